//! Rotary positions: the two axes of the vision encoder, and the three of the decoder (M-RoPE).

use super::config::TextConfig;
use crate::error::Result;
use candle_core::{Device, Tensor};
use std::sync::OnceLock;

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

    /// The same of angles on a device.
    fn from_tensor(angles: &Tensor) -> Result<Self> {
        Ok(Self { cos: angles.cos()?, sin: angles.sin()? })
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
    /// Off the CPU: what a token's three numbers are multiplied by, `[3, head_dim / 2]`, on the device that asked first.
    there: OnceLock<Tensor>,
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
        Self { inverse, axis, there: OnceLock::new() }
    }

    /// The table of these positions.
    ///
    /// # Errors
    /// [`crate::Error::Tensors`] if the device refuses the table.
    pub fn table(&self, positions: &[Position], device: &Device) -> Result<RopeTable> {
        if !device.is_cpu() {
            return RopeTable::from_tensor(&self.angles(positions, device)?);
        }
        let half = self.inverse.len();
        let mut angles = Vec::with_capacity(positions.len() * half);
        for p in positions {
            angles.extend(self.inverse.iter().zip(&self.axis).map(|(f, &a)| p.axis(a) * f));
        }
        RopeTable::from_angles(angles, positions.len(), half, device)
    }

    /// Angles of these positions, `[tokens, head_dim / 2]`, as a product: each column has one frequency, at its axis. So three numbers of each
    /// token go to the device.
    fn angles(&self, positions: &[Position], device: &Device) -> Result<Tensor> {
        let places: Vec<f32> = positions.iter().flat_map(|p| [p.t, p.h, p.w]).collect();
        let places = Tensor::from_vec(places, (positions.len(), 3), device)?;
        if let Some(frequencies) = self.there.get().filter(|t| t.device().same_device(device)) {
            return Ok(places.matmul(frequencies)?);
        }
        let frequencies = self.frequencies(device)?;
        let out = places.matmul(&frequencies)?;
        // One that another thread has put there meanwhile, or that of another device, stays.
        let _ = self.there.set(frequencies);
        Ok(out)
    }

    fn frequencies(&self, device: &Device) -> Result<Tensor> {
        let half = self.inverse.len();
        let mut frequencies = vec![0f32; 3 * half];
        for (k, (f, &axis)) in self.inverse.iter().zip(&self.axis).enumerate() {
            frequencies[axis * half + k] = *f;
        }
        Ok(Tensor::from_vec(frequencies, (3, half), device)?)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn angles_as_a_product_give_the_same_table() {
        let json =
            serde_json::from_str(include_str!("../../../tests/fixtures/qwen_small/config.json")).unwrap();
        let config = crate::vlm::qwen2_5::config::VlmConfig::from_json("config.json", &json).unwrap().text;
        let positions: Vec<Position> =
            (0..50).map(|i| Position { t: i as f32, h: i as f32 * 1.25, w: 40.0 - i as f32 * 0.5 }).collect();
        for layout in [RopeLayout::Contiguous, RopeLayout::Interleaved] {
            let rope = MRope::new(&config, layout);
            let wanted = rope.table(&positions, &Device::Cpu).unwrap();
            let found = RopeTable::from_tensor(&rope.angles(&positions, &Device::Cpu).unwrap()).unwrap();
            for (a, b) in [(&found.cos, &wanted.cos), (&found.sin, &wanted.sin)] {
                let largest = (a - b).unwrap().abs().unwrap().max_all().unwrap().to_scalar::<f32>().unwrap();
                assert!(largest < 1e-6, "{layout:?}: {largest}");
            }
        }
    }
}
