//! How far a depth map is from the truth.

use super::{SparseDepth, check_length, is_valid};
use crate::error::{Error, Result};

/// Errors of a prediction over the pixels that have ground truth, were not measured and were predicted.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Errors {
    /// Mean absolute error, metres.
    pub mae: f64,
    /// Root mean square error, metres.
    pub rmse: f64,
    /// Mean of the absolute error divided by the true depth.
    pub abs_rel: f64,
    /// Number of pixels compared.
    pub pixels: usize,
    /// Pixels with ground truth, not measured, that the prediction leaves invalid; they are in none of the means, so a
    /// comparison of two methods is fair only if both leave out the same pixels.
    pub missing: usize,
}

/// Compares a prediction with the ground truth, both row-major, metres, `width * height` of `sparse`.
///
/// Pixels measured in `sparse` are left out: they were given, not predicted. Ground truth that is not finite or not above
/// 0 is invalid.
///
/// # Errors
/// [`Error::BufferLength`] for a wrong length, [`Error::Argument`] when there is no pixel to compare.
pub fn errors(predicted: &[f32], truth: &[f32], sparse: &SparseDepth) -> Result<Errors> {
    check_length("ground truth", truth.len(), sparse.as_slice().len())?;
    let unmeasured: Vec<f32> =
        truth.iter().zip(sparse.as_slice()).map(|(&t, s)| if s.is_nan() { t } else { f32::NAN }).collect();
    errors_everywhere(predicted, &unmeasured)
}

/// As [`errors`], over all pixels with ground truth.
///
/// # Errors
/// As [`errors`].
pub fn errors_everywhere(predicted: &[f32], truth: &[f32]) -> Result<Errors> {
    check_length("prediction", predicted.len(), truth.len())?;
    let (mut absolute, mut squared, mut relative) = (0.0, 0.0, 0.0);
    let (mut pixels, mut missing) = (0, 0);
    for (&found, &truth) in predicted.iter().zip(truth).filter(|(_, t)| is_valid(**t)) {
        if !is_valid(found) {
            missing += 1;
            continue;
        }
        let error = (f64::from(found) - f64::from(truth)).abs();
        absolute += error;
        squared += error * error;
        relative += error / f64::from(truth);
        pixels += 1;
    }
    if pixels == 0 {
        let found = format!("0 pixels to compare, {missing} without prediction");
        return Err(Error::argument(
            "ground truth",
            found,
            "at least one predicted, not measured pixel with true depth",
        ));
    }
    let n = pixels as f64;
    Ok(Errors { mae: absolute / n, rmse: (squared / n).sqrt(), abs_rel: relative / n, pixels, missing })
}

/// Mean over frames: each frame counts the same, whatever its number of pixels (the usual protocol); counts are summed.
/// `None` without frames.
pub fn mean(frames: &[Errors]) -> Option<Errors> {
    if frames.is_empty() {
        return None;
    }
    let mean_of = |value: fn(&Errors) -> f64| frames.iter().map(value).sum::<f64>() / frames.len() as f64;
    Some(Errors {
        mae: mean_of(|e| e.mae),
        rmse: mean_of(|e| e.rmse),
        abs_rel: mean_of(|e| e.abs_rel),
        pixels: frames.iter().map(|e| e.pixels).sum(),
        missing: frames.iter().map(|e| e.missing).sum(),
    })
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
        assert_eq!(errors_everywhere(&predicted, &truth).unwrap().pixels, 3);
    }

    #[test]
    fn nothing_to_compare_is_an_error() {
        let sparse = SparseDepth::new(2, 1, vec![1.0, 1.0]).unwrap();
        assert!(matches!(errors(&[1.0; 2], &[1.0; 2], &sparse), Err(Error::Argument { .. })));
        assert!(matches!(errors(&[1.0; 3], &[1.0; 2], &sparse), Err(Error::BufferLength { .. })));
        assert!(matches!(errors(&[1.0; 2], &[1.0; 3], &sparse), Err(Error::BufferLength { .. })));
    }

    #[test]
    fn frames_count_the_same() {
        let small = Errors { mae: 1.0, rmse: 2.0, abs_rel: 0.5, pixels: 1, missing: 2 };
        let large = Errors { mae: 3.0, rmse: 4.0, abs_rel: 0.1, pixels: 99, missing: 0 };
        let both = mean(&[small, large]).unwrap();
        assert_eq!((both.mae, both.rmse, both.abs_rel, both.pixels, both.missing), (2.0, 3.0, 0.3, 100, 2));
        assert_eq!(mean(&[]), None);
    }
}
