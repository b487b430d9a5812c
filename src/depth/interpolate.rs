//! Dense maps from scattered values: nearest neighbour and piecewise linear over a Delaunay mesh.

use rayon::prelude::*;

use super::mesh::{Mesh, Owner, cross};
use super::{SparseDepth, check_length, pixel_count};
use crate::error::Result;

/// Gives every pixel the depth of the nearest measured pixel (Euclidean, exact). `width * height` metres.
///
/// # Errors
/// [`Error::NoMeasurement`](crate::error::Error::NoMeasurement) for a map without measurements.
pub fn nearest(sparse: &SparseDepth) -> Result<Vec<f32>> {
    sparse.require_points()?;
    let (width, height) = (sparse.width(), sparse.height());
    let rows = nearest_rows(sparse.as_slice(), width, height);
    let mut out = vec![0.0; width * height];
    out.par_chunks_mut(width).enumerate().for_each(|(y, line)| {
        let found = &rows[y * width..(y + 1) * width];
        for (pixel, x) in line.iter_mut().zip(nearest_columns(y, found)) {
            *pixel = sparse.as_slice()[found[x] as usize * width + x];
        }
    });
    Ok(out)
}

/// Piecewise linear interpolation over the Delaunay triangles of the measured pixels; the nearest measurement outside their
/// hull, and everywhere if they all lie on one line. Measured pixels keep their value. `width * height` metres.
///
/// # Errors
/// [`Error::NoMeasurement`](crate::error::Error::NoMeasurement) for a map without measurements.
pub fn linear(sparse: &SparseDepth) -> Result<Vec<f32>> {
    sparse.require_points()?;
    let (width, height) = (sparse.width(), sparse.height());
    if sparse.measured() == width * height {
        return Ok(sparse.as_slice().to_vec());
    }
    let edge: Vec<_> = sparse.points().filter(|&(x, y, _)| faces_a_hole(sparse, x, y)).collect();
    let positions: Vec<_> = edge.iter().map(|&(x, y, _)| (x as f32, y as f32)).collect();
    let values: Vec<_> = edge.iter().map(|&(_, _, depth)| depth).collect();
    let mut out = Interpolator::new(&positions, width, height)?.raster(&values);
    for (pixel, &depth) in out.iter_mut().zip(sparse.as_slice()) {
        if !depth.is_nan() {
            *pixel = depth;
        }
    }
    Ok(out)
}

/// Whether one of the eight pixels around a measured one is missing.
///
/// The triangles at a point with eight measured neighbours are the small ones towards them and hold no missing pixel, so such
/// points can be left out without changing the result. In dense maps this saves nearly all of the work.
fn faces_a_hole(sparse: &SparseDepth, x: usize, y: usize) -> bool {
    let columns = x.saturating_sub(1)..(x + 2).min(sparse.width());
    let mut rows = y.saturating_sub(1)..(y + 2).min(sparse.height());
    rows.any(|row| {
        let line = &sparse.as_slice()[row * sparse.width()..];
        line[columns.clone()].iter().any(|d| d.is_nan())
    })
}

/// No measurement in this column.
const EMPTY: u32 = u32::MAX;

/// For each pixel the row of the nearest measurement in its own column, or `EMPTY`.
fn nearest_rows(depth: &[f32], width: usize, height: usize) -> Vec<u32> {
    let mut rows = vec![EMPTY; depth.len()];
    for y in 0..height {
        for x in 0..width {
            let here = y * width + x;
            if !depth[here].is_nan() {
                rows[here] = y as u32;
            } else if y > 0 {
                rows[here] = rows[here - width];
            }
        }
    }
    for y in (0..height.saturating_sub(1)).rev() {
        for x in 0..width {
            let (above, below) = (rows[y * width + x], rows[(y + 1) * width + x]);
            let nearer = below != EMPTY && (above == EMPTY || (below as usize).abs_diff(y) < (above as usize).abs_diff(y));
            if nearer {
                rows[y * width + x] = below;
            }
        }
    }
    rows
}

/// For each pixel of row y the column whose candidate (`found`) is nearest.
///
/// Seen along the row, the squared distance to a column's candidate is a parabola; the lower envelope of all parabolas is
/// built left to right (Felzenszwalb and Huttenlocher, "Distance Transforms of Sampled Functions", 2012) and read off.
fn nearest_columns(y: usize, found: &[u32]) -> impl Iterator<Item = usize> {
    let height = |x: usize| (i64::from(found[x]) - y as i64).pow(2);
    // (column of the parabola, first pixel where it is the lowest)
    let mut envelope: Vec<(usize, usize)> = Vec::new();
    for x in (0..found.len()).filter(|&x| found[x] != EMPTY) {
        let mut from = 0;
        while let Some(&(last, last_from)) = envelope.last() {
            let rise = height(x) - height(last) + (x * x) as i64 - (last * last) as i64;
            // The new parabola is strictly lower from here on; in integers, so that the result is exact.
            let meet = rise.div_euclid(2 * (x - last) as i64) + 1;
            if meet <= last_from as i64 {
                envelope.pop();
                continue;
            }
            from = meet as usize;
            break;
        }
        if from < found.len() {
            envelope.push((x, from));
        }
    }
    let mut current = 0;
    (0..found.len()).map(move |x| {
        while envelope.get(current + 1).is_some_and(|&(_, from)| from <= x) {
            current += 1;
        }
        envelope.get(current).map_or(0, |&(column, _)| column)
    })
}

/// Piecewise linear interpolation from one set of positions, for any number of value sets.
///
/// The triangulation, and which triangle holds which pixel, is computed once. Outside the hull of the points, and everywhere
/// if they lie on one line, the value is that of the nearest point. Of several points at one position the first counts.
#[derive(Debug)]
pub struct Interpolator {
    mesh: Mesh,
    points: usize,
}

impl Interpolator {
    /// Triangulates `points` (x, y in pixels, fractions allowed, also outside the frame) for a frame of this size.
    ///
    /// # Errors
    /// [`Error::NoMeasurement`](crate::error::Error::NoMeasurement) without points,
    /// [`Error::Argument`](crate::error::Error::Argument) for a coordinate that is not finite,
    /// [`Error::ImageSize`](crate::error::Error::ImageSize) for an empty or absurdly large frame.
    pub fn new(points: &[(f32, f32)], width: usize, height: usize) -> Result<Self> {
        Ok(Self { mesh: Mesh::new(points, width, height)?, points: points.len() })
    }

    /// Number of points given to [`Interpolator::new`]: the number of values to pass.
    pub fn points(&self) -> usize {
        self.points
    }

    /// The value at any position, in the unit of `values` (one per point, in the order of the points).
    ///
    /// NaN for a position that is not finite, and where the values needed are absent or NaN.
    pub fn at(&self, x: f32, y: f32, values: &[f32]) -> f32 {
        if !(x.is_finite() && y.is_finite()) {
            return f32::NAN;
        }
        let position = [f64::from(x), f64::from(y)];
        match self.mesh.locate(position) {
            Owner::Site(site) => self.value(site, values),
            Owner::Triangle(triangle) => {
                let corners = self.mesh.triangles[triangle];
                match corners.iter().find(|&&s| self.mesh.sites[s as usize] == position) {
                    Some(&site) => self.value(site as usize, values),
                    None => self.plane(triangle, values).at(position[0], position[1]),
                }
            }
        }
    }

    /// The values at all pixel centres (integer coordinates) of the frame, row-major, `width * height`.
    ///
    /// A point that lies on a pixel gives that pixel its value bit for bit. NaN where the values needed are absent or NaN.
    pub fn raster(&self, values: &[f32]) -> Vec<f32> {
        let mut out = vec![0.0; self.mesh.width * self.mesh.height];
        self.paint(values, &mut out);
        out
    }

    /// As [`Interpolator::raster`], into a buffer of the caller.
    ///
    /// # Errors
    /// [`Error::BufferLength`](crate::error::Error::BufferLength) unless `out` holds `width * height` values.
    pub fn raster_into(&self, values: &[f32], out: &mut [f32]) -> Result<()> {
        check_length("raster", out.len(), pixel_count(self.mesh.width, self.mesh.height)?)?;
        self.paint(values, out);
        Ok(())
    }

    fn paint(&self, values: &[f32], out: &mut [f32]) {
        let planes: Vec<Plane> = (0..self.mesh.triangles.len()).map(|t| self.plane(t, values)).collect();
        out.par_chunks_mut(self.mesh.width).enumerate().for_each(|(y, row)| {
            for ((x, pixel), owner) in row.iter_mut().enumerate().zip(self.mesh.owner_row(y)) {
                *pixel = match owner {
                    Owner::Triangle(t) => planes[t].at(x as f64, y as f64),
                    Owner::Site(s) => self.value(s, values),
                };
            }
        });
        for (pixel, site) in self.mesh.pixel_sites() {
            out[pixel] = self.value(site, values);
        }
    }

    fn value(&self, site: usize, values: &[f32]) -> f32 {
        values.get(self.mesh.origin[site]).copied().unwrap_or(f32::NAN)
    }

    fn plane(&self, triangle: usize, values: &[f32]) -> Plane {
        let corner_values = self.mesh.triangles[triangle].map(|s| self.value(s as usize, values));
        Plane::through(self.mesh.corners(triangle), corner_values)
    }
}

/// The linear function over one triangle, with the range of its corner values.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Plane {
    base: f64,
    dx: f64,
    dy: f64,
    low: f32,
    high: f32,
}

impl Plane {
    pub(crate) fn through(corners: [[f64; 2]; 3], values: [f32; 3]) -> Self {
        let [a, b, c] = corners;
        let [va, vb, vc] = values.map(f64::from);
        let area = cross(a, b, c);
        let dx = ((vb - va) * (c[1] - a[1]) - (vc - va) * (b[1] - a[1])) / area;
        let dy = ((vc - va) * (b[0] - a[0]) - (vb - va) * (c[0] - a[0])) / area;
        let low = values[0].min(values[1]).min(values[2]);
        let high = values[0].max(values[1]).max(values[2]);
        Self { base: va - dx * a[0] - dy * a[1], dx, dy, low, high }
    }

    /// Value at a position inside the triangle; never outside the range of the corners, NaN if one of them is NaN.
    pub(crate) fn at(&self, x: f64, y: f64) -> f32 {
        let value = (self.base + self.dx * x + self.dy * y) as f32;
        // Not `clamp`, which panics on a NaN bound, nor `max`, which would hide a NaN value.
        if value < self.low {
            self.low
        } else if value > self.high {
            self.high
        } else {
            value
        }
    }

    /// Value at any position, also outside the triangle.
    pub(crate) fn extend(&self, x: f64, y: f64) -> f64 {
        self.base + self.dx * x + self.dy * y
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::error::Error;
    use rand::{Rng, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    fn scattered(seed: u64, count: usize, width: usize, height: usize) -> SparseDepth {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let mut point = || (rng.random_range(0..width), rng.random_range(0..height), rng.random_range(0.5..9.0f32));
        let points: Vec<_> = (0..count).map(|_| point()).collect();
        SparseDepth::from_points(width, height, &points).unwrap()
    }

    /// Squared distance to the nearest measurement, and the depths found at that distance.
    fn brute_force(sparse: &SparseDepth, x: usize, y: usize) -> Vec<f32> {
        let distance = |p: &(usize, usize, f32)| p.0.abs_diff(x).pow(2) + p.1.abs_diff(y).pow(2);
        let points: Vec<_> = sparse.points().collect();
        let best = points.iter().map(distance).min().unwrap();
        points.iter().filter(|p| distance(p) == best).map(|p| p.2).collect()
    }

    fn check_nearest(sparse: &SparseDepth, dense: &[f32]) {
        for y in 0..sparse.height() {
            for x in 0..sparse.width() {
                let (found, allowed) = (dense[y * sparse.width() + x], brute_force(sparse, x, y));
                assert!(allowed.contains(&found), "({x}, {y}): {found} is none of {allowed:?}");
            }
        }
    }

    #[test]
    fn nearest_agrees_with_brute_force() {
        for (seed, count, (w, h)) in [(1, 1, (9, 7)), (2, 2, (40, 5)), (3, 30, (37, 41)), (4, 200, (50, 33)), (5, 3, (1, 60)), (6, 3, (60, 1))] {
            let sparse = scattered(seed, count, w, h);
            check_nearest(&sparse, &nearest(&sparse).unwrap());
        }
    }

    #[test]
    fn a_mesh_without_triangles_is_nearest() {
        let lines: [&[(usize, usize, f32)]; 5] = [
            &[(20, 10, 2.0)],
            &[(3, 4, 2.0), (20, 25, 3.0)],
            &[(3, 4, 2.0), (13, 4, 3.0), (22, 4, 4.0), (7, 4, 9.0)],
            &[(5, 3, 2.0), (5, 30, 3.0), (5, 11, 4.0)],
            &[(2, 2, 2.0), (20, 20, 5.0), (8, 8, 3.0), (11, 11, 4.0)],
        ];
        for points in lines {
            let sparse = SparseDepth::from_points(32, 31, points).unwrap();
            check_nearest(&sparse, &linear(&sparse).unwrap());
        }
    }

    #[test]
    fn outside_the_hull_is_nearest() {
        let points = [(10, 10, 1.0), (20, 11, 2.0), (14, 22, 3.0), (17, 13, 4.0)];
        let sparse = SparseDepth::from_points(40, 40, &points).unwrap();
        let dense = linear(&sparse).unwrap();
        for (x, y) in [(0, 0), (39, 0), (39, 39), (0, 39), (30, 12), (15, 9), (14, 23)] {
            assert!(brute_force(&sparse, x, y).contains(&dense[y * 40 + x]), "({x}, {y})");
        }
    }

    #[test]
    fn a_plane_is_reproduced_inside_the_hull() {
        let (w, h) = (64, 48);
        let plane = |x: f32, y: f32| 2.0 + 0.03 * x + 0.07 * y;
        let mut rng = ChaCha8Rng::seed_from_u64(7);
        let mut points = vec![(0.0, 0.0), (63.0, 0.0), (0.0, 47.0), (63.0, 47.0), (5.0, 5.0), (5.0, 5.0)];
        points.extend((0..60).map(|_| (rng.random_range(0.0..63.0f32), rng.random_range(0.0..47.0f32))));
        let values: Vec<f32> = points.iter().map(|&(x, y)| plane(x, y)).collect();
        let mesh = Interpolator::new(&points, w, h).unwrap();
        for (i, v) in mesh.raster(&values).into_iter().enumerate() {
            let expected = plane((i % w) as f32, (i / w) as f32);
            assert!((v - expected).abs() < 1e-5, "pixel {i}: {v} vs {expected}");
        }
        for _ in 0..500 {
            let (x, y) = (rng.random_range(0.0..63.0f32), rng.random_range(0.0..47.0f32));
            assert!((mesh.at(x, y, &values) - plane(x, y)).abs() < 1e-5, "({x}, {y})");
        }
    }

    #[test]
    fn at_agrees_with_raster() {
        let sparse = scattered(11, 80, 50, 40);
        let points: Vec<_> = sparse.points().map(|(x, y, _)| (x as f32, y as f32)).collect();
        let values: Vec<_> = sparse.points().map(|p| p.2).collect();
        let mesh = Interpolator::new(&points, 50, 40).unwrap();
        let raster = mesh.raster(&values);
        for (i, &expected) in raster.iter().enumerate() {
            let found = mesh.at((i % 50) as f32, (i / 50) as f32, &values);
            // On a hull edge or at equal distances both are right, so only most pixels must agree exactly.
            assert!((found - expected).abs() < 1e-4, "pixel {i}: {found} vs {expected}");
        }
        assert!(mesh.at(-30.0, 90.5, &values).is_finite());
        assert!(mesh.at(f32::NAN, 1.0, &values).is_nan() && mesh.at(1.0, f32::INFINITY, &values).is_nan());
    }

    #[test]
    fn no_value_leaves_the_range_and_points_are_kept() {
        for (seed, count) in [(21, 5), (22, 100), (23, 1500), (24, 4000)] {
            let sparse = scattered(seed, count, 80, 60);
            let dense = linear(&sparse).unwrap();
            assert!(dense.iter().all(|d| (0.5..9.0).contains(d)));
            assert!(sparse.points().all(|(x, y, d)| dense[y * 80 + x].to_bits() == d.to_bits()));
        }
    }

    #[test]
    fn leaving_out_points_without_holes_around_changes_nothing() {
        let (w, h) = (40, 30);
        // Not a plane, so that a different triangle would give a different value; no two triangulations tie inside a hole of
        // one pixel, whose value is a mean of its neighbours either way.
        let full: Vec<f32> = (0..w * h).map(|i| 2.0 + 0.01 * (i % w) as f32 + 0.02 * (i / w) as f32).collect();
        let mut holes = full.clone();
        for y in 8..20 {
            holes[y * w + 5..y * w + 25].fill(f32::NAN);
        }
        holes[3] = f32::NAN;
        let dense = linear(&SparseDepth::new(w, h, holes).unwrap()).unwrap();
        let all = linear(&SparseDepth::new(w, h, full.clone()).unwrap()).unwrap();
        assert_eq!(all, full);
        assert!(dense.iter().zip(&full).all(|(a, b)| (a - b).abs() < 1e-5));
    }

    #[test]
    fn a_large_set_and_awkward_positions_are_covered() {
        let sparse = scattered(31, 20_000, 320, 240);
        assert!(linear(&sparse).unwrap().iter().all(|d| d.is_finite()));
        let ring: Vec<(f32, f32)> = (0..200).map(|i| i as f32 * 0.0314).map(|a| (50.0 + 40.0 * a.cos(), 50.0 + 40.0 * a.sin())).collect();
        let lattice: Vec<(f32, f32)> = (0..400).map(|i| ((i % 20 * 5) as f32, (i / 20 * 5) as f32)).collect();
        let far = vec![(-1e30, 5.0), (1e30, 5.0), (3.0, -1e30), (f32::MAX, f32::MAX), (1e-40, 0.0), (-0.0, 0.0), (0.0, -0.0)];
        for points in [ring, lattice, far] {
            let values: Vec<f32> = (0..points.len()).map(|i| i as f32).collect();
            let raster = Interpolator::new(&points, 100, 100).unwrap().raster(&values);
            assert!(raster.iter().all(|v| (0.0..points.len() as f32).contains(v)));
        }
    }

    #[test]
    fn the_first_of_equal_positions_counts() {
        let mesh = Interpolator::new(&[(1.0, 1.0), (1.0, 1.0), (3.0, 1.0)], 5, 3).unwrap();
        assert_eq!(mesh.raster(&[7.0, 8.0, 9.0])[6], 7.0);
        assert_eq!(mesh.at(1.0, 1.0, &[7.0, 8.0, 9.0]), 7.0);
    }

    #[test]
    fn bad_input_is_refused() {
        let none = SparseDepth::new(4, 4, vec![0.0; 16]).unwrap();
        assert!(matches!(nearest(&none), Err(Error::NoMeasurement { .. })));
        assert!(matches!(linear(&none), Err(Error::NoMeasurement { .. })));
        assert!(matches!(Interpolator::new(&[], 4, 4), Err(Error::NoMeasurement { .. })));
        assert!(matches!(Interpolator::new(&[(f32::NAN, 0.0)], 4, 4), Err(Error::Argument { .. })));
        assert!(matches!(Interpolator::new(&[(0.0, 0.0)], 0, 4), Err(Error::ImageSize { .. })));
        let mesh = Interpolator::new(&[(0.0, 0.0), (3.0, 0.0), (0.0, 3.0)], 4, 4).unwrap();
        assert!(mesh.raster(&[1.0]).iter().any(|v| v.is_nan()), "missing values must not be invented");
        assert!(matches!(mesh.raster_into(&[1.0; 3], &mut [0.0; 3]), Err(Error::BufferLength { .. })));
    }
}
