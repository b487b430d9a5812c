//! Where frames come from.

use crate::Args;
use crate::common::HELD_OUT;
use crate::settings::Fnv;
use anyhow::Context;
use sdim::benchmarks::{Dataset, LayoutOptions, Sample};
use sdim::internals::scenes::furnished::{Library, Split, furnished};
use sdim::internals::scenes::{RgbdFrame, procedural};
use std::path::Path;

/// Opens the data set that the arguments name.
pub fn open(args: &Args) -> anyhow::Result<Box<dyn Dataset>> {
    match (&args.data, args.procedural, args.furnished) {
        (Some(dir), ..) => {
            let mut options = LayoutOptions::default().with_seed(args.seed);
            (options.scale, options.range) = (args.depth_scale, args.range);
            options.frames = args.frame_list.clone();
            Ok(args.layout.open(dir, &options)?)
        }
        (None, Some(count), _) if count > 0 => Ok(Box::new(Procedural(count))),
        (None, None, Some(count)) if count > 0 => {
            let dir = args.library.as_deref().context("--furnished: expected --library DIR")?;
            Ok(Box::new(Furnished::open(dir, count)?))
        }
        _ => anyhow::bail!("--procedural 0 or --furnished 0: expected at least 1 scene"),
    }
}

/// How many frames are asked for.
pub fn count(args: &Args, frames: &dyn Dataset) -> anyhow::Result<usize> {
    let count = frames.len().min(args.limit.unwrap_or(usize::MAX));
    anyhow::ensure!(count > 0, "--limit 0: expected at least 1 frame");
    Ok(count)
}

/// Whether all of them bring their measurements.
pub fn all_own(args: &Args, frames: &dyn Dataset) -> anyhow::Result<bool> {
    Ok((0..count(args, frames)?).all(|i| frames.has_measurements(i)))
}

/// Scenes that training never saw.
struct Procedural(usize);

impl Dataset for Procedural {
    fn len(&self) -> usize {
        self.0
    }

    fn name(&self, index: usize) -> String {
        format!("scene-{index}")
    }

    fn has_measurements(&self, _: usize) -> bool {
        false
    }

    fn load(&self, index: usize) -> sdim::Result<Sample> {
        Ok(sample(self.name(index), procedural(HELD_OUT + index as u64, 320, 240)?))
    }
}

/// Rooms and models that training never saw.
struct Furnished {
    library: Library,
    count: usize,
    /// A number made from the models' ids: another library gives other rooms.
    print: String,
}

impl Furnished {
    fn open(dir: &Path, count: usize) -> anyhow::Result<Self> {
        let library = Library::open(dir)?.part(Split::HeldOut)?;
        let mut print = Fnv::default();
        library.models().iter().for_each(|m| print.add(format!("{} {}", m.id, m.triangles).as_bytes()));
        Ok(Self { library, count, print: print.text() })
    }
}

impl Dataset for Furnished {
    fn len(&self) -> usize {
        self.count
    }

    fn name(&self, index: usize) -> String {
        format!("room-{}-{index}", self.print)
    }

    fn has_measurements(&self, _: usize) -> bool {
        false
    }

    fn load(&self, index: usize) -> sdim::Result<Sample> {
        Ok(sample(self.name(index), furnished(&self.library, HELD_OUT + index as u64, 320, 240)?))
    }
}

fn sample(name: String, frame: RgbdFrame) -> Sample {
    Sample { name, rgb: frame.rgb, gt: frame.depth, sparse: None, masks: Vec::new() }
}
