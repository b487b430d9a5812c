//! What a surface looks like where a ray met it.

use std::sync::Arc;

use super::mesh::{Mesh, Touch};
use super::model::{CLEAR, Cover};
use super::texture::Texture;
use crate::scenes::space::{V3, mix, mul};
use crate::scenes::texture::{Material, Pattern};

/// Whether rays stop at a surface.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Stop {
    Always,
    /// Where the texture's alpha or a mask says so.
    Masked,
    /// Glass: in the picture, not in the depth.
    Never,
}

/// What covers an instance's part.
#[derive(Clone, Debug)]
pub(super) struct Look {
    /// Linear colour, or the tint of a texture or pattern.
    pub colour: V3,
    texture: Option<Arc<Texture>>,
    mask: Option<Arc<Texture>>,
    pattern: Option<Material>,
    pub stop: Stop,
    pub opacity: f32,
    pub gloss: f32,
    pub exponent: f32,
    /// Share of light that is thrown back as from a mirror.
    pub mirror: f32,
    /// Its own light, relative to the colour.
    pub glow: f32,
}

/// Linear values of 8-bit sRGB ones.
pub(super) fn linear_table() -> [f32; 256] {
    std::array::from_fn(|i| linear(i as f32 / 255.0))
}

/// IEC 61966-2-1.
pub(super) fn linear(v: f32) -> f32 {
    if v <= 0.04045 { v / 12.92 } else { ((v + 0.055) / 1.055).powf(2.4) }
}

impl Look {
    /// A pattern of the procedural scenes, or a plain colour (linear).
    pub fn patterned(pattern: Material) -> Self {
        Self {
            colour: [1.0; 3],
            texture: None,
            mask: None,
            stop: Stop::Always,
            opacity: 1.0,
            gloss: pattern.gloss,
            exponent: 30.0,
            mirror: 0.0,
            glow: pattern.glow,
            pattern: Some(pattern),
        }
    }

    /// A model's own cover.
    pub fn of(cover: &Cover) -> Self {
        let masked = cover.mask.is_some() || cover.texture.as_ref().is_some_and(|t| t.clear);
        let stop = match () {
            () if masked => Stop::Masked,
            () if cover.opacity < CLEAR => Stop::Never,
            () => Stop::Always,
        };
        // Black never is: a tenth of a white wall's light comes back from what files call black.
        let colour = cover.colour.map(|v| linear(v).clamp(0.012, 0.82));
        let grey = cover.colour.iter().sum::<f32>() / 3.0;
        let metal = cover.texture.is_none() && cover.gloss > 0.75 && grey < 0.45 && cover.exponent > 60.0;
        Self {
            colour: if cover.texture.is_some() { [1.0; 3] } else { colour },
            texture: cover.texture.clone(),
            mask: cover.mask.clone(),
            pattern: None,
            stop,
            opacity: cover.opacity,
            gloss: (0.35 * cover.gloss).min(0.3),
            exponent: cover.exponent.clamp(8.0, 200.0),
            mirror: if metal { 0.3 } else { 0.0 },
            glow: cover.glow,
        }
    }

    /// Gives a surface without a texture a pattern in place of its plain colour.
    pub fn with_pattern(mut self, pattern: Material) -> Self {
        self.colour = [1.0; 3];
        self.gloss = self.gloss.max(0.5 * pattern.gloss);
        self.pattern = Some(pattern);
        self
    }

    /// Whether it has a picture of its own.
    pub fn is_pictured(&self) -> bool {
        self.texture.is_some()
    }

    /// Whether a ray stops at a point.
    #[inline(always)]
    pub fn stops(&self, mesh: &Mesh, touch: &Touch) -> bool {
        match self.stop {
            Stop::Always => true,
            Stop::Never => false,
            Stop::Masked => self.stops_at(mesh.uv(touch)),
        }
    }

    fn stops_at(&self, uv: [f32; 2]) -> bool {
        self.texture.as_ref().is_none_or(|t| !t.clear || t.alpha(uv) >= 128)
            && self.mask.as_ref().is_none_or(|m| m.level(uv) >= 128)
    }

    /// Linear colour at a point; `local` is the point in the mesh's frame, `footprint` the width of a pixel there in metres.
    pub fn albedo(&self, mesh: &Mesh, touch: &Touch, local: V3, footprint: f32, linear: &[f32; 256]) -> V3 {
        if let Some(texture) = &self.texture {
            let [w, h] = texture.size();
            let texels = footprint * mesh.density(touch.face) * (w * h).sqrt();
            let c = texture.colour(mesh.uv(touch), texels, linear);
            return [0, 1, 2].map(|k| (c[k] * self.colour[k]).clamp(0.008, 0.85));
        }
        let Some(pattern) = &self.pattern else { return self.colour };
        let c = if pattern.pattern == Pattern::Print {
            let uv = mesh.uv(touch);
            pattern.albedo_at(uv, [2.0 * uv[0] - 1.0, 2.0 * uv[1] - 1.0], 1.0, footprint)
        } else {
            pattern.albedo_at(planar(mesh, touch.face, local), [0.0; 2], 1.0, footprint)
        };
        [0, 1, 2].map(|k| c[k] * self.colour[k])
    }

    /// Its colour from far away.
    pub fn mean(&self, mesh: &Mesh, touch: &Touch, linear: &[f32; 256]) -> V3 {
        match (&self.texture, &self.pattern) {
            (Some(texture), _) => texture.colour(mesh.uv(touch), 64.0, linear),
            (None, Some(p)) if p.pattern == Pattern::Print => mul(mix(p.base, p.second, 0.5), 0.8),
            (None, Some(p)) => mix(p.base, p.second, 0.3),
            (None, None) => self.colour,
        }
    }
}

/// Coordinates on the face's plane, metres: the two axes along which it reaches most.
fn planar(mesh: &Mesh, face: u32, p: V3) -> [f32; 2] {
    let n = mesh.plane(face).map(f32::abs);
    if n[1] >= n[0] && n[1] >= n[2] {
        [p[0], p[2]]
    } else if n[0] >= n[2] {
        [p[2], p[1]]
    } else {
        [p[0], p[1]]
    }
}
