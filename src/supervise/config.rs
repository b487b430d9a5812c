//! The configuration of a training run.

use super::batch::BatchConfig;
use super::optimiser::AdamW;

/// Everything that decides a run.
#[derive(Debug, Clone, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct TrainConfig {
    /// Steps of the whole schedule.
    pub steps: usize,
    /// Steps of linear warm-up.
    pub warmup: usize,
    /// Peak learning rate; falls to a hundredth along a cosine.
    pub rate: f32,
    /// Seed of weights and data.
    pub seed: u64,
    /// What a step is made of.
    pub batch: BatchConfig,
    /// The optimiser.
    pub optimiser: AdamW,
    /// Weight of the L1 on the expected depth against the cross-entropy.
    pub l1: f32,
    /// Share of the steps after which normalisations use their running statistics, as inference does.
    pub freeze_norm_at: f32,
}

impl Default for TrainConfig {
    fn default() -> Self {
        Self {
            steps: 5000,
            warmup: 200,
            rate: 1.2e-3,
            seed: 7,
            batch: BatchConfig::default(),
            optimiser: AdamW::default(),
            l1: 4.0,
            freeze_norm_at: 0.5,
        }
    }
}
