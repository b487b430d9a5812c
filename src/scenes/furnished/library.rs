//! Models of furniture: read from a folder, chosen by what they are good for.

use std::collections::BTreeMap;
use std::fmt::Write;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use rayon::prelude::*;

use super::catalogue::{self, Entry};
use super::geometry::Geometry;
use super::model::{Cover, Model, fit};
use super::role::{Role, role};
use super::simplify::simplify;
use super::texture::Texture;
use super::{obj, unpack};
use crate::error::{Error, Result};

/// Which models and rooms scenes are made of.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Split {
    /// Every model; rooms that are in neither of the others.
    #[default]
    All,
    /// Four fifths of the models, and rooms to train on.
    Train,
    /// The other fifth, and rooms that training never sees.
    HeldOut,
}

/// How models are reduced while they are read.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub struct Reduction {
    /// Triangles of a model of 35 cm or more, about, at most. Smaller ones keep a third, plants half as many again.
    pub triangles: usize,
}

impl Default for Reduction {
    fn default() -> Self {
        Self { triangles: 3000 }
    }
}

impl Reduction {
    /// Sets [`Reduction::triangles`].
    pub fn with_triangles(mut self, triangles: usize) -> Self {
        self.triangles = triangles;
        self
    }

    fn target(&self, entry: &Entry, role: Role) -> usize {
        let largest = entry.size.into_iter().fold(0.0, f32::max);
        match role {
            Role::FloorPlant | Role::SmallPlant => self.triangles + self.triangles / 2,
            _ if largest < 0.35 => self.triangles / 3,
            _ => self.triangles,
        }
    }
}

/// What is known of a model.
#[derive(Clone, Debug, PartialEq)]
#[non_exhaustive]
pub struct ModelInfo {
    /// Unique in its library.
    pub id: String,
    /// Name in the catalogue.
    pub name: String,
    /// Category in the catalogue.
    pub category: String,
    /// Who made it.
    pub author: String,
    /// The licence as the catalogue names it.
    pub licence: String,
    /// Width, height and depth, metres.
    pub size: [f32; 3],
    /// Triangles after the reduction.
    pub triangles: usize,
    /// Whether training never sees it: [`Split::HeldOut`] or [`Split::Train`].
    pub split: Split,
}

/// Models that rooms can be furnished with. Clones and parts share them.
#[derive(Clone)]
pub struct Library {
    pub(super) models: Vec<Arc<Model>>,
    pub(super) split: Split,
    by_role: BTreeMap<Role, Vec<usize>>,
}

impl std::fmt::Debug for Library {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Library").field("models", &self.models.len()).field("split", &self.split).finish()
    }
}

impl Library {
    /// Reads a folder of OBJ and MTL files with a `PluginFurnitureCatalog.properties` in it or in its folders, or a folder that
    /// [`Library::pack`] wrote. Models that suit no room are left out.
    ///
    /// Thousands of triangles per model are reduced to [`Reduction::default`]: the first reading of a large library takes a
    /// minute, a packed one a second.
    ///
    /// # Errors
    /// [`Error::Io`]; [`Error::Format`] naming the file and the line or key that is wrong.
    pub fn open(dir: impl AsRef<Path>) -> Result<Self> {
        Self::open_with(dir, &Reduction::default())
    }

    /// The same with another reduction, which a packed library has behind it.
    ///
    /// # Errors
    /// As [`Library::open`]; [`Error::Argument`] for fewer than 12 triangles.
    pub fn open_with(dir: impl AsRef<Path>, reduction: &Reduction) -> Result<Self> {
        let dir = dir.as_ref();
        if reduction.triangles < 12 {
            return Err(Error::argument("triangles", reduction.triangles, "at least 12"));
        }
        let models = if unpack::is_packed(dir) { unpack::read(dir)? } else { read(dir, reduction)? };
        if models.is_empty() {
            return Err(Error::format(dir, "no model that suits a room", "a library of furniture"));
        }
        Ok(Self::new(models, Split::All))
    }

    pub(super) fn new(models: Vec<Arc<Model>>, split: Split) -> Self {
        let mut by_role: BTreeMap<Role, Vec<usize>> = BTreeMap::new();
        for (i, model) in models.iter().enumerate() {
            by_role.entry(model.role).or_default().push(i);
        }
        Self { models, split, by_role }
    }

    /// The models of one part, for scenes of that part. Which part a model belongs to depends on its id alone, so that it is
    /// the same in a library and in a packed choice of it.
    ///
    /// # Errors
    /// [`Error::Argument`] when no model is left.
    pub fn part(&self, split: Split) -> Result<Self> {
        let wanted = |m: &&Arc<Model>| match split {
            Split::All => true,
            Split::Train => !m.held_out(),
            Split::HeldOut => m.held_out(),
        };
        let models: Vec<Arc<Model>> = self.models.iter().filter(wanted).cloned().collect();
        if models.is_empty() {
            return Err(Error::argument(
                "split",
                format!("{split:?}"),
                "a part of the library with models in it",
            ));
        }
        Ok(Self::new(models, split))
    }

    /// Which part this is.
    pub fn split(&self) -> Split {
        self.split
    }

    /// What is known of each model.
    pub fn models(&self) -> Vec<ModelInfo> {
        let info = |m: &Arc<Model>| ModelInfo {
            id: m.entry.id.clone(),
            name: m.entry.name.clone(),
            category: m.entry.category.clone(),
            author: m.entry.author.clone(),
            licence: m.entry.licence.clone(),
            size: m.size(),
            triangles: m.mesh.faces(),
            split: if m.held_out() { Split::HeldOut } else { Split::Train },
        };
        self.models.iter().map(info).collect()
    }

    /// A Markdown list of all models by licence and author.
    pub fn attribution(&self) -> String {
        let mut groups: BTreeMap<(&str, &str), Vec<&Entry>> = BTreeMap::new();
        for model in &self.models {
            let e = &model.entry;
            groups.entry((&e.licence, &e.author)).or_default().push(e);
        }
        let mut text = String::new();
        let mut licence = None;
        for ((by, author), entries) in groups {
            if licence.replace(by) != Some(by) {
                let name = if by.is_empty() { "Licence not named" } else { by };
                let _ = write!(text, "\n## {name}\n\n");
            }
            let author = if author.is_empty() { "Author not named" } else { author };
            let names: Vec<String> = entries.iter().map(|e| format!("{} (`{}`)", e.name, e.id)).collect();
            let _ = writeln!(text, "- **{author}**: {}", names.join(", "));
        }
        text
    }

    /// Models of a role.
    pub(super) fn of(&self, role: Role) -> &[usize] {
        self.by_role.get(&role).map_or(&[], Vec::as_slice)
    }
}

fn read(dir: &Path, reduction: &Reduction) -> Result<Vec<Arc<Model>>> {
    let entries: Vec<(Entry, Role)> =
        catalogue::read(dir)?.into_iter().filter_map(|e| role(&e).map(|r| (e, r))).collect();
    let read: Vec<Raw> = entries
        .into_par_iter()
        .map(|(entry, role)| Raw::read(entry, role, reduction))
        .collect::<Result<Vec<_>>>()?;
    let mut textures = Textures::default();
    read.into_iter().map(|raw| raw.model(&mut textures)).collect()
}

/// A model whose textures are not read yet: models share them.
struct Raw {
    entry: Entry,
    role: Role,
    geometry: Geometry,
    materials: Vec<obj::Material>,
}

impl Raw {
    fn read(entry: Entry, role: Role, reduction: &Reduction) -> Result<Self> {
        let (mut geometry, materials) = obj::read(&entry.file)?;
        fit(&mut geometry, &entry);
        // What the scale made too thin to see.
        geometry.clean();
        if geometry.faces.is_empty() {
            return Err(Error::format(
                &entry.file,
                "no face with an area at the catalogue's size",
                "at least one",
            ));
        }
        let textured: Vec<bool> = materials.iter().map(|m| m.texture.is_some() || m.mask.is_some()).collect();
        let geometry = simplify(geometry, reduction.target(&entry, role), &textured);
        Ok(Self { entry, role, geometry, materials })
    }

    fn model(self, textures: &mut Textures) -> Result<Arc<Model>> {
        let mut covers = Vec::new();
        for m in &self.materials {
            covers.push(Cover::new(m, textures.get(&m.texture)?, textures.get(&m.mask)?));
        }
        Ok(Arc::new(Model::new(self.entry, self.role, &self.geometry, covers)))
    }
}

/// Textures by their files, each read once.
#[derive(Default)]
struct Textures(BTreeMap<PathBuf, Arc<Texture>>);

impl Textures {
    fn get(&mut self, path: &Option<PathBuf>) -> Result<Option<Arc<Texture>>> {
        let Some(path) = path else { return Ok(None) };
        if let Some(texture) = self.0.get(path) {
            return Ok(Some(texture.clone()));
        }
        let texture = Arc::new(Texture::read(path)?);
        self.0.insert(path.clone(), texture.clone());
        Ok(Some(texture))
    }
}
