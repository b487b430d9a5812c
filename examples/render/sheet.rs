//! Frames and their depth beside each other in one picture.

use anyhow::Context;
use image::{Rgb, RgbImage, imageops};
use sdim::SparseDepth;
use sdim::draw::colour::{depth_range, depth_to_rgb};
use sdim::internals::scenes::RgbdFrame;
use std::path::Path;

/// Pairs of a frame and its depth in a row.
const COLUMNS: u32 = 4;

pub struct Sheet {
    image: RgbImage,
    cell: (u32, u32),
    next: u32,
}

impl Sheet {
    pub fn new(count: u64, width: usize, height: usize) -> Self {
        let (cell, rows) = ((2 * width as u32, height as u32), (count as u32).div_ceil(COLUMNS));
        Self { image: RgbImage::new(COLUMNS * cell.0, rows * cell.1), cell, next: 0 }
    }

    /// Adds a frame; measurements are drawn white on its depth.
    pub fn add(&mut self, frame: &RgbdFrame, measured: Option<&SparseDepth>) -> anyhow::Result<()> {
        let (w, h) = (frame.width(), frame.height());
        let (near, far) = depth_range(&frame.depth).unwrap_or((0.0, 1.0));
        let mut depth = depth_to_rgb(&frame.depth, w, h, near, far)?;
        for (x, y, _) in measured.into_iter().flat_map(SparseDepth::points) {
            depth.put_pixel(x as u32, y as u32, Rgb([255; 3]));
        }
        let (x, y) = (self.next % COLUMNS * self.cell.0, self.next / COLUMNS * self.cell.1);
        imageops::replace(&mut self.image, &frame.rgb, x.into(), y.into());
        imageops::replace(&mut self.image, &depth, (x + w as u32).into(), y.into());
        self.next += 1;
        Ok(())
    }

    pub fn write(&self, path: &Path) -> anyhow::Result<()> {
        self.image.save(path).with_context(|| path.display().to_string())
    }
}
