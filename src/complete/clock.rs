//! What time it is, and when a frame has to be done.

use std::sync::LazyLock;
use std::time::{Duration, Instant};

/// The machine's time begins here.
static START: LazyLock<Instant> = LazyLock::new(Instant::now);

/// Where the time comes from: from the machine, but in tests, which make their own.
#[derive(Clone, Default)]
pub(super) enum Watch {
    #[default]
    Machine,
    #[cfg(test)]
    Made(std::sync::Arc<dyn Fn() -> f64 + Send + Sync>),
}

impl Watch {
    /// Seconds since some moment.
    pub(super) fn now(&self) -> f64 {
        match self {
            Self::Machine => START.elapsed().as_secs_f64(),
            #[cfg(test)]
            Self::Made(now) => now(),
        }
    }

    /// Seconds since it was `then`.
    pub(super) fn since(&self, then: f64) -> f64 {
        self.now() - then
    }
}

/// When a frame has to be done.
#[derive(Clone, Copy)]
pub(super) struct Clock<'a> {
    watch: &'a Watch,
    start: f64,
    time: f64,
}

impl<'a> Clock<'a> {
    /// So much time after it was `start`.
    pub(super) fn new(watch: &'a Watch, start: f64, time: Duration) -> Self {
        Self { watch, start, time: time.as_secs_f64() }
    }

    /// Seconds until then, less than 0 afterwards.
    pub(super) fn left(&self) -> f64 {
        self.time - self.watch.since(self.start)
    }

    /// How many answers of so many seconds each fit into the time that is left, `reserved` seconds kept; less than 0 afterwards.
    pub(super) fn fits(&self, reserved: f64, answer: f64) -> f64 {
        (self.left() - reserved) / answer.max(1e-9)
    }

    /// All of it, seconds.
    pub(super) fn all(&self) -> f64 {
        self.time
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_clock_runs_out() {
        let watch = Watch::default();
        let clock = Clock::new(&watch, watch.now(), Duration::from_millis(5));
        assert!(clock.left() <= 0.005 && clock.all() == 0.005);
        std::thread::sleep(Duration::from_millis(6));
        assert!(clock.left() < 0.0 && clock.fits(0.0, 1.0) < 0.0);
    }
}
