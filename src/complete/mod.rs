//! The one function that users call: an RGB frame and sparse depth in, dense depth out.

mod adaptive;
mod alignment;
mod belief;
mod carry;
mod cells;
mod clock;
mod follow;
mod options;
mod pace;
mod prior;
mod questions;
mod schedule;
mod stages;

#[cfg(all(test, feature = "tiny"))]
mod deadline_tests;

pub use options::{
    CancelToken, CompleteOptions, Outliers, Partial, Preserve, PreviewCallback, Progress, ProgressCallback,
    Region,
};
pub(crate) use prior::{Prior, SAME_SURFACE};
pub use stages::StageSeconds;

use crate::depth::outliers::Outlier;
use crate::depth::{DepthMap, SparseDepth};
use crate::error::{Error, Result};
use crate::model::SdimModel;
use crate::query::QueryPlan;
use crate::refine::Answered;
use crate::vlm::checkpoint::LoadOptions;
use crate::vlm::qwen2_5::preprocess::MAX_RATIO;
use belief::{Reader, believe};
use clock::Clock;
use image::RgbImage;
use pace::Pace;
use questions::{Questions, scaled};
use std::collections::HashMap;
use std::path::Path;
use std::sync::Arc;

/// A dense map with what it took.
#[derive(Debug, Clone)]
pub struct Completion {
    /// The result.
    pub map: DepthMap,
    /// Pixels asked, those for alignment and about doubtful measurements included.
    pub asked: usize,
    /// Measurements that are not believed, row by row. They are not told to the model, do not define its unit, and take no
    /// part in hints, alignment and filling; what is expected there is what the map would hold without them.
    pub flagged: Vec<Outlier>,
    /// Time per stage.
    pub seconds: StageSeconds,
    /// Whether a deadline left no time for any question.
    pub(crate) interpolated: bool,
}

/// Smallest side of a frame, pixels: one merged token of the published checkpoints.
const MIN_SIDE: usize = 28;

/// A loaded checkpoint, ready for frames. Cheap to clone and to share between threads.
#[derive(Clone)]
pub struct DepthCompleter {
    model: Arc<SdimModel>,
    pace: Arc<Pace>,
}

impl DepthCompleter {
    /// The small checkpoint that ships inside the crate (feature `tiny`), on the CPU, in the format of weights that suits it.
    ///
    /// # Errors
    /// None in practice: the embedded files are covered by tests.
    #[cfg(feature = "tiny")]
    pub fn tiny() -> Result<Self> {
        Self::tiny_with(&LoadOptions::default())
    }

    /// As [`DepthCompleter::tiny`], on another device, with another format of weights or an adapter.
    ///
    /// # Errors
    /// [`Error::Tensors`] if the device refuses the tensors; what an adapter can have wrong.
    #[cfg(feature = "tiny")]
    pub fn tiny_with(options: &LoadOptions) -> Result<Self> {
        Ok(Self::new(crate::model::tiny(options)?))
    }

    /// Loads a checkpoint directory: the published files of Qwen2.5-VL (`config.json`, `preprocessor_config.json`,
    /// `tokenizer.json`, `model.safetensors` or its shards with their index), and `sdim.json` and `sdim.safetensors` if it has them.
    ///
    /// # Errors
    /// Typed errors that name the file, key or tensor.
    pub fn load(dir: impl AsRef<Path>, options: &LoadOptions) -> Result<Self> {
        Ok(Self::new(SdimModel::load(dir.as_ref(), options)?))
    }

    /// Wraps a model.
    #[doc(hidden)]
    pub fn new(model: SdimModel) -> Self {
        Self { model: Arc::new(model), pace: Arc::default() }
    }

    /// The model.
    #[doc(hidden)]
    pub fn model(&self) -> &SdimModel {
        &self.model
    }

    /// Completes a frame: Z-depth in metres for each pixel, with a confidence.
    ///
    /// ```
    /// use sdim::{CompleteOptions, DepthCompleter, QueryPlan, RgbImage, SparseDepth};
    /// # #[cfg(feature = "tiny")] {
    /// let completer = DepthCompleter::tiny()?;
    /// let rgb = RgbImage::new(64, 48);
    /// let sparse = SparseDepth::from_points(64, 48, &[(5, 5, 2.0), (60, 8, 2.5), (30, 40, 1.2)])?;
    /// let options = CompleteOptions::default().with_plan(QueryPlan::Stride(8));
    /// let map = completer.complete(&rgb, &sparse, &options)?;
    /// assert_eq!(map.get(60, 8), Some(2.5), "measured pixels keep their measurement");
    /// assert!(map.depth().iter().all(|d| *d > 0.0), "metres, row-major");
    /// # }
    /// # Ok::<(), sdim::Error>(())
    /// ```
    ///
    /// # Errors
    /// [`Error::SizeMismatch`]; [`Error::ImageSize`] on a side under 28 pixels or an aspect ratio over 200;
    /// [`Error::NoMeasurement`]; [`Error::Config`] if the answer mode does not go with the checkpoint or the frame is too small
    /// for its mark; [`Error::Cancelled`].
    pub fn complete(
        &self,
        rgb: &RgbImage,
        sparse: &SparseDepth,
        options: &CompleteOptions,
    ) -> Result<DepthMap> {
        Ok(self.complete_detailed(rgb, sparse, options)?.map)
    }

    /// As [`DepthCompleter::complete`], with counts and times.
    ///
    /// # Errors
    /// As [`DepthCompleter::complete`].
    pub fn complete_detailed(
        &self,
        rgb: &RgbImage,
        sparse: &SparseDepth,
        options: &CompleteOptions,
    ) -> Result<Completion> {
        self.complete_after(rgb, sparse, options, None)
    }

    /// As [`DepthCompleter::complete_detailed`], in a frame of which a map is expected.
    pub(crate) fn complete_after(
        &self,
        rgb: &RgbImage,
        sparse: &SparseDepth,
        options: &CompleteOptions,
        prior: Option<&Prior>,
    ) -> Result<Completion> {
        let start = self.pace.watch().now();
        self.check(rgb, sparse, options)?;
        let (watch, pace) = (self.pace.watch(), self.pace.seconds());
        let pixels = sparse.width() * sparse.height();
        let clock = match options.plan {
            QueryPlan::Deadline(time) => Some(Clock::new(watch, start, time)),
            _ => None,
        };
        let refining = pace.refining(pixels);
        if clock.is_some_and(|c| c.left() < pace.prefix.unwrap_or(0.0) * pixels as f64 + refining) {
            self.pace.skipped();
            return self.interpolated(sparse, &[], options, start);
        }
        let mut seconds = StageSeconds::default();
        let _span =
            tracing::info_span!("complete", width = sparse.width(), height = sparse.height()).entered();
        let cancelled = || options.cancel.as_ref().is_some_and(CancelToken::is_cancelled);
        // Questions that there is no time for any more need no prefix.
        let least = refining.max(pace.interpolating(pixels));
        let off = || cancelled() || clock.is_some_and(|c| c.left() < least);
        let reader = Reader { model: &self.model, options, watch, off: &off };
        let mark = watch.now();
        let believed = match believe(&reader, rgb, sparse, &mut seconds) {
            Err(Error::Cancelled) if !cancelled() => {
                self.pace.interrupted(pixels, watch.since(mark));
                return self.interpolated(sparse, &[], options, start);
            }
            other => other?,
        };
        let span = tracing::info_span!("queries").entered();
        let mark = watch.now();
        let questions = Questions::new(&self.model, rgb, &believed, options, watch)?;
        let answers = match prior {
            Some(prior) => questions.ask_following(prior, clock, pace)?,
            None => questions.ask_all(clock, pace)?,
        };
        drop(span);
        seconds.queries = watch.since(mark);
        let _refine = tracing::info_span!("refine").entered();
        let mark = watch.now();
        let asked = answers.asked + believed.asked;
        if answers.is_empty() && clock.is_some() {
            let late = self.interpolated(&believed.sparse, &believed.flagged, options, start)?;
            self.pace.learn(pixels, &seconds, (answers.asked, answers.seconds));
            return Ok(Completion {
                asked,
                seconds: StageSeconds { total: late.seconds.total, ..seconds },
                ..late
            });
        }
        let (map, flagged) = questions.dense(&answers)?;
        seconds.refine = watch.since(mark);
        self.pace.learn(pixels, &seconds, (answers.asked, answers.seconds));
        seconds.total = watch.since(start);
        Ok(Completion { map, asked, flagged, seconds, interpolated: false })
    }

    /// For want of time: the measurements, interpolated.
    fn interpolated(
        &self,
        sparse: &SparseDepth,
        flagged: &[(usize, usize, f32)],
        options: &CompleteOptions,
        start: f64,
    ) -> Result<Completion> {
        let watch = self.pace.watch();
        let mark = watch.now();
        let (map, flagged) = questions::interpolated(sparse, flagged, options)?;
        self.pace.interpolated(sparse.width() * sparse.height(), watch.since(mark));
        let seconds = StageSeconds { total: watch.since(start), ..Default::default() };
        Ok(Completion { map, asked: 0, flagged, seconds, interpolated: true })
    }

    /// How far some pixels are, without the rest of the frame: `pixels` are (column, row), the answers come in their order, in metres. A
    /// measured pixel gives its measurement where measurements are kept, with confidence 1; one whose answer cannot be read has
    /// depth NaN and confidence 0. Answers are aligned to the measurements as in a map, but there are no neighbours to read them with; plan,
    /// filter, fill, region, far limit and preview of the options say nothing here.
    ///
    /// ```
    /// # use sdim::{CompleteOptions, DepthCompleter, RgbImage, SparseDepth};
    /// # #[cfg(feature = "tiny")] {
    /// let completer = DepthCompleter::tiny()?;
    /// let sparse = SparseDepth::from_points(64, 48, &[(5, 5, 2.0), (60, 8, 2.5), (30, 40, 1.2)])?;
    /// let answers = completer.complete_at(&RgbImage::new(64, 48), &sparse, &[(31, 20), (60, 8)], &CompleteOptions::default())?;
    /// assert!(answers[0].depth > 0.0);
    /// assert_eq!((answers[1].depth, answers[1].confidence), (2.5, 1.0));
    /// # }
    /// # Ok::<(), sdim::Error>(())
    /// ```
    ///
    /// # Errors
    /// [`Error::Argument`] for a pixel outside the frame; as [`DepthCompleter::complete`].
    pub fn complete_at(
        &self,
        rgb: &RgbImage,
        sparse: &SparseDepth,
        pixels: &[(usize, usize)],
        options: &CompleteOptions,
    ) -> Result<Vec<Answered>> {
        let options = CompleteOptions { region: None, ..options.clone() };
        self.check(rgb, sparse, &options)?;
        if let Some((x, y)) = pixels.iter().find(|(x, y)| *x >= sparse.width() || *y >= sparse.height()) {
            let expected = format!("a column below {} and a row below {}", sparse.width(), sparse.height());
            return Err(Error::argument("pixel", format!("({x}, {y})"), expected));
        }
        let off = || options.cancel.as_ref().is_some_and(CancelToken::is_cancelled);
        let reader = Reader { model: &self.model, options: &options, watch: self.pace.watch(), off: &off };
        let believed = believe(&reader, rgb, sparse, &mut StageSeconds::default())?;
        let questions = Questions::new(&self.model, rgb, &believed, &options, self.pace.watch())?;
        let answers = questions.ask_pixels(pixels)?;
        let mut aligned = questions.aligned(&answers)?;
        aligned.iter_mut().for_each(|a| scaled(questions.scale(), a));
        let said: HashMap<(usize, usize), Answered> = aligned.into_iter().map(|a| ((a.x, a.y), a)).collect();
        let insisted = options.preserve == Preserve::Keep && options.outliers == Outliers::Preserve;
        let kept: HashMap<(usize, usize), f32> =
            (believed.flagged.iter().filter(|_| insisted)).map(|&(x, y, depth)| ((x, y), depth)).collect();
        let measured = |(x, y): (usize, usize)| {
            let told = believed.sparse.get(x, y).filter(|_| !questions.wanted((x, y)));
            told.or_else(|| kept.get(&(x, y)).copied())
        };
        let one = |&(x, y): &(usize, usize)| match measured((x, y)) {
            Some(depth) => Answered { x, y, depth, confidence: 1.0, expected_error: 0.0 },
            None => {
                let unread = Answered { x, y, depth: f32::NAN, confidence: 0.0, expected_error: f32::NAN };
                said.get(&(x, y)).copied().unwrap_or(unread)
            }
        };
        Ok(pixels.iter().map(one).collect())
    }

    /// Whether a frame and the options go together and with the checkpoint.
    fn check(&self, rgb: &RgbImage, sparse: &SparseDepth, options: &CompleteOptions) -> Result<()> {
        let size = (rgb.width() as usize, rgb.height() as usize);
        if size != (sparse.width(), sparse.height()) {
            return Err(Error::SizeMismatch { rgb: size, depth: (sparse.width(), sparse.height()) });
        }
        if size.0.min(size.1) < MIN_SIDE || size.0.max(size.1) > MAX_RATIO * size.0.min(size.1) {
            let reason = format!(
                "expected sides of at least {MIN_SIDE} pixels and an aspect ratio of at most {MAX_RATIO}"
            );
            return Err(Error::ImageSize { width: size.0, height: size.1, reason });
        }
        sparse.require_points()?;
        if let Some(mode) = &options.answer {
            self.model.prompts.settings().validate_mode("CompleteOptions", mode)?;
        }
        if let Some(region) = &options.region {
            region.check(size.0, size.1)?;
        }
        match options.far_limit {
            Some(far) if !(far.is_finite() && far > 0.0) => {
                Err(Error::argument("far_limit", far, "a finite number of metres above 0"))
            }
            _ => Ok(()),
        }
    }
}
