//! One model of a library, of its true size and ready for rays.

use std::sync::{Arc, OnceLock};

use super::catalogue::Entry;
use super::geometry::Geometry;
use super::mesh::{Mesh, ray};
use super::obj;
use super::profile::Profile;
use super::role::Role;
use super::texture::Texture;
use crate::scenes::space::{V3, norm, to_local};

/// What covers part of a model.
#[derive(Clone, Debug)]
pub(super) struct Cover {
    /// Colour as it is shown, 0 to 1; a texture takes its place.
    pub colour: V3,
    pub texture: Option<Arc<Texture>>,
    /// Where this picture is dark, there is nothing.
    pub mask: Option<Arc<Texture>>,
    /// 0 is clear, 1 opaque.
    pub opacity: f32,
    /// Strength and sharpness of highlights.
    pub gloss: f32,
    pub exponent: f32,
    /// Its own light.
    pub glow: f32,
}

/// Opacity below which a surface is glass: seen in the picture, but not measured.
pub(super) const CLEAR: f32 = 0.5;

impl Cover {
    pub fn new(m: &obj::Material, texture: Option<Arc<Texture>>, mask: Option<Arc<Texture>>) -> Self {
        let gloss = m.specular.iter().sum::<f32>() / 3.0;
        Self {
            colour: m.diffuse,
            texture,
            mask,
            opacity: m.opacity,
            gloss,
            exponent: m.exponent,
            glow: m.glow.min(1.0),
        }
    }

    pub fn is_clear(&self) -> bool {
        self.opacity < CLEAR && self.mask.is_none()
    }
}

/// A model and what its catalogue says.
///
/// Its frame: x to the left of who faces its front, y up, z out of its front, metres; the origin is in the middle of its lowest
/// side. (Files have x to the right: the crate's world is left-handed, and a model must not become its mirror image.)
pub(super) struct Model {
    pub entry: Entry,
    pub role: Role,
    pub mesh: Arc<Mesh>,
    pub covers: Vec<Cover>,
    profile: OnceLock<Profile>,
}

impl Model {
    pub fn new(entry: Entry, role: Role, geometry: &Geometry, covers: Vec<Cover>) -> Self {
        Self { entry, role, mesh: Arc::new(Mesh::new(geometry)), covers, profile: OnceLock::new() }
    }

    /// Width, height and depth, metres.
    pub fn size(&self) -> V3 {
        self.entry.size
    }

    /// Half the sides of the rectangle that it takes up on the floor.
    pub fn half(&self) -> [f32; 2] {
        [0.5 * self.entry.size[0], 0.5 * self.entry.size[2]]
    }

    pub fn profile(&self) -> &Profile {
        self.profile.get_or_init(|| Profile::new(&self.mesh, |material| self.is_glass(material)))
    }

    fn is_glass(&self, material: u16) -> bool {
        self.covers.get(usize::from(material)).is_some_and(Cover::is_clear)
    }

    /// Whether a box (half sides, turned by `yaw`, `tall`) can stand on a board of this height at a place of the model's frame.
    ///
    /// The profile's cells may miss a rail between two of them; what is right below and above the box decides.
    pub fn carries(&self, at: [f32; 2], half: [f32; 2], yaw: f32, height: f32, tall: f32) -> bool {
        let (s, c) = yaw.sin_cos();
        let level = |i: i32, j: i32| {
            let (x, z) = (0.5 * i as f32 * half[0], 0.5 * j as f32 * half[1]);
            let from = [at[0] + c * x + s * z, height + 0.005, at[1] - s * x + c * z];
            let down = ray(from, [0.0, -1.0, 0.0], 0.0, 0.009);
            let up = ray(from, [0.0, 1.0, 0.0], 0.0, tall);
            self.mesh.any(down, |t| !self.is_glass(self.mesh.material(t.face)))
                && !self.mesh.any(up, |_| true)
        };
        self.profile().carries(at, half, yaw, height, tall) && (-2..=2).all(|i| (-2..=2).all(|j| level(i, j)))
    }

    /// The cover of the largest part of its surface.
    pub fn main_cover(&self) -> Option<usize> {
        let mut areas = vec![0.0f32; self.covers.len()];
        for face in 0..self.mesh.faces() as u32 {
            if let Some(area) = areas.get_mut(usize::from(self.mesh.material(face))) {
                *area += norm(self.mesh.plane(face));
            }
        }
        (0..areas.len()).max_by(|&a, &b| areas[a].total_cmp(&areas[b]))
    }

    /// Whether it belongs to the models that training never sees: a fifth of all, by their ids.
    pub fn held_out(&self) -> bool {
        let hash = self
            .entry
            .id
            .bytes()
            .fold(0xcbf2_9ce4_8422_2325_u64, |h, b| (h ^ u64::from(b)).wrapping_mul(0x0100_0000_01b3));
        (hash >> 32).is_multiple_of(5)
    }
}

/// Brings a file's triangles into the model's frame and to the catalogue's size. A side without extent stays as it is.
pub(super) fn fit(geometry: &mut Geometry, entry: &Entry) {
    for p in &mut geometry.points {
        let [x, y, z] = to_local(&entry.rotation, *p);
        *p = [-x, y, z];
    }
    // The mirror turned every face over.
    for face in &mut geometry.faces {
        face.points.swap(1, 2);
        face.uv.swap(1, 2);
    }
    let Some((low, high)) = geometry.bounds() else { return };
    let scale =
        [0, 1, 2].map(|k| if high[k] - low[k] > 1e-9 { entry.size[k] / (high[k] - low[k]) } else { 1.0 });
    let origin = [0.5 * (low[0] + high[0]), low[1], 0.5 * (low[2] + high[2])];
    for p in &mut geometry.points {
        *p = [0, 1, 2].map(|k| (p[k] - origin[k]) * scale[k]);
    }
}

#[cfg(test)]
pub(super) mod tests {
    use super::super::geometry::Face;
    use super::super::geometry::tests::cuboid;
    use super::*;
    use crate::scenes::space::UPRIGHT;
    use std::path::PathBuf;

    pub(in crate::scenes::furnished) fn entry(id: &str, name: &str, category: &str, size: V3) -> Entry {
        Entry {
            id: id.to_string(),
            name: name.to_string(),
            tags: String::new(),
            category: category.to_string(),
            author: "A".to_string(),
            licence: "CC0".to_string(),
            file: PathBuf::new(),
            size,
            elevation: 0.0,
            opening: false,
            behind: size[2],
            rotation: UPRIGHT,
        }
    }

    #[test]
    fn a_file_is_scaled_centred_and_not_mirrored() {
        // A mark on the right of the front, as a viewer of the file sees it.
        let mut g = cuboid([0.0, 0.0, 0.0], [2.0, 4.0, 6.0], 0);
        let base = g.points.len() as u32;
        g.points.extend([[1.5, 1.0, 6.0], [2.0, 1.0, 6.0], [2.0, 2.0, 6.0]]);
        g.faces.push(Face { points: [base, base + 1, base + 2], uv: [[0.0; 2]; 3], material: 1 });
        let e = entry("a", "Box", "", [0.5, 1.0, 3.0]);
        fit(&mut g, &e);
        assert_eq!(g.bounds().unwrap(), ([-0.25, 0.0, -1.5], [0.25, 1.0, 1.5]));
        // The crate's world has x to the right when z points away, so that the viewer in front, who looks along -z, has -x to
        // the right.
        let mark = g.corners(g.faces.last().unwrap());
        assert!(mark.iter().all(|p| p[0] <= -0.12 && p[2] == 1.5), "{mark:?}");
    }

    #[test]
    fn files_with_other_axes_are_turned() {
        // Height along z in the file, as the catalogue's matrix says: y' = z, z' = -y.
        let mut g = cuboid([0.0; 3], [1.0, 2.0, 3.0], 0);
        let mut e = entry("a", "Box", "", [1.0, 3.0, 2.0]);
        e.rotation = [[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]];
        fit(&mut g, &e);
        assert_eq!(g.bounds().unwrap(), ([-0.5, 0.0, -1.0], [0.5, 3.0, 1.0]));
    }
}
