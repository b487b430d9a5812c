//! Sharded checkpoints: the same model from several files, and an index that lies.

use candle_core::{DType, Device, Tensor};
use sdim::Error;
use sdim::LoadOptions;
use sdim::internals::model::SdimModel;
use sdim::internals::supervise::{TrainConfig, Trainer};
use sdim::settings::Settings;
use serde_json::{Map, Value, json};
use std::collections::HashMap;
use std::path::Path;

/// A fresh checkpoint cut into two files with an index; returns the directory of the whole one and of the cut one.
fn checkpoints(dir: &Path) -> (std::path::PathBuf, std::path::PathBuf) {
    let (whole, cut) = (dir.join("whole"), dir.join("cut"));
    Trainer::new(TrainConfig::default(), &Settings::tiny()).unwrap().publish(&whole).unwrap();
    std::fs::create_dir(&cut).unwrap();
    for name in ["config.json", "preprocessor_config.json", "sdim.json", "tokenizer.json"] {
        std::fs::copy(whole.join(name), cut.join(name)).unwrap();
    }
    let tensors = candle_core::safetensors::load(whole.join("model.safetensors"), &Device::Cpu).unwrap();
    let (mut map, mut parts) = (Map::new(), [HashMap::new(), HashMap::new()]);
    for (i, (name, tensor)) in tensors.into_iter().enumerate() {
        map.insert(name.clone(), Value::from(format!("part-{}.safetensors", i % 2)));
        parts[i % 2].insert(name, tensor);
    }
    for (i, part) in parts.iter().enumerate() {
        candle_core::safetensors::save(part, cut.join(format!("part-{i}.safetensors"))).unwrap();
    }
    write_index(&cut, &Value::Object(map));
    (whole, cut)
}

fn write_index(dir: &Path, map: &Value) {
    let index = json!({"metadata": {"total_size": 1}, "weight_map": map});
    std::fs::write(dir.join("model.safetensors.index.json"), index.to_string()).unwrap();
}

fn index(dir: &Path) -> Value {
    let text = std::fs::read(dir.join("model.safetensors.index.json")).unwrap();
    serde_json::from_slice::<Value>(&text).unwrap()["weight_map"].clone()
}

#[test]
fn shards_hold_the_same_model() {
    let dir = tempfile::tempdir().unwrap();
    let (whole, cut) = checkpoints(dir.path());
    let [a, b] = [&whole, &cut].map(|d| SdimModel::load(d, &LoadOptions::default()).unwrap());
    let ids: Vec<u32> = (0..300).collect();
    let rows = |m: &SdimModel| -> Vec<f32> {
        m.vlm.decoder.embed(&ids).unwrap().flatten_all().unwrap().to_vec1().unwrap()
    };
    assert_eq!(rows(&a), rows(&b));
}

#[test]
fn a_wrong_index_or_shard_is_named() {
    let dir = tempfile::tempdir().unwrap();
    let (_, cut) = checkpoints(dir.path());
    let map = index(&cut);
    let says = |needle: &str| {
        let error = SdimModel::load(&cut, &LoadOptions::default()).err().expect("an error");
        assert!(error.to_string().contains(needle), "{error}");
        error
    };
    for file in ["../part-0.safetensors", "/etc/passwd", "", "a/b"] {
        let mut bad = map.clone();
        bad["model.norm.weight"] = json!(file);
        write_index(&cut, &bad);
        assert!(matches!(says("index.json"), Error::Format { .. }), "{file}");
    }
    let mut more = map.clone();
    more["model.absent.weight"] = json!("part-0.safetensors");
    write_index(&cut, &more);
    says("model.absent.weight");
    write_index(&cut, &json!([1]));
    says("weight_map");
    write_index(&cut, &map);
    let bytes = std::fs::read(cut.join("part-1.safetensors")).unwrap();
    std::fs::write(cut.join("part-1.safetensors"), &bytes[..bytes.len() - 7]).unwrap();
    assert!(matches!(says("part-1.safetensors"), Error::Format { .. }));
    std::fs::remove_file(cut.join("part-1.safetensors")).unwrap();
    assert!(matches!(says("part-1.safetensors"), Error::Io { .. }));
    let stray = Tensor::zeros(3, DType::F32, &Device::Cpu).unwrap();
    candle_core::safetensors::save(&HashMap::from([("stray", stray)]), cut.join("model.safetensors"))
        .unwrap();
    assert!(matches!(says("stray"), Error::TensorSet { .. }), "one file goes before the index");
}
