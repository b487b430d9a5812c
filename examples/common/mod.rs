//! What the examples share.
#![allow(dead_code)]

pub mod stdout;

use sdim::system::device;
use sdim::{DepthCompleter, LoadOptions};
use std::path::Path;

/// Loads `tiny` or a checkpoint directory, with an adapter if given.
pub fn load(model: &str, adapter: Option<&Path>, device_name: &str) -> anyhow::Result<DepthCompleter> {
    load_as(
        model,
        &LoadOptions { adapter: adapter.map(Path::to_path_buf), ..LoadOptions::on(&device(device_name)?) },
    )
}

/// Loads `tiny` or a checkpoint directory.
pub fn load_as(model: &str, options: &LoadOptions) -> anyhow::Result<DepthCompleter> {
    Ok(match model {
        "tiny" => DepthCompleter::tiny_with(options)?,
        dir => DepthCompleter::load_with(dir, options)?,
    })
}

/// Four decimals.
pub fn rounded(value: f64) -> String {
    format!("{value:.4}")
}
