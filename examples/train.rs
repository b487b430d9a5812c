//! Trains the tiny checkpoint on rendered scenes.
//!
//! `cargo run --release --example train -- --out DIR [--steps N] [--mix MIX] [--from DIR [--tune] | --resume]`
//!
//! Writes DIR/{config,preprocessor_config,sdim,tokenizer}.json, model.safetensors (what `--model DIR` loads),
//! train.json and trainer.safetensors (the configuration and the state that `--resume` continues from), curve.csv, and
//! DIR/best: the checkpoint that did best on held-out scenes so far. With `--adapter-of BASE` also DIR/adapter, which is loaded on
//! top of BASE.

use anyhow::Context;
use clap::parser::ValueSource;
use clap::{ArgMatches, CommandFactory, FromArgMatches, Parser};
use sdim::internals::scenes::furnished::Library;
use sdim::internals::supervise::{Base, LabelSource, SceneMix, StepReport, TrainConfig, Trainer, evaluate};
use sdim::settings::Settings;
use std::io::Write;
use std::path::{Path, PathBuf};
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
    #[arg(long, default_value = "dense", value_parser = ["dense", "sparse"])]
    labels: String,
    /// Shares of the scenes: procedural, furnished (rooms of the models in --library), streets and glazed (panes of glass, whose
    /// depth is the answer though a sensor sees through them), NAME=SHARE,...
    #[arg(long, default_value_t = TrainConfig::default().batch.mix)]
    mix: SceneMix,
    /// Folder of furniture, as scripts/furniture.sh made it or packed by the example `furniture`; to be told again with --resume.
    #[arg(long, value_name = "DIR")]
    library: Option<PathBuf>,
    /// Sizes of the frames, pixels, one drawn per step: 256x192,192x144
    #[arg(long, value_delimiter = ',', value_parser = size, value_name = "WxH")]
    size: Vec<(usize, usize)>,
    /// Go on from what is known: a short warm-up, sharp targets, statistics of the fusion block as they are.
    #[arg(long, requires = "from")]
    tune: bool,
    /// Go on from this checkpoint, of any shape, instead of a fresh tiny one.
    #[arg(long, value_name = "DIR", conflicts_with = "resume")]
    from: Option<PathBuf>,
    /// Also write DIR/adapter: the tensors that differ from those of this checkpoint, the one of --from, in f32.
    #[arg(long, value_name = "DIR")]
    adapter_of: Option<PathBuf>,
    /// Continue from DIR/train.json and DIR/trainer.safetensors: the schedule, the batches and the seed are those of the
    /// first run, and need not be given again.
    #[arg(long)]
    resume: bool,
    /// Stop after this many steps of the schedule (continue later with --resume).
    #[arg(long)]
    stop_at: Option<usize>,
    /// Steps between log lines.
    #[arg(long, default_value_t = 50, value_parser = at_least_one)]
    log_every: usize,
    /// Steps between checkpoints with an evaluation on held-out scenes.
    #[arg(long, default_value_t = 500, value_parser = at_least_one)]
    save_every: usize,
}

fn at_least_one(text: &str) -> Result<usize, String> {
    text.parse().ok().filter(|&n| n > 0).ok_or_else(|| "expected a number of at least 1".to_string())
}

fn size(text: &str) -> Result<(usize, usize), String> {
    let sides = text.split_once('x').and_then(|(w, h)| Some((w.parse().ok()?, h.parse().ok()?)));
    sides.ok_or_else(|| "expected WIDTHxHEIGHT, such as 256x192".to_string())
}

fn sizes_as_text(sizes: &[(usize, usize)]) -> String {
    sizes.iter().map(|(w, h)| format!("{w}x{h}")).collect::<Vec<_>>().join(",")
}

const HEADER: &str = "step,seconds,loss,l1,gradient,rate,sdim_100,linear_100,sdim_500,linear_500";

/// The rows of curve.csv up to the step that training resumes from, and the seconds spent until there.
fn curve_until(path: &Path, step: usize) -> anyhow::Result<(Vec<String>, f32)> {
    if step == 0 || !path.exists() {
        return Ok((vec![HEADER.to_string()], 0.0));
    }
    let text = std::fs::read_to_string(path).with_context(|| path.display().to_string())?;
    let first = |row: &str, i: usize| row.split(',').nth(i).and_then(|v| v.parse::<f32>().ok());
    let rows: Vec<String> =
        text.lines().filter(|row| first(row, 0).is_none_or(|s| s <= step as f32)).map(String::from).collect();
    let seconds = rows.iter().rev().find_map(|row| first(row, 1)).unwrap_or(0.0);
    Ok((rows, seconds))
}

/// Mean of the model's error over interpolation's in a row with an evaluation.
fn score(row: &str) -> Option<f32> {
    let v: Vec<f32> = row.split(',').filter_map(|v| v.parse().ok()).collect();
    (v.len() == 10).then(|| 0.5 * (v[6] / v[7] + v[8] / v[9]))
}

fn label_name(labels: LabelSource) -> &'static str {
    match labels {
        LabelSource::Dense => "dense",
        LabelSource::Sparse => "sparse",
    }
}

/// The configuration of a new run.
fn config(args: &Args) -> TrainConfig {
    let mut config =
        TrainConfig { steps: args.steps, seed: args.seed, rate: args.rate, ..Default::default() };
    config.batch.frames = args.frames;
    config.batch.questions = args.questions;
    config.batch.labels = match args.labels.as_str() {
        "sparse" => LabelSource::Sparse,
        _ => LabelSource::Dense,
    };
    config.batch.mix = args.mix;
    if !args.size.is_empty() {
        config.batch.sizes.clone_from(&args.size);
    }
    if args.tune { config.tuning() } else { config }
}

/// Refuses a flag that says otherwise than the run that is to be continued.
fn check_flags(args: &Args, given: &ArgMatches, run: &TrainConfig) -> anyhow::Result<()> {
    let values = |c: &TrainConfig| {
        let b = &c.batch;
        [
            ("steps", c.steps.to_string()),
            ("seed", c.seed.to_string()),
            ("rate", c.rate.to_string()),
            ("frames", b.frames.to_string()),
            ("questions", b.questions.to_string()),
            ("labels", label_name(b.labels).to_string()),
            ("mix", b.mix.to_string()),
            ("size", sizes_as_text(&b.sizes)),
        ]
    };
    for ((flag, said), (_, was)) in values(&config(args)).into_iter().zip(values(run)) {
        let told = given.value_source(flag) == Some(ValueSource::CommandLine);
        anyhow::ensure!(
            !told || said == was,
            "--{flag} {said}: the run in {} has {was}; leave the flag out, or start another run",
            args.out.display()
        );
    }
    Ok(())
}

/// Writes the curve so far anew, whole, and gives the file to go on with.
fn open_curve(path: &Path, rows: &[String]) -> anyhow::Result<std::fs::File> {
    let part = path.with_extension("csv.part");
    std::fs::write(&part, rows.join("\n") + "\n").with_context(|| part.display().to_string())?;
    std::fs::rename(&part, path).with_context(|| path.display().to_string())?;
    std::fs::File::options().append(true).open(path).with_context(|| path.display().to_string())
}

/// Relative errors on held-out scenes, as the last columns of a row.
fn held_out(trainer: &Trainer) -> anyhow::Result<String> {
    let model = trainer.averaged_model()?;
    let mut columns = String::new();
    for points in [100, 500] {
        let e = evaluate(&model, 24, points, 1_000_000)?;
        columns += &format!(",{:.5},{:.5}", e.model, e.linear);
    }
    Ok(columns)
}

/// What was reported since the last row of the curve.
#[derive(Default)]
struct Since {
    loss: f32,
    l1: f32,
    steps: usize,
}

impl Since {
    /// Skipped steps have no loss to be counted.
    fn add(&mut self, report: &StepReport) {
        if report.skipped {
            eprintln!("step {} skipped: its loss or gradients are not finite", report.step);
            return;
        }
        self.loss += report.loss;
        self.l1 += report.l1;
        self.steps += 1;
    }

    fn row(&self, report: &StepReport, seconds: f32) -> String {
        let n = self.steps as f32;
        let StepReport { step, gradient, rate, .. } = report;
        format!("{step},{seconds:.1},{:.4},{:.5},{gradient:.3},{rate:.2e}", self.loss / n, self.l1 / n)
    }
}

/// The run that is asked for, and the checkpoint that its adapter is for. All that can be wrong is found before anything is written.
fn begun(args: &Args, given: &ArgMatches) -> anyhow::Result<(Trainer, Option<Base>)> {
    let library = args.library.as_deref().map(Library::open).transpose()?;
    let base = args.adapter_of.as_deref().map(Base::load).transpose()?;
    let mut trainer = match &args.from {
        _ if args.resume => {
            check_flags(args, given, &TrainConfig::load(&args.out)?)?;
            Trainer::resume(&args.out)?
        }
        Some(dir) => Trainer::going_on(config(args), &Base::load(dir)?)?,
        None => Trainer::new(config(args), &Settings::tiny())?,
    };
    if let Some(library) = &library {
        trainer = trainer.with_library(library)?;
    }
    trainer.check_scenes()?;
    if let Some(base) = &base {
        // Refuses another checkpoint than the one that this run went on from.
        trainer.adapter(base)?;
    }
    if !args.resume {
        // At once, so that nothing of a run that was here before is taken for this one's.
        for old in ["best", "adapter"].map(|part| args.out.join(part)).iter().filter(|dir| dir.exists()) {
            std::fs::remove_dir_all(old).with_context(|| old.display().to_string())?;
        }
        trainer.save(&args.out)?;
    }
    Ok((trainer, base))
}

fn main() -> anyhow::Result<()> {
    let given = Args::command().get_matches();
    let args = Args::from_arg_matches(&given).unwrap_or_else(|e| e.exit());
    sdim::internals::kernels::keep_freed_memory();
    let (mut trainer, base) = begun(&args, &given)?;
    let path = args.out.join("curve.csv");
    let (rows, before) = curve_until(&path, trainer.step())?;
    let mut best = rows.iter().filter_map(|r| score(r)).fold(f32::INFINITY, f32::min);
    let mut curve = open_curve(&path, &rows)?;
    let steps = trainer.config().steps;
    eprintln!("{} parameters, step {} of {steps}", trainer.parameter_count(), trainer.step());

    let stop = args.stop_at.unwrap_or(steps).min(steps);
    let (start, mut since) = (Instant::now(), Since::default());
    while trainer.step() < stop {
        let report = trainer.train_step()?;
        since.add(&report);
        let save = report.step % args.save_every == 0 || report.step == stop;
        if report.step % args.log_every != 0 && !save {
            continue;
        }
        let mut row = std::mem::take(&mut since).row(&report, before + start.elapsed().as_secs_f32());
        if save {
            row += &held_out(&trainer)?;
            if let Some(s) = score(&row).filter(|s| *s < best) {
                best = s;
                trainer.publish(&args.out.join("best"))?;
            }
        }
        writeln!(curve, "{row}")?;
        eprintln!("{row}");
        if save {
            if let Some(base) = &base {
                trainer.adapter(base)?.save(&args.out.join("adapter"))?;
            }
            // Last: a run that is interrupted before it does these steps again, and writes the same.
            trainer.save(&args.out)?;
        }
    }
    Ok(())
}
