//! A library reduced to what rooms need, in one folder that travels: `furniture.safetensors` holds triangles and encoded
//! textures, `furniture.json` the catalogue, `ATTRIBUTION.md` authors and licences.
//!
//! Tensors of model `i`: `i.points` (`[n, 3]` U16, between the bounds that the JSON file names), `i.faces` (`[m, 3]` U32,
//! points), `i.material` (`[m]` U8) and, with textures, `i.uv` (`[m, 3, 2]` U16, between bounds as well); `texture.k`
//! (`[bytes]` U8) is a JPEG or PNG.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use safetensors::Dtype;
use safetensors::tensor::TensorView;

use super::geometry::Geometry;
use super::library::Library;
use super::model::Model;
use super::packed::{CATALOGUE, Catalogue, FORMAT, Packed, PackedCover, TENSORS};
use super::texture::Texture;
use crate::error::{Error, Result};
use crate::files::write_whole;

const ATTRIBUTION: &str = "ATTRIBUTION.md";

/// What [`Library::pack`] keeps.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub struct PackOptions {
    /// Bytes of the folder's files together, at most.
    pub bytes: u64,
    /// Seed of the choice when not all models fit.
    pub seed: u64,
}

impl Default for PackOptions {
    fn default() -> Self {
        Self { bytes: 30_000_000, seed: 0 }
    }
}

impl PackOptions {
    /// Sets [`PackOptions::bytes`].
    pub fn with_bytes(mut self, bytes: u64) -> Self {
        self.bytes = bytes;
        self
    }

    /// Sets [`PackOptions::seed`].
    pub fn with_seed(mut self, seed: u64) -> Self {
        self.seed = seed;
        self
    }
}

impl Library {
    /// Writes a folder that [`Library::open`] reads in a second: as many models as fit, from every kind some, chosen by the seed.
    /// Returns how many.
    ///
    /// # Errors
    /// [`Error::Io`]; [`Error::Argument`] when not one model fits.
    pub fn pack(&self, dir: impl AsRef<Path>, options: &PackOptions) -> Result<usize> {
        let dir = dir.as_ref();
        let mut writer = Writer::new(dir.join(TENSORS), options.bytes);
        let mut kept = Vec::new();
        for model in self.mixed(options.seed) {
            if writer.add(&model)? {
                kept.push(model);
            }
        }
        if kept.is_empty() {
            return Err(Error::argument("bytes", options.bytes, "room for at least one model"));
        }
        fs::create_dir_all(dir).map_err(Error::io(dir))?;
        let kept = Library::new(kept, self.split());
        let title = "# Models in this folder\n\nTriangles were reduced and textures made smaller.\n";
        write_whole(&dir.join(ATTRIBUTION), format!("{title}{}", kept.attribution()).as_bytes())?;
        writer.finish(dir)?;
        Ok(kept.models.len())
    }

    /// All models in the order in which they are packed: one of each role in turn.
    fn mixed(&self, seed: u64) -> Vec<Arc<Model>> {
        let rank = |id: &str| {
            let start = 0xcbf2_9ce4_8422_2325 ^ seed.wrapping_mul(0x9e37_79b9_7f4a_7c15);
            id.bytes().fold(start, |h, b| (h ^ u64::from(b)).wrapping_mul(0x0100_0000_01b3))
        };
        let mut order: Vec<&Arc<Model>> = self.models.iter().collect();
        order.sort_by_key(|m| (m.role, rank(&m.entry.id)));
        let mut turns: Vec<(usize, &Arc<Model>)> = Vec::new();
        for group in order.chunk_by(|a, b| a.role == b.role) {
            turns.extend(group.iter().copied().enumerate());
        }
        turns.sort_by_key(|(turn, m)| (*turn, m.role));
        turns.into_iter().map(|(_, m)| m.clone()).collect()
    }
}

/// A tensor before it is written.
struct Tensor {
    dtype: Dtype,
    shape: Vec<usize>,
    bytes: Vec<u8>,
}

struct Writer {
    path: PathBuf,
    left: u64,
    tensors: BTreeMap<String, Tensor>,
    /// Textures by their address, which clones of a model share.
    textures: BTreeMap<usize, usize>,
    models: Vec<Packed>,
}

impl Writer {
    fn new(path: PathBuf, bytes: u64) -> Self {
        Self { path, left: bytes, tensors: BTreeMap::new(), textures: BTreeMap::new(), models: Vec::new() }
    }

    /// Adds a model unless it takes more than is left.
    fn add(&mut self, model: &Model) -> Result<bool> {
        let mut geometry = model.mesh.geometry();
        geometry.clean();
        let mut fresh: Vec<(usize, Vec<u8>)> = Vec::new();
        for texture in model.covers.iter().flat_map(|c| [&c.texture, &c.mask]).flatten() {
            let address = Arc::as_ptr(texture) as usize;
            if !self.textures.contains_key(&address) && fresh.iter().all(|(a, _)| *a != address) {
                fresh.push((address, texture.encode(&self.path)?));
            }
        }
        let index = self.models.len();
        let (mut packed, tensors) = encode(model, &geometry, index);
        // Names, shapes and the entry in both files, and its line of attribution.
        let overhead = 900 + 160 * model.covers.len() as u64;
        let bytes: usize = tensors.iter().map(|(_, t)| t.bytes.len()).sum::<usize>()
            + fresh.iter().map(|(_, b)| b.len() + 100).sum::<usize>();
        let Some(left) = self.left.checked_sub(bytes as u64 + overhead) else { return Ok(false) };
        self.left = left;
        for (address, bytes) in fresh {
            let k = self.textures.len();
            self.textures.insert(address, k);
            let tensor = Tensor { dtype: Dtype::U8, shape: vec![bytes.len()], bytes };
            self.tensors.insert(format!("texture.{k}"), tensor);
        }
        let number = |t: &Option<Arc<Texture>>| {
            t.as_ref().and_then(|t| self.textures.get(&(Arc::as_ptr(t) as usize)).copied())
        };
        packed.covers = model
            .covers
            .iter()
            .map(|c| PackedCover {
                colour: c.colour,
                texture: number(&c.texture),
                mask: number(&c.mask),
                opacity: c.opacity,
                gloss: c.gloss,
                exponent: c.exponent,
                glow: c.glow,
            })
            .collect();
        self.tensors.extend(tensors);
        self.models.push(packed);
        Ok(true)
    }

    fn finish(self, dir: &Path) -> Result<()> {
        let wrong = |e: safetensors::SafeTensorError| {
            Error::format(&self.path, e.to_string(), "tensors that safetensors can hold")
        };
        let views = self
            .tensors
            .iter()
            .map(|(name, t)| Ok((name, TensorView::new(t.dtype, t.shape.clone(), &t.bytes).map_err(wrong)?)))
            .collect::<Result<Vec<_>>>()?;
        write_whole(&self.path, &safetensors::serialize(views, None).map_err(wrong)?)?;
        let catalogue = Catalogue { format: FORMAT.to_string(), models: self.models };
        let path = dir.join(CATALOGUE);
        let text = serde_json::to_vec(&catalogue)
            .map_err(|e| Error::format(&path, e.to_string(), "a catalogue that JSON can hold"))?;
        write_whole(&path, &text)
    }
}

fn encode(model: &Model, geometry: &Geometry, index: usize) -> (Packed, Vec<(String, Tensor)>) {
    let (low, high) = geometry.bounds().unwrap_or_default();
    let steps = |v: f32, low: f32, high: f32| {
        let t = if high > low { (v - low) / (high - low) } else { 0.0 };
        ((t * 65535.0).round() as u16).to_le_bytes()
    };
    let points =
        geometry.points.iter().flat_map(|p| (0..3).flat_map(|k| steps(p[k], low[k], high[k]))).collect();
    let faces = geometry.faces.iter().flat_map(|f| f.points).flat_map(u32::to_le_bytes).collect();
    let material = geometry.faces.iter().map(|f| f.material as u8).collect();
    let m = geometry.faces.len();
    let tensor = |dtype, shape, bytes| Tensor { dtype, shape, bytes };
    let mut tensors = vec![
        (format!("{index}.points"), tensor(Dtype::U16, vec![geometry.points.len(), 3], points)),
        (format!("{index}.faces"), tensor(Dtype::U32, vec![m, 3], faces)),
        (format!("{index}.material"), tensor(Dtype::U8, vec![m], material)),
    ];
    let textured = model.covers.iter().any(|c| c.texture.is_some() || c.mask.is_some());
    let uv = textured.then(|| {
        let all = || geometry.faces.iter().flat_map(|f| f.uv);
        let bound = |f: fn(f32, f32) -> f32, start: f32| {
            [0, 1].map(|k| all().map(|uv: [f32; 2]| uv[k]).fold(start, f))
        };
        let (low, high) = (bound(f32::min, f32::INFINITY), bound(f32::max, f32::NEG_INFINITY));
        let bytes = all().flat_map(|uv| (0..2).flat_map(move |k| steps(uv[k], low[k], high[k]))).collect();
        tensors.push((format!("{index}.uv"), tensor(Dtype::U16, vec![m, 3, 2], bytes)));
        [low, high]
    });
    let e = &model.entry;
    let packed = Packed {
        id: e.id.clone(),
        name: e.name.clone(),
        tags: e.tags.clone(),
        category: e.category.clone(),
        author: e.author.clone(),
        licence: e.licence.clone(),
        size: e.size,
        elevation: e.elevation,
        opening: e.opening,
        behind: e.behind,
        bounds: [low, high],
        uv,
        covers: Vec::new(),
    };
    (packed, tensors)
}
