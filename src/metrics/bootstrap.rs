//! How far a mean over frames may be off for having seen these frames and not others.

use rand::{RngCore, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};

/// A figure with its 95 % confidence interval.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Interval {
    /// The figure from the frames as they are.
    pub value: f64,
    /// Lower end: 2.5 % of the resampled figures lie below.
    pub low: f64,
    /// Upper end: 2.5 % of the resampled figures lie above.
    pub high: f64,
}

/// Resampled sets of frames per interval.
const RESAMPLES: usize = 2000;

/// Mean of one value per frame with its percentile bootstrap interval (Efron and Tibshirani, "An Introduction to the Bootstrap",
/// 1993, chapter 13): 2000 times as many frames are drawn with replacement.
///
/// The same values and seed give the same interval on every platform. `None` without values or if one is not finite.
pub fn bootstrap_mean(values: &[f64], seed: u64) -> Option<Interval> {
    interval(values.len(), seed, |frames| frames.map(|i| values[i]).sum::<f64>() / values.len() as f64)
}

/// Ratio of two means over the same frames, `mean a / mean b`, with its percentile bootstrap interval. Frames are drawn in
/// pairs, so what makes a frame hard for both methods cancels out: an interval below 1 says that `a` is better, even
/// where the intervals of the two means overlap.
///
/// `None` without values, for lists of different length, and if a value or ratio is not finite.
pub fn bootstrap_ratio(a: &[f64], b: &[f64], seed: u64) -> Option<Interval> {
    if a.len() != b.len() {
        return None;
    }
    interval(a.len(), seed, |frames| {
        let (above, below) = frames.fold((0.0, 0.0), |(x, y), i| (x + a[i], y + b[i]));
        above / below
    })
}

fn interval(
    count: usize,
    seed: u64,
    figure: impl Fn(&mut dyn Iterator<Item = usize>) -> f64,
) -> Option<Interval> {
    // Larger sets would need wider draws; no benchmark has 2^32 frames.
    let range = u32::try_from(count).ok().filter(|&n| n > 0)?;
    let value = figure(&mut (0..count));
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    // The high half of a product instead of the generator's own range function, whose draws may change between versions.
    let mut draw = || ((u64::from(rng.next_u32()) * u64::from(range)) >> 32) as usize;
    let mut figures: Vec<f64> = (0..RESAMPLES).map(|_| figure(&mut (0..count).map(|_| draw()))).collect();
    if !(value.is_finite() && figures.iter().all(|f| f.is_finite())) {
        return None;
    }
    figures.sort_by(f64::total_cmp);
    Some(Interval { value, low: quantile(&figures, 0.025), high: quantile(&figures, 0.975) })
}

/// Quantile of sorted values, linear between neighbours.
fn quantile(sorted: &[f64], share: f64) -> f64 {
    let place = share * (sorted.len() - 1) as f64;
    let (below, part) = (place.floor() as usize, place.fract());
    let above = (below + 1).min(sorted.len() - 1);
    sorted[below] + (sorted[above] - sorted[below]) * part
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn quantiles_by_hand() {
        assert_eq!(quantile(&[1.0, 2.0, 4.0], 0.5), 2.0);
        assert_eq!(quantile(&[1.0, 2.0, 4.0], 0.75), 3.0);
        assert_eq!(quantile(&[1.0, 2.0, 4.0], 1.0), 4.0);
        assert_eq!(quantile(&[7.0], 0.025), 7.0);
    }

    #[test]
    fn the_interval_is_that_of_theory() {
        // Mean of 400 values of variance 1/12 each: standard error 0.01443, so 1.96 of them are 0.0283.
        let mut rng = ChaCha8Rng::seed_from_u64(5);
        let values: Vec<f64> = (0..400).map(|_| f64::from(rng.next_u32()) / 2f64.powi(32)).collect();
        let i = bootstrap_mean(&values, 1).unwrap();
        assert!(i.low < i.value && i.value < i.high);
        assert!((i.high - i.low - 0.0566).abs() < 0.006, "{i:?}");
        assert_eq!(bootstrap_mean(&values, 1), Some(i));
        assert_ne!(bootstrap_mean(&values, 2), Some(i));
    }

    #[test]
    fn draws_are_the_same_on_every_platform() {
        let i = bootstrap_mean(&[1.0, 2.0, 3.0, 10.0], 0).unwrap();
        assert_eq!((i.value, i.low, i.high), (4.0, 1.5, 8.0));
    }

    #[test]
    fn pairs_cancel_what_frames_share() {
        let b: Vec<f64> = (1..=50).map(|i| f64::from(i * i)).collect();
        let a: Vec<f64> = b.iter().map(|v| 0.9 * v).collect();
        let i = bootstrap_ratio(&a, &b, 3).unwrap();
        assert!([i.value, i.low, i.high].iter().all(|v| (v - 0.9).abs() < 1e-12), "{i:?}");
    }

    #[test]
    fn without_a_figure_there_is_none() {
        assert_eq!(bootstrap_mean(&[], 0), None);
        assert_eq!(bootstrap_mean(&[1.0, f64::NAN], 0), None);
        assert_eq!(bootstrap_ratio(&[1.0], &[1.0, 2.0], 0), None);
        assert_eq!(bootstrap_ratio(&[1.0, 1.0], &[0.0, 0.0], 0), None);
    }
}
