//! Seconds, operations and memory of each stage: vision encoder, shared prefix, a batch of pixel queries.
//!
//! ```text
//! cargo run --release --example throughput -- --random 3b --queries 64 --suffix-tokens 1 --digits 5
//! cargo run --release --example throughput -- --random 3b --queries 64 --numbers bins
//! ```

mod answers;
mod cost;
mod operations;
mod shapes;

use answers::{Answers, Numbers};
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
    /// Pixel queries; several numbers are asked one after the other.
    #[arg(long, default_value = "64", value_delimiter = ',')]
    queries: Vec<usize>,
    /// Tokens of a query before its answer.
    #[arg(long, default_value_t = 1)]
    suffix_tokens: usize,
    /// How a number is said: as `digits`, a token each, or as one token of `bins`, rows behind the vocabulary; both one after the other.
    #[arg(long, default_value = "digits", value_delimiter = ',')]
    numbers: Vec<Numbers>,
    /// Tokens of an answer in digits.
    #[arg(long, default_value_t = 5)]
    digits: usize,
    /// Number tokens, where numbers are bins.
    #[arg(long, default_value_t = 1000)]
    bins: usize,
    /// Decoder layers of random weights, if not all of the shapes': a model that fits into less memory.
    #[arg(long, requires = "random")]
    layers: Option<usize>,
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
    /// Instead of the stages: milliseconds of what lies between the products of a decoder layer, for `--batch` rows and a prefix of so many
    /// tokens. `SDIM_CUDA_KERNELS=off` leaves out our kernels for CUDA.
    #[arg(long, value_name = "TOKENS")]
    operations: Option<usize>,
    /// One JSON object instead of the table.
    #[arg(long)]
    json: bool,
}

impl Args {
    fn config(&self) -> anyhow::Result<VlmConfig> {
        let (name, mut json): (String, serde_json::Value) = match (&self.model, &self.random) {
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
        if let Some(layers) = self.layers {
            json["num_hidden_layers"] = layers.into();
        }
        Ok(VlmConfig::from_json(&name, &json)?)
    }

    /// The model, with number tokens behind its vocabulary if they are asked for.
    fn load(&self, config: VlmConfig, device: &Device) -> anyhow::Result<QwenVl> {
        let weights = match &self.model {
            Some(dir) => Weights::from_dir(Path::new(dir), device)?,
            None => Weights::made(shapes::random, device),
        };
        let mut model = QwenVl::new(config, &weights.with_format(self.weights), RopeLayout::Contiguous)?;
        if self.numbers.contains(&Numbers::Bins) {
            let made = Weights::made(shapes::random, device).with_format(self.weights);
            model.decoder.add_tokens(&made, "sdim.number_tokens", self.bins)?;
        }
        Ok(model)
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

struct Run<'a> {
    args: &'a Args,
    cost: cost::Cost<'a>,
    model: QwenVl,
    device: Device,
    grid: Grid,
}

/// What is asked of one image, and how long each stage took at best.
struct Measured {
    numbers: Numbers,
    queries: usize,
    /// Passes of the decoder for one answer.
    passes: usize,
    /// Tokens of the shared prefix.
    prompt: usize,
    /// Vision, prefix, queries.
    stages: [Stage; 3],
}

impl Run<'_> {
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

    /// Asks so many times, a batch at once, and reads all answers.
    fn ask(
        &self,
        prefix: &KvCache,
        next: f32,
        answers: &Answers,
        queries: usize,
    ) -> anyhow::Result<Vec<u32>> {
        let (decoder, suffix) = (&self.model.decoder, self.args.suffix_tokens);
        let (mut left, mut read) = (queries, Vec::new());
        while left > 0 {
            let items = left.min(self.args.batch.max(1));
            left -= items;
            let ids: Vec<u32> = (0..items * suffix).map(|i| answers.asking(i)).collect();
            let text = (0..items).flat_map(|_| (0..suffix).map(|i| Position::text(next + i as f32)));
            let after = vec![next + suffix as f32; items];
            let (embedded, text) = (decoder.embed(&ids)?, text.collect::<Vec<_>>());
            let mut sequences = Sequences::prefill(decoder, Some(prefix), &embedded, &text, after)?;
            answers.read(&mut sequences, &mut read)?;
        }
        Ok(read)
    }

    /// All stages, `args.rounds` times.
    fn measure(&self, numbers: Numbers, queries: usize) -> anyhow::Result<Measured> {
        let answers = match numbers {
            Numbers::Digits => Answers::digits(&self.model, self.args.digits, self.args.weights)?,
            Numbers::Bins => Answers::bins(&self.model, self.args.bins, self.args.weights)?,
        };
        let (passes, rows) = (answers.passes(), answers.rows());
        let mut best: Option<([Stage; 3], usize)> = None;
        let patches = self.patches()?;
        let mut first: Option<Vec<u32>> = None;
        for round in 1..=self.args.rounds {
            let (image, vision) = Stage::time(self.cost.vision(), || self.encode(&patches))?;
            let prompt = BEFORE + image.dim(0)? + AFTER;
            let ((cache, next), prefill) = Stage::time(self.cost.prefill(prompt), || self.prefill(&image))?;
            let asked = self.cost.query(prompt, self.args.suffix_tokens, passes, rows) * queries as f64;
            let (found, queries) = Stage::time(asked, || self.ask(&cache, next, &answers, queries))?;
            let first = first.get_or_insert_with(|| found.clone());
            let off = first.iter().zip(&found).filter(|(a, b)| a != b).count();
            if off > 0 {
                bail!("round {round}: {off} of {} answers are not those of the first round", found.len());
            }
            let stages = [vision, prefill, queries];
            best = Some(match best {
                Some((known, _)) => (fastest(known, stages), prompt),
                None => (stages, prompt),
            });
        }
        let Some((stages, prompt)) = best else { bail!("no round") };
        Ok(Measured { numbers, queries, passes, prompt, stages })
    }
}

fn main() -> anyhow::Result<()> {
    let args = Args::parse();
    kernels::keep_freed_memory();
    if [args.suffix_tokens, args.digits, args.bins, args.rounds].contains(&0) || args.queries.contains(&0) {
        bail!("--queries, --suffix-tokens, --digits, --bins and --rounds: at least 1 each");
    }
    let device = device(&args.device)?;
    let config = args.config()?;
    if let Some(prefix) = args.operations {
        for (name, milliseconds) in
            operations::times(&config.text, args.batch.max(1), prefix.max(1), &device)?
        {
            println!("{name:10}  {milliseconds:8.3} ms");
        }
        return Ok(());
    }
    let side = config.vision.patch_size * config.vision.merge_size;
    let cells = |pixels: usize| pixels.div_ceil(side).max(1) * config.vision.merge_size;
    let grid = Grid { height: cells(args.height), width: cells(args.width) };
    let cost = cost::Cost::new(&config, grid);
    let (model, load) = Stage::time(0.0, || args.load(config.clone(), &device))?;
    let run = Run { args: &args, cost, model, device, grid };
    let peak = run.device.is_cpu().then(|| kernels::peak_gflops(args.weights));
    for &numbers in &args.numbers {
        for &queries in &args.queries {
            let measured = run.measure(numbers, queries)?;
            report(&args, &load, &measured, peak, device_memory_bytes(&run.device));
        }
    }
    Ok(())
}

fn fastest(a: [Stage; 3], b: [Stage; 3]) -> [Stage; 3] {
    let ([a0, a1, a2], [b0, b1, b2]) = (a, b);
    [(a0, b0), (a1, b1), (a2, b2)].map(|(a, b)| if a.seconds < b.seconds { a } else { b })
}

fn report(args: &Args, load: &Stage, measured: &Measured, peak: Option<f64>, device_memory: Option<u64>) {
    let Measured { numbers, queries: asked, passes, prompt, stages } = measured;
    let [vision, prefill, queries] = stages;
    let per_second = *asked as f64 / queries.seconds;
    let tokens = args.suffix_tokens + passes - 1;
    let rss = peak_rss_bytes().unwrap_or(0);
    let frame = vision.seconds + prefill.seconds + queries.seconds;
    if args.json {
        let line = json!({
            "load_s": load.seconds, "vision_s": vision.seconds, "prefill_s": prefill.seconds,
            "queries_s": queries.seconds, "queries": asked, "queries_per_second": per_second,
            "numbers": numbers.to_string(), "frame_s": frame,
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
        "{asked} queries in {numbers}: {per_second:.1} queries/s, {:.1} tokens/s ({tokens} tokens per query, {prompt} in the shared prefix)",
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
