//! Whether a map knows where it is wrong.

use serde::{Deserialize, Serialize};

use crate::depth::DepthMap;
use crate::depth::pixels::{check_length, is_valid};
use crate::error::{Error, Result};

/// How well an order by uncertainty matches the order by error. Both areas are in units of the mean error of all pixels.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Sparsification {
    /// Area under the sparsification error (AUSE): 0 for the order by the errors themselves; lower is better.
    pub ause: f64,
    /// What the order gains over a random one (AURG): 0 for no gain, negative for a misleading order; higher is better.
    pub aurg: f64,
}

/// Sparsification as Ilg et al. define it ("Uncertainty Estimates and Multi-Hypotheses Networks for Optical Flow", 2018), AURG
/// after Poggi et al. ("On the Uncertainty of Self-Supervised Monocular Depth Estimation", 2020).
///
/// The pixels are removed one by one, the most uncertain first; `S(k)` is the mean error of those left after k, divided by
/// `S(0)`. The area is the mean of `S(k)` over k = 0 .. n-1; AUSE is the area minus that of the order by error, AURG is 1 minus
/// the area. Pixels of equal uncertainty count as in random order. With no error at all both are 0.
///
/// `None` without pixels, for lists of different length, and for a value that is not finite or an error below 0.
pub fn sparsification(errors: &[f64], uncertainty: &[f64]) -> Option<Sparsification> {
    let mut pairs = paired(errors, uncertainty)?;
    let (kept, mean) = (area(&mut pairs), pairs.iter().map(|p| p.1).sum::<f64>() / pairs.len() as f64);
    if mean == 0.0 {
        return Some(Sparsification { ause: 0.0, aurg: 0.0 });
    }
    pairs.iter_mut().for_each(|p| p.0 = p.1);
    let (area, oracle) = (kept / mean, area(&mut pairs) / mean);
    Some(Sparsification { ause: area - oracle, aurg: 1.0 - area })
}

/// (uncertainty, error) of each pixel, if there are any and all can be judged.
fn paired(errors: &[f64], uncertainty: &[f64]) -> Option<Vec<(f64, f64)>> {
    let usable =
        errors.iter().all(|e| e.is_finite() && *e >= 0.0) && uncertainty.iter().all(|u| u.is_finite());
    let fit = usable && !errors.is_empty() && errors.len() == uncertainty.len();
    fit.then(|| uncertainty.iter().copied().zip(errors.iter().copied()).collect())
}

/// The curve whose area [`sparsification`] judges: `(share, S)` at `steps + 1` shares of pixels removed, from 0 on and evenly apart, the most
/// uncertain first. The last share leaves at least one pixel. `S` is the mean error of the pixels left, in units of that of all.
///
/// `None` as [`sparsification`], for 0 steps, and with no error at all.
pub fn sparsification_curve(errors: &[f64], uncertainty: &[f64], steps: usize) -> Option<Vec<(f64, f64)>> {
    let means = kept_means(&mut paired(errors, uncertainty).filter(|_| steps > 0)?);
    let (n, all) = (means.len(), means.last().copied().filter(|mean| *mean > 0.0)?);
    let point = |step: usize| {
        let removed = (n * step / steps).min(n - 1);
        (removed as f64 / n as f64, means[n - 1 - removed] / all)
    };
    Some((0..=steps).map(point).collect())
}

/// Mean over m = 1 .. n of the mean error of the m surest of (uncertainty, error).
fn area(pairs: &mut [(f64, f64)]) -> f64 {
    let means = kept_means(pairs);
    means.iter().sum::<f64>() / means.len() as f64
}

/// The mean error of the m surest of (uncertainty, error), m = 1 .. n.
fn kept_means(pairs: &mut [(f64, f64)]) -> Vec<f64> {
    // By error as well, so that sums do not depend on the order given.
    pairs.sort_unstable_by(|a, b| a.0.total_cmp(&b.0).then(a.1.total_cmp(&b.1)));
    let (mut means, mut sum) = (Vec::with_capacity(pairs.len()), 0.0);
    for tied in pairs.chunk_by(|a, b| a.0 == b.0) {
        let mean = tied.iter().map(|p| p.1).sum::<f64>() / tied.len() as f64;
        for _ in tied {
            sum += mean;
            means.push(sum / (means.len() + 1) as f64);
        }
    }
    means
}

/// What was stated and what came true, for a group of pixels with similar statements.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct CalibrationBin {
    /// Mean of what was stated.
    pub stated: f64,
    /// Mean of what was observed.
    pub observed: f64,
    /// Pixels.
    pub pixels: usize,
}

/// A reliability diagram and its one-number summary.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Calibration {
    /// `sum over bins of n_b / n |stated_b - observed_b|`: the expected calibration error of Guo et al., "On Calibration of Modern
    /// Neural Networks", 2017, in the unit of the statement; lower is better.
    pub error: f64,
    /// The bins that hold pixels, by rising statement.
    pub bins: Vec<CalibrationBin>,
}

/// Compares statements with what was observed, in bins of equally many pixels (equal statements share a bin).
///
/// `None` without pixels, for lists of different length, for a value that is not finite, and for 0 bins.
pub fn calibration(stated: &[f64], observed: &[f64], bins: usize) -> Option<Calibration> {
    let usable = stated.iter().chain(observed).all(|v| v.is_finite());
    if stated.is_empty() || stated.len() != observed.len() || bins == 0 || !usable {
        return None;
    }
    let mut pairs: Vec<(f64, f64)> = stated.iter().copied().zip(observed.iter().copied()).collect();
    pairs.sort_unstable_by(|a, b| a.0.total_cmp(&b.0).then(a.1.total_cmp(&b.1)));
    let n = pairs.len();
    let mut groups: Vec<&[(f64, f64)]> = Vec::new();
    let mut start = 0;
    for b in 1..=bins {
        let mut end = (n * b / bins).max(start);
        while end > 0 && end < n && pairs[end].0 == pairs[end - 1].0 {
            end += 1;
        }
        if end > start {
            groups.push(&pairs[start..end]);
            start = end;
        }
    }
    let mean = |group: &[(f64, f64)], of: fn(&(f64, f64)) -> f64| {
        group.iter().map(of).sum::<f64>() / group.len() as f64
    };
    let bins: Vec<CalibrationBin> = (groups.iter())
        .map(|g| CalibrationBin { stated: mean(g, |p| p.0), observed: mean(g, |p| p.1), pixels: g.len() })
        .collect();
    let error = bins.iter().map(|b| b.pixels as f64 * (b.stated - b.observed).abs()).sum::<f64>() / n as f64;
    Some(Calibration { error, bins })
}

/// How good the confidence and the expected error of a [`DepthMap`] are.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ConfidenceScores {
    /// Pixels ordered by expected error, judged by absolute error.
    pub by_expected_error: Sparsification,
    /// Pixels ordered by confidence, judged by relative error.
    pub by_confidence: Sparsification,
    /// Expected error against absolute error, metres, ten bins.
    pub expected_error: Calibration,
    /// Confidence against the share of pixels whose truth lies within the tolerance of the answer, ten bins.
    pub confidence: Calibration,
}

/// Judges a map's confidence over the pixels that have truth (row-major metres), depth, and no measurement.
///
/// `within` is what the confidence speaks of: the relative distance of truth and answer, `|p - t| <= within * p`; 0.05 for the maps of
/// [`DepthCompleter`](crate::DepthCompleter).
///
/// # Errors
/// [`Error::BufferLength`]; [`Error::Argument`] when there is no pixel to judge, or `within` is not finite and above 0.
pub fn score_confidence(map: &DepthMap, truth: &[f32], within: f64) -> Result<ConfidenceScores> {
    check_length("ground truth", truth.len(), map.depth().len())?;
    if !(within.is_finite() && within > 0.0) {
        return Err(Error::argument("within", within, "a finite share above 0"));
    }
    let pixels: Vec<usize> = (0..truth.len())
        .filter(|&i| is_valid(truth[i]) && is_valid(map.depth()[i]) && !map.measured()[i])
        .collect();
    let list = |of: &dyn Fn(usize) -> f64| pixels.iter().map(|&i| of(i)).collect::<Vec<f64>>();
    let error = |i: usize| (f64::from(map.depth()[i]) - f64::from(truth[i])).abs();
    let absolute = list(&error);
    let relative = list(&|i| error(i) / f64::from(truth[i]));
    let expected = list(&|i| f64::from(map.expected_error()[i]));
    let confidence = list(&|i| f64::from(map.confidence()[i]));
    let hit = list(&|i| f64::from(u8::from(error(i) <= within * f64::from(map.depth()[i]))));
    let doubt: Vec<f64> = confidence.iter().map(|c| -c).collect();
    let scores = || {
        Some(ConfidenceScores {
            by_expected_error: sparsification(&absolute, &expected)?,
            by_confidence: sparsification(&relative, &doubt)?,
            expected_error: calibration(&expected, &absolute, BINS)?,
            confidence: calibration(&confidence, &hit, BINS)?,
        })
    };
    scores().ok_or_else(|| {
        Error::argument(
            "ground truth",
            "0 pixels to judge",
            "at least one pixel with depth and truth, not measured",
        )
    })
}

const BINS: usize = 10;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sparsification_by_hand() {
        // Errors 1, 2, 3: mean 2. Kept in order of error: 1, 1.5, 2, area 1.5; in reverse: 3, 2.5, 2, area 2.5.
        let errors = [2.0, 1.0, 3.0];
        let best = sparsification(&errors, &[0.2, 0.1, 0.3]).unwrap();
        assert_eq!((best.ause, best.aurg), (0.0, 0.25));
        let worst = sparsification(&errors, &[0.2, 0.3, 0.1]).unwrap();
        assert_eq!((worst.ause, worst.aurg), (0.5, -0.25));
        let blind = sparsification(&errors, &[1.0; 3]).unwrap();
        assert_eq!((blind.ause, blind.aurg), (0.25, 0.0));
        assert_eq!(
            sparsification_curve(&errors, &[0.2, 0.1, 0.3], 3).unwrap(),
            [(0.0, 1.0), (1.0 / 3.0, 0.75), (2.0 / 3.0, 0.5), (2.0 / 3.0, 0.5)]
        );
        assert_eq!(sparsification_curve(&errors, &[0.1; 3], 0), None);
        assert_eq!(sparsification_curve(&[0.0; 2], &[0.1; 2], 5), None);
        assert_eq!(sparsification(&[0.0; 2], &[1.0, 2.0]), Some(Sparsification { ause: 0.0, aurg: 0.0 }));
    }

    #[test]
    fn calibration_by_hand() {
        let stated = [0.1, 0.3, 0.8, 1.0];
        let observed = [0.0, 0.0, 1.0, 1.0];
        let c = calibration(&stated, &observed, 2).unwrap();
        assert_eq!(c.bins.iter().map(|b| b.pixels).collect::<Vec<_>>(), [2, 2]);
        assert!((c.bins[0].stated - 0.2).abs() < 1e-12 && c.bins[1].observed == 1.0);
        assert!((c.error - 0.15).abs() < 1e-12);
        // Equal statements stay together, so one bin is left.
        let c = calibration(&[0.5; 4], &observed, 4).unwrap();
        assert_eq!((c.bins.len(), c.error), (1, 0.0));
        assert_eq!(calibration(&stated, &observed, 9).unwrap().bins.len(), 4);
    }

    #[test]
    fn what_cannot_be_judged_is_none() {
        assert_eq!(sparsification(&[], &[]), None);
        assert_eq!(sparsification(&[1.0], &[f64::NAN]), None);
        assert_eq!(sparsification(&[-1.0], &[0.0]), None);
        assert_eq!(sparsification(&[1.0], &[0.0, 1.0]), None);
        assert_eq!(calibration(&[], &[], 3), None);
        assert_eq!(calibration(&[1.0], &[1.0], 0), None);
        assert_eq!(calibration(&[f64::INFINITY], &[1.0], 1), None);
    }

    #[test]
    fn a_map_is_judged_where_it_answered() {
        // Measured, 10 % off and sure, exact and unsure, no truth.
        let map = DepthMap::new(
            4,
            1,
            vec![1.0, 1.1, 2.0, 3.0],
            vec![1.0, 0.9, 0.2, 0.5],
            vec![0.0, 0.1, 0.3, 0.1],
            vec![true, false, false, false],
        )
        .unwrap();
        let s = score_confidence(&map, &[5.0, 1.0, 2.0, f32::NAN], 0.05).unwrap();
        assert_eq!(s.expected_error.bins.iter().map(|b| b.pixels).sum::<usize>(), 2);
        // Expected 0.1 and 0.3, found 0.1 and 0.
        assert!((s.expected_error.error - 0.15).abs() < 1e-6);
        // Confidence 0.2 where it was right, 0.9 where it was not.
        assert!((s.confidence.error - 0.85).abs() < 1e-6);
        assert!(s.by_confidence.aurg < 0.0 && s.by_expected_error.aurg < 0.0);
        assert!(matches!(score_confidence(&map, &[f32::NAN; 4], 0.05), Err(Error::Argument { .. })));
        assert!(matches!(score_confidence(&map, &[1.0; 3], 0.05), Err(Error::BufferLength { .. })));
        assert!(matches!(score_confidence(&map, &[1.0; 4], 0.0), Err(Error::Argument { .. })));
    }
}
