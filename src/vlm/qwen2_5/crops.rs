//! Crops around places of a frame, cut where the model is.

use super::bilinear::LARGEST;
use super::preprocess::PreprocessorConfig;
use crate::error::{Error, Result};
use candle_core::{DType, Device, Tensor};
use image::RgbImage;
use rayon::prelude::*;
use std::borrow::Cow;

/// Samples of crops that are cut at a time off the CPU, about: a few tensors of so many are held.
const SAMPLES_AT_A_TIME: usize = 1 << 25;

/// A resized frame that crops are cut from. Off the CPU its samples go to the device once, and a crop costs the two numbers of its place.
#[derive(Debug, Clone)]
pub struct Picture<'a> {
    image: Cow<'a, RgbImage>,
    /// `[height * width, 3]`, f32 of 0 to 255, on a device that is not the CPU.
    samples: Option<Tensor>,
}

impl<'a> Picture<'a> {
    /// The frame for a model on this device.
    ///
    /// # Errors
    /// [`Error::Tensors`](crate::Error::Tensors) if the device refuses the samples.
    pub fn new(image: Cow<'a, RgbImage>, device: &Device) -> Result<Self> {
        let samples = if device.is_cpu() { None } else { Some(samples(&image, device)?) };
        Ok(Self { image, samples })
    }

    /// Normalised crops of `side` x `side` pixels around places between pixels, `(column, row)` each: bilinear, the border repeated;
    /// `[places, 3 * side * side]`, f32, a crop as channel, y, x.
    ///
    /// # Errors
    /// [`Error::Argument`] for a side over 64; [`Error::Tensors`] if the device refuses them.
    pub fn crops(&self, config: &PreprocessorConfig, places: &[(f32, f32)], side: usize) -> Result<Tensor> {
        if side > LARGEST {
            return Err(Error::argument("side of a crop", side, format!("at most {LARGEST}")));
        }
        let size = (self.image.width() as usize, self.image.height() as usize);
        if let Some(samples) = &self.samples {
            return in_parts(places, side, 3, |some| cut(samples, size, config, some, side));
        }
        let len = 3 * side * side;
        let mut crops = vec![0f32; places.len() * len];
        crops.par_chunks_mut(len.max(1)).zip(places).for_each(|(crop, &(x, y))| {
            config.crop(&self.image, x, y, side, crop);
        });
        Ok(Tensor::from_vec(crops, (places.len(), len), &Device::Cpu)?)
    }
}

/// Bytes that cutting crops of so many channels off the CPU takes for each place, about.
pub fn bytes_per_crop(side: usize, channels: usize) -> usize {
    // The samples, differences and sums of one axis, and what is made of them.
    5 * samples_of(side, channels) * size_of::<f32>()
}

/// Samples that a crop reads: bilinear values need one more on each axis.
fn samples_of(side: usize, channels: usize) -> usize {
    channels * (side + 1) * (side + 1)
}

/// Crops of all places, of so many at a time that a device holds their samples.
pub(crate) fn in_parts<P>(
    places: &[P],
    side: usize,
    channels: usize,
    cut: impl Fn(&[P]) -> Result<Tensor>,
) -> Result<Tensor> {
    let at_a_time = (SAMPLES_AT_A_TIME / samples_of(side, channels)).max(1);
    joined(places.chunks(at_a_time).map(cut).collect::<Result<Vec<_>>>()?)
}

/// These rows one after the other.
pub(crate) fn joined(mut parts: Vec<Tensor>) -> Result<Tensor> {
    Ok(if parts.len() == 1 { parts.swap_remove(0) } else { Tensor::cat(&parts, 0)? })
}

fn samples(image: &RgbImage, device: &Device) -> Result<Tensor> {
    let pixels = image.width() as usize * image.height() as usize;
    // Bytes go to the device, a quarter of what they are there.
    Ok(Tensor::from_slice(image.as_raw(), (pixels, 3), device)?.to_dtype(DType::F32)?)
}

/// [`PreprocessorConfig::crop`] as operations on tensors, each in its order, so that the values are the same bits.
fn cut(
    samples: &Tensor,
    (width, height): (usize, usize),
    config: &PreprocessorConfig,
    places: &[(f32, f32)],
    side: usize,
) -> Result<Tensor> {
    let values = sampled(samples, (width, height), places, side)?;
    let (scale, shift) = config.scale_and_shift();
    let scaled = values.broadcast_mul(&Tensor::new(&scale, samples.device())?)?;
    let crops = scaled.broadcast_sub(&Tensor::new(&shift, samples.device())?)?;
    Ok(crops.permute((0, 3, 1, 2))?.reshape((places.len(), 3 * side * side))?)
}

/// Bilinear values of `[height * width, channels]` in windows of `side` x `side` around places, the border repeated:
/// `[places, side, side, channels]`.
pub(crate) fn sampled(
    samples: &Tensor,
    (width, height): (usize, usize),
    places: &[(f32, f32)],
    side: usize,
) -> Result<Tensor> {
    let (n, device, channels) = (places.len(), samples.device(), samples.dim(1)?);
    let numbers: Vec<f32> = places.iter().flat_map(|&(x, y)| [x, y]).collect();
    let first = (Tensor::from_vec(numbers, (n, 2), device)? - (side as f64 - 1.0) / 2.0)?;
    let whole = first.floor()?;
    let part = (first - &whole)?;
    let steps = Tensor::arange(0f32, (side + 1) as f32, device)?.reshape((1, side + 1))?;
    let along = |axis: usize, size: usize| -> Result<Tensor> {
        let at = whole.narrow(1, axis, 1)?.broadcast_add(&steps)?.clamp(0f32, (size - 1) as f32)?;
        Ok(at.to_dtype(DType::U32)?)
    };
    let rows = (along(1, height)? * width as f64)?.reshape((n, side + 1, 1))?;
    let index = rows.broadcast_add(&along(0, width)?.reshape((n, 1, side + 1))?)?;
    let read = samples.index_select(&index.flatten_all()?, 0)?.reshape((n, side + 1, side + 1, channels))?;
    let between = |t: &Tensor, dim: usize, axis: usize| -> Result<Tensor> {
        let (before, after) = (t.narrow(dim, 0, side)?, t.narrow(dim, 1, side)?);
        let part = part.narrow(1, axis, 1)?.reshape((n, 1, 1, 1))?;
        Ok((&before + (after - &before)?.broadcast_mul(&part)?)?)
    };
    between(&between(&read, 2, 0)?, 1, 1)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::kernels::testing::test_device;

    fn config() -> PreprocessorConfig {
        let json = serde_json::json!({"min_pixels": 3136, "max_pixels": 12845056});
        PreprocessorConfig::from_json("test", &json).unwrap()
    }

    fn bits(t: &Tensor) -> Vec<u32> {
        t.flatten_all().unwrap().to_vec1::<f32>().unwrap().into_iter().map(f32::to_bits).collect()
    }

    #[test]
    fn crops_cut_by_tensors_are_those_of_the_cpu_bit_for_bit() {
        let image = RgbImage::from_fn(37, 23, |x, y| {
            image::Rgb([(x * y) as u8, (7 * x + y) as u8, (x ^ y) as u8 * 5])
        });
        // Inside, on pixels, at and beyond each border, and beyond all that a crop may reach.
        let mut places =
            vec![(18.25, 11.75), (5.5, 6.5), (0.0, 0.0), (36.9, 22.9), (-3.3, 40.1), (1e6, -1e6)];
        places.extend(
            (0..200).map(|i| ((i * 13 % 41) as f32 * 0.917 - 1.0, (i * 7 % 29) as f32 * 0.833 - 2.0)),
        );
        let device = test_device();
        let there = samples(&image, &device).unwrap();
        for side in [1, 2, 5, 12] {
            let here = Picture::new(Cow::Borrowed(&image), &Device::Cpu).unwrap();
            let wanted = here.crops(&config(), &places, side).unwrap();
            let found = cut(&there, (37, 23), &config(), &places, side).unwrap();
            assert_eq!(found.dims(), [places.len(), 3 * side * side]);
            assert!(bits(&found) == bits(&wanted), "side {side}");
            // As a model on a device has it, in parts.
            let picture = Picture { image: Cow::Borrowed(&image), samples: Some(there.clone()) };
            assert!(bits(&picture.crops(&config(), &places, side).unwrap()) == bits(&wanted), "side {side}");
        }
    }
}
