//! Removing LiDAR points that show through what hides them.

use crate::depth::SparseDepth;
use crate::error::{Error, Result};

/// Side of the window of the KITTI and DDAD protocols, pixels.
pub const WINDOW: usize = 7;
/// Largest depth behind the foreground in the KITTI and DDAD protocols, metres.
pub const THRESHOLD: f32 = 1.5;

/// Drops points that lie far behind the foreground around them.
///
/// A scanner sits beside the camera, so some of its points are hidden from the camera and fall between nearer ones. The
/// foreground at a point is the least depth in the `window` x `window` pixels around it; a point goes when it is more than
/// `threshold` metres behind the foreground of any point in its own window, itself included. This is the filter of Conti et
/// al. (arXiv 2210.03118) as used by VPP4DC (arXiv 2312.09254) and, with a window of 7 and 1.5 m on KITTI and DDAD, by
/// Marigold-DC (Sec. 4.1).
///
/// # Errors
/// [`Error::Argument`] for an even window and for a threshold that is not above 0.
pub fn remove_outliers(sparse: &SparseDepth, window: usize, threshold: f32) -> Result<SparseDepth> {
    if window.is_multiple_of(2) {
        return Err(Error::argument("window", window, "an odd number of pixels"));
    }
    if threshold.is_nan() || threshold <= 0.0 {
        return Err(Error::argument("threshold", threshold, "a depth above 0 m"));
    }
    let (w, h) = (sparse.width(), sparse.height());
    let mut foreground = vec![f32::NAN; w * h];
    for (x, y, _) in sparse.points() {
        foreground[y * w + x] = least_around(sparse.as_slice(), (w, h), window / 2, x, y);
    }
    let mut kept = sparse.as_slice().to_vec();
    for (x, y, depth) in sparse.points() {
        if depth - least_around(&foreground, (w, h), window / 2, x, y) > threshold {
            kept[y * w + x] = f32::NAN;
        }
    }
    SparseDepth::new(w, h, kept)
}

/// The least value within `reach` pixels in both directions; NaN values do not count.
fn least_around(values: &[f32], (w, h): (usize, usize), reach: usize, x: usize, y: usize) -> f32 {
    let columns = x.saturating_sub(reach)..x.saturating_add(reach + 1).min(w);
    let rows = y.saturating_sub(reach)..y.saturating_add(reach + 1).min(h);
    rows.flat_map(|row| &values[row * w..][columns.clone()]).fold(f32::INFINITY, |least, &v| least.min(v))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn kept(points: &[(usize, usize, f32)]) -> Vec<(usize, usize, f32)> {
        let sparse = SparseDepth::from_points(20, 12, points).unwrap();
        remove_outliers(&sparse, WINDOW, THRESHOLD).unwrap().points().collect()
    }

    #[test]
    fn a_point_far_behind_a_neighbour_goes() {
        assert_eq!(kept(&[(5, 5, 4.0), (8, 2, 5.75)]), [(5, 5, 4.0)]);
        assert_eq!(kept(&[(5, 5, 4.0), (9, 5, 5.75)]).len(), 2, "outside of the window");
        assert_eq!(kept(&[(5, 5, 4.0), (6, 5, 5.5)]).len(), 2, "just at the threshold");
    }

    #[test]
    fn the_foreground_of_a_neighbour_counts_as_well() {
        // The far point sees the middle one, whose window holds the near one: 5.25 - 3.5 > 1.5.
        assert_eq!(kept(&[(2, 5, 3.5), (5, 5, 4.5), (8, 5, 5.25)]), [(2, 5, 3.5), (5, 5, 4.5)]);
        assert_eq!(kept(&[(5, 5, 4.5), (8, 5, 5.25)]).len(), 2);
    }

    #[test]
    fn it_is_the_published_two_loops() {
        // The reference raises delta(q) to depth(q) - foreground(p) for every q in the window of every p.
        let mut points = Vec::new();
        for i in 0..90usize {
            points.push((i * 7 % 20, i * 5 % 12, 3.0 + (i * i % 17) as f32 * 0.25));
        }
        let sparse = SparseDepth::from_points(20, 12, &points).unwrap();
        let near = |a: usize, b: usize| a.abs_diff(b) <= 3;
        let mut delta = vec![0.0f32; 240];
        for (px, py, _) in sparse.points() {
            let around = || sparse.points().filter(move |q| near(q.0, px) && near(q.1, py));
            let least = around().map(|q| q.2).fold(f32::INFINITY, f32::min);
            for (x, y, d) in around() {
                delta[y * 20 + x] = delta[y * 20 + x].max(d - least);
            }
        }
        let expected: Vec<_> = sparse.points().filter(|q| delta[q.1 * 20 + q.0] <= 1.5).collect();
        assert_eq!(remove_outliers(&sparse, 7, 1.5).unwrap().points().collect::<Vec<_>>(), expected);
        assert!(expected.len() < sparse.measured());
    }

    #[test]
    fn wrong_arguments() {
        let sparse = SparseDepth::from_points(2, 2, &[(0, 0, 1.0)]).unwrap();
        assert!(matches!(remove_outliers(&sparse, 6, 1.5), Err(Error::Argument { name: "window", .. })));
        assert!(remove_outliers(&sparse, usize::MAX, 1.5).is_ok());
        for threshold in [0.0, -1.0, f32::NAN] {
            assert!(remove_outliers(&sparse, 7, threshold).is_err());
        }
    }
}
