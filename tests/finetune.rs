//! Fine-tuned adapters and the prompts that they were tuned on: `training/tests/make_finetune.py` tuned a small random Qwen2.5-VL of
//! `transformers` for 20 steps and wrote what PyTorch answers; `training/tests/test_finetune.py` compares PyTorch with the same files.

#[path = "number_tokens/base.rs"]
#[allow(dead_code)]
mod base;
mod common;

use base::{Base, CPU};
use candle_core::Tensor;
use common::program::program;
use sdim::benchmarks::{Layout, LayoutOptions};
use sdim::internals::model::SdimModel;
use sdim::internals::supervise::{Example, PromptShard};
use sdim::internals::vlm::qwen2_5::{decoder::Keep, sequences::Sequences};
use sdim::settings::{LoraMode, Settings};
use sdim::{Adapter, Error, LoadOptions, WeightFormat};
use std::path::{Path, PathBuf};
use std::process::Command;

fn fixture(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures/finetune").join(name)
}

/// Logits of the first token of each answer, `[questions, rows]`, computed as for a user's frame.
fn first_logits(model: &SdimModel, example: &Example) -> Tensor {
    let (w, h) = example.pixels.resized.dimensions();
    let scattered = Tensor::from_slice(&example.scattered, (1, h as usize, w as usize, 1), &CPU).unwrap();
    let image = model.encode(&example.pixels, &scattered).unwrap();
    let prefix = &example.prefix;
    let embedded = model.vlm.embed_prompt(&prefix.ids, &image).unwrap();
    let view = example.view(model).unwrap();
    let embedded = model.add_glimpses(embedded, &[(&view, &prefix.glimpses)]).unwrap();
    let decoder = &model.vlm.decoder;
    let mut shared = decoder.cache(1);
    model.vlm.prefill(&embedded, &prefix.positions, &mut shared, Keep::Nothing).unwrap();
    let rows: Vec<Tensor> = example
        .items
        .iter()
        .map(|item| {
            // Without the tokens of the answer that stand behind the first.
            let asked = item.tokens.len() + 1 - item.supervised;
            let embedded = decoder.embed(&item.tokens.ids[..asked]).unwrap();
            let group = (&view, item.tokens.glimpses.as_slice());
            let embedded = model.add_glimpses(embedded, &[group]).unwrap();
            let positions = &item.tokens.positions[..asked];
            let one = Sequences::prefill(decoder, Some(&shared), &embedded, positions, vec![0.0]).unwrap();
            model.number_rows.linear(one.last(), None).unwrap()
        })
        .collect();
    Tensor::cat(&rows, 0).unwrap()
}

fn largest(t: &Tensor) -> f32 {
    t.abs().unwrap().max_all().unwrap().to_scalar().unwrap()
}

#[test]
fn a_tuned_adapter_answers_as_in_pytorch() {
    for (name, tied, questions) in [("rows", false, 12), ("paper", true, 4)] {
        let (base, dir) = (Base::new(tied), fixture(name));
        let load = |adapter: &Path, lora| {
            let options =
                LoadOptions::default().with_weights(WeightFormat::F32).with_lora(lora).with_adapter(adapter);
            SdimModel::load(base.path(), &options).unwrap()
        };
        let (merged, apart) = (load(&dir, LoraMode::Merge), load(&dir, LoraMode::Apart));
        let mut untuned = Adapter::load(&dir).unwrap();
        for (part, tensor) in &mut untuned.tensors {
            if part.contains(".lora_B.") || part.starts_with("sdim.fusion.out") {
                *tensor = tensor.zeros_like().unwrap();
            }
        }
        let blank = tempfile::tempdir().unwrap();
        untuned.save(blank.path()).unwrap();
        let untuned = load(blank.path(), LoraMode::Merge);
        let shard = PromptShard::read(&dir.join("000000.safetensors")).unwrap();
        let expected = candle_core::safetensors::load(dir.join("expected.safetensors"), &CPU).unwrap();
        let expected = &expected["first_logits"];
        assert_eq!(expected.dims()[..2], [shard.frames(), questions]);
        for frame in 0..shard.frames() {
            let expected = expected.get(frame).unwrap();
            let off = |model: &SdimModel| {
                let example = shard.example(model.into(), frame, 0).unwrap();
                largest(&(first_logits(model, &example) - &expected).unwrap())
            };
            assert!(off(&merged) < 2e-4, "{name}, frame {frame}: {} off", off(&merged));
            assert!(off(&apart) < 2e-4, "{name}, frame {frame}, apart: {} off", off(&apart));
            assert!(off(&untuned) > 0.05, "{name}: tuning changed next to nothing, {}", off(&untuned));
        }
    }
}

#[test]
fn prompts_are_read_back_and_damage_is_named() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("0.safetensors");
    for name in ["rows", "paper"] {
        let from = fixture(name).join("000000.safetensors");
        let mut shard = PromptShard::read(&from).unwrap();
        shard.write(&path).unwrap();
        assert!(std::fs::read(&path).unwrap() == std::fs::read(&from).unwrap(), "{name}");
        for break_it in [
            (|s| s.answer[0] = 1 << 20) as fn(&mut PromptShard),
            |s| s.measured_pixel[0] = 96 * 72,
            |s| s.prefix.start[1] += 1 << 20,
            |s| s.asked.start[0] = 1,
            |s| s.answer_start[1] = s.answer_start[2],
            |s| drop(s.about.frames.pop()),
        ] {
            let mut bad = shard.clone();
            break_it(&mut bad);
            bad.write(&path).ok();
            let error = PromptShard::read(&path);
            assert!(matches!(error, Err(Error::Tensor { .. } | Error::Format { .. })), "{name}: {error:?}");
        }
        shard.about.version = 2;
        shard.write(&path).unwrap();
        let error = PromptShard::read(&path).unwrap_err().to_string();
        assert!(error.contains("version 2"), "{error}");
    }
    let records = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures/records/000000.safetensors");
    assert!(PromptShard::read(&records).unwrap_err().to_string().contains("sdim_prompts"));
}

/// The files that come with the Python package are the crate's own ways of asking.
#[test]
fn the_settings_of_the_package_are_the_crates() {
    let read = |name: &str| {
        let file = format!("training/sdim_training/qwen/settings/{name}.json");
        Settings::from_file(&Path::new(env!("CARGO_MANIFEST_DIR")).join(file)).unwrap()
    };
    let (rows, paper) = (read("rows"), read("paper"));
    let added = |own: &Settings, settings: Settings| Settings {
        fusion: own.fusion,
        lora: own.lora.clone(),
        ..settings
    };
    assert_eq!(paper, added(&paper, Settings::paper()));
    let asked = Settings {
        rope_layout: rows.rope_layout,
        position_scale: 1.0,
        glimpse: None,
        wide_glimpse: None,
        ..Settings::tiny()
    };
    let (pixel_reference, number_tokens) = (rows.pixel_reference.clone(), rows.number_tokens);
    assert_eq!(rows, added(&rows, Settings { pixel_reference, number_tokens, ..asked }));
    assert!(rows.lora.is_some() && rows.lora == paper.lora && rows.fusion == paper.fusion);
}

/// Runs `records` for a base in the way of asking `rows`; the shards of its folder.
fn prompts(base: &Base, out: &Path, more: &[&str]) -> Vec<PromptShard> {
    let settings = fixture("rows/sdim.json");
    let ran = Command::new(program("records"))
        .args([Path::new("--base"), base.path(), Path::new("--settings"), &settings, Path::new("--out"), out])
        .args(["--size", "96x72", "--shard", "1", "--prompt", "20", "--questions", "8", "--points", "20,60"])
        .args(more)
        .output()
        .unwrap();
    assert!(ran.status.success(), "{}", String::from_utf8_lossy(&ran.stderr));
    let files = std::fs::read_dir(out).unwrap().map(|e| e.unwrap().path());
    let mut files: Vec<_> = files.filter(|p| p.extension().is_some_and(|e| e == "safetensors")).collect();
    files.sort();
    files.iter().map(|p| PromptShard::read(p).unwrap()).collect()
}

/// Column, row and metres of each question of the first frame's variant.
fn questions(shard: &PromptShard, variant: usize) -> Vec<(usize, usize, f32)> {
    let range = variant * shard.questions..(variant + 1) * shard.questions;
    let at = |i: usize, k: usize| shard.asked.place[shard.asked.start[i] as usize * 5 + k] as usize;
    range.map(|i| (at(i, 3), at(i, 4), shard.asked_value[i] * shard.unit[variant])).collect()
}

#[test]
fn prompts_of_a_data_set_follow_its_list() {
    let (base, dir) = (Base::new(false), tempfile::tempdir().unwrap());
    let data = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures/benchmarks/hypersim");
    let (out, list) = (dir.path().join("out"), dir.path().join("list.txt"));
    let drawn = ["--data", data.to_str().unwrap(), "--layout", "hypersim", "--variants", "2", "--seed", "4"];
    let more = [&drawn[..], &["--sample", "2", "--list", list.to_str().unwrap()]].concat();
    let shards = prompts(&base, &out, &more);
    let text = std::fs::read_to_string(&list).unwrap();
    let names: Vec<&str> = text.lines().filter(|l| !l.starts_with('#')).collect();
    let found: Vec<&str> = shards.iter().flat_map(|s| s.about.frames.iter().map(String::as_str)).collect();
    assert_eq!((names.len(), &names), (2, &found), "{text}");

    let options = LayoutOptions::default().with_frames(&list);
    let set = Layout::Hypersim.open(&data, &options).unwrap();
    for (frame, shard) in shards.iter().enumerate() {
        let sample = set.load(frame).unwrap();
        assert_eq!((sample.name.as_str(), shard.size, shard.variants), (names[frame], (96, 72), 2));
        let z = |x: usize, y: usize| sample.gt[(2 * y + 1) * 768 / 144 * 1024 + (2 * x + 1) * 1024 / 192];
        let asked = questions(shard, 0);
        // Red rises from left to right: the labels follow the picture into the mirror.
        let mirrored = shard.rgb[0] > 128;
        for &(x, y, metres) in &asked {
            let expected = z(if mirrored { 95 - x } else { x }, y);
            assert!((metres / expected - 1.0).abs() < 1e-4, "({x}, {y}): {metres}, {expected}");
        }
        assert!(questions(shard, 1) != asked && shard.asked_value.iter().all(|v| v.is_finite()));
    }

    // What is lost is written again, the same; another choice is not mixed in.
    let lost = out.join("000001.safetensors");
    let bytes = std::fs::read(&lost).unwrap();
    std::fs::remove_file(&lost).unwrap();
    prompts(&base, &out, &more);
    assert!(std::fs::read(&lost).unwrap() == bytes);
    let settings = fixture("rows/sdim.json");
    let ran = Command::new(program("records"))
        .args([
            Path::new("--base"),
            base.path(),
            Path::new("--settings"),
            &settings,
            Path::new("--out"),
            &out,
        ])
        .args(["--size", "96x72", "--shard", "1", "--prompt", "20", "--questions", "8", "--points", "20,60"])
        .args(drawn)
        .output()
        .unwrap();
    let said = String::from_utf8_lossy(&ran.stderr);
    assert!(!ran.status.success() && said.contains("other records"), "{said}");
}

#[test]
fn a_robots_own_measurements_are_prompt_and_labels() {
    let (base, dir) = (Base::new(false), tempfile::tempdir().unwrap());
    let data = dir.path().join("robot");
    for folder in ["rgb", "sparse"] {
        std::fs::create_dir_all(data.join(folder)).unwrap();
    }
    let metres = |x: usize, y: usize| 1.0 + 0.01 * x as f32 + 0.02 * y as f32;
    let depth: Vec<f32> =
        (0..96 * 72).map(|i| if i % 97 == 0 { metres(i % 96, i / 96) } else { f32::NAN }).collect();
    image::RgbImage::from_fn(96, 72, |x, y| image::Rgb([x as u8, y as u8, 9]))
        .save(data.join("rgb/a.png"))
        .unwrap();
    sdim::depth::io::write_npy(data.join("sparse/a.npy"), 96, 72, &depth).unwrap();
    let out = dir.path().join("out");
    let more = ["--data", data.to_str().unwrap(), "--labels", "sparse", "--variants", "3"];
    let shards = prompts(&base, &out, &more);
    assert_eq!((shards.len(), &shards[0].about.frames), (1, &vec!["a".to_string()]));
    let shard = &shards[0];
    let flip = shard.rgb[0] != 0;
    for variant in 0..3 {
        let seen = shard.measured_start[variant] as usize..shard.measured_start[variant + 1] as usize;
        let told: Vec<usize> = shard.measured_pixel[seen].iter().map(|&p| p as usize).collect();
        assert!((40..60).contains(&told.len()), "70 % of 72: {}", told.len());
        for (x, y, found) in questions(shard, variant) {
            let expected = metres(if flip { 95 - x } else { x }, y);
            assert!((found - expected).abs() < 1e-4, "({x}, {y}): {found}, {expected}");
            assert!(!told.contains(&(y * 96 + x)), "({x}, {y}) is told and asked");
        }
    }
    // Without ground truth there is nothing else to ask.
    let out = dir.path().join("dense");
    let ran = Command::new(program("records"))
        .args([Path::new("--base"), base.path(), Path::new("--data"), &data, Path::new("--out"), &out])
        .args(["--size", "96x72", "--settings", fixture("rows/sdim.json").to_str().unwrap()])
        .output()
        .unwrap();
    assert!(!ran.status.success() && !out.join("000000.safetensors").exists());
}
