//! From an RGB frame to the rows of the patch embedding, as the published image processor does it.

use super::bilinear::bilinear;
use super::grid::Grid;
use crate::error::{Error, Result};
use crate::image::resize;
use crate::vlm::checkpoint::json::Node;
use candle_core::{Device, Tensor};
use image::RgbImage;
use rayon::prelude::*;
use serde_json::Value;

/// `preprocessor_config.json`.
#[derive(Debug, Clone, PartialEq)]
pub struct PreprocessorConfig {
    /// Fewest pixels of the resized image.
    pub min_pixels: usize,
    /// Most pixels of the resized image.
    pub max_pixels: usize,
    /// Side of a patch, pixels.
    pub patch_size: usize,
    /// Frames per patch.
    pub temporal_patch_size: usize,
    /// Patches per side of a merged token.
    pub merge_size: usize,
    /// Mean of each channel, of values in 0..1.
    pub image_mean: [f32; 3],
    /// Standard deviation of each channel.
    pub image_std: [f32; 3],
}

/// Largest ratio of an image's sides that the published processor takes.
pub const MAX_RATIO: usize = 200;

/// An image as the encoder reads it.
#[derive(Debug, Clone)]
pub struct Pixels {
    /// The resized frame, 8 bit.
    pub resized: RgbImage,
    /// Its patches.
    pub grid: Grid,
}

/// The key that holds the image processor's part in a file that describes several.
pub(crate) const IMAGE_PROCESSOR: &str = "image_processor";

/// Side of a merged token, pixels, at most: even one token of that side has no more pixels than `max_pixels` may say.
const MAX_SIDE: usize = 4096;

/// Refuses a file that asks for other steps than resizing (bicubic), rescaling (to 0..1) and normalising.
fn published_steps(n: &Node, json: &Value) -> Result<()> {
    let check = |key: &str, fits: fn(&Value) -> bool, expected: &str| match json.get(key) {
        None | Some(Value::Null) => Ok(()),
        Some(value) if fits(value) => Ok(()),
        Some(value) => Err(Error::config(n.file, &n.path(key), value.to_string(), expected)),
    };
    for key in ["do_resize", "do_rescale", "do_normalize", "do_convert_rgb"] {
        check(key, |v| v == true, "true")?;
    }
    // Pillow's number of the filter.
    check("resample", |v| v.as_u64() == Some(3), "3 (bicubic)")?;
    let byte = |v: &Value| v.as_f64().is_some_and(|f| (f * 255.0 - 1.0).abs() < 1e-6);
    check("rescale_factor", byte, "1/255")
}

impl PreprocessorConfig {
    /// Reads `preprocessor_config.json`, or the `image_processor` of a `processor_config.json`. As in the reference,
    /// `min_pixels` and `max_pixels` each go before `size.shortest_edge` and `size.longest_edge`; a `size` that is there has
    /// no defaults for its edges.
    ///
    /// # Errors
    /// [`Error::Config`] names the key that is missing, has a wrong value, or asks for other steps than the published
    /// ones.
    pub fn from_json(file: &str, json: &Value) -> Result<Self> {
        let (prefix, json) = match json.get(IMAGE_PROCESSOR) {
            Some(part) => (IMAGE_PROCESSOR, part),
            None => ("", json),
        };
        let n = Node::new(file, prefix, json);
        published_steps(&n, json)?;
        let none = Value::Null;
        let at = n.path("size");
        let size = Node::new(file, &at, json.get("size").unwrap_or(&none));
        let limit = |key: &str, edge: &str, default: usize| match (n.absent(key), n.absent("size")) {
            (false, _) => n.size(key),
            (true, true) => Ok(default),
            (true, false) => size.size(edge),
        };
        let channels = |key: &str, default: [f32; 3], least: f32, expected: &str| -> Result<[f32; 3]> {
            let Some(value) = json.get(key) else { return Ok(default) };
            let parsed: Option<[f32; 3]> = serde_json::from_value(value.clone()).ok();
            parsed
                .filter(|v| v.iter().all(|x| x.is_finite() && *x >= least))
                .ok_or_else(|| Error::config(file, &n.path(key), value.to_string(), expected))
        };
        let (mean, deviation) = ([0.48145466, 0.4578275, 0.40821073], [0.26862954, 0.261_302_6, 0.275_777_1]);
        let config = Self {
            min_pixels: limit("min_pixels", "shortest_edge", 56 * 56)?,
            max_pixels: limit("max_pixels", "longest_edge", 28 * 28 * 1280)?,
            patch_size: n.size_up_to_or("patch_size", 1024, 14)?,
            temporal_patch_size: n.size_up_to_or("temporal_patch_size", 64, 2)?,
            merge_size: n.size_up_to_or("merge_size", 64, 2)?,
            image_mean: channels("image_mean", mean, 0.0, "three numbers of 0 or more")?,
            image_std: channels("image_std", deviation, f32::MIN_POSITIVE, "three positive numbers")?,
        };
        if config.min_pixels > config.max_pixels {
            let found = config.min_pixels.to_string();
            return Err(Error::config(file, &n.path("min_pixels"), found, "at most max_pixels"));
        }
        let side = config.patch_size * config.merge_size;
        if side > MAX_SIDE {
            let expected = format!("at most {MAX_SIDE} pixels for patch_size x merge_size");
            return Err(Error::config(file, &n.path("patch_size"), side.to_string(), expected));
        }
        Ok(config)
    }

    /// Width and height that the processor resizes a frame to: multiples of patch x merge, close to the aspect ratio,
    /// within the limits of pixels. Ties round to even, as Python's `round` does.
    ///
    /// # Errors
    /// [`Error::ImageSize`] on an empty side or an aspect ratio over 200.
    pub fn smart_resize(&self, width: usize, height: usize) -> Result<(usize, usize)> {
        if width == 0 || height == 0 || width.max(height) > MAX_RATIO * width.min(height) {
            let reason = format!("expected non-empty sides and an aspect ratio of at most {MAX_RATIO}");
            return Err(Error::ImageSize { width, height, reason });
        }
        let factor = self.patch_size * self.merge_size;
        let (f, h, w) = (factor as f64, height as f64, width as f64);
        let even = |v: f64| (v / f).round_ties_even() as usize * factor;
        let (hb, wb) = (even(h), even(w));
        if hb * wb > self.max_pixels {
            let beta = (h * w / self.max_pixels as f64).sqrt();
            let down = |v: f64| ((v / beta / f).floor() as usize * factor).max(factor);
            Ok((down(w), down(h)))
        } else if hb * wb < self.min_pixels {
            let beta = (self.min_pixels as f64 / (h * w)).sqrt();
            let up = |v: f64| (v * beta / f).ceil() as usize * factor;
            Ok((up(w), up(h)))
        } else {
            Ok((wb, hb))
        }
    }

    /// Resizes a frame for the encoder.
    ///
    /// # Errors
    /// As [`PreprocessorConfig::smart_resize`].
    pub fn resize(&self, rgb: &RgbImage) -> Result<Pixels> {
        let (width, height) = self.smart_resize(rgb.width() as usize, rgb.height() as usize)?;
        Ok(Pixels {
            resized: resize::bicubic(rgb, width, height),
            grid: Grid { height: height / self.patch_size, width: width / self.patch_size },
        })
    }

    /// Value of an 8-bit sample as the encoder sees it.
    pub fn normalise(&self, value: u8, channel: usize) -> f32 {
        // The reference rescales in f64 and rounds to f32 before it subtracts the mean.
        let unit = (f64::from(value) * (1.0 / 255.0)) as f32;
        (unit - self.image_mean[channel]) / self.image_std[channel]
    }

    /// Rows of the patch embedding, `[patches, 3 * frames * side * side]`, f32: merge blocks row-major, four patches of
    /// a block in a row; inside a row channel, frame (repeated), y, x.
    ///
    /// # Errors
    /// [`Error::Tensors`] if the device refuses the tensor.
    pub fn patches(&self, pixels: &Pixels, device: &Device) -> Result<Tensor> {
        let (p, t) = (self.patch_size, self.temporal_patch_size);
        let len = 3 * t * p * p;
        let table: Vec<[f32; 256]> =
            (0..3).map(|c| std::array::from_fn(|v| self.normalise(v as u8, c))).collect();
        let width = pixels.resized.width() as usize;
        let raw = pixels.resized.as_raw();
        let order = pixels.grid.patch_positions(self.merge_size);
        let mut rows = vec![0f32; order.len() * len];
        rows.par_chunks_mut(len).zip(&order).for_each(|(row, &(py, px))| {
            for (plane, dst) in row.chunks_exact_mut(p * p).enumerate() {
                let channel = plane / t;
                for (i, d) in dst.iter_mut().enumerate() {
                    let (y, x) = (py * p + i / p, px * p + i % p);
                    *d = table[channel][raw[(y * width + x) * 3 + channel] as usize];
                }
            }
        });
        Ok(Tensor::from_vec(rows, (order.len(), len), device)?)
    }

    /// What a value of 0 to 255 between samples is multiplied by, and what is taken from that then, to normalise it; of each channel.
    pub(crate) fn scale_and_shift(&self) -> ([f32; 3], [f32; 3]) {
        let scale = self.image_std.map(|deviation| 1.0 / (255.0 * deviation));
        (scale, std::array::from_fn(|c| self.image_mean[c] / self.image_std[c]))
    }

    /// A normalised crop of `side` x `side` pixels around a place between pixels, bilinear, the border repeated; written as
    /// channel, y, x into `out`, which holds 3 x `side` x `side` values; `side` is at most 64.
    pub(super) fn crop(&self, image: &RgbImage, x: f32, y: f32, side: usize, out: &mut [f32]) {
        let size = (image.width() as usize, image.height() as usize);
        let (scale, shift) = self.scale_and_shift();
        bilinear::<3, u8>(image.as_raw(), size, (x, y), side, |dy, row| {
            for c in 0..3 {
                let line = &mut out[(c * side + dy) * side..][..side];
                for (value, &read) in line.iter_mut().zip(row[c..].iter().step_by(3)) {
                    *value = read * scale[c] - shift[c];
                }
            }
        });
    }

    /// The normalised frame `[height, width, 3]`, f32: what the fusion block convolves.
    ///
    /// # Errors
    /// [`Error::Tensors`] if the device refuses the tensor.
    pub fn image(&self, pixels: &Pixels, device: &Device) -> Result<Tensor> {
        let values: Vec<f32> =
            pixels.resized.as_raw().iter().enumerate().map(|(i, &v)| self.normalise(v, i % 3)).collect();
        let (w, h) = (pixels.resized.width() as usize, pixels.resized.height() as usize);
        Ok(Tensor::from_vec(values, (h, w, 3), device)?)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn published() -> PreprocessorConfig {
        let json = serde_json::json!({"min_pixels": 3136, "max_pixels": 12845056});
        PreprocessorConfig::from_json("test", &json).unwrap()
    }

    #[test]
    fn ties_go_to_even() {
        let c = published();
        for (side, want) in [(70, 56), (126, 112), (238, 224), (518, 504), (1078, 1064)] {
            assert_eq!(c.smart_resize(side, 280).unwrap(), (want, 280), "side {side}");
        }
    }

    #[test]
    fn limits_and_ratio() {
        let mut c = published();
        assert_eq!(c.smart_resize(640, 480).unwrap(), (644, 476));
        assert!(matches!(c.smart_resize(2010, 10), Err(Error::ImageSize { .. })));
        assert!(matches!(c.smart_resize(0, 10), Err(Error::ImageSize { .. })));
        let (w, h) = c.smart_resize(5, 700).unwrap();
        assert!(w >= 28 && w * h >= 3136);
        c.max_pixels = 100 * 28 * 28;
        let (w, h) = c.smart_resize(1920, 1080).unwrap();
        assert!(w * h <= c.max_pixels && w % 28 == 0 && h % 28 == 0);
    }
}
