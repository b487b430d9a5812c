//! The example program `evaluate`: scores, resuming, shards, figures, bad arguments.

mod common;

use common::program;
use serde_json::Value;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

/// A folder of rendered frames and a place for results.
struct Folder {
    dir: tempfile::TempDir,
}

impl Folder {
    fn new(count: usize) -> Self {
        let dir = tempfile::tempdir().unwrap();
        let (data, count) = (dir.path().join("data"), count.to_string());
        let args = ["--out", text(&data), "--count", &count, "--width", "64", "--height", "48"];
        let out = Command::new(program("render")).args(args).output().unwrap();
        assert!(out.status.success(), "{}", said(&out));
        Self { dir }
    }

    fn path(&self, name: &str) -> PathBuf {
        self.dir.path().join(name)
    }

    fn evaluate(&self, args: &[&str]) -> Output {
        let data = self.path("data");
        let base = ["--data", text(&data), "--depth-scale", "mm"];
        Command::new(program("evaluate")).args(base).args(args).output().unwrap()
    }

    /// Two classical methods, two numbers of points, results in `out`.
    fn classical(&self, out: &str, more: &[&str]) -> Output {
        let out = self.path(out);
        let args = ["--methods", "nearest,linear", "--points", "30,60", "--out", text(&out)];
        self.evaluate(&[&args, more].concat())
    }
}

fn text(path: &Path) -> &str {
    path.to_str().unwrap()
}

fn said(out: &Output) -> String {
    String::from_utf8_lossy(&out.stderr).into_owned()
}

fn succeeded(out: Output) -> Output {
    assert!(out.status.success(), "{}", said(&out));
    out
}

/// The files that must be the same however the work was done, and what was printed.
fn results(dir: &Path) -> Vec<Vec<u8>> {
    ["report.md", "report.json", "frames.csv"].map(|name| fs::read(dir.join(name)).unwrap()).to_vec()
}

#[test]
fn a_checkpoint_and_all_baselines_are_scored() {
    let folder = Folder::new(3);
    let out = folder.path("out");
    let out = succeeded(folder.evaluate(&["--points", "100", "--limit", "2", "--json", "--out", text(&out)]));
    let v: Value = serde_json::from_slice(&out.stdout).unwrap();
    let table = &v["tables"][0];
    assert_eq!(
        (&v["settings"]["frames"], &table["frames"], &table["points"]),
        (&2.into(), &2.into(), &100.into())
    );
    let names = ["sdim-tiny", "nearest", "linear", "ip-basic", "inverse-distance", "colorization"];
    assert_eq!(table["methods"].as_array().unwrap().len(), names.len());
    for (method, name) in table["methods"].as_array().unwrap().iter().zip(names) {
        assert_eq!(method["name"], name);
        for key in ["mae", "rmse", "imae", "irmse", "abs_rel", "log10", "delta_1.15", "delta_1.25^3"] {
            let of = |end: &str| method["metrics"][key][end].as_f64().unwrap();
            assert!(
                of("low") <= of("value") && of("value") <= of("high") && of("high") > 0.0,
                "{name} {key}"
            );
        }
        assert!(method["gradient_error"]["value"].as_f64().unwrap() > 0.0 && method["missing"] == 0);
        assert!(method["regions"].as_array().unwrap().iter().any(|r| r["name"] == "at edges"));
        assert_eq!(method["confidence"].as_object().unwrap().is_empty(), name != "sdim-tiny");
    }
    assert_eq!(table["methods"][2]["mae_ratio"]["value"], 1.0, "linear against itself");
    let written: Value = serde_json::from_slice(&fs::read(folder.path("out/report.json")).unwrap()).unwrap();
    assert_eq!(written, v);
    let csv = fs::read_to_string(folder.path("out/frames.csv")).unwrap();
    assert_eq!(csv.lines().count(), 1 + 2 * names.len());
    let speed: Value = serde_json::from_slice(&fs::read(folder.path("out/speed.json")).unwrap()).unwrap();
    assert!(speed["points"]["0000100"][0][1]["frames_per_second"].as_f64().unwrap() > 0.0);
}

#[test]
fn a_run_that_was_stopped_goes_on_where_it_was() {
    let folder = Folder::new(4);
    let whole = succeeded(folder.classical("a", &[]));
    let out = folder.path("a");
    let before = results(&out);
    let frame = |points: &str, index: usize| out.join(format!("frames/{points}/{index:06}.json"));
    let kept = fs::read(frame("30", 0)).unwrap();
    for (points, index) in [("30", 1), ("30", 3), ("60", 3)] {
        fs::remove_file(frame(points, index)).unwrap();
    }
    for name in ["report.md", "report.json", "frames.csv"] {
        fs::remove_file(out.join(name)).unwrap();
    }
    let again = succeeded(folder.classical("a", &[]));
    assert_eq!(results(&out), before);
    assert_eq!(again.stdout, whole.stdout);
    // Its seconds would differ if it had been run again.
    assert_eq!(fs::read(frame("30", 0)).unwrap(), kept);
    assert!(frame("30", 3).is_file());
}

#[test]
fn merged_shards_are_the_whole() {
    let folder = Folder::new(5);
    let whole = succeeded(folder.classical("whole", &[]));
    let [one, two, merged] = ["one", "two", "merged"].map(|n| folder.path(n));
    assert!(succeeded(folder.classical("one", &["--shard", "0/2"])).stdout.is_empty());
    let evaluate = |args: &[&str]| Command::new(program("evaluate")).args(args).output().unwrap();
    let early = evaluate(&["--merge", text(&one), "--out", text(&merged)]);
    assert!(
        !early.status.success() && said(&early).contains("2 of 5 frames with 30 points"),
        "{}",
        said(&early)
    );
    succeeded(folder.classical("two", &["--shard", "1/2"]));
    let out = succeeded(evaluate(&["--merge", text(&two), text(&one), "--out", text(&merged)]));
    assert_eq!(results(&merged), results(&folder.path("whole")));
    assert_eq!(out.stdout, whole.stdout);
    // All shards may also share one folder.
    succeeded(folder.classical("two", &["--shard", "0/2"]));
    succeeded(evaluate(&["--merge", text(&two), "--out", text(&two)]));
    assert_eq!(results(&two), results(&merged));
    succeeded(folder.classical("other", &["--seed", "1"]));
    let mixed = evaluate(&["--merge", text(&one), text(&folder.path("other"))]);
    assert!(!mixed.status.success() && said(&mixed).contains("`seed`"), "{}", said(&mixed));
}

#[test]
fn results_of_other_settings_are_not_mixed() {
    let folder = Folder::new(2);
    succeeded(folder.classical("a", &[]));
    let before = results(&folder.path("a"));
    let cases: [(&[&str], &str); 4] = [
        (&["--seed", "3"], "`seed`"),
        (&["--pattern", "sfm"], "`pattern`"),
        (&["--limit", "1"], "`frames`"),
        (&["--range", "1,5"], "`range`"),
    ];
    for (more, named) in cases {
        let out = folder.classical("a", more);
        assert!(!out.status.success() && said(&out).contains(named), "{more:?}: {}", said(&out));
        assert!(said(&out).contains("settings.json") && out.stdout.is_empty());
    }
    assert_eq!(results(&folder.path("a")), before);
}

#[test]
fn frames_that_cannot_be_scored_are_named() {
    let folder = Folder::new(3);
    // Where the ground truth was the input, nothing is left to predict.
    let truth = fs::read_dir(folder.path("data/gt")).unwrap().map(|e| e.unwrap().path()).min().unwrap();
    fs::create_dir(folder.path("data/sparse")).unwrap();
    fs::copy(&truth, folder.path("data/sparse").join(truth.file_name().unwrap())).unwrap();
    let out = succeeded(folder.classical("a", &["--json"]));
    let v: Value = serde_json::from_slice(&out.stdout).unwrap();
    assert_eq!(v["tables"][0]["frames"], 2);
    assert_eq!(v["tables"][0]["skipped"][0], truth.file_stem().unwrap().to_str().unwrap());
    assert!(said(&out).contains("skipped"));
}

#[test]
fn figures_are_drawn_once() {
    let folder = Folder::new(3);
    let figures = folder.path("figures");
    let more = ["--figures", text(&figures), "--figure-frames", "2", "--figure-tile", "96"];
    succeeded(folder.classical("a", &more));
    let mut names: Vec<PathBuf> = fs::read_dir(&figures).unwrap().map(|e| e.unwrap().path()).collect();
    names.sort();
    assert_eq!(names.len(), 4, "two frames, two numbers of points: {names:?}");
    let picture = image::open(&names[0]).unwrap();
    assert_eq!((picture.width(), picture.height()), (4 * 104 + 8, 96 + 2 * (96 + 4) + 16));
    // A figure that is wanted later is drawn later.
    fs::remove_file(&names[1]).unwrap();
    let report = results(&folder.path("a"));
    succeeded(folder.classical("a", &more));
    assert!(names[1].is_file() && results(&folder.path("a")) == report);
}

#[test]
fn bad_arguments_are_named_and_nothing_is_written() {
    let folder = Folder::new(1);
    let out = folder.path("out");
    let cases: [(&[&str], &str); 14] = [
        (&["--layout", "cityscapes"], "cityscapes"),
        (&["--points", "0"], "--points 0"),
        (&["--points", "many"], "many"),
        (&["--pattern", "lidar:0"], "lidar:0"),
        (&["--shard", "2/2"], "2/2"),
        (&["--shard", "0"], "I/N"),
        (&["--methods", "cubic"], "cubic"),
        (&["--checkpoint", "absent"], "absent"),
        (&["--checkpoint", "tiny", "--checkpoint", "tiny"], "taken"),
        (&["--adapter", "absent"], "--adapter"),
        (&["--range", "5,1"], "range"),
        (&["--range", "5"], "NEAR,FAR"),
        (&["--limit", "0"], "--limit 0"),
        (&["--plan", "stride:0"], "stride:0"),
    ];
    for (args, named) in cases {
        let ran = folder.evaluate(&[args, &["--out", text(&out)]].concat());
        assert!(!ran.status.success() && said(&ran).contains(named), "{args:?}: {}", said(&ran));
        assert!(!said(&ran).contains("panicked") && ran.stdout.is_empty() && !out.exists(), "{args:?}");
    }
    let evaluate = |args: &[&str]| Command::new(program("evaluate")).args(args).output().unwrap();
    let absent = folder.path("absent");
    let alone: [(&[&str], &str); 4] = [
        (&[], "--data"),
        (&["--data", text(&absent)], "absent"),
        (&["--merge", text(&absent)], "absent"),
        (&["--procedural", "2", "--shard", "0/2"], "--out"),
    ];
    for (args, named) in alone {
        let ran = evaluate(args);
        assert!(!ran.status.success() && said(&ran).contains(named), "{args:?}: {}", said(&ran));
    }
}
