//! How a frame is completed.

use crate::depth::DepthMap;
use crate::error::{Error, Result};
use crate::query::{AnswerMode, QueryPlan, Readout};
use crate::refine::{EdgeAwareFill, Fill, MedianFilter};
use std::str::FromStr;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

/// What becomes of measured pixels.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Preserve {
    /// They keep their measurement bit for bit, with confidence 1, but for those that [`Outliers`] leaves out.
    #[default]
    Keep,
    /// They are asked like any other pixel where the plan comes to them, with mask 1 as in the paper where the template has
    /// mask sentences; where it does not, they are filled from answers.
    Ask,
}

/// What becomes of measurements that their neighbours, the picture and the model's own answer contradict
/// ([`crate::Completion::flagged`]): saturated pixels, rays that went astray, left-overs of rectification.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Outliers {
    /// Their pixels are completed as if nothing had been measured there.
    #[default]
    Ignore,
    /// As `Ignore`, but the map keeps their measurement, where it keeps measurements at all ([`Preserve::Keep`]).
    Preserve,
    /// Measurements are not checked: all of them count, and none is flagged. For a sensor that is never wrong.
    Trust,
}

impl FromStr for Outliers {
    type Err = Error;

    fn from_str(text: &str) -> Result<Self> {
        match text {
            "ignore" => Ok(Self::Ignore),
            "preserve" => Ok(Self::Preserve),
            "trust" => Ok(Self::Trust),
            _ => Err(Error::argument("outliers", text, "ignore, preserve or trust")),
        }
    }
}

impl std::fmt::Display for Outliers {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Self::Ignore => "ignore",
            Self::Preserve => "preserve",
            Self::Trust => "trust",
        })
    }
}

/// How far a frame is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Progress {
    /// Pixels answered so far.
    pub answered: usize,
    /// Pixels that will be asked.
    pub planned: usize,
}

/// Stops a [`crate::DepthCompleter::complete`] that runs on another thread.
#[derive(Debug, Clone, Default)]
pub struct CancelToken(Arc<AtomicBool>);

impl CancelToken {
    /// Asks to stop; the call returns [`crate::Error::Cancelled`] after the batch, or the layer of the model, that runs.
    pub fn cancel(&self) {
        self.0.store(true, Ordering::Relaxed);
    }

    /// Whether [`CancelToken::cancel`] was called.
    pub fn is_cancelled(&self) -> bool {
        self.0.load(Ordering::Relaxed)
    }
}

/// A rectangle of pixels.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Region {
    /// First column.
    pub x: usize,
    /// First row.
    pub y: usize,
    /// Columns.
    pub width: usize,
    /// Rows.
    pub height: usize,
}

impl Region {
    /// Whether a pixel lies inside.
    pub fn contains(&self, x: usize, y: usize) -> bool {
        let inside = |at: usize, from: usize, size: usize| at >= from && at - from < size;
        inside(x, self.x, self.width) && inside(y, self.y, self.height)
    }

    /// The pixels of the frame that a plan's order of a lattice has in it.
    pub(super) fn lattice(
        &self,
        order: fn(usize, usize, usize) -> Vec<(usize, usize)>,
        stride: usize,
    ) -> Vec<(usize, usize)> {
        order(self.width, self.height, stride).into_iter().map(|pixel| self.place(pixel)).collect()
    }

    /// The pixel of the frame at this column and row of the region.
    pub(super) fn place(&self, (x, y): (usize, usize)) -> (usize, usize) {
        (x + self.x, y + self.y)
    }

    /// How many pixels it has.
    pub(crate) fn pixels(&self) -> usize {
        self.width * self.height
    }

    /// Fails unless it has pixels and lies in a frame.
    pub(crate) fn check(&self, width: usize, height: usize) -> Result<()> {
        let fits = |from: usize, size: usize, all: usize| size > 0 && from < all && size <= all - from;
        if fits(self.x, self.width, width) && fits(self.y, self.height, height) {
            return Ok(());
        }
        let found = format!("{}x{} at ({}, {})", self.width, self.height, self.x, self.y);
        Err(Error::argument(
            "region",
            found,
            format!("at least one pixel, inside of a frame of {width}x{height}"),
        ))
    }
}

/// A frame that is not done yet.
pub struct Partial<'a> {
    progress: Progress,
    map: &'a dyn Fn() -> Result<DepthMap>,
}

impl<'a> Partial<'a> {
    pub(super) fn new(progress: Progress, map: &'a dyn Fn() -> Result<DepthMap>) -> Self {
        Self { progress, map }
    }

    /// How far it is.
    pub fn progress(&self) -> Progress {
        self.progress
    }

    /// The whole map, as far as it is known by now. It takes the time of a frame's refinement.
    ///
    /// # Errors
    /// As [`crate::DepthCompleter::complete`].
    pub fn map(&self) -> Result<DepthMap> {
        (self.map)()
    }
}

/// Called with what is known of a frame after some thousand answers, under a deadline after each twentieth of the time; not in frames of a
/// stream after the first.
pub type PreviewCallback = Arc<dyn Fn(&Partial) + Send + Sync>;

/// Called after each batch of answers.
pub type ProgressCallback = Arc<dyn Fn(Progress) + Send + Sync>;

/// How to complete a frame.
///
/// ```
/// use sdim::{CompleteOptions, QueryPlan};
/// let options = CompleteOptions::default().with_plan(QueryPlan::Budget(4000)).with_max_memory(64 << 20);
/// assert_eq!(options.plan, QueryPlan::Budget(4000));
/// ```
#[derive(Clone)]
#[non_exhaustive]
pub struct CompleteOptions {
    /// Which pixels to ask.
    pub plan: QueryPlan,
    /// What becomes of measured pixels.
    pub preserve: Preserve,
    /// What becomes of measurements that are not plausible.
    pub outliers: Outliers,
    /// How answers are got; `None` for the checkpoint's own way (`answer_mode` of `sdim.json`).
    pub answer: Option<AnswerMode>,
    /// Which number of an answer's distribution counts, where the checkpoint's numbers are bins: the median for the least mean
    /// absolute error, the mean for the least mean squared one.
    pub readout: Readout,
    /// Whether to ask at measured pixels too and to spread the difference over the map, so that it passes through the
    /// measurements.
    pub align: bool,
    /// Bytes that a batch of queries may take beside the weights and the frame, about; smaller batches are slower and give
    /// the same answers. `None` for batches of 2048 rows.
    pub max_memory: Option<usize>,
    /// How answers are read together with those around them; `None` to take each as it is.
    pub filter: Option<MedianFilter>,
    /// How pixels that were not asked are filled.
    pub fill: Arc<dyn Fill>,
    /// The part of the frame that is completed, `None` for all of it; pixels outside are invalid, measured ones excepted. The model sees the
    /// whole frame and all measurements in any case.
    pub region: Option<Region>,
    /// Pixels that are not measured and would be farther than this, metres, are invalid instead: a sky has no depth.
    pub far_limit: Option<f32>,
    /// Shown the map so far. Pixels are then asked in an order in which those of any moment are spread over the frame.
    pub preview: Option<PreviewCallback>,
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
            readout: Readout::default(),
            align: true,
            max_memory: None,
            filter: Some(MedianFilter::default()),
            fill: Arc::new(EdgeAwareFill::default()),
            region: None,
            far_limit: None,
            preview: None,
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
            .field("readout", &self.readout)
            .field("align", &self.align)
            .field("max_memory", &self.max_memory)
            .field("filter", &self.filter)
            .field("region", &self.region)
            .field("far_limit", &self.far_limit)
            .finish_non_exhaustive()
    }
}

impl CompleteOptions {
    /// With this plan of pixels to ask.
    pub fn with_plan(mut self, plan: QueryPlan) -> Self {
        self.plan = plan;
        self
    }

    /// With measured pixels kept or asked.
    pub fn with_preserve(mut self, preserve: Preserve) -> Self {
        self.preserve = preserve;
        self
    }

    /// With measurements that are not plausible left out, kept in the map or trusted.
    pub fn with_outliers(mut self, outliers: Outliers) -> Self {
        self.outliers = outliers;
        self
    }

    /// With the median or the mean of an answer's distribution.
    pub fn with_readout(mut self, readout: Readout) -> Self {
        self.readout = readout;
        self
    }

    /// With answers got this way.
    pub fn with_answer(mut self, answer: AnswerMode) -> Self {
        self.answer = Some(answer);
        self
    }

    /// With or without the alignment to the measurements.
    pub fn with_align(mut self, align: bool) -> Self {
        self.align = align;
        self
    }

    /// With batches of queries that take about this many bytes.
    pub fn with_max_memory(mut self, bytes: usize) -> Self {
        self.max_memory = Some(bytes);
        self
    }

    /// With answers read together with those around them, or (`None`) each as it is.
    pub fn with_filter(mut self, filter: Option<MedianFilter>) -> Self {
        self.filter = filter;
        self
    }

    /// With another way to fill what was not asked.
    pub fn with_fill(mut self, fill: impl Fill + 'static) -> Self {
        self.fill = Arc::new(fill);
        self
    }

    /// With a part of the frame.
    pub fn with_region(mut self, region: Region) -> Self {
        self.region = Some(region);
        self
    }

    /// With pixels beyond so many metres invalid.
    pub fn with_far_limit(mut self, metres: f32) -> Self {
        self.far_limit = Some(metres);
        self
    }

    /// With a function that is shown the map while it grows.
    pub fn with_preview(mut self, preview: impl Fn(&Partial) + Send + Sync + 'static) -> Self {
        self.preview = Some(Arc::new(preview));
        self
    }

    /// With a function that is called after each batch.
    pub fn with_progress(mut self, progress: impl Fn(Progress) + Send + Sync + 'static) -> Self {
        self.progress = Some(Arc::new(progress));
        self
    }

    /// With a token that stops the call.
    pub fn with_cancel(mut self, cancel: CancelToken) -> Self {
        self.cancel = Some(cancel);
        self
    }
}
