//! Which layers of a checkpoint carry LoRA factors, as `sdim.json` says it.

use crate::error::{Error, Result};

/// LoRA in `sdim.json`.
#[derive(Debug, Clone, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct LoraConfig {
    /// Rows of A and columns of B.
    pub rank: usize,
    /// The addition is scaled by `alpha / rank`.
    pub alpha: f32,
    /// Names of the layers that carry it, or their last parts (`q_proj`, `gate_proj`, `qkv`), as PEFT's `target_modules`.
    pub targets: Vec<String>,
}

/// What is done with LoRA factors at load.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum LoraMode {
    /// Added to the weight: no cost per token.
    #[default]
    Merge,
    /// Kept beside the weight, in f32: the weight stays the base's own.
    Apart,
}

impl LoraConfig {
    /// Checks the values.
    ///
    /// # Errors
    /// [`Error::Config`] names the field of `sdim.json`.
    #[doc(hidden)]
    pub fn validate(&self, file: &str) -> Result<()> {
        if !(1..=4096).contains(&self.rank) {
            return Err(Error::config(file, "lora.rank", self.rank.to_string(), "1 to 4096"));
        }
        if !self.alpha.is_finite() {
            return Err(Error::config(file, "lora.alpha", self.alpha.to_string(), "a finite number"));
        }
        if self.targets.is_empty() || self.targets.iter().any(String::is_empty) {
            let found = format!("{:?}", self.targets);
            return Err(Error::config(file, "lora.targets", found, "names of linear layers"));
        }
        Ok(())
    }

    pub(crate) fn covers(&self, layer: &str) -> bool {
        self.targets
            .iter()
            .any(|t| layer.strip_suffix(t.as_str()).is_some_and(|l| l.is_empty() || l.ends_with('.')))
    }
}

/// Which layers of a checkpoint carry LoRA, and what becomes of it.
#[derive(Debug, Clone, Default)]
pub struct LoraSet {
    /// `None`: no layer does.
    pub config: Option<LoraConfig>,
    /// Merged or apart.
    pub mode: LoraMode,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn targets_are_last_parts_of_names() {
        let config =
            LoraConfig { rank: 4, alpha: 8.0, targets: vec!["q_proj".into(), "mlp.down_proj".into()] };
        assert!(config.covers("model.layers.0.self_attn.q_proj"));
        assert!(config.covers("model.layers.0.mlp.down_proj"));
        assert!(!config.covers("model.layers.0.self_attn.xq_proj"));
        assert!(config.covers("q_proj"));
        assert!(!config.covers("visual.blocks.0.down_proj"));
    }

    #[test]
    fn values_out_of_range_are_named() {
        let good = LoraConfig { rank: 4, alpha: 8.0, targets: vec!["q_proj".into()] };
        good.validate("sdim.json").unwrap();
        let key = |c: LoraConfig| match c.validate("sdim.json") {
            Err(Error::Config { key, .. }) => key,
            other => panic!("{other:?}"),
        };
        assert_eq!(key(LoraConfig { rank: 0, ..good.clone() }), "lora.rank");
        assert_eq!(key(LoraConfig { alpha: f32::NAN, ..good.clone() }), "lora.alpha");
        assert_eq!(key(LoraConfig { targets: vec![], ..good }), "lora.targets");
    }
}
