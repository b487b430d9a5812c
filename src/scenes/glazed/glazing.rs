//! Panes side by side in one plane: where rays cross them, what their glass is like, what a sensor sees of them.

use super::super::shapes::NEAR;
use super::super::space::{V3, add, dot, mul, sub, to_local};
use super::super::stage::{Place, Stage};

/// A rectangle of the plane, metres along it and up.
#[derive(Clone, Debug)]
pub(super) struct Cell {
    pub x: [f32; 2],
    pub y: [f32; 2],
    /// An opening without glass otherwise.
    pub glass: bool,
}

/// Panes in one plane.
#[derive(Clone, Debug)]
pub(super) struct Glazing {
    /// x along the plane, y up, z away from the camera.
    pub place: Place,
    pub cells: Vec<Cell>,
    pub sheet: Sheet,
    pub sensing: Sensing,
}

/// Where a ray crosses a cell.
#[derive(Clone, Copy, Debug)]
pub(super) struct Crossing {
    /// Z-depth, before the scene is scaled.
    pub t: f32,
    /// Place in the plane, metres.
    pub u: f32,
    pub v: f32,
    pub cell: usize,
    /// Cosine of the angle to the plane's normal.
    pub cos: f32,
}

/// What the glass looks like.
#[derive(Clone, Debug)]
pub(super) struct Sheet {
    /// What it lets through when it is seen straight on.
    pub tint: V3,
    /// Reflection, as a factor on that of clear glass: less for coated panes, more for those that keep the sun out.
    pub shine: f32,
    /// Light behind the plane, as a factor on what the scene has there: other rooms are lit otherwise.
    pub behind: V3,
    /// Share of the surface that dirt, smears and dust cover on average.
    pub dirt: f32,
    /// Size of its spots, metres.
    pub spot: f32,
    /// Heights between which the glass is frosted, and how densely.
    pub frost: Option<([f32; 2], f32)>,
    /// How long the glare of a lamp is smeared upwards, relative to its width.
    pub streak: f32,
    /// Whether the cut edges of the panes are to be seen, greenish.
    pub edges: bool,
    pub seed: u32,
}

/// What a sensor sees of panes: the shares of what it reports instead of what is behind.
#[derive(Clone, Debug)]
pub(super) struct Sensing {
    /// Nothing at all.
    pub nothing: f32,
    /// The pane.
    pub pane: f32,
    /// What is mirrored in it, as far behind it as it is before it.
    pub mirrored: f32,
    /// Cosine of the angle to the normal from which on the pane itself returns.
    pub glint: f32,
    /// Size of the patches in which these keep together, metres.
    pub patch: f32,
    pub seed: u32,
}

impl Glazing {
    /// Where a ray from `from` crosses it.
    pub fn crossing(&self, from: V3, ray: V3) -> Option<Crossing> {
        let normal = self.place.axes[2];
        let along = dot(normal, ray);
        let t = dot(normal, sub(self.place.at, from)) / along;
        if !(t > NEAR && t.is_finite()) {
            return None;
        }
        let [u, v, _] = to_local(&self.place.axes, sub(add(from, mul(ray, t)), self.place.at));
        let inside = |c: &Cell| u >= c.x[0] && u < c.x[1] && v >= c.y[0] && v < c.y[1];
        let cell = self.cells.iter().position(inside)?;
        Some(Crossing { t, u, v, cell, cos: along.abs() / dot(ray, ray).sqrt() })
    }

    /// A point as the plane mirrors it.
    pub fn mirrored(&self, p: V3) -> V3 {
        let normal = self.place.axes[2];
        sub(p, mul(normal, 2.0 * dot(normal, sub(p, self.place.at))))
    }

    /// A direction as the plane mirrors it.
    pub fn turned(&self, d: V3) -> V3 {
        let normal = self.place.axes[2];
        sub(d, mul(normal, 2.0 * dot(normal, d)))
    }
}

impl Sheet {
    /// Drawn at random; `height` is that of the panes. Some have next to no mark of being there.
    pub fn draw(stage: &mut Stage, height: f32) -> Self {
        let depth = stage.real(0.0, 1.0).powi(2) * 0.45;
        let tint = match stage.int(0, 9) {
            0..=5 => [0.97 - 0.5 * depth, 0.98 - 0.2 * depth, 0.96 - 0.4 * depth],
            6 | 7 => [0.97 - depth; 3],
            8 => [0.96 - 0.4 * depth, 0.93 - 0.7 * depth, 0.88 - depth],
            _ => [0.94 - depth, 0.95 - 0.7 * depth, 0.97 - 0.4 * depth],
        };
        let shine = match stage.int(0, 9) {
            0 | 1 => stage.real(0.3, 0.8),
            2..=6 => stage.real(0.8, 1.6),
            _ => stage.log(1.6, 5.0),
        };
        let behind = if stage.chance(0.5) {
            let level = stage.log(0.25, 1.8);
            [level * stage.real(0.9, 1.1), level, level * stage.real(0.85, 1.15)]
        } else {
            [1.0; 3]
        };
        let frost = stage.chance(0.12).then(|| {
            let low = stage.real(0.2, 0.6) * height;
            ([low, low + stage.real(0.1, 0.4) * height], stage.real(0.5, 0.9))
        });
        Self {
            tint,
            shine,
            behind,
            dirt: if stage.chance(0.6) { stage.log(0.01, 0.12) } else { 0.0 },
            spot: stage.log(0.03, 0.5),
            frost,
            streak: stage.log(1.0, 20.0),
            edges: stage.chance(0.7),
            seed: stage.int(0, u32::MAX as usize) as u32,
        }
    }
}

impl Sensing {
    /// Drawn at random: most panes are seen through, at some there is nothing, a few return themselves.
    pub fn draw(stage: &mut Stage) -> Self {
        let (nothing, pane, mirrored) = match stage.int(0, 99) {
            0..=59 => (stage.real(0.0, 0.25), stage.real(0.0, 0.06), stage.real(-0.2, 0.1)),
            60..=79 => (stage.real(0.5, 1.0), stage.real(0.0, 0.06), stage.real(-0.1, 0.05)),
            80..=91 => (stage.real(0.2, 0.6), stage.real(0.1, 0.3), stage.real(-0.1, 0.1)),
            _ => (stage.real(0.05, 0.3), stage.real(0.5, 0.95), 0.0),
        };
        Self {
            nothing,
            pane,
            mirrored: mirrored.max(0.0),
            glint: if stage.chance(0.5) { stage.real(0.98, 0.9995) } else { 2.0 },
            patch: stage.log(0.05, 0.6),
            seed: stage.int(0, u32::MAX as usize) as u32,
        }
    }
}
