//! Frames that follow each other, on the embedded checkpoint.

mod common;

use image::{Rgb, RgbImage};
use sdim::depth::sample_points;
use sdim::internals::scenes::Scene;
use sdim::{
    Camera, CancelToken, CompleteOptions, Completion, DepthCompleter, DepthMap, Distortion, Error, Outliers,
    QueryPlan, SparseDepth, Stream, StreamOptions, Transform, metrics,
};
use std::sync::LazyLock;

static TINY: LazyLock<DepthCompleter> =
    LazyLock::new(|| DepthCompleter::tiny_with(&common::load_options()).unwrap());

const SIZE: (usize, usize) = (160, 120);

fn complete(plan: QueryPlan) -> CompleteOptions {
    CompleteOptions::default().with_plan(plan).with_outliers(Outliers::Trust)
}

fn stream(completer: &DepthCompleter, camera: Option<Camera>) -> Stream {
    let mut options = StreamOptions::default().with_complete(complete(QueryPlan::Stride(4)));
    options.camera = camera;
    Stream::new(completer.clone(), options).unwrap()
}

/// One frame of a sequence.
struct Seen {
    rgb: RgbImage,
    truth: Vec<f32>,
    sparse: SparseDepth,
    pose: Transform,
}

/// A camera that goes to the right and turns to the left.
fn sequence(seed: u64, (width, height): (usize, usize), frames: usize, points: usize) -> (Camera, Vec<Seen>) {
    let scene = Scene::procedural(seed, width, height).unwrap();
    let camera = Camera::new(width, height, scene.intrinsics(), Distortion::None).unwrap();
    let mut depths = scene.render(&Transform::identity()).depth;
    depths.retain(|d| d.is_finite());
    depths.sort_by(f32::total_cmp);
    let step = 0.006 * f64::from(depths[depths.len() / 2]);
    let frame = |i: usize| {
        let half = -0.004 * i as f64;
        let place = [step * i as f64, 0.0, 0.5 * step * i as f64];
        let pose = Transform::from_quaternion([0.0, half.sin(), 0.0, half.cos()], place).unwrap();
        let frame = scene.render(&pose);
        let sparse = sample_points(&frame.depth, width, height, points, i as u64).unwrap();
        Seen { rgb: frame.rgb, truth: frame.depth, sparse, pose }
    };
    (camera, (0..frames).map(frame).collect())
}

fn error(done: &Completion, seen: &Seen) -> f64 {
    f64::from(metrics::errors(done.map.depth(), &seen.truth, &seen.sparse).unwrap().mae as f32)
}

fn bits(map: &DepthMap) -> Vec<u32> {
    let all = map.depth().iter().chain(map.confidence()).chain(map.expected_error());
    all.map(|v| v.to_bits()).collect()
}

#[test]
fn a_scene_that_stands_still_is_asked_less_and_known_as_well() {
    let (mut before, mut after) = (0.0, 0.0);
    for seed in [5_000_001, 5_000_002, 5_000_003] {
        let (_, frames) = sequence(seed, SIZE, 1, 60);
        let mut stream = stream(&TINY, None);
        let seen = &frames[0];
        let first = stream.push(&seen.rgb, &seen.sparse, None).unwrap();
        let alone = TINY.complete_detailed(&seen.rgb, &seen.sparse, &complete(QueryPlan::Stride(4))).unwrap();
        assert_eq!(bits(&first.map), bits(&alone.map), "the first frame is a frame alone");
        before += error(&first, seen);
        for _ in 0..3 {
            let next = stream.push(&seen.rgb, &seen.sparse, None).unwrap();
            assert!(next.asked * 2 < first.asked, "{} after {}", next.asked, first.asked);
            assert!(next.map.keeps(&seen.sparse) && next.map.valid() == SIZE.0 * SIZE.1);
            after += error(&next, seen) / 3.0;
        }
        stream.reset();
        let again = stream.push(&seen.rgb, &seen.sparse, None).unwrap();
        assert_eq!(bits(&again.map), bits(&first.map), "after a reset, as at first");
    }
    // What is asked anew every few frames sits beside what was carried, which costs a little at edges.
    assert!(after <= 1.04 * before, "MAE {after} after {before}");
}

#[test]
fn a_moving_camera_asks_less_than_half_at_no_more_error() {
    let (mut asked, mut errors) = ([0, 0], [0.0, 0.0]);
    for seed in [5_000_001, 5_000_002] {
        let (camera, frames) = sequence(seed, SIZE, 8, 60);
        let mut stream = stream(&TINY, Some(camera));
        for (i, seen) in frames.iter().enumerate() {
            let alone =
                TINY.complete_detailed(&seen.rgb, &seen.sparse, &complete(QueryPlan::Stride(4))).unwrap();
            let next = stream.push(&seen.rgb, &seen.sparse, Some(&seen.pose)).unwrap();
            assert!(next.map.keeps(&seen.sparse));
            if i > 0 {
                asked = [asked[0] + alone.asked, asked[1] + next.asked];
                errors = [errors[0] + error(&alone, seen), errors[1] + error(&next, seen)];
            }
        }
    }
    assert!(asked[1] * 2 < asked[0], "questions {asked:?}");
    assert!(errors[1] <= errors[0], "MAE {errors:?}");
}

#[test]
fn what_appears_is_seen() {
    let (_, frames) = sequence(5_000_001, SIZE, 1, 60);
    let seen = &frames[0];
    let mut stream = stream(&TINY, None);
    stream.push(&seen.rgb, &seen.sparse, None).unwrap();
    let still = stream.push(&seen.rgb, &seen.sparse, None).unwrap();
    // A box before all else, with one measurement on it.
    let nearest = seen.truth.iter().copied().filter(|d| d.is_finite()).fold(f32::INFINITY, f32::min);
    let inside = |x: usize, y: usize| (60..100).contains(&x) && (40..80).contains(&y);
    let mut rgb = seen.rgb.clone();
    for (x, y, pixel) in rgb.enumerate_pixels_mut().filter(|(x, y, _)| inside(*x as usize, *y as usize)) {
        *pixel = if (x / 5 + y / 5) % 2 == 0 { Rgb([250, 30, 200]) } else { Rgb([180, 10, 120]) };
    }
    let near = 0.6 * nearest;
    let points: Vec<_> = (seen.sparse.points())
        .filter(|p| !inside(p.0, p.1))
        .chain([(70, 50, near), (90, 50, near), (80, 70, near)])
        .collect();
    let sparse = SparseDepth::from_points(SIZE.0, SIZE.1, &points).unwrap();
    let next = stream.push(&rgb, &sparse, None).unwrap();
    let alone = TINY.complete_detailed(&rgb, &sparse, &complete(QueryPlan::Stride(4))).unwrap();
    assert!(next.asked > still.asked + 50, "the box's hundred pixels: {} {}", next.asked, still.asked);
    assert!(next.asked < alone.asked);
    let mean = |map: &DepthMap| {
        let depths = (45..75).flat_map(|y| (65..95).map(move |x| (x, y))).filter_map(|(x, y)| map.get(x, y));
        depths.map(f64::from).sum::<f64>() / 900.0
    };
    let (a, b) = (mean(&next.map), mean(&alone.map));
    assert!((a / b - 1.0).abs() < 0.1, "the box is at {a} m, in a frame alone at {b} m");
}

#[test]
fn a_frame_that_the_last_map_covers_needs_no_model() {
    for rest in [0, 1, 3] {
        let (mut asked, mut errors) = (Vec::new(), [0.0, 0.0]);
        for seed in [5_000_001, 5_000_002] {
            let (camera, frames) = sequence(seed, SIZE, 6, 60);
            let options = StreamOptions::default()
                .with_complete(complete(QueryPlan::Stride(4)))
                .with_camera(camera)
                .with_rest(rest);
            let mut stream = Stream::new(TINY.clone(), options).unwrap();
            for seen in &frames {
                let next = stream.push(&seen.rgb, &seen.sparse, Some(&seen.pose)).unwrap();
                assert!(next.map.keeps(&seen.sparse) && next.map.valid() == SIZE.0 * SIZE.1);
                asked.push(next.asked);
                if next.asked == 0 {
                    let alone = complete(QueryPlan::Stride(4));
                    let alone = TINY.complete_detailed(&seen.rgb, &seen.sparse, &alone).unwrap();
                    errors = [errors[0] + error(&alone, seen), errors[1] + error(&next, seen)];
                }
            }
        }
        let silent = |w: &[usize]| w.iter().all(|&n| n == 0);
        assert_eq!(asked.contains(&0), rest > 0, "{asked:?}");
        assert!(!asked.windows(rest + 1).any(silent), "no more than {rest} in a row: {asked:?}");
        assert!(errors[1] <= errors[0], "MAE {errors:?}");
    }
}

#[test]
fn what_contradicts_the_last_map_is_asked_about_at_once() {
    let (_, frames) = sequence(5_000_001, SIZE, 1, 60);
    let seen = &frames[0];
    let asked_of = |rgb: &RgbImage, sparse: &SparseDepth| {
        let mut stream = stream(&TINY, None);
        stream.push(&seen.rgb, &seen.sparse, None).unwrap();
        stream.push(rgb, sparse, None).unwrap().asked
    };
    assert_eq!(asked_of(&seen.rgb, &seen.sparse), 0, "the same frame again");
    // A pane of glass comes to stand there: the picture is as before.
    let near = |(x, y, depth)| (x, y, if x < SIZE.0 / 3 { 0.5 * depth } else { depth });
    let points: Vec<_> = seen.sparse.points().map(near).collect();
    let sparse = SparseDepth::from_points(SIZE.0, SIZE.1, &points).unwrap();
    assert!(asked_of(&seen.rgb, &sparse) > 0);
    // Something else is seen in a twelfth of the picture, where nothing is measured.
    let mut rgb = seen.rgb.clone();
    let inside = |x: u32, y: u32| (60..100).contains(&x) && (40..80).contains(&y);
    rgb.enumerate_pixels_mut()
        .filter(|(x, y, _)| inside(*x, *y))
        .for_each(|(_, _, p)| *p = Rgb([250, 30, 200]));
    let outside = seen.sparse.points().filter(|p| !inside(p.0 as u32, p.1 as u32));
    let sparse = SparseDepth::from_points(SIZE.0, SIZE.1, &outside.collect::<Vec<_>>()).unwrap();
    assert!(asked_of(&rgb, &sparse) > 0);
}

#[test]
fn the_same_frames_give_the_same_maps_on_any_thread() {
    let (camera, frames) = sequence(5_000_001, (64, 48), 4, 20);
    let maps = |completer: DepthCompleter| -> Vec<Vec<u32>> {
        let mut stream = stream(&completer, Some(camera));
        let next = |seen: &Seen| bits(&stream.push(&seen.rgb, &seen.sparse, Some(&seen.pose)).unwrap().map);
        frames.iter().map(next).collect()
    };
    let one = maps(TINY.clone());
    std::thread::scope(|scope| {
        let threads: Vec<_> = (0..8).map(|_| scope.spawn(|| maps(TINY.clone()))).collect();
        for thread in threads {
            assert!(thread.join().unwrap() == one, "a thread's maps are others");
        }
    });
}

#[test]
fn frames_of_another_size_begin_anew() {
    let mut stream = stream(&TINY, None);
    for (width, height) in [(64, 48), (96, 64), (64, 48)] {
        let (_, frames) = sequence(5_000_001, (width, height), 1, 20);
        let (rgb, sparse) = (&frames[0].rgb, &frames[0].sparse);
        let alone = TINY.complete_detailed(rgb, sparse, &complete(QueryPlan::Stride(4))).unwrap();
        let next = stream.push(rgb, sparse, None).unwrap();
        assert_eq!((next.asked, bits(&next.map)), (alone.asked, bits(&alone.map)));
    }
}

#[test]
fn every_plan_follows() {
    let (camera, frames) = sequence(5_000_001, (64, 48), 3, 20);
    let long = QueryPlan::Deadline(std::time::Duration::from_secs(600));
    for plan in [QueryPlan::Every, QueryPlan::Budget(200), long] {
        let options = StreamOptions::default().with_complete(complete(plan)).with_camera(camera);
        let mut stream = Stream::new(TINY.clone(), options).unwrap();
        for (i, seen) in frames.iter().enumerate() {
            let next = stream.push(&seen.rgb, &seen.sparse, Some(&seen.pose)).unwrap();
            assert_eq!(next.map.valid(), 64 * 48, "{plan}, frame {i}");
            let alone = TINY.complete_detailed(&seen.rgb, &seen.sparse, &complete(plan)).unwrap();
            assert!(i == 0 || next.asked < alone.asked, "{plan}: {} and {}", next.asked, alone.asked);
        }
    }
}

#[test]
fn bad_input_is_an_error_and_changes_nothing() {
    let (camera, frames) = sequence(5_000_001, (64, 48), 1, 20);
    let (seen, identity) = (&frames[0], Transform::identity());
    let mut blind = stream(&TINY, None);
    let refused = blind.push(&seen.rgb, &seen.sparse, Some(&identity));
    assert!(matches!(refused, Err(Error::Argument { name: "pose", .. })));
    let other = Camera::new(65, 48, camera.intrinsics(), Distortion::None).unwrap();
    let mut wide = stream(&TINY, Some(other));
    let refused = wide.push(&seen.rgb, &seen.sparse, Some(&identity));
    assert!(matches!(refused, Err(Error::Argument { name: "camera", .. })));
    for half_life in [0.0, -1.0, f32::NAN, f32::INFINITY] {
        let options = StreamOptions::default().with_half_life(half_life);
        assert!(matches!(Stream::new(TINY.clone(), options), Err(Error::Argument { .. })), "{half_life}");
    }
    let mut stream = stream(&TINY, Some(camera));
    let first = stream.push(&seen.rgb, &seen.sparse, Some(&identity)).unwrap();
    let short = SparseDepth::from_points(63, 48, &[(5, 5, 2.0)]).unwrap();
    assert!(matches!(stream.push(&seen.rgb, &short, None), Err(Error::SizeMismatch { .. })));
    let token = CancelToken::default();
    token.cancel();
    stream.set_cancel(Some(token));
    assert!(matches!(stream.push(&seen.rgb, &seen.sparse, Some(&identity)), Err(Error::Cancelled)));
    stream.set_cancel(None);
    let next = stream.push(&seen.rgb, &seen.sparse, Some(&identity)).unwrap();
    assert!(next.asked < first.asked, "the frame before the failures still counts");
    // Nothing is in view any more, and nothing is made up of what was.
    let behind = Transform::from_quaternion([0.0, 1.0, 0.0, 0.0], [0.0; 3]).unwrap();
    let turned = stream.push(&seen.rgb, &seen.sparse, Some(&behind)).unwrap();
    assert_eq!(turned.map.valid(), 64 * 48);
    assert!(turned.asked > next.asked);
}
