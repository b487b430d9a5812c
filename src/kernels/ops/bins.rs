//! Statistics of a distribution over bins, from its logits. Positions are counted in bins, whatever each bin stands for.

use crate::kernels::isa::{Isa, Level, per_level};
use crate::kernels::simd::exp;

/// Bins whose weights are summed first; the median is then looked for in the one block that holds it.
const BLOCK_BINS: usize = 64;

/// What [`bin_stats`] finds, in bins: bin `k` covers `k` to `k + 1`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BinStats {
    /// Where the middle of the distribution lies.
    pub middle: f32,
    /// Expected distance of a bin's centre from the middle.
    pub spread: f32,
    /// Probability of the bins whose centre is within the tolerance.
    pub near: f32,
}

/// What counts as the middle of a distribution.
#[derive(Clone, Copy)]
pub enum Middle<'a> {
    /// Its median, linear within its bin.
    Median,
    /// The mean of what the bins stand for.
    Mean {
        /// What each bin stands for.
        values: &'a [f32],
        /// Where among the bins such a value lies.
        position: &'a (dyn Fn(f32) -> f32 + Sync),
    },
}

/// Statistics of `softmax(logits)`. `tolerance` gives the distance from the middle, in bins, within which
/// [`BinStats::near`] counts; `scratch` is overwritten. `None` if a logit is NaN or the largest is not finite.
pub fn bin_stats(
    logits: &[f32],
    scratch: &mut Vec<f32>,
    middle: Middle,
    tolerance: impl Fn(f32) -> f32,
) -> Option<BinStats> {
    let level = Level::current();
    let blocks = logits.len().div_ceil(BLOCK_BINS);
    scratch.clear();
    scratch.resize(logits.len() + blocks, 0.0);
    let (weights, sums) = scratch.split_at_mut(logits.len());
    let max = exponentials(level, logits, weights, sums);
    let total: f32 = sums.iter().sum();
    if !max.is_finite() || total.is_nan() {
        return None;
    }
    let middle = match middle {
        Middle::Median => median(weights, sums, total * 0.5),
        Middle::Mean { values, position } => {
            position(weights.iter().zip(values).map(|(w, v)| w * v).sum::<f32>() / total)
        }
    };
    let (off, near) = distances(level, weights, middle, tolerance(middle));
    Some(BinStats { middle, spread: off / total, near: (near / total).clamp(0.0, 1.0) })
}

/// Where the sum of the weights reaches `half`.
fn median(weights: &[f32], sums: &[f32], half: f32) -> f32 {
    let mut below = 0.0;
    for (block, &sum) in sums.iter().enumerate() {
        if below + sum < half {
            below += sum;
            continue;
        }
        let start = block * BLOCK_BINS;
        for (k, &w) in weights[start..].iter().enumerate() {
            if below + w >= half {
                return (start + k) as f32 + ((half - below) / w).clamp(0.0, 1.0);
            }
            below += w;
        }
    }
    weights.len() as f32
}

#[inline(always)]
fn exponentials_body<S: Isa>(isa: S, logits: &[f32], weights: &mut [f32], sums: &mut [f32]) -> f32 {
    let mut lanes = [f32::NEG_INFINITY; 16];
    for chunk in logits.chunks(16) {
        for (l, &s) in lanes.iter_mut().zip(chunk) {
            *l = if s > *l { s } else { *l };
        }
    }
    let max = lanes.iter().fold(f32::NEG_INFINITY, |a, &b| if b > a { b } else { a });
    let blocks = logits.chunks(BLOCK_BINS).zip(weights.chunks_mut(BLOCK_BINS));
    for ((logits, weights), sum) in blocks.zip(sums) {
        let mut lanes = [0f32; 16];
        for (logits, weights) in logits.chunks(16).zip(weights.chunks_mut(16)) {
            for ((w, &l), lane) in weights.iter_mut().zip(logits).zip(&mut lanes) {
                *w = exp(isa, l - max);
                *lane += *w;
            }
        }
        *sum = lanes.iter().sum();
    }
    max
}

#[inline(always)]
fn distances_body<S: Isa>(_: S, weights: &[f32], median: f32, tolerance: f32) -> (f32, f32) {
    let (mut off, mut near) = ([0f32; 16], [0f32; 16]);
    let mut centres: [f32; 16] = std::array::from_fn(|i| i as f32 + 0.5 - median);
    for chunk in weights.chunks(16) {
        for (i, &w) in chunk.iter().enumerate() {
            let distance = centres[i].abs();
            off[i] += w * distance;
            near[i] += if distance <= tolerance { w } else { 0.0 };
        }
        for c in &mut centres {
            *c += 16.0;
        }
    }
    (off.iter().sum(), near.iter().sum())
}

per_level!(fn exponentials(logits: &[f32], weights: &mut [f32], sums: &mut [f32]) -> f32 = exponentials_body);
per_level!(fn distances(weights: &[f32], median: f32, tolerance: f32) -> (f32, f32) = distances_body);

#[cfg(test)]
mod tests {
    use super::*;
    use crate::kernels::testing::at_every_level;

    /// The same in f64, one bin after the other.
    fn plain(logits: &[f32], tolerance: f64) -> (f64, f64, f64) {
        let max = logits.iter().fold(f64::NEG_INFINITY, |m, &l| m.max(f64::from(l)));
        let weights: Vec<f64> = logits.iter().map(|&l| (f64::from(l) - max).exp()).collect();
        let total: f64 = weights.iter().sum();
        let (mut below, mut median) = (0.0, logits.len() as f64);
        for (k, w) in weights.iter().enumerate() {
            if below + w >= total / 2.0 {
                median = k as f64 + (total / 2.0 - below) / w;
                break;
            }
            below += w;
        }
        let distance = |k: usize| (k as f64 + 0.5 - median).abs();
        let spread = weights.iter().enumerate().map(|(k, w)| w * distance(k)).sum::<f64>();
        let near = weights.iter().enumerate().filter(|(k, _)| distance(*k) <= tolerance);
        (median, spread / total, near.map(|(_, w)| w).sum::<f64>() / total)
    }

    #[test]
    fn it_agrees_with_the_plain_sums() {
        for (n, sharp) in [(1, 1.0), (2, 3.0), (15, 2.0), (64, 0.1), (65, 9.0), (1000, 1.0), (1000, 30.0)] {
            let logits: Vec<f32> = (0..n).map(|i| ((i * 7919 % 1013) as f32 / 1013.0) * sharp).collect();
            let (median, spread, near) = plain(&logits, 7.25);
            at_every_level(|| {
                let s = bin_stats(&logits, &mut Vec::new(), Middle::Median, |_| 7.25).unwrap();
                let off = |a: f32, b: f64| (f64::from(a) - b).abs() / b.max(1.0);
                assert!(off(s.middle, median) < 1e-4 && off(s.spread, spread) < 1e-4, "{n}: {s:?}");
                assert!(off(s.near, near) < 1e-4, "{n}: {s:?}, {near}");
            });
        }
    }

    #[test]
    fn a_mean_is_that_of_what_the_bins_stand_for() {
        let values: Vec<f32> = (0..100).map(|k| (k as f32 * 0.05).exp()).collect();
        let position = |v: f32| v.ln() / 0.05 + 0.5;
        let mut logits = vec![-60f32; 100];
        (logits[10], logits[90]) = (0.0, 0.0);
        let middle = Middle::Mean { values: &values, position: &position };
        at_every_level(|| {
            let s = bin_stats(&logits, &mut Vec::new(), middle, |_| 40.0).unwrap();
            let mean = position((values[10] + values[90]) / 2.0);
            assert!((s.middle - mean).abs() < 1e-3 && (s.spread - 40.0).abs() < 1e-3, "{s:?}, {mean}");
            assert!((s.near - 0.5).abs() < 1e-5, "the upper one is nearer: {s:?}");
        });
    }

    #[test]
    fn what_is_no_distribution_has_no_statistics() {
        let mut scratch = Vec::new();
        for bad in [f32::NAN, f32::INFINITY] {
            let mut logits = vec![0.5f32; 40];
            logits[33] = bad;
            at_every_level(|| assert_eq!(bin_stats(&logits, &mut Vec::new(), Middle::Median, |_| 1.0), None));
        }
        assert_eq!(bin_stats(&[f32::NEG_INFINITY; 3], &mut scratch, Middle::Median, |_| 1.0), None);
        assert_eq!(bin_stats(&[], &mut scratch, Middle::Median, |_| 1.0), None);
    }
}
