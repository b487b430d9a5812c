//! Procedural RGB-D scenes for training.
//!
//! [`procedural`] casts rays into random indoor and outdoor scenes: its depth is exact, its colours are as unlike each
//! other as a real camera's. [`crate::depth::SparsePattern`] takes the measurements that a sensor would have made.

mod camera;
mod cast;
mod furniture;
mod light;
mod objects;
mod rooms;
pub mod sensor;
mod shapes;
mod space;
mod stage;
mod streets;
mod tables;
mod texture;

use image::RgbImage;
use rand::{RngCore, SeedableRng};
use rand_chacha::ChaCha8Rng;

use crate::depth::Intrinsics;
use crate::error::{Error, Result};
use stage::Stage;

/// An RGB image with the depth of every pixel.
#[derive(Clone, Debug)]
pub struct RgbdFrame {
    /// 8-bit sRGB-like picture.
    pub rgb: RgbImage,
    /// Exact Z-depth, metres, row-major, `width * height` values; NaN where nothing returns (sky).
    pub depth: Vec<f32>,
    /// The camera.
    pub intrinsics: Intrinsics,
}

impl RgbdFrame {
    /// Columns.
    pub fn width(&self) -> usize {
        self.rgb.width() as usize
    }

    /// Rows.
    pub fn height(&self) -> usize {
        self.rgb.height() as usize
    }
}

/// Largest side of a rendered frame, pixels.
const LARGEST_SIDE: usize = 8192;

/// A random scene: room, desk, table top, hall, heap of solids, street or yard, 0.1 m to some 100 m deep.
///
/// The same seed and size always give the same frame. It runs on the calling thread only; make many frames in parallel.
/// Fails with [`Error::Argument`] when a side is 0 or above 8192 pixels.
pub fn procedural(seed: u64, width: usize, height: usize) -> Result<RgbdFrame> {
    for (name, side) in [("width", width), ("height", height)] {
        if !(1..=LARGEST_SIDE).contains(&side) {
            return Err(Error::argument(name, side, format!("1 to {LARGEST_SIDE} pixels")));
        }
    }
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    // A camera may end up before a blank wall or under the floor; a few scenes are thrown away for that.
    let (mut stage, mut hits) = attempt(&mut rng, width, height);
    for _ in 0..6 {
        if interesting(&hits) {
            break;
        }
        (stage, hits) = attempt(&mut rng, width, height);
    }
    let colour = light::shade(&mut stage, &hits, width);
    let rgb = light::develop(&mut stage, colour, width, height);
    // The whole scene in another size looks the same: sizes must be learnt from the measurements.
    let scale = if stage.chance(0.5) { stage.log(0.5, 2.0) } else { 1.0 };
    let depth = hits.depth.iter().map(|&t| if t.is_finite() { t * scale } else { f32::NAN }).collect();
    Ok(RgbdFrame { rgb, depth, intrinsics: stage.camera.k })
}

fn attempt(rng: &mut ChaCha8Rng, width: usize, height: usize) -> (Stage, cast::Hits) {
    let own = ChaCha8Rng::seed_from_u64(rng.next_u64());
    let start = camera::Camera::new(Intrinsics::from_fov(width, height, 1.0), [0.0; 3], 0.0, 0.0, 0.0);
    let mut stage = Stage::new(own, start);
    let mut k = Intrinsics::from_fov(width, height, stage.real(0.7, std::f32::consts::FRAC_PI_2));
    k.cx += stage.real(-0.04, 0.04) * width as f32;
    k.cy += stage.real(-0.04, 0.04) * height as f32;
    match stage.int(0, 99) {
        0..=27 => stage.room(k),
        28..=47 => stage.desk(k),
        48..=64 => stage.tabletop(k),
        65..=72 => stage.hall(k),
        73..=79 => stage.heap(k),
        80..=91 => stage.street(k),
        _ => stage.yard(k),
    }
    let hits = cast::cast(&stage.solids, &stage.camera, width, height);
    (stage, hits)
}

/// Enough returns, several solids, nothing pressed against the lens.
fn interesting(hits: &cast::Hits) -> bool {
    let step = (hits.depth.len() / 4096).max(1);
    let mut depths: Vec<f32> = hits.depth.iter().step_by(step).copied().filter(|t| t.is_finite()).collect();
    let seen = hits.solid.iter().step_by(step).count();
    if depths.len() * 5 < seen * 2 {
        return false;
    }
    depths.sort_by(f32::total_cmp);
    let at = |q: f32| depths[((depths.len() - 1) as f32 * q) as usize];
    let mut solids: Vec<u32> = hits.solid.iter().step_by(step).copied().collect();
    solids.sort_unstable();
    let largest = solids.chunk_by(|a, b| a == b).map(<[u32]>::len).max().unwrap_or(0);
    at(0.05) > 0.12 && at(0.95) > 1.15 * at(0.05) && largest * 10 < seen * 9
}

#[cfg(test)]
mod tests;
