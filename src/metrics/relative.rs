//! One method's errors by another's, frame by frame.

use serde::{Deserialize, Serialize};

use super::Interval;
use super::bootstrap::bootstrap_mean;

/// How one method's error compares with a reference's on the same frames.
///
/// A mean in metres is ruled by the few frames with far depth. Here every frame counts alike, whatever its range: a tenth less error
/// is a tenth less everywhere.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[non_exhaustive]
pub struct RelativeError {
    /// Geometric mean over frames of the error by the reference's on the same frame, with its bootstrap interval over frames; below 1
    /// is better than the reference. `None` where no frame has a ratio.
    pub geometric_mean: Option<Interval>,
    /// Frames on which the error is smaller than the reference's.
    pub better: usize,
    /// Frames compared.
    pub frames: usize,
    /// Of these, the frames on which either error is 0. They count in `better` where they are, but have no ratio that a geometric
    /// mean can take (it would be 0 or infinite for all frames together) and are left out of it.
    pub without_ratio: usize,
}

impl RelativeError {
    /// From a frame's error and the reference's on it, frame by frame; lower errors are better. `seed` is that of the bootstrap, as in
    /// [`bootstrap_mean`].
    ///
    /// `None` without frames, or if an error is negative or not finite.
    pub fn over(frames: &[(f64, f64)], seed: u64) -> Option<Self> {
        let valid = |e: f64| e.is_finite() && e >= 0.0;
        if frames.is_empty() || !frames.iter().all(|&(e, r)| valid(e) && valid(r)) {
            return None;
        }
        let with_ratio = frames.iter().filter(|(error, reference)| *error > 0.0 && *reference > 0.0);
        let logarithms: Vec<f64> = with_ratio.map(|(error, reference)| error.ln() - reference.ln()).collect();
        // Quantiles go through an increasing function unchanged, so the interval is that of the mean logarithm.
        let geometric_mean = bootstrap_mean(&logarithms, seed).map(|mean| Interval {
            value: mean.value.exp(),
            low: mean.low.exp(),
            high: mean.high.exp(),
        });
        Some(Self {
            geometric_mean,
            better: frames.iter().filter(|(error, reference)| error < reference).count(),
            frames: frames.len(),
            without_ratio: frames.len() - logarithms.len(),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::super::bootstrap_ratio;
    use super::*;

    fn close(a: f64, b: f64) -> bool {
        (a - b).abs() < 1e-12
    }

    #[test]
    fn a_geometric_mean_by_hand() {
        // Ratios 1/2, 1/2 and 2: their product is 1/2, and its cube root 0.7937.
        let relative = RelativeError::over(&[(1.0, 2.0), (50.0, 100.0), (0.2, 0.1)], 0).unwrap();
        let mean = relative.geometric_mean.unwrap();
        assert!(close(mean.value, 0.5f64.cbrt()), "{mean:?}");
        assert_eq!((relative.better, relative.frames, relative.without_ratio), (2, 3, 0));
        // Of 27 equally likely draws of three frames one holds the third alone and 8 the first two: both beyond 2.5 %.
        assert!(close(mean.low, 0.5) && close(mean.high, 2.0), "{mean:?}");
        // The ratio of means sees little but the frame of 100 m: 51.2 / 102.1.
        let of_means = bootstrap_ratio(&[1.0, 50.0, 0.2], &[2.0, 100.0, 0.1], 0).unwrap().value;
        assert!(close(of_means, 51.2 / 102.1));
    }

    #[test]
    fn frames_count_alike_whatever_their_range() {
        let near = RelativeError::over(&[(1.0, 4.0), (3.0, 1.0)], 1).unwrap();
        let far = RelativeError::over(&[(1.0, 4.0), (3000.0, 1000.0)], 1).unwrap();
        let (near, far) = (near.geometric_mean.unwrap(), far.geometric_mean.unwrap());
        assert!(close(near.value, 0.75f64.sqrt()) && close(near.value, far.value));
        assert!(close(near.low, far.low) && close(near.high, far.high));
        // Turned round, it is the inverse.
        let inverse = RelativeError::over(&[(4.0, 1.0), (1.0, 3.0)], 1).unwrap().geometric_mean.unwrap();
        assert!(close(near.value * inverse.value, 1.0));
    }

    #[test]
    fn errors_of_zero_have_no_ratio_and_still_count() {
        // Better than the reference, worse, both without error, and one with a ratio of 3.
        let frames = [(0.0, 2.0), (1.0, 0.0), (0.0, 0.0), (3.0, 1.0)];
        let relative = RelativeError::over(&frames, 0).unwrap();
        assert_eq!((relative.better, relative.frames, relative.without_ratio), (1, 4, 3));
        assert!(close(relative.geometric_mean.unwrap().value, 3.0));
        let none = RelativeError::over(&frames[..3], 0).unwrap();
        assert_eq!((none.geometric_mean, none.better, none.without_ratio), (None, 1, 3));
    }

    #[test]
    fn equal_errors_are_not_better() {
        let same = RelativeError::over(&[(0.3, 0.3), (0.7, 0.7)], 5).unwrap();
        let mean = same.geometric_mean.unwrap();
        assert_eq!((mean.value, mean.low, mean.high, same.better), (1.0, 1.0, 1.0, 0));
    }

    #[test]
    fn without_a_figure_there_is_none() {
        assert_eq!(RelativeError::over(&[], 0), None);
        for wrong in [f64::NAN, f64::INFINITY, -1.0] {
            assert_eq!(RelativeError::over(&[(1.0, wrong)], 0), None);
            assert_eq!(RelativeError::over(&[(wrong, 1.0)], 0), None);
        }
    }
}
