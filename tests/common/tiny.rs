//! Small random checkpoints, and a frame to ask them about.

use candle_core::{Device, Tensor};
use image::{Rgb, RgbImage};
use sdim::SparseDepth;
use sdim::internals::model::{SdimModel, initial};
use sdim::internals::query::number::Numbers;
use sdim::internals::supervise::FreshFiles;
use sdim::internals::vlm::checkpoint::weights::Weights;
use sdim::settings::Settings;
use std::collections::HashMap;
use std::path::Path;

pub type Tensors = HashMap<String, Tensor>;

/// Sizes of a test model: patches of 8 pixels, merged 2x2.
#[derive(Debug, Clone, Copy)]
pub struct Shape {
    pub hidden: usize,
    pub layers: usize,
    pub heads: usize,
    pub kv_heads: usize,
    pub section: [usize; 3],
    pub tied: bool,
    pub vision_depth: usize,
    pub vision_hidden: usize,
    pub vision_heads: usize,
    /// Side of an attention window, pixels.
    pub window: usize,
    /// Blocks with full attention.
    pub full: &'static [usize],
    /// Fewest and most pixels of the resized image.
    pub pixels: (usize, usize),
}

/// Widths at which even token-by-token runs take milliseconds.
pub const SMALL: Shape = Shape {
    hidden: 64,
    layers: 2,
    heads: 4,
    kv_heads: 2,
    section: [2, 3, 3],
    tied: true,
    vision_depth: 2,
    vision_hidden: 48,
    vision_heads: 4,
    window: 64,
    full: &[1],
    pixels: (4096, 8192),
};

/// Larger ones: grouped, separate and one common key head; windows that do not divide the grid; first, some and no blocks
/// with full attention.
pub const MIDDLE: [Shape; 3] = [
    Shape {
        hidden: 256,
        layers: 5,
        heads: 8,
        section: [4, 6, 6],
        tied: false,
        vision_depth: 5,
        vision_hidden: 128,
        window: 48,
        full: &[2, 4],
        pixels: (16384, 24576),
        ..SMALL
    },
    Shape {
        hidden: 144,
        layers: 3,
        heads: 6,
        kv_heads: 6,
        section: [4, 4, 4],
        vision_depth: 3,
        vision_heads: 3,
        window: 32,
        full: &[0],
        ..SMALL
    },
    Shape {
        hidden: 128,
        layers: 4,
        heads: 8,
        kv_heads: 1,
        tied: false,
        vision_depth: 3,
        window: 80,
        full: &[],
        pixels: (12288, 16384),
        ..SMALL
    },
];

/// The files of a fresh tiny model, cut down to [`SMALL`].
pub fn small_files(settings: &Settings) -> FreshFiles {
    files(settings, &SMALL)
}

/// The files of a fresh tiny model with other sizes.
pub fn files(settings: &Settings, shape: &Shape) -> FreshFiles {
    let mut files = FreshFiles::tiny(settings).unwrap();
    let mut config: serde_json::Value = serde_json::from_str(&files.config).unwrap();
    for (pointer, value) in [
        ("/hidden_size", serde_json::json!(shape.hidden)),
        ("/intermediate_size", serde_json::json!(shape.hidden * 3 / 2)),
        ("/num_hidden_layers", serde_json::json!(shape.layers)),
        ("/num_attention_heads", serde_json::json!(shape.heads)),
        ("/num_key_value_heads", serde_json::json!(shape.kv_heads)),
        ("/rope_scaling/mrope_section", serde_json::json!(shape.section)),
        ("/tie_word_embeddings", serde_json::json!(shape.tied)),
        ("/vision_config/depth", serde_json::json!(shape.vision_depth)),
        ("/vision_config/hidden_size", serde_json::json!(shape.vision_hidden)),
        ("/vision_config/intermediate_size", serde_json::json!(shape.vision_hidden * 5 / 4)),
        ("/vision_config/num_heads", serde_json::json!(shape.vision_heads)),
        ("/vision_config/window_size", serde_json::json!(shape.window)),
        ("/vision_config/out_hidden_size", serde_json::json!(shape.hidden)),
        ("/vision_config/fullatt_block_indexes", serde_json::json!(shape.full)),
    ] {
        *config.pointer_mut(pointer).expect(pointer) = value;
    }
    let mut preprocessor: serde_json::Value = serde_json::from_str(&files.preprocessor).unwrap();
    preprocessor["min_pixels"] = shape.pixels.0.into();
    preprocessor["max_pixels"] = shape.pixels.1.into();
    files.config = config.to_string();
    files.preprocessor = preprocessor.to_string();
    files
}

/// The text of a token, as the vocabulary has it.
pub fn token(files: &FreshFiles, id: u32) -> String {
    let tokenizer: serde_json::Value = serde_json::from_str(&files.tokenizer).unwrap();
    let vocabulary =
        tokenizer["model"]["vocab"].as_object().unwrap().iter().map(|(text, id)| (text.as_str(), id));
    let added = tokenizer["added_tokens"].as_array().unwrap().iter();
    let added = added.map(|t| (t["content"].as_str().unwrap(), &t["id"]));
    vocabulary.chain(added).find(|(_, i)| **i == id).unwrap().0.to_string()
}

/// Gives the tensors that start at zero values of their own, since fresh ones would hide whose crop goes where and what the
/// fusion block does; and makes a head of its own speak up, so that answers differ.
pub fn wake(tensors: &mut Tensors) {
    for (name, scale) in [
        ("sdim.glimpse.weight", 0.02),
        ("sdim.wide_glimpse.down.weight", 0.02),
        ("sdim.fusion.depth.conv.weight", 0.3),
        ("sdim.fusion.out.weight", 0.3),
    ] {
        if let Some(tensor) = tensors.get_mut(name) {
            let wave = (0..tensor.elem_count()).map(|i| (i as f32 * 0.37).sin() * scale);
            *tensor = Tensor::from_vec(wave.collect::<Vec<f32>>(), tensor.dims(), &Device::Cpu).unwrap();
        }
    }
    if let Some(head) = tensors.get_mut("lm_head.weight") {
        *head = (&*head * 8.0).unwrap();
    }
}

/// Random tensors for these files, all that they ask for.
pub fn tensors(files: &FreshFiles, seed: u64) -> Tensors {
    let parsed = files.parse().unwrap();
    let layers = parsed.config.text.layers;
    let (format, source) = (parsed.settings.number, parsed.settings.number_tokens);
    let numbers = Numbers::new(format, source, &parsed.tokenizer).unwrap().ids;
    let empty = Weights::from_tensors("empty", Tensors::new());
    assert!(SdimModel::new(parsed, &empty, &Device::Cpu).is_err(), "built from nothing");
    initial(&empty.wanted(), &numbers, layers, seed).unwrap().into_iter().collect()
}

/// The model of these files and tensors on [`super::device`], ready for inference.
pub fn model(files: &FreshFiles, tensors: Tensors) -> SdimModel {
    let device = super::device();
    let placed = tensors.into_iter().map(|(name, t)| (name, t.to_device(&device).unwrap()));
    let weights = Weights::from_tensors("test", placed.collect());
    SdimModel::new(files.parse().unwrap(), &weights, &device).unwrap().fold().unwrap()
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
