//! Meshes at their places, and rays through them.

use std::sync::Arc;

use super::look::{Look, Stop};
use super::mesh::{Mesh, Touch, Tree, ray};
use crate::scenes::space::{Rot, V3, add, sub, to_local, to_world, turned};

/// A mesh at a place.
pub(super) struct Instance {
    pub mesh: Arc<Mesh>,
    pub at: V3,
    pub axes: Rot,
    /// Number of its first look; materials count on from there.
    pub looks: usize,
}

impl Instance {
    pub fn new(mesh: Arc<Mesh>, at: V3, yaw: f32, looks: usize) -> Self {
        Self { mesh, at, axes: turned(yaw, 0.0, 0.0), looks }
    }

    pub fn local(&self, p: V3) -> V3 {
        to_local(&self.axes, sub(p, self.at))
    }

    fn bounds(&self) -> (V3, V3) {
        let (mut low, mut high) = ([f32::INFINITY; 3], [f32::NEG_INFINITY; 3]);
        for corner in 0..8 {
            let local =
                [0, 1, 2].map(|k| if corner >> k & 1 == 1 { self.mesh.high[k] } else { self.mesh.low[k] });
            let p = add(self.at, to_world(&self.axes, local));
            for k in 0..3 {
                // A little more than the mesh, so that rounding loses nothing at its borders.
                low[k] = low[k].min(p[k] - 1e-4);
                high[k] = high[k].max(p[k] + 1e-4);
            }
        }
        (low, high)
    }
}

/// A hit: which instance, and where on its mesh.
#[derive(Clone, Copy, Debug)]
pub(super) struct Hit {
    pub instance: u32,
    pub touch: Touch,
}

/// Everything that rays can meet.
pub(super) struct Scene {
    pub instances: Vec<Instance>,
    pub looks: Vec<Look>,
    tree: Tree,
    /// Instances with glass, and the tree over them.
    glass: Vec<u32>,
    glass_tree: Option<Tree>,
}

impl Scene {
    /// Every material of a mesh must have a look.
    pub fn new(instances: Vec<Instance>, looks: Vec<Look>) -> Self {
        let boxes: Vec<(V3, V3)> = instances.iter().map(Instance::bounds).collect();
        let has_glass = |i: &Instance| {
            (0..i.mesh.faces() as u32)
                .any(|f| looks[i.looks + usize::from(i.mesh.material(f))].stop == Stop::Never)
        };
        let glass: Vec<u32> =
            (0..instances.len() as u32).filter(|&i| has_glass(&instances[i as usize])).collect();
        let glass_boxes: Vec<(V3, V3)> = glass.iter().map(|&i| boxes[i as usize]).collect();
        let glass_tree = (!glass.is_empty()).then(|| Tree::new(&glass_boxes, true));
        Self { tree: Tree::new(&boxes, true), instances, looks, glass, glass_tree }
    }

    pub fn look(&self, hit: &Hit) -> &Look {
        let instance = &self.instances[hit.instance as usize];
        &self.looks[instance.looks + usize::from(instance.mesh.material(hit.touch.face))]
    }

    /// The first surface along a ray that stops it: `t` counts multiples of `d`.
    pub fn nearest(&self, o: V3, d: V3, from: f32, to: f32) -> Option<Hit> {
        let mut best = None;
        self.tree.nearest(ray(o, d, from, to), |world, leaf| {
            let index = self.tree.leaf(leaf);
            let i = &self.instances[index];
            let local = ray(i.local(o), to_local(&i.axes, d), from, world.tmax);
            let stops =
                |t: &Touch| self.looks[i.looks + usize::from(i.mesh.material(t.face))].stops(&i.mesh, t);
            match i.mesh.nearest(local, stops) {
                Some(touch) => {
                    best = Some(Hit { instance: index as u32, touch });
                    touch.t
                }
                None => f32::INFINITY,
            }
        });
        best
    }

    /// Whether something that stops light is on a ray.
    pub fn blocked(&self, o: V3, d: V3, from: f32, to: f32) -> bool {
        self.tree.any(ray(o, d, from, to), |_, leaf| {
            let i = &self.instances[self.tree.leaf(leaf)];
            let local = ray(i.local(o), to_local(&i.axes, d), from, to);
            let stops =
                |t: &Touch| self.looks[i.looks + usize::from(i.mesh.material(t.face))].stops(&i.mesh, t);
            if i.mesh.any(local, stops) { from } else { f32::INFINITY }
        })
    }

    /// The share of light that glass lets through along a ray, per channel, and how much it adds of what is around it.
    pub fn glass(&self, o: V3, d: V3, to: f32) -> Option<(V3, f32)> {
        let tree = self.glass_tree.as_ref()?;
        let (mut through, mut shine) = ([1.0f32; 3], 0.0f32);
        tree.any(ray(o, d, 1e-3, to), |world, leaf| {
            let i = &self.instances[self.glass[tree.leaf(leaf)] as usize];
            let local = ray(i.local(o), to_local(&i.axes, d), world.tmin, world.tmax);
            let look = |t: &Touch| &self.looks[i.looks + usize::from(i.mesh.material(t.face))];
            i.mesh.any(local, |t| {
                let look = look(t);
                if look.stop == Stop::Never {
                    for (k, share) in through.iter_mut().enumerate() {
                        let tint = 1.0 - look.opacity * (1.0 - look.colour[k]);
                        *share *= tint * (1.0 - 0.4 * look.opacity);
                    }
                    shine = (shine + 0.03 + 0.08 * look.opacity).min(0.3);
                }
                false
            });
            f32::INFINITY
        });
        (shine > 0.0).then_some((through, shine))
    }
}
