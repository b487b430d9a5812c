//! The example program `evaluate`: scores, resuming, shards, figures, bad arguments.

mod common;
#[path = "common/copies.rs"]
mod copies;

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
    let cases: [(&[&str], &str); 6] = [
        (&["--seed", "3"], "`seed`"),
        (&["--score", "all"], "`score`"),
        (&["--resample"], "`resample`"),
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
fn measured_pixels_count_if_asked() {
    let folder = Folder::new(2);
    let report = |out: &str, more: &[&str]| -> (Value, String) {
        let ran = succeeded(folder.classical(out, &[&["--json"], more].concat()));
        let text = fs::read_to_string(folder.path(out).join("report.md")).unwrap();
        (serde_json::from_slice(&ran.stdout).unwrap(), text)
    };
    let (unseen, unseen_text) = report("unseen", &[]);
    let (everywhere, everywhere_text) = report("all", &["--score", "all"]);
    assert_eq!(
        (&unseen["settings"]["score"], &everywhere["settings"]["score"]),
        (&"unseen".into(), &"all".into())
    );
    assert!(unseen_text.contains("that were not measured (`--score unseen`)"), "{unseen_text}");
    assert!(everywhere_text.contains("measured ones included (`--score all`)"), "{everywhere_text}");
    // Both methods keep what was measured, so the same errors are spread over more pixels.
    let pixels = |out: &str| -> Vec<(f64, f64)> {
        let csv = fs::read_to_string(folder.path(out).join("frames.csv")).unwrap();
        let lines = csv.lines().skip(1).map(|l| l.split(',').map(str::to_string).collect::<Vec<_>>());
        lines.map(|l| (l[4].parse().unwrap(), l[6].parse().unwrap())).collect()
    };
    let (few, many) = (pixels("unseen"), pixels("all"));
    assert_eq!(few.len(), 2 * 2 * 2);
    for (row, (few, many)) in few.iter().zip(&many).enumerate() {
        assert_eq!(many.0 - few.0, if row < 4 { 30.0 } else { 60.0 }, "row {row}");
        assert!((few.0 * few.1 - many.0 * many.1).abs() < 1e-6 * few.0, "row {row}: {few:?} {many:?}");
    }
    let regions = |v: &Value| v["tables"][0]["methods"][0]["regions"].clone();
    assert_eq!(regions(&unseen), regions(&everywhere));

    // Where all truth was the input, all methods are perfect, and even a model has no confidence to judge.
    fs::create_dir(folder.path("data/sparse")).unwrap();
    for truth in fs::read_dir(folder.path("data/gt")).unwrap() {
        let truth = truth.unwrap().path();
        fs::copy(&truth, folder.path("data/sparse").join(truth.file_name().unwrap())).unwrap();
    }
    let ran = folder.evaluate(&[
        "--methods",
        "sdim-tiny,nearest",
        "--plan",
        "budget:9",
        "--score",
        "all",
        "--json",
    ]);
    let v: Value = serde_json::from_slice(&succeeded(ran).stdout).unwrap();
    assert_eq!(
        (&v["tables"][0]["frames"], &v["tables"][0]["own"], &v["tables"][0]["points"]),
        (&2.into(), &2.into(), &0.into())
    );
    assert_eq!(v["tables"][0]["methods"][0]["metrics"]["mae"]["value"], 0.0);
    assert!(v["tables"][0]["methods"][0]["regions"].as_array().unwrap().is_empty());
}

/// The report of a run over a copy of a benchmark.
fn benchmark(layout: &str, data: &Path, out: &Path, more: &[&str]) -> Output {
    let base = [
        "--layout",
        layout,
        "--data",
        text(data),
        "--methods",
        "nearest,linear",
        "--out",
        text(out),
        "--json",
    ];
    Command::new(program("evaluate")).args(base).args(more).output().unwrap()
}

#[test]
fn every_layout_is_scored() {
    let dir = tempfile::tempdir().unwrap();
    let at = |name: &str| dir.path().join(name);
    let (kitti, ddad, drawn, void) =
        (copies::kitti(), copies::ddad(true), copies::ddad(false), copies::void());
    copies::tum(&at("tum"));
    copies::scannet(&at("scannet"));
    let fixture =
        |name: &str| Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures/benchmarks").join(name);
    // Layout, place, frames, and measured pixels per frame where they are the data set's own.
    let cases: [(&str, PathBuf, usize, Option<f64>); 9] = [
        ("kitti", kitti.path().into(), 2, Some(3.0)),
        ("ddad", ddad.path().into(), 2, Some(1.0)),
        ("ddad", drawn.path().into(), 2, Some(39.0)),
        ("void", void.path().join("void_150"), 2, Some(15.0)),
        ("nyu", fixture("nyu_bundle"), 2, None),
        ("nyu", fixture("nyu"), 1, None),
        ("ibims", fixture("ibims"), 2, None),
        ("tum", at("tum"), 2, None),
        ("scannet", at("scannet"), 3, None),
    ];
    for (case, (layout, data, frames, own)) in cases.into_iter().enumerate() {
        let own_points = own.is_some() || data.ends_with("nyu_bundle");
        let out = |kind: &str| at(&format!("out/{case}-{kind}"));
        let read = |ran: Output| -> Value {
            let v: Value = serde_json::from_slice(&succeeded(ran).stdout).unwrap();
            let table = v["tables"][0].clone();
            assert_eq!(
                (&v["settings"]["layout"], &table["frames"]),
                (&layout.into(), &frames.into()),
                "{layout}"
            );
            for method in table["methods"].as_array().unwrap() {
                assert!(
                    method["metrics"]["rmse"]["value"].as_f64().unwrap() >= 0.0 && method["missing"] == 0
                );
            }
            table
        };
        if own_points {
            let table = read(benchmark(layout, &data, &out("own"), &[]));
            assert_eq!((&table["own"], &table["points"]), (&frames.into(), &0.into()), "{layout}");
            assert!(own.is_none_or(|n| table["measured"] == n), "{layout}: {}", table["measured"]);
            let markdown = fs::read_to_string(out("own").join("report.md")).unwrap();
            assert!(markdown.contains("## The data set's own measurements"), "{markdown}");
            for more in [["--points", "10"], ["--pattern", "uniform"]] {
                let ran = benchmark(layout, &data, &out("refused"), &more);
                assert!(!ran.status.success() && !out("refused").exists(), "{layout} {more:?}");
                assert!(said(&ran).contains(more[0]) && said(&ran).contains("--resample"), "{}", said(&ran));
            }
        }
        let more = if own_points { &["--points", "10", "--resample"][..] } else { &["--points", "10"] };
        let table = read(benchmark(layout, &data, &out("drawn"), more));
        assert_eq!((&table["own"], &table["measured"]), (&0.into(), &10.0.into()), "{layout}");
    }
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
    let cases: [(&[&str], &str); 15] = [
        (&["--score", "some"], "unseen, all"),
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
    let alone: [(&[&str], &str); 7] = [
        // What would change nothing is not taken without a word.
        (&["--merge", "a", "--score", "all"], "--score"),
        (&["--merge", "a", "--points", "100"], "--points"),
        (&["--procedural", "2", "--range", "1,5"], "--range"),
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
