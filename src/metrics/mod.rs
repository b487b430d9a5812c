//! How far a depth map is from the truth, in the measures of the field.
//!
//! In all formulas `p` is the predicted and `t` the true Z-depth of a pixel in metres, and means run over the pixels that have
//! both. A prediction that leaves pixels out is judged on the others; how many it left out stands in [`Errors::missing`].

mod bootstrap;
mod confidence;
mod relative;
mod structure;

pub use bootstrap::{Interval, bootstrap_mean, bootstrap_ratio};
pub use confidence::{
    Calibration, CalibrationBin, ConfidenceScores, Sparsification, calibration, score_confidence,
    sparsification, sparsification_curve,
};
pub use relative::RelativeError;
pub use structure::{DISTANCE_LIMITS, EdgeRule, Regions, gradient_error};

use serde::{Deserialize, Serialize};

use crate::depth::SparseDepth;
use crate::depth::pixels::{check_length, is_valid};
use crate::error::{Error, Result};

/// Thresholds of [`Errors::delta`]: 1.15 as in the paper's Table 3, the others as in Eigen et al., "Depth Map Prediction from a
/// Single Image using a Multi-Scale Deep Network", 2014.
pub const DELTA_THRESHOLDS: [f64; 4] = [1.15, 1.25, 1.25 * 1.25, 1.25 * 1.25 * 1.25];

/// Errors of a prediction over the pixels that have ground truth, were not measured and were predicted.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[non_exhaustive]
pub struct Errors {
    /// Mean absolute error, metres: `mean |p - t|`.
    pub mae: f64,
    /// Root mean square error, metres: `sqrt(mean (p - t)^2)`.
    pub rmse: f64,
    /// Mean absolute error of inverse depth, 1/km: `mean |1000/p - 1000/t|`, as the KITTI depth completion benchmark defines it
    /// (Uhrig et al., "Sparsity Invariant CNNs", 2017).
    pub imae: f64,
    /// Root mean square error of inverse depth, 1/km: `sqrt(mean (1000/p - 1000/t)^2)`, same source.
    pub irmse: f64,
    /// Mean relative error: `mean |p - t| / t` (Eigen et al. 2014).
    pub abs_rel: f64,
    /// `mean |log10 p - log10 t|` (Saxena et al., "Make3D", 2009).
    pub log10: f64,
    /// Share of pixels with `max(p/t, t/p)` below each of [`DELTA_THRESHOLDS`]; higher is better.
    pub delta: [f64; 4],
    /// Number of pixels compared.
    pub pixels: usize,
    /// Pixels with ground truth, not measured, that the prediction leaves invalid; they are in none of the means, so a
    /// comparison of two methods is fair only if both leave out the same pixels.
    pub missing: usize,
}

/// One measure of [`Errors`], for tables.
#[derive(Debug, Clone, Copy)]
pub struct Metric {
    /// Name in files.
    pub name: &'static str,
    /// Name in tables, with its unit.
    pub label: &'static str,
    /// Whether more is better.
    pub higher_is_better: bool,
    /// Its value.
    pub of: fn(&Errors) -> f64,
}

/// All measures of [`Errors`], in the order of tables.
pub const METRICS: [Metric; 10] = [
    Metric { name: "mae", label: "MAE m", higher_is_better: false, of: |e| e.mae },
    Metric { name: "rmse", label: "RMSE m", higher_is_better: false, of: |e| e.rmse },
    Metric { name: "abs_rel", label: "AbsRel", higher_is_better: false, of: |e| e.abs_rel },
    Metric { name: "imae", label: "iMAE 1/km", higher_is_better: false, of: |e| e.imae },
    Metric { name: "irmse", label: "iRMSE 1/km", higher_is_better: false, of: |e| e.irmse },
    Metric { name: "log10", label: "log10", higher_is_better: false, of: |e| e.log10 },
    Metric { name: "delta_1.15", label: "δ 1.15", higher_is_better: true, of: |e| e.delta[0] },
    Metric { name: "delta_1.25", label: "δ 1.25", higher_is_better: true, of: |e| e.delta[1] },
    Metric { name: "delta_1.25^2", label: "δ 1.25²", higher_is_better: true, of: |e| e.delta[2] },
    Metric { name: "delta_1.25^3", label: "δ 1.25³", higher_is_better: true, of: |e| e.delta[3] },
];

/// Compares a prediction with the ground truth, both row-major, metres, `width * height` of `sparse`.
///
/// Pixels measured in `sparse` are left out: they were given, not predicted. Ground truth that is not finite or not above
/// 0 is invalid.
///
/// # Errors
/// [`Error::BufferLength`] for a wrong length, [`Error::Argument`] when there is no pixel to compare.
pub fn errors(predicted: &[f32], truth: &[f32], sparse: &SparseDepth) -> Result<Errors> {
    check_length("ground truth", truth.len(), sparse.as_slice().len())?;
    compare(predicted, truth, |i| sparse.as_slice()[i].is_nan())
}

/// As [`errors`], over all pixels with ground truth, measured or not, as Marigold-DC's `script/eval.py` counts them for its table, with
/// which the paper's Table 2 compares.
///
/// # Errors
/// As [`errors`].
pub fn errors_everywhere(predicted: &[f32], truth: &[f32]) -> Result<Errors> {
    compare(predicted, truth, |_| true)
}

/// As [`errors`], apart for each of the `regions`; `None` for a region without a pixel to compare.
///
/// # Errors
/// [`Error::BufferLength`] for a wrong length.
pub fn errors_in(predicted: &[f32], truth: &[f32], regions: &Regions) -> Result<Vec<Option<Errors>>> {
    check_length("prediction", predicted.len(), truth.len())?;
    check_length("regions", regions.of_pixels().len(), truth.len())?;
    let mut sums = vec![Sums::default(); regions.count()];
    for ((&p, &t), &region) in predicted.iter().zip(truth).zip(regions.of_pixels()) {
        if let Some(sums) = sums.get_mut(usize::from(region)) {
            sums.add(p, t);
        }
    }
    Ok(sums.iter().map(Sums::errors).collect())
}

fn compare(predicted: &[f32], truth: &[f32], counts: impl Fn(usize) -> bool) -> Result<Errors> {
    check_length("prediction", predicted.len(), truth.len())?;
    let mut sums = Sums::default();
    for (i, (&p, &t)) in predicted.iter().zip(truth).enumerate() {
        if counts(i) {
            sums.add(p, t);
        }
    }
    sums.errors().ok_or_else(|| {
        let found = format!("0 pixels to compare, {} without prediction", sums.missing);
        Error::argument("ground truth", found, "at least one predicted, not measured pixel with true depth")
    })
}

/// Mean over frames: each frame counts the same, whatever its number of pixels (the usual protocol); counts are summed.
/// `None` without frames.
pub fn mean(frames: &[Errors]) -> Option<Errors> {
    if frames.is_empty() {
        return None;
    }
    let mean_of =
        |value: &dyn Fn(&Errors) -> f64| frames.iter().map(value).sum::<f64>() / frames.len() as f64;
    Some(Errors {
        mae: mean_of(&|e| e.mae),
        rmse: mean_of(&|e| e.rmse),
        imae: mean_of(&|e| e.imae),
        irmse: mean_of(&|e| e.irmse),
        abs_rel: mean_of(&|e| e.abs_rel),
        log10: mean_of(&|e| e.log10),
        delta: std::array::from_fn(|k| mean_of(&|e| e.delta[k])),
        pixels: frames.iter().map(|e| e.pixels).sum(),
        missing: frames.iter().map(|e| e.missing).sum(),
    })
}

/// Running sums of one set of pixels.
#[derive(Debug, Clone, Copy, Default)]
struct Sums {
    absolute: f64,
    squared: f64,
    inverse: f64,
    inverse_squared: f64,
    relative: f64,
    log10: f64,
    within: [usize; 4],
    pixels: usize,
    missing: usize,
}

impl Sums {
    /// A pixel without truth does not count at all, one without prediction counts as missing.
    fn add(&mut self, p: f32, t: f32) {
        if !is_valid(t) {
            return;
        }
        if !is_valid(p) {
            self.missing += 1;
            return;
        }
        let (p, t) = (f64::from(p), f64::from(t));
        let (error, inverse) = ((p - t).abs(), (1000.0 / p - 1000.0 / t).abs());
        self.absolute += error;
        self.squared += error * error;
        self.inverse += inverse;
        self.inverse_squared += inverse * inverse;
        self.relative += error / t;
        self.log10 += (p / t).log10().abs();
        let ratio = (p / t).max(t / p);
        for (within, threshold) in self.within.iter_mut().zip(DELTA_THRESHOLDS) {
            *within += usize::from(ratio < threshold);
        }
        self.pixels += 1;
    }

    fn errors(&self) -> Option<Errors> {
        if self.pixels == 0 {
            return None;
        }
        let n = self.pixels as f64;
        Some(Errors {
            mae: self.absolute / n,
            rmse: (self.squared / n).sqrt(),
            imae: self.inverse / n,
            irmse: (self.inverse_squared / n).sqrt(),
            abs_rel: self.relative / n,
            log10: self.log10 / n,
            delta: self.within.map(|w| w as f64 / n),
            pixels: self.pixels,
            missing: self.missing,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn errors_by_hand() {
        let sparse = SparseDepth::from_points(3, 2, &[(0, 0, 1.0)]).unwrap();
        // measured | off by 1 | off by 3 | no truth | not predicted | infinite truth
        let truth = [1.0, 2.0, 4.0, 0.0, 5.0, f32::INFINITY];
        let predicted = [9.0, 3.0, 1.0, 7.0, f32::NAN, 1.0];
        let e = errors(&predicted, &truth, &sparse).unwrap();
        assert_eq!((e.mae, e.abs_rel, e.pixels, e.missing), (2.0, (0.5 + 0.75) / 2.0, 2, 1));
        assert!((e.rmse - 5f64.sqrt()).abs() < 1e-12);
        // 1000/3 - 1000/2 = -166.67 and 1000/1 - 1000/4 = 750 per km.
        assert!((e.imae - (500.0 / 3.0 + 750.0) / 2.0).abs() < 1e-9);
        let irmse = (((500.0f64 / 3.0).powi(2) + 750.0f64.powi(2)) / 2.0).sqrt();
        assert!((e.irmse - irmse).abs() < 1e-9);
        // log10(3/2) = 0.176091, log10(4) = 0.602060.
        assert!((e.log10 - 0.389_075_6).abs() < 1e-6);
        // Ratios 1.5 and 4: only the first is below 1.25^2 = 1.5625.
        assert_eq!(e.delta, [0.0, 0.0, 0.5, 0.5]);
        assert_eq!(errors_everywhere(&predicted, &truth).unwrap().pixels, 3);
    }

    #[test]
    fn delta_is_strict_and_sees_both_directions() {
        let e = errors_everywhere(&[1.25, 1.0, 1.1, 1.2], &[1.0, 1.25, 1.0, 1.0]).unwrap();
        assert_eq!(e.delta, [0.25, 0.5, 1.0, 1.0]);
    }

    #[test]
    fn nothing_to_compare_is_an_error() {
        let sparse = SparseDepth::new(2, 1, vec![1.0, 1.0]).unwrap();
        assert!(matches!(errors(&[1.0; 2], &[1.0; 2], &sparse), Err(Error::Argument { .. })));
        assert!(matches!(errors(&[1.0; 3], &[1.0; 2], &sparse), Err(Error::BufferLength { .. })));
        assert!(matches!(errors(&[1.0; 2], &[1.0; 3], &sparse), Err(Error::BufferLength { .. })));
        assert!(matches!(errors_everywhere(&[], &[]), Err(Error::Argument { .. })));
    }

    #[test]
    fn frames_count_the_same() {
        let frame = |p: &[f32], t: &[f32]| errors_everywhere(p, t).unwrap();
        let (small, large) = (frame(&[2.0], &[1.0]), frame(&[4.0, 4.0, 4.0, f32::NAN], &[4.0; 4]));
        let both = mean(&[small, large]).unwrap();
        assert_eq!((both.mae, both.rmse, both.abs_rel, both.imae), (0.5, 0.5, 0.5, 250.0));
        assert_eq!((both.delta, both.pixels, both.missing), ([0.5; 4], 4, 1));
        assert_eq!(mean(&[]), None);
    }

    #[test]
    fn every_metric_is_listed_once() {
        let e = errors_everywhere(&[3.0, 1.0], &[2.0, 4.0]).unwrap();
        let listed: Vec<f64> = METRICS.iter().map(|m| (m.of)(&e)).collect();
        let [d0, d1, d2, d3] = e.delta;
        assert_eq!(listed, [e.mae, e.rmse, e.abs_rel, e.imae, e.irmse, e.log10, d0, d1, d2, d3]);
        assert!(METRICS.iter().all(|m| m.higher_is_better == m.name.starts_with("delta")));
    }
}
