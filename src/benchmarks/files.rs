//! What the loaders share: lists of files, pairs, depth files of the picture's size.

use std::fs;
use std::path::{Component, Path, PathBuf};

use image::RgbImage;

use crate::depth::{DepthScale, SparseDepth};
use crate::error::{Error, Result};
use crate::image::read_rgb;

pub(super) const PICTURES: [&str; 3] = ["png", "jpg", "jpeg"];

/// Files of a folder by the name without its ending, sorted.
pub(super) type Listed = Vec<(String, PathBuf)>;

/// All that a folder holds, files and folders, by name, sorted.
pub(super) fn entries(dir: &Path) -> Result<Listed> {
    let mut found = Vec::new();
    for entry in fs::read_dir(dir).map_err(Error::io(dir))? {
        let path = entry.map_err(Error::io(dir))?.path();
        if let Some(name) = path.file_name().and_then(|n| n.to_str()) {
            found.push((name.to_string(), path.clone()));
        }
    }
    found.sort();
    Ok(found)
}

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

/// A relative path of a list file as a path below `root`. A list must not lead out of its data set.
pub(super) fn below(root: &Path, relative: &str, list: &Path) -> Result<PathBuf> {
    let path = Path::new(relative);
    let inside = path.components().all(|c| matches!(c, Component::Normal(_) | Component::CurDir));
    if inside && path.file_name().is_some() {
        return Ok(root.join(path));
    }
    Err(Error::format(list, format!("path {relative:?}"), "a relative path inside the data set"))
}

/// The lines of a text file that are neither empty nor comments (`#`), without the space around them.
pub(super) fn lines(path: &Path) -> Result<Vec<String>> {
    let text = crate::files::read_text(path)?;
    let text = String::from_utf8(text).map_err(|_| Error::format(path, "no UTF-8 text", "a text file"))?;
    let used = text.lines().map(str::trim).filter(|l| !l.is_empty() && !l.starts_with('#'));
    Ok(used.map(str::to_string).collect())
}

/// The first of some places below `dir` that holds a file or folder of this name.
pub(super) fn first_with(dir: &Path, places: &[&str], marker: &str) -> Result<PathBuf> {
    let mut found = places.iter().map(|place| dir.join(place)).filter(|d| d.join(marker).exists());
    found.next().ok_or_else(|| Error::format(dir, format!("no {marker}"), format!("{marker} in it")))
}

/// The recordings of a folder: itself, or the folders in it that hold all of the marks, by name. A recording's name is empty
/// when it is the folder itself.
pub(super) fn recordings(dir: &Path, marks: [&str; 2]) -> Result<Listed> {
    let whole = |d: &Path| marks.iter().all(|m| d.join(m).exists());
    if whole(dir) {
        return Ok(vec![(String::new(), dir.to_path_buf())]);
    }
    let mut found = entries(dir)?;
    found.retain(|(_, path)| whole(path));
    let [one, other] = marks;
    if found.is_empty() {
        let expected = format!("{one} and {other}, or folders that hold them");
        return Err(Error::format(dir, "no recording", expected));
    }
    Ok(found)
}

/// A frame's name from its recording's.
pub(super) fn frame_name(recording: &str, frame: &str) -> String {
    if recording.is_empty() { frame.to_string() } else { format!("{recording}-{frame}") }
}

/// The picture, named in every error.
pub(super) fn picture(path: &Path) -> Result<RgbImage> {
    read_rgb(path).map_err(|e| naming(path, e))
}

/// Depth of the picture's size, perhaps valid at no pixel.
pub(super) fn depth(path: &Path, scale: Option<DepthScale>, rgb: &RgbImage) -> Result<SparseDepth> {
    let map = SparseDepth::read(path, scale).map_err(|e| naming(path, e))?;
    same_size(path, (map.width(), map.height()), rgb)?;
    Ok(map)
}

/// Fails, naming the file, unless a map of this width and height has the picture's size.
pub(super) fn same_size(path: &Path, (width, height): (usize, usize), rgb: &RgbImage) -> Result<()> {
    let (w, h) = (rgb.width() as usize, rgb.height() as usize);
    if (width, height) == (w, h) {
        return Ok(());
    }
    Err(Error::format(path, format!("{width}x{height} pixels"), format!("{w}x{h} as its picture")))
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
