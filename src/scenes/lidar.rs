//! What a spinning LiDAR beside a camera measures of what the camera sees.

use rand::Rng;

use super::space::{Rot, V3, norm, sub, to_local, turned};
use crate::depth::sampling::keep;
use crate::depth::{Intrinsics, SparseDepth};
use crate::error::{Error, Result};

/// A LiDAR whose lasers turn about an upright axis: each draws a ring of one elevation.
///
/// In a picture a ring is a hyperbola, not a row: at azimuth `a` from the camera's axis it lies at `cy - fy tan(elevation) / cos(a)`.
#[derive(Clone, Debug, PartialEq)]
#[non_exhaustive]
pub struct SpinningLidar {
    /// Elevation of each ring above the LiDAR's horizon, radians.
    pub elevations: Vec<f32>,
    /// Angle between two measurements of a ring, radians.
    pub step: f32,
    /// Where it is as the camera sees it: to the right, down and forward, metres.
    pub mount: [f32; 3],
    /// Heading, pitch (upwards) and roll against the camera, radians.
    pub attitude: [f32; 3],
    /// Nearest and farthest distance that it measures, metres.
    pub range: [f32; 2],
    /// Share of measurements that get lost at half of its range; more of the far ones do, fewer of the near ones.
    pub dropout: f32,
}

/// Azimuths at which a ring is looked for, at most.
const MOST: usize = 1 << 20;

impl SpinningLidar {
    /// A LiDAR of 16, 32 or 64 rings with the angles and range of a widespread one, at the camera's place, without losses.
    ///
    /// Sources: Velodyne's data sheets of the VLP-16 (2 degrees from -15 to 15; 100 m), HDL-32E (1.33 degrees from -30.67 to
    /// 10.67; 100 m) and HDL-64E S2 (a third of a degree from -8.33 to 2, half a degree from -24.33 to -8.83; 120 m), turning
    /// ten times a second.
    ///
    /// # Errors
    /// [`Error::Argument`] for another number.
    pub fn rings(count: usize) -> Result<Self> {
        let degrees: Vec<f32> = match count {
            16 => (0..16).map(|i| -15.0 + 2.0 * i as f32).collect(),
            32 => (0..32).map(|i| -30.67 + 4.0 / 3.0 * i as f32).collect(),
            64 => {
                let low = (0..32).map(|i| -24.33 + 0.5 * i as f32);
                low.chain((0..32).map(|i| -8.33 + i as f32 / 3.0)).collect()
            }
            _ => return Err(Error::argument("rings", count, "16, 32 or 64")),
        };
        let (step, far) = match count {
            16 => (0.2, 100.0),
            32 => (0.16, 100.0),
            _ => (0.17, 120.0),
        };
        Ok(Self {
            elevations: degrees.into_iter().map(f32::to_radians).collect(),
            step: f32::to_radians(step),
            mount: [0.0; 3],
            attitude: [0.0; 3],
            range: [0.9, far],
            dropout: 0.0,
        })
    }

    /// The same mounted on a car's roof near the camera, not quite parallel to it, and losing some measurements.
    pub fn mounted(mut self, rng: &mut impl Rng) -> Self {
        let mut real = |low: f32, high: f32| low + (high - low) * rng.random::<f32>();
        self.mount = [real(-0.3, 0.3), real(-0.5, -0.02), real(-0.6, 0.1)];
        self.attitude = [real(-0.03, 0.03), real(-0.05, 0.05), real(-0.02, 0.02)];
        self.dropout = real(0.02, 0.25);
        self
    }

    /// Keeps the depth, bit for bit, of those pixels that rings meet: of each ring and azimuth the nearest surface.
    ///
    /// `depth` is row-major `width * height` Z-depth in metres of a camera with these intrinsics; values that are not finite and
    /// positive return nothing. What the camera does not see cannot stand in the LiDAR's way here.
    ///
    /// # Errors
    /// [`Error::BufferLength`] when sizes disagree; [`Error::Argument`] for a step, range, place or focal length that is none;
    /// [`Error::NoMeasurement`] when no ring meets anything.
    pub fn scan(
        &self,
        depth: &[f32],
        width: usize,
        height: usize,
        intrinsics: &Intrinsics,
        rng: &mut impl Rng,
    ) -> Result<SparseDepth> {
        let expected = width.saturating_mul(height);
        if depth.len() != expected {
            return Err(Error::BufferLength { what: "depth", expected, found: depth.len() });
        }
        self.check(intrinsics)?;
        let [yaw, pitch, roll] = self.attitude;
        // Right, down and forward of the LiDAR in the camera's axes, whose y points down.
        let [r, u, f] = turned(yaw, pitch, roll);
        let axes: Rot = [[r[0], -r[1], r[2]], [-u[0], u[1], -u[2]], [f[0], -f[1], f[2]]];
        let mut rings = self.elevations.clone();
        rings.sort_by(f32::total_cmp);
        let columns = (std::f32::consts::TAU / self.step).ceil() as usize + 1;
        // Nearest surface and its pixel, for each ring and azimuth.
        let mut best = vec![(f32::INFINITY, usize::MAX); rings.len() * columns];
        for (i, &z) in depth.iter().enumerate().filter(|(_, z)| z.is_finite() && **z > 0.0) {
            let u = ((i % width) as f32 - intrinsics.cx) / intrinsics.fx;
            let v = ((i / width) as f32 - intrinsics.cy) / intrinsics.fy;
            let seen: V3 = [u * z, v * z, z];
            let p = to_local(&axes, sub(seen, self.mount));
            let distance = norm(p);
            if !(self.range[0]..=self.range[1]).contains(&distance) {
                continue;
            }
            // Half the angles that a pixel takes up, which near surfaces show larger to who is nearer to them.
            let (flat, larger) = (1.0 + u * u, norm(seen) / distance);
            let tall = 0.51 * larger * flat.sqrt() / (intrinsics.fy * (flat + v * v));
            let wide = 0.51 * larger / (intrinsics.fx * flat);
            let elevation = (-p[1] / distance).asin();
            let azimuth = p[0].atan2(p[2]) + std::f32::consts::PI;
            let column = (azimuth / self.step).round();
            let ring = nearest(&rings, elevation);
            if (azimuth - column * self.step).abs() > wide || (elevation - rings[ring]).abs() > tall {
                continue;
            }
            let slot = &mut best[ring * columns + (column as usize).min(columns - 1)];
            if distance < slot.0 {
                *slot = (distance, i);
            }
        }
        let mut chosen: Vec<usize> = Vec::new();
        for (distance, i) in best {
            let part = distance / self.range[1];
            if i != usize::MAX && rng.random::<f32>() >= self.dropout * 4.0 * part * part {
                chosen.push(i);
            }
        }
        if chosen.is_empty() {
            return Err(Error::NoMeasurement { width, height });
        }
        keep(depth, width, height, &chosen)
    }

    fn check(&self, k: &Intrinsics) -> Result<()> {
        let wrong = |name, found: String, expected: &str| Err(Error::argument(name, found, expected));
        if !(self.step > 0.0 && std::f32::consts::TAU / self.step < MOST as f32) {
            return wrong("step", self.step.to_string(), "an angle above 0, radians");
        }
        if self.elevations.is_empty()
            || self.elevations.len() > 4096
            || self.elevations.iter().any(|e| !e.is_finite())
        {
            return wrong(
                "elevations",
                format!("{} rings", self.elevations.len()),
                "1 to 4096 finite angles",
            );
        }
        if !(0.0 <= self.range[0] && self.range[0] < self.range[1] && self.range[1].is_finite()) {
            return wrong("range", format!("{:?}", self.range), "a nearest and a farther distance, metres");
        }
        let others = self.mount.iter().chain(&self.attitude).chain([&self.dropout]);
        if others.into_iter().any(|v| !v.is_finite()) {
            return wrong("mount", format!("{:?}", self.mount), "finite numbers");
        }
        if !(k.fx > 0.0
            && k.fy > 0.0
            && k.fx.is_finite()
            && k.fy.is_finite()
            && k.cx.is_finite()
            && k.cy.is_finite())
        {
            return wrong("intrinsics", format!("{k:?}"), "focal lengths above 0");
        }
        Ok(())
    }
}

/// Index of the value nearest to `v` in a sorted list that is not empty.
fn nearest(sorted: &[f32], v: f32) -> usize {
    let after = sorted.partition_point(|&e| e < v).min(sorted.len() - 1);
    let before = after.saturating_sub(1);
    if (sorted[after] - v).abs() < (sorted[before] - v).abs() { after } else { before }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;

    const K: Intrinsics = Intrinsics { fx: 300.0, fy: 310.0, cx: 199.0, cy: 121.0 };

    fn rng() -> ChaCha8Rng {
        ChaCha8Rng::seed_from_u64(1)
    }

    #[test]
    fn rings_are_hyperbolas_at_their_elevations() {
        for count in [16, 32, 64] {
            let lidar = SpinningLidar::rings(count).unwrap();
            let sparse = lidar.scan(&vec![20.0; 400 * 240], 400, 240, &K, &mut rng()).unwrap();
            let mut seen: Vec<usize> = Vec::new();
            for (x, y, d) in sparse.points() {
                assert_eq!(d, 20.0);
                let u = (x as f32 - K.cx) / K.fx;
                let row = |e: f32| K.cy - K.fy * e.tan() * (1.0 + u * u).sqrt();
                let ring = (0..count).min_by(|&a, &b| {
                    let gap = |i: usize| (row(lidar.elevations[i]) - y as f32).abs();
                    gap(a).total_cmp(&gap(b))
                });
                let ring = ring.unwrap();
                assert!((row(lidar.elevations[ring]) - y as f32).abs() < 0.6, "{count}: ({x}, {y})");
                seen.push(ring);
            }
            seen.sort_unstable();
            // Every azimuth or column of every ring that the camera sees to both sides.
            let inside = |e: &&f32| (1.0..238.0).contains(&(K.cy - K.fy * e.tan() * 1.21));
            let (whole, rings) =
                (lidar.elevations.iter().filter(inside).count(), seen.chunk_by(|a, b| a == b));
            let steps = (2.0 * (199.0f32 / K.fx).atan() / lidar.step).min(400.0);
            let full = rings.filter(|r| r.len() as f32 > 0.9 * steps).count();
            assert!(full >= whole.saturating_sub(1) && whole > 8, "{count}: {full} of {whole} whole rings");
        }
        assert!(matches!(SpinningLidar::rings(17), Err(Error::Argument { name: "rings", .. })));
    }

    #[test]
    fn what_stands_before_it_hides_what_the_camera_sees_beside() {
        // A post at 4 m before a wall at 20 m. From 0.5 m to the left the post covers other parts of the wall.
        let depth: Vec<f32> =
            (0..400 * 240).map(|i| if (190..210).contains(&(i % 400)) { 4.0 } else { 20.0 }).collect();
        let mut lidar = SpinningLidar::rings(64).unwrap();
        lidar.mount = [-0.5, 0.0, 0.0];
        let sparse = lidar.scan(&depth, 400, 240, &K, &mut rng()).unwrap();
        let count =
            |columns: std::ops::Range<usize>| sparse.points().filter(|p| columns.contains(&p.0)).count();
        // The wall at azimuths of the post, 0.5 m / 4 m and 0.5 m / 20 m aside: columns 219 to 239 of the camera.
        assert!(count(222..236) * 10 < count(245..259), "{} {}", count(222..236), count(245..259));
        assert!(count(192..206) > 100, "the post itself");
    }

    #[test]
    fn far_and_near_are_not_measured_and_some_get_lost() {
        let depth: Vec<f32> = (0..400 * 240).map(|i| [0.5, 30.0, 150.0, f32::NAN][i % 400 / 100]).collect();
        let lidar = SpinningLidar::rings(64).unwrap();
        let all = lidar.scan(&depth, 400, 240, &K, &mut rng()).unwrap();
        assert!(all.points().all(|p| p.2 == 30.0) && all.measured() > 500);
        let lossy = SpinningLidar { dropout: 1.0, ..lidar.clone() };
        let left =
            lossy.scan(&depth, 400, 240, &K, &mut rng()).unwrap().measured() as f32 / all.measured() as f32;
        // (30 / 120)^2 * 4 of them are lost.
        assert!((left - 0.75).abs() < 0.05, "{left}");
        let mounted = lidar.clone().mounted(&mut rng());
        assert!(mounted.mount[1] < 0.0 && mounted.dropout > 0.0, "above the camera");
        let none = lidar.scan(&[150.0; 400 * 240], 400, 240, &K, &mut rng());
        assert!(matches!(none, Err(Error::NoMeasurement { .. })));
        assert!(matches!(lidar.scan(&depth, 400, 241, &K, &mut rng()), Err(Error::BufferLength { .. })));
        for (name, wrong) in [
            ("step", SpinningLidar { step: 0.0, ..lidar.clone() }),
            ("elevations", SpinningLidar { elevations: vec![f32::NAN], ..lidar.clone() }),
            ("range", SpinningLidar { range: [5.0, 1.0], ..lidar.clone() }),
            ("mount", SpinningLidar { mount: [f32::INFINITY, 0.0, 0.0], ..lidar }),
        ] {
            match wrong.scan(&depth, 400, 240, &K, &mut rng()) {
                Err(Error::Argument { name: found, .. }) => assert_eq!(found, name),
                other => panic!("{name}: {other:?}"),
            }
        }
    }
}
