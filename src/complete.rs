//! The one function that users call: an RGB frame and sparse depth in, dense depth out.

use crate::depth::interpolate::Interpolator;
use crate::depth::{DepthMap, SparseDepth};
use crate::error::{Error, Result};
use crate::model::{LoadOptions, SdimModel};
use crate::query::plan::{Asked, lattice, refine_pixels, stride_within};
use crate::query::prompt::choose_evenly;
use crate::query::{AnswerMode, Hint, Prefix, Query, QueryPlan, Reading, ask_as};
use crate::refine::{Answered, EdgeAwareFill, Fill, FillInput};
use crate::vlm::preprocess::MAX_RATIO;
use candle_core::Device;
use image::RgbImage;
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
    /// How answers are got; `None` for the checkpoint's own way (`answer_mode` of `sdim.json`).
    pub answer: Option<AnswerMode>,
    /// Whether to ask at measured pixels too and to spread the difference over the map, so that it passes through the
    /// measurements.
    pub align: bool,
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
            answer: None,
            align: true,
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
            .field("answer", &self.answer)
            .field("align", &self.align)
            .finish_non_exhaustive()
    }
}

/// Seconds spent in each stage.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct StageSeconds {
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
    /// Pixels asked, those for alignment included.
    pub asked: usize,
    /// Time per stage.
    pub seconds: StageSeconds,
}

/// Measurements asked for the alignment, at most; more are chosen spatially even.
const ALIGN_POINTS: usize = 2048;

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
        Self::tiny_with(&LoadOptions { device: device.clone(), ..LoadOptions::default() })
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
        let span = tracing::info_span!("encode").entered();
        let (pixels, scattered) = self.model.preprocess(rgb, sparse)?;
        let encoded = self.model.encode_frame(rgb, &pixels, &scattered)?;
        drop(span);
        seconds.encode = start.elapsed().as_secs_f64();
        let span = tracing::info_span!("prefill").entered();
        let mark = Instant::now();
        let prefix = self.model.read_encoded(&pixels, encoded, sparse)?;
        drop(span);
        seconds.prefill = mark.elapsed().as_secs_f64();
        let span = tracing::info_span!("queries").entered();
        let mark = Instant::now();
        let frame = Frame::new(&self.model, &prefix, sparse, options)?;
        let (answers, residual) = frame.ask_all()?;
        drop(span);
        seconds.queries = mark.elapsed().as_secs_f64();
        let _refine = tracing::info_span!("refine").entered();
        let mark = Instant::now();
        let asked = answers.len() + residual.points.len();
        let map = frame.dense(rgb, answers, &residual)?;
        seconds.refine = mark.elapsed().as_secs_f64();
        seconds.total = start.elapsed().as_secs_f64();
        Ok(Completion { map, asked, seconds })
    }
}

/// A pixel and what was answered there.
type PixelReading = ((usize, usize), Reading);

/// Measurement minus answer at the pixels that were asked for the alignment.
#[derive(Default)]
struct Residual {
    points: Vec<(f32, f32)>,
    values: Vec<f32>,
}

/// One frame on its way through the questions.
struct Frame<'a> {
    model: &'a SdimModel,
    prefix: &'a Prefix,
    sparse: &'a SparseDepth,
    options: &'a CompleteOptions,
    /// Linear interpolation of all measurements, metres; empty if the checkpoint takes no hint.
    hint: Vec<f32>,
}

impl<'a> Frame<'a> {
    fn new(
        model: &'a SdimModel,
        prefix: &'a Prefix,
        sparse: &'a SparseDepth,
        options: &'a CompleteOptions,
    ) -> Result<Self> {
        let hint = match model.prompts.settings().hint {
            Hint::Linear => crate::depth::interpolate::linear(sparse)?,
            Hint::None => Vec::new(),
        };
        Ok(Self { model, prefix, sparse, options, hint })
    }

    /// What is asked at a pixel; `tell` states its measurement where the template has a place for it.
    fn query(&self, (x, y): (usize, usize), tell: bool) -> Query {
        let hint = self.hint.get(y * self.sparse.width() + x).copied().unwrap_or(f32::NAN);
        Query { x, y, measured: self.sparse.get(x, y).filter(|_| tell), hint }
    }

    /// Pixels of a plan that need an answer: measured ones do not, where they are kept.
    fn wanted(&self, pixels: Vec<(usize, usize)>) -> Vec<(usize, usize)> {
        let keep = self.options.preserve == Preserve::Keep;
        pixels.into_iter().filter(|&(x, y)| !keep || self.sparse.get(x, y).is_none()).collect()
    }

    fn ask(
        &self,
        pixels: &[(usize, usize)],
        tell: bool,
        before: usize,
        planned: usize,
    ) -> Result<Vec<Reading>> {
        let queries: Vec<Query> = pixels.iter().map(|&p| self.query(p, tell)).collect();
        let mode = self.options.answer.as_ref().unwrap_or(&self.model.prompts.settings().answer_mode);
        ask_as(self.model, self.prefix, &queries, mode, &mut |answered| {
            if let Some(callback) = &self.options.progress {
                callback(Progress { answered: before + answered, planned });
            }
            !self.options.cancel.as_ref().is_some_and(CancelToken::is_cancelled)
        })
    }

    /// Asks the plan's pixels and those of the alignment.
    fn ask_all(&self) -> Result<(Vec<PixelReading>, Residual)> {
        let (width, height) = (self.sparse.width(), self.sparse.height());
        let (first, stride, budget) = match self.options.plan {
            QueryPlan::Every => (lattice(width, height, 1), 1, 0),
            QueryPlan::Stride(n) => (lattice(width, height, n), n, 0),
            QueryPlan::Budget(n) => {
                let n = n.min(width * height);
                let stride = stride_within(width, height, n.div_ceil(2));
                let first = lattice(width, height, stride);
                let rest = n.saturating_sub(first.len());
                (first, stride, rest)
            }
        };
        let coarse = self.wanted(first.clone());
        let anchors = match self.options.align && coarse.len() + budget > 0 {
            true => choose_evenly(self.sparse, ALIGN_POINTS, 0),
            false => Vec::new(),
        };
        let planned = coarse.len() + budget + anchors.len();
        let mut pixels = coarse;
        let mut readings = self.ask(&pixels, true, 0, planned)?;
        if budget > 0 {
            let more = self.refinement(&first, stride, &pixels, &readings, budget);
            let planned = pixels.len() + more.len() + anchors.len();
            readings.extend(self.ask(&more, true, pixels.len(), planned)?);
            pixels.extend(more);
        }
        let anchor_pixels: Vec<(usize, usize)> = anchors.iter().map(|a| (a.0, a.1)).collect();
        // An answer that was told its measurement would only repeat it.
        let said = self.ask(&anchor_pixels, false, pixels.len(), pixels.len() + anchors.len())?;
        let mut residual = Residual::default();
        for ((x, y, measured), reading) in anchors.into_iter().zip(said) {
            if reading.value.is_finite() {
                residual.points.push((x as f32, y as f32));
                residual.values.push(measured - reading.value);
            }
        }
        Ok((pixels.into_iter().zip(readings).collect(), residual))
    }

    /// Where the rest of a budget goes.
    fn refinement(
        &self,
        first: &[(usize, usize)],
        stride: usize,
        asked: &[(usize, usize)],
        readings: &[Reading],
        budget: usize,
    ) -> Vec<(usize, usize)> {
        let mut next = asked.iter().zip(readings).peekable();
        let answers: Vec<Asked> = first
            .iter()
            .map(|p| match next.next_if(|(q, _)| *q == p) {
                Some((_, r)) => Asked { depth: r.value, expected_error: r.expected_error },
                // A measured pixel that was not asked is sure of its depth.
                None => Asked { depth: self.sparse.get(p.0, p.1).unwrap_or(f32::NAN), expected_error: 0.0 },
            })
            .collect();
        let (width, height) = (self.sparse.width(), self.sparse.height());
        self.wanted(refine_pixels(width, height, stride, &answers, budget))
    }

    /// Aligns the answers, fills the rest, keeps the measurements.
    fn dense(&self, rgb: &RgbImage, answers: Vec<PixelReading>, residual: &Residual) -> Result<DepthMap> {
        let (width, height) = (self.sparse.width(), self.sparse.height());
        let shift = if residual.points.is_empty() {
            None
        } else {
            Some(Interpolator::new(&residual.points, width, height)?.raster(&residual.values))
        };
        let asked: Vec<Answered> = answers
            .into_iter()
            .filter_map(|((x, y), r)| {
                let moved = r.value + shift.as_ref().map_or(0.0, |s| s[y * width + x]);
                // An alignment that would turn the depth around is not trusted.
                let depth = if moved > 0.0 { moved } else { r.value };
                (depth.is_finite() && depth > 0.0).then_some(Answered {
                    x,
                    y,
                    depth,
                    confidence: r.confidence,
                    expected_error: r.expected_error,
                })
            })
            .collect();
        let none = SparseDepth::from_points(width, height, &[])?;
        let kept = if self.options.preserve == Preserve::Keep { self.sparse } else { &none };
        let input = FillInput { width, height, rgb, asked: &asked, sparse: kept };
        let mut filled = self.options.fill.fill(&input)?;
        let mut measured = vec![false; width * height];
        if self.options.preserve == Preserve::Keep {
            for (x, y, depth) in self.sparse.points() {
                let i = y * width + x;
                measured[i] = true;
                filled.depth[i] = depth;
                filled.confidence[i] = 1.0;
                filled.expected_error[i] = 0.0;
            }
        }
        DepthMap::new(width, height, filled.depth, filled.confidence, filled.expected_error, measured)
    }
}
