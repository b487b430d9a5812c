//! What a camera and a depth sensor make of a clean frame.
//!
//! Training draws a [`CameraModel`] and a [`DepthSensor`] per frame and keeps the clean depth as the label, so that the model
//! learns what pictures and measurements look like rather than what the renderer makes of them. All strengths are relative to
//! the frame (its median depth, its size), since scenes are between 0.1 m and 100 m deep.

use crate::depth::pixels::median;
use crate::error::{Error, Result};
use image::RgbImage;
use image::codecs::jpeg::{JpegDecoder, JpegEncoder};
use rand::Rng;
use std::io::Cursor;
use std::path::Path;

/// What a colour camera does to a picture. Every strength has a value at which it does nothing.
#[derive(Debug, Clone, PartialEq)]
pub struct CameraModel {
    /// Factors of red, green and blue: exposure and white balance; 1 changes nothing.
    pub gains: [f32; 3],
    /// Exponent of the tone curve; 1 changes nothing.
    pub gamma: f32,
    /// Loss of light in the corners, 0 to 1.
    pub vignette: f32,
    /// Standard deviation of the blur, pixels; 0 for none.
    pub blur: f32,
    /// Standard deviation of the noise at full brightness, 8-bit steps; dark pixels have less.
    pub noise: f32,
    /// Quality of a JPEG that the picture goes through, 1 to 100; `None` for none.
    pub jpeg: Option<u8>,
}

impl CameraModel {
    /// A camera drawn at random; about half of its faults are absent.
    pub fn draw(rng: &mut impl Rng) -> Self {
        let mut uniform = |low: f32, high: f32| low + (high - low) * rng.random::<f32>();
        let exposure = uniform(-0.6, 0.6).exp2();
        let gains = [0, 1, 2].map(|_| exposure * uniform(0.88, 1.12));
        let gamma = uniform(0.8, 1.25);
        // A strength that is 0 in half of the cameras and grows linearly in the others.
        let mut half = |most: f32| (uniform(-most, most)).max(0.0);
        let (vignette, blur, noise) = (half(0.5), half(1.2), half(12.0));
        let jpeg = rng.random_bool(0.5).then(|| rng.random_range(30..95));
        Self { gains, gamma, vignette, blur, noise, jpeg }
    }

    /// The picture as this camera takes it, of the same size.
    ///
    /// # Errors
    /// [`Error::Format`] if the picture cannot go through JPEG (a side above 65,535 pixels).
    pub fn photograph(&self, rgb: &RgbImage, rng: &mut impl Rng) -> Result<RgbImage> {
        let mut image = rgb.clone();
        if self.blur > 0.0 {
            image = image::imageops::blur(&image, self.blur);
        }
        let (width, height) = (image.width() as f32, image.height() as f32);
        let corner = 0.25 * (width * width + height * height);
        for (x, y, pixel) in image.enumerate_pixels_mut() {
            let (dx, dy) = (x as f32 + 0.5 - 0.5 * width, y as f32 + 0.5 - 0.5 * height);
            let light = 1.0 - self.vignette * (dx * dx + dy * dy) / corner;
            for (value, gain) in pixel.0.iter_mut().zip(self.gains) {
                let bright = (f32::from(*value) / 255.0 * gain * light).clamp(0.0, 1.0).powf(self.gamma);
                // Shot noise grows with the root of the light, read noise is always there.
                let sigma = self.noise * (0.1 + 0.9 * bright).sqrt();
                *value = (255.0 * bright + sigma * bell(rng) + 0.5).clamp(0.0, 255.0) as u8;
            }
        }
        match self.jpeg {
            Some(quality) => through_jpeg(&image, quality),
            None => Ok(image),
        }
    }
}

fn through_jpeg(image: &RgbImage, quality: u8) -> Result<RgbImage> {
    let wrong = |e: image::ImageError| {
        Error::format(Path::new("jpeg"), e.to_string(), "a picture that JPEG can hold")
    };
    let mut bytes = Vec::new();
    JpegEncoder::new_with_quality(&mut bytes, quality.clamp(1, 100)).encode_image(image).map_err(wrong)?;
    let decoder = JpegDecoder::new(Cursor::new(bytes)).map_err(wrong)?;
    Ok(image::DynamicImage::from_decoder(decoder).map_err(wrong)?.into_rgb8())
}

/// What a depth sensor does to clean depth. Every strength has a value at which it does nothing.
#[derive(Debug, Clone, PartialEq)]
pub struct DepthSensor {
    /// Standard deviation of the noise at the frame's median depth, relative to the depth; grows in proportion to it.
    pub noise: f32,
    /// Step of the inverse depth, relative to the inverse of the median depth (stereo and structured light); 0 for none.
    pub step: f32,
    /// Columns and rows by which the depth lies beside the picture.
    pub offset: (i32, i32),
    /// Share of the pixels at depth edges without a return.
    pub edge_holes: f32,
    /// Share of the pixels at depth edges that see both sides and report a depth in between.
    pub mixed: f32,
    /// Brightness of the picture, 0 to 1, below which a surface returns nothing.
    pub dark: f32,
    /// Nearest and farthest depth that is reported, relative to the median.
    pub range: (f32, f32),
    /// Share of gross errors: factors of 0.35 to 2.5, at most the frame's largest depth.
    pub outliers: f32,
}

impl Default for DepthSensor {
    /// A sensor without faults.
    fn default() -> Self {
        Self {
            noise: 0.0,
            step: 0.0,
            offset: (0, 0),
            edge_holes: 0.0,
            mixed: 0.0,
            dark: 0.0,
            range: (0.0, f32::INFINITY),
            outliers: 0.0,
        }
    }
}

/// Neighbours whose depths have a larger ratio than this stand at a depth edge.
const EDGE_RATIO: f32 = 1.08;

impl DepthSensor {
    /// A sensor drawn at random; most of its faults are absent in half of the sensors or more.
    pub fn draw(rng: &mut impl Rng) -> Self {
        let mut half = |most: f32| (most * (2.0 * rng.random::<f32>() - 1.0)).max(0.0);
        let (noise, step, edge_holes, mixed, dark) =
            (half(0.02), half(0.01), half(0.8), half(0.4), half(0.12));
        let outliers = if rng.random_bool(0.25) { 0.02 * rng.random::<f32>() } else { 0.0 };
        let reach = if rng.random_bool(0.3) { 0.5 + rng.random::<f32>() } else { 0.0 };
        let mut aside = || if rng.random_bool(0.3) { rng.random_range(-2..=2) } else { 0 };
        Self {
            noise,
            step,
            offset: (aside(), aside()),
            edge_holes,
            mixed,
            dark,
            range: (0.15, if reach > 0.0 { 1.5 + 2.0 * reach } else { f32::INFINITY }),
            outliers,
        }
    }

    /// What this sensor reports of clean depth: row-major metres of the picture's size; NaN where nothing returns.
    ///
    /// # Errors
    /// [`Error::BufferLength`] if `depth` has another size than the picture.
    pub fn measure(&self, rgb: &RgbImage, depth: &[f32], rng: &mut impl Rng) -> Result<Vec<f32>> {
        let (width, height) = (rgb.width() as usize, rgb.height() as usize);
        if depth.len() != width * height {
            return Err(Error::BufferLength { what: "depth", expected: width * height, found: depth.len() });
        }
        let mut seen: Vec<f32> = depth.iter().copied().filter(|d| d.is_finite() && *d > 0.0).collect();
        let Some(median) = median(&mut seen) else { return Ok(vec![f32::NAN; depth.len()]) };
        let largest = seen.iter().copied().fold(median, f32::max);
        let mut out = vec![f32::NAN; depth.len()];
        let edges_count = self.edge_holes > 0.0 || self.mixed > 0.0;
        let bounds = if edges_count { surroundings(depth, width) } else { Vec::new() };
        for y in 0..height {
            for x in 0..width {
                let shifted = |v: usize, by: i32, size: usize| {
                    (v as i64 + i64::from(by)).clamp(0, size as i64 - 1) as usize
                };
                let (sx, sy) = (shifted(x, self.offset.0, width), shifted(y, self.offset.1, height));
                let clean = depth[sy * width + sx];
                if !(clean.is_finite() && clean > 0.0) {
                    continue;
                }
                let (low, high) = bounds.get(sy * width + sx).copied().unwrap_or((clean, clean));
                let at_edge = high > EDGE_RATIO * low;
                if at_edge && rng.random::<f32>() < self.edge_holes {
                    continue;
                }
                if self.dark > 0.0 {
                    let sum: f32 = rgb.get_pixel(sx as u32, sy as u32).0.iter().map(|&v| f32::from(v)).sum();
                    if sum / 765.0 < self.dark {
                        continue;
                    }
                }
                let seen = match at_edge && rng.random::<f32>() < self.mixed {
                    true => low + (high - low) * rng.random::<f32>(),
                    false => clean,
                };
                out[y * width + x] = self.report(seen, median, largest, rng);
            }
        }
        Ok(out)
    }

    /// One reading of a depth, metres; NaN out of range.
    fn report(&self, depth: f32, median: f32, largest: f32, rng: &mut impl Rng) -> f32 {
        let mut value = depth * (1.0 + self.noise * depth / median * bell(rng)).clamp(0.5, 2.0);
        if self.step > 0.0 {
            let steps = (median / value / self.step).round().max(1.0);
            value = median / (steps * self.step);
        }
        if rng.random::<f32>() < self.outliers {
            value *= (0.35f32.ln() + (2.5f32 / 0.35).ln() * rng.random::<f32>()).exp();
            value = value.min(largest);
        }
        let inside = value >= self.range.0 * median && value <= self.range.1 * median;
        if inside { value } else { f32::NAN }
    }
}

/// Smallest and largest valid depth of each pixel and its eight neighbours: of rows of three, then of columns of three.
fn surroundings(depth: &[f32], width: usize) -> Vec<(f32, f32)> {
    let own = |d: f32| if d.is_finite() && d > 0.0 { (d, d) } else { (f32::INFINITY, 0.0) };
    let join = |a: (f32, f32), b: (f32, f32)| (a.0.min(b.0), a.1.max(b.1));
    let mut rows: Vec<(f32, f32)> = Vec::with_capacity(depth.len());
    for row in depth.chunks_exact(width) {
        for (x, &d) in row.iter().enumerate() {
            let before = own(row[x.saturating_sub(1)]);
            rows.push(join(join(own(d), before), own(row[(x + 1).min(width - 1)])));
        }
    }
    (0..rows.len())
        .map(|i| {
            let above = if i >= width { rows[i - width] } else { rows[i] };
            join(join(rows[i], above), rows.get(i + width).copied().unwrap_or(rows[i]))
        })
        .collect()
}

/// About normal, mean 0, variance 1: the sum of four uniform values, which costs no logarithm per pixel.
fn bell(rng: &mut impl Rng) -> f32 {
    let bits: u64 = rng.random();
    let sum: u64 = [0, 16, 32, 48].iter().map(|shift| (bits >> shift) & 0xFFFF).sum();
    (sum as f32 / 65536.0 - 2.0) * 3f32.sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scenes::procedural;
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;

    fn rng(seed: u64) -> ChaCha8Rng {
        ChaCha8Rng::seed_from_u64(seed)
    }

    #[test]
    fn without_faults_nothing_changes() {
        let frame = procedural(5, 64, 48).unwrap();
        let camera =
            CameraModel { gains: [1.0; 3], gamma: 1.0, vignette: 0.0, blur: 0.0, noise: 0.0, jpeg: None };
        assert_eq!(camera.photograph(&frame.rgb, &mut rng(1)).unwrap(), frame.rgb);
        let measured = DepthSensor::default().measure(&frame.rgb, &frame.depth, &mut rng(1)).unwrap();
        for (m, d) in measured.iter().zip(&frame.depth) {
            assert!(m.to_bits() == d.to_bits() || (m.is_nan() && d.is_nan()));
        }
    }

    #[test]
    fn noise_has_the_strength_that_is_asked_for_and_grows_with_depth() {
        let rgb = RgbImage::from_pixel(100, 100, image::Rgb([128; 3]));
        let depth: Vec<f32> = (0..10_000).map(|i| if i < 5_000 { 2.0 } else { 4.0 }).collect();
        let sensor = DepthSensor { noise: 0.01, ..Default::default() };
        let out = sensor.measure(&rgb, &depth, &mut rng(2)).unwrap();
        let spread = |values: &[f32], truth: f32| {
            (values.iter().map(|v| (v / truth - 1.0).powi(2)).sum::<f32>() / values.len() as f32).sqrt()
        };
        // The median of these depths is 4 m.
        assert!((spread(&out[5_000..], 4.0) - 0.01).abs() < 0.001);
        assert!((spread(&out[..5_000], 2.0) - 0.005).abs() < 0.001);
    }

    #[test]
    fn each_fault_is_where_it_belongs() {
        let rgb = RgbImage::from_fn(100, 100, |x, _| image::Rgb([if x < 10 { 5 } else { 200 }; 3]));
        let depth: Vec<f32> = (0..10_000).map(|i| if i % 100 < 50 { 1.0 } else { 3.0 }).collect();
        let all = |sensor: DepthSensor| sensor.measure(&rgb, &depth, &mut rng(3)).unwrap();
        let dark = all(DepthSensor { dark: 0.1, ..Default::default() });
        assert!(dark.iter().enumerate().all(|(i, d)| d.is_nan() == (i % 100 < 10)));
        let holes = all(DepthSensor { edge_holes: 1.0, ..Default::default() });
        assert!(holes.iter().enumerate().all(|(i, d)| d.is_nan() == [49, 50].contains(&(i % 100))));
        let mixed = all(DepthSensor { mixed: 1.0, ..Default::default() });
        assert!((0..10_000).all(|i| (mixed[i] == depth[i]) != [49, 50].contains(&(i % 100))));
        let aside = all(DepthSensor { offset: (2, 0), ..Default::default() });
        assert!((0..10_000).all(|i| aside[i] == if i % 100 < 48 { 1.0 } else { 3.0 }));
        let far = all(DepthSensor { range: (0.0, 0.5), ..Default::default() });
        assert!((0..10_000).all(|i| far[i].is_nan() == (i % 100 >= 50)));
        let gross = all(DepthSensor { outliers: 0.1, ..Default::default() });
        let share = (0..10_000).filter(|&i| gross[i] != depth[i]).count() as f32 / 10_000.0;
        assert!((0.05..0.12).contains(&share) && gross.iter().all(|d| *d <= 3.0), "{share}");
    }

    #[test]
    fn inverse_depth_is_quantised() {
        let rgb = RgbImage::from_pixel(50, 50, image::Rgb([128; 3]));
        let depth: Vec<f32> = (0..2500).map(|i| 1.0 + i as f32 * 1e-3).collect();
        let out =
            DepthSensor { step: 0.01, ..Default::default() }.measure(&rgb, &depth, &mut rng(4)).unwrap();
        let mut levels: Vec<u32> = out.iter().map(|d| d.to_bits()).collect();
        levels.sort_unstable();
        levels.dedup();
        assert!(levels.len() < 180, "{}", levels.len());
        assert!(out.iter().zip(&depth).all(|(o, d)| (o / d - 1.0).abs() < 0.01));
    }

    #[test]
    fn drawn_sensors_leave_most_of_a_frame_and_are_the_same_for_a_seed() {
        let frame = procedural(9, 64, 48).unwrap();
        for seed in 0..40 {
            let run = || {
                let mut rng = rng(seed);
                let camera = CameraModel::draw(&mut rng);
                let sensor = DepthSensor::draw(&mut rng);
                let picture = camera.photograph(&frame.rgb, &mut rng).unwrap();
                (picture, sensor.measure(&frame.rgb, &frame.depth, &mut rng).unwrap())
            };
            let (picture, measured) = run();
            let (again, measured_again) = run();
            assert_eq!(picture, again);
            assert!(measured.iter().zip(&measured_again).all(|(a, b)| a.to_bits() == b.to_bits()));
            assert!(measured.iter().filter(|d| d.is_finite()).count() > 64 * 48 / 4, "{seed}");
        }
        let short = DepthSensor::default().measure(&frame.rgb, &frame.depth[1..], &mut rng(0));
        assert!(matches!(short, Err(Error::BufferLength { .. })));
    }
}
