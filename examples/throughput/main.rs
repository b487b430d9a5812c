//! Seconds, operations and memory of each stage: vision encoder, shared prefix, a batch of pixel queries.
//!
//! ```text
//! cargo run --release --example throughput -- --random 3b --queries 64 --suffix-tokens 1 --digits 5
//! ```

mod cost;
mod shapes;

use anyhow::{Context as _, bail};
use candle_core::{Device, Tensor};
use clap::Parser;
use sdim::WeightFormat;
use sdim::internals::kernels;
use sdim::internals::vlm::checkpoint::weights::Weights;
use sdim::internals::vlm::qwen2_5::QwenVl;
use sdim::internals::vlm::qwen2_5::cache::KvCache;
use sdim::internals::vlm::qwen2_5::config::VlmConfig;
use sdim::internals::vlm::qwen2_5::decoder::Keep;
use sdim::internals::vlm::qwen2_5::grid::Grid;
use sdim::internals::vlm::qwen2_5::positions::positions;
use sdim::internals::vlm::qwen2_5::rope::Position;
use sdim::internals::vlm::qwen2_5::sequences::Sequences;
use sdim::settings::RopeLayout;
use sdim::system::{device, device_memory_bytes, peak_rss_bytes};
use serde_json::json;
use std::path::{Path, PathBuf};
use std::time::Instant;

#[derive(Parser)]
#[command(about = "Times the stages of a model on one image and many pixel queries")]
struct Args {
    /// Checkpoint directory.
    #[arg(long, required_unless_present = "random")]
    model: Option<PathBuf>,
    /// Random weights of the shapes of: 3b, 7b or tiny.
    #[arg(long, conflicts_with = "model")]
    random: Option<String>,
    /// Width of the image as the encoder sees it, pixels; rounded up to whole merged patches.
    #[arg(long, default_value_t = 644)]
    width: usize,
    /// Height of the image as the encoder sees it, pixels; rounded up to whole merged patches.
    #[arg(long, default_value_t = 476)]
    height: usize,
    /// Pixel queries.
    #[arg(long, default_value_t = 64)]
    queries: usize,
    /// Tokens of a query before its answer.
    #[arg(long, default_value_t = 1)]
    suffix_tokens: usize,
    /// Tokens of an answer.
    #[arg(long, default_value_t = 5)]
    digits: usize,
    /// Queries of one batch.
    #[arg(long, default_value_t = 512)]
    batch: usize,
    /// Runs of all stages; the fastest of each is told. The first one of a GPU also loads its kernels.
    #[arg(long, default_value_t = 1)]
    rounds: usize,
    /// How matrices are held: f32, bf16 or int8.
    #[arg(long, default_value = "bf16")]
    weights: WeightFormat,
    /// cpu, cuda:N or metal.
    #[arg(long, default_value = "cpu")]
    device: String,
    /// One JSON object instead of the table.
    #[arg(long)]
    json: bool,
}

impl Args {
    fn config(&self) -> anyhow::Result<VlmConfig> {
        let (name, json) = match (&self.model, &self.random) {
            (Some(dir), _) => {
                let path = dir.join("config.json");
                let text = std::fs::read(&path).with_context(|| path.display().to_string())?;
                (path.display().to_string(), serde_json::from_slice(&text)?)
            }
            (None, Some(name)) => match shapes::config(name) {
                Some(json) => (format!("--random {name}"), json),
                None => bail!("--random {name}: no such model; expected 3b, 7b or tiny"),
            },
            (None, None) => bail!("--model or --random"),
        };
        Ok(VlmConfig::from_json(&name, &json)?)
    }

    fn load(&self, config: VlmConfig, device: &Device) -> anyhow::Result<QwenVl> {
        let weights = match &self.model {
            Some(dir) => Weights::from_dir(Path::new(dir), device)?,
            None => Weights::made(shapes::random, device),
        };
        Ok(QwenVl::new(config, &weights.with_format(self.weights), RopeLayout::Contiguous)?)
    }
}

/// Seconds and operations of a stage.
struct Stage {
    seconds: f64,
    operations: f64,
}

impl Stage {
    fn time<R>(operations: f64, run: impl FnOnce() -> anyhow::Result<R>) -> anyhow::Result<(R, Self)> {
        let start = Instant::now();
        let out = run()?;
        Ok((out, Self { seconds: start.elapsed().as_secs_f64(), operations }))
    }

    fn gflops(&self) -> f64 {
        self.operations / self.seconds.max(1e-9) * 1e-9
    }
}

/// Words around the image of a prompt, tokens.
const BEFORE: usize = 15;
const AFTER: usize = 5;

struct Run {
    model: QwenVl,
    device: Device,
    grid: Grid,
}

impl Run {
    fn patches(&self) -> anyhow::Result<Tensor> {
        let shape = (self.grid.patches(), self.model.config.vision.patch_len());
        Ok(Tensor::randn(0f32, 1.0, shape, &self.device)?)
    }

    fn encode(&self, patches: &Tensor) -> anyhow::Result<Tensor> {
        let tokens = self.model.encode(patches, &[self.grid])?;
        self.device.synchronize()?;
        Ok(tokens)
    }

    fn prefill(&self, image: &Tensor) -> anyhow::Result<(KvCache, f32)> {
        let mut ids = vec![11u32; BEFORE];
        ids.extend(std::iter::repeat_n(self.model.config.ids.image, image.dim(0)?));
        ids.extend([12u32; AFTER]);
        let walked = positions(&ids, &[self.grid], &self.model.config, 1.0)?;
        let embedded = self.model.embed_prompt(&ids, image)?;
        let mut cache = self.model.decoder.cache(1);
        self.model.prefill(&embedded, &walked.positions, &mut cache, Keep::Nothing)?;
        self.device.synchronize()?;
        Ok((cache, walked.next))
    }

    /// Asks `args.queries` times, `args.batch` at once, and reads `args.digits` tokens greedily: all of them, step after step.
    fn ask(&self, prefix: &KvCache, next: f32, args: &Args) -> anyhow::Result<Vec<u32>> {
        let decoder = &self.model.decoder;
        let number_ids: Vec<u32> = (13..24).collect();
        let rows = decoder.head_rows(&number_ids)?;
        let (mut left, mut read) = (args.queries, Vec::new());
        while left > 0 {
            let items = left.min(args.batch.max(1));
            left -= items;
            let mut ids: Vec<u32> = (0..items * args.suffix_tokens).map(|i| 11 + (i % 13) as u32).collect();
            let text =
                (0..items).flat_map(|_| (0..args.suffix_tokens).map(|i| Position::text(next + i as f32)));
            let after = vec![next + args.suffix_tokens as f32; items];
            let (embedded, text) = (decoder.embed(&ids)?, text.collect::<Vec<_>>());
            let mut sequences = Sequences::prefill(decoder, Some(prefix), &embedded, &text, after)?;
            for digit in 0..args.digits {
                if digit > 0 {
                    sequences.decode_step(&ids)?;
                }
                let logits = kernels::linear(sequences.last(), &rows, None)?;
                let best = logits.argmax(1)?.to_vec1::<u32>()?;
                ids = best.into_iter().map(|i| number_ids[i as usize]).collect();
                read.extend_from_slice(&ids);
            }
        }
        Ok(read)
    }
}

fn main() -> anyhow::Result<()> {
    let args = Args::parse();
    kernels::keep_freed_memory();
    if [args.suffix_tokens, args.digits, args.queries, args.rounds].contains(&0) {
        bail!("--queries, --suffix-tokens, --digits and --rounds: at least 1 each");
    }
    let device = device(&args.device)?;
    let config = args.config()?;
    let side = config.vision.patch_size * config.vision.merge_size;
    let cells = |pixels: usize| pixels.div_ceil(side).max(1) * config.vision.merge_size;
    let grid = Grid { height: cells(args.height), width: cells(args.width) };
    let cost = cost::Cost::new(&config, grid);
    let (model, load) = Stage::time(0.0, || args.load(config.clone(), &device))?;
    let run = Run { model, device, grid };
    let mut best: Option<([Stage; 3], usize)> = None;
    let patches = run.patches()?;
    let mut answers: Option<Vec<u32>> = None;
    for round in 1..=args.rounds {
        let (image, vision) = Stage::time(cost.vision(), || run.encode(&patches))?;
        let prompt = BEFORE + image.dim(0)? + AFTER;
        let ((cache, next), prefill) = Stage::time(cost.prefill(prompt), || run.prefill(&image))?;
        let asked = cost.query(prompt, args.suffix_tokens, args.digits) * args.queries as f64;
        let (found, queries) = Stage::time(asked, || run.ask(&cache, next, &args))?;
        let first = answers.get_or_insert_with(|| found.clone());
        let off = first.iter().zip(&found).filter(|(a, b)| a != b).count();
        if off > 0 {
            bail!("round {round}: {off} of {} answered tokens are not those of the first round", found.len());
        }
        let stages = [vision, prefill, queries];
        best = Some(match best {
            Some((known, _)) => (fastest(known, stages), prompt),
            None => (stages, prompt),
        });
    }
    let Some((stages, prompt)) = best else { bail!("no round") };
    let peak = run.device.is_cpu().then(|| kernels::peak_gflops(args.weights));
    report(&args, &load, &stages, peak, prompt, device_memory_bytes(&run.device));
    Ok(())
}

fn fastest(a: [Stage; 3], b: [Stage; 3]) -> [Stage; 3] {
    let ([a0, a1, a2], [b0, b1, b2]) = (a, b);
    [(a0, b0), (a1, b1), (a2, b2)].map(|(a, b)| if a.seconds < b.seconds { a } else { b })
}

fn report(
    args: &Args,
    load: &Stage,
    stages: &[Stage; 3],
    peak: Option<f64>,
    prompt: usize,
    device_memory: Option<u64>,
) {
    let [vision, prefill, queries] = stages;
    let per_second = args.queries as f64 / queries.seconds;
    let tokens = args.suffix_tokens + args.digits - 1;
    let rss = peak_rss_bytes().unwrap_or(0);
    if args.json {
        let line = json!({
            "load_s": load.seconds, "vision_s": vision.seconds, "prefill_s": prefill.seconds,
            "queries_s": queries.seconds, "queries": args.queries, "queries_per_second": per_second,
            "tokens_per_query": tokens, "tokens_per_second": per_second * tokens as f64,
            "prompt_tokens": prompt, "gflops": queries.gflops(), "vision_gflops": vision.gflops(),
            "prefill_gflops": prefill.gflops(), "peak_gflops": peak, "peak_rss_bytes": rss,
            "device_memory_bytes": device_memory,
        });
        println!("{line}");
        return;
    }
    println!("stage     seconds  GFLOP/s  of peak");
    for (name, stage) in [("vision", vision), ("prefill", prefill), ("queries", queries)] {
        let share = peak.map_or("-".into(), |peak| format!("{:.0}%", stage.gflops() / peak * 100.0));
        println!("{name:9} {:7.3} {:8.0} {share:>8}", stage.seconds, stage.gflops());
    }
    println!(
        "{per_second:.1} queries/s, {:.1} tokens/s ({tokens} tokens per query, {prompt} in the shared prefix)",
        per_second * tokens as f64
    );
    let memory = |bytes: u64| format!("{:.2} GB", bytes as f64 * 1e-9);
    println!(
        "loaded in {:.1} s; peak memory {}{}{}",
        load.seconds,
        memory(rss),
        device_memory.map_or(String::new(), |held| format!("; {} held on the device", memory(held))),
        peak.map_or(String::new(), |peak| format!("; registers alone reach {peak:.0} GFLOP/s"))
    );
}
