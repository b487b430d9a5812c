//! Scores a checkpoint and two interpolations on a folder of RGB-D frames.
//!
//! `cargo run --release --example evaluate -- --data DIR [--depth-scale S] [--points N --seed S] [--plan P]`
//!
//! DIR holds rgb/NAME.png, gt/NAME.png or .npy, and perhaps sparse/NAME.png or .npy; where there is no sparse file, N points
//! are drawn from the ground truth. Errors are over ground-truth pixels that were not given as input.
//! `--procedural N` scores on N held-out scenes instead of a folder.

mod common;

use anyhow::Context;
use clap::Parser;
use common::{load, rounded};
use indicatif::ProgressBar;
use sdim::benchmarks::{Dataset, FolderDataset, Sample};
use sdim::depth::metrics::{Errors, mean};
use sdim::scenes::procedural;
use sdim::scenes::score::{METHODS, measurements, score};
use sdim::{CompleteOptions, DepthScale, QueryPlan};
use serde_json::{Map, Value, json};
use std::path::PathBuf;
use std::time::Instant;

#[derive(Parser)]
struct Args {
    /// Folder of frames.
    #[arg(long, required_unless_present = "procedural")]
    data: Option<PathBuf>,
    /// Score on this many held-out procedural scenes of 320x240 instead.
    #[arg(long, conflicts_with = "data")]
    procedural: Option<usize>,
    /// Unit of integer depth files: mm, kitti, tum or units per metre.
    #[arg(long)]
    depth_scale: Option<DepthScale>,
    /// Points drawn from the ground truth where a frame has no sparse file.
    #[arg(long, default_value_t = 500)]
    points: usize,
    /// Seed of the drawn points.
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// Pixels to ask: every, stride:N or budget:N.
    #[arg(long, default_value_t = Default::default())]
    plan: QueryPlan,
    /// Only the first frames.
    #[arg(long)]
    limit: Option<usize>,
    /// `tiny` or a checkpoint directory.
    #[arg(long, default_value = "tiny")]
    model: String,
    /// Adapter directory on top of --model.
    #[arg(long)]
    adapter: Option<PathBuf>,
    /// cpu, cuda:N or metal.
    #[arg(long, default_value = "cpu")]
    device: String,
    /// Write the table as JSON.
    #[arg(long)]
    json: Option<PathBuf>,
    /// Print each frame's errors.
    #[arg(long)]
    verbose: bool,
}

/// Seeds from here on are never drawn in training with the default configuration.
const HELD_OUT: u64 = 2_000_000;

enum Frames {
    Folder(FolderDataset),
    Procedural(usize),
}

impl Frames {
    fn len(&self) -> usize {
        match self {
            Frames::Folder(f) => f.len(),
            Frames::Procedural(n) => *n,
        }
    }

    fn load(&self, index: usize) -> sdim::Result<Sample> {
        match self {
            Frames::Folder(f) => f.load(index),
            Frames::Procedural(_) => {
                let frame = procedural(HELD_OUT + index as u64, 320, 240)?;
                let name = format!("scene-{index}");
                Ok(Sample { name, rgb: frame.rgb, gt: frame.depth, sparse: None, masks: Vec::new() })
            }
        }
    }
}

fn main() -> anyhow::Result<()> {
    let args = Args::parse();
    sdim::kernels::keep_freed_memory();
    let frames = match (&args.data, args.procedural) {
        (Some(dir), _) => Frames::Folder(FolderDataset::open(dir, args.depth_scale)?),
        (None, n) => Frames::Procedural(n.unwrap_or(100)),
    };
    let completer = load(&args.model, args.adapter.as_deref(), &args.device)?;
    if let Some(folder) = args.json.as_ref().and_then(|p| p.parent()).filter(|p| !p.as_os_str().is_empty()) {
        anyhow::ensure!(folder.is_dir(), "--json: there is no folder {}", folder.display());
    }
    let options = CompleteOptions { plan: args.plan, ..Default::default() };
    let count = frames.len().min(args.limit.unwrap_or(usize::MAX));
    let bar = ProgressBar::new(count as u64);
    let (start, mut all) = (Instant::now(), [vec![], vec![], vec![]]);
    for i in 0..count {
        let sample = frames.load(i)?;
        let sparse = measurements(&sample, args.points, args.seed.wrapping_add(i as u64))?;
        let scores = score(&completer, &sample, &sparse, &options)?;
        if args.verbose {
            let maes = scores.map(|e| rounded(e.mae)).join("  ");
            bar.suspend(|| println!("{:30} {maes}", sample.name));
        }
        for (list, errors) in all.iter_mut().zip(scores) {
            list.push(errors);
        }
        bar.inc(1);
    }
    bar.finish_and_clear();
    let seconds = start.elapsed().as_secs_f64();
    report(&args, &all, count, seconds)
}

fn report(args: &Args, all: &[Vec<Errors>; 3], count: usize, seconds: f64) -> anyhow::Result<()> {
    println!("{count} frames, {} points where sampled, {seconds:.1} s", args.points);
    println!("{:10} {:>10} {:>10} {:>10}", "method", "MAE m", "RMSE m", "AbsRel");
    let mut methods = Map::new();
    for (name, errors) in METHODS.iter().zip(all) {
        let Some(e) = mean(errors) else { anyhow::bail!("no frame to score") };
        println!("{name:10} {:>10} {:>10} {:>10}", rounded(e.mae), rounded(e.rmse), rounded(e.abs_rel));
        methods.insert(name.to_string(), json!({"mae": e.mae, "rmse": e.rmse, "abs_rel": e.abs_rel}));
    }
    if let Some(path) = &args.json {
        let object = json!({"frames": count, "methods": Value::Object(methods), "seconds": seconds});
        std::fs::write(path, serde_json::to_string_pretty(&object)?)
            .with_context(|| path.display().to_string())?;
    }
    Ok(())
}
