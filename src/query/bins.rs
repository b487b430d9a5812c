//! Where numbers lie among the bins of a vocabulary.

use super::reading::{Reading, Readout};
use crate::depth::pixels::CONFIDENT_WITHIN;
use crate::kernels::{BinStats, Middle, bin_stats};

/// The bins of a [`NumberFormat`](super::number::NumberFormat). A position counts bins from 0: bin `k` covers `k` to `k + 1`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Bins {
    /// How many there are.
    pub count: usize,
    /// Where they lie.
    pub spacing: Spacing,
}

/// How wide bins are.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Spacing {
    /// All alike, from 0 to `range`.
    Equal {
        /// Upper end of the last bin.
        range: f64,
    },
    /// Each by the same factor above the one before it, from `lowest` to `highest`.
    Ratio {
        /// Lower end of the first bin.
        lowest: f64,
        /// Upper end of the last bin.
        highest: f64,
    },
}

impl Bins {
    /// Width of a bin: in number units where all are alike, else of the number's logarithm.
    pub fn width(&self) -> f64 {
        match self.spacing {
            Spacing::Equal { range } => range / self.count as f64,
            Spacing::Ratio { lowest, highest } => (highest / lowest).ln() / self.count as f64,
        }
    }

    /// The number at a position.
    pub fn number(&self, position: f32) -> f32 {
        match self.spacing {
            Spacing::Equal { .. } => position * self.width() as f32,
            Spacing::Ratio { lowest, .. } => (lowest * (f64::from(position) * self.width()).exp()) as f32,
        }
    }

    /// The position of a number, 0 to `count`; numbers out of range are at its ends, NaN at its beginning.
    pub fn position(&self, number: f32) -> f64 {
        let number = f64::from(number);
        let position = match self.spacing {
            Spacing::Equal { range } => number / range * self.count as f64,
            Spacing::Ratio { lowest, .. } => (number / lowest).ln() / self.width(),
        };
        // A comparison with NaN is false, also with the logarithm of what is below 0.
        if position > 0.0 { position.min(self.count as f64) } else { 0.0 }
    }

    /// The bin of a number.
    pub fn bin(&self, number: f32) -> usize {
        (self.position(number) as usize).min(self.count - 1)
    }

    /// Distance from a position, in bins, within which an answer counts as sure: 5 % of the number there, but at least one
    /// bin, or a sharp answer of a near pixel could never be confident.
    pub fn tolerance(&self, position: f32) -> f32 {
        match self.spacing {
            Spacing::Equal { .. } => (position * CONFIDENT_WITHIN).max(1.0),
            Spacing::Ratio { .. } => ((1.0 + CONFIDENT_WITHIN).ln() / self.width() as f32).max(1.0),
        }
    }

    /// The answer that a distribution over the bins gives.
    pub fn reading(&self, stats: BinStats) -> Reading {
        let value = self.number(stats.middle);
        let expected_error = match self.spacing {
            Spacing::Equal { .. } => stats.spread * self.width() as f32,
            // The spread is an expected factor.
            Spacing::Ratio { .. } => value * (stats.spread * self.width() as f32).exp_m1(),
        };
        Reading { value, confidence: stats.near, expected_error }
    }

    /// The number in the middle of each bin.
    pub fn centres(&self) -> Vec<f32> {
        (0..self.count).map(|k| self.number(k as f32 + 0.5)).collect()
    }

    /// Reads the logits of one answer as their median; `scratch` is overwritten.
    pub fn read(&self, logits: &[f32], scratch: &mut Vec<f32>) -> Reading {
        self.read_middle(logits, scratch, Middle::Median)
    }

    /// Reads the logits of one answer; `scratch` is overwritten.
    pub fn read_middle(&self, logits: &[f32], scratch: &mut Vec<f32>, middle: Middle) -> Reading {
        let stats = bin_stats(logits, scratch, middle, |at| self.tolerance(at));
        stats.map_or(Reading::INVALID, |s| self.reading(s))
    }

    /// What a readout takes for the middle of a distribution, handed to `then`.
    pub fn with_middle<T>(&self, readout: Readout, then: impl FnOnce(Middle) -> T) -> T {
        match readout {
            Readout::Median => then(Middle::Median),
            Readout::Mean => {
                let position = |number: f32| self.position(number) as f32;
                then(Middle::Mean { values: &self.centres(), position: &position })
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const EQUAL: Bins = Bins { count: 1000, spacing: Spacing::Equal { range: 1.25 } };
    const RATIO: Bins = Bins { count: 1000, spacing: Spacing::Ratio { lowest: 1.0 / 16.0, highest: 16.0 } };

    #[test]
    fn numbers_and_positions_go_together() {
        for bins in [EQUAL, RATIO] {
            for k in [0, 1, 499, 998, 999] {
                assert_eq!(bins.bin(bins.number(k as f32 + 0.5)), k);
            }
            for outside in [-1.0, 0.0, f32::NAN, f32::NEG_INFINITY] {
                assert_eq!(bins.bin(outside), 0, "{outside}");
            }
            for outside in [1e9, f32::INFINITY] {
                assert_eq!(bins.bin(outside), 999, "{outside}");
            }
        }
        assert!((RATIO.number(500.0) - 1.0).abs() < 1e-6 && (RATIO.number(1000.0) - 16.0).abs() < 1e-4);
    }

    #[test]
    fn equal_bins_give_median_error_and_confidence() {
        let read = |logits: &[f32]| EQUAL.read(logits, &mut Vec::new());
        let mut logits = vec![-30.0f32; 1000];
        logits[400] = 5.0;
        let r = read(&logits);
        assert!((r.value - 400.5 * 0.00125).abs() < 1e-5, "{r:?}");
        assert!(r.confidence > 0.999 && r.expected_error < 1e-4);
        logits[800] = 5.0 - (3.0f32).ln();
        let r = read(&logits);
        assert!((r.value - 0.5).abs() < 2e-3 && (r.confidence - 0.75).abs() < 1e-3);
        assert!((r.expected_error - 0.125).abs() < 2e-3, "{r:?}");
        logits[3] = f32::NAN;
        assert!(read(&logits).value.is_nan());
    }

    #[test]
    fn bins_of_equal_ratio_are_as_sure_near_as_far() {
        let at = |numbers: &[f32]| {
            let mut logits = vec![-30.0f32; 1000];
            numbers.iter().for_each(|&n| logits[RATIO.bin(n)] = 5.0);
            RATIO.read(&logits, &mut Vec::new())
        };
        for number in [0.2f32, 1.0, 9.0] {
            let r = at(&[number]);
            assert!((r.value / number - 1.0).abs() < 0.006 && r.confidence > 0.999, "{r:?}");
            assert!(r.expected_error < 0.002 * number, "{r:?}");
            // Three answers within 5 %, and one that is half as far.
            let r = at(&[number, number * 1.02, number * 0.98, number * 0.5]);
            assert!((r.confidence - 0.75).abs() < 1e-3, "{r:?}");
            // The mean of the logarithms' distances, 0.02, 0.02 and 0.69, is about 0.18.
            assert!((r.expected_error / number - 0.2).abs() < 0.03, "{r:?}");
        }
    }
}
