//! Where frames come from.

use crate::Args;
use sdim::benchmarks::{Dataset, LayoutOptions, Sample};
use sdim::scenes::procedural;

/// Seeds from here on are never drawn in training with the default configuration.
const HELD_OUT: u64 = 2_000_000;

/// Opens the data set that the arguments name.
pub fn open(args: &Args) -> anyhow::Result<Box<dyn Dataset>> {
    match (&args.data, args.procedural) {
        (Some(dir), _) => {
            let mut options = LayoutOptions::default().with_seed(args.seed);
            (options.scale, options.range) = (args.depth_scale, args.range);
            options.frames = args.frame_list.clone();
            Ok(args.layout.open(dir, &options)?)
        }
        (None, Some(0) | None) => anyhow::bail!("--procedural 0: expected at least 1 scene"),
        (None, Some(count)) => Ok(Box::new(Procedural(count))),
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
        let frame = procedural(HELD_OUT + index as u64, 320, 240)?;
        Ok(Sample {
            name: self.name(index),
            rgb: frame.rgb,
            gt: frame.depth,
            sparse: None,
            masks: Vec::new(),
        })
    }
}
