//! Renders RGB-D scenes into the folder layout that `evaluate --data` reads, or as a sheet to look at.
//!
//! `cargo run --release --example render -- --out DIR --count N [--recipe RECIPE] [--library DIR] [--seed S] [--width W]
//! [--height H] [--points P | --rings R | --rig SEED] [--sheet FILE]`
//!
//! Recipes: `procedural` (the default), `furnished` (rooms of the models in `--library`, see `scripts/furniture.sh`),
//! `street-lidar` (streets from a car, to be measured with `--rings`), `glazed` (rooms behind panes, which a sensor mostly sees
//! through; a sheet has the sensor's map as a third picture) and `training` (what models are trained on: frames of `--mix` with
//! the measurements that are told, bad ones among them). `--rig SEED` is a camera and a sensor of that seed: their colours, noise
//! and pattern in every frame, the clean depth as ground truth.

mod sheet;

use anyhow::{Context, bail};
use clap::{Parser, ValueEnum};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use sdim::depth::{io, sample_points};
use sdim::internals::benchmarks::{DepthFile, write_frame};
use sdim::internals::scenes::furnished::{Library, Split, furnished};
use sdim::internals::scenes::{RgbdFrame, Rig, SpinningLidar, glazed, procedural, street};
use sdim::internals::supervise::{self, BatchConfig, SceneMix, Scenes, mix, told_and_asked, training_seed};
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
    /// Shares of the scenes of `--recipe training`: procedural, furnished, streets and glazed, NAME=SHARE,...
    #[arg(long, default_value = "procedural=1")]
    mix: SceneMix,
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
    /// Also write what the depth sensor of this seed measures, and the pictures as the camera beside it takes them.
    #[arg(long, value_name = "SEED", conflicts_with_all = ["points", "rings"])]
    rig: Option<u64>,
}

#[derive(Clone, Copy, PartialEq, ValueEnum)]
enum Recipe {
    Procedural,
    Furnished,
    StreetLidar,
    Glazed,
    Training,
}

#[derive(Clone, Copy, ValueEnum)]
enum Part {
    All,
    Train,
    HeldOut,
}

impl Args {
    fn library(&self) -> anyhow::Result<Option<Library>> {
        let furnished = [Recipe::Furnished, Recipe::Training].contains(&self.recipe);
        let Some(dir) = self.library.as_ref().filter(|_| furnished) else { return Ok(None) };
        let split = match self.split {
            Part::All => Split::All,
            Part::Train => Split::Train,
            Part::HeldOut => Split::HeldOut,
        };
        Ok(Some(Library::open(dir)?.part(split)?))
    }

    /// A frame and its measurements.
    fn made(&self, library: Option<&Library>, seed: u64) -> anyhow::Result<(RgbdFrame, Option<SparseDepth>)> {
        if self.recipe != Recipe::Training {
            let mut frame = self.frame(library, seed)?;
            if let Some(rig) = self.rig {
                let (picture, measured) = Rig::draw(rig).take(&frame, seed)?;
                frame.rgb = picture;
                return Ok((frame, Some(measured)));
            }
            let measured = self.measured(&frame, seed)?;
            return Ok((frame, measured));
        }
        let mut scenes = Scenes::new(self.mix);
        if let Some(library) = library {
            scenes = scenes.with_library(library, false)?;
        }
        scenes.check(false).context("--mix")?;
        let mut frame = supervise::frame(&scenes, training_seed(mix(seed, 0)), (self.width, self.height))?;
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let (told, _) = told_and_asked(&mut frame, &BatchConfig::default(), None, &mut rng)?;
        Ok((frame, Some(told)))
    }

    fn frame(&self, library: Option<&Library>, seed: u64) -> anyhow::Result<RgbdFrame> {
        Ok(match self.recipe {
            Recipe::Training => bail!("--recipe training: made with its measurements"),
            Recipe::Procedural => procedural(seed, self.width, self.height)?,
            Recipe::StreetLidar => street(seed, self.width, self.height)?,
            Recipe::Glazed => glazed(seed, self.width, self.height)?,
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
            return Ok(Some(lidar.scan(frame.sensed(), w, h, &frame.intrinsics, &mut rng)?));
        }
        Ok(self.points.map(|n| sample_points(frame.sensed(), w, h, n, seed)).transpose()?)
    }
}

fn main() -> anyhow::Result<()> {
    let args = Args::parse();
    let scale = DepthScale::millimetres();
    let library = args.library()?;
    let pictures = if args.recipe == Recipe::Glazed { 3 } else { 2 };
    let new_sheet = |_| sheet::Sheet::new(args.count, args.width, args.height, pictures);
    let mut sheet = args.sheet.as_ref().map(new_sheet);
    for seed in args.seed..args.seed + args.count {
        let (frame, measured) = args.made(library.as_ref(), seed)?;
        if let Some(sheet) = &mut sheet {
            sheet.add(&frame, measured.as_ref())?;
        }
        let Some(out) = &args.out else { continue };
        let name = format!("scene_{seed}");
        // A rig's noise would drown in the millimetres of a small scene.
        let store = if args.rig.is_some() { DepthFile::Npy } else { DepthFile::Png(scale) };
        write_frame(out, &name, &frame, store)?;
        if let Some(sparse) = measured {
            let dir = out.join("sparse");
            std::fs::create_dir_all(&dir)?;
            if args.rig.is_some() {
                let path = dir.join(format!("{name}.npy"));
                io::write_npy(path, args.width, args.height, sparse.as_slice())?;
                continue;
            }
            let stored: Vec<u16> = sparse.as_slice().iter().map(|&d| scale.stored(d).0).collect();
            io::write_png16(dir.join(format!("{name}.png")), args.width, args.height, &stored)?;
        }
    }
    if let (Some(sheet), Some(path)) = (sheet, &args.sheet) {
        sheet.write(path)?;
    }
    Ok(())
}
