//! Lights with an area, and what arrives from them where nothing is in the way.

use crate::scenes::space::{V3, add, dot, mul, norm, sub};

/// A light: a parallelogram that shines to one side, or, without a normal, a lamp that shines all around.
#[derive(Clone, Copy, Debug)]
pub(super) struct Light {
    pub at: V3,
    /// Half its sides.
    pub half: [V3; 2],
    /// Direction in which it shines; zero for all.
    pub normal: V3,
    /// Light per metre squared at a distance of 1 m, before a surface, per channel.
    pub power: V3,
}

impl Light {
    /// A lamp of a radius.
    pub fn lamp(at: V3, radius: f32, power: V3) -> Self {
        Self { at, half: [[radius, 0.0, 0.0], [0.0, 0.7 * radius, 0.7 * radius]], normal: [0.0; 3], power }
    }

    /// Half the length of its diagonal, squared.
    fn spread(&self) -> f32 {
        dot(self.half[0], self.half[0]) + dot(self.half[1], self.half[1])
    }

    /// What arrives at a point of a surface with a unit normal.
    pub fn arriving(&self, p: V3, n: V3) -> V3 {
        let d = sub(self.at, p);
        let distance = norm(d).max(1e-3);
        let to = mul(d, 1.0 / distance);
        // A large light over the horizon still shows some of itself.
        let wide = (self.spread().sqrt() / distance).min(1.0);
        let lambert = ((dot(n, to) + 0.3 * wide) / (1.0 + 0.3 * wide)).max(0.0);
        let facing = if self.normal == [0.0; 3] {
            1.0
        } else {
            ((0.15 * wide - dot(self.normal, to)) / (1.0 + 0.15 * wide)).max(0.0)
        };
        mul(self.power, lambert * facing / (distance * distance + 0.5 * self.spread() + 0.01))
    }

    /// A point of it, by two numbers from 0 to 1.
    pub fn point(&self, a: f32, b: f32) -> V3 {
        add(self.at, add(mul(self.half[0], 2.0 * a - 1.0), mul(self.half[1], 2.0 * b - 1.0)))
    }
}

/// The sun: direction to it, and its light per channel before a surface.
#[derive(Clone, Copy, Debug)]
pub(super) struct Sun {
    pub to: V3,
    pub power: V3,
}

/// All lights of a scene.
#[derive(Clone, Debug)]
pub(super) struct Lights {
    pub lamps: Vec<Light>,
    pub sun: Option<Sun>,
    /// Radiance of the sky at the horizon and overhead.
    pub sky: [V3; 2],
    /// What comes from everywhere after many reflections.
    pub ambient: V3,
}

impl Lights {
    /// Radiance of the sky in a direction (unit).
    pub fn sky_in(&self, d: V3) -> V3 {
        crate::scenes::space::mix(self.sky[0], self.sky[1], d[1].max(0.0).sqrt())
    }

    /// What would arrive at a surface if nothing stood in the way of the lamps.
    pub fn unshadowed(&self, p: V3, n: V3) -> V3 {
        self.lamps.iter().fold([0.0; 3], |sum, l| add(sum, l.arriving(p, n)))
    }
}

pub(super) fn luma(c: V3) -> f32 {
    0.3 * c[0] + 0.6 * c[1] + 0.1 * c[2]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn light_falls_off_with_the_distance_and_shines_to_one_side() {
        let lamp = Light::lamp([0.0, 2.0, 0.0], 0.05, [4.0; 3]);
        let (near, far) =
            (lamp.arriving([0.0, 1.0, 0.0], [0.0, 1.0, 0.0])[0], lamp.arriving([0.0; 3], [0.0, 1.0, 0.0])[0]);
        assert!((near / far - 4.0).abs() < 0.1, "{near} {far}");
        assert_eq!(lamp.arriving([0.0, 1.0, 0.0], [0.0, -1.0, 0.0])[0], 0.0);
        let panel = Light { normal: [0.0, -1.0, 0.0], ..lamp };
        assert!(panel.arriving([0.0, 1.0, 0.0], [0.0, 1.0, 0.0])[0] > 3.0);
        assert_eq!(panel.arriving([0.0, 4.0, 0.0], [0.0, -1.0, 0.0])[0], 0.0, "behind it");
    }
}
