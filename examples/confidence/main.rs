//! Whether a model's confidence comes true, and the scale that makes it: reliability and sparsification, in numbers and as plots.
//!
//! `cargo run --release --example confidence -- --scenes 60 --out DIR` completes procedural scenes that training never saw, fits the scale of `sdim.json`
//! (temperature and offset of the confidence) on every other one, and judges it on those between. With
//! `--library DIR` as many furnished rooms join them; `--data DIR` takes frames of a folder instead (`--layout`), for looking: a camera of your own.
//! DIR gets `reliability.svg`, `sparsification.svg` and `confidence.json`, whose `scale` is the key `confidence` for `sdim.json`.

mod charts;
#[path = "../common/mod.rs"]
mod common;
mod pool;

use anyhow::Context;
use clap::Parser;
use common::{load_as, load_options, stdout};
use pool::Pool;
use sdim::benchmarks::{Layout, LayoutOptions};
use sdim::depth::sample_points;
use sdim::internals::scenes::furnished::{Library, Split, furnished};
use sdim::internals::scenes::procedural;
use sdim::settings::ConfidenceScale;
use sdim::{CompleteOptions, DepthCompleter, QueryPlan, RgbImage, SparseDepth};
use serde_json::json;
use std::path::PathBuf;

/// Seeds that neither training draws nor `evaluate` scores.
const FIRST_SEED: u64 = 2_500_000;

#[derive(Parser)]
struct Args {
    /// `tiny` (inside the crate) or a checkpoint directory.
    #[arg(long, default_value = "tiny")]
    model: String,
    /// Adapter directory on top of it.
    #[arg(long)]
    adapter: Option<PathBuf>,
    /// Procedural scenes of 320x240, and as many furnished ones with --library.
    #[arg(long, default_value_t = 60, conflicts_with = "data")]
    scenes: usize,
    /// Folder of furniture, as scripts/furniture.sh made it or packed by the example `furniture`.
    #[arg(long, conflicts_with = "data")]
    library: Option<PathBuf>,
    /// Frames with ground truth instead of scenes.
    #[arg(long)]
    data: Option<PathBuf>,
    /// How they are stored: folder, nyu, void, ibims, kitti, ddad, tum or scannet.
    #[arg(long, default_value_t = Layout::Folder, requires = "data")]
    layout: Layout,
    /// Measurements of a frame that has none of its own; several: 100,500.
    #[arg(long, value_delimiter = ',', default_values_t = [100, 500])]
    points: Vec<usize>,
    /// Pixels to ask: every, stride:N, budget:N or deadline:MS.
    #[arg(long, default_value_t = QueryPlan::default())]
    plan: QueryPlan,
    /// Where plots and numbers go.
    #[arg(long)]
    out: PathBuf,
}

/// One frame: its picture, ground truth and measurements.
struct Frame {
    rgb: RgbImage,
    truth: Vec<f32>,
    sparse: Option<SparseDepth>,
}

/// Frames by number.
type Source = Box<dyn Fn(usize) -> anyhow::Result<Frame>>;

/// How many frames there are, and a way to each.
fn frames(args: &Args) -> anyhow::Result<(usize, Source)> {
    if let Some(dir) = &args.data {
        let data = args.layout.open(dir, &LayoutOptions::default())?;
        let count = data.len();
        let load = move |i| {
            let sample = data.load(i)?;
            Ok(Frame { rgb: sample.rgb, truth: sample.gt, sparse: sample.sparse })
        };
        return Ok((count, Box::new(load)));
    }
    let library = match &args.library {
        Some(dir) => Some(Library::open(dir)?.part(Split::HeldOut)?),
        None => None,
    };
    let kinds = if library.is_some() { 2 } else { 1 };
    // Kinds in pairs, so that every other frame has both.
    let load = move |i: usize| {
        let seed = FIRST_SEED + (2 * (i / (2 * kinds)) + i % 2) as u64;
        let frame = match library.as_ref().filter(|_| i / 2 % 2 == 1) {
            Some(library) => furnished(library, seed, 320, 240)?,
            None => procedural(seed, 320, 240)?,
        };
        Ok(Frame { rgb: frame.rgb, truth: frame.depth, sparse: None })
    };
    Ok((args.scenes * kinds, Box::new(load)))
}

/// Completes one frame and adds its pixels to a pool.
fn add(
    args: &Args,
    completer: &DepthCompleter,
    frame: &Frame,
    points: usize,
    pool: &mut Pool,
) -> anyhow::Result<()> {
    let (width, height) = (frame.rgb.width() as usize, frame.rgb.height() as usize);
    let sparse = match &frame.sparse {
        Some(own) => own.clone(),
        None => sample_points(&frame.truth, width, height, points, 0)?,
    };
    let options = CompleteOptions::default().with_plan(args.plan);
    let map = completer.complete(&frame.rgb, &sparse, &options)?;
    pool.add(&map, &frame.truth, args.plan);
    Ok(())
}

fn main() -> anyhow::Result<()> {
    let args = Args::parse();
    let completer = load_as(&args.model, &load_options("cpu", None, args.adapter.as_deref())?)?;
    let (count, frame) = frames(&args)?;
    anyhow::ensure!(count >= 2, "{count} frames: expected at least 2, one to fit on and one to judge on");
    let mut pools = [Pool::default(), Pool::default()];
    let bar = indicatif::ProgressBar::new((count * args.points.len()) as u64);
    for i in 0..count {
        let frame = frame(i)?;
        for &points in &args.points {
            let points = if frame.sparse.is_some() { 0 } else { points };
            add(&args, &completer, &frame, points, &mut pools[i % 2])
                .with_context(|| format!("frame {i}"))?;
            bar.inc(1);
        }
    }
    bar.finish_and_clear();
    let [fitted_on, judged] = &pools;
    let more = fitted_on.fit()?;
    let scaled = judged.scaled(&more);
    let scale = completer.model().prompts.settings().confidence.then(&more);
    std::fs::create_dir_all(&args.out).with_context(|| args.out.display().to_string())?;
    charts::reliability(&args.out.join("reliability.svg"), &[("as stated", judged), ("scaled", &scaled)])?;
    charts::sparsification(&args.out.join("sparsification.svg"), judged)?;
    let report = report(judged, &scaled, &scale);
    let path = args.out.join("confidence.json");
    std::fs::write(&path, serde_json::to_string_pretty(&report)?)
        .with_context(|| path.display().to_string())?;
    stdout::print(&summary(judged, &scaled, &scale))?;
    Ok(())
}

/// The numbers of both, for `confidence.json`.
fn report(stated: &Pool, scaled: &Pool, scale: &ConfidenceScale) -> serde_json::Value {
    json!({ "scale": scale, "stated": stated.numbers(), "scaled": scaled.numbers() })
}

/// A table for people.
fn summary(stated: &Pool, scaled: &Pool, scale: &ConfidenceScale) -> String {
    let mut lines = vec![
        format!("pixels judged: {}", stated.len()),
        "calibration error of the confidence   as stated   scaled".to_string(),
    ];
    for ((name, before), (_, after)) in stated.parts().iter().zip(scaled.parts()) {
        if let (Some(before), Some(after)) = (before, after) {
            lines.push(format!("  {name:<34} {:>9.4} {:>8.4}", before.error, after.error));
        }
    }
    if let Some(error) = stated.expected_error() {
        lines.push(format!("calibration error of the expected error: {:.4} m", error.error));
    }
    if let Some(order) = stated.sparsification() {
        lines.push(format!(
            "sparsification by expected error: AUSE {:.3}, AURG {:.3}",
            order.ause, order.aurg
        ));
    }
    let ConfidenceScale { temperature, offset } = scale;
    lines.push(format!(
        "sdim.json: \"confidence\": {{ \"temperature\": {temperature:.3}, \"offset\": {offset:.3} }}"
    ));
    lines.join("\n")
}
