//! Reads what [`Library::pack`](super::Library::pack) wrote, or someone else.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use safetensors::{Dtype, SafeTensors};

use super::catalogue::Entry;
use super::geometry::{Face, Geometry};
use super::model::{Cover, Model};
use super::packed::{CATALOGUE, Catalogue, FORMAT, Packed, TENSORS};
use super::role::role;
use super::texture::Texture;
use crate::error::{Error, Result};
use crate::files::read_within;
use crate::scenes::space::{UPRIGHT, V3};

/// Bytes of a packed file, at most.
const LONGEST: u64 = 1 << 30;

/// Whether [`read`] reads this folder.
pub(super) fn is_packed(dir: &Path) -> bool {
    dir.join(CATALOGUE).is_file()
}

/// Reads what [`Library::pack`] wrote.
pub(super) fn read(dir: &Path) -> Result<Vec<Arc<Model>>> {
    let (path, list) = (dir.join(TENSORS), dir.join(CATALOGUE));
    let catalogue: Catalogue = serde_json::from_slice(&read_within(&list, LONGEST)?)
        .map_err(|e| Error::format(&list, e.to_string(), "a catalogue of packed furniture"))?;
    if catalogue.format != FORMAT {
        return Err(Error::format(&list, format!("format `{}`", catalogue.format), FORMAT));
    }
    let bytes = read_within(&path, LONGEST)?;
    let file = SafeTensors::deserialize(&bytes)
        .map_err(|e| Error::format(&path, e.to_string(), "a whole safetensors file"))?;
    let mut reader = Reader { path: &path, file, textures: BTreeMap::new() };
    let models = catalogue.models.into_iter().enumerate();
    models.filter_map(|(i, packed)| reader.model(i, packed).transpose()).collect()
}

struct Reader<'a> {
    path: &'a Path,
    file: SafeTensors<'a>,
    textures: BTreeMap<usize, Arc<Texture>>,
}

impl Reader<'_> {
    fn wrong(&self, found: impl Into<String>, expected: &str) -> Error {
        Error::format(self.path, found, expected)
    }

    /// The bytes of a tensor of a given type whose shape ends in `tail`, and its first size.
    fn tensor(&self, name: &str, dtype: Dtype, tail: &[usize]) -> Result<(usize, &[u8])> {
        let t =
            self.file.tensor(name).map_err(|e| self.wrong(format!("`{name}`: {e}"), "a packed tensor"))?;
        match t.shape().split_first() {
            Some((&n, rest)) if rest == tail && t.dtype() == dtype && n > 0 => Ok((n, t.data())),
            _ => {
                Err(self.wrong(format!("`{name}` is {:?} {:?}", t.dtype(), t.shape()), "its type and shape"))
            }
        }
    }

    fn model(&mut self, index: usize, p: Packed) -> Result<Option<Arc<Model>>> {
        let numbers = p.size.iter().chain(p.bounds.iter().flatten()).chain(p.uv.iter().flatten().flatten());
        let sound =
            numbers.copied().all(|v| v.is_finite() && v.abs() < 1e4) && p.size.iter().all(|&v| v > 0.0);
        let covers = p
            .covers
            .iter()
            .flat_map(|c| [c.opacity, c.gloss, c.exponent, c.glow].into_iter().chain(c.colour));
        let others = covers.chain([p.behind, p.elevation]);
        if !sound || others.into_iter().any(|v| !(0.0..=1000.0).contains(&v)) {
            return Err(
                self.wrong(format!("model `{}` with a size or colour out of its range", p.id), "a model")
            );
        }
        let geometry = self.geometry(index, &p)?;
        let mut covers = Vec::new();
        for c in &p.covers {
            covers.push(Cover {
                colour: c.colour,
                texture: self.texture(c.texture)?,
                mask: self.texture(c.mask)?,
                opacity: c.opacity,
                gloss: c.gloss,
                exponent: c.exponent,
                glow: c.glow,
            });
        }
        let entry = Entry {
            id: p.id,
            name: p.name,
            tags: p.tags,
            category: p.category,
            author: p.author,
            licence: p.licence,
            file: PathBuf::new(),
            size: p.size,
            elevation: p.elevation,
            opening: p.opening,
            behind: p.behind,
            rotation: UPRIGHT,
        };
        Ok(role(&entry).map(|role| Arc::new(Model::new(entry, role, &geometry, covers))))
    }

    fn geometry(&self, index: usize, p: &Packed) -> Result<Geometry> {
        let (n, points) = self.tensor(&format!("{index}.points"), Dtype::U16, &[3])?;
        let (m, faces) = self.tensor(&format!("{index}.faces"), Dtype::U32, &[3])?;
        let (k, material) = self.tensor(&format!("{index}.material"), Dtype::U8, &[])?;
        let part = |two: &[u8], low: f32, high: f32| {
            let t = f32::from(u16::from_le_bytes([two[0], two[1]])) / 65535.0;
            low + t * (high - low)
        };
        let [low, high] = p.bounds;
        let point = |six: &[u8]| [0, 1, 2].map(|c| part(&six[2 * c..], low[c], high[c]));
        let points: Vec<V3> = points.chunks_exact(6).map(point).collect();
        let corner = |b: &[u8]| u32::from_le_bytes([b[0], b[1], b[2], b[3]]);
        let faces: Vec<[u32; 3]> =
            faces.chunks_exact(12).map(|b| [corner(b), corner(&b[4..]), corner(&b[8..])]).collect();
        let uv = match p.uv {
            Some([low, high]) => {
                let (c, uv) = self.tensor(&format!("{index}.uv"), Dtype::U16, &[3, 2])?;
                if c != m {
                    return Err(self.wrong(format!("{c} texture coordinates for {m} faces"), "one for each"));
                }
                let pair = |b: &[u8]| [part(b, low[0], high[0]), part(&b[2..], low[1], high[1])];
                uv.chunks_exact(12).map(|b| [pair(b), pair(&b[4..]), pair(&b[8..])]).collect()
            }
            None => vec![[[0.0; 2]; 3]; m],
        };
        let fits = faces.iter().flatten().all(|&i| (i as usize) < n)
            && k == m
            && material.iter().all(|&i| usize::from(i) < p.covers.len());
        if !fits {
            return Err(
                self.wrong(format!("model `{}` with a face that names no point or cover", p.id), "a model")
            );
        }
        let face = |((&points, &uv), &m)| Face { points, uv, material: u16::from(m) };
        let mut geometry =
            Geometry { points, faces: faces.iter().zip(&uv).zip(material).map(face).collect() };
        geometry.clean();
        if geometry.faces.is_empty() {
            return Err(self.wrong(format!("model `{}` without a face", p.id), "a model"));
        }
        Ok(geometry)
    }

    fn texture(&mut self, index: Option<usize>) -> Result<Option<Arc<Texture>>> {
        let Some(k) = index else { return Ok(None) };
        if let Some(texture) = self.textures.get(&k) {
            return Ok(Some(texture.clone()));
        }
        let (_, bytes) = self.tensor(&format!("texture.{k}"), Dtype::U8, &[])?;
        let texture = Arc::new(Texture::decode(self.path, bytes)?);
        self.textures.insert(k, texture.clone());
        Ok(Some(texture))
    }
}

#[cfg(test)]
mod tests {
    use super::super::{Library, PackOptions, Reduction};
    use super::*;
    use std::fs;

    const CATALOGUE_TEXT: &str = "license=CC0\n\
        id#1=T#table\nname#1=Table\ncategory#1=Living room\nmodel#1=/table/table.obj\n\
        width#1=120\ndepth#1=80\nheight#1=75\ncreator#1=Ann\n\
        id#2=T#vase\nname#2=Vase\ncategory#2=Miscellaneous\nmodel#2=/vase/vase.obj\n\
        width#2=20\ndepth#2=20\nheight#2=30\ncreator#2=Bob\n\
        id#3=T#tree\nname#3=Pine tree\ncategory#3=Exterior\nmodel#3=/none.obj\n\
        width#3=300\ndepth#3=300\nheight#3=800\ncreator#3=Bob\n";

    /// A table with a texture, a vase of glass, and a tree, which suits no room and whose file is not there.
    fn raw() -> tempfile::TempDir {
        let dir = tempfile::tempdir().unwrap();
        let lib = dir.path().join("lib");
        fs::create_dir_all(lib.join("table")).unwrap();
        fs::create_dir_all(lib.join("vase")).unwrap();
        fs::write(lib.join(super::super::catalogue::FILE), CATALOGUE_TEXT).unwrap();
        let quads = "v 0 0 0\nv 9 0 0\nv 9 4 0\nv 0 4 0\nv 0 0 6\nv 9 0 6\nv 9 4 6\nv 0 4 6\nvt 0 0\nvt 2 0\nvt 2 1\nvt 0 1\n\
            usemtl m\nf 1/1 2/2 3/3 4/4\nf 5/1 6/2 7/3 8/4\nf 1/1 5/2 8/3 4/4\nf 4/1 3/2 7/3 8/4\n";
        for name in ["table", "vase"] {
            fs::write(lib.join(name).join(format!("{name}.obj")), format!("mtllib m.mtl\n{quads}")).unwrap();
        }
        fs::write(lib.join("table/m.mtl"), "newmtl m\nKd 1 1 1\nmap_Kd wood.png\n").unwrap();
        fs::write(lib.join("vase/m.mtl"), "newmtl m\nKd 0.5 0.5 1\nd 0.2\n").unwrap();
        let wood =
            image::RgbImage::from_fn(512, 300, |x, _| image::Rgb([if x < 256 { 200 } else { 40 }, 90, 30]));
        wood.save(lib.join("table/wood.png")).unwrap();
        dir
    }

    #[test]
    fn a_packed_library_holds_what_was_read() {
        let (raw, packed) = (raw(), tempfile::tempdir().unwrap());
        let library = Library::open(raw.path()).unwrap();
        assert_eq!(library.pack(packed.path(), &PackOptions::default()).unwrap(), 2);
        let again = Library::open(packed.path()).unwrap();
        let by_id = |l: &Library| {
            let mut models = l.models();
            models.sort_by(|a, b| a.id.cmp(&b.id));
            models
        };
        assert_eq!(by_id(&library), by_id(&again));
        assert_eq!(by_id(&again)[0].size, [1.2, 0.75, 0.8]);
        let table = again.models.iter().find(|m| m.entry.id == "T#table").unwrap();
        assert!(table.mesh.low.iter().zip([-0.6, 0.0, -0.4]).all(|(a, b)| (a - b).abs() < 1e-4));
        assert_eq!(table.covers[0].texture.as_ref().unwrap().size(), [256.0, 150.0]);
        assert!(again.models.iter().find(|m| m.entry.id == "T#vase").unwrap().covers[0].is_clear());
        let text = fs::read_to_string(packed.path().join("ATTRIBUTION.md")).unwrap();
        assert!(
            text.contains("## CC0") && text.contains("**Bob**: Vase (`T#vase`)") && !text.contains("tree"),
            "{text}"
        );
    }

    #[test]
    fn a_pack_keeps_to_its_size() {
        let raw = raw();
        let library = Library::open_with(raw.path(), &Reduction::default().with_triangles(12)).unwrap();
        let dir = tempfile::tempdir().unwrap();
        assert_eq!(library.pack(dir.path(), &PackOptions::default().with_bytes(2500)).unwrap(), 1);
        let bytes: u64 =
            fs::read_dir(dir.path()).unwrap().map(|f| f.unwrap().metadata().unwrap().len()).sum();
        assert!(bytes <= 2500, "{bytes}");
        let none = library.pack(dir.path(), &PackOptions::default().with_bytes(10));
        assert!(matches!(none, Err(Error::Argument { name: "bytes", .. })));
        let few = Library::open_with(raw.path(), &Reduction::default().with_triangles(3));
        assert!(matches!(few, Err(Error::Argument { name: "triangles", .. })));
    }

    #[test]
    fn damaged_packs_are_errors() {
        let (raw, dir) = (raw(), tempfile::tempdir().unwrap());
        Library::open(raw.path()).unwrap().pack(dir.path(), &PackOptions::default()).unwrap();
        let (tensors, list) = (dir.path().join(TENSORS), dir.path().join(CATALOGUE));
        let (bytes, text) = (fs::read(&tensors).unwrap(), fs::read_to_string(&list).unwrap());
        let fails = |what: &str| {
            let found = Library::open(dir.path());
            assert!(matches!(found, Err(Error::Format { .. } | Error::Io { .. })), "{what}: {found:?}");
        };
        for n in [0, 8, 100, bytes.len() - 1] {
            fs::write(&tensors, &bytes[..n]).unwrap();
            fails("a short file");
        }
        fs::write(&tensors, &bytes).unwrap();
        for (from, to) in [
            ("sdim furniture 1", "sdim furniture 9"),
            ("\"size\":[1.2", "\"size\":[-1.2"),
            ("\"size\":[1.2", "\"size\":[1e30"),
            ("\"texture\":0", "\"texture\":7"),
            ("\"opacity\":1.0", "\"opacity\":-1.0"),
            ("\"covers\":[{", "\"covers\":[],\"other\":[{"),
            ("{", "["),
        ] {
            assert!(text.contains(from), "{from} in {text}");
            fs::write(&list, text.replacen(from, to, 1)).unwrap();
            fails(to);
        }
        fs::remove_file(&tensors).unwrap();
        fs::write(&list, text).unwrap();
        fails("no tensors");
    }

    #[test]
    fn damaged_folders_are_errors_that_name_the_file() {
        let raw = raw();
        let obj = raw.path().join("lib/vase/vase.obj");
        fs::write(&obj, "v 1 2\n").unwrap();
        match Library::open(raw.path()) {
            Err(Error::Format { path, .. }) => assert_eq!(path, obj),
            other => panic!("{other:?}"),
        }
        fs::remove_file(&obj).unwrap();
        assert!(matches!(Library::open(raw.path()), Err(Error::Io { path, .. }) if path == obj));
        assert!(Library::open(raw.path().join("nowhere")).is_err());
    }
}
