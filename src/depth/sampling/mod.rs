//! Which pixels of a dense depth map a sensor would have measured.

pub(crate) mod choice;
pub(crate) mod noise;
mod scan;

use std::str::FromStr;

use image::RgbImage;
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::SparseDepth;
use crate::error::{Error, Result};
use choice::{shuffle_first, take_least};
use scan::{Scan, feature_weights};

/// How measurements are spread over the image.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SparsePattern {
    /// Every valid pixel is as likely as every other.
    Uniform,
    /// Slightly tilted rows of a scanner, with gaps. `scenes::SpinningLidar` has the geometry of a real one, for
    /// frames whose intrinsics are known.
    Lidar {
        /// Number of rows, at least 1.
        lines: usize,
    },
    /// Clustered at corners and edges of the picture, as triangulated features are.
    Sfm,
}

impl FromStr for SparsePattern {
    type Err = Error;

    /// `uniform`, `lidar:LINES` or `sfm`.
    fn from_str(text: &str) -> Result<Self> {
        let wrong = || Error::argument("sparse pattern", text, "uniform, lidar:LINES (1 to 4096) or sfm");
        match text {
            "uniform" => Ok(Self::Uniform),
            "sfm" => Ok(Self::Sfm),
            _ => {
                let lines = text.strip_prefix("lidar:").and_then(|n| n.parse().ok()).ok_or_else(wrong)?;
                if (1..=4096).contains(&lines) { Ok(Self::Lidar { lines }) } else { Err(wrong()) }
            }
        }
    }
}

impl SparsePattern {
    /// Chooses `points` distinct valid pixels (all of them when there are fewer) and keeps their depth bit for bit.
    ///
    /// `depth` is row-major `width * height` metres; values that are not finite and positive are never chosen.
    ///
    /// Fails with [`Error::BufferLength`] or [`Error::SizeMismatch`] when sizes disagree, [`Error::Argument`] for zero
    /// points or zero lines, and [`Error::NoMeasurement`] when no pixel is valid.
    pub fn sample(
        &self,
        rgb: &RgbImage,
        depth: &[f32],
        width: usize,
        height: usize,
        points: usize,
        rng: &mut impl Rng,
    ) -> Result<SparseDepth> {
        let size = (rgb.width() as usize, rgb.height() as usize);
        if size != (width, height) {
            return Err(Error::SizeMismatch { rgb: size, depth: (width, height) });
        }
        let mut valid = valid_pixels(depth, width, height, points)?;
        let points = points.min(valid.len());
        match *self {
            Self::Uniform => shuffle_first(&mut valid, points, rng),
            Self::Lidar { lines } => {
                if lines == 0 {
                    return Err(Error::argument("lines", lines, "at least 1"));
                }
                let scan = Scan::new(lines, width, height, rng);
                take_least(&mut valid, points, |i| scan.cost(i, rng));
            }
            Self::Sfm => {
                let weight = feature_weights(rgb, rng);
                // Smallest exponential waiting times: a weighted choice without replacement.
                take_least(&mut valid, points, |i| -rng.random::<f32>().max(1e-30).ln() / weight[i]);
            }
        }
        keep(depth, width, height, &valid[..points])
    }
}

/// `n` distinct valid pixels (all when there are fewer), each set equally likely; the same for the same seed on every
/// platform.
///
/// Fails as [`SparsePattern::sample`] does.
pub fn sample_points(depth: &[f32], width: usize, height: usize, n: usize, seed: u64) -> Result<SparseDepth> {
    let mut valid = valid_pixels(depth, width, height, n)?;
    let n = n.min(valid.len());
    shuffle_first(&mut valid, n, &mut ChaCha8Rng::seed_from_u64(seed));
    keep(depth, width, height, &valid[..n])
}

fn valid_pixels(depth: &[f32], width: usize, height: usize, points: usize) -> Result<Vec<usize>> {
    let expected = width.saturating_mul(height);
    if depth.len() != expected {
        return Err(Error::BufferLength { what: "depth", expected, found: depth.len() });
    }
    if points == 0 {
        return Err(Error::argument("points", points, "at least 1"));
    }
    let valid: Vec<usize> = (0..depth.len()).filter(|&i| depth[i].is_finite() && depth[i] > 0.0).collect();
    if valid.is_empty() { Err(Error::NoMeasurement { width, height }) } else { Ok(valid) }
}

/// A map of the chosen pixels alone.
pub(crate) fn keep(depth: &[f32], width: usize, height: usize, chosen: &[usize]) -> Result<SparseDepth> {
    let mut sparse = vec![f32::NAN; depth.len()];
    for &i in chosen {
        sparse[i] = depth[i];
    }
    SparseDepth::new(width, height, sparse)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scenes::procedural;

    const PATTERNS: [SparsePattern; 4] = [
        SparsePattern::Uniform,
        SparsePattern::Lidar { lines: 16 },
        SparsePattern::Lidar { lines: 64 },
        SparsePattern::Sfm,
    ];

    #[test]
    fn as_many_exact_points_as_asked() {
        let frame = procedural(11, 96, 72).unwrap();
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        for pattern in PATTERNS {
            for n in [1, 40, 500, 3000] {
                let sparse = pattern.sample(&frame.rgb, &frame.depth, 96, 72, n, &mut rng).unwrap();
                assert_eq!(sparse.measured(), n, "{pattern:?}");
                for (x, y, d) in sparse.points() {
                    assert_eq!(d.to_bits(), frame.depth[y * 96 + x].to_bits());
                }
            }
        }
    }

    #[test]
    fn few_valid_pixels_are_all_taken_and_none_is_an_error() {
        let mut rng = ChaCha8Rng::seed_from_u64(2);
        for (w, h) in [(1, 1), (2, 1), (1, 3), (7, 5)] {
            let rgb = RgbImage::new(w as u32, h as u32);
            let mut depth = vec![f32::NAN; w * h];
            for pattern in PATTERNS {
                let none = pattern.sample(&rgb, &depth, w, h, 10, &mut rng);
                assert!(matches!(none, Err(Error::NoMeasurement { .. })));
            }
            depth[w * h - 1] = 1.5;
            for pattern in PATTERNS {
                let one = pattern.sample(&rgb, &depth, w, h, 10, &mut rng).unwrap();
                assert_eq!(one.points().collect::<Vec<_>>(), [(w - 1, h - 1, 1.5)]);
                let zero = pattern.sample(&rgb, &depth, w, h, 0, &mut rng);
                assert!(matches!(zero, Err(Error::Argument { name: "points", .. })));
            }
            assert!(matches!(sample_points(&depth, w, h + 1, 3, 0), Err(Error::BufferLength { .. })));
        }
    }

    #[test]
    fn lidar_points_lie_on_few_rows() {
        let (rgb, depth) = (RgbImage::new(200, 150), vec![2.0; 30_000]);
        let mut rng = ChaCha8Rng::seed_from_u64(3);
        let spread = |pattern: SparsePattern, rng: &mut ChaCha8Rng| {
            let sparse = pattern.sample(&rgb, &depth, 200, 150, 400, rng).unwrap();
            let mut rows: Vec<usize> =
                sparse.points().filter(|p| (90..110).contains(&p.0)).map(|p| p.1).collect();
            rows.sort_unstable();
            rows.dedup();
            rows.len()
        };
        // A tilted row may cross a pixel border or two within these columns.
        assert!(spread(SparsePattern::Lidar { lines: 4 }, &mut rng) <= 12);
        assert!(spread(SparsePattern::Uniform, &mut rng) >= 25);
    }

    #[test]
    fn features_lie_where_the_picture_changes() {
        let rgb = RgbImage::from_fn(100, 80, |x, _| image::Rgb([if x < 50 { 20 } else { 220 }; 3]));
        let mut rng = ChaCha8Rng::seed_from_u64(4);
        let sparse = SparsePattern::Sfm.sample(&rgb, &[1.0; 8000], 100, 80, 100, &mut rng).unwrap();
        let near = sparse.points().filter(|p| (48..=51).contains(&p.0)).count();
        assert!(near > 70, "{near}");
    }

    #[test]
    fn points_are_the_same_on_every_platform() {
        let depth: Vec<f32> = (0..100).map(|i| 1.0 + i as f32).collect();
        let chosen: Vec<f32> = sample_points(&depth, 10, 10, 5, 7).unwrap().points().map(|p| p.2).collect();
        assert_eq!(chosen.len(), 5);
        assert_eq!(
            chosen,
            sample_points(&depth, 10, 10, 5, 7).unwrap().points().map(|p| p.2).collect::<Vec<_>>()
        );
        assert_ne!(
            chosen,
            sample_points(&depth, 10, 10, 5, 8).unwrap().points().map(|p| p.2).collect::<Vec<_>>()
        );
    }

    #[test]
    fn names_are_read() {
        assert_eq!("uniform".parse::<SparsePattern>().unwrap(), SparsePattern::Uniform);
        assert_eq!("lidar:16".parse::<SparsePattern>().unwrap(), SparsePattern::Lidar { lines: 16 });
        assert_eq!("sfm".parse::<SparsePattern>().unwrap(), SparsePattern::Sfm);
        for wrong in ["", "lidar", "lidar:0", "lidar:x", "lidar:-3", "grid", "lidar:99999999999999999999"] {
            assert!(wrong.parse::<SparsePattern>().is_err(), "{wrong}");
        }
    }
}
