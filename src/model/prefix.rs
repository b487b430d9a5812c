//! From a frame to what all of its queries share.

use super::encode::pixel_of;
use super::marked::MarkedFrame;
use super::sdim_model::SdimModel;
use super::view::View;
use super::wide_glimpse::at_cells;
use crate::depth::{SparseDepth, interpolate};
use crate::error::Result;
use crate::kernels;
use crate::query::prompt::FrameSpace;
use crate::query::settings::PixelReference;
use crate::vlm::qwen2_5::Interrupt;
use crate::vlm::qwen2_5::cache::KvCache;
use crate::vlm::qwen2_5::decoder::Keep;
use crate::vlm::qwen2_5::preprocess::Pixels;
use candle_core::Tensor;
use image::RgbImage;
use std::borrow::Cow;

/// What all queries of a frame share: its keys and values, read once, and its space.
pub struct Prefix {
    /// Keys and values of the prefix tokens. Where each query marks the image for itself, of those before the image.
    pub cache: KvCache,
    /// Ids of the prefix tokens.
    pub ids: Vec<u32>,
    /// Where pixels lie, and what numbers mean.
    pub space: FrameSpace,
    /// What tokens at pixels see of the frame.
    pub view: View<'static>,
    /// Linear interpolation of the measurements at each pixel of the frame, metres, where the checkpoint's wide crops need it.
    interpolated: Option<Vec<f32>>,
    /// The frame that each query marks for itself, for [`PixelReference::Marker`].
    pub marked: Option<MarkedFrame>,
}

impl Prefix {
    /// Linear interpolation of the frame's measurements, metres at each pixel: what was kept of it, or made anew. `sparse` is what the prefix was read
    /// with.
    ///
    /// # Errors
    /// [`crate::Error::NoMeasurement`] for a map without measurements.
    pub fn hints(&self, sparse: &SparseDepth) -> Result<Cow<'_, [f32]>> {
        Ok(match &self.interpolated {
            Some(known) => Cow::Borrowed(known.as_slice()),
            None => Cow::Owned(interpolate::linear(sparse)?),
        })
    }
}

/// A frame as its queries need it.
pub enum Encoded {
    /// Image tokens that are the same for all queries.
    Once(Tensor),
    /// A frame that is encoded for each query, with its mark.
    PerQuery(Box<MarkedFrame>),
}

impl SdimModel {
    /// Encodes a frame as the checkpoint's pixel reference needs it; `pixels` and `scattered` are what
    /// [`SdimModel::preprocess`] gave for `rgb`.
    ///
    /// # Errors
    /// [`crate::Error::Config`] if the frame is too small for the checkpoint's mark; [`crate::Error::Tensors`] on mismatched shapes;
    /// [`crate::Error::Cancelled`] when interrupted.
    pub fn encode_frame(
        &self,
        rgb: &RgbImage,
        pixels: &Pixels,
        scattered: &Tensor,
        interrupt: Interrupt,
    ) -> Result<Encoded> {
        match self.prompts.settings().pixel_reference {
            PixelReference::Marker(marker) => {
                let frame = MarkedFrame::new(self, marker, rgb, pixels, scattered)?;
                Ok(Encoded::PerQuery(Box::new(frame)))
            }
            _ => {
                let encode = || self.encode_unless(pixels, scattered, interrupt);
                Ok(Encoded::Once(kernels::in_pool(&self.device, encode)?))
            }
        }
    }

    /// From a frame to what its queries share, in one go.
    ///
    /// # Errors
    /// As [`SdimModel::preprocess`] and [`SdimModel::encode_frame`].
    pub fn prefill_frame(&self, rgb: &RgbImage, sparse: &SparseDepth) -> Result<Prefix> {
        let (pixels, scattered) = self.preprocess(rgb, sparse)?;
        let encoded = self.encode_frame(rgb, &pixels, &scattered, Interrupt::NEVER)?;
        self.prefill_encoded(&pixels, encoded, sparse, Interrupt::NEVER)
    }

    /// Reads what all queries of an encoded frame share.
    ///
    /// # Errors
    /// [`crate::Error::Tensors`] on mismatched shapes; [`crate::Error::Cancelled`] when interrupted.
    pub fn prefill_encoded(
        &self,
        pixels: &Pixels,
        encoded: Encoded,
        sparse: &SparseDepth,
        interrupt: Interrupt,
    ) -> Result<Prefix> {
        let frame = match encoded {
            Encoded::Once(tokens) => {
                let read = || self.prefill_unless(pixels, &tokens, sparse, interrupt);
                return kernels::in_pool(&self.device, read);
            }
            Encoded::PerQuery(frame) => *frame,
        };
        let resized = (pixels.resized.width() as usize, pixels.resized.height() as usize);
        let (tokens, space) = self.prompts.prefix(sparse, pixels.grid, resized, &self.vlm.config, 0)?;
        let image = tokens.ids.iter().position(|&id| id == self.vlm.config.ids.image);
        let (shared, opening) = tokens.split(image.unwrap_or(0));
        let mut cache = self.vlm.decoder.cache(1);
        if !shared.is_empty() {
            let embedded = self.vlm.decoder.embed(&shared.ids)?;
            self.vlm.prefill_unless(&embedded, &shared.positions, &mut cache, Keep::Nothing, interrupt)?;
        }
        let (view, interpolated) = self.view(pixels, sparse, space.unit)?;
        let marked = Some(frame.with_opening(opening));
        Ok(Prefix { cache, ids: shared.ids, space, view, interpolated, marked })
    }

    /// Reads the shared prefix of a frame into a cache, for pixel references that leave the image as it is.
    ///
    /// # Errors
    /// [`crate::Error::Tensors`] on mismatched shapes.
    pub fn prefill_prefix(
        &self,
        pixels: &Pixels,
        image_tokens: &Tensor,
        sparse: &SparseDepth,
    ) -> Result<Prefix> {
        self.prefill_unless(pixels, image_tokens, sparse, Interrupt::NEVER)
    }

    fn prefill_unless(
        &self,
        pixels: &Pixels,
        image_tokens: &Tensor,
        sparse: &SparseDepth,
        interrupt: Interrupt,
    ) -> Result<Prefix> {
        let resized = (pixels.resized.width() as usize, pixels.resized.height() as usize);
        let (tokens, space) = self.prompts.prefix(sparse, pixels.grid, resized, &self.vlm.config, 0)?;
        let (view, interpolated) = self.view(pixels, sparse, space.unit)?;
        let embedded = self.vlm.embed_prompt(&tokens.ids, image_tokens)?;
        let embedded = self.add_glimpses(embedded, &[(&view, &tokens.glimpses)])?;
        let mut cache = self.vlm.decoder.cache(1);
        self.vlm.prefill_unless(&embedded, &tokens.positions, &mut cache, Keep::Nothing, interrupt)?;
        Ok(Prefix { cache, ids: tokens.ids, space, view, interpolated, marked: None })
    }

    /// What tokens at pixels see of a frame, and the interpolation of its measurements if that is a part of it.
    fn view(
        &self,
        pixels: &Pixels,
        sparse: &SparseDepth,
        unit: f32,
    ) -> Result<(View<'static>, Option<Vec<f32>>)> {
        let image = Cow::Owned(pixels.resized.clone());
        if self.wide_glimpse.is_none() {
            return Ok((View::new(self, image, &[], [])?, None));
        }
        let (frame, resized) = ((sparse.width(), sparse.height()), image.dimensions());
        let resized = (resized.0 as usize, resized.1 as usize);
        let dense = interpolate::linear(sparse)?;
        let cells = at_cells(&dense, frame, resized, unit);
        let measured = sparse.points().map(|(x, y, _)| pixel_of((x, y), frame, resized));
        Ok((View::new(self, image, &cells, measured)?, Some(dense)))
    }
}
