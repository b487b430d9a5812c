//! Frames of a data set for records: which of them, in which order, in what size.

use anyhow::{Context, ensure};
use clap::Args;
use rand::seq::SliceRandom;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use sdim::DepthScale;
use sdim::benchmarks::{Dataset, Layout, LayoutOptions};
use sdim::internals::supervise::KnownFrame;
use std::path::{Path, PathBuf};

/// Frames of a data set instead of scenes.
#[derive(Args)]
pub struct DataArgs {
    /// A data set, in its published layout; or a folder with `rgb/` and `gt/`, `sparse/`, or both.
    #[arg(long)]
    data: Option<PathBuf>,
    /// How it is stored: folder, hypersim, virtual-kitti, or another of `evaluate`'s.
    #[arg(long, default_value = "folder", requires = "data")]
    layout: Layout,
    /// Unit of integer depth files of layout folder: mm, kitti, tum or units per metre.
    #[arg(long, requires = "data")]
    depth_scale: Option<DepthScale>,
    /// The frames that this text file names, one per line.
    #[arg(long, requires = "data")]
    frame_list: Option<PathBuf>,
    /// So many of the frames, drawn by --seed.
    #[arg(long, requires = "data", value_name = "FRAMES")]
    sample: Option<usize>,
    /// Write the names of the chosen frames here, in the order of the records.
    #[arg(long, requires = "data", value_name = "FILE")]
    list: Option<PathBuf>,
}

/// The chosen frames of a data set.
pub struct Data {
    set: Box<dyn Dataset>,
    /// In the order of the records, which begins anew when all were taken.
    order: Vec<usize>,
    layout: Layout,
}

impl DataArgs {
    /// Whether frames come from a data set.
    pub fn given(&self) -> bool {
        self.data.is_some()
    }

    /// Whether there is nothing to do but to write the list.
    pub fn lists(&self) -> bool {
        self.list.is_some()
    }

    /// Opens the data set and draws the frames.
    pub fn open(&self, seed: u64) -> anyhow::Result<Option<Data>> {
        let Some(path) = &self.data else { return Ok(None) };
        let mut options = LayoutOptions::default().with_seed(seed);
        if let Some(scale) = self.depth_scale {
            options = options.with_scale(scale);
        }
        if let Some(list) = &self.frame_list {
            options = options.with_frames(list);
        }
        let set = self.layout.open(path, &options)?;
        let mut order: Vec<usize> = (0..set.len()).collect();
        order.shuffle(&mut ChaCha8Rng::seed_from_u64(seed));
        if let Some(count) = self.sample {
            ensure!(count <= set.len(), "--sample {count}: {} has {} frames", path.display(), set.len());
            order.truncate(count);
        }
        let data = Data { set, order, layout: self.layout };
        if let Some(list) = &self.list {
            data.write_list(list, self, seed).with_context(|| list.display().to_string())?;
        }
        Ok(Some(data))
    }
}

impl Data {
    /// Number of chosen frames.
    pub fn len(&self) -> u64 {
        self.order.len() as u64
    }

    /// What tells these frames from others: their names in their order.
    pub fn describe(&self) -> serde_json::Value {
        let mut hash = crc32fast::Hasher::new();
        self.order.iter().for_each(|&index| hash.update(format!("{}\n", self.set.name(index)).as_bytes()));
        let layout = self.layout.name();
        serde_json::json!({"layout": layout, "frames": self.order.len(), "names_crc32": hash.finalize()})
    }

    /// The frame of a number, in the size of the records.
    pub fn frame(&self, number: u64, size: (usize, usize)) -> sdim::Result<KnownFrame> {
        let index = self.order[(number % self.len()) as usize];
        let sample = self.set.load(index)?;
        KnownFrame::resized(sample.name, &sample.rgb, &sample.gt, sample.sparse.as_ref(), size)
    }

    fn write_list(&self, path: &Path, args: &DataArgs, seed: u64) -> anyhow::Result<()> {
        let (chosen, all, layout) = (self.order.len(), self.set.len(), args.layout);
        let mut text = format!("# {chosen} of {all} frames of {layout}, seed {seed}\n");
        for &index in &self.order {
            text += &self.set.name(index);
            text.push('\n');
        }
        Ok(std::fs::write(path, text)?)
    }
}
