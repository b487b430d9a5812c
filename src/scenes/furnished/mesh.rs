//! Triangles in a tree of boxes, for rays.

use std::time::Duration;

use glam::Vec3A;
use obvhs::BvhBuildParams;
use obvhs::aabb::Aabb;
use obvhs::cwbvh::CwBvh;
use obvhs::cwbvh::builder::build_cwbvh;
use obvhs::ray::{Ray, RayHit};

use super::geometry::{Face, Geometry, cross};
use crate::scenes::space::{V3, add, dot, mul, sub};

/// A tree over boxes: the number of a box is that of a leaf.
pub(super) struct Tree(CwBvh);

impl Tree {
    /// `quick` for trees of a few boxes that serve one frame.
    pub fn new(boxes: &[(V3, V3)], quick: bool) -> Self {
        let boxes: Vec<Aabb> =
            boxes.iter().map(|&(low, high)| Aabb::new(Vec3A::from(low), Vec3A::from(high))).collect();
        let params = if quick { BvhBuildParams::fast_build() } else { BvhBuildParams::medium_build() };
        Self(build_cwbvh(&boxes, params, &mut Duration::default()))
    }

    /// Boxes in the order in which rays meet them in memory: leaf `k` is box `order()[k]`.
    fn order(&self) -> &[u32] {
        &self.0.primitive_indices
    }

    /// Shows the leaves that a ray may hit to `hit`, near ones first as far as the tree knows; it returns the distance of its hit or
    /// infinity.
    #[inline(always)]
    pub fn nearest(&self, ray: Ray, mut hit: impl FnMut(&Ray, usize) -> f32) {
        let mut found = RayHit::none();
        self.0.ray_traverse(ray, &mut found, |ray, leaf| hit(ray, leaf));
    }

    /// Whether `hit` tells a distance before the ray's end for any leaf.
    #[inline(always)]
    pub fn any(&self, ray: Ray, mut hit: impl FnMut(&Ray, usize) -> f32) -> bool {
        !self.0.ray_traverse_miss(ray, |ray, leaf| hit(ray, leaf))
    }

    /// The box of a leaf.
    #[inline(always)]
    pub fn leaf(&self, leaf: usize) -> usize {
        self.0.primitive_indices[leaf] as usize
    }
}

/// A ray from `o` along `d` (of any length), between two multiples of `d`.
#[inline(always)]
pub(super) fn ray(o: V3, d: V3, from: f32, to: f32) -> Ray {
    Ray::new(Vec3A::from(o), Vec3A::from(d), from, to)
}

/// Corner and edges of a triangle.
#[derive(Clone, Copy)]
struct Shape {
    at: V3,
    edges: [V3; 2],
}

/// What covers a triangle: per corner texture coordinates and a normal (units of 1/32767).
#[derive(Clone, Copy)]
struct Skin {
    uv: [[f32; 2]; 3],
    normals: [[i16; 3]; 3],
    material: u16,
}

/// Where a ray met a triangle.
#[derive(Clone, Copy, Debug)]
pub(super) struct Touch {
    /// Multiple of the ray's direction.
    pub t: f32,
    pub face: u32,
    /// Weights of the second and third corner.
    pub weights: [f32; 2],
}

/// Triangles ready for rays.
pub(super) struct Mesh {
    shapes: Vec<Shape>,
    skins: Vec<Skin>,
    tree: Tree,
    pub low: V3,
    pub high: V3,
}

impl Mesh {
    pub fn new(geometry: &Geometry) -> Self {
        let corners = |f: &Face| geometry.corners(f);
        let boxes: Vec<(V3, V3)> = geometry
            .faces
            .iter()
            .map(|f| {
                let [a, b, c] = corners(f);
                let pick = |f: fn(f32, f32) -> f32| [0, 1, 2].map(|k| f(f(a[k], b[k]), c[k]));
                (pick(f32::min), pick(f32::max))
            })
            .collect();
        let tree = Tree::new(&boxes, false);
        let normals = geometry.normals();
        let (mut shapes, mut skins) = (Vec::new(), Vec::new());
        for &k in tree.order() {
            let face = &geometry.faces[k as usize];
            let [a, b, c] = corners(face);
            shapes.push(Shape { at: a, edges: [sub(b, a), sub(c, a)] });
            let normals = normals[k as usize].map(|n| n.map(|v| (v * 32767.0) as i16));
            skins.push(Skin { uv: face.uv, normals, material: face.material });
        }
        let (low, high) = geometry.bounds().unwrap_or_default();
        Self { shapes, skins, tree, low, high }
    }

    pub fn faces(&self) -> usize {
        self.shapes.len()
    }

    /// Corners of a face.
    pub fn corners(&self, face: u32) -> [V3; 3] {
        let s = &self.shapes[face as usize];
        [s.at, add(s.at, s.edges[0]), add(s.at, s.edges[1])]
    }

    #[inline(always)]
    pub fn material(&self, face: u32) -> u16 {
        self.skins[face as usize].material
    }

    /// Normal of the face's plane; its length is twice the face's area.
    pub fn plane(&self, face: u32) -> V3 {
        let s = &self.shapes[face as usize];
        cross(s.edges[0], s.edges[1])
    }

    /// Normal at a point, as smooth as the surface seems to be.
    pub fn normal(&self, touch: &Touch) -> V3 {
        let n = &self.skins[touch.face as usize].normals;
        let [b, c] = touch.weights;
        let weights = [1.0 - b - c, b, c];
        [0, 1, 2].map(|k| (0..3).map(|i| weights[i] * f32::from(n[i][k])).sum())
    }

    #[inline(always)]
    pub fn uv(&self, touch: &Touch) -> [f32; 2] {
        let uv = &self.skins[touch.face as usize].uv;
        let [b, c] = touch.weights;
        [0, 1].map(|k| uv[0][k] + b * (uv[1][k] - uv[0][k]) + c * (uv[2][k] - uv[0][k]))
    }

    /// Length in texture coordinates of a metre on the face, about.
    pub fn density(&self, face: u32) -> f32 {
        let uv = &self.skins[face as usize].uv;
        let (a, b) = ([uv[1][0] - uv[0][0], uv[1][1] - uv[0][1]], [uv[2][0] - uv[0][0], uv[2][1] - uv[0][1]]);
        let n = self.plane(face);
        ((a[0] * b[1] - a[1] * b[0]).abs() / dot(n, n).sqrt().max(1e-20)).sqrt()
    }

    /// The triangles as they came, in another order, and with points not joined.
    pub fn geometry(&self) -> Geometry {
        let mut geometry = Geometry::default();
        for k in 0..self.shapes.len() as u32 {
            let base = geometry.points.len() as u32;
            geometry.points.extend(self.corners(k));
            let skin = &self.skins[k as usize];
            geometry.faces.push(Face {
                points: [base, base + 1, base + 2],
                uv: skin.uv,
                material: skin.material,
            });
        }
        geometry
    }

    /// The nearest triangle along a ray that `accept` lets count.
    #[inline(always)]
    pub fn nearest(&self, ray: Ray, mut accept: impl FnMut(&Touch) -> bool) -> Option<Touch> {
        let mut best = None;
        self.tree.nearest(ray, |ray, leaf| match self.meet(ray, leaf).filter(|t| accept(t)) {
            Some(touch) => {
                best = Some(touch);
                touch.t
            }
            None => f32::INFINITY,
        });
        best
    }

    /// Whether any triangle that `accept` lets count is on the ray.
    #[inline(always)]
    pub fn any(&self, ray: Ray, mut accept: impl FnMut(&Touch) -> bool) -> bool {
        self.tree
            .any(ray, |ray, leaf| self.meet(ray, leaf).filter(|t| accept(t)).map_or(f32::INFINITY, |t| t.t))
    }

    /// After Möller and Trumbore, "Fast, minimum storage ray/triangle intersection", 1997.
    #[inline(always)]
    fn meet(&self, ray: &Ray, face: usize) -> Option<Touch> {
        let shape = &self.shapes[face];
        let (o, d) = (ray.origin.to_array(), ray.direction.to_array());
        let [e1, e2] = shape.edges;
        let p = cross(d, e2);
        let inverse = 1.0 / dot(e1, p);
        let s = sub(o, shape.at);
        let b = dot(s, p) * inverse;
        let q = cross(s, e1);
        let c = dot(d, q) * inverse;
        let t = dot(e2, q) * inverse;
        // A ray in the triangle's plane gives infinities or NaN, for which none of these holds.
        let inside = (b >= 0.0) & (c >= 0.0) & (b + c <= 1.0) & (t > ray.tmin) & (t < ray.tmax);
        inside.then_some(Touch { t, face: face as u32, weights: [b, c] })
    }
}

/// The point of a ray at a multiple of its direction.
#[inline(always)]
pub(super) fn along(o: V3, d: V3, t: f32) -> V3 {
    add(o, mul(d, t))
}

#[cfg(test)]
mod tests {
    use super::super::geometry::tests::cuboid;
    use super::*;

    #[test]
    fn the_nearest_face_is_found_at_its_distance() {
        let mesh = Mesh::new(&cuboid([-1.0, 0.0, 3.0], [1.0, 2.0, 5.0], 7));
        let look = |o, d| mesh.nearest(ray(o, d, 0.0, 100.0), |_| true);
        let touch = look([0.25, 0.5, 0.0], [0.0, 0.0, 1.0]).unwrap();
        assert_eq!((touch.t, mesh.material(touch.face)), (3.0, 7));
        assert!(mesh.normal(&touch)[2] < -30000.0);
        // The parameter counts multiples of the direction, not metres.
        assert!((look([0.0, 1.0, 0.0], [0.1, 0.0, 2.0]).unwrap().t - 1.5).abs() < 1e-6);
        assert!((look([0.0, 1.0, 4.0], [0.0, 0.0, 1.0]).unwrap().t - 1.0).abs() < 1e-6, "from inside");
        assert!(look([2.0, 1.0, 0.0], [0.0, 0.0, 1.0]).is_none());
        assert!(mesh.nearest(ray([0.0, 1.0, 0.0], [0.0, 0.0, 1.0], 0.0, 2.9), |_| true).is_none());
        let behind = mesh.nearest(ray([0.25, 0.5, 0.0], [0.0, 0.0, 1.0], 0.0, 100.0), |t| t.t > 3.5).unwrap();
        assert_eq!(behind.t, 5.0, "a face that does not count is seen through");
        assert!(mesh.any(ray([0.25, 0.5, 0.0], [0.0, 0.0, 1.0], 0.0, 100.0), |_| true));
        assert!(!mesh.any(ray([0.25, 0.5, 0.0], [0.0, 0.0, -1.0], 0.0, 100.0), |_| true));
    }

    #[test]
    fn one_triangle_and_many_are_found_alike() {
        let face = Face { points: [0, 1, 2], uv: [[0.0, 0.0], [2.0, 0.0], [0.0, 2.0]], material: 0 };
        let points = vec![[0.0, 0.0, 1.0], [1.0, 0.0, 1.0], [0.0, 1.0, 1.0]];
        let one = Mesh::new(&Geometry { points: points.clone(), faces: vec![face] });
        let touch = one.nearest(ray([0.2, 0.3, 0.0], [0.0, 0.0, 1.0], 0.0, 9.0), |_| true).unwrap();
        let uv = one.uv(&touch);
        assert!((uv[0] - 0.4).abs() < 1e-6 && (uv[1] - 0.6).abs() < 1e-6, "{uv:?}");
        assert!((one.density(0) - 2.0).abs() < 1e-5);
        assert_eq!(one.geometry().faces.len(), 1);
        let same = Mesh::new(&Geometry { points, faces: vec![face; 3000] });
        assert_eq!(same.nearest(ray([0.2, 0.3, 0.0], [0.0, 0.0, 1.0], 0.0, 9.0), |_| true).unwrap().t, 1.0);
    }
}
