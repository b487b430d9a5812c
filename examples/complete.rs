//! Completes one frame.
//!
//! `cargo run --release --example complete` runs on the bundled pair; with `--rgb P --sparse P --depth-scale S` on yours.
//! Writes dense.png (16 bit, the input's scale), dense.npy, confidence.npy (f32) and preview.png into `--out`.
//!
//! From a LiDAR: `--rgb P --cloud C --calib K [--extrinsic E]`. With a camera (`--calib` or `--intrinsics`) normals.png is written, too, and
//! with `--cloud-out F` the map as points.

mod common;
#[path = "common/sensors.rs"]
mod sensors;

use anyhow::Context;
use clap::Parser;
use common::{bundled, load_as, load_options, rounded, stdout};
use indicatif::{ProgressBar, ProgressStyle};
use sdim::calibration::Calibration;
use sdim::depth::{Saturation, interpolate};
use sdim::draw::preview;
use sdim::metrics::{Errors, errors};
use sdim::system::{device_memory_bytes, peak_rss_bytes};
use sdim::{
    CompleteOptions, Completion, DepthScale, Device, Outliers, QueryPlan, Readout, Region, RgbImage,
    SparseDepth, WeightFormat, read_rgb,
};
use sensors::SensorArgs;
use serde_json::{Value, json};
use std::path::{Path, PathBuf};
use std::time::Instant;

#[derive(Parser)]
struct Args {
    /// RGB frame (PNG, JPEG, WebP, BMP or TIFF); without it, the bundled pair.
    #[arg(long, requires = "measurements")]
    rgb: Option<PathBuf>,
    /// Sparse depth of the same size: 16-bit PNG, .npy, .npz (FILE.npz:ARRAY), TIFF or OpenEXR. Integers need --depth-scale, floats are metres.
    #[arg(long, group = "measurements", requires = "rgb")]
    sparse: Option<PathBuf>,
    #[command(flatten)]
    sensors: SensorArgs,
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
    /// Pixels to ask: every, stride:N, budget:N or deadline:MS.
    #[arg(long, default_value_t = Default::default())]
    plan: QueryPlan,
    /// Completes this part of the frame alone.
    #[arg(long, value_name = "X,Y,WIDTH,HEIGHT", value_parser = region)]
    region: Option<Region>,
    /// Leaves out what would be farther than so many metres and is not measured.
    #[arg(long, value_name = "METRES")]
    far_limit: Option<f32>,
    /// What an answer's distribution is read as: median or mean.
    #[arg(long, default_value_t = Default::default())]
    readout: Readout,
    /// What becomes of contradicted measurements: trust, ignore or preserve.
    #[arg(long, default_value_t = Default::default())]
    outliers: Outliers,
    /// cpu, cuda:N or metal.
    #[arg(long, default_value = "cpu")]
    device: String,
    /// Megabytes (2^20 bytes) that a batch of questions may take beside the weights, about; the answers are the same for any number.
    #[arg(long, value_name = "MB")]
    max_memory: Option<usize>,
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
    /// `None` for a cloud.
    sparse: Option<PathBuf>,
    gt: Option<PathBuf>,
    scale: Option<DepthScale>,
}

impl Args {
    fn inputs(&self) -> Inputs {
        match &self.rgb {
            Some(rgb) => Inputs {
                rgb: rgb.clone(),
                sparse: self.sparse.clone(),
                gt: self.gt.clone(),
                scale: self.depth_scale,
            },
            None => Inputs {
                rgb: bundled("rgb.png"),
                sparse: Some(bundled("sparse.png")),
                gt: Some(bundled("gt.png")),
                scale: Some(DepthScale::millimetres()),
            },
        }
    }
}

fn region(text: &str) -> Result<Region, String> {
    let numbers: Vec<usize> = text.split(',').filter_map(|n| n.trim().parse().ok()).collect();
    match numbers[..] {
        [x, y, width, height] if text.split(',').count() == 4 => Ok(Region { x, y, width, height }),
        _ => Err("expected four whole numbers: X,Y,WIDTH,HEIGHT".to_string()),
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
    let device = options.device.clone();
    let completer = load_as(&args.model, &options)?;
    let frame = inputs.read(&args.sensors)?;
    let load_seconds = start.elapsed().as_secs_f64();

    let bar = bar()?;
    let ticker = bar.clone();
    let mut options = CompleteOptions::default()
        .with_plan(args.plan)
        .with_readout(args.readout)
        .with_outliers(args.outliers)
        .with_progress(move |p| {
            ticker.set_length(p.planned as u64);
            ticker.set_position(p.answered as u64);
        });
    (options.region, options.far_limit) = (args.region, args.far_limit);
    if let Some(megabytes) = args.max_memory {
        options = options.with_max_memory(megabytes.saturating_mul(1 << 20));
    }
    let mut done = completer.complete_detailed(&frame.rgb, &frame.sparse, &options)?;
    let first_seconds = done.seconds.total;
    for _ in 1..args.repeat {
        done = completer.complete_detailed(&frame.rgb, &frame.sparse, &options)?;
    }
    bar.finish_and_clear();
    let run = Run { scores: frame.scores(&done)?, frame, done, device, load_seconds, first_seconds };
    let saturation = run.write(&args, inputs.scale.unwrap_or(DepthScale::millimetres()))?;
    let text = match args.json {
        true => run.json().to_string(),
        false => run.summary(&saturation, &args.out),
    };
    stdout::print(&text)?;
    Ok(())
}

/// What is completed.
struct Frame {
    rgb: RgbImage,
    sparse: SparseDepth,
    gt: Option<SparseDepth>,
    calibration: Option<Calibration>,
}

impl Inputs {
    /// The files; depth of another size than the picture's is an error that names its file.
    fn read(&self, sensors: &SensorArgs) -> anyhow::Result<Frame> {
        let rgb = read_rgb(&self.rgb)?;
        let calibration = sensors.calibration(&rgb)?;
        let depth = |path: &Path| {
            let map = SparseDepth::read(path, self.scale)?;
            let sizes = [(map.width(), map.height()), (rgb.width() as usize, rgb.height() as usize)];
            let [depth, picture] = sizes.map(|(w, h)| format!("{w}x{h}"));
            anyhow::ensure!(
                depth == picture,
                "{}: {depth} pixels; expected {picture} as {}",
                path.display(),
                self.rgb.display()
            );
            Ok(map)
        };
        let sparse = match &self.sparse {
            Some(path) => depth(path)?,
            None => sensors.sparse(calibration.as_ref())?,
        };
        let gt = self.gt.as_deref().map(depth).transpose()?;
        Ok(Frame { rgb, sparse, gt, calibration })
    }
}

impl Frame {
    /// Errors of the model and of the nearest neighbour, where there is ground truth beside what was given as input.
    fn scores(&self, done: &Completion) -> anyhow::Result<Option<(Errors, Errors)>> {
        let open = |gt: &&SparseDepth| gt.points().any(|(x, y, _)| self.sparse.get(x, y).is_none());
        let Some(gt) = self.gt.as_ref().filter(open) else { return Ok(None) };
        let score = |depth: &[f32]| errors(depth, gt.as_slice(), &self.sparse);
        Ok(Some((score(done.map.depth())?, score(&interpolate::nearest(&self.sparse)?)?)))
    }
}

/// A completed frame with everything that is said about it.
struct Run {
    frame: Frame,
    done: Completion,
    scores: Option<(Errors, Errors)>,
    device: Device,
    load_seconds: f64,
    first_seconds: f64,
}

impl Run {
    /// Writes maps and preview.
    fn write(&self, args: &Args, scale: DepthScale) -> anyhow::Result<Saturation> {
        let dir = &args.out;
        std::fs::create_dir_all(dir).with_context(|| dir.display().to_string())?;
        let (map, frame) = (&self.done.map, &self.frame);
        let saturation = map.write_png16(dir.join("dense.png"), scale)?;
        map.write_npy(dir.join("dense.npy"))?;
        map.write_confidence_npy(dir.join("confidence.npy"))?;
        let gt = frame.gt.as_ref().map(|g| g.as_slice());
        preview::write_panel(dir.join("preview.png"), &frame.rgb, &frame.sparse, map, gt)?;
        if let Some(calibration) = &frame.calibration {
            args.sensors.write(map, &frame.rgb, &calibration.camera, dir)?;
        }
        Ok(saturation)
    }

    fn queries_per_second(&self) -> f64 {
        self.done.asked as f64 / self.done.seconds.queries.max(1e-9)
    }

    fn json(&self) -> Value {
        let (map, s) = (&self.done.map, &self.done.seconds);
        let mut object = json!({
            "width": map.width(), "height": map.height(), "measured": self.frame.sparse.measured(),
            "asked": self.done.asked, "valid": map.valid(), "flagged": self.done.flagged.len(),
            "seconds": {
                "load": self.load_seconds, "check": s.check, "encode": s.encode, "prefill": s.prefill,
                "queries": s.queries, "refine": s.refine, "total": s.total, "first_total": self.first_seconds,
            },
            "queries_per_second": self.queries_per_second(), "peak_rss_bytes": peak_rss_bytes(),
            "device_memory_bytes": device_memory_bytes(&self.device),
        });
        if let Some((model, nearest)) = &self.scores {
            for (key, value) in error_json(model).as_object().into_iter().flatten() {
                object[key] = value.clone();
            }
            object["nearest"] = error_json(nearest);
        }
        object
    }

    fn summary(&self, saturation: &Saturation, out: &Path) -> String {
        let (map, s) = (&self.done.map, &self.done.seconds);
        let mut lines = vec![format!(
            "{}x{}: {} measured, {} asked, {} of {} pixels valid, in {:.2} s (load {:.2} s, {:.0} queries/s)",
            map.width(),
            map.height(),
            self.frame.sparse.measured(),
            self.done.asked,
            map.valid(),
            map.width() * map.height(),
            s.total,
            self.load_seconds,
            self.queries_per_second()
        )];
        if let Some((model, nearest)) = &self.scores {
            let [model, nearest] = [model.mae, nearest.mae].map(rounded);
            lines.push(format!("error   MAE {model} m (nearest neighbour {nearest} m)"));
        }
        if !self.done.flagged.is_empty() {
            let flagged = self.done.flagged.len();
            lines.push(format!(
                "note    {flagged} measurements contradict those around them and were left out"
            ));
        }
        if saturation.pixels > 0 {
            let pixels = saturation.pixels;
            lines.push(format!(
                "note    {pixels} pixels are beyond the range of dense.png; dense.npy has them"
            ));
        }
        lines.push(format!("wrote   {}", out.display()));
        lines.join("\n")
    }
}
