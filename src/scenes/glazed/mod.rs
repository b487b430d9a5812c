//! Rooms, halls and yards behind glass.
//!
//! A scene as [`procedural`](super::procedural) has them is parted by panes: partitions, doors, windows, balustrades, screens. They
//! are tinted, mirror what is before them, are dirty or clean, and have frames, handles, stickers, most but not all of them. Depth
//! is that of the pane, for a robot that drives on drives into it; what a sensor sees ([`Glass::sensed`]) is another map.

mod build;
mod glazing;
mod look;
mod sense;

use super::cast::{Hits, cast};
use super::frame::{Glass, RgbdFrame, metres};
use super::space::{add, dot, mul, sub};
use super::stage::{Place, Stage};
use super::{camera::Camera, check_size, empty, light, scale};
use crate::depth::Intrinsics;
use crate::depth::pixels::median;
use crate::error::Result;
use build::Room;
use glazing::{Crossing, Glazing, Sensing, Sheet};
use look::Mirror;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use sense::{Sensed, sense};
use std::f32::consts::{FRAC_PI_2, PI};

/// A random scene seen through panes of glass, indoors or from indoors, with [`RgbdFrame::glass`].
///
/// The same seed and size always give the same frame. Fails as [`procedural`](super::procedural) does.
pub fn glazed(seed: u64, width: usize, height: usize) -> Result<RgbdFrame> {
    check_size(width, height)?;
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    // Other scenes than those of the other recipes.
    rng.set_stream(4);
    let mut view = View::new(&mut rng, width, height);
    // Panes may end up beside the picture, behind a wall or upon one.
    for _ in 0..16 {
        if view.is_glazed() {
            break;
        }
        view = View::new(&mut rng, width, height);
    }
    Ok(view.photograph())
}

/// A scene with its panes, and what its camera sees.
struct View {
    stage: Stage,
    glazings: Vec<Glazing>,
    /// What is seen without glass.
    hits: Hits,
    size: (usize, usize),
}

/// Planes that are tried, of which the one through the fewest things is taken.
const PLANES: usize = 8;

impl View {
    fn new(rng: &mut ChaCha8Rng, width: usize, height: usize) -> Self {
        let mut stage = empty(rng, width, height);
        let k = Intrinsics::from_fov(width, height, stage.real(0.7, FRAC_PI_2));
        match stage.int(0, 99) {
            0..=44 => stage.room(k),
            45..=79 => stage.hall(k),
            80..=84 => stage.desk(k),
            85..=91 => stage.street(k),
            _ => stage.yard(k),
        }
        let hits = cast(&stage.solids, &stage.camera, width, height);
        let mut far: Vec<f32> = hits.depth.iter().copied().filter(|t| t.is_finite()).collect();
        let far = median(&mut far).unwrap_or(4.0);
        let mut glazings = Vec::new();
        for _ in 0..if stage.chance(0.82) { 1 } else { 2 } {
            glazings.push(stand(&mut stage, far));
        }
        let hits = cast(&stage.solids, &stage.camera, width, height);
        Self { stage, glazings, hits, size: (width, height) }
    }

    /// All cells before what a pixel shows, the nearest first, with the number of their plane.
    fn crossings(&self, pixel: usize) -> Vec<(usize, Crossing)> {
        let camera = &self.stage.camera;
        let ray = camera.ray((pixel % self.size.0) as f32, (pixel / self.size.0) as f32);
        let before = |c: &Crossing| c.t < self.hits.depth[pixel];
        let cross = |(k, g): (usize, &Glazing)| Some((k, g.crossing(camera.at, ray).filter(before)?));
        let mut found: Vec<_> = self.glazings.iter().enumerate().filter_map(cross).collect();
        found.sort_by(|a, b| a.1.t.total_cmp(&b.1.t));
        found
    }

    fn is_glass(&self, (plane, crossing): &(usize, Crossing)) -> bool {
        self.glazings[*plane].cells[crossing.cell].glass
    }

    /// Whether enough of the picture is glass, with something behind most of it, and not pressed against the lens.
    fn is_glazed(&self) -> bool {
        let step = (self.hits.depth.len() / 2048).max(1);
        let (mut glass, mut deep, mut close, mut all) = (0, 0, 0, 0);
        for pixel in (0..self.hits.depth.len()).step_by(step) {
            all += 1;
            let depth = self.hits.depth[pixel];
            close += usize::from(depth < 0.12);
            if let Some((_, c)) = self.crossings(pixel).iter().find(|c| self.is_glass(c)) {
                glass += 1;
                deep += usize::from(depth > 1.15 * c.t);
                close += usize::from(c.t < 0.2);
            }
        }
        glass * 12 > all && glass * 6 < 5 * all && deep * 2 > glass && close * 20 < all
    }

    fn photograph(mut self) -> RgbdFrame {
        let (width, height) = self.size;
        let mirrors: Vec<Mirror> =
            self.glazings.iter().map(|g| Mirror::new(&self.stage, g, width, height)).collect();
        let mut colour = light::shade(&mut self.stage, &self.hits, width);
        let mut glass = Glass {
            pane: vec![false; colour.len()],
            behind: self.hits.depth.clone(),
            sensed: self.hits.depth.clone(),
        };
        let mut depth = self.hits.depth.clone();
        for (pixel, colour) in colour.iter_mut().enumerate() {
            let crossings = self.crossings(pixel);
            for (plane, at) in crossings.iter().rev() {
                let footprint = at.t / self.stage.camera.k.fx;
                *colour = mirrors[*plane].seen(&self.glazings[*plane], at, pixel, footprint, *colour);
            }
            let panes: Vec<_> = crossings.into_iter().filter(|c| self.is_glass(c)).collect();
            if let Some((_, first)) = panes.first() {
                (glass.pane[pixel], depth[pixel]) = (true, first.t);
                glass.sensed[pixel] = self.sensed(pixel, &panes, &mirrors);
            }
        }
        let rgb = light::develop(&mut self.stage, colour, width, height);
        let scale = scale(&mut self.stage);
        for map in [&mut depth, &mut glass.behind, &mut glass.sensed] {
            *map = metres(map, scale);
        }
        RgbdFrame { rgb, depth, intrinsics: self.stage.camera.k, glass: Some(glass) }
    }

    /// What a sensor sees at a pixel through these panes, the nearest first.
    fn sensed(&self, pixel: usize, panes: &[(usize, Crossing)], mirrors: &[Mirror]) -> f32 {
        let place = (pixel % self.size.0, pixel / self.size.0);
        for (plane, at) in panes {
            match sense(&self.glazings[*plane], at, place) {
                Sensed::Behind => {}
                Sensed::Pane => return at.t,
                Sensed::Mirrored => return mirrors[*plane].hits.depth[pixel],
                Sensed::Nothing => return f32::INFINITY,
            }
        }
        self.hits.depth[pixel]
    }
}

/// Puts panes between the camera and what it sees, `far` metres away in the middle.
fn stand(stage: &mut Stage, far: f32) -> Glazing {
    let camera = stage.camera.clone();
    let heading = camera.axes[2][0].atan2(camera.axes[2][2]);
    let mut best: Option<(usize, Place, f32)> = None;
    // Panes stand as walls do, mostly.
    let straight = (heading / FRAC_PI_2).round() * FRAC_PI_2;
    let yaw = match stage.int(0, 9) {
        0..=5 => straight,
        6 => straight + stage.pick(&[-1.0f32, 1.0]) * FRAC_PI_2,
        _ => heading + stage.real(-1.0, 1.0),
    };
    let aside = ((yaw - heading + PI).rem_euclid(2.0 * PI) - PI).abs();
    for _ in 0..PLANES {
        let most = (0.8 * far).clamp(0.8, 8.0);
        let distance = if stage.chance(0.5) { stage.log(0.4, most) } else { stage.real(0.3, 1.0) * most };
        let distance = distance * (0.25 + 0.75 * aside.cos().max(0.0));
        let flat = Place::new([camera.at[0], 0.0, camera.at[2]], yaw);
        let lean = if stage.chance(0.1) { stage.real(-0.15, 0.15) } else { 0.0 };
        let place = flat.tilted([0.0, 0.0, distance], 0.0, lean, 0.0);
        let cut = stage.solids.iter().filter(|s| is_cut(s, &place)).count();
        if best.as_ref().is_none_or(|b| cut < b.0) {
            best = Some((cut, place, distance));
        }
    }
    let (_, place, distance) = best.unwrap_or((0, Place::new(camera.at, yaw), 1.0));
    let room = Room { height: ceiling(stage), reach: (2.5 * distance + 2.5).min(12.0) };
    let (cells, height) = build::build(stage, place, room);
    Glazing { place, cells, sheet: Sheet::draw(stage, height), sensing: Sensing::draw(stage) }
}

/// Whether a plane cuts a solid, walls and floors aside.
fn is_cut(solid: &super::shapes::Solid, place: &Place) -> bool {
    let normal = place.axes[2];
    let extent: f32 = (0..3).map(|k| dot(normal, solid.axes[k]).abs() * solid.half[k]).sum();
    let large = solid.half.iter().any(|h| *h > 1.3);
    !large && dot(normal, sub(solid.centre, place.at)).abs() < extent
}

/// Height of the first thing above the camera, metres; that of a room under the open sky.
fn ceiling(stage: &mut Stage) -> f32 {
    let up = Camera::new(Intrinsics::from_fov(1, 1, 1.0), stage.camera.at, 0.0, FRAC_PI_2, 0.0);
    let hits = cast(&stage.solids, &up, 1, 1);
    let top = add(up.at, mul(up.axes[2], hits.depth[0]))[1];
    if (1.9..9.0).contains(&top) { top } else { stage.real(2.4, 3.2) }
}

#[cfg(test)]
mod tests;
