//! What batches and records are made of.

use super::mix::SceneMix;

/// Where the true answers come from.
#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum LabelSource {
    /// Measurements that are held back from the prompt: needs no ground truth (the paper's "w/ SD").
    Sparse,
    /// The dense ground truth (the paper's "w/ GT").
    Dense,
}

/// What a batch is made of.
#[derive(Debug, Clone, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(deny_unknown_fields)]
pub struct BatchConfig {
    /// Frames per step.
    pub frames: usize,
    /// Questions per frame.
    pub questions: usize,
    /// Measurements in the prompt, at most.
    pub prompt_points: usize,
    /// Fewest and most measurements per frame, evenly in their logarithm. A few frames have 20 to 60 of them; blocks, rings and
    /// holes have as many as their sensor gives.
    pub points: (usize, usize),
    /// Where labels come from.
    pub labels: LabelSource,
    /// Frame sizes, one drawn per step; multiples of patch x merge.
    pub sizes: Vec<(usize, usize)>,
    /// Share of the frames that pass through a random camera and depth sensor; labels stay clean.
    #[serde(default)]
    pub sensors: f32,
    /// Share of the frames among whose measurements are bad ones: saturated, gross errors, left-overs at the border.
    #[serde(default)]
    pub errors: f32,
    /// Share of the questions that are drawn near depth edges; the others are drawn from all known pixels.
    #[serde(default)]
    pub edges: f32,
    /// Which scenes the frames show.
    #[serde(default)]
    pub mix: SceneMix,
}

impl BatchConfig {
    /// Name and value of a share that does not lie within 0 to 1.
    pub(super) fn wrong_share(&self) -> Option<(&'static str, f32)> {
        let shares = [("sensors", self.sensors), ("errors", self.errors), ("edges", self.edges)];
        shares.into_iter().find(|(_, share)| !(0.0..=1.0).contains(share))
    }
}

impl Default for BatchConfig {
    fn default() -> Self {
        Self {
            frames: 8,
            questions: 128,
            prompt_points: 256,
            points: (40, 1500),
            labels: LabelSource::Dense,
            sizes: vec![(256, 192), (256, 192), (224, 224), (272, 160), (320, 144), (192, 256)],
            sensors: 0.6,
            errors: 0.35,
            edges: 0.3,
            mix: SceneMix::default(),
        }
    }
}
