//! Pictures of the first frames.

use anyhow::Context;
use sdim::SparseDepth;
use sdim::benchmarks::Sample;
use sdim::draw::figure::Comparison;
use std::path::Path;

/// Writes one frame's figure, making its folder.
pub fn write(
    path: &Path,
    sample: &Sample,
    sparse: &SparseDepth,
    methods: &[(String, Vec<f32>)],
    tile_width: usize,
) -> anyhow::Result<()> {
    if let Some(folder) = path.parent() {
        std::fs::create_dir_all(folder).with_context(|| folder.display().to_string())?;
    }
    let figure = Comparison { rgb: &sample.rgb, sparse, truth: &sample.gt, methods, tile_width };
    Ok(figure.write(path)?)
}
