//! Fewer triangles of nearly the same shape: edges are collapsed in the order of the squared distance to the planes that they
//! came from. After Garland and Heckbert, "Surface simplification using quadric error metrics", SIGGRAPH 1997; points are
//! not moved, only joined to a neighbour, so that texture coordinates stay those of the file.

use std::cmp::Reverse;
use std::collections::BinaryHeap;

use super::geometry::{Face, Geometry, cross};
use crate::scenes::space::{V3, dot, sub};

/// Weight of a border against the surfaces at it.
const BORDER: f64 = 10.0;

/// A symmetric form over homogeneous points: a2 ab ac ad b2 bc bd c2 cd d2.
#[derive(Clone, Copy, Default)]
struct Quadric([f64; 10]);

impl Quadric {
    /// Squared distance to the plane through `p` with a normal of any length, times `weight`.
    fn plane(normal: V3, p: V3, weight: f64) -> Self {
        let length = f64::from(dot(normal, normal)).sqrt().max(1e-30);
        let [a, b, c] = normal.map(|v| f64::from(v) / length);
        let d = -(a * f64::from(p[0]) + b * f64::from(p[1]) + c * f64::from(p[2]));
        Self([a * a, a * b, a * c, a * d, b * b, b * c, b * d, c * c, c * d, d * d].map(|v| v * weight))
    }

    fn add(&mut self, other: &Self) {
        self.0.iter_mut().zip(other.0).for_each(|(a, b)| *a += b);
    }

    fn at(&self, p: V3) -> f64 {
        let [x, y, z] = p.map(f64::from);
        let q = &self.0;
        q[0] * x * x
            + q[4] * y * y
            + q[7] * z * z
            + q[9]
            + 2.0 * (q[1] * x * y + q[2] * x * z + q[3] * x + q[5] * y * z + q[6] * y + q[8] * z)
    }
}

/// One collapse that may be done: cost as bits (not negative, so that they sort as it does), the point that goes, the one that
/// stays, and how often each had changed when the cost was found.
type Step = (Reverse<u64>, u32, u32, u32, u32);

/// Reduces `geometry` to about `target` faces. `textured` says of each material whether texture coordinates matter.
///
/// Where no edge can be collapsed any more, as in leaves of a plant, the smallest separate parts are left out.
pub(super) fn simplify(geometry: Geometry, target: usize, textured: &[bool]) -> Geometry {
    if geometry.faces.len() <= target {
        return geometry;
    }
    let mut work = Work::new(geometry, textured);
    let mut heap: BinaryHeap<Step> = BinaryHeap::new();
    for v in 0..work.around.len() as u32 {
        work.push_from(v, &mut heap);
    }
    while work.left > target {
        let Some((_, v, u, version_v, version_u)) = heap.pop() else { break };
        if work.version[v as usize] == version_v && work.version[u as usize] == version_u {
            work.collapse(v, u, &mut heap);
        }
    }
    let faces = work.faces.into_iter().zip(work.alive).filter_map(|(f, alive)| alive.then_some(f)).collect();
    let mut reduced = Geometry { points: work.points, faces };
    reduced.clean();
    prune(&mut reduced, target);
    reduced
}

struct Work<'a> {
    points: Vec<V3>,
    faces: Vec<Face>,
    alive: Vec<bool>,
    left: usize,
    /// Faces at each point; dead ones are dropped when the point changes.
    around: Vec<Vec<u32>>,
    quadric: Vec<Quadric>,
    version: Vec<u32>,
    textured: &'a [bool],
}

impl<'a> Work<'a> {
    fn new(geometry: Geometry, textured: &'a [bool]) -> Self {
        let Geometry { points, faces } = geometry;
        let mut around = vec![Vec::new(); points.len()];
        for (k, face) in faces.iter().enumerate() {
            face.points.iter().for_each(|&i| around[i as usize].push(k as u32));
        }
        let n = points.len();
        let mut work = Self {
            alive: vec![true; faces.len()],
            left: faces.len(),
            points,
            faces,
            around,
            quadric: vec![Quadric::default(); n],
            version: vec![0; n],
            textured,
        };
        work.measure();
        work
    }

    fn normal(&self, p: [u32; 3]) -> V3 {
        let [a, b, c] = p.map(|i| self.points[i as usize]);
        cross(sub(b, a), sub(c, a))
    }

    /// Quadrics of faces, and of borders: edges of one face, of two materials, or where a texture is cut.
    fn measure(&mut self) {
        let mut edges: Vec<(u32, u32, u32)> = Vec::with_capacity(3 * self.faces.len());
        for (k, face) in self.faces.iter().enumerate() {
            let n = self.normal(face.points);
            let area = 0.5 * f64::from(dot(n, n)).sqrt();
            let q = Quadric::plane(n, self.points[face.points[0] as usize], area);
            face.points.iter().for_each(|&i| self.quadric[i as usize].add(&q));
            for c in 0..3 {
                let (a, b) = (face.points[c], face.points[(c + 1) % 3]);
                edges.push((a.min(b), a.max(b), k as u32));
            }
        }
        edges.sort_unstable();
        for edge in edges.chunk_by(|x, y| (x.0, x.1) == (y.0, y.1)) {
            if edge.len() == 2 && self.goes_on(edge[0], edge[1].2) {
                continue;
            }
            for &(a, b, k) in edge {
                let (pa, pb) = (self.points[a as usize], self.points[b as usize]);
                let along = sub(pb, pa);
                let across = cross(along, self.normal(self.faces[k as usize].points));
                let q = Quadric::plane(across, pa, BORDER * f64::from(dot(along, along)));
                self.quadric[a as usize].add(&q);
                self.quadric[b as usize].add(&q);
            }
        }
    }

    /// Whether the same cover goes on over an edge to another face.
    fn goes_on(&self, (a, b, k): (u32, u32, u32), other: u32) -> bool {
        let (f, g) = (&self.faces[k as usize], &self.faces[other as usize]);
        f.material == g.material
            && (!self.matters(f.material) || [a, b].iter().all(|&p| corner_uv(f, p) == corner_uv(g, p)))
    }

    fn matters(&self, material: u16) -> bool {
        self.textured.get(usize::from(material)).copied().unwrap_or(false)
    }

    /// Adds all collapses of a point to a neighbour.
    fn push_from(&self, v: u32, heap: &mut BinaryHeap<Step>) {
        for u in self.neighbours(v) {
            self.push(v, u, heap);
        }
    }

    fn neighbours(&self, v: u32) -> Vec<u32> {
        let faces = self.around[v as usize].iter().filter(|&&k| self.alive[k as usize]);
        let mut list: Vec<u32> =
            faces.flat_map(|&k| self.faces[k as usize].points).filter(|&p| p != v).collect();
        list.sort_unstable();
        list.dedup();
        list
    }

    fn push(&self, v: u32, u: u32, heap: &mut BinaryHeap<Step>) {
        let p = self.points[u as usize];
        let mut q = self.quadric[v as usize];
        q.add(&self.quadric[u as usize]);
        // Among collapses without an error, short edges go first.
        let along = sub(p, self.points[v as usize]);
        let cost = q.at(p).max(0.0) + 1e-9 * f64::from(dot(along, along));
        heap.push((Reverse(cost.to_bits()), v, u, self.version[v as usize], self.version[u as usize]));
    }

    /// Joins `v` to `u` where no face turns over and no texture is torn.
    fn collapse(&mut self, v: u32, u: u32, heap: &mut BinaryHeap<Step>) {
        let mut around = std::mem::take(&mut self.around[v as usize]);
        around.retain(|&k| self.alive[k as usize]);
        let (gone, kept): (Vec<u32>, Vec<u32>) =
            around.iter().partition(|&&k| self.faces[k as usize].points.contains(&u));
        let moved: Option<Vec<Face>> = kept.iter().map(|&k| self.moved(k, v, u, &gone)).collect();
        let Some(moved) = moved else {
            self.around[v as usize] = around;
            return;
        };
        gone.iter().for_each(|&k| self.alive[k as usize] = false);
        self.left -= gone.len();
        for (&k, face) in kept.iter().zip(moved) {
            self.faces[k as usize] = face;
        }
        let quadric = self.quadric[v as usize];
        self.quadric[u as usize].add(&quadric);
        self.around[u as usize].retain(|&k| self.alive[k as usize]);
        self.around[u as usize].extend(kept);
        self.version[v as usize] += 1;
        self.version[u as usize] += 1;
        for w in self.neighbours(u) {
            self.push(u, w, heap);
            self.push(w, u, heap);
        }
    }

    /// The face `k` with `u` in place of `v`.
    fn moved(&self, k: u32, v: u32, u: u32, gone: &[u32]) -> Option<Face> {
        let mut face = self.faces[k as usize];
        let before = self.normal(face.points);
        let corner = face.points.iter().position(|&p| p == v)?;
        face.points[corner] = u;
        let after = self.normal(face.points);
        let bend = dot(before, after);
        if bend <= 0.2 * (dot(before, before) * dot(after, after)).sqrt() {
            return None;
        }
        if self.matters(face.material) {
            let own = face.uv[corner];
            let sides = gone.iter().map(|&g| &self.faces[g as usize]);
            let beside = sides.filter(|g| g.material == face.material && corner_uv(g, v) == Some(own));
            face.uv[corner] = beside.filter_map(|g| corner_uv(g, u)).next()?;
        }
        Some(face)
    }
}

fn corner_uv(face: &Face, point: u32) -> Option<[f32; 2]> {
    face.points.iter().position(|&p| p == point).map(|c| face.uv[c])
}

/// Leaves out the smallest separate parts until there are at most `target` faces.
fn prune(geometry: &mut Geometry, target: usize) {
    if geometry.faces.len() <= target {
        return;
    }
    let mut parent: Vec<u32> = (0..geometry.points.len() as u32).collect();
    fn root(parent: &mut [u32], mut i: u32) -> u32 {
        while parent[i as usize] != i {
            parent[i as usize] = parent[parent[i as usize] as usize];
            i = parent[i as usize];
        }
        i
    }
    for face in &geometry.faces {
        let a = root(&mut parent, face.points[0]);
        for p in &face.points[1..] {
            let b = root(&mut parent, *p);
            parent[b as usize] = a;
        }
    }
    let mut parts = vec![(0.0f32, 0usize); geometry.points.len()];
    for face in &geometry.faces {
        let n = geometry.normal(face);
        let part = &mut parts[root(&mut parent, face.points[0]) as usize];
        part.0 += dot(n, n).sqrt();
        part.1 += 1;
    }
    let mut order: Vec<usize> = (0..parts.len()).filter(|&i| parts[i].1 > 0).collect();
    order.sort_by(|&a, &b| parts[a].0.total_cmp(&parts[b].0));
    let (mut left, mut drop) = (geometry.faces.len(), vec![false; parts.len()]);
    // The largest part always stays.
    for &i in order.iter().take(order.len().saturating_sub(1)) {
        if left <= target {
            break;
        }
        left -= parts[i].1;
        drop[i] = true;
    }
    geometry.faces.retain(|f| !drop[root(&mut parent, f.points[0]) as usize]);
    geometry.clean();
}

#[cfg(test)]
mod tests {
    use super::super::geometry::tests::cuboid;
    use super::*;

    /// A sheet of `n` x `n` quads over the unit square, its texture as wide as it.
    fn sheet(n: u32) -> Geometry {
        let at = |i: u32, j: u32| [i as f32 / n as f32, 0.0, j as f32 / n as f32];
        let points = (0..=n).flat_map(|j| (0..=n).map(move |i| at(i, j))).collect::<Vec<_>>();
        let face = |p: [u32; 3]| Face {
            points: p,
            uv: p.map(|i| [points[i as usize][0], points[i as usize][2]]),
            material: 0,
        };
        let quad = |i: u32, j: u32| {
            let a = j * (n + 1) + i;
            [face([a, a + n + 1, a + 1]), face([a + 1, a + n + 1, a + n + 2])]
        };
        let faces = (0..n).flat_map(|j| (0..n).flat_map(move |i| quad(i, j))).collect();
        Geometry { points: points.clone(), faces }
    }

    fn area(g: &Geometry) -> f32 {
        g.faces.iter().map(|f| 0.5 * dot(g.normal(f), g.normal(f)).sqrt()).sum()
    }

    #[test]
    fn a_flat_sheet_becomes_few_faces_with_the_same_outline_and_texture() {
        let reduced = simplify(sheet(12), 4, &[true]);
        assert!(reduced.faces.len() <= 8, "{}", reduced.faces.len());
        assert!((area(&reduced) - 1.0).abs() < 1e-4, "{}", area(&reduced));
        for face in &reduced.faces {
            for (p, uv) in reduced.corners(face).iter().zip(face.uv) {
                assert_eq!([p[0], p[2]], uv);
            }
            assert!(reduced.normal(face)[1] > 0.0, "turned over");
        }
    }

    #[test]
    fn a_round_body_stays_round() {
        // A ball of 2 * 24 * 12 faces.
        let (n, m) = (24u32, 13u32);
        let point = |i: u32, j: u32| {
            let (a, e) =
                (i as f32 / n as f32 * std::f32::consts::TAU, (j as f32 / (m - 1) as f32 - 0.5) * 3.1);
            [e.cos() * a.cos(), e.sin(), e.cos() * a.sin()]
        };
        let points: Vec<V3> = (0..m).flat_map(|j| (0..n).map(move |i| point(i, j))).collect();
        let quad = |i: u32, j: u32| {
            let (a, b) = (j * n + i, j * n + (i + 1) % n);
            [[a, a + n, b], [b, a + n, b + n]].map(|points| Face { points, uv: [[0.0; 2]; 3], material: 0 })
        };
        let faces = (0..m - 1).flat_map(|j| (0..n).flat_map(move |i| quad(i, j))).collect();
        let ball = Geometry { points, faces };
        let full = area(&ball);
        let reduced = simplify(ball, 150, &[false]);
        assert!(reduced.faces.len() <= 150);
        assert!((area(&reduced) / full - 1.0).abs() < 0.06, "{} of {full}", area(&reduced));
    }

    #[test]
    fn small_parts_go_when_nothing_else_can() {
        let mut many = cuboid([0.0; 3], [1.0; 3], 0);
        for k in 0..10 {
            let part = cuboid([3.0 * k as f32 + 2.0, 0.0, 0.0], [3.0 * k as f32 + 2.5, 0.4, 0.4], 0);
            let base = many.points.len() as u32;
            many.points.extend(&part.points);
            many.faces.extend(part.faces.iter().map(|f| Face { points: f.points.map(|i| i + base), ..*f }));
        }
        let reduced = simplify(many, 24, &[false]);
        assert!(reduced.faces.len() <= 24);
        let (low, high) = reduced.bounds().unwrap();
        assert_eq!((low, high[1]), ([0.0; 3], 1.0), "the large one stays whole");
        let few = cuboid([0.0; 3], [1.0; 3], 0);
        assert_eq!(simplify(few.clone(), 12, &[false]), few);
    }
}
