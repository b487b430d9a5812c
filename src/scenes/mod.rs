//! Procedural RGB-D scenes for training.
//!
//! [`procedural`] casts rays into random indoor and outdoor scenes: its depth is exact, its colours are as unlike each
//! other as a real camera's. [`crate::depth::SparsePattern`] takes the measurements that a sensor would have made.

mod camera;
mod cast;
mod drive;
mod frame;
#[cfg(feature = "meshes")]
pub mod furnished;
mod furniture;
mod glazed;
mod lidar;
mod light;
mod objects;
mod rig;
mod rooms;
mod scene;
pub mod sensor;
mod shapes;
mod space;
mod stage;
mod streets;
mod tables;
mod texture;
mod traffic;

use image::RgbImage;
use rand::{RngCore, SeedableRng};
use rand_chacha::ChaCha8Rng;

use crate::depth::Intrinsics;
use crate::error::{Error, Result};
pub use frame::{Glass, RgbdFrame};
pub use glazed::glazed;
pub use lidar::SpinningLidar;
pub use rig::Rig;
pub use scene::Scene;
use stage::Stage;

/// Largest side of a rendered frame, pixels.
const LARGEST_SIDE: usize = 8192;

/// A random scene: room, desk, table top, hall, heap of solids, street or yard, 0.1 m to some 100 m deep.
///
/// The same seed and size always give the same frame. It runs on the calling thread only; make many frames in parallel.
/// Fails with [`Error::Argument`] when a side is 0 or above 8192 pixels.
pub fn procedural(seed: u64, width: usize, height: usize) -> Result<RgbdFrame> {
    let (mut stage, hits) = furnished_stage(seed, width, height)?;
    let rgb = picture(&mut stage, &hits, width, height);
    let scale = scale(&mut stage);
    let depth = frame::metres(&hits.depth, scale);
    Ok(RgbdFrame { rgb, depth, intrinsics: stage.camera.k, glass: None })
}

/// The scene of [`procedural`] before its picture is taken, and what its camera sees.
fn furnished_stage(seed: u64, width: usize, height: usize) -> Result<(Stage, cast::Hits)> {
    check_size(width, height)?;
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    // A camera may end up before a blank wall or under the floor; a few scenes are thrown away for that.
    let (mut stage, mut hits) = attempt(&mut rng, width, height);
    for _ in 0..6 {
        if interesting(&hits) {
            break;
        }
        (stage, hits) = attempt(&mut rng, width, height);
    }
    Ok((stage, hits))
}

/// How much larger than built a scene of [`procedural`] is, drawn after its picture.
///
/// The whole scene in another size looks the same: sizes must be learnt from the measurements.
fn scale(stage: &mut Stage) -> f32 {
    if stage.chance(0.5) { stage.log(0.5, 2.0) } else { 1.0 }
}

/// A street as a camera on a car sees it, 1.6 to 2 m above the road, with houses, trees, poles, vehicles, people: 2 to 120 m and
/// farther, true to scale. [`SpinningLidar`] measures in it.
///
/// The same seed and size always give the same frame. Fails as [`procedural`] does.
pub fn street(seed: u64, width: usize, height: usize) -> Result<RgbdFrame> {
    check_size(width, height)?;
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    // Other streets than those of `procedural`.
    rng.set_stream(1);
    let (mut stage, mut hits) = ride(&mut rng, width, height);
    for _ in 0..6 {
        if interesting(&hits) {
            break;
        }
        (stage, hits) = ride(&mut rng, width, height);
    }
    let rgb = picture(&mut stage, &hits, width, height);
    let depth = frame::metres(&hits.depth, 1.0);
    Ok(RgbdFrame { rgb, depth, intrinsics: stage.camera.k, glass: None })
}

fn picture(stage: &mut Stage, hits: &cast::Hits, width: usize, height: usize) -> RgbImage {
    let colour = light::shade(stage, hits, width);
    light::develop(stage, colour, width, height)
}

fn ride(rng: &mut ChaCha8Rng, width: usize, height: usize) -> (Stage, cast::Hits) {
    let mut stage = empty(rng, width, height);
    // Cameras of cars: from wide ones to those that look far ahead.
    let mut k = Intrinsics::from_fov(width, height, stage.real(1.0, 1.65));
    k.cx += stage.real(-0.03, 0.03) * width as f32;
    k.cy += stage.real(-0.05, 0.05) * height as f32;
    stage.drive(k);
    let hits = cast::cast(&stage.solids, &stage.camera, width, height);
    (stage, hits)
}

/// A stage without anything, with random numbers of its own.
fn empty(rng: &mut ChaCha8Rng, width: usize, height: usize) -> Stage {
    let own = ChaCha8Rng::seed_from_u64(rng.next_u64());
    let start = camera::Camera::new(Intrinsics::from_fov(width, height, 1.0), [0.0; 3], 0.0, 0.0, 0.0);
    Stage::new(own, start)
}

fn check_size(width: usize, height: usize) -> Result<()> {
    for (name, side) in [("width", width), ("height", height)] {
        if !(1..=LARGEST_SIDE).contains(&side) {
            return Err(Error::argument(name, side, format!("1 to {LARGEST_SIDE} pixels")));
        }
    }
    Ok(())
}

fn attempt(rng: &mut ChaCha8Rng, width: usize, height: usize) -> (Stage, cast::Hits) {
    let mut stage = empty(rng, width, height);
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
