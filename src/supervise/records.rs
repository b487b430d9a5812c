//! Which records a set holds: frames, variants and questions by number, the same for the same seed wherever they are made.

use super::asked::questions;
use super::batch::{Asking, Example, example_again, frame, held_out_seed, mix, training_seed, written};
use super::mix::Scenes;
use super::recipe::BatchConfig;
use super::shard::{About, Dims, Shard, VERSION};
use crate::depth::SparsePattern;
use crate::error::{Error, Result};
use crate::query::{Hint, MeasurementPrompt, NumberTokens, PixelReference};
use crate::scenes::RgbdFrame;
use image::RgbImage;
use rand::Rng;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use rayon::prelude::*;

/// What a set is for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(tag = "kind", rename_all = "snake_case")]
pub enum RecordSet {
    /// Training: patterns and numbers of measurements are drawn as the trainer draws them.
    Train,
    /// Scoring: scenes that are never trained on, the same ones for any number of points.
    HeldOut {
        /// Measurements per frame, spread uniformly, exact.
        points: usize,
        /// Asks every `grid`-th column and row, for pictures; without it pixels are drawn.
        grid: Option<usize>,
    },
}

/// Everything that decides a set of records.
#[derive(Debug, Clone, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct RecordConfig {
    /// Frames per shard, questions per variant, and how both are drawn; a shard has one of the sizes.
    pub batch: BatchConfig,
    /// Sets of measurements and questions per frame.
    pub variants: usize,
    /// Seed of the set.
    pub seed: u64,
    /// What it is for.
    pub set: RecordSet,
}

impl RecordConfig {
    /// Checks the sizes.
    ///
    /// # Errors
    /// [`Error::Argument`].
    pub(super) fn check_sizes(&self, asking: Asking) -> Result<()> {
        let b = &self.batch;
        let side = asking.config.vision.patch_size * asking.config.vision.merge_size;
        for (name, value, most) in [
            ("frames per shard", b.frames, 1 << 16),
            ("variants", self.variants, 1 << 10),
            ("questions", b.questions, 1 << 20),
            ("prompt points", b.prompt_points, usize::from(u16::MAX)),
            ("sizes", b.sizes.len(), 1 << 10),
        ] {
            if !(1..=most).contains(&value) {
                return Err(Error::argument(name, value, format!("1 to {most}")));
            }
        }
        if let Some((name, share)) = b.wrong_share() {
            return Err(Error::argument(name, share.to_string(), "a share, 0 to 1"));
        }
        for &(w, h) in &b.sizes {
            let fits = |s: usize| s > 0 && s.is_multiple_of(side) && s <= 8192;
            if !fits(w) || !fits(h) {
                return Err(Error::argument(
                    "size",
                    format!("{w}x{h}"),
                    format!("multiples of {side}, at most 8192"),
                ));
            }
        }
        if b.points.0 == 0 || b.points.0 > b.points.1 {
            return Err(Error::argument("points", format!("{:?}", b.points), "fewest and most, at least 1"));
        }
        if let RecordSet::HeldOut { points: 0, .. } | RecordSet::HeldOut { grid: Some(0), .. } = self.set {
            return Err(Error::argument("held-out set", format!("{:?}", self.set), "at least 1 of each"));
        }
        Ok(())
    }

    /// Checks the sizes, and that the checkpoint asks as records can hold it: one token at a pixel with a hint, one token as
    /// the answer, measurements in the prefix.
    ///
    /// # Errors
    /// [`Error::Argument`] on a size, [`Error::Config`] on a way of asking.
    pub fn check(&self, asking: Asking) -> Result<()> {
        self.check_sizes(asking)?;
        let s = asking.prompts.settings();
        // What a record calls a number: its token, or its row.
        let (key, ids) = match s.number_tokens {
            NumberTokens::Vocabulary => ("vocab_size", asking.config.text.vocab_size),
            NumberTokens::Rows => ("number.bins", asking.prompts.numbers().ids.len()),
        };
        for (key, fits) in [
            ("pixel_reference", matches!(s.pixel_reference, PixelReference::Pointer { .. })),
            ("measurements", matches!(s.measurements, MeasurementPrompt::Prefix { .. })),
            ("number", s.number.bins().is_some()),
            ("hint", s.hint == Hint::Linear),
            ("template.query", s.template.query == "{pixel}" && s.template.forced().is_empty()),
            ("fusion", s.fusion.is_some()),
            (key, ids <= 1 << 16),
        ] {
            if !fits {
                return Err(Error::config("sdim.json", key, "another way of asking", "that of sdim-tiny"));
            }
        }
        Ok(())
    }

    /// Whether the set's scenes are never trained on.
    pub fn held_out(&self) -> bool {
        matches!(self.set, RecordSet::HeldOut { .. })
    }

    /// Makes a shard of scenes of the batch's mix, on all cores.
    ///
    /// # Errors
    /// As [`RecordConfig::check`] and [`Scenes::check`]; a frame of which nothing can be measured is replaced by the next seed's, eight times.
    pub fn shard(&self, asking: Asking, scenes: &Scenes, index: u64) -> Result<Shard> {
        self.check(asking)?;
        scenes.check(self.held_out())?;
        if scenes.mix() != self.batch.mix {
            let found = format!("{:?}", scenes.mix());
            return Err(Error::argument("mix", found, format!("the records' own: {:?}", self.batch.mix)));
        }
        let size =
            self.batch.sizes[(mix(self.seed ^ 0x51CE, index) % self.batch.sizes.len() as u64) as usize];
        let first = index.saturating_mul(self.batch.frames as u64);
        let made: Vec<(u64, Vec<Example>)> = (first..first.saturating_add(self.batch.frames as u64))
            .into_par_iter()
            .map(|number| self.frame(asking, scenes, number, size))
            .collect::<Result<_>>()?;
        let about = About {
            version: VERSION,
            sdim: env!("CARGO_PKG_VERSION").into(),
            index,
            config: serde_json::to_value(self)
                .map_err(|e| Error::format("records", e.to_string(), "a configuration that JSON can hold"))?,
            settings: asking.prompts.settings().of_the_shape(),
        };
        let dims = Dims {
            frames: made.len(),
            variants: self.variants,
            width: size.0,
            height: size.1,
            told: self.batch.prompt_points,
            asked: made.first().and_then(|(_, v)| v.first()).map_or(0, |e| e.items.len()),
        };
        let mut shard = Shard::new(about, dims);
        for (seed, variants) in made {
            shard.push(seed, &variants)?;
        }
        Ok(shard)
    }

    /// One frame by its number in the set: the scene's seed, and its variants.
    fn frame(
        &self,
        asking: Asking,
        scenes: &Scenes,
        number: u64,
        size: (usize, usize),
    ) -> Result<(u64, Vec<Example>)> {
        let base = mix(self.seed, number);
        let mut tries = 0;
        loop {
            let random = mix(base, tries);
            let seed = match self.set {
                RecordSet::Train => training_seed(random),
                RecordSet::HeldOut { .. } => held_out_seed(random),
            };
            let made = frame(scenes, seed, size).and_then(|f| {
                let dice = |v| ChaCha8Rng::seed_from_u64(mix(random, v));
                let mut made = vec![self.variant(asking, &f, None, &mut dice(1))?];
                // A shard holds one picture of a frame: the first variant's.
                let picture = made[0].pixels.resized.clone();
                for v in 2..=self.variants as u64 {
                    made.push(self.variant(asking, &f, Some(&picture), &mut dice(v))?);
                }
                Ok(made)
            });
            match made {
                Err(_) if tries < 8 => tries += 1,
                Err(e) => return Err(e),
                Ok(variants) => return Ok((seed, variants)),
            }
        }
    }

    fn variant(
        &self,
        asking: Asking,
        frame: &RgbdFrame,
        picture: Option<&RgbImage>,
        rng: &mut ChaCha8Rng,
    ) -> Result<Example> {
        let RecordSet::HeldOut { points, grid } = self.set else {
            return example_again(asking, &self.batch, frame, picture, rng);
        };
        let (width, height) = (frame.width(), frame.height());
        let sparse = SparsePattern::Uniform.sample(&frame.rgb, frame.sensed(), width, height, points, rng)?;
        let asked = match grid {
            None => questions(frame, None, (self.batch.questions, 0.0), None, rng),
            Some(step) => (step / 2..height)
                .step_by(step)
                .flat_map(|y| (step / 2..width).step_by(step).map(move |x| (x, y)))
                .map(|(x, y)| (x, y, frame.depth[y * width + x]))
                .collect(),
        };
        written(asking, &frame.rgb, &sparse, self.batch.prompt_points, &asked, rng.random())
    }
}
