//! The 3-D convolution that turns patches into tokens, as the matrix product that it is.

use super::config::VisionConfig;
use super::grid::Grid;
use super::weights::Weights;
use crate::error::Result;
use crate::kernels;
use candle_core::Tensor;

/// Patch embedding: `Conv3d` whose stride equals its kernel, without bias (Eq. 3a: F_e1 and F_e2).
pub struct PatchEmbed {
    /// `[hidden, channels * frames * side * side]`
    weight: Tensor,
    frames: usize,
    channels: usize,
    patch: usize,
    merge: usize,
}

impl PatchEmbed {
    /// Reads `{name}.weight` of shape `[hidden, channels, frames, side, side]`.
    ///
    /// # Errors
    /// As [`Weights::get`].
    pub fn new(config: &VisionConfig, weights: &Weights, name: &str) -> Result<Self> {
        let (p, t, c) = (config.patch_size, config.temporal_patch_size, config.in_channels);
        let kernel = weights.get(&format!("{name}.weight"), &[config.hidden_size, c, t, p, p])?;
        Ok(Self {
            weight: kernel.reshape((config.hidden_size, config.patch_len()))?,
            frames: t,
            channels: c,
            patch: p,
            merge: config.merge_size,
        })
    }

    /// `[patches, patch_len]`, the rows of the preprocessor, to `[patches, hidden]`.
    ///
    /// # Errors
    /// [`crate::Error::Tensors`] on another row length.
    pub fn forward(&self, patches: &Tensor) -> Result<Tensor> {
        kernels::linear(patches, &self.weight, None)
    }

    /// One image `[height, width, channels]` (sides a multiple of patch x merge) to `[patches, hidden]`, as if it were
    /// repeated over the frames.
    ///
    /// # Errors
    /// [`crate::Error::Tensors`] on another shape.
    pub fn forward_image(&self, image: &Tensor, grid: Grid) -> Result<Tensor> {
        let (p, m) = (self.patch, self.merge);
        let (rows, cols) = grid.merged(m);
        // [by, iy, y, bx, ix, x, c] -> [by, bx, iy, ix, c, y, x]
        let blocks = image.reshape(&[rows, m, p, cols, m, p, self.channels][..])?;
        let rows_of_patches = blocks
            .permute(vec![0, 3, 1, 4, 6, 2, 5])?
            .contiguous()?
            .reshape((grid.patches(), self.channels * p * p))?;
        kernels::linear(&rows_of_patches, &self.still()?, None)
    }

    /// `[hidden, channels * side * side]`: the frames summed, for an image that is the same in each frame. Summed in each
    /// pass, since a weight that is trained moves under the model.
    fn still(&self) -> Result<Tensor> {
        let (hidden, area) = (self.weight.dim(0)?, self.patch * self.patch);
        let kernel = self.weight.reshape((hidden, self.channels, self.frames, area))?;
        Ok(kernel.sum(2)?.reshape((hidden, self.channels * area))?)
    }
}
