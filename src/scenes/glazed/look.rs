//! What glass does to a picture: what it mirrors, how it tints what is behind it, and what lies on it.

use super::super::cast::{Hits, cast_beyond};
use super::super::light::shade;
use super::super::space::{V3, add, dot, mix, mul, sub, times, to_local};
use super::super::stage::Stage;
use super::glazing::{Crossing, Glazing};
use crate::depth::sampling::noise::noise;

/// What the camera sees in a plane, if it were a mirror.
pub(super) struct Mirror {
    pub hits: Hits,
    colour: Vec<V3>,
    /// Images of lamps in the plane: place, colour, width.
    glare: Vec<([f32; 2], V3, f32)>,
    /// White that lies in the plane, in the scene's light.
    white: V3,
}

/// Share of the light that clear glass reflects when it is seen straight on, of both its surfaces.
const STRAIGHT: f32 = 0.08;

/// Angular half width of the image of a lamp.
const LAMP: f32 = 0.018;

impl Mirror {
    /// Casts the mirrored rays. To be called before the scene itself is shaded, so that both have the same shadows.
    pub fn new(stage: &Stage, glazing: &Glazing, width: usize, height: usize) -> Self {
        let mut other = stage.clone();
        other.camera.at = glazing.mirrored(stage.camera.at);
        other.camera.axes = stage.camera.axes.map(|axis| glazing.turned(axis));
        // Only what is on the camera's side of the plane is mirrored.
        let normal = glazing.place.axes[2];
        let side = if dot(normal, sub(stage.camera.at, glazing.place.at)) > 0.0 { 1.0 } else { -1.0 };
        let towards = mul(normal, side);
        let plane = (towards, dot(towards, glazing.place.at));
        let hits = cast_beyond(&other.solids, &other.camera, width, height, plane);
        let colour = shade(&mut other, &hits, width);
        let eye = to_local(&glazing.place.axes, sub(other.camera.at, glazing.place.at));
        let mut white = stage.ambient;
        let mut glare = Vec::new();
        for light in &stage.lights {
            let to = to_local(&glazing.place.axes, sub(light.at, glazing.place.at));
            white = add(white, mul(light.colour, 0.2));
            if side * to[2] > 0.0 {
                // Where the line from the mirrored eye to the lamp crosses the plane.
                let s = eye[2] / (eye[2] - to[2]);
                let at = [0, 1].map(|k| eye[k] + s * (to[k] - eye[k]));
                let far = ((at[0] - eye[0]).powi(2) + (at[1] - eye[1]).powi(2) + eye[2] * eye[2]).sqrt();
                glare.push((at, light.colour, LAMP * far));
            }
        }
        Self { hits, colour, glare, white }
    }

    /// What of the light `behind` a pixel's glass, or opening, arrives, and what it adds.
    pub fn seen(&self, glazing: &Glazing, at: &Crossing, pixel: usize, footprint: f32, behind: V3) -> V3 {
        let sheet = &glazing.sheet;
        let behind = times(behind, sheet.behind);
        if !glazing.cells[at.cell].glass {
            return behind;
        }
        // Fresnel's reflection by Schlick's approximation; the way through the glass by Snell's law.
        let grazing = (1.0 - at.cos).powi(5);
        let reflected = (sheet.shine * STRAIGHT * (1.0 - grazing) + grazing).min(0.95);
        let inside = (1.0 - (1.0 - at.cos * at.cos) / (1.52 * 1.52)).sqrt();
        let through = sheet.tint.map(|t| t.powf(1.0 / inside) * (1.0 - reflected));
        let mut colour = add(times(behind, through), mul(self.colour[pixel], reflected));
        for (centre, light, wide) in &self.glare {
            let (du, dv) = ((at.u - centre[0]) / wide, (at.v - centre[1]) / (wide * sheet.streak));
            let bell = (-du * du - dv * dv).exp();
            if bell > 1e-3 {
                colour = add(colour, mul(*light, 6.0 * bell * reflected / sheet.streak.sqrt()));
            }
        }
        let cover = (dirt(glazing, at) + frost(glazing, at)).min(1.0);
        colour = mix(colour, mul(self.white, 0.55), cover);
        mix(colour, times(self.white, [0.1, 0.2, 0.16]), edge(glazing, at, footprint))
    }
}

/// Share of a place that dirt covers: spots and, finer, dust.
pub(super) fn dirt(glazing: &Glazing, at: &Crossing) -> f32 {
    let s = &glazing.sheet;
    if s.dirt == 0.0 {
        return 0.0;
    }
    let coarse = noise(at.u / s.spot, at.v / s.spot, s.seed);
    let fine = noise(at.u / (0.2 * s.spot), at.v / (0.3 * s.spot), s.seed ^ 11);
    (s.dirt * (0.3 + 6.0 * (coarse - 0.45).max(0.0) * (0.5 + fine))).min(0.8)
}

/// Share of a place that frosting covers.
pub(super) fn frost(glazing: &Glazing, at: &Crossing) -> f32 {
    match glazing.sheet.frost {
        Some((y, density)) if at.v >= y[0] && at.v < y[1] => density,
        _ => 0.0,
    }
}

/// How much of a pixel the cut edge of its pane fills.
fn edge(glazing: &Glazing, at: &Crossing, footprint: f32) -> f32 {
    if !glazing.sheet.edges {
        return 0.0;
    }
    let cell = &glazing.cells[at.cell];
    let off = [at.u - cell.x[0], cell.x[1] - at.u, at.v - cell.y[0], cell.y[1] - at.v];
    let off = off.into_iter().fold(f32::INFINITY, f32::min);
    // Six millimetres, spread over a pixel where that is wider.
    let wide = footprint.max(0.006);
    if off < wide { 0.8 * 0.006 / wide } else { 0.0 }
}
