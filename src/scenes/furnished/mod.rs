//! Rooms furnished with meshes, for training and for measuring.
//!
//! A [`Library`] holds models: a folder of OBJ and MTL files with a catalogue of their sizes, such as Debian's package
//! `sweethome3d-furniture` (`scripts/furniture.sh`), or what [`Library::pack`] made of one. [`furnished`] lays out a room with
//! them, as large as they are, lights it, and looks at it as a robot, a phone or a head would.
//!
//! Depth is exact, with two conventions: glass is not measured but what is behind it, and the open sky behind a window has no
//! depth. Mirrors and screens are where their surface is.

mod catalogue;
mod fill;
mod geometry;
mod home;
mod library;
mod light;
mod look;
mod mesh;
mod model;
mod obj;
mod openings;
mod pack;
mod packed;
mod plan;
mod profile;
mod render;
mod role;
mod room;
mod scene;
mod shell;
mod simplify;
mod style;
mod texture;
mod unpack;
mod view;
mod work;

use std::sync::Arc;

use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

use super::camera::Camera;
use super::light::Finish;
use super::space::{V3, mul};
use super::stage::Stage;
use super::{RgbdFrame, check_size};
use crate::depth::Intrinsics;
use crate::error::Result;
pub use library::{Library, ModelInfo, Reduction, Split};
use light::{Lights, luma};
use mesh::Mesh;
pub use pack::PackOptions;
use plan::Plan;
use room::Room;
use scene::{Instance, Scene};
use shell::Shell;
use style::{Kind, Style};

/// A random room of a library's models: kitchen, living room, bedroom, office, bathroom, shop or workshop.
///
/// The same library, seed and size give the same frame. The parts of a library ([`Library::part`]) share neither models nor
/// rooms. It runs on the calling thread only; make many frames in parallel.
///
/// Depth in metres; NaN where nothing returns (the sky behind a window). Fails with [`crate::Error::Argument`] when a side is 0
/// or above 8192 pixels.
pub fn furnished(library: &Library, seed: u64, width: usize, height: usize) -> Result<RgbdFrame> {
    check_size(width, height)?;
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    rng.set_stream(match library.split() {
        Split::All => 1,
        Split::Train => 2,
        Split::HeldOut => 3,
    });
    let mut dice = Stage::new(rng, standing(width, height, [0.0; 3]));
    let mut rooms = 0;
    loop {
        let (scene, mut room) = furnish(library, dice);
        let lights = room.all_lights();
        rooms += 1;
        match view::choose(&mut room, &scene, width, height) {
            Some((worth, camera)) if worth > WORTH || rooms == ROOMS => {
                return Ok(photograph(scene, room, lights, camera, width, height));
            }
            None if rooms == ROOMS => {
                // No free place in any of them: a camera below the ceiling is better than none.
                let [w, h, l] = room.plan.size;
                let camera = standing(width, height, [0.9 * w, 0.9 * h, -0.9 * l]);
                return Ok(photograph(scene, room, lights, camera, width, height));
            }
            _ => dice = room.dice,
        }
    }
}

/// Views worth less are not rendered, of so many rooms that are tried.
const WORTH: f32 = 0.3;
const ROOMS: usize = 4;

/// A camera that looks level along z.
fn standing(width: usize, height: usize, at: V3) -> Camera {
    Camera::new(Intrinsics::from_fov(width, height, 1.2), at, 0.0, 0.0, 0.0)
}

impl Room<'_> {
    fn all_lights(&mut self) -> Lights {
        let sun = self.windows();
        let day = self.day;
        let sky = [[0.75, 0.85, 1.0].map(|v| v * day * 1.6), [0.35, 0.6, 1.0].map(|v| v * day * 1.3)];
        Lights { lamps: std::mem::take(&mut self.lights), sun, sky, ambient: [0.0; 3] }
    }
}

/// A room, its pieces in place.
fn layout(library: &Library, mut dice: Stage) -> Room<'_> {
    let kind = dice.pick(&[
        Kind::Living,
        Kind::Living,
        Kind::Living,
        Kind::Bedroom,
        Kind::Bedroom,
        Kind::Kitchen,
        Kind::Kitchen,
        Kind::Kitchen,
        Kind::Office,
        Kind::Office,
        Kind::Bathroom,
        Kind::Workshop,
        Kind::Workshop,
    ]);
    let ([w0, w1], [l0, l1]) = match kind {
        Kind::Living => ([1.7, 2.8], [1.9, 3.6]),
        Kind::Bedroom => ([1.4, 2.2], [1.6, 2.6]),
        Kind::Kitchen => ([1.2, 2.3], [1.5, 2.9]),
        Kind::Bathroom => ([0.9, 1.5], [1.1, 2.0]),
        Kind::Office => ([1.5, 3.5], [1.8, 4.5]),
        Kind::Workshop => ([1.8, 4.0], [2.0, 5.5]),
    };
    let size = [dice.real(w0, w1), dice.real(2.35, 3.1), dice.real(l0, l1)];
    let daylight = dice.chance(0.75);
    let (day, lit) = if daylight { (dice.log(1.0, 3.0), dice.chance(0.45)) } else { (0.02, true) };
    let mut room = Room {
        library,
        dice,
        kind,
        plan: Plan::new(size),
        pieces: Vec::new(),
        small: Vec::new(),
        shell: Shell::default(),
        holes: Vec::new(),
        lights: Vec::new(),
        day,
        lit,
    };
    room.open();
    // A room without a window needs its lamps.
    room.lit |= !room.holes.iter().any(|h| h.window);
    match kind {
        Kind::Living => room.living(),
        Kind::Bedroom => room.bedroom(),
        Kind::Kitchen => room.kitchen(),
        Kind::Bathroom => room.bathroom(),
        Kind::Office => room.office(),
        Kind::Workshop => room.workshop(),
    }
    room.finish();
    room
}

/// The room and all of its triangles.
fn furnish(library: &Library, dice: Stage) -> (Scene, Room<'_>) {
    let mut room = layout(library, dice);
    let style = Style::new(&mut room.dice, room.kind);
    room.build(&style);
    room.lamps();
    let mut looks = std::mem::take(&mut room.shell.looks);
    let mut instances = vec![Instance::new(Arc::new(Mesh::new(&room.shell.geometry)), [0.0; 3], 0.0, 0)];
    let mut known: Vec<(*const model::Model, usize)> = Vec::new();
    for piece in &room.pieces {
        // Chairs of one table look alike.
        let model = Arc::as_ptr(&piece.model);
        let first = match known.iter().find(|(m, _)| *m == model) {
            Some((_, first)) => *first,
            None => {
                known.push((model, looks.len()));
                looks.extend(style::looks(&mut room.dice, &piece.model));
                known[known.len() - 1].1
            }
        };
        instances.push(Instance::new(piece.model.mesh.clone(), piece.at, piece.yaw, first));
    }
    (Scene::new(instances, looks), room)
}

fn photograph(
    scene: Scene,
    mut room: Room<'_>,
    mut lights: Lights,
    camera: Camera,
    width: usize,
    height: usize,
) -> RgbdFrame {
    let mean = render::mean_light(&scene, &lights, &camera, width, height);
    lights.ambient = mul(mean, render::AMBIENT);
    let seed = room.dice.int(0, u32::MAX as usize) as u32;
    let view = render::View {
        scene: &scene,
        lights: &lights,
        plan: &room.plan,
        holes: &room.holes,
        camera: &camera,
        width,
        height,
        seed,
    };
    let rendered = render::render(&view);
    let colour = expose(&mut room.dice, rendered.colour);
    let finish = finish(&mut room.dice);
    let rgb = super::light::finish(colour, width, height, &finish);
    RgbdFrame { rgb, depth: rendered.depth, intrinsics: camera.k, glass: None }
}

/// Automatic exposure: the picture's middle becomes a middle grey unless its bright half would be lost, and what is still too
/// bright nears white without reaching it.
fn expose(dice: &mut Stage, mut colour: Vec<V3>) -> Vec<V3> {
    let step = (colour.len() / 4096).max(1);
    let mut sample: Vec<f32> = colour.iter().step_by(step).map(|c| luma(*c)).collect();
    sample.sort_by(f32::total_cmp);
    let at = |q: f32| sample[((sample.len() - 1) as f32 * q) as usize].max(1e-4);
    let key = dice.log(0.17, 0.34);
    let gain = (key / at(0.5)).min(0.95 / at(0.85));
    let gain = gain * dice.log(0.85, 1.12);
    for c in &mut colour {
        *c = c.map(|v| {
            let v = v * gain;
            if v < 0.55 { v } else { 0.55 + 0.45 * (1.0 - (-(v - 0.55) / 0.45).exp()) }
        });
    }
    colour
}

/// The camera's own faults, small ones.
fn finish(dice: &mut Stage) -> Finish {
    let cast = if dice.chance(0.6) {
        [dice.real(0.93, 1.07), dice.real(0.98, 1.02), dice.real(0.9, 1.1)]
    } else {
        [1.0; 3]
    };
    Finish {
        cast,
        vignette: if dice.chance(0.4) { dice.real(0.0, 0.3) } else { 0.0 },
        blur: if dice.chance(0.5) { dice.real(0.0, 0.15) } else { 0.0 },
        noise: if dice.chance(0.7) { dice.log(0.002, 0.02) } else { 0.0 },
        saturation: dice.real(0.8, 1.15),
        gamma: 1.0 / dice.real(2.0, 2.4),
        contrast: dice.real(0.0, 0.5),
        lift: if dice.chance(0.2) { dice.real(0.0, 0.03) } else { 0.0 },
        seed: dice.int(0, u32::MAX as usize) as u32,
    }
}

#[cfg(test)]
mod tests;
