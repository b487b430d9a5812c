//! A camera with a depth sensor beside it, as one user owns them.

use super::RgbdFrame;
use super::sensor::{CameraModel, DepthSensor};
use crate::depth::{SparseDepth, SparsePattern};
use crate::error::Result;
use image::RgbImage;
use rand::Rng;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;

/// A camera and a depth sensor whose faults are the same in every frame: only their noise differs.
#[derive(Debug, Clone, PartialEq)]
pub struct Rig {
    /// What each of its channels is made of: weights of red, green and blue, of either sign (a filter array that sees other
    /// wavelengths, a palette of false colours).
    pub colours: [[f32; 3]; 3],
    /// The camera behind its filters.
    pub camera: CameraModel,
    /// The depth sensor.
    pub sensor: DepthSensor,
    /// Where it measures.
    pub pattern: SparsePattern,
    /// Its measurements of a frame.
    pub points: usize,
}

impl Rig {
    /// The rig of a seed. Its colours are none that training has; camera, noise and pattern are drawn as in training.
    pub fn draw(seed: u64) -> Self {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        // Another stream than any scene's.
        rng.set_stream(2);
        let colours = std::array::from_fn(|_| std::array::from_fn(|_| 2.0 * rng.random::<f32>() - 1.0));
        let camera = CameraModel { jpeg: None, ..CameraModel::draw(&mut rng) };
        let noise = 0.004 + 0.008 * rng.random::<f32>();
        let sensor = DepthSensor { noise, offset: (0, 0), outliers: 0.0, ..DepthSensor::draw(&mut rng) };
        let pattern = match rng.random_range(0..4) {
            0 => SparsePattern::Sfm,
            1 => SparsePattern::Lidar { lines: rng.random_range(8..24) },
            2 => SparsePattern::Grid,
            _ => SparsePattern::Uniform,
        };
        let points = rng.random_range(150..600);
        Self { colours, camera, sensor, pattern, points }
    }

    /// Its picture and its measurements of a frame.
    ///
    /// # Errors
    /// As [`SparsePattern::sample`].
    pub fn take(&self, frame: &RgbdFrame, seed: u64) -> Result<(RgbImage, SparseDepth)> {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        rng.set_stream(3);
        let depth = self.sensor.measure(&frame.rgb, frame.sensed(), &mut rng)?;
        let picture = self.camera.photograph(&self.filtered(&frame.rgb), &mut rng)?;
        let (width, height) = (frame.width(), frame.height());
        let sparse = self.pattern.sample(&frame.rgb, &depth, width, height, self.points, &mut rng)?;
        Ok((picture, sparse))
    }

    /// The picture in its colours: each channel's range is that which its weights can reach.
    fn filtered(&self, rgb: &RgbImage) -> RgbImage {
        let mut out = rgb.clone();
        for pixel in out.pixels_mut() {
            let old = pixel.0.map(f32::from);
            pixel.0 = self.colours.map(|weights| {
                let low: f32 = weights.iter().map(|w| w.min(0.0)).sum();
                let high: f32 = weights.iter().map(|w| w.max(0.0)).sum();
                let sum: f32 = weights.iter().zip(old).map(|(w, v)| w * v / 255.0).sum();
                (255.0 * (sum - low) / (high - low).max(1e-3) + 0.5).clamp(0.0, 255.0) as u8
            });
        }
        out
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scenes::procedural;

    #[test]
    fn a_rig_is_the_same_in_every_frame_but_for_its_noise() {
        let rig = Rig::draw(1);
        assert_eq!(rig, Rig::draw(1));
        assert_ne!(rig, Rig::draw(2));
        let frame = procedural(3, 64, 48).unwrap();
        let (a, b) = (rig.take(&frame, 1).unwrap(), rig.take(&frame, 2).unwrap());
        assert_eq!(a.0, rig.take(&frame, 1).unwrap().0);
        assert!(a.1.as_slice() != b.1.as_slice() && a.0 != frame.rgb);
        assert!(a.1.points().all(|(x, y, d)| (d / frame.depth[y * 64 + x] - 1.0).abs() < 0.2));
    }

    #[test]
    fn colours_fill_their_range_and_may_be_negative() {
        let rig = Rig { colours: [[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.5, -0.5]], ..Rig::draw(1) };
        let of =
            |pixel: [u8; 3]| rig.filtered(&RgbImage::from_pixel(1, 1, image::Rgb(pixel))).get_pixel(0, 0).0;
        assert_eq!(of([0, 255, 0]), [0, 255, 255]);
        assert_eq!(of([255, 0, 255]), [255, 0, 0]);
        assert_eq!(of([100, 100, 100]), [100, 155, 128]);
    }
}
