//! Rotary positions: the two axes of the vision encoder, and the three of the decoder (M-RoPE).

use super::config::TextConfig;
use crate::error::Result;
use candle_core::{Device, Tensor};

/// Cosines and sines of rotary angles, each `[tokens, head_dim / 2]`, f32.
#[derive(Debug, Clone)]
pub struct RopeTable {
    /// Cosines.
    pub cos: Tensor,
    /// Sines.
    pub sin: Tensor,
}

impl RopeTable {
    fn from_angles(angles: Vec<f32>, tokens: usize, half: usize, device: &Device) -> Result<Self> {
        let cos = angles.iter().map(|a| a.cos()).collect();
        let sin = angles.iter().map(|a| a.sin()).collect();
        Ok(Self {
            cos: Tensor::from_vec(cos, (tokens, half), device)?,
            sin: Tensor::from_vec(sin, (tokens, half), device)?,
        })
    }

    /// Rows of the table in another order.
    ///
    /// # Errors
    /// [`crate::Error::Tensors`] if an index is out of range.
    pub fn select(&self, rows: &Tensor) -> Result<Self> {
        Ok(Self { cos: self.cos.index_select(rows, 0)?, sin: self.sin.index_select(rows, 0)? })
    }
}

/// Angles of the vision encoder: half of the frequencies turn with the patch row, half with the column.
///
/// # Errors
/// [`crate::Error::Tensors`] if the device refuses the table.
pub fn vision_table(positions: &[(usize, usize)], head_dim: usize, device: &Device) -> Result<RopeTable> {
    let quarter = head_dim / 4;
    let inverse: Vec<f32> =
        (0..quarter).map(|k| 1.0 / 10000f32.powf((2 * k) as f32 / (head_dim / 2) as f32)).collect();
    let mut angles = Vec::with_capacity(positions.len() * head_dim / 2);
    for &(row, col) in positions {
        angles.extend(inverse.iter().map(|f| row as f32 * f));
        angles.extend(inverse.iter().map(|f| col as f32 * f));
    }
    RopeTable::from_angles(angles, positions.len(), head_dim / 2, device)
}

/// A token's place for M-RoPE: time, height, width. Fractional where a pixel is meant.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Position {
    /// Temporal axis.
    pub t: f32,
    /// Height axis.
    pub h: f32,
    /// Width axis.
    pub w: f32,
}

impl Position {
    /// A text token's position: the same on the three axes.
    pub fn text(p: f32) -> Self {
        Self { t: p, h: p, w: p }
    }

    fn axis(&self, axis: usize) -> f32 {
        [self.t, self.h, self.w][axis]
    }
}

/// Which frequency turns with which axis.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum RopeLayout {
    /// Sections one after the other, as published for Qwen2.5-VL: width gets the slow frequencies only.
    #[default]
    Contiguous,
    /// Axes in turn, as Qwen3-VL does: each axis gets the full range of frequencies.
    Interleaved,
}

/// M-RoPE of the decoder: inverse frequency and axis of each of the `head_dim / 2` rotations.
#[derive(Debug, Clone)]
pub struct MRope {
    inverse: Vec<f32>,
    axis: Vec<usize>,
}

impl MRope {
    /// From `rope_theta` and `mrope_section`.
    pub fn new(config: &TextConfig, layout: RopeLayout) -> Self {
        let half = config.head_dim() / 2;
        let inverse = (0..half)
            .map(|k| 1.0 / (config.rope_theta as f32).powf((2 * k) as f32 / config.head_dim() as f32))
            .collect();
        let [t, h, w] = config.mrope_section;
        let axis = match layout {
            RopeLayout::Contiguous => {
                [0, 1, 2].into_iter().zip([t, h, w]).flat_map(|(a, n)| std::iter::repeat_n(a, n)).collect()
            }
            RopeLayout::Interleaved => (0..half)
                .map(|i| match i % 3 {
                    1 if i < 3 * h => 1,
                    2 if i < 3 * w => 2,
                    _ => 0,
                })
                .collect(),
        };
        Self { inverse, axis }
    }

    /// The table of these positions.
    ///
    /// # Errors
    /// [`crate::Error::Tensors`] if the device refuses the table.
    pub fn table(&self, positions: &[Position], device: &Device) -> Result<RopeTable> {
        let half = self.inverse.len();
        let mut angles = Vec::with_capacity(positions.len() * half);
        for p in positions {
            angles.extend(self.inverse.iter().zip(&self.axis).map(|(f, &a)| p.axis(a) * f));
        }
        RopeTable::from_angles(angles, positions.len(), half, device)
    }
}
