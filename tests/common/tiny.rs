//! Small random checkpoints, and a frame to ask them about.

use candle_core::{Device, Tensor};
use image::{Rgb, RgbImage};
use sdim::SparseDepth;
use sdim::model::SdimModel;
use sdim::query::Settings;
use sdim::query::number::Numbers;
use sdim::supervise::init::{FreshFiles, initial};
use sdim::vlm::weights::Weights;
use std::collections::HashMap;
use std::path::Path;

pub type Tensors = HashMap<String, Tensor>;

/// The files of a fresh tiny model, cut down to widths at which even token-by-token runs take milliseconds.
pub fn small_files(settings: &Settings) -> FreshFiles {
    let mut files = FreshFiles::tiny(settings).unwrap();
    let mut config: serde_json::Value = serde_json::from_str(&files.config).unwrap();
    for (pointer, value) in [
        ("/hidden_size", serde_json::json!(64)),
        ("/intermediate_size", serde_json::json!(96)),
        ("/num_hidden_layers", serde_json::json!(2)),
        ("/rope_scaling/mrope_section", serde_json::json!([2, 3, 3])),
        ("/vision_config/depth", serde_json::json!(2)),
        ("/vision_config/hidden_size", serde_json::json!(48)),
        ("/vision_config/intermediate_size", serde_json::json!(60)),
        ("/vision_config/out_hidden_size", serde_json::json!(64)),
        ("/vision_config/fullatt_block_indexes", serde_json::json!([1])),
    ] {
        *config.pointer_mut(pointer).expect(pointer) = value;
    }
    let mut preprocessor: serde_json::Value = serde_json::from_str(&files.preprocessor).unwrap();
    preprocessor["min_pixels"] = 4096.into();
    preprocessor["max_pixels"] = 8192.into();
    files.config = config.to_string();
    files.preprocessor = preprocessor.to_string();
    files
}

/// Random tensors for these files, all that they ask for.
pub fn tensors(files: &FreshFiles, seed: u64) -> Tensors {
    let parsed = files.parse().unwrap();
    let layers = parsed.config.text.layers;
    let numbers = Numbers::new(parsed.settings.number, &parsed.tokenizer).unwrap().ids;
    let empty = Weights::from_tensors("empty", Tensors::new());
    assert!(SdimModel::new(parsed, &empty, &Device::Cpu).is_err(), "built from nothing");
    initial(&empty.wanted(), &numbers, layers, seed).unwrap().into_iter().collect()
}

/// The model of these files and tensors, ready for inference.
pub fn model(files: &FreshFiles, tensors: Tensors) -> SdimModel {
    let weights = Weights::from_tensors("test", tensors);
    SdimModel::new(files.parse().unwrap(), &weights, &Device::Cpu).unwrap().fold().unwrap()
}

/// Writes a checkpoint directory.
pub fn write(dir: &Path, files: &FreshFiles, tensors: &Tensors) {
    for (name, text) in [
        ("config.json", &files.config),
        ("preprocessor_config.json", &files.preprocessor),
        ("sdim.json", &files.settings),
        ("tokenizer.json", &files.tokenizer),
    ] {
        std::fs::write(dir.join(name), text).unwrap();
    }
    std::fs::write(dir.join("model.safetensors"), safetensors::serialize(tensors, None).unwrap()).unwrap();
}

/// A frame with a pattern and a sprinkling of measurements between 1 and 9 m.
pub fn frame(width: usize, height: usize) -> (RgbImage, SparseDepth) {
    let rgb = RgbImage::from_fn(width as u32, height as u32, |x, y| {
        Rgb([(x * 5 % 256) as u8, (y * 7 % 256) as u8, ((x / 8 + y / 8) % 2 * 200) as u8])
    });
    let points: Vec<(usize, usize, f32)> = (0..width * height)
        .step_by(37)
        .map(|i| (i % width, i / width, 1.0 + (i % 101) as f32 * 0.08))
        .collect();
    (rgb, SparseDepth::from_points(width, height, &points).unwrap())
}
