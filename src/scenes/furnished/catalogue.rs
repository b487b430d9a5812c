//! The catalogue of a folder of models: which file each is, how large, by whom, under which licence.
//!
//! The format is the one of Sweet Home 3D's furniture libraries: Java properties in Latin-1, `key#NUMBER=value` for the
//! model of that number, centimetres, and `key=value` for all of them.
//! Source: <https://www.sweethome3d.com/importModels.jsp>.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Component, Path, PathBuf};

use crate::error::{Error, Result};
use crate::files::read_within;
use crate::scenes::space::{Rot, UPRIGHT, V3};

/// Name of a catalogue inside the folder of a library or inside one of its folders.
pub(super) const FILE: &str = "PluginFurnitureCatalog.properties";

/// Bytes of a catalogue, at most.
const LONGEST: u64 = 16 << 20;

/// Models of a library, at most.
const MOST: usize = 20_000;

/// Sizes that are accepted, metres.
const SIZES: std::ops::RangeInclusive<f32> = 1e-4..=100.0;

/// One model as the catalogue tells of it.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Entry {
    pub id: String,
    pub name: String,
    pub tags: String,
    pub category: String,
    pub author: String,
    pub licence: String,
    /// The OBJ file.
    pub file: PathBuf,
    /// Width, height and depth (front to back), metres.
    pub size: V3,
    /// Height above the floor at which it hangs, metres.
    pub elevation: f32,
    /// Whether it belongs into an opening of a wall.
    pub opening: bool,
    /// Of a door or window: how far its back is behind the inner face of the wall, metres.
    pub behind: f32,
    /// Turns the file's axes to width, height and depth.
    pub rotation: Rot,
}

/// Reads the catalogues in `dir` and in its folders, in order of the folders' names.
pub(super) fn read(dir: &Path) -> Result<Vec<Entry>> {
    let mut folders = vec![dir.to_path_buf()];
    let listed = fs::read_dir(dir).map_err(Error::io(dir))?;
    for entry in listed {
        folders.push(entry.map_err(Error::io(dir))?.path());
    }
    folders[1..].sort();
    let mut entries = Vec::new();
    for folder in &folders {
        let file = folder.join(FILE);
        if file.is_file() {
            entries.extend(parse(&file, &read_within(&file, LONGEST)?)?);
        }
    }
    let wanted = || format!("1 to {MOST} models in `{FILE}` in the folder or one level below");
    if entries.is_empty() || entries.len() > MOST {
        return Err(Error::format(dir, format!("{} models", entries.len()), wanted()));
    }
    let mut ids: Vec<&str> = entries.iter().map(|e| e.id.as_str()).collect();
    ids.sort_unstable();
    match ids.windows(2).find(|pair| pair[0] == pair[1]) {
        Some(pair) => Err(Error::format(dir, format!("two models `{}`", pair[0]), "one model of each id")),
        None => Ok(entries),
    }
}

fn parse(file: &Path, bytes: &[u8]) -> Result<Vec<Entry>> {
    let mut models: BTreeMap<u32, BTreeMap<String, String>> = BTreeMap::new();
    let mut licence = String::new();
    for (key, value) in properties(bytes) {
        match key.split_once('#') {
            Some((key, number)) => {
                // Keys in the plural, such as `light#1#2`, are none of ours.
                if let Ok(number) = number.parse() {
                    models.entry(number).or_default().insert(key.to_string(), value);
                }
            }
            None if key == "license" => licence = value,
            None => {}
        }
    }
    let folder = file.parent().unwrap_or(Path::new(""));
    models
        .iter()
        .map(|(number, keys)| Fields { file, number: *number, keys }.entry(folder, &licence))
        .collect()
}

/// The properties of one model.
struct Fields<'a> {
    file: &'a Path,
    number: u32,
    keys: &'a BTreeMap<String, String>,
}

impl Fields<'_> {
    fn text(&self, key: &str) -> &str {
        self.keys.get(key).map_or("", |v| v.trim())
    }

    fn wrong(&self, key: &str, expected: &str) -> Error {
        let found = self.keys.get(key).map_or("missing".to_string(), |v| format!("`{v}`"));
        Error::format(self.file, format!("`{key}#{}` is {found}", self.number), expected)
    }

    fn must(&self, key: &str) -> Result<&str> {
        match self.text(key) {
            "" => Err(self.wrong(key, "a value")),
            text => Ok(text),
        }
    }

    /// Centimetres in the file, metres here.
    fn length(&self, key: &str, range: std::ops::RangeInclusive<f32>) -> Result<f32> {
        let metres = self.text(key).parse::<f64>().ok().map(|v| (0.01 * v) as f32);
        let expected =
            || self.wrong(key, &format!("{} to {} cm", 100.0 * range.start(), 100.0 * range.end()));
        metres.filter(|v| range.contains(v)).ok_or_else(expected)
    }

    /// The same with a value for a key that is not there.
    fn length_or(&self, key: &str, default: f32) -> Result<f32> {
        if self.text(key).is_empty() { Ok(default) } else { self.length(key, 0.0..=100.0) }
    }

    fn rotation(&self) -> Result<Rot> {
        const KEY: &str = "modelRotation";
        if self.text(KEY).is_empty() {
            return Ok(UPRIGHT);
        }
        let values: Option<Vec<f32>> = self
            .text(KEY)
            .split_whitespace()
            .map(|v| v.parse().ok().filter(|v: &f32| v.abs() <= 1.01))
            .collect();
        match values.as_deref() {
            Some(&[a, b, c, d, e, f, g, h, i]) => Ok([[a, b, c], [d, e, f], [g, h, i]]),
            _ => Err(self.wrong(KEY, "nine numbers of a rotation")),
        }
    }

    fn entry(&self, folder: &Path, licence: &str) -> Result<Entry> {
        let name = self.must("name")?.to_string();
        let model = self.must("model")?;
        let inside =
            contained(model).ok_or_else(|| self.wrong("model", "a path inside the catalogue's folder"))?;
        let depth = self.length("depth", SIZES)?;
        // Without a thickness the wall is as thick as the model is deep.
        let thick = self.length_or("doorOrWindowWallThickness", depth)?;
        Ok(Entry {
            id: self.must("id")?.to_string(),
            name,
            tags: self.text("tags").to_string(),
            category: self.text("category").to_string(),
            author: self.text("creator").to_string(),
            licence: licence.to_string(),
            file: folder.join(inside),
            size: [self.length("width", SIZES)?, self.length("height", SIZES)?, depth],
            elevation: self.length_or("elevation", 0.0)?,
            opening: self.text("doorOrWindow") == "true",
            behind: (thick + self.length_or("doorOrWindowWallDistance", 0.0)?).min(depth),
            rotation: self.rotation()?,
        })
    }
}

/// The path without its leading slash, if it stays below the folder that it is joined to.
pub(super) fn contained(path: &str) -> Option<PathBuf> {
    let path = Path::new(path.trim_start_matches('/'));
    let plain = path.components().all(|c| matches!(c, Component::Normal(_) | Component::CurDir));
    (plain && path.file_name().is_some()).then(|| path.to_path_buf())
}

/// Keys and values of a Java properties file: Latin-1, `\uXXXX`, lines that end in a backslash go on.
fn properties(bytes: &[u8]) -> Vec<(String, String)> {
    let text: String = bytes.iter().map(|&b| char::from(b)).collect();
    let mut pairs = Vec::new();
    let mut lines = text.lines();
    while let Some(first) = lines.next() {
        let mut line = first.trim_start().to_string();
        if line.starts_with(['#', '!']) {
            continue;
        }
        while line.bytes().rev().take_while(|&b| b == b'\\').count() % 2 == 1 {
            line.pop();
            match lines.next() {
                Some(next) => line.push_str(next.trim_start()),
                None => break,
            }
        }
        if let Some((key, value)) = line.split_once('=') {
            pairs.push((unescaped(key.trim()), unescaped(value.trim())));
        }
    }
    pairs
}

fn unescaped(text: &str) -> String {
    let mut out = String::with_capacity(text.len());
    let mut rest = text.chars();
    while let Some(c) = rest.next() {
        if c != '\\' {
            out.push(c);
            continue;
        }
        match rest.next() {
            Some('u') => {
                let digits: String = rest.by_ref().take(4).collect();
                let decoded = u32::from_str_radix(&digits, 16).ok().and_then(char::from_u32);
                out.push(decoded.unwrap_or(char::REPLACEMENT_CHARACTER));
            }
            Some('t') => out.push('\t'),
            Some('n') => out.push('\n'),
            Some(other) => out.push(other),
            None => {}
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    const ONE: &str = "license=CC0\n# a comment\nid#1=Lib#chair\nname#1=Ch\\u00e2ir\ntags#1=Seat,\\\n  Old\n\
        category#1=Living room\nmodel#1=/a/chair.obj\nwidth#1=40\ndepth#1=50.5\nheight#1=90\nelevation#1=10\n\
        doorOrWindow#1=false\ncreator#1=A\n";

    fn parsed(text: &str) -> Result<Vec<Entry>> {
        parse(Path::new("lib/c.properties"), text.as_bytes())
    }

    #[test]
    fn a_model_is_read_in_metres() {
        let entry = &parsed(ONE).unwrap()[0];
        assert_eq!(
            (entry.id.as_str(), entry.name.as_str(), entry.tags.as_str()),
            ("Lib#chair", "Châir", "Seat,Old")
        );
        assert_eq!((entry.author.as_str(), entry.licence.as_str()), ("A", "CC0"));
        assert_eq!(entry.file, Path::new("lib/a/chair.obj"));
        assert!(
            entry.size.iter().zip([0.4, 0.9, 0.505]).all(|(a, b)| (a - b).abs() < 1e-6),
            "{:?}",
            entry.size
        );
        assert!((entry.elevation - 0.1).abs() < 1e-6 && !entry.opening && entry.rotation == UPRIGHT);
    }

    #[test]
    fn wrong_values_name_their_key() {
        for (from, to, key) in [
            ("width#1=40", "width#1=-40", "width#1"),
            ("width#1=40", "width#1=nan", "width#1"),
            ("depth#1=50.5", "depth#1=1e9", "depth#1"),
            ("height#1=90\n", "", "height#1"),
            ("name#1=Ch\\u00e2ir", "name#1=", "name#1"),
            ("/a/chair.obj", "/a/../../chair.obj", "model#1"),
            ("elevation#1=10", "elevation#1=x", "elevation#1"),
            ("creator#1=A", "modelRotation#1=1 0 0", "modelRotation#1"),
            ("creator#1=A", "doorOrWindowWallThickness#1=-7", "doorOrWindowWallThickness#1"),
        ] {
            let text = ONE.replace(from, to);
            assert_ne!(text, ONE);
            match parsed(&text) {
                Err(Error::Format { found, .. }) => assert!(found.contains(key), "{found}"),
                other => panic!("{to}: {other:?}"),
            }
        }
    }

    #[test]
    fn a_folder_needs_models_and_each_once() {
        let dir = tempfile::tempdir().unwrap();
        assert!(matches!(read(dir.path()), Err(Error::Format { .. })));
        for folder in ["a", "b"] {
            fs::create_dir(dir.path().join(folder)).unwrap();
            fs::write(dir.path().join(folder).join(FILE), ONE).unwrap();
        }
        match read(dir.path()) {
            Err(Error::Format { found, .. }) => assert!(found.contains("Lib#chair"), "{found}"),
            other => panic!("{other:?}"),
        }
        fs::remove_file(dir.path().join("b").join(FILE)).unwrap();
        assert_eq!(read(dir.path()).unwrap().len(), 1);
    }
}
