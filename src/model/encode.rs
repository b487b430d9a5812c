//! From a frame to image tokens (Eq. 1-3).

use super::sdim_model::SdimModel;
use super::view::View;
use crate::depth::SparseDepth;
use crate::error::{Error, Result};
use crate::fusion::Normalise;
use crate::kernels;
use crate::query::prompt::Glimpse;
use crate::vlm::qwen2_5::Interrupt;
use crate::vlm::qwen2_5::crops::joined;
use crate::vlm::qwen2_5::grid::Grid;
use crate::vlm::qwen2_5::preprocess::Pixels;
use candle_core::Tensor;
use image::RgbImage;

impl SdimModel {
    /// Resizes a frame and scatters its measurements: pixels, and `[1, h, w, 1]` of what the fusion block sees of a number, with 0
    /// where nothing was measured.
    ///
    /// # Errors
    /// [`Error::SizeMismatch`], [`Error::ImageSize`].
    pub fn preprocess(&self, rgb: &RgbImage, sparse: &SparseDepth) -> Result<(Pixels, Tensor)> {
        let size = (rgb.width() as usize, rgb.height() as usize);
        let depth = (sparse.width(), sparse.height());
        if size != depth {
            return Err(Error::SizeMismatch { rgb: size, depth });
        }
        let pixels = self.preprocessor.resize(rgb)?;
        let (w, h) = (pixels.resized.width() as usize, pixels.resized.height() as usize);
        let unit = self.prompts.unit(sparse);
        let scattered = scatter(sparse, w, h, |depth| self.prompts.seen(depth, unit));
        Ok((pixels, Tensor::from_vec(scattered, (1, h, w, 1), &self.device)?))
    }

    /// Image tokens of a frame with its measurements (Eq. 1-3).
    ///
    /// # Errors
    /// [`Error::Tensors`] on mismatched shapes.
    pub fn encode(&self, pixels: &Pixels, scattered: &Tensor) -> Result<Tensor> {
        self.encode_batch(&[pixels], scattered, Normalise::Running)
    }

    /// Image tokens of frames of one size, one frame after the other; `scattered` is `[frames, h, w, 1]`.
    ///
    /// # Errors
    /// [`Error::Tensors`] on mismatched shapes.
    pub fn encode_batch(
        &self,
        frames: &[&Pixels],
        scattered: &Tensor,
        normalise: Normalise,
    ) -> Result<Tensor> {
        let grids: Vec<Grid> = frames.iter().map(|p| p.grid).collect();
        self.vlm.vision.encode(&self.embed_patches(frames, scattered, normalise)?, &grids)
    }

    /// As [`SdimModel::encode`], unless it is interrupted.
    pub(crate) fn encode_unless(
        &self,
        pixels: &Pixels,
        scattered: &Tensor,
        interrupt: Interrupt,
    ) -> Result<Tensor> {
        let embedded = self.embed_patches(&[pixels], scattered, Normalise::Running)?;
        self.vlm.vision.encode_unless(&embedded, &[pixels.grid], interrupt)
    }

    /// E of Eq. 3a: embedded patches of frames of one size, `[frames * patches, hidden]`.
    pub(crate) fn embed_patches(
        &self,
        frames: &[&Pixels],
        scattered: &Tensor,
        normalise: Normalise,
    ) -> Result<Tensor> {
        let patches = frames.iter().map(|p| self.preprocessor.patches(p, &self.device));
        let patches = Tensor::cat(&patches.collect::<Result<Vec<_>>>()?, 0)?;
        let mut embedded = self.vlm.vision.patch_embed.forward(&patches)?; // F_e1(I)
        if let Some(injection) = &self.injection {
            let images = frames.iter().map(|p| self.preprocessor.image(p, &self.device));
            let rgb = Tensor::stack(&images.collect::<Result<Vec<_>>>()?, 0)?;
            let o = injection.fusion.forward(&rgb, scattered, normalise)?;
            let tokens = frames.iter().enumerate();
            let tokens = tokens.map(|(i, p)| injection.patch_embed.forward_image(&o.get(i)?, p.grid));
            embedded = kernels::add(&embedded, &Tensor::cat(&tokens.collect::<Result<Vec<_>>>()?, 0)?)?; // Eq. 3a
        }
        Ok(embedded)
    }

    /// Adds the crops around its pixel to each token that stands at one; `groups` pairs frames with the tokens that stand
    /// in them, indices counting over all of `embedded`. Without a glimpse layer nothing changes.
    ///
    /// # Errors
    /// [`Error::Tensors`] if an index is out of range.
    pub fn add_glimpses(&self, embedded: Tensor, groups: &[(&View, &[Glimpse])]) -> Result<Tensor> {
        let (Some(layer), Some(side)) = (&self.glimpse, self.prompts.settings().glimpse) else {
            return Ok(embedded);
        };
        let rows: Vec<u32> =
            groups.iter().flat_map(|(_, list)| list.iter().map(|g| g.token as u32)).collect();
        if rows.is_empty() {
            return Ok(embedded);
        }
        let seen = || groups.iter().filter(|(_, list)| !list.is_empty());
        let crops = seen().map(|(view, list)| view.crops(&self.preprocessor, list, side));
        let crops = joined(crops.collect::<Result<Vec<_>>>()?)?;
        let mut added = layer.forward(&crops)?;
        if let Some(wide) = &self.wide_glimpse {
            let wider = seen().map(|(view, list)| view.wide_crops(list, side)).collect::<Result<Vec<_>>>()?;
            added = kernels::add(&added, &wide.forward(&crops, &joined(wider)?)?)?;
        }
        if rows.len() == embedded.dim(0)? && (0..).zip(&rows).all(|(i, &row)| row == i) {
            return kernels::add(&embedded, &added);
        }
        let count = rows.len();
        Ok(embedded.index_add(&Tensor::from_vec(rows, count, &self.device)?, &added, 0)?)
    }
}

/// Moves measurements to the pixels of the resized frame, each as what is `seen` of its metres, 0 elsewhere. Where several fall on
/// one pixel, the one nearest to its centre stays: nothing is averaged or interpolated.
pub fn scatter(sparse: &SparseDepth, width: usize, height: usize, seen: impl Fn(f32) -> f32) -> Vec<f32> {
    let mut out = vec![0f32; width * height];
    let mut off = vec![f32::MAX; width * height];
    let (from, to) = ((sparse.width(), sparse.height()), (width, height));
    for (x, y, depth) in sparse.points() {
        let (fx, fy) = resized_centre((x, y), from, to);
        let (column, row) = pixel_of((x, y), from, to);
        let at = row * width + column;
        let distance = (fx.fract() - 0.5).powi(2) + (fy.fract() - 0.5).powi(2);
        if distance < off[at] {
            off[at] = distance;
            out[at] = seen(depth);
        }
    }
    out
}

/// Where the centre of a frame's pixel falls in the resized frame, from the upper left corner of its first pixel.
fn resized_centre((x, y): (usize, usize), from: (usize, usize), to: (usize, usize)) -> (f32, f32) {
    let (sx, sy) = (to.0 as f32 / from.0 as f32, to.1 as f32 / from.1 as f32);
    ((x as f32 + 0.5) * sx, (y as f32 + 0.5) * sy)
}

/// The pixel of the resized frame in which the centre of a frame's pixel falls.
pub(super) fn pixel_of(at: (usize, usize), from: (usize, usize), to: (usize, usize)) -> (usize, usize) {
    let (x, y) = resized_centre(at, from, to);
    ((x as usize).min(to.0 - 1), (y as usize).min(to.1 - 1))
}
