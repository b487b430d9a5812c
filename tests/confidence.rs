//! What a checkpoint makes of its confidence.

mod common;

use common::program::program;
use sdim::internals::scenes::procedural;
use sdim::settings::ConfidenceScale;
use sdim::{CompleteOptions, DepthCompleter, DepthMap, LoadOptions, QueryPlan, Stream, StreamOptions};
use serde_json::{Value, json};
use std::path::Path;
use std::process::Command;

/// The embedded checkpoint with another scale, or none.
fn tiny_with(scale: Option<Value>) -> (tempfile::TempDir, DepthCompleter) {
    let dir = tempfile::tempdir().unwrap();
    for entry in std::fs::read_dir(common::root().join("assets/sdim-tiny")).unwrap() {
        let path = entry.unwrap().path();
        std::fs::copy(&path, dir.path().join(path.file_name().unwrap())).unwrap();
    }
    let path = dir.path().join("sdim.json");
    let mut settings: Value = serde_json::from_slice(&std::fs::read(&path).unwrap()).unwrap();
    settings.as_object_mut().unwrap().remove("confidence");
    if let Some(scale) = scale {
        settings["confidence"] = scale;
    }
    std::fs::write(path, settings.to_string()).unwrap();
    let completer = DepthCompleter::load(dir.path(), &LoadOptions::default()).unwrap();
    (dir, completer)
}

fn frame() -> (sdim::RgbImage, sdim::SparseDepth) {
    let frame = procedural(3_700_000, 160, 120).unwrap();
    let sparse = sdim::depth::sample_points(&frame.depth, 160, 120, 80, 0).unwrap();
    (frame.rgb, sparse)
}

/// Largest distance between two confidences where nothing was measured.
fn apart(a: &[f32], b: &DepthMap) -> f32 {
    let pairs = a.iter().zip(b.confidence()).zip(b.measured());
    pairs.filter(|(_, m)| !**m).map(|((a, b), _)| (a - b).abs()).fold(0.0, f32::max)
}

#[test]
fn the_scale_changes_confidence_and_nothing_else() {
    let (rgb, sparse) = frame();
    // Every pixel is asked, so that none is filled between scaled ones.
    let options = CompleteOptions::default().with_plan(QueryPlan::Every);
    let (_plain_dir, plain) = tiny_with(None);
    let (_dir, other) = tiny_with(Some(json!({ "temperature": 2.0, "offset": -0.7 })));
    let scale = ConfidenceScale { temperature: 2.0, offset: -0.7 };
    let (before, after) =
        (plain.complete(&rgb, &sparse, &options).unwrap(), other.complete(&rgb, &sparse, &options).unwrap());
    assert_eq!(before.depth(), after.depth());
    assert_eq!(before.expected_error(), after.expected_error());
    let wanted: Vec<f32> = before.confidence().iter().map(|c| scale.confidence(*c)).collect();
    assert!(apart(&wanted, &after) < 1e-5, "{}", apart(&wanted, &after));
    assert!(apart(before.confidence(), &after) > 0.1, "this scale is not nothing");
    assert!((0..after.measured().len()).all(|i| !after.measured()[i] || after.confidence()[i] == 1.0));
}

#[test]
fn a_stream_scales_once() {
    let (rgb, sparse) = frame();
    let (_dir, completer) = tiny_with(Some(json!({ "temperature": 0.5, "offset": -1.0 })));
    // Frames that rest have doubts of their own.
    let mut stream = Stream::new(completer, StreamOptions::default().with_rest(0)).unwrap();
    let mean = |map: &DepthMap| map.confidence().iter().sum::<f32>() / map.confidence().len() as f32;
    let first = mean(&stream.push(&rgb, &sparse, None).unwrap().map);
    for _ in 0..4 {
        let next = mean(&stream.push(&rgb, &sparse, None).unwrap().map);
        // Carried answers age a little; scaled again and again they would fall by a quarter in a frame.
        assert!((next / first - 1.0).abs() < 0.15, "{first}, then {next}");
    }
}

#[test]
fn the_example_measures_fits_and_draws() {
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().to_str().unwrap();
    let args = ["--scenes", "2", "--points", "100", "--plan", "stride:16", "--out", out];
    let run = Command::new(program("confidence")).args(args).output().unwrap();
    assert!(run.status.success(), "{}", String::from_utf8_lossy(&run.stderr));
    let report: Value =
        serde_json::from_slice(&std::fs::read(dir.path().join("confidence.json")).unwrap()).unwrap();
    let scale: ConfidenceScale = serde_json::from_value(report["scale"].clone()).unwrap();
    assert!(scale.temperature > 0.0 && !scale.is_identity(), "{scale:?}");
    let error = |which: &str, part: usize| {
        report[which]["confidence"][part]["reliability"]["error"].as_f64().unwrap()
    };
    assert!((0..3).all(|part| (0.0..0.5).contains(&error("stated", part))));
    assert!((error("scaled", 0) - error("stated", 0)).abs() > 1e-6);
    let text = |name: &str| std::fs::read_to_string(Path::new(out).join(name)).unwrap();
    assert!(text("reliability.svg").contains("share of pixels within 5 %"));
    assert!(text("sparsification.svg").contains("by expected error"));
    let one = Command::new(program("confidence")).args(["--scenes", "1", "--out", out]).output().unwrap();
    assert!(!one.status.success() && String::from_utf8_lossy(&one.stderr).contains("expected at least 2"));
}
