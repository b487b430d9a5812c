//! Whatever threads ask, and however often, a model gives the same answers: on the CPU at small shapes, on the device that
//! `SDIM_TEST_DEVICE` names at those of a model of 3 billion weights (with fewer layers), whose work takes long enough to overlap.

mod common;
#[path = "../examples/throughput/shapes.rs"]
mod shapes;

use candle_core::Device;
use common::device;
use image::RgbImage;
use sdim::internals::kernels;
use sdim::internals::vlm::checkpoint::weights::Weights;
use sdim::internals::vlm::qwen2_5::QwenVl;
use sdim::internals::vlm::qwen2_5::cache::KvCache;
use sdim::internals::vlm::qwen2_5::config::VlmConfig;
use sdim::internals::vlm::qwen2_5::decoder::Keep;
use sdim::internals::vlm::qwen2_5::rope::Position;
use sdim::internals::vlm::qwen2_5::sequences::Sequences;
use sdim::settings::RopeLayout;
use sdim::{CompleteOptions, DepthCompleter, LoadOptions, QueryPlan, SparseDepth, WeightFormat};

/// Tokens that all queries see.
const PREFIX: usize = 400;
/// Tokens of an answer.
const STEPS: usize = 5;

/// Published shapes with few layers and words, and hardly a vision encoder.
fn config() -> VlmConfig {
    let (name, layers) = if device().is_cpu() { ("tiny", 2) } else { ("3b", 12) };
    let mut json = shapes::config(name).unwrap();
    json["num_hidden_layers"] = layers.into();
    json["vision_config"]["depth"] = 1.into();
    for (key, id) in [
        ("vocab_size", 1024),
        ("vision_start_token_id", 1000),
        ("vision_end_token_id", 1001),
        ("image_token_id", 1002),
        ("video_token_id", 1003),
    ] {
        json[key] = id.into();
    }
    VlmConfig::from_json("config.json", &json).unwrap()
}

struct Model {
    vlm: QwenVl,
    prefix: KvCache,
}

impl Model {
    fn new(format: WeightFormat) -> Self {
        let weights = Weights::made(shapes::random, &device()).with_format(format);
        let vlm = QwenVl::new(config(), &weights, RopeLayout::Contiguous).unwrap();
        let ids: Vec<u32> = (0..PREFIX as u32).map(|i| i * 37 % 900).collect();
        let positions: Vec<Position> = (0..PREFIX).map(|i| Position::text(i as f32)).collect();
        let embedded = vlm.decoder.embed(&ids).unwrap();
        let mut prefix = vlm.decoder.cache(1);
        vlm.prefill(&embedded, &positions, &mut prefix, Keep::Nothing).unwrap();
        Self { vlm, prefix }
    }

    /// The likeliest of eleven tokens at each step, query after query.
    fn answers(&self, queries: usize) -> Vec<u32> {
        let decoder = &self.vlm.decoder;
        let number_ids: Vec<u32> = (13..24).collect();
        let rows = decoder.head_rows(&number_ids).unwrap();
        let mut ids: Vec<u32> = (0..queries as u32).map(|i| i * 7 % 900).collect();
        let positions: Vec<Position> =
            (0..queries).map(|i| Position::text((PREFIX + i % 50) as f32 + 0.25)).collect();
        let next = positions.iter().map(|p| p.t + 1.0).collect();
        let embedded = decoder.embed(&ids).unwrap();
        let mut sequences =
            Sequences::prefill(decoder, Some(&self.prefix), &embedded, &positions, next).unwrap();
        let mut out = Vec::new();
        for step in 0..STEPS {
            if step > 0 {
                sequences.decode_step(&ids).unwrap();
            }
            let best = kernels::linear(sequences.last(), &rows, None).unwrap().argmax(1).unwrap();
            let best: Vec<u32> = best.to_vec1().unwrap();
            ids = best.iter().map(|&i| number_ids[i as usize]).collect();
            out.extend(best);
        }
        out
    }
}

#[test]
fn answers_are_equal_in_ten_runs_on_other_threads_and_almost_those_of_f32() {
    let queries = if device().is_cpu() { 32 } else { 2048 };
    let model = Model::new(WeightFormat::Bf16);
    let wanted = model.answers(queries);
    let mut kinds = wanted.clone();
    kinds.sort_unstable();
    kinds.dedup();
    assert!(kinds.len() > 2, "all answers are alike");
    let pool = rayon::ThreadPoolBuilder::new().num_threads(4).build().unwrap();
    for run in 0..10 {
        let found = match run % 3 {
            0 => model.answers(queries),
            1 => std::thread::scope(|s| s.spawn(|| model.answers(queries)).join().unwrap()),
            _ => pool.install(|| model.answers(queries)),
        };
        let off = found.iter().zip(&wanted).filter(|(a, b)| a != b).count();
        assert_eq!(off, 0, "of {} ids in run {run}", wanted.len());
    }
    drop(model);
    let exact = Model::new(WeightFormat::F32).answers(queries);
    // First answers alone: later ones follow from those before.
    let same = exact.iter().zip(&wanted).take(queries).filter(|(a, b)| a == b).count();
    println!("{same} of {queries} first ids are those of f32, {} kinds", kinds.len());
    assert!(same * 100 >= queries * 90, "{same} of {queries} first ids are those of f32");
}

fn frame() -> (RgbImage, SparseDepth) {
    let frame = sdim::internals::scenes::procedural(3_000_001, 160, 120).unwrap();
    let sparse = sdim::depth::sample_points(&frame.depth, 160, 120, 200, 1).unwrap();
    (frame.rgb, sparse)
}

/// Another handle of the device that tests run on, with a stream of its own.
fn another() -> Device {
    let name = std::env::var("SDIM_TEST_DEVICE").unwrap_or_else(|_| "cpu".into());
    sdim::system::device(&name).unwrap()
}

#[test]
fn completers_of_several_threads_give_the_maps_of_one() {
    let (rgb, sparse) = frame();
    let (stride, repeats) = if device().is_cpu() { (16, 1) } else { (2, 4) };
    let options = CompleteOptions::default().with_plan(QueryPlan::Stride(stride));
    for format in [WeightFormat::F32, WeightFormat::Bf16] {
        let completer = |device: &Device| {
            let mut load = LoadOptions::on(device);
            load.weights = format;
            DepthCompleter::tiny_with(&load).unwrap()
        };
        let one = completer(&device());
        let wanted = one.complete(&rgb, &sparse, &options).unwrap();
        let others = [one.clone(), one, completer(&device()), completer(&another()), completer(&another())];
        std::thread::scope(|scope| {
            let runs = others.iter().map(|c| {
                let run =
                    || (0..repeats).map(|_| c.complete(&rgb, &sparse, &options).unwrap()).collect::<Vec<_>>();
                scope.spawn(run)
            });
            for (i, run) in runs.collect::<Vec<_>>().into_iter().enumerate() {
                for map in run.join().unwrap() {
                    let off = map.depth().iter().zip(wanted.depth()).filter(|(a, b)| a != b).count();
                    assert_eq!(off, 0, "{format}: pixels of completer {i} differ");
                }
            }
        });
    }
}
