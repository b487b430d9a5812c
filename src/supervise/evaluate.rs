//! A quick look at a model while it trains: relative error on held-out procedural scenes against interpolation.

use super::batch::mix;
use crate::depth::{interpolate, sample_points};
use crate::error::Result;
use crate::model::{AskOptions, SdimModel, ask};
use crate::query::Query;
use crate::scenes::procedural;
use rand::Rng;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;

/// Mean over scenes of mean |error| / mean depth, at pixels drawn at random.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct HeldOut {
    /// The model's answers as they are, without alignment.
    pub model: f32,
    /// Delaunay-linear interpolation of the same measurements.
    pub linear: f32,
}

/// Pixels asked per scene.
const PIXELS: usize = 1024;

/// Evaluates on the scenes of these seeds. Training draws its scenes from all 64-bit seeds, so it does not meet these.
///
/// # Errors
/// [`crate::Error::NoMeasurement`] if a scene has no pixel left to ask; errors of the scenes and the model.
pub fn evaluate(model: &SdimModel, scenes: u64, points: usize, first_seed: u64) -> Result<HeldOut> {
    let mut sum = HeldOut { model: 0.0, linear: 0.0 };
    for seed in first_seed..first_seed + scenes {
        let frame = procedural(seed, 256, 192)?;
        let sparse = sample_points(&frame.depth, 256, 192, points, seed)?;
        let linear = interpolate::linear(&sparse)?;
        let mut rng = ChaCha8Rng::seed_from_u64(mix(seed, 1));
        let open = |i: &usize| frame.depth[*i].is_finite() && sparse.as_slice()[*i].is_nan();
        let candidates: Vec<usize> = (0..256 * 192).filter(open).collect();
        if candidates.is_empty() {
            return Err(crate::Error::NoMeasurement { width: 256, height: 192 });
        }
        let queries: Vec<Query> = (0..PIXELS)
            .map(|_| candidates[rng.random_range(0..candidates.len())])
            .map(|i| Query { x: i % 256, y: i / 256, measured: None, hint: linear[i] })
            .collect();
        let (pixels, scattered) = model.preprocess(&frame.rgb, &sparse)?;
        let tokens = model.encode(&pixels, &scattered)?;
        let prefix = model.prefill_prefix(&pixels, &tokens, &sparse)?;
        let answers = ask(model, &prefix, &queries, AskOptions::default())?;
        let (mut off, mut off_linear, mut depth) = (0.0, 0.0, 0.0);
        for (q, a) in queries.iter().zip(answers) {
            let truth = frame.depth[q.y * 256 + q.x];
            off += (a.value - truth).abs();
            off_linear += (q.hint - truth).abs();
            depth += truth;
        }
        sum.model += off / depth / scenes as f32;
        sum.linear += off_linear / depth / scenes as f32;
    }
    Ok(sum)
}
