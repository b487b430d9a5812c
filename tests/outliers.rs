//! Wrong measurements: found, left out, reported; right ones: untouched, to the bit.

use image::RgbImage;
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use sdim::depth::SparsePattern;
use sdim::depth::outliers::find;
use sdim::internals::scenes::procedural;
use sdim::metrics::errors;
use sdim::{
    CompleteOptions, Completion, DepthCompleter, DepthScale, Outliers, Preserve, QueryPlan, SparseDepth,
    read_rgb,
};
use std::path::Path;
use std::sync::LazyLock;

static TINY: LazyLock<DepthCompleter> = LazyLock::new(|| DepthCompleter::tiny().unwrap());

fn options() -> CompleteOptions {
    CompleteOptions::default().with_plan(QueryPlan::Stride(8)).with_outliers(Outliers::Ignore)
}

/// A part of the measurements times or divided by 1.5 to 3, with the pixels of these.
fn corrupted(sparse: &SparseDepth, part: f64, rng: &mut ChaCha8Rng) -> (SparseDepth, Vec<usize>) {
    let mut depth = sparse.as_slice().to_vec();
    let measured: Vec<usize> = (0..depth.len()).filter(|&i| !depth[i].is_nan()).collect();
    let count = (measured.len() as f64 * part).round().max(1.0) as usize;
    let chosen = rand::seq::index::sample(rng, measured.len(), count);
    let wrong: Vec<usize> = chosen.iter().map(|i| measured[i]).collect();
    for &i in &wrong {
        let factor = rng.random_range(1.5..3.0f32);
        depth[i] *= if rng.random_bool(0.5) { factor } else { factor.recip() };
    }
    (SparseDepth::new(sparse.width(), sparse.height(), depth).unwrap(), wrong)
}

/// Shares of wrong measurements found and of right ones flagged, with the points of a pattern in several scenes.
fn shares(pattern: SparsePattern, points: usize, part: f64) -> (f64, f64) {
    let (mut found, mut wrong, mut false_alarms, mut right) = (0, 0, 0, 0);
    for seed in 3_100_000..3_100_012 {
        let scene = procedural(seed, 320, 240).unwrap();
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let clean = pattern.sample(&scene.rgb, &scene.depth, 320, 240, points, &mut rng).unwrap();
        let (bad, chosen) = corrupted(&clean, part, &mut rng);
        let flagged = find(&scene.rgb, &bad).unwrap();
        let hit = flagged.iter().filter(|o| chosen.contains(&(o.y * 320 + o.x))).count();
        found += hit;
        wrong += chosen.len();
        false_alarms += flagged.len() - hit + find(&scene.rgb, &clean).unwrap().len();
        right += 2 * clean.measured() - chosen.len();
    }
    (found as f64 / wrong as f64, false_alarms as f64 / right as f64)
}

#[test]
fn gross_errors_are_found_and_right_measurements_are_left_alone() {
    for (pattern, points) in [
        (SparsePattern::Uniform, 500),
        (SparsePattern::Uniform, 1500),
        (SparsePattern::Lidar { lines: 16 }, 500),
        (SparsePattern::Sfm, 1500),
        (SparsePattern::Uniform, 320 * 240),
    ] {
        let (found, false_alarms) = shares(pattern, points, 0.05);
        assert!(found >= 0.8 && false_alarms < 0.01, "{pattern:?} {points}: {found}, {false_alarms}");
    }
}

fn bundled() -> (RgbImage, SparseDepth, SparseDepth) {
    let file = |name: &str| Path::new(env!("CARGO_MANIFEST_DIR")).join("assets/example").join(name);
    let depth = |name: &str| SparseDepth::read(file(name), Some(DepthScale::millimetres())).unwrap();
    (read_rgb(file("rgb.png")).unwrap(), depth("sparse.png"), depth("gt.png"))
}

fn run(rgb: &RgbImage, sparse: &SparseDepth, outliers: Outliers) -> Completion {
    TINY.complete_detailed(rgb, sparse, &options().with_outliers(outliers)).unwrap()
}

#[test]
fn the_bundled_frame_bears_wrong_measurements() {
    let (rgb, clean, gt) = bundled();
    let mae = |done: &Completion| errors(done.map.depth(), gt.as_slice(), &clean).unwrap().mae;
    let before = mae(&run(&rgb, &clean, Outliers::Ignore));
    // One saturated pixel, and left-overs at the border.
    let mut depth = clean.as_slice().to_vec();
    let (x, y, _) = clean.points().nth(250).unwrap();
    depth[y * 640 + x] = 65.535;
    for y in (0..480).step_by(60) {
        depth[y * 640] = 0.0001;
    }
    let bad = SparseDepth::new(640, 480, depth).unwrap();
    let done = run(&rgb, &bad, Outliers::Ignore);
    let flagged: Vec<_> = done.flagged.iter().map(|o| (o.x, o.y)).collect();
    assert!(flagged.contains(&(x, y)) && (0..480).step_by(60).all(|y| flagged.contains(&(0, y))));
    assert!((mae(&done) / before - 1.0).abs() < 0.02, "{} after {before}", mae(&done));
    let trusted = mae(&run(&rgb, &bad, Outliers::Trust));
    assert!(trusted > 1.3 * before, "{trusted}: the check has something to do");
    for (part, limit) in [(0.02, 1.15), (0.05, 1.4)] {
        let (bad, _) = corrupted(&clean, part, &mut ChaCha8Rng::seed_from_u64(9));
        let after = mae(&run(&rgb, &bad, Outliers::Ignore));
        assert!(after < limit * before, "{part}: {after} after {before}");
    }
}

#[test]
fn without_a_flag_the_map_is_the_same_to_the_bit() {
    let scene = procedural(3_000_001, 160, 120).unwrap();
    let mut untouched = 0;
    for seed in 0..8 {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let sparse = SparsePattern::Uniform.sample(&scene.rgb, &scene.depth, 160, 120, 50, &mut rng).unwrap();
        let (checked, trusted) =
            (run(&scene.rgb, &sparse, Outliers::Ignore), run(&scene.rgb, &sparse, Outliers::Trust));
        assert!(trusted.flagged.is_empty());
        if checked.flagged.is_empty() {
            untouched += 1;
            let bits = |v: &[f32]| v.iter().map(|d| d.to_bits()).collect::<Vec<_>>();
            assert_eq!(bits(checked.map.depth()), bits(trusted.map.depth()));
            assert_eq!(bits(checked.map.confidence()), bits(trusted.map.confidence()));
        }
    }
    assert!(untouched >= 2);
}

#[test]
fn flagged_measurements_are_kept_only_where_the_caller_insists() {
    let (rgb, clean, _) = bundled();
    let (x, y, right) = clean.points().nth(250).unwrap();
    let mut depth = clean.as_slice().to_vec();
    depth[y * 640 + x] = 65.535;
    let bad = SparseDepth::new(640, 480, depth).unwrap();
    let ignored = run(&rgb, &bad, Outliers::Ignore);
    let wrong = *ignored.flagged.iter().find(|o| (o.x, o.y) == (x, y)).unwrap();
    assert_eq!(wrong.measured, 65.535);
    assert!((wrong.expected / right - 1.0).abs() < 0.2, "{wrong:?}, {right} m");
    let here = y * 640 + x;
    assert!(!ignored.map.measured()[here] && ignored.map.depth()[here] == wrong.expected);
    let kept = run(&rgb, &bad, Outliers::Preserve);
    assert_eq!(kept.flagged, ignored.flagged);
    assert!(kept.map.keeps(&bad) && kept.map.confidence()[here] == 1.0);
    let changed = (0..640 * 480).filter(|&i| kept.map.depth()[i] != ignored.map.depth()[i]).count();
    assert_eq!(changed, kept.flagged.len(), "only the flagged pixels themselves");
    let ask = options().with_outliers(Outliers::Preserve).with_preserve(Preserve::Ask);
    assert!(!TINY.complete(&rgb, &bad, &ask).unwrap().measured()[here]);
}

#[test]
fn where_measurements_lie_far_apart_the_model_is_asked_about_doubtful_ones() {
    let (mut found, mut alone, mut wrong, mut false_alarms, mut right) = (0, 0, 0, 0, 0);
    for seed in 3_100_000..3_100_016 {
        let scene = procedural(seed, 320, 240).unwrap();
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let clean = SparsePattern::Uniform.sample(&scene.rgb, &scene.depth, 320, 240, 100, &mut rng).unwrap();
        let (bad, chosen) = corrupted(&clean, 0.04, &mut rng);
        let sparse_plan =
            CompleteOptions::default().with_plan(QueryPlan::Stride(40)).with_outliers(Outliers::Ignore);
        let done = TINY.complete_detailed(&scene.rgb, &bad, &sparse_plan).unwrap();
        let hit = done.flagged.iter().filter(|o| chosen.contains(&(o.y * 320 + o.x))).count();
        found += hit;
        false_alarms += done.flagged.len() - hit;
        let classical = find(&scene.rgb, &bad).unwrap();
        alone += classical.iter().filter(|o| chosen.contains(&(o.y * 320 + o.x))).count();
        wrong += chosen.len();
        right += 100 - chosen.len();
    }
    assert!(found * 4 >= wrong * 3, "{found} of {wrong}, {alone} of them without the model");
    assert!(false_alarms * 50 < right, "{false_alarms} of {right}");
    assert!(found >= alone);
}
