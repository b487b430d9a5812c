//! Wide crops around pixels: a frame at a quarter of its size, with the interpolated depth and the places of measurements.

use crate::error::{Error, Result};
use crate::query::prompt::Glimpse;
use crate::vlm::checkpoint::weights::Weights;
use crate::vlm::layers::linear::Linear;
use crate::vlm::qwen2_5::bilinear::bilinear;
use crate::vlm::qwen2_5::config::VlmConfig;
use crate::vlm::qwen2_5::crops::{in_parts, sampled};
use crate::vlm::qwen2_5::preprocess::PreprocessorConfig;
use candle_core::{Device, Tensor};
use image::RgbImage;
use rayon::prelude::*;

/// Side of a cell, pixels of the resized frame.
pub const CELL: usize = 4;
/// Channels of a cell: red, green, blue, interpolated depth, measured.
pub(super) const WIDE_CHANNELS: usize = 5;
/// Which of them is the interpolated depth.
const DEPTH: usize = 3;
/// A difference of logarithms is multiplied by this, so that it is as large as the other channels, and limited to this much.
const STEEP: f32 = 4.0;

/// The layers that crops of both widths go through: `[n, (3 + 5) * side * side]` to `[n, width]`.
pub struct WideGlimpse {
    up: Linear,
    down: Linear,
}

impl WideGlimpse {
    /// Reads `sdim.wide_glimpse.up` (with a bias) and `sdim.wide_glimpse.down`.
    ///
    /// # Errors
    /// [`Error::Config`] if the frame's sides are no multiples of a cell's; as [`Linear::new`].
    pub fn new(weights: &Weights, side: usize, inner: usize, config: &VlmConfig) -> Result<Self> {
        let unit = config.vision.patch_size * config.vision.merge_size;
        if !unit.is_multiple_of(CELL) {
            let key = "vision_config.patch_size";
            return Err(Error::config(
                "config.json",
                key,
                unit.to_string(),
                "a multiple of 4 with the merge",
            ));
        }
        let inputs = (3 + WIDE_CHANNELS) * side * side;
        Ok(Self {
            up: Linear::new(weights, "sdim.wide_glimpse.up", inputs, inner, true)?,
            down: Linear::new(weights, "sdim.wide_glimpse.down", inner, config.text.hidden_size, false)?,
        })
    }

    /// From crops and wide crops to what is added to the tokens' embeddings.
    ///
    /// # Errors
    /// [`Error::Tensors`] on other widths.
    pub fn forward(&self, crops: &Tensor, wide: &Tensor) -> Result<Tensor> {
        let inner = self.up.forward(&Tensor::cat(&[crops, wide], 1)?)?;
        self.down.forward(&inner.relu()?)
    }
}

/// A resized frame in cells of [`CELL`] pixels a side.
#[derive(Debug, Clone)]
pub(super) struct WideView {
    /// Columns and rows of cells.
    size: (usize, usize),
    /// `WIDE_CHANNELS` per cell, row-major: the normalised colour's mean, the logarithm of the interpolated number, 1 if anything was measured.
    cells: Vec<f32>,
    /// The same as `[cells, WIDE_CHANNELS]` on a device that is not the CPU.
    there: Option<Tensor>,
}

impl WideView {
    pub(super) fn new(
        config: &PreprocessorConfig,
        image: &RgbImage,
        interpolated: &[f32],
        measured: impl IntoIterator<Item = (usize, usize)>,
        device: &Device,
    ) -> Result<Self> {
        let (columns, rows) = cells_of((image.width() as usize, image.height() as usize));
        if interpolated.len() != columns * rows {
            let expected = format!("{} of {columns} x {rows} cells", columns * rows);
            return Err(Error::argument("interpolated depths", interpolated.len(), expected));
        }
        let mut cells = vec![0f32; columns * rows * WIDE_CHANNELS];
        let (scale, shift) = config.scale_and_shift();
        let (raw, stride) = (image.as_raw(), image.width() as usize * 3);
        let row_of_cells = cells.par_chunks_mut((columns * WIDE_CHANNELS).max(1));
        row_of_cells.zip(interpolated.par_chunks(columns.max(1))).enumerate().for_each(
            |(row, (out, depths))| {
                for (column, (cell, depth)) in out.chunks_mut(WIDE_CHANNELS).zip(depths).enumerate() {
                    for c in 0..3 {
                        let line = |y: usize| {
                            (0..CELL).map(move |x| (row * CELL + y) * stride + (column * CELL + x) * 3 + c)
                        };
                        let sum: u32 = (0..CELL).flat_map(line).map(|i| u32::from(raw[i])).sum();
                        cell[c] = sum as f32 / (CELL * CELL) as f32 * scale[c] - shift[c];
                    }
                    cell[DEPTH] = depth.ln();
                }
            },
        );
        for (x, y) in measured {
            let (column, row) = (x / CELL, y / CELL);
            if column < columns && row < rows {
                cells[(row * columns + column) * WIDE_CHANNELS + WIDE_CHANNELS - 1] = 1.0;
            }
        }
        let there = match device.is_cpu() {
            true => None,
            false => Some(Tensor::from_slice(&cells, (columns * rows, WIDE_CHANNELS), device)?),
        };
        Ok(Self { size: (columns, rows), cells, there })
    }

    /// Crops of `side` x `side` cells around tokens: bilinear, the border repeated, depths as four times the logarithm of their ratio to what
    /// the token states, at most 4 either way; `[tokens, 5 * side * side]`, f32, a crop as channel, y, x.
    pub(super) fn crops(&self, list: &[Glimpse], side: usize) -> Result<Tensor> {
        if let Some(samples) = &self.there {
            return in_parts(list, side, WIDE_CHANNELS, |some| self.cut(samples, some, side));
        }
        let len = WIDE_CHANNELS * side * side;
        let mut crops = vec![0f32; list.len() * len];
        crops.par_chunks_mut(len.max(1)).zip(list).for_each(|(crop, at)| self.crop(at, side, crop));
        Ok(Tensor::from_vec(crops, (list.len(), len), &Device::Cpu)?)
    }

    fn crop(&self, at: &Glimpse, side: usize, out: &mut [f32]) {
        let stated = at.stated.ln();
        bilinear::<WIDE_CHANNELS, f32>(&self.cells, self.size, in_cells(at), side, |dy, row| {
            for c in 0..WIDE_CHANNELS {
                let line = &mut out[(c * side + dy) * side..][..side];
                for (value, &read) in line.iter_mut().zip(row[c..].iter().step_by(WIDE_CHANNELS)) {
                    *value = if c == DEPTH { relative(read, stated) } else { read };
                }
            }
        });
    }

    /// [`WideView::crop`] as operations on tensors, each in its order, so that the values are the same bits.
    fn cut(&self, samples: &Tensor, list: &[Glimpse], side: usize) -> Result<Tensor> {
        let (n, device) = (list.len(), samples.device());
        let places: Vec<(f32, f32)> = list.iter().map(in_cells).collect();
        let values = sampled(samples, self.size, &places, side)?;
        let stated: Vec<f32> = list.iter().map(|g| g.stated.ln()).collect();
        let stated = Tensor::from_vec(stated, (n, 1, 1, 1), device)?;
        let depth = values.narrow(3, DEPTH, 1)?.broadcast_sub(&stated)?;
        let depth = (depth * f64::from(STEEP))?.clamp(-STEEP, STEEP)?;
        let (colour, measured) = (values.narrow(3, 0, DEPTH)?, values.narrow(3, DEPTH + 1, 1)?);
        let crops = Tensor::cat(&[&colour, &depth, &measured], 3)?.permute((0, 3, 1, 2))?;
        Ok(crops.reshape((n, WIDE_CHANNELS * side * side))?)
    }
}

fn relative(depth: f32, stated: f32) -> f32 {
    ((depth - stated) * STEEP).clamp(-STEEP, STEEP)
}

/// A token's place among cells: 0 is the middle of the first one.
fn in_cells(at: &Glimpse) -> (f32, f32) {
    let along = |p: f32| (p + 0.5) / CELL as f32 - 0.5;
    (along(at.x), along(at.y))
}

/// Columns and rows of the cells of a resized frame.
fn cells_of((width, height): (usize, usize)) -> (usize, usize) {
    (width / CELL, height / CELL)
}

/// What a dense map of a frame, metres, has at the middle of each cell of the resized frame, bilinear, in number units; row-major.
pub fn at_cells(dense: &[f32], frame: (usize, usize), resized: (usize, usize), unit: f32) -> Vec<f32> {
    let (columns, rows) = cells_of(resized);
    let (width, height) = frame;
    // The pixels on both sides of a cell's middle, and how far it is from the first of them.
    let around = |cell: usize, size: usize, resized: usize| {
        let middle = (cell * CELL) as f32 + CELL as f32 / 2.0;
        let at = (middle * (size as f32 / resized as f32) - 0.5).clamp(0.0, (size - 1) as f32);
        let first = at.floor() as usize;
        (first, (first + 1).min(size - 1), at - at.floor())
    };
    let across: Vec<_> = (0..columns).map(|i| around(i, width, resized.0)).collect();
    let mut out = vec![0f32; columns * rows];
    for (row, line) in out.chunks_mut(columns.max(1)).enumerate() {
        let (top, bottom, fy) = around(row, height, resized.1);
        for (value, &(left, right, fx)) in line.iter_mut().zip(&across) {
            let along = |y: usize| {
                let (a, b) = (dense[y * width + left], dense[y * width + right]);
                a + (b - a) * fx
            };
            let (u, v) = (along(top), along(bottom));
            *value = (u + (v - u) * fy) / unit;
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::depth::SparseDepth;
    use crate::depth::interpolate;
    use crate::kernels::testing::test_device;

    fn config() -> PreprocessorConfig {
        let json = serde_json::json!({"min_pixels": 3136, "max_pixels": 12845056});
        PreprocessorConfig::from_json("test", &json).unwrap()
    }

    fn frame() -> RgbImage {
        RgbImage::from_fn(48, 32, |x, y| image::Rgb([(x * y) as u8, (7 * x + y) as u8, (x ^ y) as u8 * 5]))
    }

    fn view(depths: &[f32], device: &Device) -> WideView {
        let measured = [(0, 0), (17, 9), (47, 31), (18, 10)];
        WideView::new(&config(), &frame(), depths, measured, device).unwrap()
    }

    fn depths() -> Vec<f32> {
        (0..96).map(|i| 0.2 + (i * 37 % 96) as f32 * 0.05).collect()
    }

    fn bits(t: &Tensor) -> Vec<u32> {
        t.flatten_all().unwrap().to_vec1::<f32>().unwrap().into_iter().map(f32::to_bits).collect()
    }

    fn glimpse(x: f32, y: f32, stated: f32) -> Glimpse {
        Glimpse { token: 0, x, y, stated }
    }

    #[test]
    fn wide_crops_cut_by_tensors_are_those_of_the_cpu_bit_for_bit() {
        let mut list = vec![glimpse(1e6, -1e6, 1.0), glimpse(-3.3, 40.1, 0.07), glimpse(47.0, 31.0, 15.0)];
        list.extend((0..200).map(|i| {
            let at = ((i * 13 % 53) as f32 * 0.917 - 1.0, (i * 7 % 37) as f32 * 0.833 - 2.0);
            glimpse(at.0, at.1, 0.1 + i as f32 * 0.02)
        }));
        let device = test_device();
        for side in [1, 2, 5, 12] {
            let here = view(&depths(), &Device::Cpu);
            let wanted = here.crops(&list, side).unwrap();
            assert_eq!(wanted.dims(), [list.len(), 5 * side * side]);
            let samples = Tensor::from_slice(&here.cells, (96, WIDE_CHANNELS), &device).unwrap();
            assert!(bits(&here.cut(&samples, &list, side).unwrap()) == bits(&wanted), "side {side}");
            let there = WideView { there: Some(samples), ..here };
            assert!(bits(&there.crops(&list, side).unwrap()) == bits(&wanted), "side {side}, as on a device");
        }
    }

    #[test]
    fn a_crop_holds_mean_colours_ratios_of_depths_and_where_measurements_are() {
        // A crop of one cell around the middle of cell (4, 2), which holds two measurements.
        let crop = view(&depths(), &Device::Cpu).crops(&[glimpse(17.5, 9.5, 3.0)], 1).unwrap();
        let crop = crop.flatten_all().unwrap().to_vec1::<f32>().unwrap();
        let mean = |c: usize| {
            let pixels = (8..12).flat_map(|y| (16..20).map(move |x| (x, y)));
            let sum: f32 = pixels.map(|(x, y)| config().normalise(frame().get_pixel(x, y).0[c], c)).sum();
            sum / 16.0
        };
        for (c, value) in crop[..3].iter().enumerate() {
            assert!((value - mean(c)).abs() < 1e-4, "{c}: {value} for {}", mean(c));
        }
        let ratio = depths()[2 * 12 + 4] / 3.0;
        assert!((crop[DEPTH] - 4.0 * ratio.ln()).abs() < 1e-4, "{}", crop[DEPTH]);
        assert_eq!(crop[4], 1.0);
        // Far from what is stated, and where nothing was measured.
        let far = view(&depths(), &Device::Cpu).crops(&[glimpse(25.5, 9.5, 16.0)], 1).unwrap();
        assert_eq!(far.flatten_all().unwrap().to_vec1::<f32>().unwrap()[3..], [-4.0, 0.0]);
    }

    #[test]
    fn a_plane_is_the_same_plane_in_cells_whatever_the_frame_was() {
        // Interpolation of four corners is a plane of columns; the resized frame has 48 x 32 pixels.
        for (width, height) in [(48, 32), (96, 64), (120, 80), (36, 24)] {
            let depth = |x: usize| 1.0 + (x as f32 + 0.5) / width as f32;
            let corners = [(0, 0), (width - 1, 0), (0, height - 1), (width - 1, height - 1)];
            let points = corners.map(|(x, y)| (x, y, depth(x)));
            let sparse = SparseDepth::from_points(width, height, &points).unwrap();
            let dense = interpolate::linear(&sparse).unwrap();
            let cells = at_cells(&dense, (width, height), (48, 32), 2.0);
            assert_eq!(cells.len(), 96);
            for (i, value) in cells.iter().enumerate() {
                let wanted = (1.0 + ((i % 12) as f32 + 0.5) / 12.0) / 2.0;
                assert!((value - wanted).abs() < 1e-5, "{width}x{height}, cell {i}: {value} for {wanted}");
            }
        }
    }

    #[test]
    fn another_number_of_cells_is_refused() {
        let found = WideView::new(&config(), &frame(), &[1.0; 95], [], &Device::Cpu).map(|_| ());
        assert!(matches!(found, Err(Error::Argument { .. })), "{found:?}");
    }
}
