//! Which pixels of a dense depth map a sensor would have measured.

pub(crate) mod choice;
pub(crate) mod noise;
mod scan;
mod shapes;

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
    /// One row across the picture, as of a scanner with a single beam; at most one measurement per column.
    Line,
    /// The middles of `side` by `side` zones over the middle of the picture or all of it, as of a small time-of-flight sensor;
    /// at most so many.
    Block {
        /// Zones per row and per column, at least 1.
        side: usize,
    },
    /// Square cells over the whole picture; about as many as asked for, not more.
    Grid,
    /// Uniform but for a large rectangle or ellipse without any measurement.
    Hole,
}

impl FromStr for SparsePattern {
    type Err = Error;

    /// `uniform`, `sfm`, `line`, `grid`, `hole`, `lidar:LINES` or `block:SIDE`.
    fn from_str(text: &str) -> Result<Self> {
        let expected = "uniform, sfm, line, grid, hole, lidar:LINES or block:SIDE (1 to 4096)";
        let wrong = || Error::argument("sparse pattern", text, expected);
        Ok(match text.split_once(':') {
            None => match text {
                "uniform" => Self::Uniform,
                "sfm" => Self::Sfm,
                "line" => Self::Line,
                "grid" => Self::Grid,
                "hole" => Self::Hole,
                _ => return Err(wrong()),
            },
            Some((name, count)) => {
                let count = count.parse().ok().filter(|n| (1..=4096).contains(n)).ok_or_else(wrong)?;
                match name {
                    "lidar" => Self::Lidar { lines: count },
                    "block" => Self::Block { side: count },
                    _ => return Err(wrong()),
                }
            }
        })
    }
}

impl SparsePattern {
    /// Chooses `points` distinct valid pixels (all of them when there are fewer, or as many as the pattern holds) and keeps
    /// their depth bit for bit.
    ///
    /// `depth` is row-major `width * height` metres; values that are not finite and positive are never chosen.
    ///
    /// Fails with [`Error::BufferLength`] or [`Error::SizeMismatch`] when sizes disagree, [`Error::Argument`] for zero
    /// points, lines or zones, and [`Error::NoMeasurement`] when no pixel is valid or the pattern meets none.
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
            Self::Line | Self::Block { .. } | Self::Grid | Self::Hole => {
                valid = self.place(valid, depth, (width, height), points, rng)?;
            }
        }
        keep(depth, width, height, &valid[..points.min(valid.len())])
    }

    /// The pixels of patterns that cover a part of the picture, in random order if there are more than `points`.
    fn place(
        &self,
        valid: Vec<usize>,
        depth: &[f32],
        (width, height): (usize, usize),
        points: usize,
        rng: &mut impl Rng,
    ) -> Result<Vec<usize>> {
        let mut chosen = match *self {
            Self::Block { side: 0 } => return Err(Error::argument("side", 0, "at least 1")),
            Self::Block { side } => shapes::block(width, height, side, rng),
            Self::Line => shapes::line(width, height, points, rng),
            Self::Grid => shapes::grid(width, height, points, rng),
            _ => shapes::outside_of_a_hole(&valid, width, height, rng),
        };
        chosen.retain(|&i| depth.get(i).is_some_and(|d| d.is_finite() && *d > 0.0));
        if chosen.is_empty() {
            return Err(Error::NoMeasurement { width, height });
        }
        if chosen.len() > points {
            shuffle_first(&mut chosen, points, rng);
        }
        Ok(chosen)
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
    fn parts_of_the_picture_are_measured_as_their_devices_do() {
        let (w, h) = (200, 150);
        let (rgb, depth) = (RgbImage::new(200, 150), vec![2.0; 30_000]);
        let mut rng = ChaCha8Rng::seed_from_u64(5);
        let mut drawn = |pattern: SparsePattern, points: usize| -> Vec<(usize, usize)> {
            let sparse = pattern.sample(&rgb, &depth, w, h, points, &mut rng).unwrap();
            assert!(sparse.measured() <= points);
            sparse.points().map(|(x, y, _)| (x, y)).collect()
        };
        let distinct = |of: &mut dyn Iterator<Item = usize>| {
            let mut all: Vec<usize> = of.collect();
            all.sort_unstable();
            all.dedup();
            all.len()
        };
        for _ in 0..20 {
            let line = drawn(SparsePattern::Line, 5000);
            assert!(line.len() == 200 && distinct(&mut line.iter().map(|p| p.0)) == 200);
            assert!(distinct(&mut line.iter().map(|p| p.1)) <= 10);
            let block = drawn(SparsePattern::Block { side: 16 }, 5000);
            assert_eq!(block.len(), 256);
            assert_eq!(distinct(&mut block.iter().map(|p| p.0)), 16);
            let grid = drawn(SparsePattern::Grid, 400);
            assert!((300..=400).contains(&grid.len()), "{}", grid.len());
            assert_eq!(
                distinct(&mut grid.iter().map(|p| p.0)) * distinct(&mut grid.iter().map(|p| p.1)),
                grid.len()
            );
            let around = drawn(SparsePattern::Hole, 3000);
            let cell = |x: usize, y: usize| around.iter().filter(|p| p.0 / 20 == x && p.1 / 15 == y).count();
            let empty = (0..100).filter(|i| cell(i % 10, i / 10) == 0).count();
            assert!(around.len() == 3000 && empty >= 1, "{empty} of 100 cells are empty");
            assert!(
                drawn(SparsePattern::Grid, 1).len() == 1
                    && drawn(SparsePattern::Block { side: 9 }, 5).len() == 5
            );
        }
        // A row of the sky.
        let mut sky = vec![f32::NAN; 30_000];
        sky[29_999] = 1.0;
        let none = SparsePattern::Line.sample(&rgb, &sky, w, h, 10, &mut rng);
        assert!(matches!(none, Err(Error::NoMeasurement { .. })));
        let zero = SparsePattern::Block { side: 0 }.sample(&rgb, &depth, w, h, 10, &mut rng);
        assert!(matches!(zero, Err(Error::Argument { name: "side", .. })));
    }

    #[test]
    fn names_are_read() {
        assert_eq!("block:64".parse::<SparsePattern>().unwrap(), SparsePattern::Block { side: 64 });
        assert_eq!("line".parse::<SparsePattern>().unwrap(), SparsePattern::Line);
        assert_eq!("hole".parse::<SparsePattern>().unwrap(), SparsePattern::Hole);
        assert_eq!("grid".parse::<SparsePattern>().unwrap(), SparsePattern::Grid);
        assert_eq!("uniform".parse::<SparsePattern>().unwrap(), SparsePattern::Uniform);
        assert_eq!("lidar:16".parse::<SparsePattern>().unwrap(), SparsePattern::Lidar { lines: 16 });
        assert_eq!("sfm".parse::<SparsePattern>().unwrap(), SparsePattern::Sfm);
        for wrong in [
            "",
            "lidar",
            "lidar:0",
            "lidar:x",
            "lidar:-3",
            "block",
            "block:0",
            "line:3",
            "grids",
            "lidar:99999999999999999999",
        ] {
            assert!(wrong.parse::<SparsePattern>().is_err(), "{wrong}");
        }
    }
}
