//! Where scanners and feature trackers measure.

use super::noise::noise;
use image::RgbImage;
use rand::Rng;

/// Rows of a scanner in the image.
pub(super) struct Scan {
    width: usize,
    lines: f32,
    first: f32,
    spacing: f32,
    tilt: f32,
    bend: f32,
    dropout: f32,
    seed: u32,
}

impl Scan {
    pub(super) fn new(lines: usize, width: usize, height: usize, rng: &mut impl Rng) -> Self {
        let h = height as f32;
        let mut real = |low: f32, high: f32| low + (high - low) * rng.random::<f32>();
        let (top, bottom) = (h * real(0.0, 0.4), h * real(0.85, 1.0));
        let spacing = (bottom - top) / lines as f32;
        Self {
            width,
            lines: lines as f32,
            first: top + real(0.2, 0.8) * spacing,
            spacing,
            tilt: real(-0.06, 0.06),
            bend: real(-0.04, 0.04) * h,
            dropout: real(0.0, 0.3),
            seed: rng.random(),
        }
    }

    /// Pixels on a row first, at random; then those in its gaps; then the others, nearest first.
    pub(super) fn cost(&self, i: usize, rng: &mut impl Rng) -> f32 {
        let (x, y) = ((i % self.width) as f32, (i / self.width) as f32);
        let u = 2.0 * x / self.width as f32 - 1.0;
        let row = y - self.tilt * (x - 0.5 * self.width as f32) - self.bend * u * u;
        let phase = (row - self.first) / self.spacing;
        let line = phase.round().clamp(0.0, self.lines - 1.0);
        let distance = (phase - line).abs() * self.spacing;
        let shade: f32 = rng.random();
        if distance > 0.5 {
            return 2.0 + distance + 0.1 * shade;
        }
        // Dark or shiny patches return nothing, and a few single rays are lost.
        let patch = noise(x / 14.0, 0.3 * line, self.seed);
        if patch < self.dropout || rng.random::<f32>() < 0.05 { 1.0 + shade } else { shade }
    }
}

/// Gradient strength times a coarse random cover: real reconstructions have dense and empty regions.
pub(super) fn feature_weights(rgb: &RgbImage, rng: &mut impl Rng) -> Vec<f32> {
    let (w, h) = (rgb.width() as usize, rgb.height() as usize);
    let grey: Vec<f32> =
        rgb.pixels().map(|p| p.0.iter().map(|&c| f32::from(c)).sum::<f32>() / 765.0).collect();
    let seed: u32 = rng.random();
    let cell = 0.18 * w.max(h) as f32 + 1.0;
    let mut out = Vec::with_capacity(w * h);
    for y in 0..h {
        for x in 0..w {
            let at = |x: usize, y: usize| grey[y.min(h - 1) * w + x.min(w - 1)];
            let gx = at(x + 1, y) - at(x.saturating_sub(1), y);
            let gy = at(x, y + 1) - at(x, y.saturating_sub(1));
            let cover = noise(x as f32 / cell, y as f32 / cell, seed);
            out.push((gx * gx + gy * gy + 2e-4) * (0.1 + cover * cover * cover));
        }
    }
    out
}
