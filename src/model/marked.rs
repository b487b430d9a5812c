//! A frame that is encoded anew for each query, with that query's mark in it.
//!
//! The mark changes few pixels. What of the encoder's work depends on them is done again, all else is taken over, exactly:
//! the fusion block's convolutions and both patch embeddings see a pixel's neighbourhood only, and the encoder's blocks before
//! its first full attention only its window. From there on every token depends on every pixel, and so do the keys
//! and values that the decoder makes of them: the rest of the encoder and the decoder's reading of the image are done per query.

use super::sdim_model::SdimModel;
use crate::error::Result;
use crate::fusion::{Fusion, Normalise};
use crate::kernels;
use crate::query::marker::Marker;
use crate::query::prompt::Tokens;
use crate::vlm::qwen2_5::grid::Grid;
use crate::vlm::qwen2_5::preprocess::Pixels;
use crate::vlm::qwen2_5::vision::{Change, VisionBase};
use candle_core::Tensor;
use image::{RgbImage, imageops};
use rayon::prelude::*;
use std::ops::Range;

/// The frame without a mark, with what is kept of its encoding.
pub struct MarkedFrame {
    marker: Marker,
    frame: RgbImage,
    plain: Pixels,
    /// Measurements, `[1, h, w, 1]`.
    scattered: Tensor,
    base: VisionBase,
    /// Tokens between the shared text and the query: image placeholders and what follows them.
    opening: Tokens,
}

impl MarkedFrame {
    /// Encodes the frame as far as marks leave its parts alone. `plain` and `scattered` are what
    /// [`SdimModel::preprocess`] gave for the frame.
    pub(crate) fn new(
        model: &SdimModel,
        marker: Marker,
        frame: &RgbImage,
        plain: &Pixels,
        scattered: &Tensor,
    ) -> Result<Self> {
        marker.fits("sdim.json", frame.width() as usize, frame.height() as usize)?;
        let embedded = model.embed_patches(&[plain], scattered, Normalise::Running)?;
        Ok(Self {
            marker,
            frame: frame.clone(),
            base: model.vlm.vision.base(embedded, plain.grid)?,
            plain: plain.clone(),
            scattered: scattered.clone(),
            opening: Tokens::default(),
        })
    }

    /// The same with the tokens that stand before each query.
    pub(crate) fn with_opening(self, opening: Tokens) -> Self {
        Self { opening, ..self }
    }

    pub(crate) fn opening(&self) -> &Tokens {
        &self.opening
    }

    pub(crate) fn patches(&self) -> usize {
        self.plain.grid.patches()
    }

    /// Image tokens of the frame marked at each of these pixels, one image after the other: `[pixels * tokens, hidden]`; what
    /// [`SdimModel::encode`] gives for the marked frames.
    ///
    /// # Errors
    /// [`crate::Error::Tensors`] if the model is not the one that the frame was encoded with.
    pub fn encode(&self, model: &SdimModel, pixels: &[(usize, usize)]) -> Result<Tensor> {
        let marked: Vec<RgbImage> = pixels
            .par_iter()
            .map(|&(x, y)| {
                let mut frame = self.frame.clone();
                self.marker.draw(&mut frame, x, y);
                Ok(model.preprocessor.resize(&frame)?.resized)
            })
            .collect::<Result<_>>()?;
        let changes: Vec<Change> = marked.iter().map(|m| self.change(model, m)).collect::<Result<_>>()?;
        model.vlm.vision.encode_changed(&self.base, &changes)
    }

    /// The patches that differ from those of the plain frame, embedded.
    fn change(&self, model: &SdimModel, marked: &RgbImage) -> Result<Change> {
        let Some((cols, rows)) = differing(&self.plain.resized, marked) else {
            return Ok(Change::default());
        };
        let reach = if model.injection.is_some() { Fusion::REACH } else { 0 };
        let side = model.preprocessor.patch_size * model.preprocessor.merge_size;
        let (w, h) = (marked.width() as usize, marked.height() as usize);
        // All patches of the merged tokens that the change reaches.
        let (cols, rows) = (aligned(&grown(&cols, reach, w), side), aligned(&grown(&rows, reach, h), side));
        let pixels = Pixels {
            resized: crop(marked, &cols, &rows),
            grid: Grid {
                height: rows.len() / model.preprocessor.patch_size,
                width: cols.len() / model.preprocessor.patch_size,
            },
        };
        let patches = model.preprocessor.patches(&pixels, &model.device)?;
        let mut embedded = model.vlm.vision.patch_embed.forward(&patches)?;
        if let Some(injection) = &model.injection {
            // The convolutions see beyond the patches; what they miss at the cut of this margin stays within it.
            let (wide, high) = (grown(&cols, reach, w), grown(&rows, reach, h));
            let around = Pixels { resized: crop(marked, &wide, &high), grid: pixels.grid };
            let rgb = model.preprocessor.image(&around, &model.device)?.unsqueeze(0)?;
            let sparse =
                self.scattered.narrow(1, high.start, high.len())?.narrow(2, wide.start, wide.len())?;
            let o = injection.fusion.forward(&rgb, &sparse.contiguous()?, Normalise::Running)?.get(0)?;
            let o = o.narrow(0, rows.start - high.start, rows.len())?;
            let o = o.narrow(1, cols.start - wide.start, cols.len())?.contiguous()?;
            embedded = kernels::add(&embedded, &injection.patch_embed.forward_image(&o, pixels.grid)?)?;
        }
        let unit = model.preprocessor.merge_size.pow(2);
        let per_row = w / side;
        let tokens = (rows.start / side..rows.end / side)
            .flat_map(|y| (cols.start / side..cols.end / side).map(move |x| y * per_row + x));
        let rows = tokens.flat_map(|t| t * unit..(t + 1) * unit).collect();
        Ok(Change { rows, embedded: Some(embedded) })
    }
}

/// Columns and rows of the smallest box that holds all differing pixels of two images of one size.
fn differing(a: &RgbImage, b: &RgbImage) -> Option<(Range<usize>, Range<usize>)> {
    let width = a.width() as usize;
    let (mut left, mut right, mut top, mut bottom) = (width, 0, usize::MAX, 0);
    for (y, (p, q)) in a.as_raw().chunks(3 * width).zip(b.as_raw().chunks(3 * width)).enumerate() {
        if p == q {
            continue;
        }
        let differs = |x: &usize| p[3 * x..3 * x + 3] != q[3 * x..3 * x + 3];
        let first = (0..width).find(differs).unwrap_or(0);
        let last = (0..width).rfind(differs).unwrap_or(0);
        (left, right) = (left.min(first), right.max(last + 1));
        (top, bottom) = (top.min(y), y + 1);
    }
    (top < bottom).then_some((left..right, top..bottom))
}

fn grown(range: &Range<usize>, by: usize, size: usize) -> Range<usize> {
    range.start.saturating_sub(by)..(range.end + by).min(size)
}

/// To multiples of `side`, outwards. Sides of the image are multiples of it.
fn aligned(range: &Range<usize>, side: usize) -> Range<usize> {
    range.start / side * side..range.end.next_multiple_of(side)
}

fn crop(image: &RgbImage, cols: &Range<usize>, rows: &Range<usize>) -> RgbImage {
    let [x, y, w, h] = [cols.start, rows.start, cols.len(), rows.len()].map(|v| v as u32);
    imageops::crop_imm(image, x, y, w, h).to_image()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_box_of_what_differs() {
        let plain = RgbImage::new(20, 10);
        let mut other = plain.clone();
        assert_eq!(differing(&plain, &other), None);
        other.put_pixel(7, 3, image::Rgb([0, 0, 1]));
        assert_eq!(differing(&plain, &other), Some((7..8, 3..4)));
        other.put_pixel(2, 9, image::Rgb([1, 0, 0]));
        assert_eq!(differing(&plain, &other), Some((2..8, 3..10)));
        assert_eq!(aligned(&grown(&(2..8), 4, 20), 8), 0..16);
    }
}
