//! One block or layer of each kind at the published sizes, with random weights, on an image of 644x476:
//! `cargo bench --bench layers -- 3b/bf16`.
//!
//! An element of the throughput is a pixel of the fusion block, a patch of the encoder, a token of the decoder.

#[path = "../examples/throughput/shapes.rs"]
mod shapes;

use candle_core::{Device, Tensor};
use criterion::{Criterion, SamplingMode, Throughput, criterion_group, criterion_main};
use sdim::WeightFormat;
use sdim::internals::fusion::{Fusion, Normalise};
use sdim::internals::vlm::checkpoint::weights::Weights;
use sdim::internals::vlm::qwen2_5::Interrupt;
use sdim::internals::vlm::qwen2_5::cache::KvCache;
use sdim::internals::vlm::qwen2_5::config::{VisionConfig, VlmConfig};
use sdim::internals::vlm::qwen2_5::decoder::{Context, Decoder, Keep};
use sdim::internals::vlm::qwen2_5::grid::Grid;
use sdim::internals::vlm::qwen2_5::patch_embed::PatchEmbed;
use sdim::internals::vlm::qwen2_5::rope::{MRope, Position, RopeTable};
use sdim::internals::vlm::qwen2_5::vision::VisionTower;
use sdim::settings::{FusionConfig, RopeLayout};
use std::cell::LazyCell;
use std::time::Duration;

const FORMATS: [WeightFormat; 3] = [WeightFormat::F32, WeightFormat::Bf16, WeightFormat::Int8];
const CPU: Device = Device::Cpu;
/// 644 x 476 pixels, 391 merged tokens.
const GRID: Grid = Grid { height: 34, width: 46 };
/// The image's tokens and 20 of text.
const PROMPT: usize = 411;

fn model(name: &str) -> VlmConfig {
    let mut config =
        VlmConfig::from_json(name, &shapes::config(name).expect("a known model")).expect("a config");
    // One layer, and no more of the vocabulary than a benchmark asks for: nothing.
    (config.text.layers, config.text.vocab_size) = (1, 1);
    config
}

fn weights(format: WeightFormat) -> Weights {
    Weights::made(shapes::random, &CPU).with_format(format)
}

fn values(shape: &[usize]) -> Tensor {
    Tensor::from_vec(shapes::random("values", shape), shape, &CPU).expect("a tensor")
}

/// What comes before the encoder's blocks; f32 in every format.
fn image(c: &mut Criterion) {
    let (config, side) = (model("3b").vision, 14);
    let (height, width) = (GRID.height * side, GRID.width * side);
    let mut group = c.benchmark_group("image");
    group.sampling_mode(SamplingMode::Flat).throughput(Throughput::Elements((height * width) as u64));
    let block = LazyCell::new(|| {
        let (config, weights) = (FusionConfig::default(), weights(WeightFormat::F32));
        let mut fusion = Fusion::new(&config, &weights).expect("a block");
        fusion.fold().expect("running statistics");
        (fusion, values(&[1, height, width, 3]), values(&[1, height, width, 1]))
    });
    group.bench_function("fusion", |b| {
        let (fusion, rgb, sparse) = &*block;
        b.iter(|| fusion.forward(rgb, sparse, Normalise::Running).expect("an image"));
    });
    group.throughput(Throughput::Elements(GRID.patches() as u64));
    let embed = PatchEmbed::new(&config, &weights(WeightFormat::F32), "embed").expect("an embedding");
    let patches = values(&[GRID.patches(), config.patch_len()]);
    group.bench_function("patch-embed", |b| b.iter(|| embed.forward(&patches).expect("patches")));
    group.finish();
}

fn vision(c: &mut Criterion) {
    let mut config = model("3b").vision;
    let patches = values(&[GRID.patches(), config.hidden_size]);
    // Blocks before the first full attention are what `base` runs, so that full attention is here that of one large window.
    config.fullatt_block_indexes.clear();
    for format in FORMATS {
        let mut group = c.benchmark_group(format!("vision/{format}"));
        group.sampling_mode(SamplingMode::Flat).throughput(Throughput::Elements(GRID.patches() as u64));
        let tower = |depth, window_size| {
            let config = VisionConfig { depth, window_size, ..config.clone() };
            LazyCell::new(move || VisionTower::new(&config, &weights(format)).expect("a tower"))
        };
        for (name, window) in [("windowed-block", config.window_size), ("full-block", 1 << 16)] {
            let tower = tower(1, window);
            group.bench_function(name, |b| {
                let tower = &*tower;
                b.iter(|| tower.base(patches.clone(), GRID).expect("a block"));
            });
        }
        let tower = tower(0, config.window_size);
        group.bench_function("merger", |b| {
            let tower = &*tower;
            b.iter(|| tower.encode(&patches, &[GRID]).expect("tokens"));
        });
        group.finish();
    }
}

/// Positions `from`, `from + 1`, ...
fn table(rope: &MRope, from: usize, tokens: usize) -> RopeTable {
    let positions: Vec<_> = (from..from + tokens).map(|p| Position::text(p as f32)).collect();
    rope.table(&positions, &CPU).expect("a table")
}

/// The layer with all its outputs.
fn pass(decoder: &Decoder, x: &Tensor, table: &RopeTable, shared: Option<&KvCache>, own: &mut KvCache) {
    decoder
        .forward_keeping(x, table, Context::Cached { shared, own }, Keep::All, Interrupt::NEVER)
        .expect("a pass");
}

fn decoder(c: &mut Criterion) {
    for name in ["3b", "7b"] {
        let config = model(name).text;
        for format in FORMATS {
            let mut group = c.benchmark_group(format!("{name}/{format}"));
            group.sampling_mode(SamplingMode::Flat);
            // The layer, and a prompt with what the layer keeps of it.
            let made = LazyCell::new(|| {
                let layer = Decoder::new(&config, &weights(format), RopeLayout::Contiguous).expect("a layer");
                let (prompt, table) = (values(&[PROMPT, config.hidden_size]), table(layer.rope(), 0, PROMPT));
                let mut prefix = layer.cache(1);
                pass(&layer, &prompt, &table, None, &mut prefix);
                (layer, prompt, table, prefix)
            });
            group.throughput(Throughput::Elements(PROMPT as u64));
            group.bench_function("prefill", |b| {
                let (layer, prompt, table, _) = &*made;
                b.iter(|| pass(layer, prompt, table, None, &mut layer.cache(1)));
            });
            for queries in [64, 512] {
                group.throughput(Throughput::Elements(queries as u64));
                group.bench_function(format!("queries-{queries}"), |b| {
                    let (layer, _, _, prefix) = &*made;
                    let (x, table) =
                        (values(&[queries, config.hidden_size]), table(layer.rope(), PROMPT, queries));
                    b.iter(|| pass(layer, &x, &table, Some(prefix), &mut layer.cache(queries)));
                });
            }
            group.finish();
        }
    }
}

fn config() -> Criterion {
    let short = Criterion::default().sample_size(10).nresamples(2000);
    short.warm_up_time(Duration::from_millis(300)).measurement_time(Duration::from_secs(2))
}

criterion_group! { name = benches; config = config(); targets = image, vision, decoder }
criterion_main!(benches);
