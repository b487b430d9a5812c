//! The fusion block: a fresh one adds exactly nothing, a trained one does, and folding changes nothing.

mod common;

use candle_core::Tensor;
use common::tiny::{self, Tensors};
use common::{device, relative_difference};
use sdim::SparseDepth;
use sdim::internals::fusion::{BatchStats, Fusion, Normalise};
use sdim::internals::model::{AskOptions, SdimModel, ask};
use sdim::internals::query::Query;
use sdim::internals::vlm::checkpoint::weights::Weights;
use sdim::settings::{FusionConfig, Settings};

const CONFIG: FusionConfig = FusionConfig { branch: 6, high: 10, low: 5 };

fn settings(fusion: bool) -> Settings {
    Settings { fusion: fusion.then_some(CONFIG), ..Settings::tiny() }
}

/// Values between -1 and 1 that repeat after nothing.
fn noise(count: usize, seed: u32) -> Vec<f32> {
    let mut state = seed.wrapping_mul(2_654_435_761).wrapping_add(12345);
    let mut next = || {
        state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        (state >> 8) as f32 / (1 << 23) as f32 - 1.0
    };
    (0..count).map(|_| next()).collect()
}

fn random(shape: &[usize], scale: f32, offset: f32, seed: u32) -> Tensor {
    let values: Vec<f32> = noise(shape.iter().product(), seed).iter().map(|v| v * scale + offset).collect();
    Tensor::from_vec(values, shape, &device()).unwrap()
}

/// He's scale (uniform with the same variance) for the two convolutions that start at zero.
fn he_initialised(mut tensors: Tensors) -> Tensors {
    for (i, name) in ["sdim.fusion.depth.conv.weight", "sdim.fusion.out.weight"].into_iter().enumerate() {
        let shape = tensors[name].dims().to_vec();
        let fan_in: usize = shape[1..].iter().product();
        let limit = (6.0 / fan_in as f32).sqrt();
        assert_eq!(relative_difference(&tensors[name], &tensors[name].zeros_like().unwrap()), 0.0, "{name}");
        tensors.insert(name.into(), random(&shape, limit, 0.0, i as u32));
    }
    tensors
}

/// Image tokens of the test frame, and readings of a few queries, as bits.
fn run(model: &SdimModel, sparse: &SparseDepth) -> (Vec<u32>, Vec<u32>) {
    let (rgb, _) = tiny::frame(90, 70);
    let (pixels, scattered) = model.preprocess(&rgb, sparse).unwrap();
    let tokens = model.encode(&pixels, &scattered).unwrap();
    let prefix = model.prefill_prefix(&pixels, &tokens, sparse).unwrap();
    let queries: Vec<Query> =
        (0..20).map(|i| Query { x: i * 4, y: i * 3, measured: None, hint: 2.0 }).collect();
    let readings = ask(model, &prefix, &queries, AskOptions::default()).unwrap();
    let tokens: Vec<f32> = tokens.flatten_all().unwrap().to_vec1().unwrap();
    let readings = readings.iter().flat_map(|r| [r.value, r.confidence, r.expected_error]);
    (tokens.iter().map(|v| v.to_bits()).collect(), readings.map(f32::to_bits).collect())
}

/// The frame's measurements, moved away by a metre.
fn farther(sparse: &SparseDepth) -> SparseDepth {
    let points: Vec<_> = sparse.points().map(|(x, y, d)| (x, y, if d < 8.0 { d + 0.5 } else { d })).collect();
    SparseDepth::from_points(sparse.width(), sparse.height(), &points).unwrap()
}

#[test]
fn a_fresh_block_adds_exactly_nothing_and_a_trained_one_does() {
    let with = tiny::small_files(&settings(true));
    let without = tiny::small_files(&settings(false));
    let tensors = tiny::tensors(&with, 5);
    let mut plain = tensors.clone();
    plain.retain(|name, _| !name.starts_with("sdim.fusion.") && !name.starts_with("sdim.patch_embed."));
    assert!(plain.len() < tensors.len());
    let plain = tiny::model(&without, plain);
    let fresh = tiny::model(&with, tensors.clone());
    let trained = tiny::model(&with, he_initialised(tensors));
    let (_, sparse) = tiny::frame(90, 70);

    let wanted = run(&plain, &sparse);
    assert!(run(&fresh, &sparse) == wanted, "a fresh block changes the output");
    let changed = run(&trained, &sparse);
    assert!(changed.0 != wanted.0, "a trained block leaves the image tokens alone");
    assert!(changed.1 != wanted.1, "a trained block leaves the answers alone");

    let moved = farther(&sparse);
    assert!(run(&fresh, &moved).0 == wanted.0, "without the block no measurement reaches the image tokens");
    assert!(run(&trained, &moved).0 != changed.0, "measurements do not pass through the block");
}

/// A block with random convolutions and random statistics.
fn random_block(seed: u32) -> Tensors {
    let mut out = Tensors::new();
    let mut put = |name: String, tensor: Tensor| out.insert(format!("sdim.fusion.{name}"), tensor);
    let sizes = [
        ("rgb", 3, CONFIG.branch),
        ("depth", 1, CONFIG.branch),
        ("high", 2 * CONFIG.branch, CONFIG.high),
        ("low", CONFIG.high, CONFIG.low),
    ];
    for (i, (part, inputs, outputs)) in sizes.into_iter().enumerate() {
        let seed = seed + 10 * i as u32;
        put(format!("{part}.conv.weight"), random(&[outputs, inputs, 3, 3], 0.4, 0.0, seed));
        put(format!("{part}.bn.weight"), random(&[outputs], 0.5, 1.0, seed + 1));
        put(format!("{part}.bn.bias"), random(&[outputs], 0.5, 0.0, seed + 2));
        put(format!("{part}.bn.running_mean"), random(&[outputs], 0.7, 0.1, seed + 3));
        put(format!("{part}.bn.running_var"), random(&[outputs], 0.9, 1.2, seed + 4));
    }
    put("out.weight".into(), random(&[3, CONFIG.low, 3, 3], 0.4, 0.0, seed + 100));
    put("out.bias".into(), random(&[3], 0.4, 0.0, seed + 101));
    out
}

fn fusion(tensors: &Tensors) -> Fusion {
    let weights = Weights::from_tensors("test", tensors.clone());
    let block = Fusion::new(&CONFIG, &weights).unwrap();
    weights.finish().unwrap();
    block
}

fn inputs() -> (Tensor, Tensor) {
    (random(&[2, 17, 22, 3], 1.5, 0.2, 77), random(&[2, 17, 22, 1], 0.5, 0.5, 78))
}

#[test]
fn folding_changes_nothing() {
    let mut block = fusion(&random_block(1));
    let (rgb, sparse) = inputs();
    let plain = block.forward(&rgb, &sparse, Normalise::Running).unwrap();
    block.fold().unwrap();
    let folded = block.forward(&rgb, &sparse, Normalise::Running).unwrap();
    assert_eq!(plain.dims(), [2, 17, 22, 3]);
    let difference = relative_difference(&folded, &plain);
    println!("folded: {difference:.1e}");
    assert!(difference < 1e-5, "{difference:.1e}");
    let other = fusion(&random_block(2)).forward(&rgb, &sparse, Normalise::Running).unwrap();
    assert!(relative_difference(&other, &plain) > 0.1, "the weights do not matter");
}

#[test]
fn running_statistics_that_equal_the_batchs_give_the_batchs_output() {
    let mut tensors = random_block(3);
    let (rgb, sparse) = inputs();
    let mut stats: Vec<BatchStats> = Vec::new();
    let batch = fusion(&tensors).forward(&rgb, &sparse, Normalise::Batch(&mut stats)).unwrap();
    assert_eq!(stats.len(), 4);
    let before = fusion(&tensors).forward(&rgb, &sparse, Normalise::Running).unwrap();
    assert!(relative_difference(&before, &batch) > 0.01, "the statistics do not matter");
    for s in stats {
        for (part, values) in [("running_mean", s.mean), ("running_var", s.var)] {
            let count = values.len();
            let old = tensors
                .insert(format!("{}.{part}", s.name), Tensor::from_vec(values, count, &device()).unwrap());
            assert!(old.is_some(), "{} is no name of a checkpoint", s.name);
        }
    }
    let running = fusion(&tensors).forward(&rgb, &sparse, Normalise::Running).unwrap();
    let difference = relative_difference(&running, &batch);
    assert!(difference < 1e-5, "{difference:.1e}");
}
