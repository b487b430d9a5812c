//! Damaged and hostile checkpoints: a typed error that names the file, key or tensor; never a panic.

mod common;

use candle_core::{DType, Device, Tensor};
use common::tiny::{self, Tensors};
use sdim::Error;
use sdim::internals::model::{AskOptions, SdimModel, ask};
use sdim::internals::query::Query;
use sdim::internals::supervise::FreshFiles;
use sdim::settings::Settings;
use serde_json::{Value, json};
use std::path::PathBuf;
use tempfile::TempDir;

/// A good checkpoint in a directory of its own, to be damaged.
struct Checkpoint {
    dir: TempDir,
    files: FreshFiles,
    tensors: Tensors,
}

impl Checkpoint {
    fn new() -> Self {
        let mut settings = Settings::tiny();
        settings.number = sdim::settings::NumberFormat::Bins { bins: 40, range: 1.25 };
        settings.wide_glimpse = None;
        let files = tiny::small_files(&settings);
        let tensors = tiny::tensors(&files, 3);
        let dir = tempfile::tempdir().unwrap();
        tiny::write(dir.path(), &files, &tensors);
        let made = Self { dir, files, tensors };
        made.load().unwrap();
        made
    }

    fn path(&self, name: &str) -> PathBuf {
        self.dir.path().join(name)
    }

    fn load(&self) -> Result<SdimModel, Error> {
        SdimModel::load(self.dir.path(), &common::load_options())
    }

    fn error(&self) -> Error {
        match self.load() {
            Ok(_) => panic!("a bad checkpoint was loaded"),
            Err(error) => error,
        }
    }

    fn json(&self, name: &str) -> Value {
        let text = match name {
            "config.json" => &self.files.config,
            "preprocessor_config.json" => &self.files.preprocessor,
            _ => &self.files.settings,
        };
        serde_json::from_str(text).unwrap()
    }

    /// Writes a file with one value replaced, or removed if `value` is `None`; says whether it was there.
    fn replace(&self, name: &str, pointer: &str, value: Option<Value>) {
        let mut whole = self.json(name);
        let (parent, key) = pointer.rsplit_once('/').unwrap();
        match (whole.pointer_mut(parent).expect(pointer), value) {
            (Value::Object(map), Some(value)) => drop(map.insert(key.to_string(), value)),
            (Value::Object(map), None) => drop(map.remove(key).expect(pointer)),
            (Value::Array(list), Some(value)) => list[key.parse::<usize>().unwrap()] = value,
            (_, None) => {}
            (other, _) => panic!("{pointer} is inside {other}"),
        }
        std::fs::write(self.path(name), whole.to_string()).unwrap();
    }

    fn restore(&self, name: &str) {
        std::fs::write(self.path(name), self.json(name).to_string()).unwrap();
    }

    fn write_tensors(&self, change: impl FnOnce(&mut Tensors)) {
        let mut tensors = self.tensors.clone();
        change(&mut tensors);
        let bytes = safetensors::serialize(&tensors, None).unwrap();
        std::fs::write(self.path("model.safetensors"), bytes).unwrap();
    }

    /// The error of a JSON file with one value replaced must name the file and this key.
    fn config_error(&self, name: &str, pointer: &str, value: Option<Value>, wanted: &str) {
        self.replace(name, pointer, value.clone());
        match self.error() {
            Error::Config { file, key, found, expected } => {
                assert!(file.ends_with(name), "{file} is not {name}");
                assert_eq!(key, wanted, "{pointer} = {value:?}");
                assert!(!found.is_empty() && !expected.is_empty());
            }
            other => panic!("{pointer} = {value:?}: {other:?}"),
        }
        self.restore(name);
    }
}

fn zeros(shape: &[usize]) -> Tensor {
    Tensor::zeros(shape, DType::F32, &Device::Cpu).unwrap()
}

const NORM: &str = "model.layers.1.input_layernorm.weight";

#[test]
fn a_missing_file_is_named() {
    let checkpoint = Checkpoint::new();
    for name in ["config.json", "preprocessor_config.json", "tokenizer.json", "model.safetensors"] {
        let path = checkpoint.path(name);
        let bytes = std::fs::read(&path).unwrap();
        std::fs::remove_file(&path).unwrap();
        match checkpoint.error() {
            Error::Io { path: named, source } => {
                assert_eq!(named, path);
                assert_eq!(source.kind(), std::io::ErrorKind::NotFound);
            }
            other => panic!("{name}: {other:?}"),
        }
        std::fs::write(&path, bytes).unwrap();
    }
    checkpoint.load().unwrap();
    // Without sdim.json it would be plain Qwen2.5-VL, to which the fusion block does not belong.
    std::fs::remove_file(checkpoint.path("sdim.json")).unwrap();
    match checkpoint.error() {
        Error::TensorSet { unexpected, .. } => assert!(unexpected.iter().all(|n| n.starts_with("sdim."))),
        other => panic!("{other:?}"),
    }
}

#[test]
fn damaged_files_are_named() {
    let checkpoint = Checkpoint::new();
    let damage = |name: &str, bytes: &[u8], what: &str| {
        let good = std::fs::read(checkpoint.path(name)).unwrap();
        std::fs::write(checkpoint.path(name), bytes).unwrap();
        match checkpoint.error() {
            Error::Format { path, found, expected } => {
                assert!(path.ends_with(name), "{name}, {what}: {} was named", path.display());
                assert!(!found.is_empty() && !expected.is_empty());
            }
            other => panic!("{name}, {what}: {other:?}"),
        }
        std::fs::write(checkpoint.path(name), good).unwrap();
    };
    for name in ["config.json", "preprocessor_config.json", "sdim.json", "tokenizer.json"] {
        let good = std::fs::read(checkpoint.path(name)).unwrap();
        damage(name, b"", "empty");
        damage(name, &good[..good.len() / 2], "half");
        damage(name, &[0xff, 0xfe, 0, 7], "binary");
    }
    let name = "model.safetensors";
    let good = std::fs::read(checkpoint.path(name)).unwrap();
    for length in [0, 4, 8, 100, good.len() / 2, good.len() - 1] {
        damage(name, &good[..length], &format!("{length} bytes of {}", good.len()));
    }
    let mut huge = good.clone();
    huge[..8].copy_from_slice(&u64::MAX.to_le_bytes());
    damage(name, &huge, "a header of 2^64 bytes");
    damage(name, &[good.as_slice(), &[0; 8]].concat(), "longer than its header says");
    checkpoint.load().unwrap();
}

#[test]
fn a_tensor_of_another_shape_or_type_is_named() {
    let checkpoint = Checkpoint::new();
    let named = |wanted: &str, part: &str| match checkpoint.error() {
        Error::Tensor { file, name, found, .. } => {
            assert_eq!(name, wanted);
            assert!(file.ends_with("model.safetensors"), "{file}");
            assert!(found.contains(part), "{found}");
        }
        other => panic!("{wanted}: {other:?}"),
    };
    let names: Vec<String> = checkpoint.tensors.keys().cloned().collect();
    for name in names {
        let mut shape = checkpoint.tensors[&name].dims().to_vec();
        shape[0] += 1;
        checkpoint.write_tensors(|t| drop(t.insert(name.clone(), zeros(&shape))));
        named(&name, &format!("{shape:?}"));
    }
    let integers = zeros(checkpoint.tensors[NORM].dims()).to_dtype(DType::I64).unwrap();
    checkpoint.write_tensors(|t| drop(t.insert(NORM.into(), integers)));
    named(NORM, "I64");
}

#[test]
fn missing_unexpected_and_misshaped_tensors_are_all_listed() {
    let checkpoint = Checkpoint::new();
    let lists = || match checkpoint.error() {
        Error::TensorSet { file, missing, unexpected, misshaped } => {
            assert!(file.ends_with("model.safetensors"), "{file}");
            (missing, unexpected, misshaped)
        }
        other => panic!("{other:?}"),
    };
    let gone = [NORM, "sdim.fusion.rgb.bn.running_var", "visual.merger.mlp.2.bias"];
    checkpoint.write_tensors(|t| gone.iter().for_each(|name| drop(t.remove(*name).unwrap())));
    assert_eq!(lists(), (gone.map(String::from).to_vec(), vec![], vec![]));
    checkpoint.write_tensors(|t| {
        t.insert("visual.blocks.9.norm1.weight".into(), zeros(&[4]));
        t.insert("adapter.extra".into(), zeros(&[4]));
    });
    let extra = ["adapter.extra", "visual.blocks.9.norm1.weight"].map(String::from);
    assert_eq!(lists(), (vec![], extra.to_vec(), vec![]));
    checkpoint.write_tensors(|t| {
        t.insert("adapter.extra".into(), zeros(&[4]));
        t.remove("visual.merger.mlp.2.bias").unwrap();
        // The first and the last that are read.
        t.insert("visual.patch_embed.proj.weight".into(), zeros(&[3, 1]));
        t.insert(NORM.into(), zeros(&[7]));
    });
    let (missing, unexpected, misshaped) = lists();
    assert_eq!((&missing[..], &unexpected[..]), (&[gone[2].to_string()][..], &extra[..1]));
    let told = misshaped.join(" ");
    assert!(
        misshaped.len() == 2 && told.contains("proj.weight [3, 1], expected [") && told.contains(NORM),
        "{told}"
    );
}

#[test]
fn config_keys_are_named() {
    let checkpoint = Checkpoint::new();
    let bad = |pointer: &str, value: Value, key: &str| {
        checkpoint.config_error("config.json", pointer, Some(value), key);
    };
    bad("/model_type", json!("llama"), "model_type");
    checkpoint.config_error("config.json", "/model_type", None, "model_type");
    bad("/rope_scaling/mrope_section", json!([3, 3, 3]), "mrope_section");
    bad("/rope_scaling/mrope_section", json!([4, 4]), "rope_scaling.mrope_section");
    bad("/rope_scaling/mrope_section", json!([u64::MAX, 1, 8]), "mrope_section");
    bad("/rope_scaling/type", json!("yarn"), "rope_scaling.type");
    checkpoint.config_error("config.json", "/rope_scaling", None, "rope_scaling");
    checkpoint.config_error("config.json", "/vision_config", None, "vision_config");
    checkpoint.config_error("config.json", "/hidden_size", None, "hidden_size");
    bad("/hidden_size", json!(-64), "hidden_size");
    bad("/hidden_size", json!(66), "hidden_size");
    bad("/num_attention_heads", json!(0), "num_attention_heads");
    bad("/num_key_value_heads", json!(3), "num_key_value_heads");
    bad("/num_hidden_layers", json!(10_000_000), "num_hidden_layers");
    bad("/hidden_act", json!("gelu"), "hidden_act");
    bad("/use_sliding_window", json!(true), "use_sliding_window");
    bad("/image_token_id", json!(1_000_000), "image_token_id");
    bad("/rms_norm_eps", json!(-1.0), "rms_norm_eps");
    bad("/vision_config/num_heads", json!(5), "vision_config.hidden_size");
    bad("/vision_config/depth", json!(10_000_000), "vision_config.depth");
    bad("/vision_config/patch_size", json!(10_000_000), "vision_config.patch_size");
    bad("/vision_config/spatial_merge_size", json!(10_000_000), "vision_config.spatial_merge_size");
    bad("/vision_config/temporal_patch_size", json!(10_000_000), "vision_config.temporal_patch_size");
    bad("/vision_config/window_size", json!(1), "vision_config.window_size");
    bad("/vision_config/out_hidden_size", json!(32), "vision_config.out_hidden_size");
    bad("/vision_config/in_chans", json!(4), "vision_config.in_channels");
}

#[test]
fn preprocessor_and_settings_keys_are_named() {
    let checkpoint = Checkpoint::new();
    let name = "preprocessor_config.json";
    checkpoint.config_error(name, "/min_pixels", Some(json!(1_000_000)), "min_pixels");
    checkpoint.config_error(name, "/max_pixels", Some(json!("many")), "max_pixels");
    checkpoint.config_error(name, "/image_std", Some(json!([0.2, 0.0, 0.2])), "image_std");
    checkpoint.config_error(name, "/image_mean", Some(json!([0.2, 0.2])), "image_mean");
    let patches = "patch_size, merge_size, temporal_patch_size";
    checkpoint.config_error(name, "/patch_size", Some(json!(7)), patches);
    let name = "sdim.json";
    checkpoint.config_error(name, "/format", Some(json!(99)), "format");
    checkpoint.config_error(name, "/position_scale", Some(json!(0.0)), "position_scale");
    checkpoint.config_error(name, "/template/query", Some(json!("where?")), "template.query");
    checkpoint.config_error(name, "/template/answer", Some(json!("far")), "template.answer");
    checkpoint.config_error(name, "/number/bins", Some(json!(0)), "number.bins");
    checkpoint.config_error(name, "/fusion/high", Some(json!(1u64 << 40)), "fusion");
    checkpoint.load().unwrap();
}

#[test]
fn tokens_that_the_vocabulary_lacks_are_named() {
    let checkpoint = Checkpoint::new();
    for (pointer, value, token) in [
        ("/number/bins", json!(50), "<|d40|>"),
        ("/pixel_reference/token", json!("<|nowhere|>"), "<|nowhere|>"),
    ] {
        checkpoint.replace("sdim.json", pointer, Some(value));
        match checkpoint.error() {
            Error::Tokenizer(message) => assert!(message.contains(token), "{message}"),
            other => panic!("{token}: {other:?}"),
        }
        checkpoint.restore("sdim.json");
    }
    // A vocabulary that is larger than the model's embedding.
    let rows = 300;
    checkpoint.replace("config.json", "/vocab_size", Some(json!(rows)));
    let table = "model.embed_tokens.weight";
    checkpoint.write_tensors(|t| drop(t.insert(table.into(), t[table].narrow(0, 0, rows).unwrap())));
    match checkpoint.error() {
        Error::Argument { name, found, .. } => {
            assert_eq!(name, "token id");
            assert!(found.parse::<usize>().unwrap() >= rows, "{found}");
        }
        other => panic!("{other:?}"),
    }
}

/// A config that asks for more than could ever be there must be refused before memory is set aside for it.
#[test]
fn what_is_missing_costs_no_memory() {
    let checkpoint = Checkpoint::new();
    checkpoint.replace("config.json", "/vocab_size", Some(json!(1 << 24)));
    checkpoint.write_tensors(|t| drop(t.remove("model.embed_tokens.weight").unwrap()));
    match checkpoint.error() {
        Error::TensorSet { missing, .. } => assert_eq!(missing, ["model.embed_tokens.weight"]),
        other => panic!("{other:?}"),
    }
    checkpoint.restore("config.json");
    checkpoint.replace("config.json", "/intermediate_size", Some(json!(1 << 24)));
    checkpoint.write_tensors(|t| t.retain(|name, _| !name.contains("_proj")));
    assert!(matches!(checkpoint.error(), Error::TensorSet { missing, .. } if !missing.is_empty()));
}

/// Places of all values inside a JSON value that hold no further ones.
fn leaves(value: &Value, at: String, out: &mut Vec<String>) {
    match value {
        Value::Object(map) => map.iter().for_each(|(k, v)| leaves(v, format!("{at}/{k}"), out)),
        Value::Array(list) => list.iter().enumerate().for_each(|(i, v)| leaves(v, format!("{at}/{i}"), out)),
        _ => out.push(at),
    }
}

/// Loads the checkpoint and, where that is fast whatever the values are, asks it about one pixel; says whether it loaded.
fn load_and_ask(checkpoint: &Checkpoint, and_ask: bool) -> bool {
    let Ok(model) = checkpoint.load() else { return false };
    if and_ask {
        let (rgb, sparse) = tiny::frame(40, 30);
        let (pixels, scattered) = model.preprocess(&rgb, &sparse).unwrap();
        let tokens = model.encode(&pixels, &scattered).unwrap();
        if let Ok(prefix) = model.prefill_prefix(&pixels, &tokens, &sparse) {
            let query = Query { x: 3, y: 4, measured: None, hint: 2.0 };
            let _ = ask(&model, &prefix, &[query], AskOptions::default());
        }
    }
    true
}

/// Each value of each file in turn is replaced by what does not belong there: whatever comes of it is no panic, and a
/// checkpoint that still loads still answers.
#[test]
fn no_value_makes_the_loader_panic() {
    let checkpoint = Checkpoint::new();
    let hostile = [
        json!(null),
        json!(0),
        json!(1),
        json!(-1),
        json!(0.5),
        json!(1e300),
        json!(u64::MAX),
        json!(1 << 24),
        json!(""),
        json!([]),
        json!({}),
        json!(true),
    ];
    let (mut refused, mut loaded, mut panicked) = (0, 0, Vec::new());
    for name in ["config.json", "preprocessor_config.json", "sdim.json"] {
        let mut places = Vec::new();
        leaves(&checkpoint.json(name), String::new(), &mut places);
        for (place, value) in places.iter().flat_map(|p| hostile.iter().map(move |v| (p, v))) {
            checkpoint.replace(name, place, Some(value.clone()));
            // Other files' values can ask for a frame of many millions of pixels.
            let run = || load_and_ask(&checkpoint, name == "sdim.json");
            match std::panic::catch_unwind(std::panic::AssertUnwindSafe(run)) {
                Ok(true) => loaded += 1,
                Ok(false) => refused += 1,
                Err(_) => panicked.push(format!("{name}: {place} = {value}")),
            }
        }
        checkpoint.restore(name);
    }
    println!("{refused} refused, {loaded} loaded");
    assert!(panicked.is_empty(), "{panicked:#?}");
    assert!(refused > 200 && loaded > 50);
}
