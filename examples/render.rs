//! Renders procedural RGB-D scenes into the folder layout that `evaluate --data` reads.
//!
//! `cargo run --release --example render -- --out DIR --count N [--seed S] [--width W --height H] [--points P]`

use clap::Parser;
use sdim::DepthScale;
use sdim::benchmarks::{DepthFile, write_frame};
use sdim::depth::io;
use sdim::depth::sample_points;
use sdim::scenes::procedural;
use std::path::PathBuf;

#[derive(Parser)]
struct Args {
    /// Folder to write rgb/, gt/ and perhaps sparse/ into.
    #[arg(long)]
    out: PathBuf,
    /// Scenes.
    #[arg(long, default_value_t = 1)]
    count: u64,
    /// Seed of the first scene.
    #[arg(long, default_value_t = 2_000_000)]
    seed: u64,
    /// Frame width, pixels.
    #[arg(long, default_value_t = 640)]
    width: usize,
    /// Frame height, pixels.
    #[arg(long, default_value_t = 480)]
    height: usize,
    /// Also write this many random measurements per scene as sparse/NAME.png.
    #[arg(long)]
    points: Option<usize>,
}

fn main() -> anyhow::Result<()> {
    let args = Args::parse();
    let scale = DepthScale::millimetres();
    for seed in args.seed..args.seed + args.count {
        let frame = procedural(seed, args.width, args.height)?;
        let name = format!("scene_{seed}");
        write_frame(&args.out, &name, &frame, DepthFile::Png(scale))?;
        if let Some(points) = args.points {
            let sparse = sample_points(&frame.depth, args.width, args.height, points, seed)?;
            let stored: Vec<u16> = sparse.as_slice().iter().map(|&d| scale.stored(d).0).collect();
            let dir = args.out.join("sparse");
            std::fs::create_dir_all(&dir)?;
            io::write_png16(dir.join(format!("{name}.png")), args.width, args.height, &stored)?;
        }
    }
    Ok(())
}
