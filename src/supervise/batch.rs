//! From a seed to a training batch: frames, measurements, questions and their true answers.

use super::asked::{Asked, questions};
use super::measure::{measure, spoil};
use super::mix::Scenes;
use super::recipe::{BatchConfig, LabelSource};
use crate::depth::SparseDepth;
use crate::depth::interpolate::Interpolator;
use crate::error::{Error, Result};
use crate::model::{SdimModel, View, at_cells, scatter};
use crate::query::prompt::Tokens;
use crate::query::{DepthUnit, PromptWriter, Query};
use crate::scenes::RgbdFrame;
use crate::vlm::chat::tokenizer::Tokenizer;
use crate::vlm::qwen2_5::config::VlmConfig;
use crate::vlm::qwen2_5::grid::Grid;
use crate::vlm::qwen2_5::preprocess::Pixels;
use image::RgbImage;
use rand::Rng;
use rand::seq::SliceRandom;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use rayon::prelude::*;
use std::borrow::Cow;

/// One frame's part of a batch.
pub struct Example {
    /// The frame as the encoder reads it.
    pub pixels: Pixels,
    /// Scattered measurements as the fusion block sees them, row-major.
    pub scattered: Vec<f32>,
    /// What interpolation gives at the middle of each cell of [`crate::model::CELL`] pixels a side, in number units, row-major.
    pub interpolated: Vec<f32>,
    /// Metres per number unit.
    pub unit: f32,
    /// The shared prefix.
    pub prefix: Tokens,
    /// Suffixes with their answers' tokens (all but the last one appended), shortest first.
    pub items: Vec<Item>,
}

impl Example {
    /// Pixels with a measurement, by their place in the frame, and what the fusion block sees of it.
    pub(super) fn measured(&self) -> impl Iterator<Item = (u32, f32)> + '_ {
        (0u32..).zip(self.scattered.iter().copied()).filter(|(_, value)| *value != 0.0)
    }

    /// What tokens at its pixels see of the frame.
    ///
    /// # Errors
    /// [`Error::Tensors`] if the device refuses it.
    pub fn view(&self, model: &SdimModel) -> Result<View<'_>> {
        let width = self.pixels.resized.width() as usize;
        let measured = self.measured().map(|(pixel, _)| (pixel as usize % width, pixel as usize / width));
        View::new(model, Cow::Borrowed(&self.pixels.resized), &self.interpolated, measured)
    }

    /// What the frame's errors are counted in, as in its [`Item::scale`]; 1 without a question.
    pub(super) fn scale(&self) -> f32 {
        self.items.first().map_or(1.0, |item| item.scale)
    }
}

/// One question with its answer.
pub struct Item {
    /// What the decoder reads.
    pub tokens: Tokens,
    /// Tokens at the end of `tokens` whose next token is supervised.
    pub supervised: usize,
    /// The answer, as indices of the number rows.
    pub answer: Vec<usize>,
    /// The answer in number units.
    pub value: f32,
    /// What interpolation of the measurements says here, in number units.
    pub hint: f32,
    /// What the frame's errors are counted in, in number units, so that frames of near and of far things weigh alike: its
    /// largest measurement, or twice the median where numbers are counted in the median.
    pub scale: f32,
}

/// Mixes a run's seed with a counter, so that neighbouring streams share nothing.
pub fn mix(seed: u64, counter: u64) -> u64 {
    let mut z = seed ^ counter.wrapping_mul(0x9E37_79B9_7F4A_7C15);
    z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
    z ^ (z >> 31)
}

/// Seeds of scenes, cut into ranges that share none, so that what scores a model was never trained on: training draws from
/// here, below are those of evaluations that count their scenes, above those of held-out records.
pub fn training_seed(random: u64) -> u64 {
    random >> 2 | 1 << 62
}

/// Seeds of scenes that are held out, for records; see [`training_seed`].
pub fn held_out_seed(random: u64) -> u64 {
    random >> 1 | 1 << 63
}

/// Makes the examples of one step, in parallel; the same seed and step give the same batch.
///
/// # Errors
/// Errors of the prompt writer; a frame without any return is replaced by the next seed's. As [`Scenes::check`].
pub fn make(
    model: &SdimModel,
    config: &BatchConfig,
    scenes: &Scenes,
    seed: u64,
    step: u64,
) -> Result<Vec<Example>> {
    scenes.check(false)?;
    let size = config.sizes[(mix(seed ^ 0x51CE, step) % config.sizes.len() as u64) as usize];
    (0..config.frames as u64)
        .into_par_iter()
        .map(|i| {
            let base = mix(seed, step * config.frames as u64 + i);
            let mut tries = 0;
            loop {
                match example(model, config, scenes, mix(base, tries), size) {
                    Err(_) if tries < 8 => tries += 1,
                    other => return other,
                }
            }
        })
        .collect()
}

/// What a checkpoint writes questions with: all of it but the weights.
#[derive(Clone, Copy)]
pub struct Asking<'a> {
    /// Sizes of the model.
    pub config: &'a VlmConfig,
    /// Its words and numbers.
    pub prompts: &'a PromptWriter,
    /// Its vocabulary.
    pub tokenizer: &'a Tokenizer,
}

impl<'a> From<&'a SdimModel> for Asking<'a> {
    fn from(model: &'a SdimModel) -> Self {
        Self { config: &model.vlm.config, prompts: &model.prompts, tokenizer: &model.tokenizer }
    }
}

/// The frame of a seed, as it is trained on: a scene of the mix, mirrored and recoloured. All training data come from here.
///
/// # Errors
/// Errors of the scenes.
pub fn frame(scenes: &Scenes, seed: u64, size: (usize, usize)) -> Result<RgbdFrame> {
    let place = (mix(seed, 2) >> 40) as f32 / (1u64 << 24) as f32;
    let mut frame = scenes.render(seed, place, size)?;
    augment(&mut frame, &mut ChaCha8Rng::seed_from_u64(mix(seed, 1)));
    Ok(frame)
}

fn example(
    model: &SdimModel,
    config: &BatchConfig,
    scenes: &Scenes,
    seed: u64,
    size: (usize, usize),
) -> Result<Example> {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let frame = frame(scenes, training_seed(rng.random()), size)?;
    example_of(model.into(), config, &frame, &mut rng)
}

/// Measures a frame and asks about it.
///
/// # Errors
/// [`crate::Error::NoMeasurement`] if nothing can be measured or asked; errors of the prompt writer.
pub fn example_of(
    asking: Asking,
    config: &BatchConfig,
    frame: &RgbdFrame,
    rng: &mut ChaCha8Rng,
) -> Result<Example> {
    example_again(asking, config, frame, None, rng)
}

/// Measures a frame once more and asks about it; `picture` is what a camera made of it the first time.
///
/// # Errors
/// As [`example_of`].
pub(super) fn example_again(
    asking: Asking,
    config: &BatchConfig,
    frame: &RgbdFrame,
    picture: Option<&RgbImage>,
    rng: &mut ChaCha8Rng,
) -> Result<Example> {
    let mut frame = frame.clone();
    let (told, asked) = told_and_asked(&mut frame, config, picture, rng)?;
    written(asking, &frame.rgb, &told, config.prompt_points, &asked, rng.random())
}

/// Measures a frame, which a random camera may have taken afterwards unless there is a `picture` of it. What is told may be
/// wrong, what is asked is not.
///
/// # Errors
/// [`crate::Error::NoMeasurement`] if nothing can be measured.
pub fn told_and_asked(
    frame: &mut RgbdFrame,
    config: &BatchConfig,
    picture: Option<&RgbImage>,
    rng: &mut ChaCha8Rng,
) -> Result<(SparseDepth, Asked)> {
    let measured = measure(frame, config, picture, rng)?;
    asked_about(frame, measured, config, rng)
}

/// Of what was measured in a frame: what is told, and what is asked.
///
/// # Errors
/// [`crate::Error::NoMeasurement`] if nothing is left to tell.
pub(super) fn asked_about(
    frame: &RgbdFrame,
    measured: SparseDepth,
    config: &BatchConfig,
    rng: &mut ChaCha8Rng,
) -> Result<(SparseDepth, Asked)> {
    let (mut told, held_back) = match config.labels {
        LabelSource::Dense => (measured, None),
        LabelSource::Sparse => split(&measured, rng)?,
    };
    if rng.random::<f32>() < config.errors {
        told = spoil(&told, rng)?;
    }
    let asked = questions(frame, held_back.as_ref(), (config.questions, config.edges), Some(&told), rng);
    Ok((told, asked))
}

/// Writes questions about a frame, whose sides are multiples of patch x merge. `asked` holds pixels with their true depth in
/// metres, `seed` draws which measurements are told, `prompt_points` at most, and in which order.
///
/// # Errors
/// [`crate::Error::NoMeasurement`] without a measurement or a question; errors of the prompt writer.
pub fn written(
    asking: Asking,
    rgb: &RgbImage,
    prompted: &SparseDepth,
    prompt_points: usize,
    asked: &[(usize, usize, f32)],
    seed: u64,
) -> Result<Example> {
    let side = asking.config.vision.patch_size;
    let grid = Grid { height: rgb.height() as usize / side, width: rgb.width() as usize / side };
    let pixels = Pixels { resized: rgb.clone(), grid };
    written_on(asking, pixels, prompted, prompt_points, asked, seed)
}

/// As [`written`], about a frame of any size, of which `pixels` is what the encoder reads.
///
/// # Errors
/// As [`written`].
pub(super) fn written_on(
    asking: Asking,
    pixels: Pixels,
    prompted: &SparseDepth,
    prompt_points: usize,
    asked: &[(usize, usize, f32)],
    seed: u64,
) -> Result<Example> {
    prompted.require_points()?;
    let (width, height) = (prompted.width(), prompted.height());
    if asked.is_empty() {
        return Err(Error::NoMeasurement { width, height });
    }
    let resized = (pixels.resized.width() as usize, pixels.resized.height() as usize);
    let writer = asking.prompts;
    let (prefix, space) =
        writer.prefix_of(prompted, prompt_points, pixels.grid, resized, asking.config, seed)?;

    let points: Vec<(f32, f32)> = prompted.points().map(|(x, y, _)| (x as f32, y as f32)).collect();
    let values: Vec<f32> = prompted.points().map(|p| p.2).collect();
    let interpolator = Interpolator::new(&points, width, height)?;
    let scale = match writer.settings().unit {
        DepthUnit::FrameMedian => 2.0,
        _ => prompted.max().unwrap_or(space.unit) / space.unit,
    };
    let mut items = Vec::with_capacity(asked.len());
    for &(x, y, depth) in asked {
        let hint = interpolator.at(x as f32, y as f32, &values);
        let query = Query { x, y, measured: prompted.get(x, y), hint };
        let mut tokens = writer.suffix(&query, &space, asking.tokenizer)?;
        let value = depth / space.unit;
        let answer = writer.numbers().write(value);
        let mut p = tokens.next_text(&space);
        for &digit in &answer[..answer.len() - 1] {
            tokens.ids.push(writer.numbers().ids[digit]);
            tokens.positions.push(crate::vlm::qwen2_5::rope::Position::text(p));
            p += 1.0;
        }
        let (supervised, hint) = (answer.len(), hint / space.unit);
        items.push(Item { tokens, supervised, answer, value, hint, scale });
    }
    items.sort_by_key(|i| i.tokens.len());
    let scattered = scatter(prompted, resized.0, resized.1, |depth| writer.seen(depth, space.unit));
    let interpolated = at_cells(&interpolator.raster(&values), (width, height), resized, space.unit);
    Ok(Example { pixels, scattered, interpolated, unit: space.unit, prefix, items })
}

/// Mirrors, drops the colour or mixes the channels of a frame.
fn augment(frame: &mut RgbdFrame, rng: &mut ChaCha8Rng) {
    if rng.random_bool(0.5) {
        frame.mirror();
    }
    let mut order = [0, 1, 2];
    if rng.random_bool(0.3) {
        order.shuffle(rng);
    }
    let grey = rng.random_bool(0.08);
    recolour(&mut frame.rgb, order, grey);
}

fn recolour(rgb: &mut RgbImage, order: [usize; 3], grey: bool) {
    if order == [0, 1, 2] && !grey {
        return;
    }
    for pixel in rgb.pixels_mut() {
        let old = pixel.0;
        pixel.0 = order.map(|c| old[c]);
        if grey {
            let mean = (old.iter().map(|&v| u32::from(v)).sum::<u32>() / 3) as u8;
            pixel.0 = [mean; 3];
        }
    }
}

/// Holds 30 % of the measurements back as labels.
fn split(measured: &SparseDepth, rng: &mut ChaCha8Rng) -> Result<(SparseDepth, Option<SparseDepth>)> {
    let (held, shown): (Vec<_>, Vec<_>) = measured.points().partition(|_| rng.random_bool(0.3));
    let (w, h) = (measured.width(), measured.height());
    Ok((SparseDepth::from_points(w, h, &shown)?, Some(SparseDepth::from_points(w, h, &held)?)))
}

#[cfg(test)]
mod tests {
    use super::super::asked::tests::post;
    use super::*;
    use crate::scenes::{glazed, procedural};

    #[test]
    fn labels_stay_clean_whatever_is_told() {
        let frame = post();
        let config = BatchConfig { errors: 1.0, sensors: 0.0, ..Default::default() };
        for seed in 0..30 {
            let mut rng = ChaCha8Rng::seed_from_u64(seed);
            let mut seen = frame.clone();
            let (told, asked) = told_and_asked(&mut seen, &config, None, &mut rng).unwrap();
            assert!(told.points().any(|(_, _, d)| d != 1.0 && d != 3.0), "{seed}: nothing is wrong");
            assert!(asked.iter().all(|p| p.2 == 1.0 || p.2 == 3.0));
            let clean = BatchConfig { errors: 0.0, ..config.clone() };
            let (told, _) = told_and_asked(&mut seen, &clean, None, &mut rng).unwrap();
            assert!(told.points().all(|(_, _, d)| d == 1.0 || d == 3.0));
        }
    }

    #[test]
    fn panes_are_measured_through_and_asked_for_themselves() {
        let (mut through, mut asked_at_panes) = (0, 0);
        for (seed, sensors) in (0..12).flat_map(|seed| [(seed, 0.0), (seed, 1.0)]) {
            let frame = glazed(seed, 64, 48).unwrap();
            let glass = frame.glass.clone().unwrap();
            let config = BatchConfig { sensors, errors: 0.0, ..Default::default() };
            let mut rng = ChaCha8Rng::seed_from_u64(seed);
            let (told, asked) = told_and_asked(&mut frame.clone(), &config, None, &mut rng).unwrap();
            if sensors == 0.0 {
                assert!(told.points().all(|(x, y, d)| d == glass.sensed[y * 64 + x]));
            }
            let pane = |x: usize, y: usize| glass.pane[y * 64 + x];
            let beyond = |&(x, y, d): &(usize, usize, f32)| pane(x, y) && d > 1.3 * frame.depth[y * 64 + x];
            through += told.points().filter(beyond).count();
            assert!(asked.iter().all(|&(x, y, d)| d == frame.depth[y * 64 + x]));
            asked_at_panes += asked.iter().filter(|p| pane(p.0, p.1)).count();
        }
        assert!(through > 100 && asked_at_panes > 100, "{through} {asked_at_panes}");
    }

    #[test]
    fn a_mirrored_frame_is_seen_by_a_mirrored_camera() {
        for seed in 0..20 {
            let (clean, mut seen) = (procedural(5, 64, 48).unwrap(), procedural(5, 64, 48).unwrap());
            augment(&mut seen, &mut ChaCha8Rng::seed_from_u64(seed));
            let mirrored = seen.depth[0].to_bits() == clean.depth[63].to_bits();
            let cx = if mirrored { 63.0 - clean.intrinsics.cx } else { clean.intrinsics.cx };
            assert_eq!(seen.intrinsics.cx, cx);
        }
    }
}
