//! Stages of one 640x480 frame on the embedded checkpoint: `cargo bench --bench frame`.

use criterion::{Criterion, criterion_group, criterion_main};
use sdim::depth::sample_points;
use sdim::internals::fusion::Normalise;
use sdim::internals::model::{AskOptions, ask};
use sdim::internals::query::Query;
use sdim::internals::scenes::procedural;
use sdim::refine::{Answered, EdgeAwareFill, Fill, FillInput};
use sdim::{CompleteOptions, DepthCompleter, QueryPlan};

fn frame(c: &mut Criterion) {
    let frame = procedural(2_000_003, 640, 480).expect("a scene");
    let sparse = sample_points(&frame.depth, 640, 480, 500, 1).expect("points");
    let completer = DepthCompleter::tiny().expect("the embedded checkpoint");
    let model = completer.model();
    let (pixels, scattered) = model.preprocess(&frame.rgb, &sparse).expect("a frame");
    let tokens = model.encode(&pixels, &scattered).expect("tokens");
    let prefix = model.prefill_prefix(&pixels, &tokens, &sparse).expect("a prefix");
    let queries: Vec<Query> =
        (0..4096).map(|i| Query { x: i * 7 % 640, y: i * 11 % 480, measured: None, hint: 2.0 }).collect();

    let mut group = c.benchmark_group("tiny-640x480");
    group.sample_size(10);
    group.bench_function("preprocess", |b| b.iter(|| model.preprocess(&frame.rgb, &sparse)));
    let patches = model.preprocessor.patches(&pixels, &model.device).expect("patches");
    group.bench_function("patch-embed", |b| b.iter(|| model.vlm.vision.patch_embed.forward(&patches)));
    let image =
        model.preprocessor.image(&pixels, &model.device).expect("an image").unsqueeze(0).expect("a batch");
    let injection = model.injection.as_ref().expect("a fusion block");
    group.bench_function("fusion", |b| {
        b.iter(|| injection.fusion.forward(&image, &scattered, Normalise::Running));
    });
    group.bench_function("vision", |b| b.iter(|| model.vlm.encode(&patches, &[pixels.grid])));
    group.bench_function("encode", |b| b.iter(|| model.encode(&pixels, &scattered)));
    group.bench_function("prefill", |b| b.iter(|| model.prefill_prefix(&pixels, &tokens, &sparse)));
    group.bench_function("ask-4096", |b| b.iter(|| ask(model, &prefix, &queries, AskOptions::default())));
    let asked: Vec<Answered> = (0..160 * 120)
        .map(|i| Answered {
            x: i % 160 * 4,
            y: i / 160 * 4,
            depth: 2.0 + (i % 7) as f32 * 0.01,
            confidence: 0.9,
            expected_error: 0.01,
        })
        .collect();
    let input = FillInput { width: 640, height: 480, rgb: &frame.rgb, asked: &asked, sparse: &sparse };
    group.bench_function("fill-stride-4", |b| b.iter(|| EdgeAwareFill::default().fill(&input)));
    for plan in [QueryPlan::Stride(4), QueryPlan::Stride(2)] {
        let options = CompleteOptions::default().with_plan(plan);
        group.bench_function(format!("complete-{plan}"), |b| {
            b.iter(|| completer.complete(&frame.rgb, &sparse, &options));
        });
    }
    group.finish();
}

criterion_group!(benches, frame);
criterion_main!(benches);
