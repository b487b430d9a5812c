//! What the examples share.
#![allow(dead_code)]

pub mod stdout;

use sdim::{DepthCompleter, LoadOptions, WeightFormat};
use std::path::{Path, PathBuf};

/// What `--device`, `--weights` and `--adapter` say.
pub fn load_options(
    device: &str,
    weights: Option<WeightFormat>,
    adapter: Option<&Path>,
) -> sdim::Result<LoadOptions> {
    let mut options = LoadOptions::on(&sdim::system::device(device)?);
    options.weights = weights.unwrap_or(options.weights);
    options.adapter = adapter.map(Path::to_path_buf);
    Ok(options)
}

/// Loads `tiny` or a checkpoint directory.
pub fn load_as(model: &str, options: &LoadOptions) -> anyhow::Result<DepthCompleter> {
    Ok(match model {
        "tiny" => DepthCompleter::tiny_with(options)?,
        dir => DepthCompleter::load(dir, options)?,
    })
}

/// Seeds of scenes that are never drawn in training, from here on.
pub const HELD_OUT: u64 = 2_000_000;

/// A file of the bundled frame.
pub fn bundled(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("assets/example").join(name)
}

/// Four decimals.
pub fn rounded(value: f64) -> String {
    format!("{value:.4}")
}
