//! Completes one frame.
//!
//! `cargo run --release --example complete` runs on the bundled pair; with `--rgb P --sparse P --depth-scale S` on yours.
//! Writes dense.png (16 bit, the input's scale), dense.npy, confidence.npy (f32) and preview.png into `--out`.

mod common;

use anyhow::Context;
use clap::Parser;
use common::{load_as, load_options, rounded, stdout};
use indicatif::{ProgressBar, ProgressStyle};
use sdim::depth::interpolate;
use sdim::draw::preview;
use sdim::metrics::{Errors, errors};
use sdim::system::{device_memory_bytes, peak_rss_bytes};
use sdim::{CompleteOptions, DepthScale, QueryPlan, SparseDepth, WeightFormat, read_rgb};
use serde_json::{Value, json};
use std::path::{Path, PathBuf};
use std::time::Instant;

#[derive(Parser)]
struct Args {
    /// RGB frame (PNG or JPEG); without it, the bundled pair.
    #[arg(long, requires = "sparse")]
    rgb: Option<PathBuf>,
    /// Sparse depth of the same size: 16-bit PNG (with --depth-scale) or .npy in metres.
    #[arg(long, requires = "rgb")]
    sparse: Option<PathBuf>,
    /// Unit of integer depth files: mm, kitti (1/256 m), tum (1/5000 m) or units per metre.
    #[arg(long, requires = "rgb")]
    depth_scale: Option<DepthScale>,
    /// Dense ground truth, for errors and two more panels in the preview.
    #[arg(long, requires = "rgb")]
    gt: Option<PathBuf>,
    /// `tiny` (inside the crate) or a checkpoint directory.
    #[arg(long, default_value = "tiny")]
    model: String,
    /// Adapter directory on top of --model.
    #[arg(long)]
    adapter: Option<PathBuf>,
    /// How matrices are held: f32, bf16 or int8; without it, what this machine multiplies best.
    #[arg(long)]
    weights: Option<WeightFormat>,
    /// Pixels to ask: every, stride:N or budget:N.
    #[arg(long, default_value_t = Default::default())]
    plan: QueryPlan,
    /// cpu, cuda:N or metal.
    #[arg(long, default_value = "cpu")]
    device: String,
    /// Completes the frame so many times; results and seconds are those of the last time.
    #[arg(long, default_value_t = 1)]
    repeat: usize,
    /// Where results go.
    #[arg(long, default_value = "out")]
    out: PathBuf,
    /// One JSON object on stdout instead of the summary.
    #[arg(long)]
    json: bool,
}

struct Inputs {
    rgb: PathBuf,
    sparse: PathBuf,
    gt: Option<PathBuf>,
    scale: Option<DepthScale>,
}

impl Args {
    fn inputs(&self) -> Inputs {
        match (&self.rgb, &self.sparse) {
            (Some(rgb), Some(sparse)) => Inputs {
                rgb: rgb.clone(),
                sparse: sparse.clone(),
                gt: self.gt.clone(),
                scale: self.depth_scale,
            },
            _ => {
                let bundled = |name| Path::new(env!("CARGO_MANIFEST_DIR")).join("assets/example").join(name);
                Inputs {
                    rgb: bundled("rgb.png"),
                    sparse: bundled("sparse.png"),
                    gt: Some(bundled("gt.png")),
                    scale: Some(DepthScale::millimetres()),
                }
            }
        }
    }
}

fn bar() -> anyhow::Result<ProgressBar> {
    let style = ProgressStyle::with_template("{bar:40} {pos}/{len} pixels asked, {eta} left")?;
    Ok(ProgressBar::new(0).with_style(style))
}

fn error_json(e: &Errors) -> Value {
    json!({"mae": e.mae, "rmse": e.rmse, "abs_rel": e.abs_rel})
}

fn main() -> anyhow::Result<()> {
    let args = Args::parse();
    sdim::internals::kernels::keep_freed_memory();
    let inputs = args.inputs();
    let start = Instant::now();
    let options = load_options(&args.device, args.weights, args.adapter.as_deref())?;
    let on = options.device.clone();
    let completer = load_as(&args.model, &options)?;
    let rgb = read_rgb(&inputs.rgb)?;
    let sparse = SparseDepth::read(&inputs.sparse, inputs.scale)?;
    let gt = inputs.gt.as_ref().map(|p| SparseDepth::read(p, inputs.scale)).transpose()?;
    for (path, map) in [(Some(&inputs.sparse), Some(&sparse)), (inputs.gt.as_ref(), gt.as_ref())] {
        if let (Some(path), Some(map)) = (path, map) {
            let sizes = [(map.width(), map.height()), (rgb.width() as usize, rgb.height() as usize)];
            let [depth, picture] = sizes.map(|(w, h)| format!("{w}x{h}"));
            anyhow::ensure!(
                depth == picture,
                "{}: {depth} pixels; expected {picture} as {}",
                path.display(),
                inputs.rgb.display()
            );
        }
    }
    let load_seconds = start.elapsed().as_secs_f64();

    let bar = bar()?;
    let ticker = bar.clone();
    let options = CompleteOptions::default().with_plan(args.plan).with_progress(move |p| {
        ticker.set_length(p.planned as u64);
        ticker.set_position(p.answered as u64);
    });
    let mut done = completer.complete_detailed(&rgb, &sparse, &options)?;
    let first_seconds = done.seconds.total;
    for _ in 1..args.repeat {
        done = completer.complete_detailed(&rgb, &sparse, &options)?;
    }
    bar.finish_and_clear();
    let scores = match &gt {
        // Where everything was given as input there is nothing to score.
        Some(gt) if gt.points().any(|(x, y, _)| sparse.get(x, y).is_none()) => {
            let score = |depth: &[f32]| errors(depth, gt.as_slice(), &sparse);
            Some((score(done.map.depth())?, score(&interpolate::nearest(&sparse)?)?))
        }
        _ => None,
    };

    std::fs::create_dir_all(&args.out).with_context(|| args.out.display().to_string())?;
    let out = |name: &str| args.out.join(name);
    let scale = inputs.scale.unwrap_or(DepthScale::millimetres());
    let saturation = done.map.write_png16(out("dense.png"), scale)?;
    done.map.write_npy(out("dense.npy"))?;
    done.map.write_confidence_npy(out("confidence.npy"))?;
    preview::write_panel(out("preview.png"), &rgb, &sparse, &done.map, gt.as_ref().map(|g| g.as_slice()))?;

    let (map, s) = (&done.map, &done.seconds);
    let per_second = done.asked as f64 / s.queries.max(1e-9);
    if args.json {
        let mut object = json!({
            "width": map.width(), "height": map.height(), "measured": sparse.measured(),
            "asked": done.asked, "valid": map.valid(), "flagged": done.flagged.len(),
            "seconds": {
                "load": load_seconds, "check": s.check, "encode": s.encode, "prefill": s.prefill,
                "queries": s.queries, "refine": s.refine, "total": s.total, "first_total": first_seconds,
            },
            "queries_per_second": per_second, "peak_rss_bytes": peak_rss_bytes(),
            "device_memory_bytes": device_memory_bytes(&on),
        });
        if let Some((model, nearest)) = &scores {
            for (key, value) in error_json(model).as_object().into_iter().flatten() {
                object[key] = value.clone();
            }
            object["nearest"] = error_json(nearest);
        }
        stdout::print(&object.to_string())?;
        return Ok(());
    }
    let mut lines = vec![format!(
        "{}x{}: {} measured, {} asked, {} of {} pixels valid, in {:.2} s (load {:.2} s, {:.0} queries/s)",
        map.width(),
        map.height(),
        sparse.measured(),
        done.asked,
        map.valid(),
        map.width() * map.height(),
        s.total,
        load_seconds,
        per_second
    )];
    if let Some((model, nearest)) = &scores {
        let [model, nearest] = [model.mae, nearest.mae].map(rounded);
        lines.push(format!("error   MAE {model} m (nearest neighbour {nearest} m)"));
    }
    if !done.flagged.is_empty() {
        let flagged = done.flagged.len();
        lines.push(format!("note    {flagged} measurements contradict those around them and were left out"));
    }
    if saturation.pixels > 0 {
        lines.push(format!(
            "note    {} pixels are beyond the range of dense.png; dense.npy has them",
            saturation.pixels
        ));
    }
    lines.push(format!("wrote   {}", args.out.display()));
    stdout::print(&lines.join("\n"))?;
    Ok(())
}
