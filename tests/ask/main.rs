//! `examples/ask.rs` as a user runs it: the answer of the reference, and of damaged input one message and nothing else.

#[path = "../common/mod.rs"]
mod common;
mod sampling;

use candle_core::Device;
use common::{Golden, relative_difference};
use sdim::Error;
use sdim::chat::{AnswerOptions, ChatModel, ChatPrompt, Part};
use sdim::{LoadOptions, WeightFormat};
use serde_json::{Value, json};
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};
use tempfile::TempDir;

const QUESTION: &str = "How far?";
/// The case of the golden tensors whose prompt has no token twice, so that a vocabulary can be made for it.
const CASE: &str = "b";

/// The chat template with [`QUESTION`], cut into as many pieces as the golden prompt has ids on each side of its image.
const BEFORE: [&str; 5] =
    ["<|im_start|>system\n", "You are ", "a helpful ", "assistant.<|im_end|>\n", "<|im_start|>user\n"];
const AFTER: [&str; 4] = ["How ", "far?", "<|im_end|>\n", "<|im_start|>assistant\n"];

fn fixture() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures/qwen_small")
}

fn golden() -> Golden {
    Golden::open(&fixture())
}

/// A checkpoint directory: the fixture's model, and a vocabulary in which the template is the golden prompt.
struct Checkpoint {
    dir: TempDir,
}

impl Checkpoint {
    fn new() -> Self {
        let dir = tempfile::tempdir().unwrap();
        for name in ["config.json", "preprocessor_config.json", "model.safetensors"] {
            std::fs::copy(fixture().join(name), dir.path().join(name)).unwrap();
        }
        let made = Self { dir };
        made.write("tokenizer.json", &tokenizer(None));
        made.write(
            "generation_config.json",
            &json!({"eos_token_id": [302, 303], "repetition_penalty": 1.05}),
        );
        made
    }

    fn path(&self, name: &str) -> PathBuf {
        self.dir.path().join(name)
    }

    fn write(&self, name: &str, json: &Value) {
        std::fs::write(self.path(name), json.to_string()).unwrap();
    }

    /// Cuts the model into two shards with an index, whose weight map is returned.
    fn shard(&self) -> Value {
        let tensors = candle_core::safetensors::load(self.path("model.safetensors"), &Device::Cpu).unwrap();
        std::fs::remove_file(self.path("model.safetensors")).unwrap();
        let (vision, text): (Vec<_>, Vec<_>) =
            tensors.into_iter().partition(|(name, _)| name.starts_with("visual."));
        let mut map = serde_json::Map::new();
        for (file, part) in [("model-1.safetensors", vision), ("model-2.safetensors", text)] {
            map.extend(part.iter().map(|(name, _)| (name.clone(), file.into())));
            let part = part.into_iter().collect();
            candle_core::safetensors::save(&part, self.path(file)).unwrap();
        }
        self.index(&Value::Object(map.clone()));
        Value::Object(map)
    }

    fn index(&self, map: &Value) {
        self.write("model.safetensors.index.json", &json!({"weight_map": map}));
    }

    fn load(&self) -> Result<ChatModel, Error> {
        ChatModel::load(self.dir.path(), &LoadOptions::default().with_weights(WeightFormat::F32))
    }

    fn ask(&self, args: &[&str]) -> Output {
        self.command(args).output().unwrap()
    }

    fn command(&self, args: &[&str]) -> Command {
        let image = fixture().join(format!("image_{CASE}.png"));
        let dir = text(self.dir.path());
        // In f32, in which the reference's answers were made.
        let base = ["--model", dir, "--image", text(&image), "--prompt", QUESTION, "--weights", "f32"];
        // A later flag of the same name replaces an earlier one only if it is told apart; so each is given once.
        let base = base.chunks(2).filter(|pair| !args.contains(&pair[0])).flatten().copied();
        let mut command = Command::new(common::program::program("ask"));
        command.args(base).args(args);
        command
    }

    /// The example must end with code 1 and one message that names `wanted`, and print nothing else.
    fn refused(&self, args: &[&str], wanted: &str) {
        let out = self.ask(args);
        let said = String::from_utf8_lossy(&out.stderr).into_owned();
        assert_eq!(out.status.code(), Some(1), "{args:?}: {said}");
        assert!(out.stdout.is_empty(), "{args:?}: {}", String::from_utf8_lossy(&out.stdout));
        assert!(said.contains(wanted) && !said.contains("panicked"), "{args:?}: {said}");
        assert_eq!(said.trim_end().lines().count(), 1, "{said}");
    }

    /// Both the library and the example refuse the checkpoint and name `wanted`.
    fn does_not_load(&self, wanted: &str) -> Error {
        let error = self.load().err().expect("a bad checkpoint was loaded");
        assert!(error.to_string().contains(wanted), "{error}");
        self.refused(&[], wanted);
        error
    }
}

fn text(path: &Path) -> &str {
    path.to_str().unwrap()
}

/// 302 tokens: the pieces of the prompt at the golden ids, the special tokens at those of the config, fillers elsewhere.
fn tokenizer(without: Option<&str>) -> Value {
    let ids: Vec<usize> =
        golden().integers(&format!("{CASE}.input_ids")).iter().map(|&id| id as usize).collect();
    let mut tokens: Vec<String> = (0..302).map(|id| format!("<w{id}>")).collect();
    let ends = BEFORE.iter().zip(&ids).chain(AFTER.iter().zip(&ids[ids.len() - AFTER.len()..]));
    for (piece, &id) in ends {
        tokens[id] = piece.to_string();
    }
    for (id, special) in [(297, "<|vision_start|>"), (298, "<|vision_end|>"), (300, "<|image_pad|>")] {
        tokens[id] = special.to_string();
    }
    let kept = tokens.iter().enumerate().filter(|(_, token)| Some(token.as_str()) != without);
    let vocab: serde_json::Map<String, Value> = kept.clone().map(|(id, t)| (t.clone(), id.into())).collect();
    let added: Vec<Value> = kept
        .map(|(id, token)| {
            json!({"id": id, "content": token, "single_word": false, "lstrip": false, "rstrip": false,
                   "normalized": false, "special": token.starts_with("<|vision") || token == "<|image_pad|>"})
        })
        .collect();
    json!({"version": "1.0", "truncation": null, "padding": null, "added_tokens": added, "normalizer": null,
           "pre_tokenizer": null, "post_processor": null, "decoder": {"type": "Fuse"},
           "model": {"type": "WordLevel", "vocab": vocab, "unk_token": "<w0>"}})
}

fn ids(value: &Value) -> Vec<i64> {
    value.as_array().unwrap().iter().map(|v| v.as_i64().unwrap()).collect()
}

#[test]
fn the_answer_is_that_of_the_reference() {
    let checkpoint = Checkpoint::new();
    let golden = golden();
    let logits: Vec<f32> = golden.take(&format!("{CASE}.last_logits")).unwrap().to_vec1().unwrap();
    for (penalty, name) in [(None, "generated_ids_rp105"), (Some("1"), "generated_ids")] {
        let wanted = golden.integers(&format!("{CASE}.{name}"));
        let count = wanted.len().to_string();
        let mut args = vec!["--json", "--max-new-tokens", &count];
        args.extend(penalty.iter().flat_map(|p| ["--repetition-penalty", p]));
        let out = checkpoint.ask(&args);
        assert!(out.status.success(), "{}", String::from_utf8_lossy(&out.stderr));
        let v: Value = serde_json::from_slice(&out.stdout).unwrap();
        assert_eq!(ids(&v["prompt_ids"]), golden.integers(&format!("{CASE}.input_ids")));
        assert_eq!(ids(&v["generated_ids"]), wanted, "{name}");
        let words: String = wanted.iter().map(|id| word(*id)).collect();
        assert_eq!(v["text"], words.as_str());
        first_logits_are_those_of(&v["first_logits_top"], &logits);
    }
}

/// The word of an id that the model generates; none of the golden answers holds a piece of the prompt.
fn word(id: i64) -> String {
    let model: Value = tokenizer(None);
    let vocab = model["model"]["vocab"].as_object().unwrap();
    vocab.iter().find(|(_, v)| v.as_i64() == Some(id)).unwrap().0.clone()
}

fn first_logits_are_those_of(top: &Value, golden: &[f32]) {
    let top: Vec<(usize, f32)> = serde_json::from_value(top.clone()).unwrap();
    assert_eq!(top.len(), 20);
    assert!(top.windows(2).all(|pair| pair[0].1 >= pair[1].1), "{top:?}");
    // Columns 302 and 303 have no token.
    let mut order: Vec<usize> = (0..302).collect();
    order.sort_by(|&a, &b| golden[b].total_cmp(&golden[a]));
    assert_eq!(top.iter().map(|t| t.0).collect::<Vec<_>>(), order[..20]);
    let tensor = |values: Vec<f32>| candle_core::Tensor::new(values, &Device::Cpu).unwrap();
    let ours = tensor(top.iter().map(|t| t.1).collect());
    let wanted = tensor(order[..20].iter().map(|&id| golden[id]).collect());
    assert!(relative_difference(&ours, &wanted) <= common::TOLERANCE);
}

/// Rounding weights and activations to bf16 moves the logits of this small model by up to a few hundredths of the largest,
/// by another path with each kernel; `tests/golden` holds them to the reference's own gap.
#[test]
fn bf16_answers_nearly_alike() {
    let checkpoint = Checkpoint::new();
    let top = |dtype: &str| -> Vec<(u32, f32)> {
        let out = checkpoint.ask(&["--json", "--max-new-tokens", "1", "--weights", dtype]);
        assert!(out.status.success(), "{}", String::from_utf8_lossy(&out.stderr));
        let v: Value = serde_json::from_slice(&out.stdout).unwrap();
        serde_json::from_value(v["first_logits_top"].clone()).unwrap()
    };
    let (whole, half) = (top("f32"), top("bf16"));
    assert_ne!(whole, half, "bf16 was not used");
    let largest = whole[0].1.abs();
    let common = whole.iter().filter_map(|(id, a)| Some((a, half.iter().find(|(h, _)| h == id)?.1)));
    let differences: Vec<f32> = common.map(|(a, b)| (a - b).abs() / largest).collect();
    assert!(differences.len() >= 15, "{whole:?} {half:?}");
    assert!(differences.iter().all(|&d| d < 0.1), "{differences:?}");
}

#[test]
fn without_json_the_words_alone_are_printed() {
    let out = Checkpoint::new().ask(&["--max-new-tokens", "2"]);
    assert!(out.status.success(), "{}", String::from_utf8_lossy(&out.stderr));
    let wanted: String =
        golden().integers(&format!("{CASE}.generated_ids_rp105"))[..2].iter().map(|id| word(*id)).collect();
    assert_eq!(String::from_utf8(out.stdout).unwrap(), format!("{wanted}\n"));
}

#[test]
fn an_answer_ends_before_a_stop_id() {
    let checkpoint = Checkpoint::new();
    let model = checkpoint.load().unwrap();
    let image = sdim::read_rgb(fixture().join(format!("image_{CASE}.png"))).unwrap();
    let golden: Vec<u32> =
        golden().integers(&format!("{CASE}.generated_ids_rp105")).iter().map(|&id| id as u32).collect();
    let options = AnswerOptions::default().with_stop_ids(vec![golden[3]]);
    let answer = model.answer(&image, QUESTION, &options).unwrap();
    assert_eq!(answer.generated_ids, golden[..3]);
}

/// The output head has more columns than the vocabulary has tokens: here one of them is ten times as likely as any token.
#[test]
fn columns_without_a_token_are_never_chosen() {
    let checkpoint = Checkpoint::new();
    let path = checkpoint.path("model.safetensors");
    let mut tensors = candle_core::safetensors::load(&path, &Device::Cpu).unwrap();
    let name = ["lm_head.weight", "model.embed_tokens.weight"].into_iter().find(|n| tensors.contains_key(*n));
    let head = tensors[name.unwrap()].to_dtype(candle_core::DType::F32).unwrap();
    let wanted = golden().integers(&format!("{CASE}.generated_ids_rp105"));
    let logits: Vec<f32> = golden().take(&format!("{CASE}.last_logits")).unwrap().to_vec1().unwrap();
    assert!(logits[wanted[0] as usize] > 0.0 && logits.len() == 304);
    let loud = (head.narrow(0, wanted[0] as usize, 1).unwrap() * 10.0).unwrap();
    let head = candle_core::Tensor::cat(&[head.narrow(0, 0, 303).unwrap(), loud], 0).unwrap();
    tensors.insert(name.unwrap().into(), head);
    candle_core::safetensors::save(&tensors, &path).unwrap();
    let out = checkpoint.ask(&["--json", "--max-new-tokens", &wanted.len().to_string()]);
    let v: Value = serde_json::from_slice(&out.stdout).unwrap();
    assert_eq!(ids(&v["generated_ids"]), wanted);
    first_logits_are_those_of(&v["first_logits_top"], &logits);
}

/// `transformers` 5 writes the keys of `preprocessor_config.json` into `processor_config.json`.
#[test]
fn a_checkpoint_as_newer_versions_save_it_answers_alike() {
    let checkpoint = Checkpoint::new();
    let answer = || checkpoint.ask(&["--json", "--max-new-tokens", "1"]).stdout;
    let as_published = answer();
    let older = checkpoint.path("preprocessor_config.json");
    let mut part: Value = serde_json::from_slice(&std::fs::read(&older).unwrap()).unwrap();
    std::fs::remove_file(&older).unwrap();
    let write = |json: Value| checkpoint.write("processor_config.json", &json);
    write(json!({"processor_class": "Qwen2_5_VLProcessor"}));
    checkpoint.does_not_load("preprocessor_config.json");
    write(json!({"processor_class": "Qwen2_5_VLProcessor", "image_processor": part}));
    assert!(!as_published.is_empty());
    assert_eq!(answer(), as_published);
    // Where both stand, the reference takes the newer one.
    checkpoint.write("preprocessor_config.json", &json!({"patch_size": 7}));
    checkpoint.load().unwrap();
    part["image_std"] = json!([1, 1, 0]);
    write(json!({"image_processor": part}));
    checkpoint.does_not_load("image_processor.image_std");
}

#[test]
fn nobody_reading_the_answer_is_no_failure() {
    let checkpoint = Checkpoint::new();
    let mut command = checkpoint.command(&["--max-new-tokens", "1"]);
    let mut child = command.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
    drop(child.stdout.take());
    let out = child.wait_with_output().unwrap();
    assert!(out.status.success() && out.stderr.is_empty(), "{}", String::from_utf8_lossy(&out.stderr));
}

#[test]
fn a_conversation_may_have_more_images_or_none() {
    let model = Checkpoint::new().load().unwrap();
    let image = sdim::read_rgb(fixture().join(format!("image_{CASE}.png"))).unwrap();
    let options = AnswerOptions::default().with_max_new_tokens(3);
    let two = ChatPrompt::new().user([Part::Image, Part::Image, QUESTION.into()]);
    let answer = model.reply(&two, &[&image, &image], &options).unwrap();
    assert_eq!(answer.prompt_ids.iter().filter(|&&id| id == 300).count(), 2 * 32);
    let none = ChatPrompt::new().user([QUESTION.into()]);
    assert_eq!(model.reply(&none, &[], &options).unwrap().prompt_ids.len(), BEFORE.len() + AFTER.len());
    for images in [&[&image][..], &[&image, &image, &image]] {
        let error = model.reply(&two, images, &options).unwrap_err();
        assert!(matches!(error, Error::Argument { name: "image placeholders", .. }), "{error}");
    }
}

#[test]
fn shards_answer_alike_and_damaged_ones_are_named() {
    let checkpoint = Checkpoint::new();
    let whole = checkpoint.ask(&["--json", "--max-new-tokens", "3"]);
    let map = checkpoint.shard();
    assert_eq!(checkpoint.ask(&["--json", "--max-new-tokens", "3"]).stdout, whole.stdout);

    let mut lies = map.clone();
    lies["model.layers.9.mlp.up_proj.weight"] = json!("model-2.safetensors");
    checkpoint.index(&lies);
    checkpoint.does_not_load("model.layers.9.mlp.up_proj.weight");
    for outside in ["../model-2.safetensors", "/etc/passwd"] {
        let mut leaves = map.clone();
        leaves["model.norm.weight"] = json!(outside);
        checkpoint.index(&leaves);
        let error = checkpoint.does_not_load("model.safetensors.index.json");
        assert!(matches!(error, Error::Format { .. }) && error.to_string().contains(outside), "{error}");
    }
    checkpoint.index(&map);

    let shard = checkpoint.path("model-2.safetensors");
    let bytes = std::fs::read(&shard).unwrap();
    for length in [bytes.len() - 1, bytes.len() / 2, 7, 0] {
        std::fs::write(&shard, &bytes[..length]).unwrap();
        let error = checkpoint.does_not_load("model-2.safetensors");
        assert!(matches!(error, Error::Format { .. }), "{length} bytes: {error}");
    }
    std::fs::remove_file(&shard).unwrap();
    assert!(matches!(checkpoint.does_not_load("model-2.safetensors"), Error::Io { .. }));
}

#[test]
fn a_config_or_tokenizer_of_another_model_is_named() {
    let checkpoint = Checkpoint::new();
    let mut config: Value =
        serde_json::from_slice(&std::fs::read(checkpoint.path("config.json")).unwrap()).unwrap();
    config["model_type"] = json!("qwen3_vl");
    checkpoint.write("config.json", &config);
    assert!(matches!(checkpoint.does_not_load("model_type"), Error::Config { .. }));
    checkpoint.refused(&[], "config.json");
    std::fs::copy(fixture().join("config.json"), checkpoint.path("config.json")).unwrap();

    checkpoint.write("tokenizer.json", &tokenizer(Some("<|image_pad|>")));
    let error = checkpoint.does_not_load("tokenizer.json");
    assert!(error.to_string().contains("<|image_pad|>"), "{error}");
    let mut moved: Value =
        serde_json::from_slice(&std::fs::read(checkpoint.path("config.json")).unwrap()).unwrap();
    moved["image_token_id"] = json!(299);
    checkpoint.write("config.json", &moved);
    checkpoint.write("tokenizer.json", &tokenizer(None));
    checkpoint.does_not_load("image_token_id");
    std::fs::copy(fixture().join("config.json"), checkpoint.path("config.json")).unwrap();

    checkpoint.write("generation_config.json", &json!({"repetition_penalty": -1}));
    assert!(matches!(checkpoint.does_not_load("generation_config.json"), Error::Config { .. }));
    std::fs::remove_file(checkpoint.path("tokenizer.json")).unwrap();
    checkpoint.does_not_load("tokenizer.json");
}

#[test]
fn arguments_that_cannot_be_answered_are_named() {
    let checkpoint = Checkpoint::new();
    let (none, words) = (checkpoint.path("absent.png"), checkpoint.path("words.png"));
    std::fs::write(&words, "no image at all").unwrap();
    let cut = checkpoint.path("cut.png");
    let whole = std::fs::read(fixture().join("image_b.png")).unwrap();
    std::fs::write(&cut, &whole[..whole.len() / 2]).unwrap();
    let thin = checkpoint.path("thin.png");
    image::RgbImage::new(1, 201).save(&thin).unwrap();
    let cases: [(&[&str], &str); 12] = [
        (&["--image", text(&none)], "absent.png"),
        (&["--image", text(&words)], "words.png"),
        (&["--image", text(&cut)], "cut.png"),
        (&["--image", text(&thin)], "1x201"),
        (&["--prompt", ""], "question"),
        (&["--prompt", " \n"], "question"),
        (&["--prompt", "<|image_pad|>"], "image placeholders"),
        (&["--max-new-tokens", "0"], "max_new_tokens"),
        (&["--repetition-penalty", "0"], "repetition_penalty"),
        (&["--repetition-penalty", "NaN"], "repetition_penalty"),
        (&["--model", text(&none)], "absent.png"),
        (&["--device", "gpu"], "gpu"),
    ];
    for (args, wanted) in cases {
        checkpoint.refused(args, wanted);
    }
}
