//! The example program `evaluate`: scores, resuming, shards, figures, bad arguments.

#[path = "../common/mod.rs"]
mod common;
#[path = "../common/copies.rs"]
mod copies;
mod running;
mod scores;
mod skipped;

use common::program::program;
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
