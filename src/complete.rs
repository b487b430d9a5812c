//! The one function that users call: an RGB frame and sparse depth in, dense depth out.

mod alignment;
mod belief;
mod questions;

use crate::depth::outliers::Outlier;
use crate::depth::{DepthMap, SparseDepth};
use crate::error::{Error, Result};
use crate::model::{LoadOptions, SdimModel};
use crate::query::{AnswerMode, QueryPlan};
use crate::refine::{EdgeAwareFill, Fill};
use crate::vlm::preprocess::MAX_RATIO;
use candle_core::Device;
use image::RgbImage;
use questions::Questions;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Instant;

/// What becomes of measured pixels.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Preserve {
    /// They keep their measurement bit for bit, with confidence 1.
    #[default]
    Keep,
    /// They are asked like any other pixel where the plan comes to them, with mask 1 as in the paper where the template has
    /// mask sentences; where it does not, they are filled from answers.
    Ask,
}

/// What becomes of measurements that their neighbours, the picture and the model's own answer contradict
/// ([`Completion::flagged`]): saturated pixels, rays that went astray, left-overs of rectification.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Outliers {
    /// Their pixels are completed as if nothing had been measured there.
    #[default]
    Ignore,
    /// As `Ignore`, but the map keeps their measurement, where it keeps measurements at all ([`Preserve::Keep`]).
    Preserve,
    /// Measurements are not checked: all of them count, and none is flagged.
    Trust,
}

/// How far a frame is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Progress {
    /// Pixels answered so far.
    pub answered: usize,
    /// Pixels that will be asked.
    pub planned: usize,
}

/// Stops a [`DepthCompleter::complete`] that runs on another thread.
#[derive(Debug, Clone, Default)]
pub struct CancelToken(Arc<AtomicBool>);

impl CancelToken {
    /// Asks to stop; the call returns [`Error::Cancelled`] after the batch that runs.
    pub fn cancel(&self) {
        self.0.store(true, Ordering::Relaxed);
    }

    /// Whether [`CancelToken::cancel`] was called.
    pub fn is_cancelled(&self) -> bool {
        self.0.load(Ordering::Relaxed)
    }
}

/// Called after each batch of answers.
pub type ProgressCallback = Arc<dyn Fn(Progress) + Send + Sync>;

/// How to complete a frame.
#[derive(Clone)]
pub struct CompleteOptions {
    /// Which pixels to ask.
    pub plan: QueryPlan,
    /// What becomes of measured pixels.
    pub preserve: Preserve,
    /// What becomes of measurements that are not plausible.
    pub outliers: Outliers,
    /// How answers are got; `None` for the checkpoint's own way (`answer_mode` of `sdim.json`).
    pub answer: Option<AnswerMode>,
    /// Whether to ask at measured pixels too and to spread the difference over the map, so that it passes through the
    /// measurements.
    pub align: bool,
    /// Bytes that a batch of queries may take beside the weights and the frame, about; smaller batches are slower and give
    /// the same answers. `None` for batches of 2048 rows.
    pub max_memory: Option<usize>,
    /// How pixels that were not asked are filled.
    pub fill: Arc<dyn Fill>,
    /// Told after each batch.
    pub progress: Option<ProgressCallback>,
    /// Checked after each batch.
    pub cancel: Option<CancelToken>,
}

impl Default for CompleteOptions {
    fn default() -> Self {
        Self {
            plan: QueryPlan::default(),
            preserve: Preserve::default(),
            outliers: Outliers::default(),
            answer: None,
            align: true,
            max_memory: None,
            fill: Arc::new(EdgeAwareFill::default()),
            progress: None,
            cancel: None,
        }
    }
}

impl std::fmt::Debug for CompleteOptions {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("CompleteOptions")
            .field("plan", &self.plan)
            .field("preserve", &self.preserve)
            .field("outliers", &self.outliers)
            .field("answer", &self.answer)
            .field("align", &self.align)
            .field("max_memory", &self.max_memory)
            .finish_non_exhaustive()
    }
}

/// Seconds spent in each stage.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct StageSeconds {
    /// Checking the measurements, with what is asked about them.
    pub check: f64,
    /// Preprocessing, fusion and vision encoder.
    pub encode: f64,
    /// Reading the shared prefix.
    pub prefill: f64,
    /// Asking.
    pub queries: f64,
    /// Alignment and filling.
    pub refine: f64,
    /// All of it.
    pub total: f64,
}

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
}

/// Smallest side of a frame, pixels: one merged token of the published checkpoints.
const MIN_SIDE: usize = 28;

/// A loaded checkpoint, ready for frames. Cheap to clone and to share between threads.
#[derive(Clone)]
pub struct DepthCompleter {
    model: Arc<SdimModel>,
}

impl DepthCompleter {
    /// The small checkpoint that ships inside the crate (feature `tiny`), on the CPU.
    ///
    /// # Errors
    /// None in practice: the embedded files are covered by tests.
    #[cfg(feature = "tiny")]
    pub fn tiny() -> Result<Self> {
        Self::tiny_on(&Device::Cpu)
    }

    /// As [`DepthCompleter::tiny`], on another device.
    ///
    /// # Errors
    /// [`Error::Tensors`] if the device refuses the tensors.
    #[cfg(feature = "tiny")]
    pub fn tiny_on(device: &Device) -> Result<Self> {
        Self::tiny_with(&LoadOptions::on(device))
    }

    /// As [`DepthCompleter::tiny`], with a form of weights and an adapter.
    ///
    /// # Errors
    /// [`Error::Tensors`] if the device refuses the tensors; what an adapter can have wrong.
    #[cfg(feature = "tiny")]
    pub fn tiny_with(options: &LoadOptions) -> Result<Self> {
        Ok(Self::new(crate::model::tiny(options)?))
    }

    /// Loads a checkpoint directory onto a device.
    ///
    /// # Errors
    /// As [`SdimModel::load`].
    pub fn load(dir: impl AsRef<Path>, device: &Device) -> Result<Self> {
        Ok(Self::new(SdimModel::load(dir.as_ref(), device)?))
    }

    /// Loads a checkpoint directory with a form of weights and an adapter.
    ///
    /// # Errors
    /// As [`SdimModel::load_with`].
    pub fn load_with(dir: impl AsRef<Path>, options: &LoadOptions) -> Result<Self> {
        Ok(Self::new(SdimModel::load_with(dir.as_ref(), options)?))
    }

    /// Wraps a model.
    pub fn new(model: SdimModel) -> Self {
        Self { model: Arc::new(model) }
    }

    /// The model.
    pub fn model(&self) -> &SdimModel {
        &self.model
    }

    /// Completes a frame: Z-depth in metres for each pixel, with a confidence.
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
        let start = Instant::now();
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
            mode.validate("CompleteOptions", self.model.prompts.settings())?;
        }
        let mut seconds = StageSeconds::default();
        let _span = tracing::info_span!("complete", width = size.0, height = size.1).entered();
        let believed = self.believe(rgb, sparse, options, &mut seconds)?;
        let span = tracing::info_span!("queries").entered();
        let mark = Instant::now();
        let questions = Questions::new(&self.model, &believed.prefix, &believed.sparse, options)?;
        let answers = questions.ask_all()?;
        drop(span);
        seconds.queries = mark.elapsed().as_secs_f64();
        let _refine = tracing::info_span!("refine").entered();
        let mark = Instant::now();
        let asked = answers.asked + believed.asked;
        let (map, flagged) = questions.dense(rgb, answers, &believed.flagged)?;
        seconds.refine = mark.elapsed().as_secs_f64();
        seconds.total = start.elapsed().as_secs_f64();
        Ok(Completion { map, asked, flagged, seconds })
    }
}
