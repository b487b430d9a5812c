//! What a training frame's sensor measures: patterns of measurements, faulty sensors, and measurements that are wrong.

use super::recipe::BatchConfig;
use crate::depth::{SparseDepth, SparsePattern};
use crate::error::Result;
use crate::scenes::sensor::{CameraModel, DepthSensor};
use crate::scenes::{RgbdFrame, SpinningLidar};
use image::RgbImage;
use rand::Rng;
use rand_chacha::ChaCha8Rng;

/// Measurements of a frame: a pattern and a number of points drawn at random. A share of the frames is seen by a random
/// camera and measured by a random depth sensor, which sees through panes; the frame's depth, of which labels are made, stays
/// clean. With a `picture` that such a camera has taken already, that one is the frame's.
pub(super) fn measure(
    frame: &mut RgbdFrame,
    config: &BatchConfig,
    picture: Option<&RgbImage>,
    rng: &mut ChaCha8Rng,
) -> Result<SparseDepth> {
    let pattern = Pattern::draw(Reach::of(frame.sensed()), config.points, rng);
    if rng.random::<f32>() >= config.sensors {
        if let Some(picture) = picture {
            frame.rgb.clone_from(picture);
        }
        return pattern.sample(frame, frame.sensed(), rng);
    }
    let measured = DepthSensor::draw(rng).measure(&frame.rgb, frame.sensed(), rng)?;
    frame.rgb = match picture {
        Some(picture) => picture.clone(),
        None => CameraModel::draw(rng).photograph(&frame.rgb, rng)?,
    };
    pattern.sample(frame, &measured, rng)
}

/// How far a frame reaches, metres.
#[derive(Clone, Copy)]
struct Reach {
    median: f32,
    far: f32,
}

impl Reach {
    fn of(depth: &[f32]) -> Self {
        let step = (depth.len() / 4096).max(1);
        let mut seen: Vec<f32> = depth.iter().step_by(step).copied().filter(|d| d.is_finite()).collect();
        seen.sort_by(f32::total_cmp);
        let at = |part: usize| seen.get(seen.len() * part / 10).copied().unwrap_or(1.0);
        Self { median: at(5), far: at(9) }
    }

    /// Whether the frame is one of those that spinning LiDARs are used in.
    fn street(&self) -> bool {
        self.far > 18.0
    }
}

/// Rings give as many measurements as they meet, thinned to this many.
const MOST_OF_RINGS: usize = 4096;
/// Measurements around a hole, at most.
const MOST_AROUND: usize = 8000;

/// A pattern with its number of points.
enum Pattern {
    Spread(SparsePattern, usize),
    Rings(SpinningLidar),
}

/// A number between two, its logarithm uniform.
fn log_uniform(low: f32, high: f32, rng: &mut ChaCha8Rng) -> f32 {
    low * (high / low).powf(rng.random::<f32>())
}

impl Pattern {
    /// Shares of the patterns, per cent: a little more than half are uniform, in streets most are rings.
    fn draw(reach: Reach, (fewest, most): (usize, usize), rng: &mut ChaCha8Rng) -> Self {
        let mut points = log_uniform(fewest as f32, most as f32, rng) as usize;
        if rng.random_bool(0.06) {
            // A sensor that sees next to nothing.
            points = log_uniform(20f32.min(fewest as f32), 60f32.min(most as f32), rng) as usize;
        }
        let shares: [u32; 8] =
            if reach.street() { [22, 8, 4, 58, 3, 1, 3, 1] } else { [55, 13, 4, 9, 4, 6, 5, 4] };
        let mut at = rng.random_range(0..shares.iter().sum());
        let kind = shares.iter().position(|&share| {
            let here = at < share;
            at = at.saturating_sub(share);
            here
        });
        let pattern = match kind {
            Some(1) => SparsePattern::Sfm,
            Some(2) => SparsePattern::Lidar { lines: rng.random_range(4..24) },
            Some(3) => match rings(reach, rng) {
                Ok(lidar) => return Self::Rings(lidar),
                Err(_) => SparsePattern::Uniform,
            },
            Some(4) => SparsePattern::Line,
            Some(5) => {
                let side = [8, 16, 24, 32, 48, 64][rng.random_range(0..6)];
                return Self::Spread(SparsePattern::Block { side }, side * side);
            }
            Some(6) => {
                // Some of them are dense maps with a hole.
                let dense = rng.random_bool(0.2);
                let few = log_uniform(300.0, MOST_AROUND as f32, rng) as usize;
                return Self::Spread(SparsePattern::Hole, if dense { usize::MAX } else { few });
            }
            Some(7) => SparsePattern::Grid,
            _ => SparsePattern::Uniform,
        };
        Self::Spread(pattern, points.max(1))
    }

    /// Of depth as it is measured, of the frame's size. A pattern that meets nothing becomes a uniform one.
    fn sample(&self, frame: &RgbdFrame, depth: &[f32], rng: &mut ChaCha8Rng) -> Result<SparseDepth> {
        let (width, height) = (frame.width(), frame.height());
        let (made, points) = match self {
            Self::Spread(pattern, points) => {
                (pattern.sample(&frame.rgb, depth, width, height, *points, rng), *points)
            }
            Self::Rings(lidar) => {
                let scan = lidar.scan(depth, width, height, &frame.intrinsics, rng);
                let scan = scan.and_then(|s| {
                    let n = MOST_OF_RINGS;
                    if s.measured() <= n { Ok(s) } else { uniform(frame, s.as_slice(), n, rng) }
                });
                (scan, MOST_OF_RINGS)
            }
        };
        // Less than a handful says nothing about a frame: a row of the sky, rings above a wall.
        match made {
            Ok(sparse) if sparse.measured() >= points.min(8) => Ok(sparse),
            _ => uniform(frame, depth, points.min(500), rng),
        }
    }
}

fn uniform(frame: &RgbdFrame, depth: &[f32], points: usize, rng: &mut ChaCha8Rng) -> Result<SparseDepth> {
    SparsePattern::Uniform.sample(&frame.rgb, depth, frame.width(), frame.height(), points, rng)
}

/// A spinning LiDAR beside the camera. Small scenes are seen by one as much smaller, so that it stands beside them as well.
fn rings(reach: Reach, rng: &mut ChaCha8Rng) -> Result<SpinningLidar> {
    let count = [16, 16, 32, 64][rng.random_range(0..4)];
    let mut lidar = SpinningLidar::rings(count)?.mounted(rng);
    lidar.step *= [1.0, 2.0, 4.0][rng.random_range(0..3)];
    let scale = (reach.median / 8.0).min(1.0);
    lidar.mount = lidar.mount.map(|m| m * scale);
    lidar.range = lidar.range.map(|r| r * scale);
    if !reach.street() {
        // Held in a hand or on a robot's mast, it looks up and down with the camera.
        lidar.range = [0.0, (20.0 * reach.far).max(1.0)];
        lidar.attitude[1] += 0.5 * (rng.random::<f32>() - 0.5);
    }
    Ok(lidar)
}

/// Depth of a saturated 16-bit pixel in millimetres, metres.
const SATURATED: f32 = 65.535;

/// What bad measurements a frame's measurements are mixed with, one or more kinds of them: a few saturated values, gross
/// errors, and left-overs of next to nothing at the picture's border, as undistorted and resized depth images have them.
pub(super) fn spoil(sparse: &SparseDepth, rng: &mut ChaCha8Rng) -> Result<SparseDepth> {
    let (width, height) = (sparse.width(), sparse.height());
    let mut points: Vec<(usize, usize, f32)> = sparse.points().collect();
    let largest = sparse.max().unwrap_or(1.0);
    let mut kinds = [rng.random_bool(0.65), rng.random_bool(0.3), rng.random_bool(0.25)];
    if kinds == [false; 3] {
        kinds[rng.random_range(0..3)] = true;
    }
    let [gross, saturated, left_over] = kinds;
    if gross && !points.is_empty() {
        let share = log_uniform(0.005, 0.06, rng);
        let count = ((points.len() as f32 * share).round() as usize).max(1);
        for _ in 0..count {
            let at = rng.random_range(0..points.len());
            let factor = rng.random_range(1.3f32..3.0);
            points[at].2 *= if rng.random_bool(0.5) { factor } else { 1.0 / factor };
        }
    }
    if saturated && !points.is_empty() {
        // Scenes are of any size: next to large ones the largest number of a file is none.
        let value = if rng.random_bool(0.5) && largest < 30.0 {
            SATURATED
        } else {
            largest * log_uniform(2.0, 12.0, rng)
        };
        for _ in 0..if rng.random_bool(0.7) { 1 } else { rng.random_range(2..4) } {
            let at = rng.random_range(0..points.len());
            points[at].2 = value.min(SparseDepth::MAX_DEPTH);
        }
    }
    if left_over {
        let side = rng.random_range(0..4);
        for _ in 0..log_uniform(2.0, 0.04 * points.len() as f32 + 3.0, rng) as usize {
            let inwards = rng.random_range(0..3);
            let (x, y) = (rng.random_range(0..width), rng.random_range(0..height));
            let at = match side {
                0 => (x, inwards.min(height - 1)),
                1 => (x, height - 1 - inwards.min(height - 1)),
                2 => (inwards.min(width - 1), y),
                _ => (width - 1 - inwards.min(width - 1), y),
            };
            // Of two measurements at a pixel the nearer counts: this one.
            points.push((at.0, at.1, log_uniform(1e-4, 5e-3, rng)));
        }
    }
    SparseDepth::from_points(width, height, &points)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::depth::Intrinsics;
    use crate::scenes::{procedural, street};
    use rand_chacha::rand_core::SeedableRng;

    #[test]
    fn every_pattern_is_drawn_and_rings_rule_in_streets() {
        let mut uniform = [0, 0];
        let mut rings = [0, 0];
        let mut others = Vec::new();
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        let mut few = 0;
        for (k, far) in [5.0, 60.0].into_iter().enumerate() {
            for _ in 0..2000 {
                match Pattern::draw(Reach { median: 3.0, far }, (40, 1500), &mut rng) {
                    Pattern::Spread(SparsePattern::Uniform, n) => {
                        uniform[k] += 1;
                        few += usize::from(n < 40);
                        assert!((20..=1500).contains(&n));
                    }
                    Pattern::Rings(lidar) => {
                        assert!([16, 32, 64].contains(&lidar.elevations.len()));
                        rings[k] += 1;
                    }
                    Pattern::Spread(other, _) => others.push(std::mem::discriminant(&other)),
                }
            }
        }
        assert!((1000..1200).contains(&uniform[0]) && rings[1] > 1000 && rings[0] > 100 && few > 20);
        others.sort_unstable_by_key(|d| format!("{d:?}"));
        others.dedup();
        assert_eq!(others.len(), 6, "all other patterns");
    }

    #[test]
    fn measurements_come_from_the_frame_whatever_the_pattern() {
        let config = BatchConfig { points: (12, 40), sensors: 0.0, ..Default::default() };
        let frames = [procedural(7, 96, 64).unwrap(), street(3, 96, 64).unwrap()];
        let mut rng = ChaCha8Rng::seed_from_u64(2);
        for frame in &frames {
            for _ in 0..60 {
                let mut seen = frame.clone();
                let sparse = measure(&mut seen, &config, None, &mut rng).unwrap();
                assert!(sparse.measured() >= 8);
                assert!(sparse.points().all(|(x, y, d)| d == frame.depth[y * 96 + x]));
                assert!(seen.depth.iter().zip(&frame.depth).all(|(a, b)| a.to_bits() == b.to_bits()));
            }
        }
        let nothing = RgbdFrame {
            rgb: RgbImage::new(96, 64),
            depth: vec![f32::NAN; 96 * 64],
            intrinsics: Intrinsics::from_fov(96, 64, 1.0),
            glass: None,
        };
        assert!(measure(&mut nothing.clone(), &config, None, &mut rng).is_err());
    }

    #[test]
    fn bad_measurements_are_few_and_of_three_kinds() {
        let wall = vec![2.0; 80 * 60];
        let mut rng = ChaCha8Rng::seed_from_u64(3);
        let (mut saturated, mut near, mut gross) = (0, 0, 0);
        for _ in 0..200 {
            let rgb = RgbImage::new(80, 60);
            let clean = SparsePattern::Uniform.sample(&rgb, &wall, 80, 60, 400, &mut rng).unwrap();
            let bad = spoil(&clean, &mut rng).unwrap();
            let wrong: Vec<_> = bad.points().filter(|p| p.2 != 2.0).collect();
            assert!(!wrong.is_empty() && wrong.len() <= 50, "{}", wrong.len());
            saturated += usize::from(wrong.iter().any(|p| p.2 > 6.0));
            gross += usize::from(wrong.iter().any(|p| (0.6..=6.0).contains(&p.2)));
            for &(x, y, _) in wrong.iter().filter(|p| p.2 < 0.01) {
                assert!(x.min(79 - x).min(y).min(59 - y) < 3);
            }
            near += usize::from(wrong.iter().any(|p| (1e-4..=5.001e-3).contains(&p.2)));
        }
        assert!(saturated > 40 && near > 30 && gross > 100, "{saturated} {near} {gross}");
    }
}
