//! Frames and their depth beside each other in one picture.

use anyhow::Context;
use image::{Rgb, RgbImage, imageops};
use sdim::SparseDepth;
use sdim::draw::colour::{depth_range, depth_to_rgb};
use sdim::internals::scenes::RgbdFrame;
use std::path::Path;

/// Pictures in a row, of frames and of their depths.
const COLUMNS: u32 = 8;

pub struct Sheet {
    image: RgbImage,
    cell: (u32, u32),
    /// Pictures of a frame, and frames in a row.
    pictures: u32,
    across: u32,
    next: u32,
}

impl Sheet {
    /// A sheet for so many frames, each with its depth beside it; with `pictures` 3 also with what a sensor sees.
    pub fn new(count: u64, width: usize, height: usize, pictures: u32) -> Self {
        let (cell, across) = ((width as u32, height as u32), COLUMNS / pictures);
        let rows = (count as u32).div_ceil(across);
        let image = RgbImage::new(across * pictures * cell.0, rows * cell.1);
        Self { image, cell, pictures, across, next: 0 }
    }

    /// Adds a frame; measurements are drawn white on its depth.
    pub fn add(&mut self, frame: &RgbdFrame, measured: Option<&SparseDepth>) -> anyhow::Result<()> {
        let (w, h) = (frame.width(), frame.height());
        let (near, far) = depth_range(frame.sensed()).unwrap_or((0.0, 1.0));
        let (near, far) = depth_range(&frame.depth).map_or((near, far), |(n, f)| (near.min(n), far.max(f)));
        let mut depth = depth_to_rgb(&frame.depth, w, h, near, far)?;
        for (x, y, _) in measured.into_iter().flat_map(SparseDepth::points) {
            depth.put_pixel(x as u32, y as u32, Rgb([255; 3]));
        }
        let sensed =
            (self.pictures > 2).then(|| depth_to_rgb(frame.sensed(), w, h, near, far)).transpose()?;
        let first = self.next % self.across * self.pictures;
        let y = self.next / self.across * self.cell.1;
        for (k, picture) in (0..).zip([&frame.rgb, &depth].into_iter().chain(&sensed)) {
            imageops::replace(&mut self.image, picture, ((first + k) * self.cell.0).into(), y.into());
        }
        self.next += 1;
        Ok(())
    }

    pub fn write(&self, path: &Path) -> anyhow::Result<()> {
        self.image.save(path).with_context(|| path.display().to_string())
    }
}
