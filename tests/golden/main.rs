//! Qwen2.5-VL against golden tensors of the reference implementation, stage by stage.
//!
//! `tests/fixtures/qwen_small` is written by `tests/reference/make_golden.py`, the models of [`family`] by
//! `tests/reference/make_family.py`. All but [`formats`] run on the device that `SDIM_TEST_DEVICE` names.

#[path = "../common/mod.rs"]
mod common;
mod family;
mod formats;
mod stages;

use candle_core::{DType, Device, Tensor};
use common::Golden;
use sdim::internals::vlm::checkpoint::weights::Weights;
use sdim::internals::vlm::qwen2_5::QwenVl;
use sdim::internals::vlm::qwen2_5::config::VlmConfig;
use sdim::internals::vlm::qwen2_5::grid::Grid;
use sdim::internals::vlm::qwen2_5::preprocess::{Pixels, PreprocessorConfig};
use sdim::settings::RopeLayout;
use stages::Case;
use std::collections::{BTreeMap, HashMap};
use std::path::{Path, PathBuf};

const CPU: Device = Device::Cpu;

fn own_fixture() -> PathBuf {
    common::root().join("tests/fixtures/qwen_small")
}

/// A second set of golden tensors that may lie beside the repository.
fn other_fixture() -> Option<PathBuf> {
    common::beside("golden", "golden.safetensors")
}

fn json(path: &Path) -> serde_json::Value {
    serde_json::from_slice(&std::fs::read(path).unwrap()).unwrap()
}

fn load(config: &serde_json::Value, weights: &Weights) -> QwenVl {
    let config = VlmConfig::from_json("config.json", config).unwrap();
    let model = QwenVl::new(config, weights, RopeLayout::Contiguous).unwrap();
    weights.finish().unwrap();
    model
}

fn weights(path: &Path) -> Weights {
    Weights::from_file(path, &common::device()).unwrap()
}

/// Compares every stage of every case of a directory; `Err` lists what differs.
fn compare(dir: &Path, config: &serde_json::Value, weights: &Weights) -> Result<String, Vec<String>> {
    let model = load(config, weights);
    let golden = Golden::open(dir);
    let file = dir.join("preprocessor_config.json");
    let preprocessor = PreprocessorConfig::from_json("preprocessor_config.json", &json(&file)).unwrap();
    resized_sizes(&golden);
    let images: BTreeMap<char, Pixels> = "abc"
        .chars()
        .filter(|name| dir.join(format!("image_{name}.png")).exists())
        .map(|name| (name, preprocess(&golden, &preprocessor, name)))
        .collect();
    for case in ["a", "b", "ab"] {
        let pixels: Vec<&Pixels> = case.chars().map(|c| &images[&c]).collect();
        let patches: Vec<Tensor> =
            pixels.iter().map(|p| preprocessor.patches(p, &common::device()).unwrap()).collect();
        let grids: Vec<Grid> = pixels.iter().map(|p| p.grid).collect();
        let run = Case { golden: &golden, model: &model, name: case, grids };
        run.check(Some(&Tensor::cat(&patches, 0).unwrap()));
    }
    golden.finish()
}

fn check(dir: &Path, config: &str, weights: &Weights) {
    match compare(dir, &json(&dir.join(config)), weights) {
        Ok(line) => println!("{config}, {line}"),
        Err(differences) => panic!("{}, {config}:\n{}", dir.display(), differences.join("\n")),
    }
}

/// Sizes before and after the resize, under several limits.
fn resized_sizes(golden: &Golden) {
    if !golden.has("smart_resize") {
        return;
    }
    let wanted = golden.integers("smart_resize");
    let ours = wanted.chunks(7).flat_map(|row| {
        let [h, w, factor, low, high] = std::array::from_fn(|i| row[i] as usize);
        let limits = serde_json::json!({"patch_size": factor / 2, "min_pixels": low, "max_pixels": high});
        let config = PreprocessorConfig::from_json("limits", &limits).unwrap();
        let (width, height) = config.smart_resize(w, h).unwrap();
        [h, w, factor, low, high, height, width].map(|v| v as i64)
    });
    golden.exact("smart_resize", ours);
}

fn preprocess(golden: &Golden, preprocessor: &PreprocessorConfig, name: char) -> Pixels {
    let rgb = image::open(golden.dir.join(format!("image_{name}.png"))).unwrap().to_rgb8();
    let pixels = preprocessor.resize(&rgb).unwrap();
    golden.exact(&format!("{name}.resized_u8"), pixels.resized.as_raw().iter().map(|&v| i64::from(v)));
    golden.close(&format!("{name}.pixel_values"), &preprocessor.patches(&pixels, &CPU).unwrap());
    pixels
}

/// The same tensors under the names that they have in memory since `transformers` 4.52.
fn renamed(path: &Path, extra: Option<(&str, Tensor)>) -> Weights {
    let tensors = candle_core::safetensors::load(path, &CPU).unwrap();
    let mut out: HashMap<String, Tensor> = tensors
        .into_iter()
        .map(|(name, tensor)| match name.strip_prefix("model.") {
            Some(rest) => (format!("model.language_model.{rest}"), tensor),
            None if name.starts_with("visual.") => (format!("model.{name}"), tensor),
            None => (name, tensor),
        })
        .collect();
    out.extend(extra.map(|(name, tensor)| (name.to_string(), tensor)));
    let bytes = safetensors::serialize(&out, None).unwrap();
    Weights::from_bytes("renamed", bytes, &common::device()).unwrap()
}

#[test]
fn own_fixture_agrees_at_every_stage() {
    let dir = own_fixture();
    check(&dir, "config.json", &weights(&dir.join("model.safetensors")));
}

#[test]
fn own_fixture_agrees_with_nested_config_and_in_memory_names() {
    let dir = own_fixture();
    check(&dir, "config_nested.json", &renamed(&dir.join("model.safetensors"), None));
}

#[test]
fn a_redundant_head_of_a_tied_checkpoint_is_not_used() {
    let dir = own_fixture();
    let config = json(&dir.join("config.json"));
    let size = |key: &str| config[key].as_u64().unwrap() as usize;
    assert_eq!(config["tie_word_embeddings"], true);
    let head = Tensor::ones((size("vocab_size"), size("hidden_size")), DType::F32, &CPU).unwrap();
    check(&dir, "config.json", &renamed(&dir.join("model.safetensors"), Some(("lm_head.weight", head))));
}

/// The comparison is sharp enough to notice each of these misreadings of a config.
#[test]
fn a_misread_config_does_not_agree() {
    let dir = own_fixture();
    let config = json(&dir.join("config.json"));
    let weights = weights(&dir.join("model.safetensors"));
    for (pointer, value, first) in [
        ("/rms_norm_eps", serde_json::json!(1e-6), "b.text_layer_0"),
        ("/rope_theta", serde_json::json!(10000.0), "b.text_cos"),
        ("/rope_scaling/mrope_section", serde_json::json!([2, 1, 1]), "b.text_cos"),
        ("/vision_config/window_size", serde_json::json!(48), "a.window_index"),
        ("/vision_config/fullatt_block_indexes", serde_json::json!([]), "a.vision_block_1"),
        ("/vision_config/fullatt_block_indexes", serde_json::json!([0, 1]), "a.vision_block_0"),
    ] {
        let mut misread = config.clone();
        *misread.pointer_mut(pointer).unwrap() = value;
        let differences = compare(&dir, &misread, &weights).expect_err(pointer);
        println!("{pointer}: {} differ, the first is {}", differences.len(), differences[0]);
        assert!(differences.iter().any(|d| d.starts_with(first)), "{pointer}: {differences:?}");
    }
}

#[test]
fn other_fixture_agrees_at_every_stage() {
    if let Some(dir) = other_fixture() {
        check(&dir, "config.json", &weights(&dir.join("model.safetensors")));
    }
}

#[test]
fn other_fixture_agrees_with_nested_config_and_in_memory_names() {
    if let Some(dir) = other_fixture() {
        check(&dir, "config_v5.json", &weights(&dir.join("model_newnames.safetensors")));
        check(&dir, "config.json", &weights(&dir.join("model_newnames.safetensors")));
        check(&dir, "config_v5.json", &weights(&dir.join("model.safetensors")));
    }
}
