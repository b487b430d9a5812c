//! Triangles with what covers them, before they are made ready for rays.

use crate::scenes::space::{V3, dot, mul, sub};

/// Three corners: indices of points, texture coordinates (v up), and the index of a material.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Face {
    pub points: [u32; 3],
    pub uv: [[f32; 2]; 3],
    pub material: u16,
}

/// Points in metres, and triangles between them. Every index of a face is that of a point.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct Geometry {
    pub points: Vec<V3>,
    pub faces: Vec<Face>,
}

#[inline(always)]
pub(super) fn cross(a: V3, b: V3) -> V3 {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}

impl Geometry {
    pub fn corners(&self, face: &Face) -> [V3; 3] {
        face.points.map(|i| self.points[i as usize])
    }

    /// Normal of a face with twice its area as length.
    pub fn normal(&self, face: &Face) -> V3 {
        let [a, b, c] = self.corners(face);
        cross(sub(b, a), sub(c, a))
    }

    /// Least and largest coordinates of the points that faces use; none without a face.
    pub fn bounds(&self) -> Option<(V3, V3)> {
        let mut bounds: Option<(V3, V3)> = None;
        for p in self.faces.iter().flat_map(|f| self.corners(f)) {
            let (low, high) = bounds.get_or_insert((p, p));
            for k in 0..3 {
                low[k] = low[k].min(p[k]);
                high[k] = high[k].max(p[k]);
            }
        }
        bounds
    }

    /// Drops faces without an area and points that no face uses, and joins points at the same place.
    pub fn clean(&mut self) {
        let mut order: Vec<u32> = (0..self.points.len() as u32).collect();
        let key = |i: u32| self.points[i as usize].map(|v| (v + 0.0).to_bits());
        order.sort_unstable_by_key(|&i| (key(i), i));
        let mut same = vec![0; self.points.len()];
        for group in order.chunk_by(|&a, &b| key(a) == key(b)) {
            for &i in group {
                same[i as usize] = group[0];
            }
        }
        let mut faces = std::mem::take(&mut self.faces);
        faces.iter_mut().for_each(|f| f.points = f.points.map(|i| same[i as usize]));
        faces.retain(|f| {
            let n = self.normal(f);
            dot(n, n) > 1e-20
        });
        let mut place = vec![u32::MAX; self.points.len()];
        let mut points = Vec::new();
        for index in faces.iter_mut().flat_map(|f| &mut f.points) {
            let slot = &mut place[*index as usize];
            if *slot == u32::MAX {
                *slot = points.len() as u32;
                points.push(self.points[*index as usize]);
            }
            *index = *slot;
        }
        *self = Self { points, faces };
    }

    /// A normal for each corner of each face: the mean of the faces around the point that bend away by less than 40 degrees,
    /// whichever way these are wound.
    pub fn normals(&self) -> Vec<[V3; 3]> {
        let flat: Vec<V3> = self.faces.iter().map(|f| self.normal(f)).collect();
        let mut start = vec![0u32; self.points.len() + 1];
        for i in self.faces.iter().flat_map(|f| f.points) {
            start[i as usize + 1] += 1;
        }
        for i in 1..start.len() {
            start[i] += start[i - 1];
        }
        let mut around = vec![0u32; start.last().map_or(0, |&n| n as usize)];
        let mut next = start.clone();
        for (k, face) in self.faces.iter().enumerate() {
            for i in face.points {
                around[next[i as usize] as usize] = k as u32;
                next[i as usize] += 1;
            }
        }
        const COS: f32 = 0.766;
        let corner = |own: V3, point: u32| {
            let length = dot(own, own).sqrt();
            let mut sum = [0.0f32; 3];
            for &k in &around[start[point as usize] as usize..start[point as usize + 1] as usize] {
                let n = flat[k as usize];
                let along = dot(n, own);
                if along.abs() > COS * length * dot(n, n).sqrt() {
                    let s = along.signum();
                    (0..3).for_each(|c| sum[c] += s * n[c]);
                }
            }
            mul(sum, 1.0 / dot(sum, sum).sqrt().max(1e-30))
        };
        self.faces.iter().zip(&flat).map(|(f, &own)| f.points.map(|p| corner(own, p))).collect()
    }
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;

    /// A box from `low` to `high`, its sides of one material, wound outwards.
    pub(in crate::scenes::furnished) fn cuboid(low: V3, high: V3, material: u16) -> Geometry {
        let points: Vec<V3> =
            (0..8).map(|i| [0, 1, 2].map(|k| if i >> k & 1 == 1 { high[k] } else { low[k] })).collect();
        let sides = [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]];
        let uv = [[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]];
        let face = |q: [u32; 4], a: usize, b: usize| Face {
            points: [q[0], q[a], q[b]],
            uv: [uv[0], uv[a], uv[b]],
            material,
        };
        Geometry { points, faces: sides.iter().flat_map(|&q| [face(q, 1, 2), face(q, 2, 3)]).collect() }
    }

    #[test]
    fn corners_of_a_box_stay_sharp_and_a_bent_sheet_is_smooth() {
        let cube = cuboid([0.0; 3], [1.0; 3], 0);
        for (face, normals) in cube.faces.iter().zip(cube.normals()) {
            let flat = cube.normal(face);
            assert!(normals.iter().all(|&n| (dot(n, flat) - dot(flat, flat).sqrt()).abs() < 1e-5));
        }
        // Two quads that meet at 20 degrees; the second is wound the other way.
        let points =
            vec![[0.0, 0.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [1.0, 0.0, 1.0], [1.94, 0.342, 0.0]];
        let face = |points| Face { points, uv: [[0.0; 2]; 3], material: 0 };
        let sheet = Geometry { points, faces: vec![face([0, 1, 2]), face([1, 3, 2]), face([2, 4, 3])] };
        let normals = sheet.normals();
        let up = normals[1][2];
        assert!(up[1] > 0.95 && up[0] < -0.1, "{up:?}");
    }

    #[test]
    fn doubles_and_slivers_go() {
        let mut twice = cuboid([0.0; 3], [1.0; 3], 0);
        let n = twice.points.len() as u32;
        let copy = twice.points.clone();
        twice.points.extend(copy);
        twice.points.push([9.0; 3]);
        twice.faces[3].points = twice.faces[3].points.map(|i| i + n);
        twice.faces.push(Face { points: [0, 1, 1 + n], uv: [[0.0; 2]; 3], material: 0 });
        twice.clean();
        assert_eq!((twice.points.len(), twice.faces.len()), (8, 12));
        assert_eq!(twice.bounds(), Some(([0.0; 3], [1.0; 3])));
        assert_eq!(Geometry::default().bounds(), None);
    }
}
