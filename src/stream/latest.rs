//! The newest frame first, when frames come faster than they are completed.

use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};

/// A place for one frame, between the thread that gets frames and the one that completes them: a frame that still waits when the next one
/// comes gives way to it.
///
/// ```
/// let (frames, worker) = sdim::Latest::new();
/// let completing = std::thread::spawn(move || {
///     let mut last = 0;
///     while let Some(frame) = worker.next() {
///         assert!(frame > last, "in order; some are left out");
///         last = frame;
///     }
///     last
/// });
/// for frame in 1..=100 {
///     frames.submit(frame).expect("the worker lives");
/// }
/// drop(frames); // no more frames; the one that waits is still completed
/// assert_eq!(completing.join().unwrap(), 100);
/// ```
#[derive(Debug)]
pub struct Latest<T>(Arc<Place<T>>);

/// The end of a [`Latest`] where frames are taken.
#[derive(Debug)]
pub struct LatestFrames<T>(Arc<Place<T>>);

#[derive(Debug)]
struct Place<T> {
    state: Mutex<State<T>>,
    changed: Condvar,
}

#[derive(Debug)]
struct State<T> {
    waiting: Option<T>,
    /// One of both ends is gone.
    ended: bool,
}

impl<T> Place<T> {
    fn state(&self) -> MutexGuard<'_, State<T>> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn end(&self) {
        self.state().ended = true;
        self.changed.notify_all();
    }
}

impl<T> Latest<T> {
    /// Both ends.
    #[allow(clippy::new_ret_no_self)]
    pub fn new() -> (Self, LatestFrames<T>) {
        let state = Mutex::new(State { waiting: None, ended: false });
        let place = Arc::new(Place { state, changed: Condvar::new() });
        (Self(place.clone()), LatestFrames(place))
    }

    /// Puts a frame into the place, without waiting; the one that gives way to it is given back.
    ///
    /// # Errors
    /// The frame itself, when nobody is left to take it.
    pub fn submit(&self, frame: T) -> Result<Option<T>, T> {
        let mut state = self.0.state();
        if state.ended {
            return Err(frame);
        }
        let late = state.waiting.replace(frame);
        drop(state);
        self.0.changed.notify_one();
        Ok(late)
    }
}

impl<T> LatestFrames<T> {
    /// The frame that waits, or the next one that comes; `None` when no more will come.
    pub fn next(&self) -> Option<T> {
        let mut state = self.0.state();
        loop {
            if let Some(frame) = state.waiting.take() {
                return Some(frame);
            }
            if state.ended {
                return None;
            }
            state = self.0.changed.wait(state).unwrap_or_else(PoisonError::into_inner);
        }
    }

    /// The frame that waits, if there is one.
    pub fn try_next(&self) -> Option<T> {
        self.0.state().waiting.take()
    }
}

impl<T> Drop for Latest<T> {
    fn drop(&mut self) {
        self.0.end();
    }
}

impl<T> Drop for LatestFrames<T> {
    fn drop(&mut self) {
        self.0.end();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_newer_frame_takes_the_place_of_one_that_waits() {
        let (frames, worker) = Latest::new();
        assert_eq!(worker.try_next(), None);
        assert_eq!(frames.submit(1), Ok(None));
        assert_eq!(frames.submit(2), Ok(Some(1)));
        assert_eq!(frames.submit(3), Ok(Some(2)));
        assert_eq!(worker.next(), Some(3));
        assert_eq!(worker.try_next(), None);
        assert_eq!(frames.submit(4), Ok(None));
        drop(frames);
        assert_eq!((worker.next(), worker.next()), (Some(4), None), "the last one is not lost");
    }

    #[test]
    fn a_frame_that_nobody_takes_comes_back() {
        let (frames, worker) = Latest::new();
        drop(worker);
        assert_eq!(frames.submit("frame"), Err("frame"));
    }

    #[test]
    fn a_worker_that_waits_gets_the_frame_that_comes_and_the_end() {
        let (frames, worker) = Latest::new();
        let (taken, seen) = std::sync::mpsc::channel();
        let thread = std::thread::spawn(move || {
            while let Some(frame) = worker.next() {
                taken.send(frame).unwrap();
            }
        });
        // Each one is taken before the next one comes.
        for frame in 0..50 {
            assert_eq!(frames.submit(frame), Ok(None));
            assert_eq!(seen.recv(), Ok(frame));
        }
        drop(frames);
        thread.join().unwrap();
    }
}
