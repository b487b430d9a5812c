//! Benchmarks: each loader on a small copy in the published layout, and on damaged ones.

#[path = "../common/copies.rs"]
mod copies;

mod containers;
mod general;
mod pictures;
mod recordings;
mod rendered;

use std::fs;
use std::path::Path;

use copies::{H, W, depth, grey8};
use sdim::benchmarks::{Dataset, Layout, LayoutOptions, Sample};
use sdim::depth::io;
use sdim::{Error, Result};

fn open(layout: Layout, dir: &Path) -> Result<Box<dyn Dataset>> {
    layout.open(dir, &LayoutOptions::default())
}

fn all(layout: Layout, dir: &Path) -> Result<Vec<Sample>> {
    let set = open(layout, dir)?;
    let samples: Vec<Sample> = (0..set.len()).map(|i| set.load(i)).collect::<Result<_>>()?;
    for (index, sample) in samples.iter().enumerate() {
        assert_eq!(set.has_measurements(index), sample.sparse.is_some(), "{}", sample.name);
    }
    assert!(!set.has_measurements(samples.len()), "beyond the last frame");
    Ok(samples)
}

/// Opening and loading everything fails with a message that names these.
#[track_caller]
fn says(layout: Layout, dir: &Path, needles: &[&str]) {
    let error = all(layout, dir).map(|s| s.len()).unwrap_err();
    assert!(matches!(error, Error::Format { .. } | Error::Io { .. }), "{error:?}");
    let error = error.to_string();
    for needle in needles {
        assert!(error.contains(needle), "{needle}: {error}");
    }
}

/// Number of frames, all of which can be loaded, without valid ground truth or without measurements where they bring some.
fn without_depth(layout: Layout, dir: &Path) -> usize {
    let nothing =
        |s: &&Sample| s.gt.iter().all(|d| d.is_nan()) || s.sparse.as_ref().is_some_and(|s| s.measured() == 0);
    all(layout, dir).unwrap().iter().filter(nothing).count()
}

/// The usual damage to a 16-bit depth file, each undone afterwards.
#[track_caller]
fn damage(layout: Layout, dir: &Path, file: &str) {
    let path = dir.join(file);
    let name = path.file_name().unwrap().to_str().unwrap();
    let whole = fs::read(&path).unwrap();
    assert_eq!(without_depth(layout, dir), 0);
    fs::write(&path, &whole[..whole.len() / 2]).unwrap();
    says(layout, dir, &[name]);
    fs::write(&path, b"").unwrap();
    says(layout, dir, &[name]);
    grey8(&path);
    says(layout, dir, &[name, "8-bit grey"]);
    depth(path.clone(), |_, _| 0);
    assert_eq!(without_depth(layout, dir), 1, "{name}: no damage, but nothing was measured");
    io::write_png16(&path, W, H + 1, &[300; W * (H + 1)]).unwrap();
    says(layout, dir, &[name, "24x17", "24x16"]);
    let mut lie = whole.clone();
    lie[16..24].copy_from_slice(&[0, 0, 0x3f, 0, 0, 0, 0x3f, 0]);
    fs::write(&path, lie).unwrap();
    says(layout, dir, &[name]);
    fs::remove_file(&path).unwrap();
    says(layout, dir, &[Path::new(name).file_stem().unwrap().to_str().unwrap()]);
    fs::write(&path, whole).unwrap();
    all(layout, dir).unwrap();
}

fn points(sample: &Sample) -> Vec<(usize, usize, f32)> {
    sample.sparse.as_ref().unwrap().points().collect()
}
