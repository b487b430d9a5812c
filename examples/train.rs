//! Trains the tiny checkpoint on procedural scenes.
//!
//! `cargo run --release --example train -- --out DIR [--steps N] [--resume]`
//!
//! Writes DIR/{config,preprocessor_config,sdim,tokenizer}.json, model.safetensors (what `--model DIR` loads),
//! trainer.safetensors (what `--resume` continues from), train.json (the configuration) and curve.csv.

use anyhow::Context;
use clap::Parser;
use sdim::query::Settings;
use sdim::supervise::{LabelSource, TrainConfig, Trainer, evaluate};
use std::io::Write;
use std::path::PathBuf;
use std::time::Instant;

#[derive(Parser)]
struct Args {
    /// Checkpoint directory.
    #[arg(long)]
    out: PathBuf,
    /// Steps of the schedule.
    #[arg(long, default_value_t = TrainConfig::default().steps)]
    steps: usize,
    /// Seed of weights and scenes.
    #[arg(long, default_value_t = TrainConfig::default().seed)]
    seed: u64,
    /// Peak learning rate.
    #[arg(long, default_value_t = TrainConfig::default().rate)]
    rate: f32,
    /// Frames per step.
    #[arg(long, default_value_t = TrainConfig::default().batch.frames)]
    frames: usize,
    /// Questions per frame.
    #[arg(long, default_value_t = TrainConfig::default().batch.questions)]
    questions: usize,
    /// Labels: `dense` ground truth, or `sparse` measurements held back from the prompt.
    #[arg(long, default_value = "dense")]
    labels: String,
    /// Continue from DIR/trainer.safetensors.
    #[arg(long)]
    resume: bool,
    /// Stop after this many steps of the schedule (continue later with --resume).
    #[arg(long)]
    stop_at: Option<usize>,
    /// Steps between log lines.
    #[arg(long, default_value_t = 50)]
    log_every: usize,
    /// Steps between checkpoints with an evaluation on held-out scenes.
    #[arg(long, default_value_t = 500)]
    save_every: usize,
}

fn main() -> anyhow::Result<()> {
    let args = Args::parse();
    sdim::kernels::keep_freed_memory();
    let mut config =
        TrainConfig { steps: args.steps, seed: args.seed, rate: args.rate, ..Default::default() };
    config.batch.frames = args.frames;
    config.batch.questions = args.questions;
    config.batch.labels = match args.labels.as_str() {
        "dense" => LabelSource::Dense,
        "sparse" => LabelSource::Sparse,
        other => anyhow::bail!("--labels {other}: expected dense or sparse"),
    };
    std::fs::create_dir_all(&args.out)?;
    let mut trainer = Trainer::new(config.clone(), &Settings::tiny())?;
    if args.resume {
        trainer.resume(&args.out)?;
    }
    std::fs::write(args.out.join("train.json"), serde_json::to_string_pretty(&config)?)?;
    let path = args.out.join("curve.csv");
    let mut curve = std::fs::OpenOptions::new().create(true).append(true).open(&path).context("curve.csv")?;
    if curve.metadata()?.len() == 0 {
        writeln!(curve, "step,seconds,loss,l1,gradient,rate,sdim_100,linear_100,sdim_500,linear_500")?;
    }
    eprintln!("{} parameters, step {} of {}", trainer.parameter_count(), trainer.step(), config.steps);
    let stop = args.stop_at.unwrap_or(config.steps).min(config.steps);
    let (start, mut loss, mut l1, mut seen) = (Instant::now(), 0.0, 0.0, 0);
    while trainer.step() < stop {
        let report = trainer.train_step()?;
        loss += report.loss;
        l1 += report.l1;
        seen += 1;
        let save = report.step % args.save_every == 0 || report.step == stop;
        if report.step % args.log_every == 0 || save {
            let n = seen as f32;
            let mut line = format!(
                "{},{:.1},{:.4},{:.5},{:.3},{:.2e}",
                report.step,
                start.elapsed().as_secs_f32(),
                loss / n,
                l1 / n,
                report.gradient,
                report.rate
            );
            (loss, l1, seen) = (0.0, 0.0, 0);
            if save {
                trainer.save(&args.out)?;
                let model = trainer.averaged_model()?;
                for points in [100, 500] {
                    let e = evaluate(&model, 24, points, 1_000_000)?;
                    line += &format!(",{:.5},{:.5}", e.model, e.linear);
                }
            }
            writeln!(curve, "{line}")?;
            eprintln!("{line}");
        }
    }
    Ok(())
}
