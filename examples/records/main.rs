//! Writes training records: frames with measurements, questions and answers, for a trainer on a GPU (`training/`).
//!
//! ```sh
//! records --fresh fresh --shape small                                   # a checkpoint to start from
//! records --shape small --size 384x288 --prompt 512 --count 60000 --seconds 300 --out train
//! records --shape small --size 384x288 --prompt 512 --count 256 --held-out 100 --out held/100
//! records --mix procedural=0.5,furnished=0.35,streets=0.15 --library furniture --out mixed
//!
//! # Whole prompts for a published checkpoint: of a data set, and of a robot's own frames, whose measurements are the labels
//! records --base Qwen2.5-VL-3B-Instruct --settings my-adapter/sdim.json --size 532x392 --prompt 256 --questions 64 \
//!     --data hypersim --layout hypersim --sample 10000 --list hypersim.txt --out prompts/hypersim
//! records --base Qwen2.5-VL-3B-Instruct --settings my-adapter/sdim.json --size 644x476 --questions 64 \
//!     --data robot --depth-scale mm --labels sparse --out prompts/robot
//! ```
//!
//! A set is a folder of shards (`src/supervise/shard.rs`) and `records.json`, which says how it was drawn. The same
//! arguments give the same bytes whatever the number of cores; a run that was stopped goes on where it was. Scenes of
//! training, of held-out records and of the crate's own evaluations have seeds of three ranges
//! ([`sdim::internals::supervise::training_seed`]).

mod data;

use anyhow::{Context, bail, ensure};
use clap::Parser;
use data::{Data, DataArgs};
use indicatif::{ProgressBar, ProgressStyle};
use sdim::internals::model::CheckpointFiles;
use sdim::internals::query::PromptWriter;
use sdim::internals::scenes::furnished::Library;
use sdim::internals::supervise::{
    Asking, BatchConfig, FreshFiles, KnownFrame, LabelSource, RecordConfig, RecordSet, SceneMix, Scenes,
    Shape, frame, held_out_seed, mix, training_seed,
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
    /// Directory of a published checkpoint: whole prompts for it instead of records for a shape; `sdim.json` of --settings, else its own.
    #[arg(long, conflicts_with_all = ["shape", "fresh"])]
    base: Option<PathBuf>,
    /// Write a checkpoint with initial weights here.
    #[arg(long, required_unless_present_any = ["out", "list"])]
    fresh: Option<PathBuf>,
    /// Checkpoint directory that the initial weights are taken from; what the shape has and it has not is initial.
    #[arg(long, requires = "fresh")]
    from: Option<PathBuf>,
    /// Folder of the records.
    #[arg(long)]
    out: Option<PathBuf>,
    #[command(flatten)]
    data: DataArgs,
    /// Frames, rounded up to whole shards; without it 1024, or each of the data set once.
    #[arg(long)]
    count: Option<u64>,
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
    /// True answers: dense (the ground truth), or sparse (measurements that are held back).
    #[arg(long, value_parser = labels, default_value = "dense", requires = "base")]
    labels: LabelSource,
    /// Share of the frames that pass through a random camera and depth sensor; 0 without it for frames of a data set.
    #[arg(long)]
    sensors: Option<f32>,
    /// Share of the frames among whose measurements are bad ones; 0 without it for frames of a data set.
    #[arg(long)]
    errors: Option<f32>,
    /// Which scenes: shares of procedural, furnished, streets and glazed (panes that a sensor sees through), NAME=SHARE,...; procedural alone
    /// without it.
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

fn labels(text: &str) -> Result<LabelSource, String> {
    match text {
        "dense" => Ok(LabelSource::Dense),
        "sparse" => Ok(LabelSource::Sparse),
        _ => Err("expected dense or sparse".to_string()),
    }
}

fn main() -> anyhow::Result<()> {
    let args = Args::parse();
    if let Some(threads) = args.threads {
        rayon::ThreadPoolBuilder::new().num_threads(threads).build_global()?;
    }
    let data = args.data.open(args.seed)?;
    let files = match &args.base {
        Some(base) => {
            let mut files = CheckpointFiles::from_dir(base)?;
            if let Some(path) = &args.settings {
                files.settings = Settings::from_file(path)?;
            }
            files
        }
        None => {
            ensure!(!args.data.given() || args.data.lists(), "--data: whole prompts, so --base is missing");
            fresh(&args)?.parse()?
        }
    };
    let Some(out) = &args.out else { return Ok(()) };
    let prompts = PromptWriter::new(&files.settings, &files.tokenizer)?;
    let asking = Asking { config: &files.config, prompts: &prompts, tokenizer: &files.tokenizer };
    write(&args, asking, data.as_ref(), out)
}

/// The files of a shape, with initial weights where they were asked for.
fn fresh(args: &Args) -> anyhow::Result<FreshFiles> {
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
    match (&args.fresh, &args.from) {
        (Some(dir), Some(from)) => {
            let fresh = files.write_grown(dir, args.seed, from)?;
            let (dir, from) = (dir.display(), from.display());
            eprintln!(
                "{dir}: weights of {from}; {fresh} tensors that it has not are initial ones of seed {}",
                args.seed
            );
        }
        (Some(dir), None) => {
            files.write_initial(dir, args.seed)?;
            eprintln!("{}: initial weights of seed {}", dir.display(), args.seed);
        }
        (None, _) => {}
    }
    Ok(files)
}

fn config(args: &Args) -> anyhow::Result<RecordConfig> {
    let &[fewest, most] = &args.points[..] else { bail!("--points: expected FEWEST,MOST") };
    ensure!(args.base.is_none() || args.sizes.len() == 1, "--size: one of them for whole prompts");
    let usual = BatchConfig::default();
    // A data set's pictures and measurements are a real sensor's already.
    let of_data = |share: f32| if args.data.given() { 0.0 } else { share };
    let batch = BatchConfig {
        labels: args.labels,
        sensors: args.sensors.unwrap_or(of_data(usual.sensors)),
        errors: args.errors.unwrap_or(of_data(usual.errors)),
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
fn claim(out: &Path, config: &RecordConfig, data: Option<&Data>) -> anyhow::Result<()> {
    let path = out.join("records.json");
    let from = data.map(Data::describe);
    std::fs::create_dir_all(out).with_context(|| out.display().to_string())?;
    if path.exists() {
        let text = std::fs::read_to_string(&path).with_context(|| path.display().to_string())?;
        let found: RecordConfig = serde_json::from_str(&text).with_context(|| path.display().to_string())?;
        let keys: serde_json::Value = serde_json::from_str(&text)?;
        let same = found == *config && keys.get("data") == from.as_ref();
        ensure!(same, "{}: other records are there; expected {config:?}, data {from:?}", path.display());
        return Ok(());
    }
    let mut keys = serde_json::to_value(config)?;
    if let (Some(keys), Some(from)) = (keys.as_object_mut(), from) {
        keys.insert("data".into(), from);
    }
    std::fs::write(&path, serde_json::to_string_pretty(&keys)?).with_context(|| path.display().to_string())
}

/// The frame of a number for whole prompts: of a data set, else a scene.
fn known(
    config: &RecordConfig,
    scenes: &Scenes,
    data: Option<&Data>,
    number: u64,
) -> sdim::Result<KnownFrame> {
    let size = config.batch.sizes[0];
    if let Some(data) = data {
        return data.frame(number, size);
    }
    let random = mix(config.seed, number);
    let seed = if config.held_out() { held_out_seed(random) } else { training_seed(random) };
    Ok(KnownFrame { name: format!("{seed:016x}"), frame: frame(scenes, seed, size)?, measured: None })
}

fn write(args: &Args, asking: Asking, data: Option<&Data>, out: &Path) -> anyhow::Result<()> {
    let config = config(args)?;
    match args.base {
        Some(_) => config.check_prompts(asking)?,
        None => config.check(asking)?,
    }
    let count = args.count.unwrap_or(data.map_or(1024, Data::len));
    let per_shard = args.shard as u64;
    let scenes = scenes(args, &config)?;
    claim(out, &config, data)?;
    let start = Instant::now();
    let (mut made, mut bytes, mut said) = (0u64, 0u64, start);
    let style = "{msg} {wide_bar} {pos}/{len} frames {per_sec} {eta}";
    let bar = ProgressBar::new(count).with_style(ProgressStyle::with_template(style)?);
    bar.set_message(out.display().to_string());
    for index in 0..count.div_ceil(per_shard) {
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
            if args.base.is_some() {
                let numbers = index * per_shard..((index + 1) * per_shard).min(count);
                let source = |number| known(&config, &scenes, data, number);
                config.prompts(asking, source, index, numbers)?.write(&path)?;
            } else {
                config.shard(asking, &scenes, index)?.write(&path)?;
            }
            made += per_shard;
        }
        bytes += path.metadata().with_context(|| path.display().to_string())?.len();
        bar.inc(per_shard);
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
