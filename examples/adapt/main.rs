//! Adapts a small checkpoint to a user's own camera, from pictures and sparse depth alone.
//!
//! `cargo run --release --example adapt -- --data FOLDER --out DIR [--model tiny|DIR] [--depth-scale mm] [--minutes N]`
//!
//! FOLDER holds `rgb/NAME.png` with `sparse/NAME.npy` or `.png` (the layout `folder` of `evaluate`; ground truth is not looked at).
//! In each step some measurements of a frame are told and others are asked. One frame in five is never trained on: what is held
//! back there says when to stop and whether anything was won. Only then is DIR written, an adapter for `complete --adapter DIR` and
//! [`sdim::LoadOptions::with_adapter`]. The same seed and number of steps give the same adapter.

#[path = "../common/mod.rs"]
mod common;
mod held_out;

use anyhow::{Context, ensure};
use clap::Parser;
use common::stdout::print;
use held_out::{Gain, HeldOut};
use indicatif::{ProgressBar, ProgressStyle};
use sdim::internals::supervise::{Adaptation, Base, OwnFrames, StepReport};
use sdim::{Adapter, DepthCompleter, DepthScale, LoadOptions, WeightFormat};
use serde_json::json;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

/// Adapts a small checkpoint to a camera of one's own: frames of RGB and sparse depth in, an adapter directory out.
#[derive(Parser)]
struct Args {
    /// Folder of frames: rgb/NAME.png with sparse/NAME.npy or .png.
    #[arg(long)]
    data: PathBuf,
    /// Unit of integer depth files: mm, kitti, tum or units per metre.
    #[arg(long)]
    depth_scale: Option<DepthScale>,
    /// What is adapted: `tiny` or the directory of a small checkpoint.
    #[arg(long, default_value = "tiny")]
    model: String,
    /// Directory of the adapter; it must not exist yet.
    #[arg(long)]
    out: PathBuf,
    /// Steps, at most.
    #[arg(long, default_value_t = 400)]
    steps: usize,
    /// Minutes, at most; a run that they end depends on how fast the machine is.
    #[arg(long, default_value_t = 10.0)]
    minutes: f32,
    /// Peak learning rate.
    #[arg(long, default_value_t = 5e-4)]
    rate: f32,
    /// Frames per step.
    #[arg(long, default_value_t = Adaptation::config(1, 0).batch.frames)]
    frames: usize,
    /// Questions per frame.
    #[arg(long, default_value_t = Adaptation::config(1, 0).batch.questions)]
    questions: usize,
    /// Steps between looks at the frames that are not trained on.
    #[arg(long, default_value_t = 40)]
    check_every: usize,
    /// Looks without a better one that end the run.
    #[arg(long, default_value_t = 3)]
    patience: usize,
    /// Seed of all that is drawn.
    #[arg(long, default_value_t = 7)]
    seed: u64,
    /// Print the result as one JSON object.
    #[arg(long)]
    json: bool,
}

/// One frame in so many is never trained on.
const HELD_OUT: usize = 5;

/// What a run came to.
struct Outcome {
    /// The best there was, where it is better than the start.
    best: Option<Best>,
    /// Steps done.
    steps: usize,
    /// Why it ended.
    ended: &'static str,
}

struct Best {
    gain: Gain,
    step: usize,
    adapter: Adapter,
}

fn main() -> anyhow::Result<()> {
    let args = Args::parse();
    sdim::internals::kernels::keep_freed_memory();
    ensure!(!args.out.exists(), "--out {}: is there already", args.out.display());
    ensure!(args.check_every > 0, "--check-every 0: expected at least 1");
    let start = Instant::now();
    let own = OwnFrames::read(&args.data, args.depth_scale)?;
    for name in &own.left_out {
        eprintln!("{name}: left out, fewer than {} measurements", OwnFrames::FEWEST);
    }
    let count = own.frames.len();
    ensure!(count >= HELD_OUT, "{}: {count} frames; expected at least {HELD_OUT}", args.data.display());
    let (held, trained) = held_out::part(own.frames, HELD_OUT, args.seed);
    let base = match args.model.as_str() {
        "tiny" => Base::tiny()?,
        dir => Base::load(Path::new(dir))?,
    };
    let mut config = Adaptation::config(args.steps, args.seed);
    (config.rate, config.batch.frames, config.batch.questions) = (args.rate, args.frames, args.questions);
    let mut run = Adaptation::new(config, base, &trained)?;
    let held = HeldOut::new(held, &loaded(&args.model, None)?, args.seed)?;
    eprintln!(
        "{} frames to learn from, {} to check with; error there at the start {:.4} m",
        trained.len(),
        held.len(),
        held.error_before()
    );
    let outcome = adapt(&args, &mut run, &held, start)?;
    if let Some(best) = &outcome.best {
        write(best, &args.out)?;
    }
    report(&args, &outcome, &held, start.elapsed())
}

/// A checkpoint as it is checked: in f32, in which it is trained.
fn loaded(model: &str, adapter: Option<&Path>) -> anyhow::Result<DepthCompleter> {
    let mut options = LoadOptions::default();
    (options.weights, options.adapter) = (WeightFormat::F32, adapter.map(Path::to_path_buf));
    common::load_as(model, &options)
}

/// Trains until the steps or the minutes are over, or nothing better comes.
fn adapt(args: &Args, run: &mut Adaptation, held: &HeldOut, start: Instant) -> anyhow::Result<Outcome> {
    // More than a week is for ever; a duration cannot hold all numbers.
    let limit = Duration::try_from_secs_f32((60.0 * args.minutes).clamp(0.0, 6e5)).unwrap_or_default();
    let style = "{wide_bar} step {pos}/{len} {elapsed} {msg}";
    let bar = ProgressBar::new(args.steps as u64).with_style(ProgressStyle::with_template(style)?);
    let (mut best, mut worse, mut since): (Option<Best>, usize, Vec<StepReport>) = (None, 0, Vec::new());
    let mut lowest = f64::INFINITY;
    let mut steps = 0;
    let ended = loop {
        let late = start.elapsed() >= limit;
        let check = steps > 0 && (steps % args.check_every == 0 || steps == args.steps || late);
        if check && !since.is_empty() {
            let gain = held.gain(&DepthCompleter::new(run.model()?))?;
            let loss = since.iter().map(|r| r.loss).sum::<f32>() / since.len() as f32;
            since.clear();
            bar.suspend(|| eprintln!("step {steps}: loss {loss:.4}, {gain}"));
            worse += 1;
            if gain.ratio < lowest {
                (lowest, worse) = (gain.ratio, 0);
                if gain.is_better() {
                    best = Some(Best { gain, step: steps, adapter: run.adapter()? });
                }
            }
        }
        if steps == args.steps {
            break "all steps are done";
        }
        if late {
            break "the minutes are over";
        }
        if worse >= args.patience {
            break "nothing better came";
        }
        let report = match run.step() {
            Err(sdim::Error::Diverged { .. }) => break "it diverged",
            report => report?,
        };
        steps += 1;
        bar.inc(1);
        if !report.skipped {
            since.push(report);
        }
    };
    bar.finish_and_clear();
    Ok(Outcome { best, steps, ended })
}

/// Writes the adapter beside its place and moves it there once it is whole.
fn write(best: &Best, out: &Path) -> anyhow::Result<()> {
    let name = out.file_name().with_context(|| format!("--out {}: expected a name", out.display()))?;
    let part = out.with_file_name(format!("{}.part", name.to_string_lossy()));
    best.adapter.save(&part)?;
    std::fs::rename(&part, out).with_context(|| out.display().to_string())
}

fn report(args: &Args, outcome: &Outcome, held: &HeldOut, took: Duration) -> anyhow::Result<()> {
    let (before, seconds) = (held.error_before(), took.as_secs_f64());
    if args.json {
        let best = outcome.best.as_ref();
        let found = json!({
            "written": best.map(|_| args.out.display().to_string()),
            "step": best.map(|b| b.step),
            "steps": outcome.steps,
            "ended": outcome.ended,
            "held_out_frames": held.len(),
            "mae_before": before,
            "mae_after": best.map(|b| b.gain.error),
            "ratio": best.map(|b| b.gain.ratio),
            "seconds": seconds,
        });
        return Ok(print(&found.to_string())?);
    }
    let Outcome { steps, ended, .. } = outcome;
    let told = match &outcome.best {
        Some(Best { gain, step, .. }) => format!(
            "{}: the adapter of step {step} of {steps} ({ended}), {gain}, {seconds:.0} s",
            args.out.display()
        ),
        None => {
            format!("nothing written: after {steps} steps ({ended}) no better than before, {seconds:.0} s")
        }
    };
    Ok(print(&told)?)
}
