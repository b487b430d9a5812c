//! The configuration of a training run.

use super::optimiser::AdamW;
use super::recipe::{BatchConfig, LabelSource};
use crate::error::{Error, Result};
use crate::files::{read_text, write_whole};
use std::path::Path;

/// File of a run's configuration.
pub const CONFIG: &str = "train.json";

/// Everything that decides a run.
#[derive(Debug, Clone, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(deny_unknown_fields)]
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
    /// By how much more the targets are blurred at the first step than at the end: near misses teach a fresh model. Falls to 0
    /// over a quarter of the steps.
    #[serde(default = "fresh")]
    pub widen: f32,
}

/// [`TrainConfig::widen`] of a model that knows nothing.
fn fresh() -> f32 {
    7.0
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
            widen: fresh(),
        }
    }
}

impl TrainConfig {
    /// The same for a run that goes on from a checkpoint: a short warm-up, statistics of the fusion block as they are, targets as
    /// sharp as at the end of training, an average over fewer steps.
    pub fn tuning(mut self) -> Self {
        self.warmup = (self.steps / 10).clamp(1, 20);
        (self.freeze_norm_at, self.widen, self.optimiser.average) = (0.0, 0.0, 0.98);
        self
    }

    /// Reads `train.json` of a run's directory.
    ///
    /// # Errors
    /// [`Error::Io`]; [`Error::Format`] if a key is missing, unknown or of another type; [`Error::Config`] on a value out of
    /// range.
    pub fn load(dir: &Path) -> Result<Self> {
        let path = dir.join(CONFIG);
        let config: Self = serde_json::from_slice(&read_text(&path)?)
            .map_err(|e| Error::format(&path, e.to_string(), "the keys of a training configuration"))?;
        config.validate(&path.display().to_string())?;
        Ok(config)
    }

    /// Writes `train.json` into a run's directory, which must exist. What [`TrainConfig::load`] then reads is equal.
    ///
    /// # Errors
    /// [`Error::Io`]; [`Error::Config`] on a value out of range.
    pub fn save(&self, dir: &Path) -> Result<()> {
        let path = dir.join(CONFIG);
        self.validate(&path.display().to_string())?;
        let text = serde_json::to_string_pretty(self)
            .map_err(|e| Error::format(&path, e.to_string(), "values that JSON can hold"))?;
        write_whole(&path, text.as_bytes())
    }

    /// Checks the values; `file` is for messages.
    ///
    /// # Errors
    /// [`Error::Config`] names the key.
    pub fn validate(&self, file: &str) -> Result<()> {
        let (b, o) = (&self.batch, &self.optimiser);
        let share = 0.0..=1.0;
        if let Some((name, share)) = b.wrong_share() {
            return Err(Error::config(file, &format!("batch.{name}"), share.to_string(), "0 to 1"));
        }
        let checks: [(&str, bool, String, &str); 17] = [
            (
                "batch.labels",
                b.labels == LabelSource::Dense || b.mix.glazed <= 0.0,
                "sparse, with glazed scenes in the mix".into(),
                "dense: what is measured there lies behind panes",
            ),
            (
                "batch.mix",
                b.mix.check().is_ok(),
                format!("{:?}", b.mix),
                "shares of at least 0, one of them above it",
            ),
            ("steps", self.steps > 0, self.steps.to_string(), "at least 1"),
            ("rate", positive(self.rate), self.rate.to_string(), "a positive number"),
            ("batch.frames", b.frames > 0, b.frames.to_string(), "at least 1"),
            ("batch.questions", b.questions > 0, b.questions.to_string(), "at least 1"),
            (
                "batch.points",
                0 < b.points.0 && b.points.0 <= b.points.1,
                format!("{:?}", b.points),
                "at least 1, the fewest first",
            ),
            (
                "batch.sizes",
                !b.sizes.is_empty() && b.sizes.iter().all(|s| s.0 > 0 && s.1 > 0),
                format!("{:?}", b.sizes),
                "at least one size of at least 1 pixel each way",
            ),
            ("optimiser.beta1", decay(o.beta1), o.beta1.to_string(), "0 or more, below 1"),
            ("optimiser.beta2", decay(o.beta2), o.beta2.to_string(), "0 or more, below 1"),
            ("optimiser.eps", positive(o.eps), o.eps.to_string(), "a positive number"),
            (
                "optimiser.weight_decay",
                o.weight_decay.is_finite() && o.weight_decay >= 0.0,
                o.weight_decay.to_string(),
                "0 or more",
            ),
            ("optimiser.clip", positive(o.clip), o.clip.to_string(), "a positive number"),
            ("optimiser.average", decay(o.average), o.average.to_string(), "0 or more, below 1"),
            ("l1", self.l1.is_finite() && self.l1 >= 0.0, self.l1.to_string(), "0 or more"),
            (
                "freeze_norm_at",
                share.contains(&self.freeze_norm_at),
                self.freeze_norm_at.to_string(),
                "0 to 1, a share of the steps",
            ),
            ("widen", self.widen.is_finite() && self.widen >= 0.0, self.widen.to_string(), "0 or more"),
        ];
        match checks.into_iter().find(|(_, good, ..)| !good) {
            Some((key, _, found, expected)) => Err(Error::config(file, key, found, expected)),
            None => Ok(()),
        }
    }
}

fn positive(value: f32) -> bool {
    value.is_finite() && value > 0.0
}

/// Whether a value can be the share of a moving average that is kept.
fn decay(value: f32) -> bool {
    (0.0..1.0).contains(&value)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_written_is_read_back() {
        let dir = tempfile::tempdir().unwrap();
        let mut config = TrainConfig { rate: 1.0 / 3.0, seed: u64::MAX, ..Default::default() };
        config.batch.labels = LabelSource::Sparse;
        config.optimiser.eps = f32::MIN_POSITIVE;
        config.save(dir.path()).unwrap();
        assert_eq!(TrainConfig::load(dir.path()).unwrap(), config);
    }

    #[test]
    fn what_is_wrong_with_a_file_is_told() {
        let dir = tempfile::tempdir().unwrap();
        assert!(matches!(TrainConfig::load(dir.path()), Err(Error::Io { .. })));
        type Change = fn(&mut serde_json::Value);
        let read = |change: Change| {
            let mut json = serde_json::to_value(TrainConfig::default()).unwrap();
            change(&mut json);
            std::fs::write(dir.path().join(CONFIG), json.to_string()).unwrap();
            TrainConfig::load(dir.path())
        };
        assert_eq!(read(|_| {}).unwrap(), TrainConfig::default());
        let damaged: [Change; 6] = [
            |j| *j = "cut".into(),
            |j| drop(j.as_object_mut().unwrap().remove("seed")),
            |j| j["step"] = 7.into(),
            |j| j["batch"]["frame"] = 7.into(),
            |j| j["optimiser"]["momentum"] = 1.into(),
            |j| j["rate"] = serde_json::Value::Null,
        ];
        for change in damaged {
            match read(change) {
                Err(Error::Format { path, .. }) => assert_eq!(path, dir.path().join(CONFIG)),
                other => panic!("{other:?}"),
            }
        }
        let wrong: [(&str, Change); 5] = [
            ("steps", |j| j["steps"] = 0.into()),
            ("rate", |j| j["rate"] = (-0.1).into()),
            ("batch.points", |j| j["batch"]["points"] = serde_json::json!([40, 30])),
            ("batch.sizes", |j| j["batch"]["sizes"] = serde_json::json!([[64, 0]])),
            ("optimiser.average", |j| j["optimiser"]["average"] = 1.into()),
        ];
        for (wanted, change) in wrong {
            match read(change) {
                Err(Error::Config { key, file, .. }) => {
                    assert!(key == wanted && file.ends_with(CONFIG), "{key} of {file}, expected {wanted}")
                }
                other => panic!("{wanted}: {other:?}"),
            }
        }
    }

    #[test]
    fn values_that_no_file_can_hold_are_not_written() {
        let dir = tempfile::tempdir().unwrap();
        let config = TrainConfig { l1: f32::NAN, ..Default::default() };
        assert!(matches!(config.save(dir.path()), Err(Error::Config { key, .. }) if key == "l1"));
        assert_eq!(std::fs::read_dir(dir.path()).unwrap().count(), 0);
    }
}
