//! The promises of `DepthCompleter::complete`, on the embedded checkpoint.

mod common;

use image::RgbImage;
use sdim::depth::sample_points;
use sdim::internals::scenes::procedural;
use sdim::{
    CompleteOptions, DepthCompleter, DepthMap, DepthScale, Error, Outliers, Preserve, QueryPlan, SparseDepth,
    read_rgb,
};
use std::sync::{Arc, LazyLock, Mutex};

static TINY: LazyLock<DepthCompleter> =
    LazyLock::new(|| DepthCompleter::tiny_with(&common::load_options()).unwrap());

fn options(plan: QueryPlan) -> CompleteOptions {
    CompleteOptions::default().with_plan(plan)
}

fn frame(points: usize) -> (RgbImage, SparseDepth, Vec<f32>) {
    let frame = procedural(3_000_001, 160, 120).unwrap();
    let sparse = sample_points(&frame.depth, 160, 120, points, 1).unwrap();
    (frame.rgb, sparse, frame.depth)
}

fn assert_complete(map: &DepthMap, sparse: &SparseDepth) {
    assert_eq!(map.valid(), map.width() * map.height(), "all pixels valid");
    assert!(map.keeps(sparse), "measured pixels bit for bit");
    assert!(map.confidence().iter().all(|c| (0.0..=1.0).contains(c)));
    for (x, y, _) in sparse.points() {
        assert_eq!(map.confidence()[y * map.width() + x], 1.0);
    }
}

#[test]
fn every_plan_gives_a_complete_map_that_keeps_the_measurements() {
    let (rgb, sparse, _) = frame(200);
    for plan in [QueryPlan::Every, QueryPlan::Stride(3), QueryPlan::Stride(64), QueryPlan::Budget(700)] {
        let done = TINY.complete_detailed(&rgb, &sparse, &options(plan)).unwrap();
        assert_complete(&done.map, &sparse);
    }
}

#[test]
fn a_budget_is_spent_to_the_last_question() {
    let (rgb, sparse, _) = frame(200);
    for (budget, preserve) in
        [(40, Preserve::Keep), (700, Preserve::Keep), (4000, Preserve::Keep), (700, Preserve::Ask)]
    {
        let plan = options(QueryPlan::Budget(budget));
        let spending = plan.with_preserve(preserve).with_outliers(Outliers::Trust);
        let done = TINY.complete_detailed(&rgb, &sparse, &spending).unwrap();
        assert_eq!(done.asked, budget + sparse.measured(), "{budget} and the alignment");
        assert_eq!(done.map.valid(), 160 * 120);
    }
    let all = options(QueryPlan::Budget(90_000)).with_outliers(Outliers::Trust).with_align(false);
    let done = TINY.complete_detailed(&rgb, &sparse, &all).unwrap();
    assert_eq!(done.asked, 160 * 120 - sparse.measured(), "all that there is to ask");
}

#[test]
fn the_same_frame_gives_the_same_map() {
    let (rgb, sparse, _) = frame(150);
    let a = TINY.complete(&rgb, &sparse, &options(QueryPlan::Stride(8))).unwrap();
    let b = TINY.clone().complete(&rgb, &sparse, &options(QueryPlan::Stride(8))).unwrap();
    assert_eq!(a.depth(), b.depth());
}

#[test]
fn preserve_ask_lets_the_model_speak_at_measured_pixels() {
    let (rgb, sparse, _) = frame(100);
    let ask = options(QueryPlan::Every).with_preserve(Preserve::Ask).with_align(false);
    let map = TINY.complete(&rgb, &sparse, &ask).unwrap();
    assert!(map.measured().iter().all(|m| !m));
    let kept = sparse.points().filter(|&(x, y, d)| map.get(x, y) == Some(d)).count();
    assert!(kept < sparse.measured());
    let aligned = TINY.complete(&rgb, &sparse, &ask.with_align(true)).unwrap();
    let off = |m: &DepthMap| -> f32 {
        sparse.points().map(|(x, y, d)| (m.get(x, y).unwrap_or(0.0) - d).abs()).sum()
    };
    assert!(off(&aligned) < 0.2 * off(&map), "{} vs {}", off(&aligned), off(&map));
}

#[test]
fn beats_linear_interpolation_on_held_out_scenes() {
    let (mut model, mut linear) = (0.0, 0.0);
    for seed in 3_000_010..3_000_018 {
        let frame = procedural(seed, 320, 240).unwrap();
        let sparse = sample_points(&frame.depth, 320, 240, 100, seed).unwrap();
        let map = TINY.complete(&frame.rgb, &sparse, &options(QueryPlan::Stride(4))).unwrap();
        let mae = |d: &[f32]| sdim::metrics::errors(d, &frame.depth, &sparse).unwrap().mae;
        model += mae(map.depth());
        linear += mae(&sdim::depth::interpolate::linear(&sparse).unwrap());
    }
    assert!(model < 0.8 * linear, "model {model}, linear {linear}");
}

#[test]
fn one_point_and_all_points_give_sensible_maps() {
    let (rgb, _, depth) = frame(1);
    let one = SparseDepth::from_points(160, 120, &[(80, 60, 2.0)]).unwrap();
    let map = TINY.complete(&rgb, &one, &options(QueryPlan::Stride(8))).unwrap();
    assert_complete(&map, &one);
    let full: Vec<f32> = depth.iter().map(|d| if d.is_finite() { *d } else { 50.0 }).collect();
    let all = SparseDepth::new(160, 120, full.clone()).unwrap();
    // A sensor that measures everything is believed.
    let options = |plan| options(plan).with_outliers(Outliers::Trust);
    let done = TINY.complete_detailed(&rgb, &all, &options(QueryPlan::Every)).unwrap();
    assert!(done.map.depth() == full);
    assert_eq!(done.asked, 0, "nothing to ask");
    let done = TINY.complete_detailed(&rgb, &all, &options(QueryPlan::Budget(500))).unwrap();
    assert_eq!(done.asked, 0, "nothing to spend a budget on");
}

#[test]
fn unusable_values_are_missing_and_none_left_is_an_error() {
    let rgb = RgbImage::new(40, 30);
    let mut values = vec![0.0, f32::NAN, f32::INFINITY, -1.0];
    values.resize(40 * 30, 0.0);
    let none = SparseDepth::new(40, 30, values.clone()).unwrap();
    let error = TINY.complete(&rgb, &none, &options(QueryPlan::Every)).unwrap_err();
    assert!(matches!(error, Error::NoMeasurement { width: 40, height: 30 }), "{error}");
    values[700] = 1.5;
    let some = SparseDepth::new(40, 30, values.clone()).unwrap();
    assert_eq!(some.measured(), 1);
    assert_complete(&TINY.complete(&rgb, &some, &options(QueryPlan::Stride(4))).unwrap(), &some);
    values[701] = 1e9;
    let error = SparseDepth::new(40, 30, values).unwrap_err();
    assert!(matches!(error, Error::DepthRange { x: 21, y: 17, .. }), "{error}");
}

#[test]
fn wrong_sizes_are_named() {
    let sparse = |w, h| SparseDepth::from_points(w, h, &[(1, 1, 1.0)]).unwrap();
    let complete = |w, h, s: &SparseDepth| TINY.complete(&RgbImage::new(w, h), s, &options(QueryPlan::Every));
    let error = complete(64, 48, &sparse(48, 64)).unwrap_err();
    assert!(matches!(error, Error::SizeMismatch { rgb: (64, 48), depth: (48, 64) }));
    assert_eq!(error.to_string().matches("64x48").count(), 1, "{error}");
    for (w, h) in [(27, 100), (100, 27), (6000, 28)] {
        let error = complete(w, h, &sparse(w as usize, h as usize)).unwrap_err();
        assert!(matches!(error, Error::ImageSize { .. }), "{w}x{h}: {error}");
    }
}

#[test]
fn files_that_are_not_what_they_should_be_are_named() {
    let dir = tempfile::tempdir().unwrap();
    let path = |name: &str| dir.path().join(name);
    image::GrayImage::new(8, 8).save(path("grey8.png")).unwrap();
    let scale = Some(DepthScale::millimetres());
    let error = SparseDepth::read(path("grey8.png"), scale).unwrap_err();
    assert!(error.to_string().contains("grey8.png") && error.to_string().contains("16"), "{error}");

    RgbImage::new(64, 64).save(path("whole.png")).unwrap();
    let bytes = std::fs::read(path("whole.png")).unwrap();
    std::fs::write(path("half.png"), &bytes[..bytes.len() / 2]).unwrap();
    std::fs::write(path("text.png"), b"hello").unwrap();
    for name in ["half.png", "text.png"] {
        let error = read_rgb(path(name)).unwrap_err();
        assert!(matches!(error, Error::Format { .. }), "{name}: {error}");
        assert!(error.to_string().contains(name));
    }
    assert!(matches!(read_rgb(path("absent.png")), Err(Error::Io { .. })));
    // A header that claims 4 billion by 4 billion pixels, and nothing behind it.
    let mut header = bytes[..33].to_vec();
    header[16..24].fill(0x7f);
    std::fs::write(path("huge.png"), header).unwrap();
    assert!(read_rgb(path("huge.png")).is_err());
    for bad in ["", "inch", "0", "-1", "nan"] {
        assert!(bad.parse::<DepthScale>().is_err(), "{bad}");
    }
}

#[test]
fn progress_counts_up_and_a_token_stops() {
    let (rgb, sparse, _) = frame(50);
    let seen = Arc::new(Mutex::new(Vec::new()));
    let cancel = sdim::CancelToken::default();
    let (log, token) = (seen.clone(), cancel.clone());
    let mut watched = options(QueryPlan::Every)
        .with_progress(move |p| log.lock().unwrap().push((p.answered, p.planned)))
        .with_cancel(token);
    // Several batches on any device.
    watched.max_memory = Some(100_000_000);
    TINY.complete(&rgb, &sparse, &watched).unwrap();
    let calls = std::mem::take(&mut *seen.lock().unwrap());
    assert!(calls.len() > 1 && calls.windows(2).all(|w| w[0].0 < w[1].0));
    assert_eq!(calls.last().unwrap().0, calls.last().unwrap().1);
    cancel.cancel();
    assert!(matches!(TINY.complete(&rgb, &sparse, &watched), Err(Error::Cancelled)));
    assert!(seen.lock().unwrap().is_empty(), "who has cancelled waits for no batch");
    let cancel = sdim::CancelToken::default();
    let (log, token) = (seen.clone(), cancel.clone());
    let stopping = watched.with_cancel(cancel).with_progress(move |p| {
        log.lock().unwrap().push((p.answered, p.planned));
        token.cancel();
    });
    assert!(matches!(TINY.complete(&rgb, &sparse, &stopping), Err(Error::Cancelled)));
    assert_eq!(seen.lock().unwrap().len(), 1, "stops after the first batch");
}

#[test]
fn a_memory_limit_makes_smaller_batches_and_the_same_map() {
    let (rgb, sparse, _) = frame(100);
    let run = |max_memory: Option<usize>| {
        let steps = Arc::new(Mutex::new(vec![0]));
        let seen = steps.clone();
        let mut options =
            options(QueryPlan::Stride(8)).with_progress(move |p| seen.lock().unwrap().push(p.answered));
        options.max_memory = max_memory;
        let map = TINY.complete(&rgb, &sparse, &options).unwrap();
        let largest = steps.lock().unwrap().windows(2).map(|s| s[1] - s[0]).max().unwrap();
        (map, largest)
    };
    let (free, all) = run(None);
    // A row of the tiny model takes 15 kB: 8 x 192 + 3 x 512 values in passing, 2 x 4 x 96 kept.
    let (tight, thirteen) = run(Some(200_000));
    let (least, one) = run(Some(1));
    assert!(all > 200 && one == 1, "{all}, {one}");
    if common::device().is_cpu() {
        assert_eq!(thirteen, 13);
    } else {
        // There the scores against the prefix take memory, too.
        assert!((1..13).contains(&thirteen), "{thirteen}");
    }
    for map in [&tight, &least] {
        for (a, b) in map.depth().iter().zip(free.depth()) {
            assert!((a - b).abs() <= 1e-3 * b, "{a} is not {b}");
        }
    }
}

#[test]
fn the_completer_is_shared_between_threads() {
    fn shared<T: Send + Sync>(_: &T) {}
    shared(&*TINY);
}
