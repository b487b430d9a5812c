//! What tokens at pixels see of a frame.

use super::sdim_model::SdimModel;
use super::wide_glimpse::WideView;
use crate::error::{Error, Result};
use crate::query::prompt::Glimpse;
use crate::vlm::qwen2_5::crops::Picture;
use crate::vlm::qwen2_5::preprocess::PreprocessorConfig;
use candle_core::Tensor;
use image::RgbImage;
use std::borrow::Cow;

/// What tokens at pixels see of a frame: the resized picture, and its wide form where the checkpoint has wide crops.
#[derive(Debug, Clone)]
pub struct View<'a> {
    picture: Picture<'a>,
    wide: Option<WideView>,
}

impl<'a> View<'a> {
    /// The view of a resized frame. A checkpoint with wide crops also needs `interpolated`, what interpolation gives at each cell
    /// ([`super::at_cells`]), and the pixels of the resized frame that are measured, as (column, row).
    ///
    /// # Errors
    /// [`Error::Argument`] if `interpolated` has another number of cells; [`Error::Tensors`] if the device refuses the samples.
    pub fn new(
        model: &SdimModel,
        image: Cow<'a, RgbImage>,
        interpolated: &[f32],
        measured: impl IntoIterator<Item = (usize, usize)>,
    ) -> Result<Self> {
        let wide = match &model.wide_glimpse {
            Some(_) => {
                Some(WideView::new(&model.preprocessor, &image, interpolated, measured, &model.device)?)
            }
            None => None,
        };
        Ok(Self { picture: Picture::new(image, &model.device)?, wide })
    }

    /// The crops around tokens, `[tokens, 3 * side * side]`.
    pub(super) fn crops(&self, config: &PreprocessorConfig, list: &[Glimpse], side: usize) -> Result<Tensor> {
        let places: Vec<(f32, f32)> = list.iter().map(|g| (g.x, g.y)).collect();
        self.picture.crops(config, &places, side)
    }

    /// The wide crops around tokens; see [`WideView::crops`].
    pub(super) fn wide_crops(&self, list: &[Glimpse], side: usize) -> Result<Tensor> {
        match &self.wide {
            Some(wide) => wide.crops(list, side),
            None => Err(Error::argument("view", "one without wide crops", "one of this model's own")),
        }
    }
}
