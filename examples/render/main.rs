//! Renders RGB-D scenes into the folder layout that `evaluate --data` reads, or as a sheet to look at.
//!
//! `cargo run --release --example render -- --out DIR --count N [--recipe RECIPE] [--library DIR] [--seed S] [--width W]
//! [--height H] [--points P | --rings R] [--sheet FILE]`
//!
//! Recipes: `procedural` (the default), `furnished` (rooms of the models in `--library`, see `scripts/furniture.sh`) and
//! `street-lidar` (streets from a car, to be measured with `--rings`).

mod sheet;

use anyhow::Context;
use clap::{Parser, ValueEnum};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use sdim::benchmarks::{DepthFile, write_frame};
use sdim::depth::{io, sample_points};
use sdim::scenes::furnished::{Library, Split, furnished};
use sdim::scenes::{RgbdFrame, SpinningLidar, procedural, street};
use sdim::{DepthScale, SparseDepth};
use std::path::PathBuf;

#[derive(Parser)]
struct Args {
    /// Folder to write rgb/, gt/ and perhaps sparse/ into.
    #[arg(long, required_unless_present = "sheet")]
    out: Option<PathBuf>,
    /// A picture of all frames and their depth beside each other, PNG or JPEG.
    #[arg(long)]
    sheet: Option<PathBuf>,
    /// What is rendered.
    #[arg(long, value_enum, default_value_t = Recipe::Procedural)]
    recipe: Recipe,
    /// Folder of furniture, as it was installed or packed.
    #[arg(long, required_if_eq("recipe", "furnished"))]
    library: Option<PathBuf>,
    /// Which models and rooms.
    #[arg(long, value_enum, default_value_t = Part::All)]
    split: Part,
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
    #[arg(long, conflicts_with = "rings")]
    points: Option<usize>,
    /// Also write what a LiDAR of 16, 32 or 64 rings beside the camera measures.
    #[arg(long)]
    rings: Option<usize>,
}

#[derive(Clone, Copy, PartialEq, ValueEnum)]
enum Recipe {
    Procedural,
    Furnished,
    StreetLidar,
}

#[derive(Clone, Copy, ValueEnum)]
enum Part {
    All,
    Train,
    HeldOut,
}

impl Args {
    fn library(&self) -> anyhow::Result<Option<Library>> {
        let Some(dir) = self.library.as_ref().filter(|_| self.recipe == Recipe::Furnished) else {
            return Ok(None);
        };
        let split = match self.split {
            Part::All => Split::All,
            Part::Train => Split::Train,
            Part::HeldOut => Split::HeldOut,
        };
        Ok(Some(Library::open(dir)?.part(split)?))
    }

    fn frame(&self, library: Option<&Library>, seed: u64) -> anyhow::Result<RgbdFrame> {
        Ok(match self.recipe {
            Recipe::Procedural => procedural(seed, self.width, self.height)?,
            Recipe::StreetLidar => street(seed, self.width, self.height)?,
            Recipe::Furnished => {
                let library = library.context("--recipe furnished: expected --library DIR")?;
                furnished(library, seed, self.width, self.height)?
            }
        })
    }

    fn measured(&self, frame: &RgbdFrame, seed: u64) -> anyhow::Result<Option<SparseDepth>> {
        let (w, h) = (self.width, self.height);
        if let Some(rings) = self.rings {
            let mut rng = ChaCha8Rng::seed_from_u64(seed);
            let lidar = SpinningLidar::rings(rings)?.mounted(&mut rng);
            return Ok(Some(lidar.scan(&frame.depth, w, h, &frame.intrinsics, &mut rng)?));
        }
        Ok(self.points.map(|n| sample_points(&frame.depth, w, h, n, seed)).transpose()?)
    }
}

fn main() -> anyhow::Result<()> {
    let args = Args::parse();
    let scale = DepthScale::millimetres();
    let library = args.library()?;
    let mut sheet = args.sheet.as_ref().map(|_| sheet::Sheet::new(args.count, args.width, args.height));
    for seed in args.seed..args.seed + args.count {
        let frame = args.frame(library.as_ref(), seed)?;
        let measured = args.measured(&frame, seed)?;
        if let Some(sheet) = &mut sheet {
            sheet.add(&frame, measured.as_ref())?;
        }
        let Some(out) = &args.out else { continue };
        let name = format!("scene_{seed}");
        write_frame(out, &name, &frame, DepthFile::Png(scale))?;
        if let Some(sparse) = measured {
            let stored: Vec<u16> = sparse.as_slice().iter().map(|&d| scale.stored(d).0).collect();
            let dir = out.join("sparse");
            std::fs::create_dir_all(&dir)?;
            io::write_png16(dir.join(format!("{name}.png")), args.width, args.height, &stored)?;
        }
    }
    if let (Some(sheet), Some(path)) = (sheet, &args.sheet) {
        sheet.write(path)?;
    }
    Ok(())
}
