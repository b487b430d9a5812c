//! What the loaders share: lists of files, pairs, depth files of the picture's size.

use std::fs;
use std::path::{Path, PathBuf};

use image::RgbImage;

use crate::depth::{DepthScale, SparseDepth};
use crate::error::{Error, Result};
use crate::frame::read_rgb;

pub(super) const PICTURES: [&str; 3] = ["png", "jpg", "jpeg"];

/// Files of a folder by the name without its ending, sorted.
pub(super) type Listed = Vec<(String, PathBuf)>;

/// Files of a folder with one of the endings. Two files of one name are an error.
pub(super) fn list(dir: &Path, endings: &[&str]) -> Result<Listed> {
    let mut files = Vec::new();
    for entry in fs::read_dir(dir).map_err(Error::io(dir))? {
        let path = entry.map_err(Error::io(dir))?.path();
        let ending = path.extension().and_then(|e| e.to_str()).map(str::to_ascii_lowercase);
        let stem = path.file_stem().and_then(|s| s.to_str());
        if let (Some(ending), Some(stem)) = (ending, stem)
            && endings.contains(&ending.as_str())
            && !stem.starts_with('.')
        {
            files.push((stem.to_string(), path.clone()));
        }
    }
    files.sort();
    if let Some(two) = files.windows(2).find(|two| two[0].0 == two[1].0) {
        return Err(Error::format(&two[1].1, "a second file of this name", "one file per frame"));
    }
    Ok(files)
}

/// As [`list`], with at least one file.
pub(super) fn list_some(dir: &Path, endings: &[&str]) -> Result<Listed> {
    let files = list(dir, endings)?;
    if files.is_empty() {
        return Err(Error::format(dir, "no frame", format!("at least one .{}", endings.join(" or ."))));
    }
    Ok(files)
}

/// Removes the file of this name from a sorted list.
pub(super) fn take(files: &mut Listed, name: &str) -> Option<PathBuf> {
    let at = files.binary_search_by(|(n, _)| n.as_str().cmp(name)).ok()?;
    Some(files.remove(at).1)
}

/// The error for a file whose partner is absent.
pub(super) fn unpaired(path: &Path, lacks: &str, expected: impl Into<String>) -> Error {
    Error::format(path, format!("no {lacks} for it"), expected)
}

/// Fails unless nothing is left over of a list after its partners were taken.
pub(super) fn all_taken(files: Listed, expected: impl FnOnce(&str) -> String) -> Result<()> {
    match files.into_iter().next() {
        None => Ok(()),
        Some((name, path)) => Err(unpaired(&path, "picture", expected(&name))),
    }
}

/// The picture, named in every error.
pub(super) fn picture(path: &Path) -> Result<RgbImage> {
    read_rgb(path).map_err(|e| naming(path, e))
}

/// Measured depth of the picture's size; at least one pixel is valid.
pub(super) fn depth(path: &Path, scale: Option<DepthScale>, rgb: &RgbImage) -> Result<SparseDepth> {
    let map = SparseDepth::read(path, scale).map_err(|e| naming(path, e))?;
    let (w, h) = (rgb.width() as usize, rgb.height() as usize);
    if (map.width(), map.height()) != (w, h) {
        let found = format!("{}x{} pixels", map.width(), map.height());
        return Err(Error::format(path, found, format!("{w}x{h} as its picture")));
    }
    some_valid(path, map)
}

/// Fails, naming the file, when a map has no valid pixel.
pub(super) fn some_valid(path: &Path, map: SparseDepth) -> Result<SparseDepth> {
    if map.measured() > 0 {
        return Ok(map);
    }
    Err(Error::format(path, "no valid depth at any pixel", "at least one depth above 0"))
}

/// Adds the file to errors that speak of values or sizes only.
pub(super) fn naming(path: &Path, error: Error) -> Error {
    match error {
        Error::DepthRange { .. } => Error::format(path, error.to_string(), "depth in the layout's unit"),
        Error::ImageSize { .. } | Error::BufferLength { .. } => {
            Error::format(path, error.to_string(), "an image of ordinary size")
        }
        other => other,
    }
}
