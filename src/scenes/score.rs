//! Scores of the model and of classical interpolation on one frame.

use super::patterns::SparsePattern;
use crate::benchmarks::Sample;
use crate::complete::{CompleteOptions, DepthCompleter};
use crate::depth::metrics::{Errors, errors};
use crate::depth::{SparseDepth, interpolate};
use crate::error::Result;

/// Names of the methods, in the order of [`score`]'s result.
pub const METHODS: [&str; 3] = ["sdim", "nearest", "linear"];

/// The measurements of a frame: its own, or this many points drawn from the ground truth.
///
/// # Errors
/// [`crate::Error::NoMeasurement`] if the ground truth is empty.
pub fn measurements(sample: &Sample, points: usize, seed: u64) -> Result<SparseDepth> {
    sample.measurements(points, SparsePattern::Uniform, seed)
}

/// Errors of each of [`METHODS`] over ground-truth pixels that were not given as input.
///
/// # Errors
/// As [`DepthCompleter::complete`] and [`errors`].
pub fn score(
    completer: &DepthCompleter,
    sample: &Sample,
    sparse: &SparseDepth,
    options: &CompleteOptions,
) -> Result<[Errors; 3]> {
    let map = completer.complete(&sample.rgb, sparse, options)?;
    Ok([
        errors(map.depth(), &sample.gt, sparse)?,
        errors(&interpolate::nearest(sparse)?, &sample.gt, sparse)?,
        errors(&interpolate::linear(sparse)?, &sample.gt, sparse)?,
    ])
}
