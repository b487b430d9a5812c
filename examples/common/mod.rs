//! What the examples share.
#![allow(dead_code)]

use sdim::DepthCompleter;
use sdim::system::device;
use std::path::Path;

/// Loads `tiny` or a checkpoint directory, with an adapter if given.
pub fn load(model: &str, adapter: Option<&Path>, device_name: &str) -> anyhow::Result<DepthCompleter> {
    let device = device(device_name)?;
    Ok(match (model, adapter) {
        ("tiny", None) => DepthCompleter::tiny_on(&device)?,
        ("tiny", Some(_)) => {
            anyhow::bail!("--adapter goes with a checkpoint directory, not with --model tiny")
        }
        (dir, None) => DepthCompleter::load(dir, &device)?,
        (dir, Some(adapter)) => DepthCompleter::load_adapted(dir, adapter, &device)?,
    })
}

/// Four significant decimals.
pub fn rounded(value: f64) -> String {
    format!("{value:.4}")
}
