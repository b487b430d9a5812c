//! Writes training records: frames with measurements, questions and answers, for a trainer on a GPU (`training/`).
//!
//! ```sh
//! records --fresh fresh --shape small                                   # a checkpoint to start from
//! records --shape small --size 384x288 --prompt 512 --count 60000 --seconds 300 --out train
//! records --shape small --size 384x288 --prompt 512 --count 256 --held-out 100 --out held/100
//! records --mix procedural=0.5,furnished=0.35,streets=0.15 --library furniture --out mixed
//! ```
//!
//! A set is a folder of shards (`src/supervise/shard.rs`) and `records.json`, which says how it was drawn. The same
//! arguments give the same bytes whatever the number of cores; a run that was stopped goes on where it was. Scenes of
//! training, of held-out records and of the crate's own evaluations have seeds of three ranges
//! ([`sdim::internals::supervise::training_seed`]).

use anyhow::{Context, bail, ensure};
use clap::Parser;
use indicatif::{ProgressBar, ProgressStyle};
use sdim::internals::query::PromptWriter;
use sdim::internals::scenes::furnished::Library;
use sdim::internals::supervise::{
    Asking, BatchConfig, FreshFiles, RecordConfig, RecordSet, SceneMix, Scenes, Shape,
};
use sdim::settings::Settings;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

/// Writes training records, and the checkpoint that training starts from.
#[derive(Parser)]
struct Args {
    /// Sizes of the model: tiny, small, or a JSON file of them.
    #[arg(long, default_value = "tiny")]
    shape: String,
    /// `sdim.json` of another way of asking than the shape's own.
    #[arg(long)]
    settings: Option<PathBuf>,
    /// Write a checkpoint with initial weights here.
    #[arg(long, required_unless_present = "out")]
    fresh: Option<PathBuf>,
    /// Folder of the records.
    #[arg(long)]
    out: Option<PathBuf>,
    /// Frames, rounded up to whole shards.
    #[arg(long, default_value_t = 1024)]
    count: u64,
    /// Start no shard after so many seconds.
    #[arg(long)]
    seconds: Option<u64>,
    /// Stop when the records take so many gigabytes.
    #[arg(long, default_value_t = 20.0)]
    max_gb: f64,
    /// Frames per shard.
    #[arg(long, default_value_t = 64)]
    shard: usize,
    /// Size of the frames, WIDTHxHEIGHT; several: one is drawn per shard.
    #[arg(long = "size", value_delimiter = ',', value_parser = size, default_value = "256x192")]
    sizes: Vec<(usize, usize)>,
    /// Sets of measurements and questions per frame.
    #[arg(long, default_value_t = 4)]
    variants: usize,
    /// Measurements in a prompt, at most.
    #[arg(long, default_value_t = BatchConfig::default().prompt_points)]
    prompt: usize,
    /// Questions per variant.
    #[arg(long, default_value_t = BatchConfig::default().questions)]
    questions: usize,
    /// Fewest and most measurements of a frame: FEWEST,MOST. Blocks, rings and holes have their own numbers.
    #[arg(long, value_delimiter = ',', num_args = 1, default_value = "40,1500")]
    points: Vec<usize>,
    /// Which scenes: shares of procedural, furnished and streets, NAME=SHARE,...; procedural alone without it.
    #[arg(long)]
    mix: Option<SceneMix>,
    /// Folder of furniture for furnished rooms, as it was installed or packed. Held-out records have models of their own.
    #[arg(long)]
    library: Option<PathBuf>,
    /// Scenes that are never trained on, with exactly so many uniform measurements.
    #[arg(long, value_name = "POINTS")]
    held_out: Option<usize>,
    /// Held-out records ask every N-th column and row, for pictures.
    #[arg(long, value_name = "N", requires = "held_out")]
    grid: Option<usize>,
    /// Seed of the records and of initial weights.
    #[arg(long, default_value_t = 7)]
    seed: u64,
    /// Threads; all cores without it.
    #[arg(long)]
    threads: Option<usize>,
}

fn size(text: &str) -> Result<(usize, usize), String> {
    let sides = text.split_once('x').and_then(|(w, h)| Some((w.parse().ok()?, h.parse().ok()?)));
    sides.ok_or_else(|| "expected WIDTHxHEIGHT".to_string())
}

fn main() -> anyhow::Result<()> {
    let args = Args::parse();
    if let Some(threads) = args.threads {
        rayon::ThreadPoolBuilder::new().num_threads(threads).build_global()?;
    }
    let shape = match Shape::named(&args.shape) {
        Some(shape) => shape,
        None => {
            let text = std::fs::read_to_string(&args.shape).with_context(|| {
                format!("--shape {}: neither {} nor a file", args.shape, Shape::NAMES.join(", "))
            })?;
            serde_json::from_str(&text).with_context(|| args.shape.clone())?
        }
    };
    let settings = match &args.settings {
        Some(path) => Settings::from_file(path)?,
        None => shape.settings(),
    };
    let files = FreshFiles::of(&shape, &settings)?;
    if let Some(dir) = &args.fresh {
        files.write_initial(dir, args.seed)?;
        eprintln!("{}: initial weights of seed {}", dir.display(), args.seed);
    }
    match &args.out {
        Some(out) => write(&args, &files, out),
        None => Ok(()),
    }
}

fn config(args: &Args) -> anyhow::Result<RecordConfig> {
    let &[fewest, most] = &args.points[..] else { bail!("--points: expected FEWEST,MOST") };
    let batch = BatchConfig {
        frames: args.shard,
        questions: args.questions,
        prompt_points: args.prompt,
        points: (fewest, most),
        sizes: args.sizes.clone(),
        mix: args.mix.unwrap_or_default(),
        ..Default::default()
    };
    let set = match args.held_out {
        None => RecordSet::Train,
        Some(points) => RecordSet::HeldOut { points, grid: args.grid },
    };
    // Held-out scenes are the same for any seed of training's.
    let (seed, variants) = if args.held_out.is_some() { (0, 1) } else { (args.seed, args.variants) };
    Ok(RecordConfig { batch, variants, seed, set })
}

fn scenes(args: &Args, config: &RecordConfig) -> anyhow::Result<Scenes> {
    let mut scenes = Scenes::new(config.batch.mix);
    if let Some(dir) = args.library.as_ref().filter(|_| config.batch.mix.furnished > 0.0) {
        scenes = scenes.with_library(&Library::open(dir)?, config.held_out())?;
    }
    scenes.check(config.held_out()).context("--mix")?;
    Ok(scenes)
}

/// Refuses a folder that holds other records.
fn claim(out: &Path, config: &RecordConfig) -> anyhow::Result<()> {
    let path = out.join("records.json");
    std::fs::create_dir_all(out).with_context(|| out.display().to_string())?;
    if path.exists() {
        let text = std::fs::read_to_string(&path).with_context(|| path.display().to_string())?;
        let found: RecordConfig = serde_json::from_str(&text).with_context(|| path.display().to_string())?;
        ensure!(found == *config, "{}: other records are there; expected {config:?}", path.display());
        return Ok(());
    }
    std::fs::write(&path, serde_json::to_string_pretty(config)?).with_context(|| path.display().to_string())
}

fn write(args: &Args, files: &FreshFiles, out: &Path) -> anyhow::Result<()> {
    let parsed = files.parse()?;
    let prompts = PromptWriter::new(&parsed.settings, &parsed.tokenizer)?;
    let asking = Asking { config: &parsed.config, prompts: &prompts, tokenizer: &parsed.tokenizer };
    let config = config(args)?;
    config.check(asking)?;
    let scenes = scenes(args, &config)?;
    claim(out, &config)?;
    let start = Instant::now();
    let (mut made, mut bytes, mut said) = (0u64, 0u64, start);
    let style = "{msg} {wide_bar} {pos}/{len} frames {per_sec} {eta}";
    let bar = ProgressBar::new(args.count).with_style(ProgressStyle::with_template(style)?);
    bar.set_message(out.display().to_string());
    for index in 0..args.count.div_ceil(args.shard as u64) {
        if args.seconds.is_some_and(|s| start.elapsed() >= Duration::from_secs(s)) {
            eprintln!("{}: --seconds is over", out.display());
            break;
        }
        if bytes as f64 >= args.max_gb * 1e9 {
            eprintln!("{}: {:.1} GB are there, --max-gb is reached", out.display(), bytes as f64 / 1e9);
            break;
        }
        let path = out.join(format!("{index:06}.safetensors"));
        if !path.exists() {
            config.shard(asking, &scenes, index)?.write(&path)?;
            made += args.shard as u64;
        }
        bytes += path.metadata().with_context(|| path.display().to_string())?.len();
        bar.inc(args.shard as u64);
        // A bar is for terminals; logs get a line now and then.
        if bar.is_hidden() && said.elapsed() > Duration::from_secs(20) {
            said = Instant::now();
            let rate = made as f64 / start.elapsed().as_secs_f64();
            eprintln!("{}: {made} frames, {rate:.1} a second, {:.2} GB", out.display(), bytes as f64 / 1e9);
        }
    }
    bar.finish_and_clear();
    let seconds = start.elapsed().as_secs_f64();
    eprintln!("{}: {made} new frames in {seconds:.1} s, {:.2} GB in all", out.display(), bytes as f64 / 1e9);
    Ok(())
}
