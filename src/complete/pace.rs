//! How fast this machine is, learnt while it completes frames.

use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant};

/// Seconds of the stages, as they were last.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Seconds {
    /// Check, encoding and prefill, per pixel of the frame; `None` before the first frame.
    pub(super) prefix: Option<f64>,
    /// One answer, in a batch.
    pub(super) answer: Option<f64>,
    /// Alignment, filter and filling, per pixel of the frame.
    pub(super) refine: f64,
}

/// What refinement is taken to cost before it was seen, seconds per pixel: 60 ms for 640x480.
const UNSEEN_REFINE: f64 = 2e-7;

/// So many answers of a frame say what one costs; fewer carry too much of what a frame costs in any case.
const ENOUGH: usize = 64;

/// What is left of the known time of a prefix after a frame that had no time for it. So one frame in 14 is tried, and late, where a prefix takes
/// one and a half times what there is, one in 23 where it takes twice that.
const AFTER_SKIP: f64 = 0.97;

/// The pace of one loaded model, shared by its clones.
pub(super) struct Pace(Mutex<Seconds>);

impl Default for Pace {
    fn default() -> Self {
        Self(Mutex::new(Seconds { prefix: None, answer: None, refine: UNSEEN_REFINE }))
    }
}

impl Pace {
    pub(super) fn seconds(&self) -> Seconds {
        *self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Takes note of a frame that was left to interpolation: a machine that was slow once is tried again after some of them.
    pub(super) fn skipped(&self) {
        let mut known = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        known.prefix = known.prefix.map(|seconds| seconds * AFTER_SKIP);
    }

    /// Takes note of a frame. What is new counts half, so that one slow frame does not rule.
    pub(super) fn learn(&self, pixels: usize, stages: &super::StageSeconds, asked: usize) {
        let mut known = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let mix = |old: Option<f64>, new: f64| old.map_or(new, |old| 0.5 * (old + new));
        let pixels = pixels.max(1) as f64;
        known.prefix = Some(mix(known.prefix, (stages.check + stages.encode + stages.prefill) / pixels));
        if asked >= ENOUGH {
            known.answer = Some(mix(known.answer, stages.queries / asked as f64));
        }
        if stages.refine > 0.0 {
            let seen = (known.refine != UNSEEN_REFINE).then_some(known.refine);
            known.refine = mix(seen, stages.refine / pixels);
        }
    }
}

/// When a frame has to be done.
#[derive(Debug, Clone, Copy)]
pub(super) struct Clock {
    start: Instant,
    time: Duration,
}

impl Clock {
    pub(super) fn new(start: Instant, time: Duration) -> Self {
        Self { start, time }
    }

    /// Seconds until then, less than 0 afterwards.
    pub(super) fn left(&self) -> f64 {
        self.time.as_secs_f64() - self.start.elapsed().as_secs_f64()
    }

    /// How many answers of so many seconds each fit into the time that is left, `reserved` seconds kept; less than 0 afterwards.
    pub(super) fn fits(&self, reserved: f64, answer: f64) -> f64 {
        (self.left() - reserved) / answer.max(1e-9)
    }

    /// All of it, seconds.
    pub(super) fn all(&self) -> f64 {
        self.time.as_secs_f64()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::complete::StageSeconds;

    #[test]
    fn a_pace_is_learnt_and_follows_the_machine() {
        let pace = Pace::default();
        assert_eq!(pace.seconds(), Seconds { prefix: None, answer: None, refine: UNSEEN_REFINE });
        let stages =
            StageSeconds { check: 0.1, encode: 0.2, prefill: 0.1, queries: 2.0, refine: 0.3, total: 2.7 };
        pace.learn(1000, &stages, 100);
        let first = pace.seconds();
        assert!((first.prefix.unwrap() - 4e-4).abs() < 1e-12 && (first.answer.unwrap() - 0.02).abs() < 1e-12);
        assert!((first.refine - 3e-4).abs() < 1e-12);
        let slower = StageSeconds { queries: 4.0, refine: 0.9, ..stages };
        pace.learn(1000, &slower, 100);
        assert!((pace.seconds().answer.unwrap() - 0.03).abs() < 1e-12);
        assert!((pace.seconds().refine - 6e-4).abs() < 1e-12);
        pace.learn(1000, &slower, 0);
        assert!(
            (pace.seconds().answer.unwrap() - 0.03).abs() < 1e-12,
            "no question says nothing of questions"
        );
    }

    #[test]
    fn a_frame_that_was_not_refined_says_nothing_of_that() {
        let pace = Pace::default();
        pace.learn(1000, &StageSeconds { refine: 0.5, ..Default::default() }, 0);
        let known = pace.seconds().refine;
        pace.learn(1000, &StageSeconds { encode: 1.0, ..Default::default() }, 0);
        assert_eq!(pace.seconds().refine, known);
    }

    #[test]
    fn one_slow_frame_does_not_end_the_asking() {
        let pace = Pace::default();
        pace.skipped();
        assert_eq!(pace.seconds().prefix, None);
        pace.learn(1, &StageSeconds { encode: 1.0, ..Default::default() }, 0);
        for _ in 0..14 {
            pace.skipped();
        }
        assert!((0.6..0.67).contains(&pace.seconds().prefix.unwrap()));
    }

    #[test]
    fn a_clock_runs_out() {
        let clock = Clock::new(Instant::now(), Duration::from_millis(5));
        assert!(clock.left() <= 0.005 && clock.all() == 0.005);
        std::thread::sleep(Duration::from_millis(6));
        assert!(clock.left() < 0.0);
    }
}
