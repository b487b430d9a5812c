//! The tensors that a published configuration asks for, against the published checkpoints' own lists, without weights.
//!
//! The lists are not part of the repository: the tests look for a directory beside it and say so when it is not there.

use sdim::internals::vlm::checkpoint::weights::Weights;
use sdim::internals::vlm::qwen2_5::QwenVl;
use sdim::internals::vlm::qwen2_5::config::VlmConfig;
use sdim::settings::RopeLayout;
use serde_json::Value;
use std::collections::{BTreeMap, HashMap};
use std::path::Path;

fn check(model: &str, tensors: usize, parameters: usize) {
    let dir = Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/tokenizer");
    let read = |name: String| -> Option<Value> {
        Some(serde_json::from_slice(&std::fs::read(dir.join(name)).ok()?).unwrap())
    };
    let (config, shapes) =
        (read(format!("config-{model}.json")), read(format!("tensor_shapes-{model}.json")));
    let (Some(config), Some(shapes)) = (config, shapes) else {
        return println!("skipped: {} does not hold the lists", dir.display());
    };
    let shapes: BTreeMap<String, Vec<usize>> = serde_json::from_value(shapes).unwrap();
    let config = VlmConfig::from_json("config.json", &config).unwrap();
    let nothing = Weights::from_tensors("nothing", HashMap::new());
    QwenVl::new(config, &nothing, RopeLayout::Contiguous).unwrap();
    let wanted = nothing.wanted();
    let differ = |a: &BTreeMap<String, Vec<usize>>, b: &BTreeMap<String, Vec<usize>>| {
        a.iter()
            .filter(|&(name, shape)| b.get(name) != Some(shape))
            .map(|(n, s)| format!("{n} {s:?}"))
            .collect()
    };
    let (extra, lacking): (Vec<String>, Vec<String>) = (differ(&wanted, &shapes), differ(&shapes, &wanted));
    assert!(extra.is_empty() && lacking.is_empty(), "{model}: asks for {extra:?}, published are {lacking:?}");
    let values: usize = wanted.values().map(|s| s.iter().product::<usize>()).sum();
    assert_eq!((wanted.len(), values), (tensors, parameters), "{model}");
}

#[test]
fn the_3b_model_asks_for_the_published_tensors() {
    check("3b", 824, 3_754_622_976);
}

#[test]
fn the_7b_model_asks_for_the_published_tensors() {
    check("7b", 729, 8_292_166_656);
}
