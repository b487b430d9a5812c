//! Whether deadlines are kept: the bundled frame, 640x480, completed again and again until each of some deadlines.
//!
//! `cargo run --release --example deadlines` takes the checkpoint inside the crate, `--model DIR` another one, and `--random 3b --times 30000` random
//! weights of a published model's shapes, asked in the way of the one inside the crate. Each deadline begins with a model that has seen no frame.

#[path = "../common/mod.rs"]
mod common;
#[path = "../throughput/shapes.rs"]
mod shapes;

use anyhow::{Context, ensure};
use clap::Parser;
use common::{bundled, load_as, load_options, rounded, stdout};
use sdim::internals::model::{CheckpointFiles, SdimModel};
use sdim::internals::vlm::checkpoint::weights::Weights;
use sdim::{
    CompleteOptions, DepthCompleter, DepthScale, LoadOptions, QueryPlan, SparseDepth, metrics, read_rgb,
};
use serde_json::{Value, json};
use std::path::Path;
use std::time::{Duration, Instant};

#[derive(Parser)]
#[command(about = "Measures how deadlines are kept")]
struct Args {
    /// `tiny` (inside the crate) or a checkpoint directory.
    #[arg(long, default_value = "tiny")]
    model: String,
    /// Random weights of the shapes of 3b or 7b instead.
    #[arg(long, conflicts_with = "model")]
    random: Option<String>,
    /// Measurements that random weights are told, each of which is a token of the shared prefix.
    #[arg(long, default_value_t = 64)]
    told: usize,
    /// Deadlines, milliseconds.
    #[arg(long, default_value = "50,100,200,500", value_delimiter = ',')]
    times: Vec<u64>,
    /// Frames by each deadline.
    #[arg(long, default_value_t = 30)]
    frames: usize,
    /// cpu, cuda:N or metal.
    #[arg(long, default_value = "cpu")]
    device: String,
    /// One JSON object instead of the table.
    #[arg(long)]
    json: bool,
}

impl Args {
    fn load(&self) -> anyhow::Result<DepthCompleter> {
        let options = load_options(&self.device, None, None)?;
        match &self.random {
            Some(name) => Ok(DepthCompleter::new(random(name, self.told, &options)?)),
            None => load_as(&self.model, &options),
        }
    }
}

/// Random weights of a published model's layers, with the vocabulary and the questions of the checkpoint inside the crate.
fn random(name: &str, told: usize, options: &LoadOptions) -> anyhow::Result<SdimModel> {
    let own = Path::new(env!("CARGO_MANIFEST_DIR")).join("assets/sdim-tiny");
    let read = |file: &str| -> anyhow::Result<Vec<u8>> {
        let path = own.join(file);
        std::fs::read(&path).with_context(|| path.display().to_string())
    };
    let object = |file: &str| -> anyhow::Result<Value> { Ok(serde_json::from_slice(&read(file)?)?) };
    let mut config = shapes::config(name).with_context(|| format!("--random {name}: expected 3b or 7b"))?;
    for (key, value) in object("config.json")?.as_object().into_iter().flatten() {
        if key == "vocab_size" || key.ends_with("_token_id") {
            config[key] = value.clone();
        }
    }
    let mut preprocessor = object("preprocessor_config.json")?;
    for key in ["patch_size", "temporal_patch_size"] {
        preprocessor[key] = config["vision_config"][key].clone();
    }
    (preprocessor["min_pixels"], preprocessor["max_pixels"]) = (3136.into(), 12_845_056.into());
    let mut settings = object("sdim.json")?;
    settings["measurements"]["max"] = told.into();
    let [config, preprocessor, settings] = [config, preprocessor, settings].map(|v| v.to_string());
    let files = CheckpointFiles::from_bytes(
        name,
        config.as_bytes(),
        preprocessor.as_bytes(),
        settings.as_bytes(),
        &read("tokenizer.json")?,
    )?;
    let weights = Weights::made(shapes::random, &options.device).with_format(options.weights);
    Ok(SdimModel::new(files, &weights, &options.device)?.fold()?)
}

/// What is seen of one deadline.
struct Kept {
    time: u64,
    /// Milliseconds, in the order of the frames.
    took: Vec<f64>,
    asked: Vec<usize>,
    errors: Vec<f64>,
}

impl Kept {
    fn measure(args: &Args, time: u64) -> anyhow::Result<Self> {
        let depth = |file: &str| SparseDepth::read(bundled(file), Some(DepthScale::millimetres()));
        let (rgb, sparse, gt) = (read_rgb(bundled("rgb.png"))?, depth("sparse.png")?, depth("gt.png")?);
        let plan = QueryPlan::Deadline(Duration::from_millis(time));
        let options = CompleteOptions::default().with_plan(plan);
        let completer = args.load()?;
        let mut kept = Self { time, took: Vec::new(), asked: Vec::new(), errors: Vec::new() };
        for _ in 0..args.frames {
            let start = Instant::now();
            let done = completer.complete_detailed(&rgb, &sparse, &options)?;
            kept.took.push(1e3 * start.elapsed().as_secs_f64());
            kept.asked.push(done.asked);
            ensure!(done.map.valid() == rgb.width() as usize * rgb.height() as usize, "a map with holes");
            kept.errors
                .push(f64::from(metrics::errors(done.map.depth(), gt.as_slice(), &sparse)?.mae as f32));
        }
        Ok(kept)
    }

    /// Frames that took more than 1.1 of the deadline.
    fn late(&self) -> usize {
        self.took.iter().filter(|&&t| t > 1.1 * self.time as f64).count()
    }

    /// Frames without a question.
    fn silent(&self) -> usize {
        self.asked.iter().filter(|&&n| n == 0).count()
    }

    fn middle(values: &[f64]) -> f64 {
        let mut sorted = values.to_vec();
        sorted.sort_by(f64::total_cmp);
        sorted.get(sorted.len() / 2).copied().unwrap_or(f64::NAN)
    }

    fn json(&self) -> Value {
        json!({
            "deadline_ms": self.time, "took_ms": self.took, "asked": self.asked, "mae": self.errors,
            "over_1.1": self.late(), "without_questions": self.silent(),
        })
    }

    fn line(&self) -> String {
        let asked: Vec<f64> = self.asked.iter().map(|&n| n as f64).collect();
        let slowest = self.took.iter().copied().fold(0.0, f64::max);
        format!(
            "{:7} {:9.1} {:9.1} {:10.1} {:9} {:11.0} {:9} {:>9}",
            self.time,
            self.took.first().copied().unwrap_or(f64::NAN),
            Self::middle(&self.took),
            slowest,
            format!("{}/{}", self.late(), self.took.len()),
            Self::middle(&asked),
            self.silent(),
            rounded(Self::middle(&self.errors))
        )
    }
}

fn main() -> anyhow::Result<()> {
    let args = Args::parse();
    sdim::internals::kernels::keep_freed_memory();
    ensure!(args.frames > 0 && !args.times.contains(&0), "--frames and --times: at least 1 each");
    let all: Vec<Kept> =
        args.times.iter().map(|&time| Kept::measure(&args, time)).collect::<anyhow::Result<_>>()?;
    let text = match args.json {
        true => Value::from(all.iter().map(Kept::json).collect::<Vec<_>>()).to_string(),
        false => {
            let head = "deadline  first ms median ms slowest ms over 1.1x   questions    silent     MAE m";
            std::iter::once(head.to_string()).chain(all.iter().map(Kept::line)).collect::<Vec<_>>().join("\n")
        }
    };
    stdout::print(&text)?;
    Ok(())
}
