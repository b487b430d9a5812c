//! The difference between measurements and answers, carried over to the answers around.

use crate::depth::interpolate::Interpolator;
use crate::depth::pixels::CONFIDENT_WITHIN;
use crate::error::Result;
use crate::query::Reading;

/// An aligned answer is at least and at most this many times the answer itself. Measured on 30 procedural scenes and 13 real
/// frames, 100 to 1500 points: a tighter upper limit loses on frames whose far parts the model draws too near (a street: MAE
/// 0.945 of that without alignment with 3, 0.971 with 2, 1.002 with 1.1); a lower limit of 0.33 gives the same as 0.5.
const BOUND: (f32, f32) = (0.5, 3.0);

/// Difference in log depth between a pixel's answer and that at a measured pixel that counts as one standard deviation: what lies
/// farther apart is another surface, and its difference says little. Of 0.05, 0.07, 0.1, 0.15 and none, the same frames: MAE at
/// 1500 points 0.940, 0.939, 0.940, 0.940 and 0.949 of that without alignment.
const SAME_SURFACE: f32 = 0.1;

/// Answers at measured pixels, beside the measurements.
#[derive(Clone, Default)]
pub(super) struct Anchors {
    /// Columns and rows.
    points: Vec<(f32, f32)>,
    measured: Vec<f32>,
    answered: Vec<f32>,
}

impl Anchors {
    /// Adds a measured pixel, unless its answer could not be read.
    pub(super) fn push(&mut self, (x, y, measured): (usize, usize, f32), answer: &Reading) {
        if answer.value.is_finite() && answer.value > 0.0 {
            self.points.push((x as f32, y as f32));
            self.measured.push(measured);
            self.answered.push(answer.value);
        }
    }
}

/// What is added to answers, pixel by pixel.
///
/// The measurement minus the answer at the corners of the triangle around a pixel is interpolated linearly, with two
/// restraints: a corner counts as far as its own answer is like the pixel's (else it lies on another surface), and where
/// corners contradict each other the shift shrinks. So the map passes through the measurements, up to [`BOUND`], and an
/// answer far from any measurement like it stays as it is.
pub(super) struct Alignment {
    mesh: Interpolator,
    anchors: Anchors,
}

impl Alignment {
    /// `None` without anything to align to.
    ///
    /// # Errors
    /// [`crate::Error::ImageSize`] for an empty frame.
    pub(super) fn new(anchors: Anchors, width: usize, height: usize) -> Result<Option<Self>> {
        if anchors.points.is_empty() {
            return Ok(None);
        }
        let mesh = Interpolator::new(&anchors.points, width, height)?;
        Ok(Some(Self { mesh, anchors }))
    }

    /// The answer at a pixel of the frame, moved. Its expected error and its confidence follow.
    pub(super) fn apply(&self, (x, y): (usize, usize), answer: Reading) -> Reading {
        let (mut weight, mut sum, mut squares) = (0f32, 0f32, 0f32);
        for (anchor, share) in self.mesh.weights_at(x, y) {
            let answered = self.anchors.answered[anchor];
            let apart = (answer.value / answered).ln() / SAME_SURFACE;
            let share = share * (-0.5 * apart * apart).exp();
            let residual = self.anchors.measured[anchor] - answered;
            weight += share;
            sum += share * residual;
            squares += share * residual * residual;
        }
        if weight * squares < f32::MIN_POSITIVE {
            return answer;
        }
        // 1 where all agree, by Cauchy and Schwarz, and 0 where they cancel.
        let agreement = (sum * sum / (weight * squares)).min(1.0);
        let (low, high) = (answer.value * BOUND.0, answer.value * BOUND.1);
        let value = (answer.value + sum * agreement).max(low).min(high);
        doubted(answer, value, squares.sqrt())
    }
}

/// A moved answer whose place is doubtful by `doubt`, the root mean square of the differences around it, same unit.
///
/// Variances add, since the model's error and that of the shift have different causes. Measured on the frames above, where the
/// shift is one to three times the model's expected error: true error 5.5 % of depth, this 5.3 %, the model's own 2.9 %. For
/// the confidence the model's errors are taken to be as far spread as a Laplace distribution with that probability within the
/// tolerance.
fn doubted(answer: Reading, value: f32, doubt: f32) -> Reading {
    let own = -CONFIDENT_WITHIN * answer.value / (-answer.confidence).ln_1p();
    let confidence = -(-CONFIDENT_WITHIN * value / own.hypot(doubt)).exp_m1();
    Reading {
        value,
        confidence: confidence.clamp(0.0, answer.confidence),
        expected_error: answer.expected_error.hypot(doubt),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn answer(value: f32) -> Reading {
        Reading { value, confidence: 0.95, expected_error: 0.01 * value }
    }

    /// Anchors at (x, y): measured, answered.
    fn alignment(anchors: &[(usize, usize, f32, f32)]) -> Alignment {
        let mut all = Anchors::default();
        for &(x, y, measured, answered) in anchors {
            all.push((x, y, measured), &answer(answered));
        }
        Alignment::new(all, 21, 21).unwrap().unwrap()
    }

    /// Residuals at three corners around the centre.
    fn around(answered: f32, residuals: [f32; 3]) -> Alignment {
        let corners = [(0, 0), (20, 0), (10, 20)];
        let all = std::array::from_fn::<_, 3, _>(|i| {
            (corners[i].0, corners[i].1, answered + residuals[i], answered)
        });
        alignment(&all)
    }

    #[test]
    fn it_passes_through_the_measurements() {
        let a = alignment(&[(0, 0, 2.2, 2.0), (20, 0, 3.0, 3.3), (10, 20, 5.0, 5.0)]);
        for (x, y, measured, answered) in [(0, 0, 2.2, 2.0), (20, 0, 3.0, 3.3), (10, 20, 5.0, 5.0)] {
            let moved = a.apply((x, y), answer(answered));
            assert!((moved.value - measured).abs() < 1e-6, "{moved:?}");
        }
        assert!(Alignment::new(Anchors::default(), 21, 21).unwrap().is_none());
    }

    #[test]
    fn nothing_to_align_changes_nothing() {
        let a = around(2.0, [0.0; 3]);
        for value in [0.3, 2.0, 9.0] {
            assert_eq!(a.apply((10, 8), answer(value)), answer(value));
        }
    }

    #[test]
    fn error_and_confidence_follow_the_shift() {
        let mut last = answer(2.0);
        for residual in [0.01, 0.05, 0.2, 1.0] {
            let moved = around(2.0, [residual; 3]).apply((10, 8), answer(2.0));
            assert!((moved.value - 2.0 - residual).abs() < 1e-5, "{moved:?}");
            assert!(moved.expected_error > 0.999 * residual && moved.expected_error > last.expected_error);
            assert!(moved.confidence < last.confidence, "{moved:?} after {last:?}");
            last = moved;
        }
        assert!(last.confidence < 0.2, "2.0 m at 0.95 became 3.0 m at {}", last.confidence);
        let sure = Reading { confidence: 1.0, expected_error: 0.0, ..answer(2.0) };
        let moved = around(2.0, [0.1; 3]).apply((10, 8), sure);
        assert!((0.3..0.9).contains(&moved.confidence) && moved.expected_error > 0.0999, "{moved:?}");
        let unsure = Reading { confidence: 0.0, ..answer(2.0) };
        assert_eq!(around(2.0, [0.1; 3]).apply((10, 8), unsure).confidence, 0.0);
    }

    #[test]
    fn corners_that_contradict_each_other_move_little_and_cost_confidence() {
        let together = around(2.0, [0.2, 0.2, 0.2]).apply((10, 8), answer(2.0));
        let apart = around(2.0, [0.5, -0.4, 0.4]).apply((10, 8), answer(2.0));
        assert!((apart.value - 2.0).abs() < 0.1 && (together.value - 2.2).abs() < 1e-5, "{apart:?}");
        assert!(apart.expected_error > together.expected_error);
        assert!(apart.confidence < together.confidence, "{apart:?} and {together:?}");
    }

    #[test]
    fn a_shift_is_bounded_by_the_answer() {
        let nearer = around(0.30, [-0.28; 3]).apply((10, 8), answer(0.30));
        assert_eq!(nearer.value, 0.15);
        assert!(nearer.confidence < 0.1 && nearer.expected_error > 0.2, "{nearer:?}");
        let farther = around(0.30, [20.0; 3]).apply((10, 8), answer(0.30));
        assert!((farther.value - 0.9).abs() < 1e-6, "{farther:?}");
    }

    #[test]
    fn another_surface_is_left_alone() {
        // Corners on a wall that the model draws too near, and an answer on something before it.
        let a = around(4.0, [0.5; 3]);
        let before = a.apply((10, 8), answer(1.0));
        assert!((before.value - 1.0).abs() < 1e-4 && (before.confidence - 0.95).abs() < 1e-3, "{before:?}");
        assert!((a.apply((10, 8), answer(4.1)).value - 4.6).abs() < 0.05);
    }

    #[test]
    fn unreadable_answers_are_no_anchors() {
        let mut all = Anchors::default();
        all.push((3, 3, 2.0), &Reading::INVALID);
        all.push((5, 3, 2.0), &Reading { value: 0.0, ..answer(1.0) });
        assert!(Alignment::new(all, 21, 21).unwrap().is_none());
    }
}
