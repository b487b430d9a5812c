//! Files as the field's own tools write them: depth images, pictures, clouds and calibrations.
//!
//! `tests/fixtures/files` is written by `tests/reference/make_files.py`.

mod calibrations;
mod clouds;
#[path = "../common/mod.rs"]
mod common;
mod depth;
mod program;

use serde_json::Value;
use std::path::PathBuf;

fn fixture(name: &str) -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures/files").join(name)
}

/// What the fixtures say, by NumPy.
fn expected(key: &str) -> Value {
    let text = std::fs::read(fixture("expected.json")).unwrap();
    serde_json::from_slice::<Value>(&text).unwrap()[key].take()
}

fn numbers(value: &Value) -> Vec<f64> {
    value.as_array().unwrap().iter().map(|v| v.as_f64().unwrap()).collect()
}

fn triples(value: &Value) -> Vec<[f32; 3]> {
    let triple = |v: &Value| <[f64; 3]>::try_from(numbers(v)).unwrap().map(|c| c as f32);
    value.as_array().unwrap().iter().map(triple).collect()
}
