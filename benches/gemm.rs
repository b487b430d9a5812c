//! Products with packed weights, one JSON line each: `cargo bench --bench gemm -- --shapes 2048x11008 --rows 1,64,1024`.
//!
//! With `--threads 1` the time is that of the processor spent on this thread, which other work on the machine lengthens
//! less than it does the time on the wall. `benches/peers/gemm.py` runs this and PyTorch in turn.

use anyhow::{Context, Result};
use candle_core::{Device, Tensor};
use clap::Parser;
use cpu_time::ThreadTime;
use sdim::WeightFormat;
use sdim::internals::kernels::{PackedGate, PackedWeight, RowMajor};
use std::time::Instant;

#[derive(Parser)]
struct Args {
    /// Inputs x outputs of the weights.
    #[arg(long, value_delimiter = ',', default_value = "2048x2048,2048x11008,11008x2048")]
    shapes: Vec<String>,
    /// Rows multiplied at once.
    #[arg(long, value_delimiter = ',', default_value = "1,64,256,1024,4096")]
    rows: Vec<usize>,
    /// `bf16`, `int8`, or `gate-bf16`, `gate-int8` for the gate and the up projection of a SwiGLU network in one.
    #[arg(long, value_delimiter = ',', default_value = "bf16,int8")]
    formats: Vec<String>,
    /// Threads; 0 for one to a processor.
    #[arg(long, default_value_t = 0)]
    threads: usize,
    /// Seconds to repeat each product for.
    #[arg(long, default_value_t = 0.5)]
    seconds: f64,
    /// What `cargo bench` adds.
    #[arg(long, hide = true)]
    bench: bool,
    /// One small product, to see that it runs: `cargo bench -- --test`.
    #[arg(long, hide = true)]
    test: bool,
}

enum Weight {
    Plain(PackedWeight),
    Gate(PackedGate),
}

fn values(n: usize, step: usize) -> Vec<f32> {
    (0..n).map(|i| (i * step % 2003) as f32 / 1001.0 - 1.0).collect()
}

fn weight(format: &str, m: usize, k: usize) -> Result<Weight> {
    let all = values(m * k, 7919);
    let (gate, format) = match format.strip_prefix("gate-") {
        Some(format) => (true, format),
        None => (false, format),
    };
    let format = match format {
        "bf16" => WeightFormat::Bf16,
        "int8" => WeightFormat::Int8,
        other => anyhow::bail!("format {other}; expected bf16 or int8"),
    };
    let rows = RowMajor::f32(&all, m, k)?;
    Ok(match gate {
        true => Weight::Gate(PackedGate::new(format, (rows, None), (rows, None))?),
        false => Weight::Plain(PackedWeight::new(format, &[rows])?),
    })
}

/// Seconds that `f` takes: of this thread's processor time, or on the wall.
fn time<R>(by_thread: bool, f: impl FnOnce() -> R) -> (f64, R) {
    let (wall, thread) = (Instant::now(), ThreadTime::now());
    let result = f();
    let elapsed = if by_thread { thread.elapsed() } else { wall.elapsed() };
    (elapsed.as_secs_f64(), result)
}

fn main() -> Result<()> {
    let mut args = Args::parse();
    // Without any argument it is `cargo test --benches` that runs this.
    if args.test || std::env::args().len() == 1 {
        (args.shapes, args.rows, args.seconds) = (vec!["100x70".to_string()], vec![3], 0.0);
    }
    let pool = rayon::ThreadPoolBuilder::new().num_threads(args.threads);
    if args.threads == 1 { pool.use_current_thread() } else { pool }.build_global()?;
    for shape in &args.shapes {
        let (k, m) = shape.split_once('x').context("shapes are inputs x outputs")?;
        let (k, m): (usize, usize) = (k.parse()?, m.parse()?);
        for format in &args.formats {
            let start = Instant::now();
            let weight = weight(format, m, k)?;
            let packing = start.elapsed().as_secs_f64();
            for &n in &args.rows {
                let x = Tensor::from_vec(values(n * k, 104_729), (n, k), &Device::Cpu)?;
                let (mut times, start) = (Vec::new(), Instant::now());
                while times.len() < 3 || start.elapsed().as_secs_f64() < args.seconds {
                    let (seconds, out) = time(args.threads == 1, || match &weight {
                        Weight::Plain(weight) => weight.linear(&x, None),
                        Weight::Gate(gate) => gate.apply(&x),
                    });
                    times.push(seconds);
                    std::hint::black_box(out?);
                }
                times.sort_by(f64::total_cmp);
                let (least, median) = (times[0], times[times.len() / 2]);
                let line = serde_json::json!({"format": format, "k": k, "m": m, "n": n, "seconds": least,
                    "median_seconds": median, "runs": times.len(), "packing_seconds": packing});
                println!("{line}");
            }
        }
    }
    Ok(())
}
