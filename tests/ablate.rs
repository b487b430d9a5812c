//! The ablation: every cell runs, what is done is not done again, and other results are not mixed in.

mod common;

use common::program::program;
use serde_json::Value;
use std::path::Path;
use std::process::{Command, Output};

fn run(out: &Path, flags: &[&str]) -> Output {
    let out = out.to_str().unwrap();
    Command::new(program("ablate")).args(["--out", out]).args(flags).output().unwrap()
}

#[test]
fn every_cell_runs_and_a_finished_one_is_kept() {
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("out");
    let done = run(&out, &["--quick", "--seeds", "1"]);
    let said = String::from_utf8_lossy(&done.stderr).into_owned();
    assert!(done.status.success(), "{said}");
    let table = String::from_utf8(done.stdout).unwrap();
    let rows = [
        "(a) concatenation",
        "(b)",
        "(c)",
        "(d)",
        "(e)",
        "(f)",
        "pointer",
        "coordinates",
        "marker",
        "glimpse",
    ];
    assert!(rows.iter().all(|row| table.contains(row)), "{table}");
    assert_eq!(std::fs::read_to_string(out.join("table.md")).unwrap(), table);
    let v: Value = serde_json::from_slice(&std::fs::read(out.join("ablation.json")).unwrap()).unwrap();
    let cells = v["cells"].as_array().unwrap();
    assert_eq!(cells.len(), 13);
    for cell in cells {
        let error = cell["procedural_mae"]["mean"].as_f64().unwrap();
        assert!(error.is_finite() && error > 0.0, "{cell}");
    }

    // A mark where a finished cell was: it is read, not made again. What is missing is.
    let kept = out.join("c-1.json");
    let text = std::fs::read_to_string(&kept).unwrap().replace("\"cell\":\"c\"", "\"cell\":\"kept\"");
    std::fs::write(&kept, &text).unwrap();
    let missing = out.join("marker-1.json");
    let before = std::fs::read(&missing).unwrap();
    std::fs::remove_file(&missing).unwrap();
    assert!(run(&out, &["--quick", "--seeds", "1", "--cells", "c,marker"]).status.success());
    assert_eq!(std::fs::read_to_string(&kept).unwrap(), text);
    let scores = |bytes: &[u8]| serde_json::from_slice::<Value>(bytes).unwrap()["scores"].clone();
    assert_eq!(
        scores(&std::fs::read(&missing).unwrap()),
        scores(&before),
        "the same seed gives the same scores"
    );

    for (flags, words) in [(&["--seeds", "1"][..], "plan.json"), (&["--quick", "--cells", "g"], "--cells g")]
    {
        let refused = run(&out, flags);
        let said = String::from_utf8_lossy(&refused.stderr).into_owned();
        assert!(!refused.status.success() && said.contains(words) && !said.contains("panicked"), "{said}");
    }
}
