//! The one function that users call: an RGB frame and sparse depth in, dense depth out.

mod alignment;
mod belief;
mod options;
mod questions;
mod stages;

pub use options::{CancelToken, CompleteOptions, Outliers, Preserve, Progress, ProgressCallback};
pub use stages::StageSeconds;

use crate::depth::outliers::Outlier;
use crate::depth::{DepthMap, SparseDepth};
use crate::error::{Error, Result};
use crate::model::SdimModel;
use crate::vlm::checkpoint::LoadOptions;
use crate::vlm::qwen2_5::preprocess::MAX_RATIO;
use belief::believe;
use image::RgbImage;
use questions::Questions;
use std::path::Path;
use std::sync::Arc;
use std::time::Instant;

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
        Self { model: Arc::new(model) }
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
            self.model.prompts.settings().validate_mode("CompleteOptions", mode)?;
        }
        let mut seconds = StageSeconds::default();
        let _span = tracing::info_span!("complete", width = size.0, height = size.1).entered();
        let believed = believe(&self.model, rgb, sparse, options, &mut seconds)?;
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
