//! What bf16 and int8 weights cost: states and logits of the random models beside those of the same models in f32.

use super::common::{Allowed, Golden, random};
use super::family::{Family, NAMES};
use super::{CPU, json, own_fixture};
use candle_core::{DType, Tensor};
use sdim::WeightFormat;
use sdim::WeightFormat::{Bf16, F32, Int8};
use sdim::internals::vlm::checkpoint::weights::Weights;
use sdim::internals::vlm::qwen2_5::QwenVl;
use sdim::internals::vlm::qwen2_5::config::VlmConfig;
use sdim::internals::vlm::qwen2_5::decoder::Keep;
use sdim::internals::vlm::qwen2_5::grid::Grid;
use sdim::internals::vlm::qwen2_5::positions::positions;
use sdim::internals::vlm::qwen2_5::preprocess::PreprocessorConfig;
use sdim::settings::RopeLayout;
use std::collections::HashMap;

/// One prompt, with the rows of its images.
struct Prompt {
    ids: Vec<u32>,
    rows: Option<Tensor>,
    grids: Vec<Grid>,
}

/// A random model and prompts for it.
struct Subject {
    name: &'static str,
    config: VlmConfig,
    tensors: HashMap<String, Tensor>,
    prompts: Vec<Prompt>,
}

fn ids(golden: &Golden, case: &str) -> Vec<u32> {
    golden.integers(&format!("{case}.input_ids")).into_iter().map(|id| id as u32).collect()
}

impl Subject {
    fn of_family(name: &'static str) -> Self {
        let family = Family::new(name);
        let golden = family.golden(Allowed::Rounding);
        let prompt = |case: &str| {
            let (rows, grids) = family.images(case);
            Prompt { ids: ids(&golden, case), rows, grids }
        };
        let prompts = family.cases().map(prompt).collect();
        let tensors = random::weights(&family.config).into_iter().collect();
        Self { name, config: family.config, tensors, prompts }
    }

    fn of_own_fixture() -> Self {
        let dir = own_fixture();
        let golden = Golden::open(&dir);
        let read = |name: &str| json(&dir.join(name));
        let preprocessor = PreprocessorConfig::from_json("", &read("preprocessor_config.json")).unwrap();
        let prompts = ["a", "b"].map(|case| {
            let rgb = sdim::read_rgb(dir.join(format!("image_{case}.png"))).unwrap();
            let pixels = preprocessor.resize(&rgb).unwrap();
            let rows = Some(preprocessor.patches(&pixels, &CPU).unwrap());
            Prompt { ids: ids(&golden, case), rows, grids: vec![pixels.grid] }
        });
        Self {
            name: "qwen_small",
            config: VlmConfig::from_json("", &read("config.json")).unwrap(),
            tensors: candle_core::safetensors::load(dir.join("model.safetensors"), &CPU).unwrap(),
            prompts: prompts.into(),
        }
    }

    fn all() -> Vec<Self> {
        NAMES.into_iter().map(Self::of_family).chain([Self::of_own_fixture()]).collect()
    }

    /// States after the final norm and logits, of all tokens of all prompts.
    fn run(&self, format: WeightFormat) -> [Vec<f32>; 2] {
        let weights = Weights::from_tensors(self.name, self.tensors.clone()).with_format(format);
        let model = QwenVl::new(self.config.clone(), &weights, RopeLayout::Contiguous).unwrap();
        let mut all = [Vec::new(), Vec::new()];
        for prompt in &self.prompts {
            let image = match &prompt.rows {
                Some(rows) => model.encode(rows, &prompt.grids).unwrap(),
                None => Tensor::zeros((0, self.config.text.hidden_size), DType::F32, &CPU).unwrap(),
            };
            let embedded = model.embed_prompt(&prompt.ids, &image).unwrap();
            let walked = positions(&prompt.ids, &prompt.grids, &self.config, 1.0).unwrap();
            let mut cache = model.decoder.cache(1);
            let hidden = model.prefill(&embedded, &walked.positions, &mut cache, Keep::All).unwrap();
            let normed = model.decoder.final_norm(&hidden).unwrap();
            let logits = model.decoder.logits(&normed).unwrap();
            for (all, one) in all.iter_mut().zip([normed, logits]) {
                all.extend(one.flatten_all().unwrap().to_vec1::<f32>().unwrap());
            }
        }
        all
    }
}

/// Root mean square of the differences over that of the values, and the largest difference over the largest value.
struct Difference {
    rms: f64,
    largest: f64,
}

impl Difference {
    fn of(ours: &[f32], exact: &[f32]) -> Self {
        assert_eq!(ours.len(), exact.len());
        let (mut squares, mut largest) = ([0f64; 2], [0f64; 2]);
        for (a, b) in ours.iter().zip(exact) {
            for (i, v) in [f64::from(a - b), f64::from(*b)].into_iter().enumerate() {
                squares[i] += v * v;
                // A value that is no number must not pass.
                largest[i] = if v.is_nan() { f64::INFINITY } else { largest[i].max(v.abs()) };
            }
        }
        Self { rms: (squares[0] / squares[1]).sqrt(), largest: largest[0] / largest[1] }
    }
}

impl std::fmt::Display for Difference {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{:9.4} {:9.4}", self.rms, self.largest)
    }
}

/// Of the states after the final norm, root mean square: about a fifth more than the most that any kernel was seen to differ.
fn limit(name: &str, format: WeightFormat) -> f64 {
    let (bf16, int8) = match name {
        "like_3b" => (0.018, 0.060),
        "like_7b" => (0.028, 0.085),
        "merge_3" => (0.028, 0.075),
        "merge_1" => (0.041, 0.105),
        "window_1" => (0.019, 0.057),
        "window_7" => (0.020, 0.057),
        "qwen_small" => (0.090, 0.260),
        other => panic!("no limit for {other}"),
    };
    if format == Bf16 { bf16 } else { int8 }
}

#[test]
fn bf16_and_int8_stay_within_their_limits() {
    println!("model       format  states: rms, largest  logits: rms, largest");
    for subject in Subject::all() {
        let exact = subject.run(F32);
        for format in [Bf16, Int8] {
            let ours = subject.run(format);
            let [states, logits] = [0, 1].map(|i| Difference::of(&ours[i], &exact[i]));
            let (name, limit) = (subject.name, limit(subject.name, format));
            println!("{name:11} {format:7} {states} {logits}");
            // Logits are one more product.
            assert!(states.rms <= limit && logits.rms <= 1.1 * limit, "{name}, {format}: allowed {limit}");
        }
    }
}

/// The limits are sharp enough to notice channels that have the scale of their neighbour, although the rows of these random
/// matrices have largest values that differ by a few per cent only.
#[test]
fn scales_of_other_channels_are_noticed() {
    for mut subject in Subject::all() {
        let exact = subject.run(F32);
        for tensor in subject.tensors.values_mut().filter(|t| t.rank() == 2) {
            let own = tensor.abs().unwrap().max_keepdim(1).unwrap();
            let rest = own.narrow(0, 1, own.dim(0).unwrap() - 1).unwrap();
            let next = Tensor::cat(&[rest, own.narrow(0, 0, 1).unwrap()], 0).unwrap();
            *tensor = tensor.broadcast_mul(&(next / own).unwrap()).unwrap();
        }
        let found = Difference::of(&subject.run(Int8)[0], &exact[0]);
        assert!(found.rms > limit(subject.name, Int8), "{}: {found}", subject.name);
    }
}
