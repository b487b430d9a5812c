//! Training on frames of a user's own camera, which have no ground truth: some of a frame's measurements are told, the others
//! are asked (Sec. 3.4 of the paper: labels made of sparse depth).

use super::asked::Asked;
use super::base::Base;
use super::batch::{Asking, Example, mix, written_on};
use super::config::TrainConfig;
use super::own::OwnFrame;
use super::recipe::{BatchConfig, LabelSource};
use super::trainer::{StepReport, Trainer, check_shared};
use crate::depth::SparseDepth;
use crate::error::{Error, Result};
use crate::model::{Adapter, SETTINGS, SdimModel};
use crate::vlm::qwen2_5::preprocess::Pixels;
use rand::Rng;
use rand::seq::SliceRandom;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use rayon::prelude::*;

/// A run that adapts a checkpoint to one camera.
pub struct Adaptation {
    trainer: Trainer,
    base: Base,
    /// Each frame, and its mirror image.
    frames: Vec<[Seen; 2]>,
    /// The batch of a coming step.
    prefetched: Option<(u64, Vec<Example>)>,
}

/// A frame as it is trained on.
struct Seen {
    pixels: Pixels,
    sparse: SparseDepth,
}

/// Share of a frame's measurements that are asked and not told.
const HELD_BACK: f32 = 0.25;

impl Adaptation {
    /// What a run of so many steps is made of: small steps from what is known ([`TrainConfig::tuning`]).
    pub fn config(steps: usize, seed: u64) -> TrainConfig {
        TrainConfig {
            steps,
            rate: 3e-4,
            seed,
            batch: BatchConfig {
                frames: 4,
                prompt_points: usize::MAX,
                questions: 96,
                labels: LabelSource::Sparse,
                ..BatchConfig::default()
            },
            ..TrainConfig::default()
        }
        .tuning()
    }

    /// Starts from a checkpoint. Of the configuration's batch only the number of frames, of questions and of measurements in the
    /// prompt count: the rest is the camera's own.
    ///
    /// # Errors
    /// [`Error::Argument`] without a frame; as [`Trainer::new`] for what cannot be trained;
    /// [`Error::ImageSize`] for frames that the checkpoint cannot read.
    pub fn new(config: TrainConfig, base: Base, frames: &[OwnFrame]) -> Result<Self> {
        if frames.is_empty() {
            return Err(Error::argument("frames", "none", "at least one"));
        }
        let file = base.dir.join(SETTINGS).display().to_string();
        check_shared(&base.files.parse_of(&base.dir)?.settings, &file)?;
        let trainer = Trainer::of(config, &base, |_| true)?;
        let preprocessor = &trainer.model().preprocessor;
        let seen = |frame: &OwnFrame| -> Result<Seen> {
            Ok(Seen { pixels: preprocessor.resize(&frame.rgb)?, sparse: frame.sparse.clone() })
        };
        let both = |frame: &OwnFrame| Ok([seen(frame)?, seen(&frame.mirrored()?)?]);
        let frames = frames.iter().map(both).collect::<Result<_>>()?;
        Ok(Self { trainer, base, frames, prefetched: None })
    }

    /// One step.
    ///
    /// # Errors
    /// As [`Trainer::train_step`].
    pub fn step(&mut self) -> Result<StepReport> {
        let step = self.trainer.step() as u64;
        let config = self.trainer.config();
        let (batch, seed) = (config.batch.clone(), config.seed);
        let make = |model: &SdimModel, step| examples(model, &self.frames, &batch, seed, step);
        let now = match self.prefetched.take() {
            Some((of, examples)) if of == step => examples,
            _ => make(self.trainer.model(), step)?,
        };
        let (report, next) = self.trainer.step_on(&now, |model| make(model, step + 1))?;
        self.prefetched = Some((step + 1, next));
        Ok(report)
    }

    /// The adapted model.
    ///
    /// # Errors
    /// As [`Trainer::averaged_model`].
    pub fn model(&self) -> Result<SdimModel> {
        self.trainer.averaged_model()
    }

    /// What it is in an adapter.
    ///
    /// # Errors
    /// As [`Trainer::adapter`].
    pub fn adapter(&self) -> Result<Adapter> {
        self.trainer.adapter(&self.base)
    }
}

/// The examples of a step. Each frame comes once before any comes again, in an order of its own each time.
fn examples(
    model: &SdimModel,
    frames: &[[Seen; 2]],
    batch: &BatchConfig,
    seed: u64,
    step: u64,
) -> Result<Vec<Example>> {
    let count = frames.len() as u64;
    let first = step * batch.frames as u64;
    (first..first + batch.frames as u64)
        .into_par_iter()
        .map(|number| {
            let mut order: Vec<usize> = (0..frames.len()).collect();
            order.shuffle(&mut ChaCha8Rng::seed_from_u64(mix(seed, number / count)));
            let pair = &frames[order[(number % count) as usize]];
            let mut rng = ChaCha8Rng::seed_from_u64(mix(seed ^ 0xADA7, number));
            let seen = &pair[usize::from(rng.random_bool(0.5))];
            let (told, held) = hold_back(&seen.sparse, rng.random())?;
            let asked: Vec<_> = (0..batch.questions).map(|_| held[rng.random_range(0..held.len())]).collect();
            let pixels = seen.pixels.clone();
            written_on(Asking::from(model), pixels, &told, batch.prompt_points, &asked, rng.random())
        })
        .collect()
}

/// Parts measurements into those that are told and those that are held back, about a quarter, neither of them none: the measurements of
/// square cells, from single pixels to an eighth of the width, so that pixels far from any measurement are asked as well.
///
/// # Errors
/// [`Error::NoMeasurement`] for fewer than two.
pub fn hold_back(measured: &SparseDepth, seed: u64) -> Result<(SparseDepth, Asked)> {
    let (width, height) = (measured.width(), measured.height());
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let largest = (width as f32 / 8.0).max(1.0);
    let side = largest.powf(rng.random::<f32>()) as usize;
    let (dx, dy) = (rng.random_range(0..side), rng.random_range(0..side));
    let dice: u64 = rng.random();
    let mut points: Vec<(usize, usize, f32)> = measured.points().collect();
    let of = |&(x, y, _): &(usize, usize, f32)| {
        let cell = ((y + dy) / side * (width + side) + (x + dx) / side) as u64;
        mix(dice, cell + 1)
    };
    // Whole cells by their lot: those of the lowest are held back.
    points.sort_by_key(|p| (of(p), p.1, p.0));
    let wanted = ((points.len() as f32 * HELD_BACK).round() as usize).max(1);
    if points.len() < 2 {
        return Err(Error::NoMeasurement { width, height });
    }
    let told = points.split_off(wanted.min(points.len() - 1));
    Ok((SparseDepth::from_points(width, height, &told)?, points))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_quarter_is_held_back_in_cells_of_any_size() {
        let points: Vec<(usize, usize, f32)> =
            (0..600).map(|i| ((i * 37) % 160, (i * 53) % 120, 1.0 + i as f32)).collect();
        let all = SparseDepth::from_points(160, 120, &points).unwrap();
        let mut apart = Vec::new();
        for seed in 0..40 {
            let (told, held) = hold_back(&all, seed).unwrap();
            assert_eq!(held.len(), (all.measured() as f32 * 0.25).round() as usize);
            assert_eq!(told.measured() + held.len(), all.measured());
            assert!(held.iter().all(|&(x, y, d)| told.get(x, y).is_none() && all.get(x, y) == Some(d)));
            assert_eq!(hold_back(&all, seed).unwrap().1, held);
            // How far the next told one is.
            let far = |&(x, y, _): &(usize, usize, f32)| {
                let off = |(a, b, _): (usize, usize, f32)| a.abs_diff(x).max(b.abs_diff(y));
                told.points().map(off).min().unwrap() as f32
            };
            apart.push(held.iter().map(far).sum::<f32>() / held.len() as f32);
        }
        apart.sort_by(f32::total_cmp);
        assert!(apart[39] > 1.3 * apart[0], "{} to {}", apart[0], apart[39]);
    }

    #[test]
    fn neither_part_is_ever_empty() {
        let two = SparseDepth::from_points(40, 30, &[(3, 4, 1.0), (4, 4, 2.0)]).unwrap();
        for seed in 0..20 {
            let (told, held) = hold_back(&two, seed).unwrap();
            assert_eq!((told.measured(), held.len()), (1, 1));
        }
        let one = SparseDepth::from_points(40, 30, &[(3, 4, 1.0)]).unwrap();
        assert!(matches!(hold_back(&one, 1), Err(Error::NoMeasurement { .. })));
    }
}
