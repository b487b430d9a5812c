//! Makes the adapter from which a published checkpoint is tuned to answer with one token per number.
//!
//! ```sh
//! number_tokens --model Qwen2.5-VL-3B-Instruct --out my-adapter
//! complete --model Qwen2.5-VL-3B-Instruct --adapter my-adapter --rgb rgb.png --sparse sparse.png --depth-scale mm
//! ```
//!
//! `sdim.json` says how the checkpoint is asked: a pointer with a hint asks, measurements stand in the prefix, and both are number tokens as the
//! answer is. `sdim.safetensors` holds their rows, which start among those of the digits; nothing of the checkpoint is copied or changed. Its
//! answers are noise until it was tuned.

use anyhow::{Context, ensure};
use clap::Parser;
use sdim::Adapter;
use sdim::settings::{NumberFormat, NumberTokens, PixelReference, RopeLayout, Settings};
use std::path::PathBuf;

/// Writes an adapter with number tokens for a published checkpoint.
#[derive(Parser)]
struct Args {
    /// Checkpoint directory, as published.
    #[arg(long)]
    model: PathBuf,
    /// Directory of the adapter.
    #[arg(long)]
    out: PathBuf,
    /// `sdim.json` of another way of asking; its numbers must be bins.
    #[arg(long)]
    settings: Option<PathBuf>,
    /// Number tokens.
    #[arg(long, default_value_t = 1000, conflicts_with = "settings")]
    bins: usize,
    /// Lower end of the first bin, in medians of a frame's measurements.
    #[arg(long, default_value_t = 0.0625, conflicts_with = "settings")]
    lowest: f64,
    /// Upper end of the last bin, in medians of a frame's measurements.
    #[arg(long, default_value_t = 16.0, conflicts_with = "settings")]
    highest: f64,
    /// A token of the checkpoint's vocabulary that asks where there is no hint.
    #[arg(long, default_value = "<|box_start|>", conflicts_with = "settings")]
    pointer: String,
    /// Seed of what tells the rows apart.
    #[arg(long, default_value_t = 7)]
    seed: u64,
}

impl Args {
    fn asking(&self) -> anyhow::Result<Settings> {
        let settings = match &self.settings {
            Some(path) => Settings::from_file(path)?,
            None => Settings {
                // As published; the fusion block and the crops would have to be trained first.
                rope_layout: RopeLayout::Contiguous,
                position_scale: 1.0,
                fusion: None,
                glimpse: None,
                wide_glimpse: None,
                pixel_reference: PixelReference::Pointer { token: self.pointer.clone() },
                number: NumberFormat::LogBins { bins: self.bins, lowest: self.lowest, highest: self.highest },
                ..Settings::tiny()
            },
        };
        let bins = !matches!(settings.number, NumberFormat::Digits { .. });
        ensure!(bins, "--settings: numbers are digits, which need no tokens");
        Ok(Settings { number_tokens: NumberTokens::Rows, ..settings })
    }
}

fn main() -> anyhow::Result<()> {
    let args = Args::parse();
    let adapter = Adapter::starting(&args.model, args.asking()?, args.seed)?;
    adapter.save(&args.out).with_context(|| args.out.display().to_string())?;
    for (name, tensor) in &adapter.tensors {
        println!("{name} {:?}", tensor.dims());
    }
    Ok(())
}
