//! Scores checkpoints and classical baselines on a data set of RGB-D frames: the paper's Tables 2 and 4 on your own copy.
//!
//! `cargo run --release --example evaluate -- --layout folder --data DIR --points 100,500 --out RESULTS`
//!
//! Errors are over ground-truth pixels that were not given as input; the tables of Marigold-DC, and those compared with them, count
//! all of them: `--score all`. Beside the means in metres stand geometric means over frames of each error by that of `linear` on
//! the same frame, which the frames with far depth do not rule. A frame without valid depth is skipped and named in the report; a
//! file that cannot be read ends the run with its name. Each frame's scores are one small file under `--out`, so a run that was
//! stopped goes on where it was, and `--shard I/N` spreads a data set over machines; `--merge` makes one report of them.
//! report.md, report.json and frames.csv depend on the scores alone and are the same, byte for byte, however the work was divided;
//! times and memory stand in speed.json and are printed to stderr.
//!
//! # On a cluster
//!
//! Any array of jobs will do: they share nothing but the folder `--out`, which may also be one per job. Build first, so that no job
//! compiles, and give all jobs the same arguments. A job that was killed is sent again as it was and goes on where it stopped.
//!
//! SLURM, 16 jobs, and one for the report after they all went well:
//!
//! ```sh
//! run="target/release/examples/evaluate --layout void --data /data/void_1500 --score all --out /results/void_1500"
//! jobs=$(sbatch --parsable --array=0-15 --wrap "$run --shard \$SLURM_ARRAY_TASK_ID/16")
//! sbatch --dependency=afterok:$jobs --wrap "target/release/examples/evaluate --merge /results/void_1500 --out /results/void_1500"
//! ```
//!
//! Kubernetes, an indexed Job: `completionMode: Indexed`, `completions: 16`, `parallelism` as many as there is room for, a volume
//! that all can write to at `/results`, and as the container's command, in the form that a shell reads for the index:
//!
//! ```sh
//! sh -c 'exec evaluate --layout void --data /data/void_1500 --score all --out /results/void_1500 --shard "$JOB_COMPLETION_INDEX/16"'
//! ```
//!
//! then `--merge` as above in a Job of its own. It names what is missing when not all shards are done.

#[path = "../common/mod.rs"]
mod common;
mod figures;
mod frames;
mod methods;
mod record;
mod report;
mod run;
mod settings;
mod speed;

use anyhow::{Context, bail, ensure};
use clap::Parser;
use sdim::benchmarks::Layout;
use sdim::depth::SparsePattern;
use sdim::{DepthScale, LoadOptions, Outliers, QueryPlan, Readout, WeightFormat};
use serde::{Deserialize, Serialize};
use std::path::PathBuf;
use std::str::FromStr;

/// Scores checkpoints and classical baselines on RGB-D frames.
///
/// Results under --out: settings.json, frames/POINTS/INDEX.json (one per frame and number of points, written whole or not at all);
/// report.md, report.json, frames.csv (the same bytes however the work was divided or interrupted); speed.json (times and memory, which
/// differ from run to run).
#[derive(Parser)]
pub struct Args {
    /// How the data set is stored: folder, nyu, void, ibims, kitti, ddad, tum, scannet, hypersim or virtual-kitti.
    #[arg(long, default_value = "folder")]
    layout: Layout,
    /// The data set.
    #[arg(long, required_unless_present_any = ["procedural", "furnished", "merge"])]
    data: Option<PathBuf>,
    /// Score on this many held-out procedural scenes of 320x240 instead.
    #[arg(long, conflicts_with_all = ["data", "layout", "depth_scale", "range", "frame_list", "resample"])]
    procedural: Option<usize>,
    /// Score on this many rooms of 320x240 furnished with models of --library, rooms and models held out from training.
    #[arg(long, requires = "library",
        conflicts_with_all = ["data", "layout", "depth_scale", "range", "resample", "procedural"])]
    furnished: Option<usize>,
    /// Folder of furniture, as scripts/furniture.sh made it or packed by the example `furniture`.
    #[arg(long, requires = "furnished")]
    library: Option<PathBuf>,
    /// Unit of integer depth files of layout folder: mm, kitti, tum or units per metre.
    #[arg(long)]
    depth_scale: Option<DepthScale>,
    /// Nearest and farthest ground truth that counts, metres: NEAR,FAR.
    #[arg(long, value_parser = pair)]
    range: Option<(f32, f32)>,
    /// Only the frames that this text file names, one per line, in its order: as the report calls them, or SCENE/NUMBER as in the
    /// published lists of ScanNet's frames.
    #[arg(long, value_name = "FILE")]
    frame_list: Option<PathBuf>,
    /// Points drawn from the ground truth where a frame has no measurements of its own; several: 100,500,1500. Default: what
    /// the benchmark's protocol says, else 500. An error where all frames have their own (void, kitti, ddad, nyu with its hints).
    #[arg(long, value_delimiter = ',')]
    points: Vec<usize>,
    /// How they are spread: uniform (the default), sfm, line, grid, hole, lidar:LINES or block:SIDE.
    #[arg(long)]
    pattern: Option<String>,
    /// Draw points from the ground truth even where a frame has measurements of its own.
    #[arg(long)]
    resample: bool,
    /// Pixels with ground truth that count: unseen leaves out those given as input, all does not (as Marigold-DC's
    /// script/eval.py, and so the tables that are compared with it).
    #[arg(long, value_enum, default_value_t = Score::Unseen)]
    score: Score,
    /// Seed of the drawn points.
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// Only the first frames.
    #[arg(long)]
    limit: Option<usize>,
    /// `tiny` (the default) or a checkpoint directory; may be given several times.
    #[arg(long, visible_alias = "model")]
    checkpoint: Vec<String>,
    /// Adapter directory on top of the one --checkpoint.
    #[arg(long)]
    adapter: Option<PathBuf>,
    /// Only these methods: names of baselines and checkpoints as in the table. Memory per method is that of the whole process with
    /// all checkpoints loaded, so name one method to see what it needs alone.
    #[arg(long, value_delimiter = ',')]
    methods: Vec<String>,
    /// Pixels to ask: every, stride:N, budget:N or deadline:MS.
    #[arg(long, default_value_t = Default::default())]
    plan: QueryPlan,
    /// What an answer's distribution is read as: median or mean.
    #[arg(long, default_value_t = Default::default())]
    readout: Readout,
    /// What becomes of contradicted measurements: trust, ignore or preserve.
    #[arg(long, default_value_t = Default::default())]
    outliers: Outliers,
    /// How matrices of checkpoints are held: f32, bf16 or int8; without it, what this machine multiplies best.
    #[arg(long)]
    weights: Option<WeightFormat>,
    /// cpu, cuda:N or metal.
    #[arg(long, default_value = "cpu")]
    device: String,
    /// Where results go and are taken up from. Without it nothing is kept.
    #[arg(long)]
    out: Option<PathBuf>,
    /// Only every N-th frame, from the I-th on, I from 0 to N-1 (as in SLURM_ARRAY_TASK_ID); needs --out, and --merge afterwards.
    #[arg(long, requires = "out", value_name = "I/N")]
    shard: Option<Shard>,
    /// Make the report of finished runs or shards instead of running; into --out if given.
    #[arg(long, num_args = 1.., value_name = "DIR", conflicts_with_all = [
        "data", "procedural", "furnished", "library", "layout", "depth_scale", "range", "frame_list", "points",
        "pattern", "resample", "score", "seed", "limit", "checkpoint", "adapter", "methods", "plan", "readout",
        "outliers", "weights", "device", "shard", "figures", "verbose"])]
    merge: Vec<PathBuf>,
    /// Draw the first frames into this folder, all methods and their errors beside each other.
    #[arg(long)]
    figures: Option<PathBuf>,
    /// How many frames to draw.
    #[arg(long, default_value_t = 10)]
    figure_frames: usize,
    /// Width of one picture in a figure, pixels.
    #[arg(long, default_value_t = 320)]
    figure_tile: usize,
    /// Print the report as one JSON object instead of tables.
    #[arg(long)]
    json: bool,
    /// Print each frame's MAE of each method to stderr.
    #[arg(long)]
    verbose: bool,
}

/// Pixels that count in the errors.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Score {
    /// With ground truth, not measured.
    Unseen,
    /// With ground truth.
    All,
}

/// A part of the frames: those whose index leaves `index` when divided by `of`.
#[derive(Clone, Copy, Debug)]
pub struct Shard {
    pub index: usize,
    pub of: usize,
}

impl FromStr for Shard {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let parts = text.split_once('/').and_then(|(i, n)| Some((i.parse().ok()?, n.parse().ok()?)));
        match parts {
            Some((index, of)) if index < of => Ok(Shard { index, of }),
            _ => Err("expected I/N with I from 0 to N-1".to_string()),
        }
    }
}

fn pair(text: &str) -> Result<(f32, f32), String> {
    let parts =
        text.split_once(',').and_then(|(a, b)| Some((a.trim().parse().ok()?, b.trim().parse().ok()?)));
    parts.ok_or_else(|| "expected NEAR,FAR in metres".to_string())
}

impl Args {
    /// How checkpoints are loaded.
    fn options(&self) -> sdim::Result<LoadOptions> {
        common::load_options(&self.device, self.weights, self.adapter.as_deref())
    }

    /// Numbers of points to draw; 0 alone where nothing is drawn, since all frames have their own.
    fn points(&self, all_own: bool) -> anyhow::Result<Vec<usize>> {
        if all_own && !self.resample {
            let flag = if self.points.is_empty() { "--pattern" } else { "--points" };
            ensure!(
                self.points.is_empty() && self.pattern.is_none(),
                "{flag}: nothing is drawn, all frames of layout {} have measurements of their own; expected --resample beside \
                 it, to draw from the ground truth instead",
                self.layout
            );
            return Ok(vec![0]);
        }
        let mut points = self.points.clone();
        if points.is_empty() {
            points.push(self.layout.points().unwrap_or(500));
        }
        points.sort_unstable();
        points.dedup();
        if points[0] == 0 {
            bail!("--points 0: expected at least 1");
        }
        Ok(points)
    }

    fn pattern(&self) -> anyhow::Result<SparsePattern> {
        self.pattern_name().parse().context("--pattern")
    }

    fn pattern_name(&self) -> &str {
        self.pattern.as_deref().unwrap_or("uniform")
    }
}

fn main() -> anyhow::Result<()> {
    let args = Args::parse();
    sdim::internals::kernels::keep_freed_memory();
    let made =
        if args.merge.is_empty() { run::run(&args)? } else { Some(report::Report::read(&args.merge)?) };
    let Some(report) = made else { return Ok(()) };
    if let Some(out) = &args.out {
        report.write(out)?;
    }
    if args.json {
        println!("{}", serde_json::to_string_pretty(&report.tables)?);
    } else {
        print!("{}", report.markdown());
    }
    eprint!("{}", report.speed.table());
    Ok(())
}
