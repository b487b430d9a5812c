//! Whether a model takes panes of glass for what they are: obstacles, though its sensor sees through them.
//!
//! `cargo run --release --example panes -- --checkpoint tiny --checkpoint DIR [--scenes 60] [--points 100,500]`
//!
//! Completes scenes behind glass that training never saw, from measurements that are made through the panes, and scores the maps at
//! pixels of panes and elsewhere. Errors are over pixels that were not measured. Of two frames one may be a hundred times as deep as
//! the other, so beside metres stand geometric means over frames of each error by that of `linear`, and of the first checkpoint, on
//! the same frame. `sees the pane` is the share of pane pixels whose answer is nearer to the pane than to what is behind it, by
//! their ratio, where the two lie a tenth or more apart; mean over frames.

#[path = "../common/mod.rs"]
mod common;
mod score;

use clap::Parser;
use common::{HELD_OUT, load_as, load_options, stdout};
use score::{Scores, score};
use sdim::depth::{interpolate, sample_points};
use sdim::internals::scenes::{RgbdFrame, glazed};
use sdim::{CompleteOptions, DepthCompleter, Outliers, Preserve, QueryPlan, SparseDepth};
use std::path::{Path, PathBuf};

#[derive(Parser)]
struct Args {
    /// `tiny` (inside the crate) or a checkpoint directory; may be given several times.
    #[arg(long, default_value = "tiny")]
    checkpoint: Vec<String>,
    /// Adapter directory on top of the first checkpoint, scored beside it.
    #[arg(long)]
    adapter: Option<PathBuf>,
    /// Held-out scenes.
    #[arg(long, default_value_t = 60)]
    scenes: u64,
    /// Measurements of a frame; several: 100,500.
    #[arg(long, value_delimiter = ',', default_values_t = [100, 500])]
    points: Vec<usize>,
    /// Columns and rows of a frame.
    #[arg(long, default_value_t = 320)]
    width: usize,
    #[arg(long, default_value_t = 240)]
    height: usize,
    /// Pixels to ask: every, stride:N, budget:N or deadline:MS.
    #[arg(long, default_value_t = Default::default())]
    plan: QueryPlan,
    /// What becomes of contradicted measurements: trust, ignore or preserve.
    #[arg(long, default_value_t = Default::default())]
    outliers: Outliers,
    /// Ask measured pixels as well, so that maps need not keep what was measured through a pane.
    #[arg(long)]
    ask_measured: bool,
    /// Leave answers as they are, without aligning them to the measurements.
    #[arg(long)]
    no_align: bool,
    /// Print JSON instead of tables.
    #[arg(long)]
    json: bool,
}

/// What is compared.
struct Method {
    name: String,
    completer: Option<DepthCompleter>,
}

fn methods(args: &Args) -> anyhow::Result<Vec<Method>> {
    let mut all = vec![Method { name: "linear".into(), completer: None }];
    let mut add = |checkpoint: &str, adapter: Option<&Path>| -> anyhow::Result<()> {
        let completer = load_as(checkpoint, &load_options("cpu", None, adapter)?)?;
        let name = match adapter {
            Some(adapter) => format!("{checkpoint} + {}", adapter.display()),
            None => checkpoint.to_string(),
        };
        all.push(Method { name, completer: Some(completer) });
        Ok(())
    };
    for checkpoint in &args.checkpoint {
        add(checkpoint, None)?;
    }
    if let Some(adapter) = &args.adapter {
        add(&args.checkpoint[0], Some(adapter))?;
    }
    Ok(all)
}

/// A method's map, and the pixels whose measurement it does not believe.
fn complete(
    method: &Method,
    options: &CompleteOptions,
    frame: &RgbdFrame,
    sparse: &SparseDepth,
) -> sdim::Result<(Vec<f32>, Vec<usize>)> {
    let Some(completer) = &method.completer else {
        return Ok((interpolate::linear(sparse)?, Vec::new()));
    };
    let done = completer.complete_detailed(&frame.rgb, sparse, options)?;
    let flagged = done.flagged.iter().map(|o| o.y * frame.width() + o.x).collect();
    Ok((done.map.depth().to_vec(), flagged))
}

fn main() -> anyhow::Result<()> {
    let args = Args::parse();
    anyhow::ensure!(args.scenes > 0, "--scenes 0: expected at least 1");
    sdim::internals::kernels::keep_freed_memory();
    let methods = methods(&args)?;
    let preserve = if args.ask_measured { Preserve::Ask } else { Preserve::Keep };
    let options = CompleteOptions::default()
        .with_plan(args.plan)
        .with_outliers(args.outliers)
        .with_preserve(preserve)
        .with_align(!args.no_align);
    let bar = indicatif::ProgressBar::new(args.scenes * args.points.len() as u64);
    let mut report = Vec::new();
    for &points in &args.points {
        let mut all: Vec<Scores> = methods.iter().map(|m| Scores::new(&m.name)).collect();
        for seed in HELD_OUT..HELD_OUT + args.scenes {
            let frame = glazed(seed, args.width, args.height)?;
            let sparse = sample_points(frame.sensed(), args.width, args.height, points, seed)?;
            for (method, scores) in methods.iter().zip(&mut all) {
                let (map, flagged) = complete(method, &options, &frame, &sparse)?;
                scores.add(score(&frame, &sparse, &map, &flagged)?);
            }
            bar.inc(1);
        }
        report.push((points, all));
    }
    bar.finish_and_clear();
    Ok(stdout::print(&if args.json { score::json(&report)? } else { score::tables(&report) })?)
}
