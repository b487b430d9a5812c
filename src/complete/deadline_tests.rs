//! Deadlines by a clock that the tests run, so that no other work of the machine is in the way.

use super::clock::Watch;
use super::pace::Pace;
use super::*;
use std::sync::Mutex;
use std::time::Duration;

/// A machine whose time goes on by looking at it, as between the layers of a model, and by answers.
#[derive(Clone, Copy, Debug)]
struct Machine {
    /// Seconds that a look takes.
    look: f64,
    /// Seconds that an answer takes.
    answer: f64,
}

/// A frame, and what completes it on a made machine.
struct Made {
    now: Arc<Mutex<f64>>,
    machine: Arc<Mutex<Machine>>,
    completer: DepthCompleter,
    rgb: RgbImage,
    sparse: SparseDepth,
}

impl Made {
    fn new(machine: Machine) -> Self {
        let (now, machine) = (Arc::new(Mutex::new(0.0)), Arc::new(Mutex::new(machine)));
        let (time, of) = (now.clone(), machine.clone());
        let watch = Watch::Made(Arc::new(move || {
            let mut time = time.lock().unwrap();
            *time += of.lock().unwrap().look;
            *time
        }));
        let model = DepthCompleter::tiny().unwrap().model;
        let completer = DepthCompleter { model, pace: Arc::new(Pace::by(watch)) };
        let (width, height) = (96, 64);
        let rgb = RgbImage::from_fn(width, height, |x, y| image::Rgb([x as u8, y as u8, 90]));
        let points: Vec<_> = (0..20).map(|i| (i * 4 + 3, (i * 7) % 64, 1.0 + 0.1 * i as f32)).collect();
        let sparse = SparseDepth::from_points(width as usize, height as usize, &points).unwrap();
        Self { now, machine, completer, rgb, sparse }
    }

    /// Completes the frame until a deadline; what it took, by the made clock.
    fn complete(&self, time: f64) -> (Completion, f64) {
        let (now, machine, seen) = (self.now.clone(), self.machine.clone(), Mutex::new(0));
        let options = CompleteOptions::default()
            .with_plan(QueryPlan::Deadline(Duration::from_secs_f64(time)))
            .with_outliers(Outliers::Trust)
            .with_progress(move |p| {
                let mut seen = seen.lock().unwrap();
                *now.lock().unwrap() += machine.lock().unwrap().answer * (p.answered - *seen) as f64;
                *seen = p.answered;
            });
        let before = *self.now.lock().unwrap();
        let done = self.completer.complete_detailed(&self.rgb, &self.sparse, &options).unwrap();
        assert_eq!(done.map.valid(), self.sparse.width() * self.sparse.height(), "a whole map");
        assert!(done.map.keeps(&self.sparse));
        let took = *self.now.lock().unwrap() - before;
        (done, took)
    }
}

/// What a frame may take: 1.1 of the deadline, one batch (a twentieth of the deadline or four answers), and what is looked at last.
fn most(time: f64, machine: Machine) -> f64 {
    1.1 * time + (0.05 * time).max(4.0 * machine.answer) + 8.0 * machine.look
}

const ROBOT: Machine = Machine { look: 0.004, answer: 4e-5 };
/// A large model on a small machine: seconds for a layer, half a second for an answer.
const LARGE: Machine = Machine { look: 0.8, answer: 0.45 };

#[test]
fn deadlines_are_kept_from_the_first_frame_on() {
    for (machine, times) in [(ROBOT, &[0.05, 0.1, 0.2, 0.5][..]), (LARGE, &[10.0, 30.0, 60.0])] {
        for &time in times {
            let made = Made::new(machine);
            for frame in 0..40 {
                let (done, took) = made.complete(time);
                assert!(took <= most(time, machine), "{took} s of {time} s, frame {frame}, {machine:?}");
                if time >= 0.2 && time != 10.0 {
                    assert!(done.asked > 0, "{time} s, frame {frame}, {machine:?}");
                }
            }
        }
    }
}

#[test]
fn the_time_is_used() {
    let made = Made::new(ROBOT);
    for frame in 0..6 {
        let (done, took) = made.complete(0.2);
        assert!(took > 0.7 * 0.2, "frame {frame} was done after {took} s, with {} answers", done.asked);
    }
}

#[test]
fn a_machine_that_slows_down_makes_one_frame_late_by_a_batch_and_recovers() {
    let made = Made::new(ROBOT);
    (0..5).for_each(|_| drop(made.complete(0.2)));
    let slow = Machine { look: 3.0 * ROBOT.look, answer: 20.0 * ROBOT.answer };
    *made.machine.lock().unwrap() = slow;
    for frame in 0..30 {
        let (_, took) = made.complete(0.2);
        // Of the first of these frames a batch is as large as it was for the fast machine.
        let batch = if frame == 0 { 0.05 * 0.2 * 20.0 } else { 0.0 };
        assert!(took <= most(0.2, slow) + batch, "{took} s, frame {frame}");
    }
    *made.machine.lock().unwrap() = ROBOT;
    let asked = (0..40).filter(|_| made.complete(0.2).0.asked > 0).count();
    assert!(asked >= 20, "{asked} of 40 frames are asked about again");
}

#[test]
fn who_cancels_is_heard_between_layers() {
    let made = Made::new(ROBOT);
    let token = CancelToken::default();
    token.cancel();
    let options = CompleteOptions::default().with_cancel(token);
    let before = *made.now.lock().unwrap();
    let refused = made.completer.complete(&made.rgb, &made.sparse, &options);
    assert!(matches!(refused, Err(Error::Cancelled)));
    assert!(*made.now.lock().unwrap() - before < 8.0 * ROBOT.look, "long before the prefix is read");
}
