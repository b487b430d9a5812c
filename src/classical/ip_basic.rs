//! IP-Basic: morphology only.
//!
//! Everything works on nearness, the negative depth: the largest nearness in a window is the nearest surface, so that a near
//! thing's outline wins against what lies behind it (the paper inverts depth for this reason). Empty is minus infinity.

use rayon::prelude::*;

use crate::depth::{SparseDepth, interpolate};
use crate::error::Result;

const EMPTY: f32 = f32::NEG_INFINITY;

/// The eight steps of section III of the paper, then the nearest depth for what is left: the paper's largest window fills holes
/// of 31 pixels, enough for LiDAR rows, not for a few hundred points.
pub(super) fn complete(sparse: &SparseDepth) -> Result<Vec<f32>> {
    let size = (sparse.width(), sparse.height());
    let measured = sparse.as_slice().iter().map(|d| if d.is_nan() { EMPTY } else { -d }).collect();
    let dilated = diamond(measured, size);
    let closed = extremum(&extremum(&dilated, size, 2, f32::max), size, 2, f32::min);
    let mut filled = closed;
    fill_empty(&mut filled, size, 3);
    extend_to_top(&mut filled, size);
    fill_empty(&mut filled, size, 15);
    let depth = filled.iter().map(|n| if *n == EMPTY { f32::NAN } else { -n }).collect();
    let full = interpolate::nearest(&SparseDepth::new(size.0, size.1, depth)?)?;
    Ok(gaussian(&median(&full, size), size))
}

/// Largest value in the 5x5 diamond around each pixel: the custom kernel of the first step.
fn diamond(values: Vec<f32>, (width, height): (usize, usize)) -> Vec<f32> {
    map_pixels((width, height), |x, y| {
        let rows = y.saturating_sub(2)..(y + 3).min(height);
        rows.fold(EMPTY, |best, row| {
            let reach = 2 - row.abs_diff(y);
            let line = &values[row * width..(row + 1) * width];
            line[x.saturating_sub(reach)..(x + reach + 1).min(width)].iter().copied().fold(best, f32::max)
        })
    })
}

/// Largest (`f32::max`) or smallest (`f32::min`) value in the square window around each pixel, cut at the frame's border.
fn extremum(
    values: &[f32],
    (width, height): (usize, usize),
    radius: usize,
    better: fn(f32, f32) -> f32,
) -> Vec<f32> {
    let rows = map_pixels((width, height), |x, y| {
        let line = &values[y * width..(y + 1) * width];
        let window = &line[x.saturating_sub(radius)..(x + radius + 1).min(width)];
        window.iter().copied().fold(line[x], better)
    });
    let mut out = rows.clone();
    out.par_chunks_mut(width).enumerate().for_each(|(y, line)| {
        for row in y.saturating_sub(radius)..(y + radius + 1).min(height) {
            for (best, &other) in line.iter_mut().zip(&rows[row * width..(row + 1) * width]) {
                *best = better(*best, other);
            }
        }
    });
    out
}

fn fill_empty(values: &mut [f32], size: (usize, usize), radius: usize) {
    let dilated = extremum(values, size, radius, f32::max);
    for (value, filled) in values.iter_mut().zip(dilated) {
        if *value == EMPTY {
            *value = filled;
        }
    }
}

/// What stands highest in a column reaches to its top: poles and walls rise above the highest ray of a scanner.
fn extend_to_top(values: &mut [f32], (width, height): (usize, usize)) {
    for x in 0..width {
        if let Some(top) = (0..height).find(|y| values[y * width + x] != EMPTY) {
            let value = values[top * width + x];
            (0..top).for_each(|y| values[y * width + x] = value);
        }
    }
}

/// Median of the 5x5 window, the border's pixels repeated outwards.
fn median(values: &[f32], (width, height): (usize, usize)) -> Vec<f32> {
    map_pixels((width, height), |x, y| {
        let mut window = [0.0; 25];
        for (k, slot) in window.iter_mut().enumerate() {
            let row = (y + k / 5).saturating_sub(2).min(height - 1);
            let column = (x + k % 5).saturating_sub(2).min(width - 1);
            *slot = values[row * width + column];
        }
        *window.select_nth_unstable_by(12, f32::total_cmp).1
    })
}

/// 5x5 Gaussian (1, 4, 6, 4, 1 in each direction), the border's pixels repeated outwards.
fn gaussian(values: &[f32], (width, height): (usize, usize)) -> Vec<f32> {
    let blur = |at: &dyn Fn(usize) -> f32, i: usize, length: usize| {
        let tap = |k: usize| at((i + k).saturating_sub(2).min(length - 1));
        (tap(0) + 4.0 * tap(1) + 6.0 * tap(2) + 4.0 * tap(3) + tap(4)) / 16.0
    };
    let rows = map_pixels((width, height), |x, y| blur(&|i| values[y * width + i], x, width));
    map_pixels((width, height), |x, y| blur(&|i| rows[i * width + x], y, height))
}

fn map_pixels((width, height): (usize, usize), value: impl Fn(usize, usize) -> f32 + Sync) -> Vec<f32> {
    let mut out = vec![0.0; width * height];
    out.par_chunks_mut(width).enumerate().for_each(|(y, line)| {
        line.iter_mut().enumerate().for_each(|(x, pixel)| *pixel = value(x, y));
    });
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_diamond_reaches_two_pixels() {
        let mut values = vec![EMPTY; 49];
        values[3 * 7 + 3] = -4.0;
        let grown = diamond(values, (7, 7));
        for (i, &found) in grown.iter().enumerate() {
            let inside = (i % 7).abs_diff(3) + (i / 7).abs_diff(3) <= 2;
            assert_eq!(found, if inside { -4.0 } else { EMPTY }, "pixel {i}");
        }
    }

    #[test]
    fn the_nearer_surface_wins() {
        let sparse = SparseDepth::from_points(20, 20, &[(8, 10, 2.0), (11, 10, 9.0)]).unwrap();
        // Both reach (9, 10) and (10, 10).
        let grown = diamond(
            sparse.as_slice().iter().map(|d| if d.is_nan() { EMPTY } else { -d }).collect(),
            (20, 20),
        );
        assert_eq!((grown[10 * 20 + 9], grown[10 * 20 + 10], grown[10 * 20 + 11]), (-2.0, -2.0, -9.0));
    }

    #[test]
    fn closing_fills_small_holes_only() {
        let mut values = vec![-3.0; 400];
        values[5 * 20 + 5] = EMPTY;
        (10..17).for_each(|y| (10..17).for_each(|x| values[y * 20 + x] = EMPTY));
        let closed = extremum(&extremum(&values, (20, 20), 2, f32::max), (20, 20), 2, f32::min);
        assert_eq!((closed[5 * 20 + 5], closed[13 * 20 + 13]), (-3.0, EMPTY));
        fill_empty(&mut values, (20, 20), 3);
        assert_eq!((values[12 * 20 + 12], values[13 * 20 + 13]), (-3.0, EMPTY));
    }

    #[test]
    fn columns_reach_their_top() {
        let mut values = vec![EMPTY; 12];
        (values[2 * 3], values[3 * 3], values[3 + 1]) = (-5.0, -6.0, -7.0);
        extend_to_top(&mut values, (3, 4));
        assert_eq!(values[..6], [-5.0, -7.0, EMPTY, -5.0, -7.0, EMPTY]);
        assert_eq!(values[9], -6.0);
    }

    #[test]
    fn smoothing_removes_one_outlier_and_keeps_a_plane() {
        let mut flat = vec![2.0; 81];
        flat[40] = 50.0;
        assert!(gaussian(&median(&flat, (9, 9)), (9, 9)).iter().all(|d| (d - 2.0).abs() < 1e-6));
        let plane: Vec<f32> = (0..81).map(|i| 2.0 + (i % 9) as f32).collect();
        let smooth = gaussian(&median(&plane, (9, 9)), (9, 9));
        assert!((smooth[40] - plane[40]).abs() < 1e-6);
        // One pixel of 16 spreads as 6/16 * 6/16 at its place.
        let mut spot = vec![0.0; 81];
        spot[40] = 256.0;
        let spread = gaussian(&spot, (9, 9));
        assert_eq!((spread[40], spread[41], spread[42], spread[40 + 9]), (36.0, 24.0, 6.0, 24.0));
    }
}
