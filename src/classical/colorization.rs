//! Depth that changes where the picture changes.
//!
//! Minimises `sum over pixels r of (d(r) - sum over neighbours s of w_rs d(s))^2` with d held at the measurements; the eight weights of a
//! pixel fall with the difference in brightness and sum to 1 (Levin et al. 2004, equations 1 and 2). The normal equations are
//! solved by conjugate gradients from coarse to fine: waves much longer than a pixel, which they would take thousands of steps for, are
//! settled where they are short.

use image::{Rgb, RgbImage};
use rayon::prelude::*;

use crate::depth::{SparseDepth, interpolate};
use crate::error::Result;

/// Steps on the finest level; each coarser level, a quarter of the pixels, takes twice as many.
const RELAXATION_STEPS: usize = 40;

/// At most so many steps on a level.
const MOST_STEPS: usize = 640;

/// A level whose shorter side is at most this is solved without a coarser one.
const COARSEST_SIDE: usize = 6;

/// Smallest variance of brightness (0 to 1): half a step of 8 bits, squared.
const LEAST_VARIANCE: f32 = 0.25 / (255.0 * 255.0);

pub(super) fn complete(rgb: &RgbImage, sparse: &SparseDepth) -> Result<Vec<f32>> {
    let depths = || sparse.points().map(|p| p.2);
    let (low, high) = (depths().fold(f32::MAX, f32::min), depths().fold(0.0, f32::max));
    if low == high || sparse.measured() == sparse.as_slice().len() {
        return interpolate::nearest(sparse);
    }
    // Centred and of size 1, where f32 resolves best; 0 is no valid depth, so the known values lie in 1 to 2.
    let known = sparse.as_slice().iter().map(|d| 1.0 + (d - low) / (high - low)).collect();
    let brightness = rgb
        .pixels()
        .map(|&Rgb([r, g, b])| (0.299 * f32::from(r) + 0.587 * f32::from(g) + 0.114 * f32::from(b)) / 255.0);
    let level = Level { width: sparse.width(), height: sparse.height(), guide: brightness.collect(), known };
    let solved = level.solve(RELAXATION_STEPS)?;
    let metres = |(&v, &d): (&f32, &f32)| {
        if d.is_nan() { (low + (v - 1.0) * (high - low)).max(low).min(high) } else { d }
    };
    Ok(solved.iter().zip(sparse.as_slice()).map(metres).collect())
}

/// A picture with some known values, at one resolution.
struct Level {
    width: usize,
    height: usize,
    guide: Vec<f32>,
    /// NaN where not known.
    known: Vec<f32>,
}

impl Level {
    fn solve(&self, steps: usize) -> Result<Vec<f32>> {
        let mut values = if self.width.min(self.height) <= COARSEST_SIDE {
            let known = SparseDepth::new(self.width, self.height, self.known.clone())?;
            interpolate::nearest(&known)?
        } else {
            let coarse = self.halved();
            coarse.enlarge(&coarse.solve((2 * steps).min(MOST_STEPS))?, self.width, self.height)
        };
        for (value, known) in values.iter_mut().zip(&self.known) {
            if !known.is_nan() {
                *value = *known;
            }
        }
        System::new(self).descend(&mut values, steps);
        Ok(values)
    }

    /// Half the width and height, rounded up: mean brightness and mean of the known values of up to 2x2 pixels.
    fn halved(&self) -> Level {
        let (width, height) = (self.width.div_ceil(2), self.height.div_ceil(2));
        let mean = |of: &[f32], i: usize| {
            let (x, y) = (2 * (i % width), 2 * (i / width));
            let rows = y..(y + 2).min(self.height);
            let all = rows.flat_map(|row| &of[row * self.width..][x..(x + 2).min(self.width)]);
            let (sum, n) = all.filter(|v| !v.is_nan()).fold((0.0, 0.0), |(s, n), v| (s + v, n + 1.0));
            sum / n
        };
        let halve = |of: &[f32]| (0..width * height).map(|i| mean(of, i)).collect();
        Level { width, height, guide: halve(&self.guide), known: halve(&self.known) }
    }

    /// Bilinear, from this level's pixels to twice as many (or one fewer) in each direction.
    fn enlarge(&self, values: &[f32], width: usize, height: usize) -> Vec<f32> {
        // Fine pixel 2k lies a quarter below coarse pixel k, 2k + 1 a quarter above it.
        let neighbour = |i: usize, length: usize| {
            let other =
                if i.is_multiple_of(2) { (i / 2).saturating_sub(1) } else { (i / 2 + 1).min(length - 1) };
            (i / 2, other)
        };
        let value = |i: usize| {
            let (x, y) = (neighbour(i % width, self.width), neighbour(i / width, self.height));
            let row = |y: usize| 0.75 * values[y * self.width + x.0] + 0.25 * values[y * self.width + x.1];
            0.75 * row(y.0) + 0.25 * row(y.1)
        };
        (0..width * height).map(value).collect()
    }
}

/// The equations of a level. All fields have a border of one pixel, whose weights are 0, so that no pixel is a special case.
struct System {
    width: usize,
    height: usize,
    stride: usize,
    /// For each of the eight neighbours, the weight that it has for each pixel.
    weights: [Vec<f32>; 8],
    /// Of the neighbours, as steps in a field.
    steps: [isize; 8],
    /// Diagonal of the normal equations; 0 where a pixel is known or outside.
    diagonal: Vec<f32>,
}

const NEIGHBOUR_OFFSETS: [(isize, isize); 8] =
    [(-1, -1), (0, -1), (1, -1), (-1, 0), (1, 0), (-1, 1), (0, 1), (1, 1)];

impl System {
    fn new(level: &Level) -> Self {
        let (width, height, stride) = (level.width, level.height, level.width + 2);
        let mut weights: [Vec<f32>; 8] = std::array::from_fn(|_| vec![0.0; stride * (height + 2)]);
        for y in 0..height {
            for x in 0..width {
                let of_pixel = similarity(level, x, y);
                let here = (y + 1) * stride + x + 1;
                weights.iter_mut().zip(of_pixel).for_each(|(plane, w)| plane[here] = w);
            }
        }
        let steps = NEIGHBOUR_OFFSETS.map(|(dx, dy)| dy * stride as isize + dx);
        let mut system = Self { width, height, stride, weights, steps, diagonal: Vec::new() };
        system.diagonal = system.each_row(|start, line| {
            line.fill(1.0);
            for (plane, step) in system.weights.iter().zip(system.steps) {
                let heard = &plane[start.wrapping_add_signed(-step)..][..line.len()];
                line.iter_mut().zip(heard).for_each(|(sum, w)| *sum += w * w);
            }
            let known = &level.known[(start / stride - 1) * width..][..width];
            line.iter_mut().zip(known).filter(|(_, k)| !k.is_nan()).for_each(|(sum, _)| *sum = 0.0);
        });
        system
    }

    /// A field made row by row: from the place of a row's first pixel in it, and the row without its border.
    fn each_row(&self, fill: impl Fn(usize, &mut [f32]) + Sync) -> Vec<f32> {
        let mut out = vec![0.0; self.stride * (self.height + 2)];
        let inner = out.par_chunks_mut(self.stride).enumerate().skip(1).take(self.height);
        inner.for_each(|(row, line)| fill(row * self.stride + 1, &mut line[1..=self.width]));
        out
    }

    /// Each pixel minus the weighted mean of its neighbours.
    fn differences(&self, v: &[f32]) -> Vec<f32> {
        self.each_row(|start, line| {
            line.copy_from_slice(&v[start..][..line.len()]);
            for (plane, step) in self.weights.iter().zip(self.steps) {
                let neighbours = &v[start.wrapping_add_signed(step)..][..line.len()];
                subtract(line, &plane[start..][..neighbours.len()], neighbours);
            }
        })
    }

    /// The normal equations applied to a field, at the pixels that are not known.
    fn apply(&self, v: &[f32]) -> Vec<f32> {
        let d = self.differences(v);
        self.each_row(|start, line| {
            line.copy_from_slice(&d[start..][..line.len()]);
            for (plane, step) in self.weights.iter().zip(self.steps) {
                let from = start.wrapping_add_signed(-step);
                subtract(line, &plane[from..][..line.len()], &d[from..][..line.len()]);
            }
            let diagonal = &self.diagonal[start..][..line.len()];
            line.iter_mut().zip(diagonal).filter(|(_, d)| **d == 0.0).for_each(|(v, _)| *v = 0.0);
        })
    }

    /// Product of two fields; summed row by row, so that it does not depend on the number of threads.
    fn product(&self, a: &[f32], b: &[f32]) -> f64 {
        let rows = a.par_chunks(self.stride).zip(b.par_chunks(self.stride));
        let sums: Vec<f64> =
            rows.map(|(a, b)| a.iter().zip(b).map(|(a, b)| f64::from(*a) * f64::from(*b)).sum()).collect();
        sums.iter().sum()
    }

    /// Conjugate gradients, preconditioned by the diagonal, from the values given; known values do not move.
    fn descend(&self, values: &mut [f32], steps: usize) {
        let mut x = self.each_row(|start, line| {
            line.copy_from_slice(&values[(start / self.stride - 1) * self.width..][..self.width]);
        });
        let mut residual: Vec<f32> = self.apply(&x).into_iter().map(|v| -v).collect();
        let scaled = |r: &[f32]| {
            let value = |(r, d): (&f32, &f32)| if *d > 0.0 { r / d } else { 0.0 };
            r.par_iter().zip(&self.diagonal).map(value).collect::<Vec<f32>>()
        };
        let mut z = scaled(&residual);
        let mut direction = z.clone();
        let mut size = self.product(&residual, &z);
        let enough = 1e-10 * size;
        for _ in 0..steps {
            let image = self.apply(&direction);
            let step = size / self.product(&direction, &image);
            // Also when there is nothing left to do: 0 / 0.
            if !(step.is_finite() && step > 0.0) {
                break;
            }
            add(&mut x, step as f32, &direction);
            add(&mut residual, -step as f32, &image);
            z = scaled(&residual);
            let next = self.product(&residual, &z);
            if next <= enough {
                break;
            }
            let keep = (next / size) as f32;
            size = next;
            direction.par_iter_mut().zip(&z).for_each(|(d, z)| *d = z + keep * *d);
        }
        for (row, line) in values.chunks_mut(self.width).enumerate() {
            line.copy_from_slice(&x[(row + 1) * self.stride + 1..][..self.width]);
        }
    }
}

/// `from - weights * values`, one by one.
fn subtract(from: &mut [f32], weights: &[f32], values: &[f32]) {
    for ((f, w), v) in from.iter_mut().zip(weights).zip(values) {
        *f -= w * v;
    }
}

fn add(to: &mut [f32], times: f32, what: &[f32]) {
    to.par_iter_mut().zip(what).for_each(|(t, w)| *t += times * w);
}

/// Weights of the eight neighbours of a pixel: `exp(-(Y(r) - Y(s))^2 / (0.6 v))`, v the variance of brightness in the 3x3 window
/// (the paper writes `2 sigma_r^2` for the denominator, its authors' program has 0.6 v), scaled to sum 1; 0 for neighbours
/// outside the frame.
fn similarity(level: &Level, x: usize, y: usize) -> [f32; 8] {
    let here = level.guide[y * level.width + x];
    let guide = NEIGHBOUR_OFFSETS.map(|(dx, dy)| {
        let (x, y) = (x.checked_add_signed(dx)?, y.checked_add_signed(dy)?);
        (x < level.width && y < level.height).then(|| level.guide[y * level.width + x])
    });
    let seen = || guide.iter().flatten().copied();
    let count = seen().count() as f32 + 1.0;
    let mean = (seen().sum::<f32>() + here) / count;
    let variance = (seen().map(|g| (g - mean).powi(2)).sum::<f32>() + (here - mean).powi(2)) / count;
    let variance = variance.max(LEAST_VARIANCE);
    // Relative to the most alike neighbour, so that not all can vanish; the scaling to sum 1 makes it the same.
    let least = seen().map(|g| (g - here).powi(2)).fold(f32::MAX, f32::min);
    let raw = guide.map(|g| g.map_or(0.0, |g| ((least - (g - here).powi(2)) / (0.6 * variance)).exp()));
    let sum: f32 = raw.iter().sum();
    // A frame of one pixel has no neighbour.
    raw.map(|w| if sum > 0.0 { w / sum } else { 0.0 })
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{Rng, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    fn level(width: usize, height: usize, seed: u64) -> Level {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let guide = (0..width * height)
            .map(|i| if i % width < width / 2 { 0.2 } else { 0.8 } + 0.05 * rng.random::<f32>());
        let guide = guide.collect();
        let known = |i: usize| if i % 7 == 3 { 1.0 + (i % 5) as f32 * 0.25 } else { f32::NAN };
        Level { width, height, guide, known: (0..width * height).map(known).collect() }
    }

    /// The energy that is minimised, straight from its formula.
    fn energy(level: &Level, v: &[f64]) -> f64 {
        let (w, h) = (level.width, level.height);
        let term = |i: usize| {
            let weights = similarity(level, i % w, i / w);
            let mut difference = v[i];
            for (weight, (dx, dy)) in weights.into_iter().zip(NEIGHBOUR_OFFSETS) {
                let (x, y) = ((i % w) as isize + dx, (i / w) as isize + dy);
                if (0..w as isize).contains(&x) && (0..h as isize).contains(&y) {
                    difference -= f64::from(weight) * v[y as usize * w + x as usize];
                } else {
                    assert_eq!(weight, 0.0);
                }
            }
            difference * difference
        };
        (0..w * h).map(term).sum()
    }

    #[test]
    fn the_minimum_is_found() {
        let level = level(11, 9, 4);
        let solved: Vec<f64> = level.solve(400).unwrap().into_iter().map(f64::from).collect();
        let least = energy(&level, &solved);
        // At a minimum no single unknown pixel can be moved with profit, by however little.
        for i in (0..99).filter(|&i| level.known[i].is_nan()) {
            for change in [-1e-3, 1e-3] {
                let mut moved = solved.clone();
                moved[i] += change;
                assert!(energy(&level, &moved) >= least, "pixel {i}");
            }
        }
        assert!(solved.iter().zip(&level.known).all(|(s, k)| k.is_nan() || *s == f64::from(*k)));
    }

    #[test]
    fn few_steps_are_close_to_many() {
        let (w, h) = (120, 90);
        let mut level = level(w, h, 5);
        for (i, known) in level.known.iter_mut().enumerate() {
            *known = if i % 211 == 7 { 1.0 + (i % w) as f32 / w as f32 } else { f32::NAN };
        }
        let (quick, long) = (level.solve(RELAXATION_STEPS).unwrap(), level.solve(3000).unwrap());
        let difference: f32 =
            quick.iter().zip(&long).map(|(a, b)| (a - b).abs()).sum::<f32>() / (w * h) as f32;
        // A picture of pure noise is the slowest there is.
        assert!(difference < 0.02, "{difference} of a range of 1");
    }

    #[test]
    fn depth_stops_where_the_picture_changes() {
        let (w, h) = (40u32, 30u32);
        let rgb = RgbImage::from_fn(w, h, |x, _| Rgb([if x < 20 { 40 } else { 200 }; 3]));
        let points = [(4, 4, 1.0), (10, 25, 1.0), (14, 12, 1.0), (26, 5, 3.0), (35, 20, 3.0), (30, 28, 3.0)];
        let sparse = SparseDepth::from_points(40, 30, &points).unwrap();
        let dense = complete(&rgb, &sparse).unwrap();
        let worst = |columns: std::ops::Range<usize>, depth: f32| {
            let all = (0..30).flat_map(|y| columns.clone().map(move |x| y * 40 + x));
            all.map(|i| (dense[i] - depth).abs()).fold(0.0, f32::max)
        };
        assert!(worst(0..19, 1.0) < 0.1 && worst(21..40, 3.0) < 0.1);
    }

    #[test]
    fn halving_and_enlarging_fit() {
        for (w, h) in [(7, 5), (8, 8), (13, 1), (1, 9), (2, 3)] {
            let mut level = level(w, h, 6);
            level.guide = (0..w * h).map(|i| (i % w) as f32).collect();
            let half = level.halved();
            assert_eq!((half.width, half.height), (w.div_ceil(2), h.div_ceil(2)));
            assert!(half.guide.iter().all(|g| g.is_finite()));
            let back = half.enlarge(&half.guide, w, h);
            assert_eq!(back.len(), w * h);
            // A slope comes back, but for the border and the half column of an odd width.
            for (i, value) in back.iter().enumerate().filter(|(i, _)| i % w > 0 && i % w + 3 < w) {
                assert!((value - (i % w) as f32).abs() < 1e-5, "{w}x{h} pixel {i}: {value}");
            }
        }
    }
}
