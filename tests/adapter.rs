//! Adapters on a base checkpoint: neutral when fresh, equal bit for bit after a round trip, merged or apart.

mod common;

use candle_core::{Device, Tensor};
use common::tiny;
use sdim::internals::model::SdimModel;
use sdim::internals::supervise::FreshFiles;
use sdim::settings::{FusionConfig, LoraConfig, LoraMode, PixelReference, Settings};
use sdim::{Adapter, CompleteOptions, DepthCompleter, Error, LoadOptions, QueryPlan, WeightFormat};
use std::path::Path;

/// The way of asking of a base without fusion block.
fn plain() -> Settings {
    Settings { fusion: None, glimpse: None, wide_glimpse: None, ..Settings::tiny() }
}

fn adapted() -> Settings {
    Settings {
        fusion: Some(FusionConfig { branch: 4, high: 6, low: 5 }),
        lora: Some(LoraConfig {
            rank: 3,
            alpha: 6.0,
            targets: ["q_proj", "down_proj", "qkv"].map(String::from).to_vec(),
        }),
        ..plain()
    }
}

struct Base {
    dir: tempfile::TempDir,
    files: FreshFiles,
}

impl Base {
    fn new() -> Self {
        let files = tiny::small_files(&plain());
        let dir = tempfile::tempdir().unwrap();
        tiny::write(dir.path(), &files, &tiny::tensors(&files, 11));
        Self { dir, files }
    }

    fn fresh(&self) -> Adapter {
        Adapter::fresh(&self.files.parse().unwrap().config, adapted(), 5).unwrap()
    }

    fn load(&self, adapter: Option<&Path>, lora: LoraMode, weights: WeightFormat) -> SdimModel {
        let mut options = LoadOptions::default().with_lora(lora).with_weights(weights);
        options.adapter = adapter.map(Path::to_path_buf);
        SdimModel::load(self.dir.path(), &options).unwrap()
    }
}

fn answers(model: SdimModel) -> Vec<f32> {
    let (rgb, sparse) = tiny::frame(80, 64);
    let options = CompleteOptions::default().with_plan(QueryPlan::Every);
    let map = DepthCompleter::new(model).complete(&rgb, &sparse, &options).unwrap();
    map.depth().iter().chain(map.expected_error()).copied().collect()
}

fn bits(values: &[f32]) -> Vec<u32> {
    values.iter().map(|v| v.to_bits()).collect()
}

/// Every tensor that a fresh adapter leaves at zero becomes a small random one.
fn disturb(adapter: &mut Adapter) {
    for (name, tensor) in &mut adapter.tensors {
        let zero = tensor.abs().unwrap().sum_all().unwrap().to_scalar::<f32>().unwrap() == 0.0;
        if zero && !name.ends_with("running_mean") {
            let count = tensor.elem_count();
            let values: Vec<f32> = (0..count).map(|i| ((i * 37 % 101) as f32 - 50.0) * 4e-3).collect();
            *tensor = Tensor::from_vec(values, tensor.shape(), &Device::Cpu).unwrap();
        }
    }
}

#[test]
fn a_fresh_adapter_changes_nothing() {
    let base = Base::new();
    let dir = tempfile::tempdir().unwrap();
    base.fresh().save(dir.path()).unwrap();
    for weights in [WeightFormat::F32, WeightFormat::Bf16] {
        let alone = bits(&answers(base.load(None, LoraMode::Merge, weights)));
        for lora in [LoraMode::Merge, LoraMode::Apart] {
            let adapted = bits(&answers(base.load(Some(dir.path()), lora, weights)));
            assert!(alone == adapted, "{weights:?}, {lora:?}");
        }
    }
}

#[test]
fn a_trained_adapter_changes_the_answers_and_merging_does_not() {
    let base = Base::new();
    let mut adapter = base.fresh();
    disturb(&mut adapter);
    let dir = tempfile::tempdir().unwrap();
    adapter.save(dir.path()).unwrap();
    let alone = answers(base.load(None, LoraMode::Merge, WeightFormat::F32));
    let merged = answers(base.load(Some(dir.path()), LoraMode::Merge, WeightFormat::F32));
    let apart = answers(base.load(Some(dir.path()), LoraMode::Apart, WeightFormat::F32));
    let max = alone.iter().fold(0f32, |m, v| m.max(v.abs()));
    let gap = |a: &[f32], b: &[f32]| a.iter().zip(b).fold(0f32, |m, (a, b)| m.max((a - b).abs()));
    assert!(gap(&alone, &merged) > 1e-2 * max, "the adapter had no effect");
    assert!(gap(&merged, &apart) < 1e-4 * max, "{} of {max}", gap(&merged, &apart));
}

#[test]
fn each_part_of_an_adapter_has_its_effect() {
    let base = Base::new();
    let mut adapter = base.fresh();
    disturb(&mut adapter);
    let alone = answers(base.load(None, LoraMode::Merge, WeightFormat::F32));
    for part in ["sdim.fusion", "q_proj.lora", "down_proj.lora", "qkv.lora"] {
        let mut only = base.fresh();
        for (name, tensor) in &mut only.tensors {
            if name.contains(part) {
                *tensor = adapter.tensors[name].clone();
            }
        }
        let dir = tempfile::tempdir().unwrap();
        only.save(dir.path()).unwrap();
        let with = answers(base.load(Some(dir.path()), LoraMode::Merge, WeightFormat::F32));
        assert!(bits(&with) != bits(&alone), "{part}");
    }
}

#[test]
fn saving_and_loading_keeps_every_bit() {
    let base = Base::new();
    let mut adapter = base.fresh();
    disturb(&mut adapter);
    adapter.settings.pixel_reference = PixelReference::Coordinates;
    adapter.settings.position_scale = 0.1 + 0.2;
    let half = "sdim.patch_embed.proj.weight";
    let narrow = adapter.tensors[half].to_dtype(candle_core::DType::BF16).unwrap();
    adapter.tensors.insert(half.into(), narrow);
    let dir = tempfile::tempdir().unwrap();
    let (first, second) = (dir.path().join("a"), dir.path().join("b"));
    adapter.save(&first).unwrap();
    let again = Adapter::load(&first).unwrap();
    assert_eq!(again.settings, adapter.settings);
    again.save(&second).unwrap();
    for file in ["sdim.json", "sdim.safetensors"] {
        let [a, b] = [&first, &second].map(|d| std::fs::read(d.join(file)).unwrap());
        assert!(a == b, "{file}");
    }
    for (name, tensor) in &adapter.tensors {
        let read = &again.tensors[name];
        assert_eq!((read.dtype(), read.dims()), (tensor.dtype(), tensor.dims()), "{name}");
    }
}

/// A product of factors that are not there would have 2^48 values.
#[test]
fn the_layout_of_a_large_model_costs_no_memory() {
    let mut config = Base::new().files.parse().unwrap().config;
    (config.text.hidden_size, config.text.layers) = (1 << 24, 1);
    let layout = Adapter::layout(&config, &adapted()).unwrap();
    assert_eq!(layout["model.layers.0.self_attn.q_proj.lora_A.weight"], [3, 1 << 24]);
    assert_eq!(layout["model.layers.0.self_attn.q_proj.lora_B.weight"], [1 << 24, 3]);
}

#[test]
fn what_an_adapter_has_wrong_is_named() {
    let base = Base::new();
    let config = base.files.parse().unwrap().config;
    let mut settings = adapted();
    settings.lora.as_mut().unwrap().targets.push("z_proj".into());
    let error = Adapter::fresh(&config, settings, 0).unwrap_err();
    assert!(error.to_string().contains("z_proj"), "{error}");

    let adapter = base.fresh();
    let fails = |change: &dyn Fn(&mut Adapter)| {
        let mut bad = adapter.clone();
        change(&mut bad);
        let dir = tempfile::tempdir().unwrap();
        bad.save(dir.path()).unwrap();
        let options = LoadOptions::default().with_adapter(dir.path());
        SdimModel::load(base.dir.path(), &options).err().expect("an error")
    };
    let a = "model.layers.1.self_attn.q_proj.lora_A.weight";
    match fails(&|bad| drop(bad.tensors.remove(a))) {
        Error::TensorSet { missing, .. } => assert_eq!(missing, [a]),
        other => panic!("{other:?}"),
    }
    match fails(&|bad| bad.settings.lora.as_mut().unwrap().rank = 4) {
        Error::TensorSet { misshaped, .. } => {
            let factors = adapter.tensors.keys().filter(|name| name.contains(".lora_")).count();
            assert!(misshaped.len() == factors && misshaped[0].contains("expected [4, "), "{misshaped:?}")
        }
        other => panic!("{other:?}"),
    }
    match fails(&|bad| bad.settings.lora = None) {
        Error::TensorSet { unexpected, .. } => assert!(unexpected.contains(&a.to_string())),
        other => panic!("{other:?}"),
    }
}

/// The factors as PEFT saves them: prefixed names, rank, alpha and variant in a file of its own.
fn save_as_peft(adapter: &Adapter, dir: &Path, prefix: &str, config: serde_json::Value) {
    let factors = adapter.tensors.iter().filter(|(name, _)| name.contains(".lora_"));
    let named: std::collections::HashMap<_, _> =
        factors.map(|(name, t)| (format!("{prefix}{name}"), t.clone())).collect();
    candle_core::safetensors::save(&named, dir.join("adapter_model.safetensors")).unwrap();
    std::fs::write(dir.join("adapter_config.json"), config.to_string()).unwrap();
}

fn peft_config() -> serde_json::Value {
    serde_json::json!({
        "peft_type": "LORA", "r": 3, "lora_alpha": 6, "use_rslora": false, "use_dora": false, "bias": "none", "rank_pattern": {},
        "alpha_pattern": {}, "fan_in_fan_out": false, "init_lora_weights": true, "modules_to_save": null, "layer_replication": null,
        "target_modules": "^(model.*(q_proj|down_proj)|visual.*qkv)$", "task_type": "CAUSAL_LM",
    })
}

fn factors_alone(base: &Base) -> Adapter {
    let settings = Settings { fusion: None, ..adapted() };
    let mut adapter = Adapter::fresh(&base.files.parse().unwrap().config, settings, 5).unwrap();
    disturb(&mut adapter);
    adapter
}

#[test]
fn an_adapter_of_peft_gives_the_answers_of_ours_and_of_merged_weights() {
    let base = Base::new();
    let mut adapter = factors_alone(&base);
    let [ours, peft] = [(); 2].map(|()| tempfile::tempdir().unwrap());
    adapter.save(ours.path()).unwrap();
    let load = |dir: &Path| bits(&answers(base.load(Some(dir), LoraMode::Merge, WeightFormat::F32)));
    let expected = load(ours.path());
    assert!(expected != bits(&answers(base.load(None, LoraMode::Merge, WeightFormat::F32))));
    // What older and newer versions of transformers call the layers.
    save_as_peft(&adapter, peft.path(), "base_model.model.", peft_config());
    assert!(load(peft.path()) == expected);
    let newer = Adapter {
        tensors: adapter
            .tensors
            .iter()
            .map(|(name, t)| {
                (
                    name.replacen("model.", "model.language_model.", 1).replace("visual.", "model.visual."),
                    t.clone(),
                )
            })
            .collect(),
        settings: adapter.settings.clone(),
    };
    save_as_peft(&newer, peft.path(), "base_model.model.", peft_config());
    assert!(load(peft.path()) == expected);

    // W + alpha / r B A, by hand.
    let mut merged = tiny::tensors(&base.files, 11);
    for (name, a) in adapter.tensors.iter().filter(|(name, _)| name.ends_with(".lora_A.weight")) {
        let layer = name.strip_suffix(".lora_A.weight").unwrap();
        let b = &adapter.tensors[&format!("{layer}.lora_B.weight")];
        let weight = merged.get_mut(&format!("{layer}.weight")).unwrap();
        *weight = ((b * 2.0).unwrap().matmul(a).unwrap() + &*weight).unwrap();
    }
    let whole = tempfile::tempdir().unwrap();
    tiny::write(whole.path(), &base.files, &merged);
    let whole =
        SdimModel::load(whole.path(), &LoadOptions::default().with_weights(WeightFormat::F32)).unwrap();
    let (merged, found) =
        (answers(whole), answers(base.load(Some(peft.path()), LoraMode::Merge, WeightFormat::F32)));
    let max = merged.iter().fold(0f32, |m, v| m.max(v.abs()));
    assert!(merged.iter().zip(&found).all(|(a, b)| (a - b).abs() < 1e-4 * max));

    // alpha / sqrt(r) instead: the same as another alpha.
    let mut stabilised = peft_config();
    stabilised["use_rslora"] = true.into();
    save_as_peft(&adapter, peft.path(), "base_model.model.", stabilised);
    adapter.settings.lora.as_mut().unwrap().alpha = 6.0 * 3f32.sqrt();
    adapter.save(ours.path()).unwrap();
    assert!(load(peft.path()) == load(ours.path()) && load(peft.path()) != expected);
}

#[test]
fn what_cannot_be_applied_of_peft_is_named() {
    let base = Base::new();
    let adapter = factors_alone(&base);
    let dir = tempfile::tempdir().unwrap();
    let fails = || {
        let options = LoadOptions::default().with_adapter(dir.path());
        SdimModel::load(base.dir.path(), &options).err().expect("an error")
    };
    for (key, value) in [
        ("use_dora", true.into()),
        ("peft_type", "IA3".into()),
        ("rank_pattern", serde_json::json!({"q_proj": 8})),
        ("init_lora_weights", "pissa".into()),
        ("r", 0.into()),
        ("lora_alpha", "high".into()),
    ] {
        let mut config = peft_config();
        config[key] = value;
        save_as_peft(&adapter, dir.path(), "base_model.model.", config);
        match fails() {
            Error::Config { file, key: named, .. } => {
                assert!(named == key && file.ends_with("adapter_config.json"))
            }
            other => panic!("{key}: {other:?}"),
        }
    }
    // A layer that the model does not have, one of another rank, none at all.
    let mut other = adapter.clone();
    let lonely = other.tensors.pop_first().unwrap().1;
    other.tensors.insert("model.extra.lora_A.weight".into(), lonely);
    save_as_peft(&other, dir.path(), "base_model.model.", peft_config());
    match fails() {
        Error::TensorSet { unexpected, missing, .. } => {
            assert!(unexpected.contains(&"model.extra.lora_A.weight".to_string()) || !missing.is_empty())
        }
        other => panic!("{other:?}"),
    }
    let mut rank = peft_config();
    rank["r"] = 4.into();
    save_as_peft(&adapter, dir.path(), "base_model.model.", rank);
    assert!(matches!(fails(), Error::TensorSet { misshaped, .. } if !misshaped.is_empty()));
    save_as_peft(&Adapter { tensors: Default::default(), ..adapter }, dir.path(), "", peft_config());
    assert!(fails().to_string().contains("no factors of LoRA"));
}
