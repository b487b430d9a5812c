//! Adapters as PEFT saves them, and with it most tools that fine-tune (ms-swift, TRL): `adapter_config.json` and
//! `adapter_model.safetensors`.
//!
//! The tensors have the names of ours, `{layer}.lora_A.weight` and `{layer}.lora_B.weight`, below the prefix `base_model.model.`, which
//! [`published_name`] takes off. Source: `LoraConfig` and `save_pretrained` of PEFT.

use super::files::SETTINGS;
use crate::error::{Error, Result};
use crate::vlm::checkpoint::StoredFile;
use crate::vlm::checkpoint::json::{Node, read_json};
use crate::vlm::checkpoint::lora::LoraConfig;
use crate::vlm::checkpoint::weights::published_name;
use serde_json::Value;
use std::path::Path;

const CONFIG: &str = "adapter_config.json";
/// File of the tensors.
pub(super) const PEFT_TENSORS: &str = "adapter_model.safetensors";

/// Variants of LoRA that change the layer in another way than `W + scale B A`, or the base itself.
const OTHER: [&str; 11] = [
    "use_dora",
    "rank_pattern",
    "alpha_pattern",
    "fan_in_fan_out",
    "lora_bias",
    "use_qalora",
    "layer_replication",
    "trainable_token_indices",
    "target_parameters",
    "alora_invocation_tokens",
    "use_bdlora",
];

/// Whether a directory holds such an adapter and none of ours.
pub(super) fn is_peft(dir: &Path) -> bool {
    dir.join(CONFIG).exists() && !dir.join(SETTINGS).exists()
}

/// Rank, scale and layers of the adapter. The layers are those that have factors in the file: `target_modules` may be a pattern.
///
/// # Errors
/// [`Error::Config`] names a key whose value is not plain LoRA; [`Error::Format`] for a file without factors.
pub(super) fn lora(dir: &Path) -> Result<LoraConfig> {
    let path = dir.join(CONFIG);
    let json = read_json(&path)?;
    let file = path.display().to_string();
    let node = Node::new(&file, "", &json);
    match json.get("peft_type") {
        Some(Value::String(kind)) if kind == "LORA" => {}
        _ => return node.wrong("peft_type", "\"LORA\": nothing else can be applied"),
    }
    for key in OTHER {
        if json.get(key).is_some_and(is_used) {
            return node.wrong(key, "nothing: plain LoRA with one rank and one alpha is what can be applied");
        }
    }
    // These begin with other weights of the base than the published ones.
    match json.get("init_lora_weights") {
        None | Some(Value::Null | Value::Bool(_)) => {}
        Some(Value::String(way)) if ["gaussian", "eva", "orthogonal"].contains(&way.as_str()) => {}
        _ => {
            return node.wrong(
                "init_lora_weights",
                "one that leaves the base as it is (true, false, \"gaussian\", \"eva\")",
            );
        }
    }
    let rank = node.size_up_to("r", 4096)?;
    let alpha = node.positive_or("lora_alpha", 8.0)?;
    // The addition is scaled by alpha / rank here; by alpha / sqrt(rank) in Kalajdzievski, "A Rank Stabilization Scaling Factor for
    // Fine-Tuning with LoRA" (2023).
    let rank_stabilised = json.get("use_rslora").is_some_and(is_used);
    let alpha = if rank_stabilised { alpha * (rank as f64).sqrt() } else { alpha };
    Ok(LoraConfig { rank, alpha: alpha as f32, targets: layers(&dir.join(PEFT_TENSORS))? })
}

/// Whether a value of a key says that its feature is in use.
fn is_used(value: &Value) -> bool {
    match value {
        Value::Null | Value::Bool(false) => false,
        Value::Array(list) => !list.is_empty(),
        Value::Object(map) => !map.is_empty(),
        _ => true,
    }
}

fn layers(path: &Path) -> Result<Vec<String>> {
    let tensors = StoredFile::open(path)?.tensors()?;
    let layer = |name: &String| published_name(name).strip_suffix(".lora_A.weight").map(String::from);
    let mut layers: Vec<String> = tensors.iter().filter_map(|(name, _)| layer(name)).collect();
    layers.sort();
    if layers.is_empty() {
        let expected = "tensors base_model.model.{layer}.lora_A.weight and .lora_B.weight";
        return Err(Error::format(path, "no factors of LoRA", expected));
    }
    Ok(layers)
}
