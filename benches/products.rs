//! Matrix products at the sizes of the models, in each format: `cargo bench --bench products -- 3b/bf16`.
//!
//! A product is named inputs x outputs / rows; `gate-` is the gate and the up projection of an MLP with their SwiGLU. An element of the
//! throughput is a floating-point operation, two to a multiplication: Gelem/s are GFLOP/s. One weight is multiplied again and
//! again, so that small ones lie in the cache, where a model of many layers has to read them from memory.

#[path = "../examples/throughput/shapes.rs"]
mod shapes;

use candle_core::{Device, Tensor};
use criterion::{BenchmarkId, Criterion, SamplingMode, Throughput, criterion_group, criterion_main};
use sdim::internals::kernels::{PackedGate, RowMajor, swiglu};
use sdim::internals::vlm::layers::matrix::Matrix;
use sdim::internals::vlm::qwen2_5::config::VlmConfig;
use sdim::{Result, WeightFormat};
use std::cell::LazyCell;
use std::time::Duration;

const ROWS: [usize; 4] = [1, 64, 256, 1024];

/// Inputs and outputs of a weight, and whether two of them make the gated half of an MLP.
type Shape = (usize, usize, bool);

/// The products of a layer: attention from and to `width`, another of `outputs`, the gated MLP.
fn layer(width: usize, outputs: usize, inner: usize) -> Vec<Shape> {
    let attention = [width, outputs].map(|m| (width, m, false));
    let mlp = [(width, inner, true), (width, inner, false), (inner, width, false)];
    let mut all: Vec<Shape> = attention.into_iter().chain(mlp).collect();
    all.dedup();
    all
}

fn values(name: &str, rows: usize, columns: usize) -> Tensor {
    let values = shapes::random(name, &[rows, columns]);
    Tensor::from_vec(values, (rows, columns), &Device::Cpu).expect("a tensor")
}

enum Weight {
    Plain(Matrix),
    Gate(PackedGate),
    /// A format without a gate of its own.
    Pair(Matrix),
}

impl Weight {
    fn new((k, m, gated): Shape, format: WeightFormat) -> Result<Self> {
        if gated && format != WeightFormat::F32 {
            let values = shapes::random("weight", &[m, k]);
            let rows = RowMajor::f32(&values, m, k)?;
            return Ok(Self::Gate(PackedGate::new(format, (rows, None), (rows, None))?));
        }
        let one = Matrix::from_tensor(&values("weight", m, k), format)?;
        Ok(if gated { Self::Pair(one) } else { Self::Plain(one) })
    }

    fn apply(&self, x: &Tensor) -> Result<Tensor> {
        match self {
            Self::Plain(weight) => weight.linear(x, None),
            Self::Gate(gate) => gate.apply(x),
            Self::Pair(weight) => swiglu(&weight.linear(x, None)?, &weight.linear(x, None)?),
        }
    }
}

fn products(c: &mut Criterion, model: &str, shapes: &[Shape]) {
    for format in [WeightFormat::F32, WeightFormat::Bf16, WeightFormat::Int8] {
        let mut group = c.benchmark_group(format!("{model}/{format}"));
        group.sampling_mode(SamplingMode::Flat);
        for &(k, m, gated) in shapes {
            // Made when a benchmark that was asked for needs it; 7B weights are large.
            let weight = LazyCell::new(|| Weight::new((k, m, gated), format).expect("a weight"));
            for n in ROWS {
                let weights = if gated { 2 } else { 1 };
                group.throughput(Throughput::Elements((2 * n * k * m * weights) as u64));
                let name = format!("{}{k}x{m}", if gated { "gate-" } else { "" });
                let x = LazyCell::new(|| values("x", n, k));
                group.bench_function(BenchmarkId::new(name, n), |b| {
                    let (weight, x) = (&*weight, &*x);
                    b.iter(|| weight.apply(x).expect("a product"));
                });
            }
        }
        group.finish();
    }
}

fn all(c: &mut Criterion) {
    for model in ["tiny", "3b", "7b"] {
        let json = shapes::config(model).expect("a known model");
        let config = VlmConfig::from_json(model, &json).expect("a config");
        let (t, v) = (&config.text, &config.vision);
        // Keys and values as one.
        let kv = 2 * t.kv_heads * t.head_dim();
        products(c, model, &layer(t.hidden_size, kv, t.intermediate_size));
        // The 7B model has the vision encoder of the 3B one.
        if model != "7b" {
            let width = v.hidden_size;
            products(c, &format!("{model}-vision"), &layer(width, 3 * width, v.intermediate_size));
        }
    }
}

fn config() -> Criterion {
    let short = Criterion::default().sample_size(10).nresamples(2000);
    short.warm_up_time(Duration::from_millis(200)).measurement_time(Duration::from_millis(800))
}

criterion_group! { name = benches; config = config(); targets = all }
criterion_main!(benches);
