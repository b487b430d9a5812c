//! What is scored and what the reports say.

use crate::common::program::program;
use crate::{Folder, benchmark, copies, said, succeeded, text};
use sdim::benchmarks::Layout;
use serde_json::{Value, json};
use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

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
    // Without linear the first method stands in for it; without any error there is no ratio.
    assert_eq!(v["tables"][0]["reference"], "sdim-tiny");
    let expected = json!({"geometric_mean": null, "better": 0, "frames": 2, "without_ratio": 2});
    assert_eq!(v["tables"][0]["methods"][1]["relative"]["mae"], expected);
    assert!(v["tables"][0]["methods"][0]["regions"].as_array().unwrap().is_empty());
}

#[test]
fn errors_are_compared_frame_by_frame() {
    let folder = Folder::new(5);
    let out = succeeded(folder.classical("a", &["--json"]));
    let v: Value = serde_json::from_slice(&out.stdout).unwrap();
    let csv = fs::read_to_string(folder.path("a/frames.csv")).unwrap();
    let heads: Vec<&str> = csv.lines().next().unwrap().split(',').collect();
    let markdown = fs::read_to_string(folder.path("a/report.md")).unwrap();
    let mut cells = Vec::new();
    for (table, points) in v["tables"].as_array().unwrap().iter().zip(["30", "60"]) {
        assert_eq!(table["reference"], "linear");
        let [nearest, linear] = [&table["methods"][0], &table["methods"][1]];
        for key in ["mae", "rmse", "abs_rel", "gradient_error"] {
            let column = heads.iter().position(|h| *h == key).unwrap();
            let of = |method: &str| -> Vec<f64> {
                let rows = csv.lines().map(|l| l.split(',').collect::<Vec<_>>());
                rows.filter(|r| r[0] == points && r[2] == method)
                    .map(|r| r[column].parse().unwrap())
                    .collect()
            };
            let ratios: Vec<f64> = of("nearest").iter().zip(of("linear")).map(|(e, r)| e / r).collect();
            assert_eq!(ratios.len(), 5);
            let found = &nearest["relative"][key];
            let of = |end: &str| found["geometric_mean"][end].as_f64().unwrap();
            let expected = ratios.iter().product::<f64>().powf(0.2);
            assert!((of("value") / expected - 1.0).abs() < 1e-9, "{key}: {found} {expected}");
            assert!(
                of("low") <= of("value") && of("value") <= of("high") && of("low") < of("high"),
                "{key}: {found}"
            );
            let better = ratios.iter().filter(|r| **r < 1.0).count();
            assert_eq!((&found["better"], &found["frames"]), (&better.into(), &5.into()), "{key}");
            assert_eq!(found["without_ratio"], 0);
            cells.push(format!("{expected:.3} ("));
            cells.push(format!("), {better} of 5 |"));
            let own = &linear["relative"][key];
            assert_eq!((&own["geometric_mean"]["value"], &own["better"]), (&1.0.into(), &0.into()), "{key}");
        }
    }
    // One row per table, cell by cell.
    let rows: Vec<&str> =
        markdown.lines().filter(|l| l.starts_with("| nearest |") && l.contains(" of 5 |")).collect();
    assert_eq!(rows.len(), 2, "{markdown}");
    let mut rest = rows.concat();
    for cell in cells {
        let at = rest.find(&cell).unwrap_or_else(|| panic!("{cell} in {rest}"));
        rest.drain(..at);
    }
    assert!(
        markdown.contains("| method | MAE : linear | RMSE : linear | AbsRel : linear | GE : linear |"),
        "{markdown}"
    );
    // Linear's own row says nothing, and the means in metres stay.
    assert!(
        markdown.contains("| linear |  |  |  |  |") && markdown.contains("| method | MAE m |"),
        "{markdown}"
    );
    assert!(!markdown.contains("was not run"));

    let out = succeeded(folder.evaluate(&["--points", "30", "--methods", "nearest,inverse-distance"]));
    let markdown = String::from_utf8(out.stdout).unwrap();
    assert!(
        markdown.contains("`nearest`, since `linear` was not run") && markdown.contains("| MAE : nearest |"),
        "{markdown}"
    );
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
    let cases: [(&str, PathBuf, usize, Option<f64>); 11] = [
        ("kitti", kitti.path().into(), 2, Some(3.0)),
        ("ddad", ddad.path().into(), 2, Some(1.0)),
        ("ddad", drawn.path().into(), 2, Some(39.0)),
        ("void", void.path().join("void_150"), 2, Some(15.0)),
        ("nyu", fixture("nyu_bundle"), 2, None),
        ("nyu", fixture("nyu"), 1, None),
        ("ibims", fixture("ibims"), 2, None),
        ("tum", at("tum"), 2, None),
        ("scannet", at("scannet"), 3, None),
        ("hypersim", fixture("hypersim/ai_002_003"), 1, None),
        ("virtual-kitti", fixture("virtual_kitti"), 3, None),
    ];
    let scored: Vec<&str> = cases.iter().map(|case| case.0).collect();
    for layout in Layout::ALL {
        // The other tests score folders.
        let name = layout.name();
        assert!(layout == Layout::Folder || scored.contains(&name), "no case of layout {name}");
    }
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
fn the_help_names_every_layout() {
    let out = succeeded(Command::new(program("evaluate")).arg("--help").output().unwrap());
    let help = String::from_utf8(out.stdout).unwrap();
    let stored = help.split("How the data set is stored: ").nth(1).unwrap().lines().next().unwrap();
    let named: Vec<&str> = stored.split(|c: char| !c.is_alphanumeric() && c != '-').collect();
    for layout in Layout::ALL {
        assert!(named.contains(&layout.name()), "{layout} in {stored}");
    }
}
