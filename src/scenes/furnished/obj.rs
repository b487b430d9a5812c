//! OBJ and MTL files, from folders that anyone may have filled.
//!
//! `tobj` reads them. It trusts numbers that a damaged file may hold (a colour of two values, an index before the first
//! vertex), so that every line is looked at first.

use std::cell::RefCell;
use std::io::Cursor;
use std::path::{Path, PathBuf};

use tobj::LoadOptions;

use super::catalogue::contained;
use super::geometry::{Face, Geometry};
use crate::error::{Error, Result};
use crate::files::read_within;
use crate::scenes::space::V3;

/// Bytes of an OBJ and of an MTL file, at most.
const LONGEST: u64 = 256 << 20;
const LONGEST_MATERIALS: u64 = 4 << 20;

/// Vertices and faces of a model, at most.
const MOST: usize = 4 << 20;

/// Corners of one face, at most.
const CORNERS: usize = 1024;

/// Materials of a model, at most.
const MATERIALS: usize = 255;

/// What covers a surface, as an MTL file tells of it. Colours as they are shown, 0 to 1.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Material {
    pub name: String,
    pub diffuse: V3,
    pub specular: V3,
    pub exponent: f32,
    /// 0 is clear, 1 opaque.
    pub opacity: f32,
    /// Its own light.
    pub glow: f32,
    pub texture: Option<PathBuf>,
    pub mask: Option<PathBuf>,
}

impl Default for Material {
    fn default() -> Self {
        Self {
            name: String::new(),
            diffuse: [0.7; 3],
            specular: [0.0; 3],
            exponent: 10.0,
            opacity: 1.0,
            glow: 0.0,
            texture: None,
            mask: None,
        }
    }
}

/// A model's triangles in the file's units and axes, and its materials (at least one).
///
/// Fails with [`Error::Io`] or [`Error::Format`], naming the file and, where there is one, the line. Materials and textures that
/// are not there do not count: published libraries name files of their authors' machines.
pub(super) fn read(path: &Path) -> Result<(Geometry, Vec<Material>)> {
    let bytes = read_within(path, LONGEST)?;
    let text = String::from_utf8_lossy(&bytes);
    screen(path, &text)?;
    let folder = path.parent().unwrap_or(Path::new(""));
    let failed = RefCell::new(None);
    let options =
        LoadOptions { triangulate: true, ignore_points: true, ignore_lines: true, ..Default::default() };
    let loaded = tobj::load_obj_buf(&mut Cursor::new(text.as_bytes()), &options, |name| {
        materials(folder, name).map_err(|e| {
            *failed.borrow_mut() = Some(e);
            tobj::LoadError::ReadError
        })
    });
    if let Some(error) = failed.into_inner() {
        return Err(error);
    }
    let wrong = |e: tobj::LoadError| Error::format(path, e.to_string(), "a Wavefront OBJ file");
    let (models, found) = loaded.map_err(wrong)?;
    let found = found.map_err(wrong)?;
    if found.len() >= MATERIALS {
        return Err(Error::format(path, format!("{} materials", found.len()), format!("below {MATERIALS}")));
    }
    // Faces without a material take the one at the end.
    let plain = found.len();
    let mut geometry = Geometry::default();
    for model in &models {
        append(&mut geometry, &model.mesh, model.mesh.material_id.unwrap_or(plain) as u16);
    }
    if geometry.points.iter().flatten().any(|v| !v.is_finite() || v.abs() > 1e9) {
        return Err(Error::format(path, "a vertex that is not finite or beyond 1e9", "vertices of a model"));
    }
    geometry.clean();
    if geometry.faces.is_empty() {
        return Err(Error::format(path, "no face with an area", "at least one"));
    }
    let mut list: Vec<Material> = found.iter().map(|m| material(folder, m)).collect();
    list.push(Material::default());
    Ok((geometry, list))
}

fn append(into: &mut Geometry, mesh: &tobj::Mesh, material: u16) {
    let base = into.points.len() as u32;
    into.points.extend(mesh.positions.chunks_exact(3).map(|p| [p[0], p[1], p[2]]));
    let uv = |corner: usize| {
        let at = mesh.texcoord_indices.get(corner).map_or(usize::MAX, |&i| i as usize).saturating_mul(2);
        let pair =
            at.checked_add(1).and_then(|last| Some([*mesh.texcoords.get(at)?, *mesh.texcoords.get(last)?]));
        pair.filter(|uv| uv.iter().all(|v| v.abs() < 1e4)).unwrap_or_default()
    };
    for (k, corners) in mesh.indices.chunks_exact(3).enumerate() {
        let points = [base + corners[0], base + corners[1], base + corners[2]];
        into.faces.push(Face { points, uv: [uv(3 * k), uv(3 * k + 1), uv(3 * k + 2)], material });
    }
}

/// Fails on lines that would make the reader stop the program or take up memory without end.
fn screen(path: &Path, text: &str) -> Result<()> {
    let (mut points, mut textures, mut normals, mut faces) = (0usize, 0usize, 0usize, 0usize);
    for (number, line) in text.lines().enumerate() {
        let mut words = line.split_whitespace();
        let fail = |found: String, expected: &str| {
            Err(Error::format(path, format!("line {}: {found}", number + 1), expected.to_string()))
        };
        match words.next() {
            Some("v") => points += 1,
            Some("vt") => textures += 1,
            Some("vn") => normals += 1,
            Some("f" | "l") => {
                let mut corners = 0;
                for word in words {
                    corners += 1;
                    let whole = word.split('/').zip([points, textures, normals]).all(|(i, n)| fits(i, n));
                    if !whole || word.split('/').count() > 3 || corners > CORNERS {
                        return fail(
                            format!("face corner `{word}`"),
                            "indices of vertices that were given before, at most 1024 corners",
                        );
                    }
                }
                faces += corners.max(3) - 2;
            }
            _ => {}
        }
        if points.max(textures).max(normals).max(faces) > MOST {
            return fail(
                format!("more than {MOST} vertices or triangles"),
                "a model of a piece of furniture",
            );
        }
    }
    Ok(())
}

/// Whether an index of a face, empty or counted from 1 or back from the end, is one of `n`.
fn fits(index: &str, n: usize) -> bool {
    index.is_empty() || index.parse::<i64>().is_ok_and(|i| i != 0 && i.unsigned_abs() <= n as u64)
}

fn materials(folder: &Path, name: &Path) -> Result<(Vec<tobj::Material>, Numbers)> {
    let wrong = |found: String, expected: &str| Error::format(folder.join(name), found, expected);
    let inside = name.to_str().and_then(contained);
    let path =
        folder.join(inside.ok_or_else(|| wrong("an outer path".into(), "a file in the model's folder"))?);
    if !path.exists() {
        return Ok(Default::default());
    }
    let bytes = read_within(&path, LONGEST_MATERIALS)?;
    let text = String::from_utf8_lossy(&bytes);
    for (number, line) in text.lines().enumerate() {
        let mut words = line.split_whitespace();
        if matches!(words.next(), Some("Ka" | "Kd" | "Ks" | "Ke")) && words.count() < 3 {
            return Err(wrong(format!("line {}: `{}`", number + 1, line.trim()), "three values of a colour"));
        }
    }
    tobj::load_mtl_buf(&mut Cursor::new(text.as_bytes()))
        .map_err(|e| wrong(e.to_string(), "a Wavefront MTL file"))
}

/// Numbers of materials by their names, as `tobj` returns them.
type Numbers = std::collections::HashMap<String, usize>;

fn material(folder: &Path, m: &tobj::Material) -> Material {
    let colour = |c: Option<[f32; 3]>, default: f32| {
        c.map_or([default; 3], |c| c.map(|v| if v.is_finite() { v.clamp(0.0, 1.0) } else { default }))
    };
    let number = |v: Option<f32>, low: f32, high: f32, default: f32| {
        v.filter(|v| v.is_finite()).map_or(default, |v| v.clamp(low, high))
    };
    let file = |name: &Option<String>| {
        let name = name.as_ref()?.replace('\\', "/");
        // Options come before the name; paths of other machines end in a name that may lie here.
        let last = name.rsplit('/').next()?;
        let tried = [Some(name.as_str()), Some(last), name.split_whitespace().last()];
        tried.into_iter().flatten().filter_map(contained).map(|p| folder.join(p)).find(|p| p.is_file())
    };
    let glow = colour(m.emissive, 0.0);
    Material {
        name: m.name.clone(),
        diffuse: colour(m.diffuse, 0.7),
        specular: colour(m.specular, 0.0),
        exponent: number(m.shininess, 0.0, 1000.0, 10.0),
        opacity: number(m.dissolve, 0.0, 1.0, 1.0),
        glow: glow.iter().copied().fold(0.0, f32::max),
        texture: file(&m.diffuse_texture),
        mask: file(&m.dissolve_texture),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::fs;

    const QUAD: &str = "mtllib m.mtl\nv 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 1 1\n\
        o quad\nusemtl red\nf 1/1 2/2 3/3 4/1\n";
    const RED: &str = "newmtl red\nKd 1 0.5 0\nd 0.25\nNs 90\nmap_Kd C:\\pictures\\t.png\n";

    fn try_files(obj: &str, mtl: &str) -> Result<(Geometry, Vec<Material>)> {
        let dir = tempfile::tempdir().unwrap();
        fs::write(dir.path().join("m.mtl"), mtl).unwrap();
        fs::write(dir.path().join("t.png"), "").unwrap();
        fs::write(dir.path().join("a.obj"), obj).unwrap();
        read(&dir.path().join("a.obj"))
    }

    #[test]
    fn faces_keep_their_texture_coordinates_and_material() {
        let (geometry, materials) = try_files(QUAD, RED).unwrap();
        assert_eq!((geometry.points.len(), geometry.faces.len(), materials.len()), (4, 2, 2));
        assert_eq!(geometry.faces[0].uv, [[0.0, 0.0], [1.0, 0.0], [1.0, 1.0]]);
        assert_eq!(geometry.faces[1].material, 0);
        let red = &materials[0];
        assert_eq!((red.diffuse, red.opacity, red.exponent), ([1.0, 0.5, 0.0], 0.25, 90.0));
        assert!(red.texture.as_ref().unwrap().ends_with("t.png") && red.mask.is_none());
    }

    #[test]
    fn corners_without_texture_coordinates_do_not_shift_others() {
        let mixed = format!("{QUAD}f 1 2 3\nf 2/2 3/3 1/1\n");
        let (geometry, _) = try_files(&mixed, RED).unwrap();
        assert_eq!(geometry.faces[2].uv, [[0.0; 2]; 3]);
        assert_eq!(geometry.faces[3].uv, [[1.0, 0.0], [1.0, 1.0], [0.0, 0.0]]);
    }

    #[test]
    fn damaged_files_are_named_with_their_line() {
        for (line, place) in [
            ("f 1 2 9", "line 12"),
            ("f 0 1 2", "line 12"),
            ("f 1/1/-5 2 3", "line 12"),
            ("f 1//-9223372036854775807 2 3", "line 12"),
            ("f 1/2/3/4 2 3", "line 12"),
            ("f 1 2 x", "line 12"),
            ("v 1 2", "position"),
            ("v nan 2 3\nf 5 1 2", "finite"),
            ("mtllib ../m.mtl", "outer path"),
        ] {
            match try_files(&format!("{QUAD}{line}\n"), RED) {
                Err(Error::Format { found, .. }) => assert!(found.contains(place), "{line}: {found}"),
                other => panic!("{line}: {other:?}"),
            }
        }
        for mtl in ["newmtl red\nKd 1 2\n", "newmtl\n", "newmtl red\nNs x\n"] {
            assert!(matches!(try_files(QUAD, mtl), Err(Error::Format { .. })), "{mtl}");
        }
        let plain = try_files(&QUAD.replace("m.mtl", "none.mtl"), RED).unwrap();
        assert_eq!((plain.1.len(), plain.0.faces[0].material), (1, 0), "faces without materials are grey");
        assert!(matches!(try_files("v 0 0 0\n", RED), Err(Error::Format { .. })));
    }
}
