//! What a node on a robot does with a frame: messages in, completion, messages out.
//!
//! `cargo run --release --example robot` makes the messages of the bundled frame, as the drivers of a camera and of a LiDAR 8 cm above it would
//! publish them, and completes it. In a node of yours, `Messages` comes from three subscriptions and tf, and `answer` is the callback.

mod common;

use anyhow::ensure;
use clap::Parser;
use common::{bundled, load_as, load_options, rounded, stdout};
use sdim::cloud::{CloudOptions, PointCloud};
use sdim::depth::{ProjectionReport, Visibility};
use sdim::messages::{CameraInfo, Image, PointCloud2, PointField};
use sdim::{
    Camera, CompleteOptions, DepthCompleter, DepthScale, Distortion, Intrinsics, QueryPlan, SparseDepth,
    Transform, metrics, read_rgb,
};
use serde_json::json;
use std::time::Instant;

#[derive(Parser)]
struct Args {
    /// `tiny` (inside the crate) or a checkpoint directory.
    #[arg(long, default_value = "tiny")]
    model: String,
    /// Pixels to ask: every, stride:N, budget:N or deadline:MS.
    #[arg(long, default_value = "stride:8")]
    plan: QueryPlan,
    /// Points with less confidence are not published.
    #[arg(long, default_value_t = 0.3)]
    min_confidence: f32,
    /// One JSON object on stdout instead of the summary.
    #[arg(long)]
    json: bool,
}

/// What a node receives.
struct Messages {
    picture: Image,
    info: CameraInfo,
    cloud: PointCloud2,
    /// From tf: target the camera's optical frame, source the cloud's frame.
    lidar_to_camera: Transform,
}

/// What it publishes.
struct Answer {
    cloud: PointCloud2,
    depth: Image,
    projected: ProjectionReport,
}

fn answer(
    messages: &Messages,
    completer: &DepthCompleter,
    options: &CompleteOptions,
    min_confidence: f32,
) -> sdim::Result<Answer> {
    let rgb = messages.picture.to_rgb()?;
    let camera = messages.info.to_camera()?;
    let points = messages.cloud.points()?;
    let (sparse, projected) =
        SparseDepth::from_cloud(points, &camera, &messages.lidar_to_camera, &Visibility::default())?;
    let map = completer.complete(&rgb, &sparse, options)?;
    let sure = CloudOptions::default().with_min_confidence(min_confidence);
    let cloud = PointCloud2::from_cloud(&PointCloud::from_map(&map, Some(&rgb), &camera, &sure)?)?;
    Ok(Answer { cloud, depth: Image::from_depth(&map), projected })
}

/// The bundled frame as drivers publish such: the picture as bgr8 with padded rows, the calibration, the measurements as a cloud in the
/// LiDAR's axes (x forward, y left, z up).
fn publish() -> anyhow::Result<Messages> {
    let rgb = read_rgb(bundled("rgb.png"))?;
    let (width, height) = rgb.dimensions();
    let step = width * 3 + 64;
    let mut data = Vec::new();
    for row in rgb.as_raw().chunks((width * 3) as usize) {
        data.extend(row.chunks(3).flat_map(|p| [p[2], p[1], p[0]]));
        data.resize(data.len() + 64, 0);
    }
    let picture = Image { height, width, encoding: "bgr8".into(), is_bigendian: 0, step, data };

    let sparse = SparseDepth::read(bundled("sparse.png"), Some(DepthScale::millimetres()))?;
    let k = Intrinsics::from_fov(sparse.width(), sparse.height(), 1.1);
    let camera = Camera::new(sparse.width(), sparse.height(), k, Distortion::PlumbBob([0.0; 5]))?;
    let lidar_to_camera =
        Transform::from_rows([[0.0, -1.0, 0.0, 0.0], [0.0, 0.0, -1.0, -0.08], [1.0, 0.0, 0.0, 0.0]])?;
    let camera_to_lidar = lidar_to_camera.inverse();
    let seen = |(x, y, d): (usize, usize, f32)| {
        let ray = camera.ray(x as f32, y as f32)?;
        Some(camera_to_lidar.apply(ray.map(|c| c * d)))
    };
    let points: Vec<[f32; 3]> = sparse.points().filter_map(seen).collect();
    let (width, row_step) = (points.len() as u32, 12 * points.len() as u32);
    let cloud = PointCloud2 {
        height: 1,
        width,
        fields: ["x", "y", "z"].into_iter().zip([0, 4, 8]).map(|(n, o)| PointField::float32(n, o)).collect(),
        is_bigendian: false,
        point_step: 12,
        row_step,
        data: points.iter().flatten().flat_map(|c| c.to_le_bytes()).collect(),
        is_dense: true,
    };
    Ok(Messages { picture, info: CameraInfo::from_camera(&camera), cloud, lidar_to_camera })
}

fn main() -> anyhow::Result<()> {
    let args = Args::parse();
    let completer = load_as(&args.model, &load_options("cpu", None, None)?)?;
    let options = CompleteOptions::default().with_plan(args.plan);
    let messages = publish()?;

    let start = Instant::now();
    let answer = answer(&messages, &completer, &options, args.min_confidence)?;
    let seconds = start.elapsed().as_secs_f64();

    let truth = SparseDepth::read(bundled("gt.png"), Some(DepthScale::millimetres()))?;
    let given = SparseDepth::read(bundled("sparse.png"), Some(DepthScale::millimetres()))?;
    let depth = answer.depth.to_depth(None)?;
    ensure!(depth.measured() > 0, "the published depth image is empty");
    let mae = metrics::errors(depth.as_slice(), truth.as_slice(), &given)?.mae;
    let Answer { cloud, projected, .. } = &answer;
    let text = if args.json {
        json!({
            "points_in": projected.points, "measured": projected.measured, "hidden": projected.hidden,
            "points_out": cloud.width, "point_step": cloud.point_step, "mae": mae, "seconds": seconds,
        })
        .to_string()
    } else {
        format!(
            "in      {}x{} {}; {projected}\nout     {} points of {} bytes and a depth image as {}, in {seconds:.2} s\nerror   MAE {} m",
            messages.picture.width,
            messages.picture.height,
            messages.picture.encoding,
            cloud.width,
            cloud.point_step,
            answer.depth.encoding,
            rounded(mae)
        )
    };
    stdout::print(&text)?;
    Ok(())
}
