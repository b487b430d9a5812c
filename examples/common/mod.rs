//! What the examples share.
#![allow(dead_code)]

pub mod stdout;

use sdim::{DepthCompleter, LoadOptions};

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
