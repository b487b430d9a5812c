//! Resuming, shards, settings, figures, bad arguments.

use crate::common::program::program;
use crate::{Folder, results, said, succeeded, text};
use std::fs;
use std::path::PathBuf;
use std::process::Command;

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
    // The same frames the other way round get other points.
    let names = fs::read_dir(folder.path("data/gt")).unwrap().map(|e| e.unwrap().path());
    let mut names: Vec<String> =
        names.map(|p| p.file_stem().unwrap().to_str().unwrap().to_string()).collect();
    names.sort();
    names.reverse();
    let turned = folder.path("turned.txt");
    fs::write(&turned, names.join("\n")).unwrap();
    let cases: [(&[&str], &str); 7] = [
        (&["--seed", "3"], "`seed`"),
        (&["--score", "all"], "`score`"),
        (&["--resample"], "`resample`"),
        (&["--pattern", "sfm"], "`pattern`"),
        (&["--limit", "1"], "`frames`"),
        (&["--range", "1,5"], "`range`"),
        (&["--frame-list", text(&turned)], "`names`"),
    ];
    for (more, named) in cases {
        let out = folder.classical("a", more);
        assert!(!out.status.success() && said(&out).contains(named), "{more:?}: {}", said(&out));
        assert!(said(&out).contains("settings.json") && out.stdout.is_empty());
    }
    assert_eq!(results(&folder.path("a")), before);
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
    let list = folder.path("list.txt");
    fs::write(&list, "scene0707_00/343").unwrap();
    let cases: [(&[&str], &str); 16] = [
        (&["--frame-list", text(&list)], "\"scene0707_00/343\", no such frame"),
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
    let alone: [(&[&str], &str); 8] = [
        // What would change nothing is not taken without a word.
        (&["--merge", "a", "--score", "all"], "--score"),
        (&["--merge", "a", "--points", "100"], "--points"),
        (&["--procedural", "2", "--range", "1,5"], "--range"),
        (&["--procedural", "2", "--frame-list", "list.txt"], "--frame-list"),
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
