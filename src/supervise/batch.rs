//! From a seed to a training batch: frames, measurements, questions and their true answers.

use crate::depth::interpolate::Interpolator;
use crate::depth::{SparseDepth, SparsePattern};
use crate::error::{Error, Result};
use crate::model::{SdimModel, scatter};
use crate::query::prompt::Tokens;
use crate::query::{DepthUnit, PromptWriter, Query};
use crate::scenes::sensor::{CameraModel, DepthSensor};
use crate::scenes::{RgbdFrame, procedural};
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

/// Where the true answers come from.
#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum LabelSource {
    /// Measurements that are held back from the prompt: needs no ground truth (the paper's "w/ SD").
    Sparse,
    /// The dense ground truth (the paper's "w/ GT").
    Dense,
}

/// What a batch is made of.
#[derive(Debug, Clone, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(deny_unknown_fields)]
pub struct BatchConfig {
    /// Frames per step.
    pub frames: usize,
    /// Questions per frame.
    pub questions: usize,
    /// Measurements in the prompt, at most.
    pub prompt_points: usize,
    /// Fewest and most measurements per frame.
    pub points: (usize, usize),
    /// Where labels come from.
    pub labels: LabelSource,
    /// Frame sizes, one drawn per step; multiples of patch x merge.
    pub sizes: Vec<(usize, usize)>,
    /// Share of the frames that pass through a random camera and depth sensor; labels stay clean.
    #[serde(default)]
    pub sensors: f32,
}

impl Default for BatchConfig {
    fn default() -> Self {
        Self {
            frames: 8,
            questions: 128,
            prompt_points: 256,
            points: (40, 1500),
            labels: LabelSource::Dense,
            sizes: vec![(256, 192), (256, 192), (224, 224), (272, 160), (320, 144), (192, 256)],
            sensors: 0.6,
        }
    }
}

/// One frame's part of a batch.
pub struct Example {
    /// The frame as the encoder reads it.
    pub pixels: Pixels,
    /// Scattered measurements as the fusion block sees them, row-major.
    pub scattered: Vec<f32>,
    /// Metres per number unit.
    pub unit: f32,
    /// The shared prefix.
    pub prefix: Tokens,
    /// Suffixes with their answers' tokens (all but the last one appended), shortest first.
    pub items: Vec<Item>,
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
/// Errors of the prompt writer; a frame without any return is replaced by the next seed's.
pub fn make(model: &SdimModel, config: &BatchConfig, seed: u64, step: u64) -> Result<Vec<Example>> {
    let size = config.sizes[(mix(seed ^ 0x51CE, step) % config.sizes.len() as u64) as usize];
    (0..config.frames as u64)
        .into_par_iter()
        .map(|i| {
            let base = mix(seed, step * config.frames as u64 + i);
            let mut tries = 0;
            loop {
                match example(model, config, mix(base, tries), size) {
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

/// The frame of a seed, as it is trained on: a scene, mirrored and recoloured. All training data come from here.
///
/// # Errors
/// Errors of the scenes.
pub fn frame(seed: u64, size: (usize, usize)) -> Result<RgbdFrame> {
    let mut frame = procedural(seed, size.0, size.1)?;
    augment(&mut frame, &mut ChaCha8Rng::seed_from_u64(mix(seed, 1)));
    Ok(frame)
}

fn example(model: &SdimModel, config: &BatchConfig, seed: u64, size: (usize, usize)) -> Result<Example> {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let frame = frame(training_seed(rng.random()), size)?;
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
    let mut frame = frame.clone();
    let measured = measure(&mut frame, config, rng)?;
    let (prompted, held_back) = match config.labels {
        LabelSource::Dense => (measured, None),
        LabelSource::Sparse => split(&measured, rng)?,
    };
    let asked = questions(&frame, held_back.as_ref(), config.questions, rng);
    written(asking, &frame.rgb, &prompted, config.prompt_points, &asked, rng.random())
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
    prompted.require_points()?;
    let (width, height) = (rgb.width() as usize, rgb.height() as usize);
    if asked.is_empty() {
        return Err(Error::NoMeasurement { width, height });
    }
    let vision = &asking.config.vision;
    let grid = Grid { height: height / vision.patch_size, width: width / vision.patch_size };
    let writer = asking.prompts;
    let (prefix, space) =
        writer.prefix_of(prompted, prompt_points, grid, (width, height), asking.config, seed)?;

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
    let scattered = scatter(prompted, width, height, |depth| writer.seen(depth, space.unit));
    let pixels = Pixels { resized: rgb.clone(), grid };
    Ok(Example { pixels, scattered, unit: space.unit, prefix, items })
}

/// Mirrors, drops the colour or mixes the channels of a frame.
fn augment(frame: &mut RgbdFrame, rng: &mut ChaCha8Rng) {
    let (width, height) = (frame.rgb.width() as usize, frame.rgb.height() as usize);
    if rng.random_bool(0.5) {
        image::imageops::flip_horizontal_in_place(&mut frame.rgb);
        for row in frame.depth.chunks_mut(width) {
            row.reverse();
        }
    }
    debug_assert_eq!(frame.depth.len(), width * height);
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

/// Measurements of a frame: a pattern and a number of points drawn at random. A share of the frames is seen by a random
/// camera and measured by a random depth sensor; the frame's depth, of which labels are made, stays clean.
fn measure(frame: &mut RgbdFrame, config: &BatchConfig, rng: &mut ChaCha8Rng) -> Result<SparseDepth> {
    let (width, height) = (frame.rgb.width() as usize, frame.rgb.height() as usize);
    let (low, high) = config.points;
    let points = (low as f32 * (high as f32 / low as f32).powf(rng.random::<f32>())) as usize;
    let pattern = match rng.random_range(0..10) {
        0 => SparsePattern::Sfm,
        1 | 2 => SparsePattern::Lidar { lines: rng.random_range(4..24) },
        _ => SparsePattern::Uniform,
    };
    if rng.random::<f32>() >= config.sensors {
        return pattern.sample(&frame.rgb, &frame.depth, width, height, points, rng);
    }
    let measured = DepthSensor::draw(rng).measure(&frame.rgb, &frame.depth, rng)?;
    frame.rgb = CameraModel::draw(rng).photograph(&frame.rgb, rng)?;
    pattern.sample(&frame.rgb, &measured, width, height, points, rng)
}

/// Holds 30 % of the measurements back as labels.
fn split(measured: &SparseDepth, rng: &mut ChaCha8Rng) -> Result<(SparseDepth, Option<SparseDepth>)> {
    let (held, shown): (Vec<_>, Vec<_>) = measured.points().partition(|_| rng.random_bool(0.3));
    let (w, h) = (measured.width(), measured.height());
    Ok((SparseDepth::from_points(w, h, &shown)?, Some(SparseDepth::from_points(w, h, &held)?)))
}

/// Pixels to ask and their true depths.
pub(super) fn questions(
    frame: &RgbdFrame,
    held_back: Option<&SparseDepth>,
    count: usize,
    rng: &mut ChaCha8Rng,
) -> Vec<(usize, usize, f32)> {
    let width = frame.rgb.width() as usize;
    let known: Vec<(usize, usize, f32)> = match held_back {
        Some(sparse) => sparse.points().collect(),
        None => (0..frame.depth.len())
            .filter(|&i| frame.depth[i].is_finite())
            .map(|i| (i % width, i / width, frame.depth[i]))
            .collect(),
    };
    if known.is_empty() {
        return Vec::new();
    }
    (0..count).map(|_| known[rng.random_range(0..known.len())]).collect()
}
