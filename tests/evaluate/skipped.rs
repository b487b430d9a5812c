//! Frames without valid depth, and damaged ones.

use crate::common::program::program;
use crate::{Folder, results, said, succeeded, text};
use sdim::depth::io;
use serde_json::{Value, json};
use std::fs;
use std::path::PathBuf;
use std::process::Command;

/// Ground-truth files in order, and the measurements that would lie beside each.
fn files(folder: &Folder) -> Vec<(PathBuf, PathBuf)> {
    let mut truths: Vec<PathBuf> =
        fs::read_dir(folder.path("data/gt")).unwrap().map(|e| e.unwrap().path()).collect();
    truths.sort();
    let sparse = |t: &PathBuf| folder.path("data/sparse").join(t.file_name().unwrap());
    truths.iter().map(|t| (t.clone(), sparse(t))).collect()
}

/// Six frames: the second without ground truth, the third without a measurement, the fifth with all of its ground truth measured.
fn with_gaps() -> (Folder, Vec<String>) {
    let folder = Folder::new(6);
    let files = files(&folder);
    fs::create_dir(folder.path("data/sparse")).unwrap();
    let nothing = [0; 64 * 48];
    io::write_png16(&files[1].0, 64, 48, &nothing).unwrap();
    io::write_png16(&files[2].1, 64, 48, &nothing).unwrap();
    fs::copy(&files[4].0, &files[4].1).unwrap();
    let name = |(truth, _): &(PathBuf, PathBuf)| truth.file_stem().unwrap().to_str().unwrap().to_string();
    let names = files.iter().map(name).collect();
    (folder, names)
}

#[test]
fn frames_without_valid_depth_are_named_and_in_no_mean() {
    let (folder, names) = with_gaps();
    let out = succeeded(folder.classical("a", &["--json"]));
    let v: Value = serde_json::from_slice(&out.stdout).unwrap();
    let expected = json!([
        {"frame": names[1], "reason": "no ground truth"},
        {"frame": names[2], "reason": "no measurement"},
        {"frame": names[4], "reason": "no pixel left to predict"},
    ]);
    for table in v["tables"].as_array().unwrap() {
        assert_eq!((&table["frames"], &table["skipped"]), (&3.into(), &expected));
    }
    assert_eq!(said(&out).matches("skipped").count(), 2 * 3, "{}", said(&out));
    let markdown = fs::read_to_string(folder.path("a/report.md")).unwrap();
    let line = format!("Skipped, 1 of 6 frames, no measurement: {}.", names[2]);
    assert_eq!(markdown.matches(&line).count(), 2, "{markdown}");

    // The means are those of the other frames.
    let csv = fs::read_to_string(folder.path("a/frames.csv")).unwrap();
    let rows = csv.lines().map(|l| l.split(',').collect::<Vec<_>>());
    let maes: Vec<f64> =
        rows.filter(|r| r[0] == "30" && r[2] == "linear").map(|r| r[6].parse().unwrap()).collect();
    assert_eq!(maes.len(), 3);
    let mean = v["tables"][0]["methods"][1]["metrics"]["mae"]["value"].as_f64().unwrap();
    assert!((mean - maes.iter().sum::<f64>() / 3.0).abs() < 1e-12);

    // All truth of a frame may count where nothing of it is left to predict, but not where there is none.
    let all = succeeded(folder.classical("all", &["--json", "--score", "all"]));
    let v: Value = serde_json::from_slice(&all.stdout).unwrap();
    assert_eq!(v["tables"][0]["frames"], 4);
    assert_eq!(v["tables"][0]["skipped"].as_array().unwrap()[..], expected.as_array().unwrap()[..2]);
}

#[test]
fn what_was_skipped_is_remembered_however_the_work_was_divided() {
    let (folder, names) = with_gaps();
    let whole = succeeded(folder.classical("whole", &[]));
    let before = results(&folder.path("whole"));
    for part in ["0/2", "1/2"] {
        succeeded(folder.classical(&part[..1], &["--shard", part]));
    }
    let [one, two, merged] = ["0", "1", "merged"].map(|n| folder.path(n));
    let merge = ["--merge", text(&two), text(&one), "--out", text(&merged)];
    let out = succeeded(Command::new(program("evaluate")).args(merge).output().unwrap());
    assert_eq!((results(&merged), &out.stdout), (before.clone(), &whole.stdout));

    // A resumed run does not look at such a frame again, not even for a figure: its file may be gone by now.
    fs::remove_file(folder.path("whole/frames/30/000003.json")).unwrap();
    fs::write(&files(&folder)[1].0, b"not a picture").unwrap();
    let figures = folder.path("figures");
    let again = succeeded(folder.classical("whole", &["--figures", text(&figures), "--figure-tile", "64"]));
    assert_eq!((results(&folder.path("whole")), &again.stdout), (before, &whole.stdout));
    assert!(!said(&again).contains("skipped"), "{}", said(&again));
    assert_eq!(fs::read_dir(&figures).unwrap().count(), 2 * 3);
    assert!(!figures.join(format!("{}-30.png", names[1])).exists());
}

#[test]
fn a_damaged_file_is_an_error_that_names_it() {
    let folder = Folder::new(4);
    let damaged = files(&folder).remove(2).0;
    let whole = fs::read(&damaged).unwrap();
    fs::write(&damaged, &whole[..whole.len() / 2]).unwrap();
    let out = folder.classical("a", &[]);
    assert!(!out.status.success() && out.stdout.is_empty());
    assert!(said(&out).contains(damaged.file_name().unwrap().to_str().unwrap()), "{}", said(&out));
    assert!(!folder.path("a/report.md").exists());
    // What was done before it is kept, and the run goes on once the file is whole.
    let first = folder.path("a/frames/30/000000.json");
    let kept = fs::read(&first).unwrap();
    fs::write(&damaged, whole).unwrap();
    succeeded(folder.classical("a", &[]));
    assert_eq!(fs::read(&first).unwrap(), kept);
    assert!(folder.path("a/report.md").is_file());
}

#[test]
fn a_set_without_any_valid_depth_is_a_report_of_its_names() {
    let folder = Folder::new(2);
    for (truth, _) in files(&folder) {
        io::write_png16(&truth, 64, 48, &[0; 64 * 48]).unwrap();
    }
    let out = succeeded(folder.classical("a", &[]));
    let text = String::from_utf8(out.stdout).unwrap();
    assert!(text.contains("0 frames") && text.contains("2 of 2 frames, no ground truth"), "{text}");
}
