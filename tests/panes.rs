//! The example `panes`, run as a user runs it, and what it says of maps that see panes or look through them.

mod common;

use common::program::program;
use sdim::depth::{interpolate, sample_points};
use sdim::internals::scenes::sensor::DepthSensor;
use sdim::internals::scenes::{Rig, glazed};
use serde_json::Value;
use std::path::Path;
use std::process::{Command, Output};

fn run(name: &str, args: &[&str]) -> Output {
    Command::new(program(name)).args(args).output().unwrap()
}

#[test]
fn panes_scores_interpolation_and_checkpoints() {
    let flags = ["--scenes", "3", "--points", "60", "--width", "96", "--height", "72", "--plan", "stride:16"];
    let out = run("panes", &[&flags[..], &["--json"]].concat());
    assert!(out.status.success(), "{}", String::from_utf8_lossy(&out.stderr));
    let v: Value = serde_json::from_slice(&out.stdout).unwrap();
    let methods = v[0]["methods"].as_array().unwrap();
    let names: Vec<&str> = methods.iter().map(|m| m["method"].as_str().unwrap()).collect();
    assert_eq!((names, v[0]["points"].as_u64()), (vec!["linear", "tiny"], Some(60)));
    for m in methods {
        for key in ["pane_mae", "elsewhere_mae"] {
            assert!(m[key].as_f64().unwrap() > 0.0, "{key} of {m}");
        }
        for key in ["sees_the_pane", "sees_the_pane_where_measured_through", "flagged_of_measured_through"] {
            assert!((0.0..=1.0).contains(&m[key].as_f64().unwrap()), "{key} of {m}");
        }
    }
    assert_eq!(methods[0]["pane_by_linear"], serde_json::json!([1.0, 1.0, 1.0]));
    // What interpolation says of a pane, counted by hand.
    let (mut off, mut own) = (0.0, 0.0);
    for seed in 2_000_000..2_000_003 {
        let frame = glazed(seed, 96, 72).unwrap();
        let sparse = sample_points(frame.sensed(), 96, 72, 60, seed).unwrap();
        let (map, glass) = (interpolate::linear(&sparse).unwrap(), frame.glass.as_ref().unwrap());
        let open = |i: &usize| glass.pane[*i] && sparse.as_slice()[*i].is_nan();
        let pixels: Vec<usize> = (0..map.len()).filter(open).collect();
        let sum: f64 = pixels.iter().map(|&i| f64::from((map[i] - frame.depth[i]).abs())).sum();
        own += sum / pixels.len() as f64 / 3.0;
        // Pixels of panes where interpolation says what is behind.
        off += pixels.iter().filter(|&&i| map[i] > 1.1 * frame.depth[i]).count() as f64;
    }
    assert!((methods[0]["pane_mae"].as_f64().unwrap() / own - 1.0).abs() < 1e-6, "{own} m");
    assert!(off > 100.0, "measurements lie behind panes");
    let table = run("panes", &flags);
    assert!(String::from_utf8_lossy(&table.stdout).contains("| sees the pane |"));
    for bad in [&["--scenes", "0"][..], &["--checkpoint", "/nowhere"], &["--outliers", "perhaps"]] {
        let failed = run("panes", bad);
        assert!(!failed.status.success() && failed.stdout.is_empty(), "{bad:?}");
    }
}

#[test]
fn render_shows_panes_and_measures_through_them() {
    let dir = tempfile::tempdir().unwrap();
    let path = |name: &str| dir.path().join(name).to_str().unwrap().to_string();
    let (sheet, out) = (path("sheet.png"), path("out"));
    let size = ["--width", "64", "--height", "48", "--count", "3", "--recipe", "glazed"];
    let done = run("render", &[&size[..], &["--points", "300", "--sheet", &sheet, "--out", &out]].concat());
    assert!(done.status.success(), "{}", String::from_utf8_lossy(&done.stderr));
    // Frame, depth and what the sensor sees; two frames in a row.
    assert_eq!(image::image_dimensions(&sheet).unwrap(), (2 * 3 * 64, 2 * 48));
    let frame = glazed(2_000_000, 64, 48).unwrap();
    let read = |part: &str| {
        let file = Path::new(&out).join(part).join("scene_2000000.png");
        sdim::SparseDepth::read(file, Some(sdim::DepthScale::millimetres())).unwrap()
    };
    // Millimetres, up to the largest number of a file.
    let near = |a: f32, b: f32| (a - b.min(65.535)).abs() < 2e-3;
    let (sparse, truth) = (read("sparse"), read("gt"));
    assert!(sparse.points().all(|(x, y, d)| near(d, frame.sensed()[y * 64 + x])));
    assert!(truth.points().all(|(x, y, d)| near(d, frame.depth[y * 64 + x])));
    assert!(sparse.points().any(|(x, y, d)| truth.get(x, y).is_some_and(|t| d > 1.2 * t)));
}

#[test]
fn a_cameras_own_sensor_sees_through_panes() {
    let frame = glazed(3, 64, 48).unwrap();
    let rig = Rig { sensor: DepthSensor::default(), ..Rig::draw(1) };
    let (_, measured) = rig.take(&frame, 1).unwrap();
    assert!(measured.points().all(|(x, y, d)| d == frame.sensed()[y * 64 + x]));
    assert!(measured.points().any(|(x, y, d)| d > 1.05 * frame.depth[y * 64 + x]));
}
