//! A stream of frames from a moving camera against the same frames one by one: frames per second, questions, errors, flicker, memory.
//!
//! `cargo run --release --example stream` renders a procedural scene along a camera's way and completes each frame twice, alone and as the next
//! one of a stream with poses, in turns, so that both see the same machine. `--no-poses` keeps the poses from the stream.

mod common;

use anyhow::Context;
use clap::Parser;
use common::{load_as, load_options, rounded, stdout};
use sdim::depth::sample_points;
use sdim::internals::scenes::{RgbdFrame, Scene};
use sdim::{
    Camera, CompleteOptions, Completion, DepthMap, Distortion, QueryPlan, SparseDepth, Stream, StreamOptions,
    Transform, metrics, system,
};
use serde_json::json;
use std::f64::consts::TAU;
use std::time::Instant;

#[derive(Parser)]
struct Args {
    /// `tiny` (inside the crate) or a checkpoint directory.
    #[arg(long, default_value = "tiny")]
    model: String,
    /// Pixels to ask in a frame alone: every, stride:N or budget:N.
    #[arg(long, default_value = "stride:4")]
    plan: QueryPlan,
    /// Frames of each scene.
    #[arg(long, default_value_t = 300)]
    frames: usize,
    /// How many scenes.
    #[arg(long, default_value_t = 1)]
    scenes: u64,
    /// Seed of the first scene.
    #[arg(long, default_value_t = 5_000_000)]
    seed: u64,
    #[arg(long, default_value_t = 320)]
    width: usize,
    #[arg(long, default_value_t = 240)]
    height: usize,
    /// Measurements in a frame, at other pixels in each.
    #[arg(long, default_value_t = 300)]
    points: usize,
    /// How fast the camera moves; 1 is a robot indoors at 30 frames per second, 0 stands still.
    #[arg(long, default_value_t = 1.0)]
    speed: f64,
    /// Frames after which an answer counts half.
    #[arg(long)]
    half_life: Option<f32>,
    /// Frames in a row that may be made of the last map alone; 0 to ask about each frame.
    #[arg(long)]
    rest: Option<usize>,
    /// Does not tell the stream where the camera is.
    #[arg(long)]
    no_poses: bool,
    /// One JSON object on stdout instead of the summary.
    #[arg(long)]
    json: bool,
}

/// Where the camera is in a frame, in the axes of the scene's first camera. Lengths are relative to the scene's `depth`, metres.
fn pose(frame: f64, depth: f64, speed: f64) -> sdim::Result<Transform> {
    let wave = |size: f64, period: f64| size * (TAU * frame * speed / period).sin();
    let (yaw, pitch) = (wave(0.2, 140.0), wave(0.05, 100.0));
    let place = [wave(0.12, 120.0), wave(0.04, 90.0), wave(0.1, 170.0)].map(|c| c * depth);
    let turn = Transform::from_quaternion([0.0, (0.5 * yaw).sin(), 0.0, (0.5 * yaw).cos()], place)?;
    let nod = Transform::from_quaternion([(0.5 * pitch).sin(), 0.0, 0.0, (0.5 * pitch).cos()], [0.0; 3])?;
    Ok(nod.then(&turn))
}

/// What is added up of one way of completing.
#[derive(Default)]
struct Sums {
    seconds: f64,
    asked: usize,
    /// Frames without a question.
    rested: usize,
    /// Seconds of the stages that a frame alone has, too; what is left of the time is the moving of the last map.
    stages: [f64; 5],
    error: f64,
    /// Mean changes of static pixels, metres.
    flicker: Vec<f64>,
    before: Option<DepthMap>,
}

impl Sums {
    fn add(
        &mut self,
        done: Completion,
        frame: &RgbdFrame,
        sparse: &SparseDepth,
        pairs: &[Pair],
    ) -> sdim::Result<()> {
        self.asked += done.asked;
        self.rested += usize::from(done.asked == 0);
        let s = &done.seconds;
        for (sum, seconds) in self.stages.iter_mut().zip([s.check, s.encode, s.prefill, s.queries, s.refine])
        {
            *sum += seconds;
        }
        self.error += f64::from(metrics::errors(done.map.depth(), &frame.depth, sparse)?.mae as f32);
        if let Some(before) = self.before.as_ref().filter(|_| !pairs.is_empty()) {
            let change = |p: &Pair| {
                let moved = f64::from(before.depth()[p.from]) * p.scale + p.shift;
                (f64::from(done.map.depth()[p.to]) - moved).abs()
            };
            let changes = pairs.iter().map(change).filter(|c| c.is_finite());
            self.flicker.push(changes.sum::<f64>() / pairs.len() as f64);
        }
        self.before = Some(done.map);
        Ok(())
    }
}

const STAGES: [&str; 5] = ["check", "encode", "prefill", "questions", "refine"];

/// A point that is seen in two frames: its pixels, and how a depth at the one becomes a depth at the other.
struct Pair {
    from: usize,
    to: usize,
    scale: f64,
    shift: f64,
}

/// Points of the frame before that are seen again.
fn pairs(before: &[f32], now: &[f32], camera: &Camera, motion: &Transform) -> Vec<Pair> {
    let width = camera.width();
    let pair = |from: usize| {
        let ray = camera.ray((from % width) as f32, (from / width) as f32)?;
        let point = motion.apply(ray.map(|c| c * before[from]));
        let (x, y) = camera.pixel(point)?;
        let to = y * width + x;
        let row = motion.rows()[2];
        let scale: f64 = row.iter().zip(ray).map(|(r, c)| r * f64::from(c)).sum();
        ((now[to] / point[2]).ln().abs() < 0.01).then_some(Pair { from, to, scale, shift: row[3] })
    };
    (0..before.len()).filter_map(pair).collect()
}

/// What is measured beside the completing.
#[derive(Default)]
struct Around {
    /// Seconds for rendering the frames.
    rendering: f64,
    /// The most memory that was held after a tenth of the frames.
    early: Option<u64>,
}

/// Completes the frames of one scene, in both ways.
fn run(args: &Args, seed: u64, sums: &mut [Sums; 2], around: &mut Around) -> anyhow::Result<()> {
    let completer = load_as(&args.model, &load_options("cpu", None, None)?)?;
    let complete = CompleteOptions::default().with_plan(args.plan);
    let scene = Scene::procedural(seed, args.width, args.height)?;
    let camera = Camera::new(args.width, args.height, scene.intrinsics(), Distortion::None)?;
    let mut options = StreamOptions::default().with_complete(complete.clone()).with_camera(camera);
    options.half_life = args.half_life.unwrap_or(options.half_life);
    options.rest = args.rest.unwrap_or(options.rest);
    let mut stream = Stream::new(completer.clone(), options)?;
    let mut depths: Vec<f32> = scene.render(&Transform::identity()).depth;
    depths.retain(|d| d.is_finite());
    depths.sort_by(f32::total_cmp);
    let typical = f64::from(*depths.get(depths.len() / 2).context("the scene is empty")?);
    let mut before: Option<(Vec<f32>, Transform)> = None;
    sums.iter_mut().for_each(|s| s.before = None);
    for i in 0..args.frames {
        let pose = pose(i as f64, typical, args.speed)?;
        let start = Instant::now();
        let frame = scene.render(&pose);
        around.rendering += start.elapsed().as_secs_f64();
        let sparse = sample_points(&frame.depth, args.width, args.height, args.points, seed + i as u64)?;
        let seen = match &before {
            Some((depth, last)) => pairs(depth, &frame.depth, &camera, &last.then(&pose.inverse())),
            None => Vec::new(),
        };
        for way in [i % 2, 1 - i % 2] {
            let start = Instant::now();
            let done = match way {
                0 => completer.complete_detailed(&frame.rgb, &sparse, &complete)?,
                _ => stream.push(&frame.rgb, &sparse, Some(&pose).filter(|_| !args.no_poses))?,
            };
            sums[way].seconds += start.elapsed().as_secs_f64();
            sums[way].add(done, &frame, &sparse, &seen)?;
        }
        before = Some((frame.depth, pose));
        if i == args.frames / 10 && around.early.is_none() {
            around.early = system::peak_rss_bytes();
        }
    }
    Ok(())
}

fn main() -> anyhow::Result<()> {
    let args = Args::parse();
    anyhow::ensure!(args.frames > 0 && args.scenes > 0, "--frames and --scenes must be at least 1");
    let mut sums = <[Sums; 2]>::default();
    let mut around = Around::default();
    for seed in args.seed..args.seed + args.scenes {
        run(&args, seed, &mut sums, &mut around)?;
    }
    let late = system::peak_rss_bytes();
    let n = args.frames as f64 * args.scenes as f64;
    let mean = |values: &[f64]| values.iter().sum::<f64>() / values.len().max(1) as f64;
    let row = |s: &Sums| [n / s.seconds, s.asked as f64 / n, s.error / n, mean(&s.flicker)];
    let (early, rendering, rested) = (around.early, around.rendering, sums[1].rested);
    let [single, stream] = [row(&sums[0]), row(&sums[1])];
    let text = if args.json {
        let object = |[rate, asked, mae, flicker]: [f64; 4], s: &Sums| {
            let stages: serde_json::Map<_, _> =
                STAGES.iter().zip(s.stages).map(|(k, v)| (k.to_string(), json!(v / n))).collect();
            json!({ "frames_per_second": rate, "asked": asked, "mae": mae, "flicker": flicker, "seconds": stages })
        };
        json!({
            "frames": n, "single": object(single, &sums[0]), "stream": object(stream, &sums[1]),
            "without_questions": rested,
            "rendering_s": rendering,
            "peak_bytes_early": early, "peak_bytes": late,
        })
        .to_string()
    } else {
        let line = |name: &str, [rate, asked, mae, flicker]: [f64; 4]| {
            let (mae, flicker) = (rounded(mae), rounded(flicker));
            format!("{name} {rate:6.2} frames/s  {asked:6.0} questions  MAE {mae} m  flicker {flicker} m\n")
        };
        let stages = |name: &str, s: &Sums| {
            let parts = STAGES.iter().zip(s.stages).map(|(k, v)| format!("{k} {:.1}", 1e3 * v / n));
            let all = parts.collect::<Vec<_>>().join(", ");
            format!("{name} milliseconds of a frame: {all}, in all {:.1}\n", 1e3 * s.seconds / n)
        };
        let ratio = |i: usize| stream[i] / single[i];
        let mib = |bytes: Option<u64>| bytes.map_or("unknown".into(), |b| format!("{} MiB", b >> 20));
        format!(
            "{}{}{}{}ratio  {:6.2}          {:6.2}            {:.3}          {:.3}\n\
             {rested} of {n} frames of the stream without a question\n\
             memory {} at most after a tenth of the frames, {} in the end; rendering took {rendering:.1} s",
            line("single", single),
            line("stream", stream),
            stages("single", &sums[0]),
            stages("stream", &sums[1]),
            ratio(0),
            ratio(1),
            ratio(2),
            ratio(3),
            mib(early),
            mib(late)
        )
    };
    stdout::print(&text)?;
    Ok(())
}
