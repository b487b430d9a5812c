//! Surface normals of a dense map.

use rayon::prelude::*;

use super::{Camera, DepthMap};
use crate::error::{Error, Result};

/// Largest radius of a window.
const MAX_RADIUS: usize = 16;
/// Two neighbours whose inverse depths differ by more than this share may lie on two surfaces.
const EDGE: f32 = 0.03;
/// They do unless the surface beside them is as steep: its step, so many times, must reach theirs.
const STEEP: f32 = 3.0;

/// The unit normal of the surface at each pixel, row-major, in camera coordinates (x right, y down, z forward), turned to the
/// camera: its product with the pixel's ray is negative. NaN where there is no depth, no ray ([`Camera::ray`]), or fewer than three
/// neighbours that span a plane.
///
/// A plane is fitted to the inverse depths of a window, which on a plane are linear in the rays, so that neither tilt nor the lens
/// costs accuracy. A pixel of the window counts if a way leads to it inside the window that crosses no depth edge; at an edge the
/// normal is thus that of the pixel's own side. An edge is a step of more than 3 % that the surface's own slope does not
/// explain: lower steps are smoothed over.
///
/// `radius`, 1 to 16, is half of the window's side without its middle: noise of the depth turns the normals by an angle that
/// falls with its square, details that are smaller are lost. With independent noise of 0.5 % in each pixel and a focal length of 500
/// pixels, those of a wall that faces the camera are off by 7.4, 2.2 and 0.7 degrees on average at radius 4, 8 and 16, those of
/// tilted walls by less; a camera with twice the focal length sees twice that.
///
/// # Errors
/// [`Error::Argument`] for a radius out of range and for a camera with pictures of another size.
pub fn normals(map: &DepthMap, camera: &Camera, radius: usize) -> Result<Vec<[f32; 3]>> {
    if !(1..=MAX_RADIUS).contains(&radius) {
        return Err(Error::argument("radius of normals", radius, format!("1 to {MAX_RADIUS} pixels")));
    }
    camera.require_size("camera", "the size of the map", (map.width(), map.height()))?;
    let surface = Surface::new(map, camera);
    let mut normals = vec![[f32::NAN; 3]; map.depth().len()];
    normals.par_chunks_mut(map.width()).enumerate().for_each_init(
        || Window::new(radius),
        |window, (y, row)| {
            for (x, normal) in row.iter_mut().enumerate() {
                let found = window.fit(&surface, x, y).and_then(|plane| plane.normal());
                *normal = found.unwrap_or([f32::NAN; 3]);
            }
        },
    );
    Ok(normals)
}

/// A plane as inverse depth over the plane z = 1, in units of the inverse depth at a pixel: `here` at its ray, and the change per
/// focal length to the right and down.
struct Plane {
    here: f64,
    slope: [f64; 2],
    ray: [f64; 2],
}

impl Plane {
    /// A plane `normal * point = 1` is `normal * ray` in inverse depth, from which its factors can be read.
    fn normal(&self) -> Option<[f32; 3]> {
        let [right, down] = self.slope;
        let forward = self.here - right * self.ray[0] - down * self.ray[1];
        let length = (right * right + down * down + forward * forward).sqrt();
        let usable = self.here > 0.0 && length.is_finite() && length > 0.0;
        usable.then(|| [right, down, forward].map(|part| (-part / length) as f32))
    }
}

/// Inverse depths, their rays, and which neighbours lie on one surface.
struct Surface {
    width: usize,
    height: usize,
    focal: [f64; 2],
    /// NaN where there is no depth or no ray.
    inverse: Vec<f32>,
    rays: Vec<[f32; 2]>,
    /// Whether a pixel is joined to the one at its right, and to the one below.
    right: Vec<bool>,
    down: Vec<bool>,
}

impl Surface {
    fn new(map: &DepthMap, camera: &Camera) -> Self {
        let (width, height) = (map.width(), map.height());
        let ray = |i: usize| camera.ray((i % width) as f32, (i / width) as f32);
        let rays =
            (0..width * height).into_par_iter().map(|i| ray(i).map_or([f32::NAN; 2], |[a, b, _]| [a, b]));
        let rays: Vec<[f32; 2]> = rays.collect();
        let inverse =
            map.depth().iter().zip(&rays).map(|(d, ray)| if ray[0].is_nan() { f32::NAN } else { d.recip() });
        let inverse: Vec<f32> = inverse.collect();
        let at = |x: usize, y: usize| match x < width && y < height {
            true => inverse[y * width + x],
            false => f32::NAN,
        };
        let (mut right, mut down) = (Vec::with_capacity(inverse.len()), Vec::with_capacity(inverse.len()));
        for y in 0..height {
            for x in 0..width {
                // Beyond the left and upper border the number wraps around and is outside, too.
                let (left, above) = (x.wrapping_sub(1), y.wrapping_sub(1));
                right.push(joined([at(left, y), at(x, y), at(x + 1, y), at(x + 2, y)]));
                down.push(joined([at(x, above), at(x, y), at(x, y + 1), at(x, y + 2)]));
            }
        }
        let focal = [camera.intrinsics().fx, camera.intrinsics().fy].map(f64::from);
        Self { width, height, focal, inverse, rays, right, down }
    }
}

/// Whether the two in the middle of four in a row lie on one surface; NaN where there is nothing.
fn joined([before, a, b, after]: [f32; 4]) -> bool {
    let step = b - a;
    if step.abs() <= EDGE * a.max(b) {
        return !step.is_nan();
    }
    let slope = |beside: f32| match beside * step > 0.0 {
        true => beside.abs(),
        false if beside.is_nan() => f32::NAN,
        false => 0.0,
    };
    // The smaller of two, or the one that is there.
    step.abs() <= STEEP * slope(a - before).min(slope(after - b))
}

/// The pixels around one that lie on its surface.
struct Window {
    radius: isize,
    seen: Vec<bool>,
    open: Vec<(isize, isize)>,
}

impl Window {
    fn new(radius: usize) -> Self {
        let side = 2 * radius + 1;
        Self { radius: radius as isize, seen: vec![false; side * side], open: Vec::new() }
    }

    /// Weighted least squares over the pixels that can be reached from the middle.
    fn fit(&mut self, surface: &Surface, x: usize, y: usize) -> Option<Plane> {
        let here = y * surface.width + x;
        let middle = f64::from(surface.inverse[here]);
        if middle.is_nan() {
            return None;
        }
        let ray = surface.rays[here].map(f64::from);
        let [fx, fy] = surface.focal;
        let mut sums = Sums::default();
        self.seen.fill(false);
        self.open.clear();
        self.visit(0, 0);
        while let Some((dx, dy)) = self.open.pop() {
            let (px, py) = (x.wrapping_add_signed(dx), y.wrapping_add_signed(dy));
            let at = py * surface.width + px;
            let near = 1.0 - (dx * dx + dy * dy) as f64 / (2 * (self.radius + 1).pow(2)) as f64;
            // Distances on the plane z = 1, about as long as in pixels.
            let [a, b] = surface.rays[at].map(f64::from);
            sums.add(near, (a - ray[0]) * fx, (b - ray[1]) * fy, f64::from(surface.inverse[at]) / middle);
            if px + 1 < surface.width && surface.right[at] {
                self.visit(dx + 1, dy);
            }
            if px > 0 && surface.right[at - 1] {
                self.visit(dx - 1, dy);
            }
            if py + 1 < surface.height && surface.down[at] {
                self.visit(dx, dy + 1);
            }
            if py > 0 && surface.down[at - surface.width] {
                self.visit(dx, dy - 1);
            }
        }
        let [here, right, down] = sums.solve()?;
        Some(Plane { here, slope: [right * fx, down * fy], ray })
    }

    fn visit(&mut self, dx: isize, dy: isize) {
        let r = self.radius;
        if dx.abs() > r || dy.abs() > r {
            return;
        }
        let seen = &mut self.seen[((dy + r) * (2 * r + 1) + dx + r) as usize];
        if !std::mem::replace(seen, true) {
            self.open.push((dx, dy));
        }
    }
}

#[derive(Default)]
struct Sums {
    weight: f64,
    x: f64,
    y: f64,
    value: f64,
    xx: f64,
    xy: f64,
    yy: f64,
    x_value: f64,
    y_value: f64,
}

impl Sums {
    fn add(&mut self, weight: f64, x: f64, y: f64, value: f64) {
        self.weight += weight;
        self.x += weight * x;
        self.y += weight * y;
        self.value += weight * value;
        self.xx += weight * x * x;
        self.xy += weight * x * y;
        self.yy += weight * y * y;
        self.x_value += weight * x * value;
        self.y_value += weight * y * value;
    }

    /// The value in the middle and its changes along x and y; `None` where all pixels lie in one line.
    fn solve(&self) -> Option<[f64; 3]> {
        let [x, y, value] = [self.x, self.y, self.value].map(|sum| sum / self.weight);
        let (xx, yy) = (self.xx / self.weight - x * x, self.yy / self.weight - y * y);
        let xy = self.xy / self.weight - x * y;
        let (x_value, y_value) =
            (self.x_value / self.weight - x * value, self.y_value / self.weight - y * value);
        let determinant = xx * yy - xy * xy;
        // Three pixels at a corner have about 0.03.
        if determinant.is_nan() || determinant < 1e-3 {
            return None;
        }
        let right = (x_value * yy - y_value * xy) / determinant;
        let down = (y_value * xx - x_value * xy) / determinant;
        Some([value - right * x - down * y, right, down])
    }
}

#[cfg(test)]
mod tests {
    use super::super::{Distortion, Intrinsics};
    use super::*;
    use rand::{Rng, SeedableRng};

    const SIZE: (usize, usize) = (96, 72);

    fn lens(distortion: Distortion) -> Camera {
        let intrinsics = Intrinsics { fx: 500.0, fy: 480.0, cx: 45.3, cy: 38.9 };
        Camera::new(SIZE.0, SIZE.1, intrinsics, distortion).unwrap()
    }

    fn camera() -> Camera {
        lens(Distortion::None)
    }

    fn ray(camera: &Camera, pixel: usize) -> [f64; 3] {
        camera.ray((pixel % SIZE.0) as f32, (pixel / SIZE.0) as f32).unwrap().map(f64::from)
    }

    fn map(camera: &Camera, depth: impl Fn([f64; 3]) -> f64) -> DepthMap {
        of((0..SIZE.0 * SIZE.1).map(|i| depth(ray(camera, i)) as f32).collect())
    }

    fn of(depth: Vec<f32>) -> DepthMap {
        let pixels = depth.len();
        DepthMap::new(SIZE.0, SIZE.1, depth, vec![1.0; pixels], vec![0.0; pixels], vec![false; pixels])
            .unwrap()
    }

    fn unit(v: [f64; 3]) -> [f64; 3] {
        let length = v.iter().map(|c| c * c).sum::<f64>().sqrt();
        v.map(|c| c / length)
    }

    fn dot(a: [f64; 3], b: [f64; 3]) -> f64 {
        a.iter().zip(b).map(|(a, b)| a * b).sum()
    }

    /// A plane of this normal, which faces the camera, 2 m in front of it.
    fn plane(normal: [f64; 3]) -> impl Fn([f64; 3]) -> f64 {
        let through = dot(normal, [0.0, 0.0, 2.0]);
        move |ray| through / dot(normal, ray)
    }

    fn degrees(found: [f32; 3], truth: [f64; 3]) -> f64 {
        let found = found.map(f64::from);
        assert!((dot(found, found) - 1.0).abs() < 1e-5, "{found:?} is no unit vector");
        // The sine by the cross product: the cosine says nothing of small angles.
        let cross = [0, 1, 2]
            .map(|i| found[(i + 1) % 3] * truth[(i + 2) % 3] - found[(i + 2) % 3] * truth[(i + 1) % 3]);
        dot(cross, cross).sqrt().atan2(dot(found, truth)).to_degrees()
    }

    fn tilted() -> [[f64; 3]; 5] {
        [[0.0, 0.0, -1.0], [0.5, 0.2, -1.0], [-2.0, 0.3, -1.0], [0.1, -4.0, -1.0], [7.0, -2.0, -1.0]]
            .map(unit)
    }

    #[test]
    fn planes_are_exact_at_every_tilt_and_at_the_borders() {
        // Strong enough to move the corners by 2 %.
        let bent = lens(Distortion::PlumbBob([-1.0, 0.0, 0.01, 0.01, 0.0]));
        for (camera, normal) in tilted().into_iter().flat_map(|n| [(camera(), n), (bent, n)]) {
            for radius in [1, 2, 8] {
                let found = normals(&map(&camera, plane(normal)), &camera, radius).unwrap();
                let worst = found.iter().map(|&n| degrees(n, normal)).fold(0.0, f64::max);
                assert!(worst < 0.2, "{normal:?} at radius {radius}: {worst} degrees");
            }
        }
    }

    #[test]
    fn noise_turns_normals_as_little_as_the_documents_say() {
        let mut rng = rand_chacha::ChaCha8Rng::seed_from_u64(1);
        for normal in &tilted()[..3] {
            let clean = map(&camera(), plane(*normal));
            let noisy = clean.depth().iter().map(|d| {
                // The sum of twelve uniform numbers is close to a normal distribution of variance 1.
                let bell: f32 = (0..12).map(|_| rng.random::<f32>()).sum::<f32>() - 6.0;
                d * (1.0 + 0.005 * bell)
            });
            let noisy = of(noisy.collect());
            for (radius, most) in [(4, 8.0), (8, 2.5), (16, 0.9)] {
                let found = normals(&noisy, &camera(), radius).unwrap();
                // Where the whole window is inside.
                let inside = (16..56).flat_map(|y| (16..80).map(move |x| y * SIZE.0 + x));
                let errors: Vec<f64> = inside.map(|i| degrees(found[i], *normal)).collect();
                let mean = errors.iter().sum::<f64>() / errors.len() as f64;
                assert!(mean < most, "{normal:?} at radius {radius}: {mean} degrees");
            }
        }
    }

    #[test]
    fn a_sphere_has_radial_normals() {
        let (centre, radius) = ([0.0, 0.0, 3.0], 0.2);
        let hit = |ray: [f64; 3]| {
            let (a, b) = (dot(ray, ray), dot(ray, centre));
            let c = dot(centre, centre) - radius * radius;
            let root = b * b - a * c;
            if root < 0.0 { f64::NAN } else { (b - root.sqrt()) / a }
        };
        let map = map(&camera(), hit);
        let found = normals(&map, &camera(), 2).unwrap();
        let (mut checked, mut worst) = (0, 0f64);
        for (i, normal) in found.iter().enumerate() {
            let depth = f64::from(map.depth()[i]);
            if depth.is_nan() {
                assert!(normal[0].is_nan());
                continue;
            }
            let ray = ray(&camera(), i);
            let truth = unit([0, 1, 2].map(|c| ray[c] * depth - centre[c]));
            // Towards its rim a sphere bends too much for a window.
            if -dot(truth, unit(ray)) > 0.5 {
                checked += 1;
                worst = worst.max(degrees(*normal, truth));
            }
        }
        assert!(checked > 2000 && worst < 3.0, "{worst} degrees in {checked} pixels");
    }

    #[test]
    fn edges_keep_their_sides() {
        let (near, far) = (unit([0.6, 0.1, -1.0]), unit([-0.5, -0.4, -1.0]));
        // Two planes that end at the same column, one 0.3 m behind the other, and a pole of one pixel's width before the second.
        let at_pole = |x: f64| (0.0605..0.0625).contains(&x);
        let behind = |ray: [f64; 3]| dot(far, [0.0, 0.0, 2.3]) / dot(far, ray);
        let map = map(&camera(), |ray| match ray[0] {
            x if x < -0.0005 => plane(near)(ray),
            x if at_pole(x) => 1.0,
            _ => behind(ray),
        });
        let found = normals(&map, &camera(), 4).unwrap();
        for (i, &normal) in found.iter().enumerate() {
            match ray(&camera(), i)[0] {
                x if x < -0.0005 => assert!(degrees(normal, near) < 0.2, "{i}: {normal:?}"),
                // A line of pixels spans no plane.
                x if at_pole(x) => assert!(normal.iter().all(|c| c.is_nan()), "{i}: {normal:?}"),
                _ => assert!(degrees(normal, far) < 0.2, "{i}: {normal:?}"),
            }
        }
    }

    #[test]
    fn what_cannot_be_known_is_nan_and_bad_arguments_are_refused() {
        let mut depth = vec![f32::NAN; SIZE.0 * SIZE.1];
        depth[5 * SIZE.0 + 5] = 1.0;
        depth[5 * SIZE.0 + 6] = 1.0;
        let lonely = of(depth);
        assert!(normals(&lonely, &camera(), 2).unwrap().iter().all(|n| n.iter().all(|c| c.is_nan())));
        for bad in [0, 17] {
            assert!(matches!(normals(&lonely, &camera(), bad), Err(Error::Argument { .. })));
        }
        let other = Camera::new(SIZE.1, SIZE.0, camera().intrinsics(), Distortion::None).unwrap();
        let message = normals(&lonely, &other, 2).unwrap_err().to_string();
        assert!(message.contains("72x96") && message.contains("96x72"), "{message}");
    }
}
