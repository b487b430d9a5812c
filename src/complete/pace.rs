//! How fast this machine is, learnt while it completes frames.

use super::clock::Watch;
use super::stages::StageSeconds;
use std::sync::{Mutex, PoisonError};

/// Seconds of the stages, as they were last.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Seconds {
    /// Check, encoding and prefill, per pixel of the frame; `None` before the first frame.
    pub(super) prefix: Option<f64>,
    /// One answer, in a batch.
    pub(super) answer: Option<f64>,
    /// Alignment, filter and filling, per pixel of the frame.
    refine: f64,
    /// Interpolation of the measurements, per pixel of the frame.
    interpolation: f64,
}

/// What refinement and interpolation are taken to cost before they were seen, seconds per pixel: 60 and 30 ms for 640x480.
const UNSEEN_REFINE: f64 = 2e-7;
const UNSEEN_INTERPOLATION: f64 = 1e-7;

/// What comes last is given so much more time than it took before: nothing can be left out any more when it takes longer.
const MARGIN: f64 = 1.15;

/// So many answers of a frame say what one costs; fewer are a small batch, which is slower.
const ENOUGH: usize = 64;

/// What is left of the known time of a prefix after a frame that had no time for it. So one frame in 14 is tried where a prefix takes one and a
/// half times what there is, one in 23 where it takes twice that.
const AFTER_SKIP: f64 = 0.97;

/// A prefix that was interrupted takes longer than it had; it is taken to need so many times that.
const INTERRUPTED: f64 = 1.5;

impl Seconds {
    /// To keep for making a map of the answers.
    pub(super) fn refining(&self, pixels: usize) -> f64 {
        MARGIN * self.refine * pixels as f64
    }

    /// To keep for making a map of the measurements alone.
    pub(super) fn interpolating(&self, pixels: usize) -> f64 {
        MARGIN * self.interpolation * pixels as f64
    }
}

/// The pace of one loaded model, shared by its clones.
#[derive(Default)]
pub(super) struct Pace {
    watch: Watch,
    seconds: Mutex<Seconds>,
}

impl Default for Seconds {
    fn default() -> Self {
        Self { prefix: None, answer: None, refine: UNSEEN_REFINE, interpolation: UNSEEN_INTERPOLATION }
    }
}

/// Half of what was known and half of what is new, so that one slow frame does not rule.
fn mix(old: Option<f64>, new: f64) -> f64 {
    old.map_or(new, |old| 0.5 * (old + new))
}

/// What is known, if it is more than what was taken for granted.
fn seen(known: f64, unseen: f64) -> Option<f64> {
    (known != unseen).then_some(known)
}

impl Pace {
    #[cfg(test)]
    pub(super) fn by(watch: Watch) -> Self {
        Self { watch, ..Self::default() }
    }

    pub(super) fn watch(&self) -> &Watch {
        &self.watch
    }

    pub(super) fn seconds(&self) -> Seconds {
        *self.seconds.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn change(&self, change: impl FnOnce(&mut Seconds)) {
        change(&mut self.seconds.lock().unwrap_or_else(PoisonError::into_inner));
    }

    /// Takes note of a frame that was left to interpolation: a machine that was slow once is tried again after some of them.
    pub(super) fn skipped(&self) {
        self.change(|known| known.prefix = known.prefix.map(|seconds| seconds * AFTER_SKIP));
    }

    /// Takes note of a prefix that was not done after so many seconds.
    pub(super) fn interrupted(&self, pixels: usize, seconds: f64) {
        let least = INTERRUPTED * seconds / pixels.max(1) as f64;
        self.change(|known| known.prefix = Some(known.prefix.map_or(least, |seconds| seconds.max(least))));
    }

    /// Takes note of how long the measurements of a frame took to interpolate.
    pub(super) fn interpolated(&self, pixels: usize, seconds: f64) {
        let new = seconds / pixels.max(1) as f64;
        self.change(|known| {
            known.interpolation = mix(seen(known.interpolation, UNSEEN_INTERPOLATION), new);
        });
    }

    /// Takes note of a frame, of which so many answers took so many seconds.
    pub(super) fn learn(&self, pixels: usize, stages: &StageSeconds, (answers, seconds): (usize, f64)) {
        let pixels = pixels.max(1) as f64;
        self.change(|known| {
            known.prefix = Some(mix(known.prefix, (stages.check + stages.encode + stages.prefill) / pixels));
            if answers >= ENOUGH || (answers > 0 && known.answer.is_none()) {
                known.answer = Some(mix(known.answer, seconds / answers as f64));
            }
            if stages.refine > 0.0 {
                known.refine = mix(seen(known.refine, UNSEEN_REFINE), stages.refine / pixels);
            }
        });
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_pace_is_learnt_and_follows_the_machine() {
        let pace = Pace::default();
        assert_eq!(pace.seconds(), Seconds::default());
        let stages =
            StageSeconds { check: 0.1, encode: 0.2, prefill: 0.1, queries: 2.0, refine: 0.3, total: 2.7 };
        pace.learn(1000, &stages, (100, 2.0));
        let first = pace.seconds();
        assert!((first.prefix.unwrap() - 4e-4).abs() < 1e-12 && (first.answer.unwrap() - 0.02).abs() < 1e-12);
        assert!((first.refining(1000) - 0.3 * MARGIN).abs() < 1e-12);
        let slower = StageSeconds { refine: 0.9, ..stages };
        pace.learn(1000, &slower, (100, 4.0));
        assert!((pace.seconds().answer.unwrap() - 0.03).abs() < 1e-12);
        assert!((pace.seconds().refining(1000) - 0.6 * MARGIN).abs() < 1e-12);
        pace.learn(1000, &slower, (3, 4.0));
        assert!((pace.seconds().answer.unwrap() - 0.03).abs() < 1e-12, "few answers are slow ones");
        pace.interpolated(1000, 0.2);
        pace.interpolated(1000, 0.4);
        assert!((pace.seconds().interpolating(1000) - 0.3 * MARGIN).abs() < 1e-12);
    }

    #[test]
    fn a_model_that_only_has_time_for_few_answers_learns_from_them() {
        let pace = Pace::default();
        pace.learn(1000, &StageSeconds::default(), (0, 0.0));
        assert_eq!(pace.seconds().answer, None);
        pace.learn(1000, &StageSeconds::default(), (4, 2.0));
        assert_eq!(pace.seconds().answer, Some(0.5));
    }

    #[test]
    fn a_frame_that_was_not_refined_says_nothing_of_that() {
        let pace = Pace::default();
        pace.learn(1000, &StageSeconds { refine: 0.5, ..Default::default() }, (0, 0.0));
        let known = pace.seconds().refine;
        pace.learn(1000, &StageSeconds { encode: 1.0, ..Default::default() }, (0, 0.0));
        assert_eq!(pace.seconds().refine, known);
    }

    #[test]
    fn one_slow_frame_does_not_end_the_asking() {
        let pace = Pace::default();
        pace.skipped();
        assert_eq!(pace.seconds().prefix, None);
        pace.interrupted(1, 1.0);
        assert_eq!(pace.seconds().prefix, Some(1.5), "longer than it had");
        for _ in 0..14 {
            pace.skipped();
        }
        assert!((0.9..1.0).contains(&pace.seconds().prefix.unwrap()));
        pace.interrupted(1, 0.1);
        assert!(pace.seconds().prefix.unwrap() > 0.9, "what is known is not forgotten for less");
    }
}
