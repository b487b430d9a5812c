//! Inverse-distance weighting of the nearest measurements.

use rayon::prelude::*;

use crate::depth::SparseDepth;

/// Measurements that a pixel listens to.
const NEIGHBOURS: usize = 12;

/// One measurement: column, row, metres.
type Point = (usize, usize, f32);

/// `sum w_i d_i / sum w_i` over the 12 nearest measurements with `w_i = ((R - r_i) / (R r_i))^2`, where r_i is the distance and R that of
/// the 13th: the weights of Franke and Little (in Barnhill, "Representation and approximation of surfaces", 1977), which fade to 0
/// where a neighbour is exchanged for another, so that the map has no steps. Up to 12 measurements in all: Shepard's `1 / r_i^2`.
pub(super) fn complete(sparse: &SparseDepth) -> Vec<f32> {
    let width = sparse.width();
    let grid = Grid::new(sparse);
    let mut out = sparse.as_slice().to_vec();
    out.par_chunks_mut(width).enumerate().for_each(|(y, line)| {
        for (x, pixel) in line.iter_mut().enumerate() {
            if pixel.is_nan() {
                *pixel = weigh(&grid.nearest(x, y));
            }
        }
    });
    out
}

/// The weighted mean of (squared distance above 0, depth) in rising order.
fn weigh(found: &[(usize, f32)]) -> f32 {
    let distance = |i: usize| (found[i].0 as f64).sqrt();
    let shepard = |i: usize| 1.0 / found[i].0 as f64;
    let used = found.len().min(NEIGHBOURS);
    let mean = |weight: &dyn Fn(usize) -> f64| {
        let (sum, total) = (0..used)
            .fold((0.0, 0.0), |(sum, total), i| (sum + weight(i) * f64::from(found[i].1), total + weight(i)));
        (sum / total) as f32
    };
    // All on one circle: the weights of Franke and Little would all be 0.
    let mean = if found.len() <= NEIGHBOURS || found[0].0 == found[NEIGHBOURS].0 {
        mean(&shepard)
    } else {
        let reach = distance(NEIGHBOURS);
        mean(&|i| ((reach - distance(i)) / (reach * distance(i))).powi(2))
    };
    // Rounding must not carry a mean of equal depths out of their range.
    let (low, high) = found[..used].iter().fold((f32::MAX, 0f32), |(a, b), p| (a.min(p.1), b.max(p.1)));
    mean.max(low).min(high)
}

/// Measurements in square cells of about two each.
struct Grid {
    side: usize,
    columns: usize,
    rows: usize,
    /// Where each cell's points start in `points`; one more entry than cells.
    starts: Vec<usize>,
    points: Vec<Point>,
}

impl Grid {
    fn new(sparse: &SparseDepth) -> Self {
        let (width, height) = (sparse.width(), sparse.height());
        let area = 2.0 * (width * height) as f64 / sparse.measured().max(1) as f64;
        let side = (area.sqrt() as usize).max(1);
        let (columns, rows) = (width.div_ceil(side), height.div_ceil(side));
        let cell = |p: &Point| p.1 / side * columns + p.0 / side;
        let mut points: Vec<Point> = sparse.points().collect();
        points.sort_by_key(cell);
        let mut starts = vec![0; columns * rows + 1];
        points.iter().for_each(|p| starts[cell(p) + 1] += 1);
        (1..starts.len()).for_each(|i| starts[i] += starts[i - 1]);
        Self { side, columns, rows, starts, points }
    }

    /// The nearest measurements, one more than are used, as (squared distance, depth) in rising order.
    fn nearest(&self, x: usize, y: usize) -> Vec<(usize, f32)> {
        let mut found: Vec<(usize, f32)> = Vec::with_capacity(NEIGHBOURS + 2);
        let (cx, cy) = (x / self.side, y / self.side);
        for ring in 0..=self.columns.max(self.rows) {
            // Cells of this ring are at least so far away.
            let least = (ring.saturating_sub(1) * self.side).pow(2);
            if found.len() > NEIGHBOURS && found[NEIGHBOURS].0 <= least {
                break;
            }
            for row in cy.saturating_sub(ring)..(cy + ring + 1).min(self.rows) {
                let whole = row.abs_diff(cy) == ring;
                let (left, right) = (cx.checked_sub(ring), Some(cx + ring).filter(|&c| c < self.columns));
                if whole {
                    (left.unwrap_or(0)..(cx + ring + 1).min(self.columns))
                        .for_each(|column| self.visit(column, row, (x, y), &mut found));
                } else {
                    let ends = [left, right];
                    ends.into_iter().flatten().for_each(|column| self.visit(column, row, (x, y), &mut found));
                }
            }
        }
        found
    }

    fn visit(&self, column: usize, row: usize, (x, y): (usize, usize), found: &mut Vec<(usize, f32)>) {
        let cell = row * self.columns + column;
        for &(px, py, depth) in &self.points[self.starts[cell]..self.starts[cell + 1]] {
            let squared = px.abs_diff(x).pow(2) + py.abs_diff(y).pow(2);
            let place = found.partition_point(|f| f.0 <= squared);
            if place <= NEIGHBOURS {
                found.insert(place, (squared, depth));
                found.truncate(NEIGHBOURS + 1);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{Rng, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    #[test]
    fn few_points_are_shepards_mean() {
        let sparse = SparseDepth::from_points(5, 1, &[(0, 0, 1.0), (3, 0, 4.0)]).unwrap();
        let dense = complete(&sparse);
        // At 1: weights 1 and 1/4. At 4: 1/16 and 1.
        assert!(
            (dense[1] - 1.6).abs() < 1e-6 && (dense[4] - (1.0 / 16.0 + 4.0) / (17.0 / 16.0)).abs() < 1e-6
        );
        assert_eq!((dense[0], dense[3]), (1.0, 4.0));
    }

    #[test]
    fn the_nearest_are_found() {
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        for (count, (w, h)) in [(1, (30, 20)), (13, (30, 20)), (40, (90, 7)), (300, (50, 40)), (5, (1, 70))] {
            let points: Vec<Point> = (0..count)
                .map(|_| (rng.random_range(0..w), rng.random_range(0..h), rng.random_range(1.0..9.0f32)))
                .collect();
            let sparse = SparseDepth::from_points(w, h, &points).unwrap();
            let grid = Grid::new(&sparse);
            for i in 0..w * h {
                let (x, y) = (i % w, i / w);
                let mut all: Vec<usize> =
                    sparse.points().map(|p| p.0.abs_diff(x).pow(2) + p.1.abs_diff(y).pow(2)).collect();
                all.sort_unstable();
                all.truncate(NEIGHBOURS + 1);
                let found: Vec<usize> = grid.nearest(x, y).iter().map(|f| f.0).collect();
                assert_eq!(found, all, "({x}, {y}) of {w}x{h}");
            }
        }
    }

    #[test]
    fn equal_distances_are_a_plain_mean() {
        let found: Vec<(usize, f32)> = (0..13).map(|i| (25, 1.0 + i as f32)).collect();
        assert_eq!(weigh(&found), 6.5);
    }
}
