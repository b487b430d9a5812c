//! Piecewise linear interpolation of a frame's measurements, with each of them or without it.

use super::interpolate::{Interpolator, Plane};
use super::mesh::holder;
use super::{SparseDepth, faces_a_hole};
use crate::error::Result;

/// The Delaunay mesh of a frame's measurements.
pub(crate) struct Linear<'a> {
    sparse: &'a SparseDepth,
    /// Measured pixels with a missing one among the eight around them, as row-major indices: the mesh's points, in its order.
    ///
    /// The triangles at any other are the small ones towards its eight neighbours and hold no missing pixel, so it can be left
    /// out without changing the result. In dense maps this saves nearly all of the work.
    rim: Vec<usize>,
    /// `None` where nothing is missing.
    mesh: Option<Interpolator>,
}

impl<'a> Linear<'a> {
    /// # Errors
    /// [`Error::NoMeasurement`](crate::error::Error::NoMeasurement) for a map without measurements.
    pub(crate) fn new(sparse: &'a SparseDepth) -> Result<Self> {
        sparse.require_points()?;
        let (width, height) = (sparse.width(), sparse.height());
        let edge = rim(sparse);
        let positions: Vec<_> = edge.iter().map(|&(x, y, _)| (x as f32, y as f32)).collect();
        let rim = edge.iter().map(|&(x, y, _)| y * width + x).collect();
        let mesh = if edge.is_empty() { None } else { Some(Interpolator::new(&positions, width, height)?) };
        Ok(Self { sparse, rim, mesh })
    }

    /// Depth at all pixels, metres, row-major; measured pixels keep theirs.
    pub(crate) fn raster(&self) -> Vec<f32> {
        let depth = self.sparse.as_slice();
        let Some(mesh) = &self.mesh else { return depth.to_vec() };
        let mut out = mesh.raster(&self.rim.iter().map(|&pixel| depth[pixel]).collect::<Vec<_>>());
        for (pixel, &depth) in out.iter_mut().zip(depth) {
            if !depth.is_nan() {
                *pixel = depth;
            }
        }
        out
    }

    /// Measured pixels that an edge of the mesh joins to a measured pixel, all of them, and perhaps others of the eight
    /// around it.
    pub(crate) fn neighbours(&self, x: usize, y: usize, out: &mut Vec<(usize, usize)>) {
        let width = self.sparse.width();
        out.clear();
        for (nx, ny) in around(x, y) {
            if self.sparse.get(nx, ny).is_some() {
                out.push((nx, ny));
            }
        }
        let site = self.rim.binary_search(&(y * width + x));
        if let (Ok(site), Some(mesh)) = (site, &self.mesh) {
            let linked = mesh.mesh().neighbours(site).iter().map(|&s| self.rim[s as usize]);
            out.extend(
                linked
                    .map(|pixel| (pixel % width, pixel / width))
                    .filter(|&(nx, ny)| nx.abs_diff(x) > 1 || ny.abs_diff(y) > 1),
            );
        }
    }

    /// What the interpolation would give at a measured pixel if it had not been measured, metres: linear between the others, the
    /// nearest other one outside their hull; `None` without others.
    pub(crate) fn without(&self, x: usize, y: usize) -> Option<f32> {
        let mut others = Vec::new();
        self.neighbours(x, y, &mut others);
        let value = |i: usize| self.sparse.get(others[i].0, others[i].1).unwrap_or(f32::NAN);
        let positions: Vec<[f64; 2]> = others.iter().map(|&(x, y)| [x as f64, y as f64]).collect();
        let here = [x as f64, y as f64];
        if let Some(corners) = holder(here, &positions) {
            let plane = Plane::through(corners.map(|i| positions[i]), corners.map(value));
            return Some(plane.at(here[0], here[1]));
        }
        let squared = |p: &[f64; 2]| (p[0] - here[0]).powi(2) + (p[1] - here[1]).powi(2);
        let nearest =
            (0..positions.len()).min_by(|&a, &b| squared(&positions[a]).total_cmp(&squared(&positions[b])));
        nearest.map(value)
    }
}

/// Measurements with a missing pixel among the eight around them, row by row.
pub(crate) fn rim(sparse: &SparseDepth) -> Vec<(usize, usize, f32)> {
    let (width, height) = (sparse.width(), sparse.height());
    if sparse.measured() == width * height {
        return Vec::new();
    }
    sparse.points().filter(|&(x, y, _)| faces_a_hole(sparse.as_slice(), width, height, x, y)).collect()
}

/// The eight pixels around one, but for those left of or above the frame.
fn around(x: usize, y: usize) -> impl Iterator<Item = (usize, usize)> {
    let rows = y.saturating_sub(1)..=y + 1;
    rows.flat_map(move |ny| (x.saturating_sub(1)..=x + 1).map(move |nx| (nx, ny)))
        .filter(move |&p| p != (x, y))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::depth::interpolate::linear;
    use rand::{Rng, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    /// Interpolation anew, without the pixel.
    fn rebuilt(sparse: &SparseDepth, x: usize, y: usize) -> f32 {
        let mut depth = sparse.as_slice().to_vec();
        depth[y * sparse.width() + x] = f32::NAN;
        let rest = SparseDepth::new(sparse.width(), sparse.height(), depth).unwrap();
        linear(&rest).unwrap()[y * sparse.width() + x]
    }

    fn assert_same_as_rebuilt(sparse: &SparseDepth, pixels: impl Iterator<Item = (usize, usize, f32)>) {
        let mesh = Linear::new(sparse).unwrap();
        for (x, y, _) in pixels {
            let (found, wanted) = (mesh.without(x, y).unwrap(), rebuilt(sparse, x, y));
            assert!((found - wanted).abs() <= 1e-5 * wanted, "({x}, {y}): {found}, rebuilt {wanted}");
        }
    }

    fn scattered(seed: u64, count: usize, (w, h): (usize, usize)) -> SparseDepth {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let points: Vec<_> = (0..count)
            .map(|_| (rng.random_range(0..w), rng.random_range(0..h), rng.random_range(0.5..9.0f32)))
            .collect();
        SparseDepth::from_points(w, h, &points).unwrap()
    }

    #[test]
    fn leaving_a_point_out_is_rebuilding_without_it() {
        // On large grids hardly four points lie on one circle, where two triangulations would be right.
        for (seed, count) in [(1, 2), (2, 3), (3, 4), (4, 7), (5, 60), (6, 250)] {
            let sparse = scattered(seed, count, (5003, 3989));
            assert_same_as_rebuilt(&sparse, sparse.points());
        }
    }

    /// What comes out of any triangulation is right, where they tie: a plane is the same in all of them.
    fn plane(x: usize, y: usize) -> f32 {
        2.0 + 0.03 * x as f32 + 0.02 * y as f32
    }

    #[test]
    fn lattices_rows_and_dense_maps_with_holes() {
        let (w, h) = (60, 44);
        let of = |keep: &dyn Fn(usize, usize) -> bool| {
            let pixels = (0..w * h).map(|i| (i % w, i / w)).filter(|&(x, y)| keep(x, y));
            let points: Vec<_> = pixels.map(|(x, y)| (x, y, plane(x, y))).collect();
            SparseDepth::from_points(w, h, &points).unwrap()
        };
        let inner = |p: &(usize, usize, f32)| (8..w - 8).contains(&p.0) && (8..h - 8).contains(&p.1);
        let maps = [
            of(&|x, y| x % 4 == 1 && y % 4 == 2),
            of(&|x, y| y % 9 == 3 && x % 2 == 0),
            of(&|x, y| !((20..33).contains(&x) && (15..30).contains(&y))),
            of(&|x, y| (x * 7 + y * 3) % 5 != 0),
            of(&|_, _| true),
        ];
        for sparse in &maps {
            assert_same_as_rebuilt(sparse, sparse.points().filter(inner).step_by(7));
        }
        // The edge of the hull, where the nearest counts: values that tell which.
        let sparse = scattered(9, 40, (997, 1009));
        let hull: Vec<_> =
            sparse.points().filter(|p| p.0 < 150 || p.0 > 850 || p.1 < 150 || p.1 > 850).collect();
        assert!(hull.len() > 10);
        assert_same_as_rebuilt(&sparse, hull.into_iter());
    }

    #[test]
    fn dense_maps_with_other_values_than_a_plane() {
        let (w, h) = (200, 150);
        let mut depth: Vec<f32> =
            (0..w * h).map(|i| plane(i % w, i / w) + 0.3 * ((i * i % 17) as f32)).collect();
        for y in 40..110 {
            // Ragged, so that circles through four rim pixels are rare.
            depth[y * w + 50 + y * y % 13..y * w + 120 + y * y % 11].fill(f32::NAN);
        }
        let sparse = SparseDepth::new(w, h, depth).unwrap();
        let mesh = Linear::new(&sparse).unwrap();
        let rim = sparse.points().filter(|p| faces_a_hole(sparse.as_slice(), w, h, p.0, p.1));
        let (mut same, mut all) = (0, 0);
        for (x, y, _) in rim {
            let (found, wanted) = (mesh.without(x, y).unwrap(), rebuilt(&sparse, x, y));
            same += usize::from((found - wanted).abs() <= 1e-5 * wanted);
            all += 1;
        }
        // Four pixels around one lie on a circle; elsewhere there is one answer.
        assert!(same * 10 > all * 8, "{same} of {all}");
    }

    #[test]
    fn points_on_one_line_and_a_single_one() {
        let line: Vec<_> = (0..9).map(|i| (3 * i, 10, 1.0 + i as f32)).collect();
        let sparse = SparseDepth::from_points(40, 20, &line).unwrap();
        let mesh = Linear::new(&sparse).unwrap();
        for (x, y, depth) in sparse.points() {
            let found = mesh.without(x, y).unwrap();
            assert_eq!((found - depth).abs(), 1.0, "one of the two beside it");
        }
        let one = SparseDepth::from_points(40, 20, &line[..1]).unwrap();
        assert_eq!(Linear::new(&one).unwrap().without(0, 10), None);
    }

    #[test]
    fn one_point_that_sees_a_long_row_is_done_in_no_time() {
        let row = (0..8000).map(|x| (x, 1, 1.0 + x as f32));
        let points: Vec<_> = row.chain([(4001, 40, 7.0)]).collect();
        let sparse = SparseDepth::from_points(8000, 41, &points).unwrap();
        let mesh = Linear::new(&sparse).unwrap();
        assert_eq!(mesh.without(4001, 40), Some(4002.0));
        assert_eq!(mesh.without(17, 1), Some(18.0));
    }
}
