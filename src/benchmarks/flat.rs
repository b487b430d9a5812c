//! Folders without subfolders: `NAME_rgb.png`, `NAME_gt.png` and perhaps `NAME_sparse.png` side by side, with the units of
//! their integers in `manifest.json`.

use super::files::{Listed, PICTURES, list};
use crate::depth::DepthScale;
use crate::error::{Error, Result};
use std::collections::HashMap;
use std::path::Path;

/// Units of frames, beside the frames.
const MANIFEST: &str = "manifest.json";

/// Pictures, ground truths and measurements of a folder by the names of their frames.
pub(super) struct Flat {
    pub(super) pictures: Listed,
    pub(super) truths: Listed,
    pub(super) measured: Listed,
    /// Unit per frame, of those that the manifest names.
    pub(super) scales: HashMap<String, DepthScale>,
}

impl Flat {
    /// Lists `dir`; `None` if it holds no `NAME_rgb` picture.
    pub(super) fn list(dir: &Path, depths: &[&str]) -> Result<Option<Self>> {
        let with = |endings: &[&str], suffix: &str| -> Result<Listed> {
            let named = |(name, path): (String, _)| Some((name.strip_suffix(suffix)?.to_string(), path));
            Ok(list(dir, endings)?.into_iter().filter_map(named).collect())
        };
        let pictures = with(&PICTURES, "_rgb")?;
        if pictures.is_empty() {
            return Ok(None);
        }
        let path = dir.join(MANIFEST);
        let scales = if path.exists() { scales(&path)? } else { HashMap::new() };
        let (truths, measured) = (with(depths, "_gt")?, with(depths, "_sparse")?);
        Ok(Some(Self { pictures, truths, measured, scales }))
    }
}

/// Reads `[{"name": .., "scale": units per metre}, ..]`; other keys are left alone.
fn scales(path: &Path) -> Result<HashMap<String, DepthScale>> {
    #[derive(serde::Deserialize)]
    struct Frame {
        name: String,
        scale: f32,
    }
    let text = crate::files::read_text(path)?;
    let frames: Vec<Frame> = serde_json::from_slice(&text).map_err(|e| {
        Error::format(path, e.to_string(), "a list of objects with `name` and `scale` (units per metre)")
    })?;
    let unit = |f: Frame| {
        let scale = DepthScale::units_per_metre(f.scale)
            .map_err(|e| Error::format(path, format!("{}: {e}", f.name), "a positive scale"))?;
        Ok((f.name, scale))
    };
    frames.into_iter().map(unit).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::benchmarks::FolderDataset;
    use crate::benchmarks::dataset::Dataset;
    use crate::depth::io::png16;

    fn write(dir: &Path, name: &str, value: u16) {
        image::RgbImage::new(8, 6).save(dir.join(format!("{name}_rgb.png"))).unwrap();
        png16::write_png16(dir.join(format!("{name}_gt.png")), 8, 6, &[value; 48]).unwrap();
    }

    #[test]
    fn files_side_by_side_are_frames_in_the_manifests_units() {
        let dir = tempfile::tempdir().unwrap();
        write(dir.path(), "a", 2000);
        write(dir.path(), "b", 512);
        png16::write_png16(dir.path().join("b_sparse.png"), 8, 6, &[256; 48]).unwrap();
        let manifest = |text: &str| std::fs::write(dir.path().join(MANIFEST), text).unwrap();
        manifest(
            r#"[{"name": "a", "scale": 1000.0, "sensor": "x"}, {"name": "b", "scale": 256, "unit": null}]"#,
        );
        let set = FolderDataset::open(dir.path(), None).unwrap();
        assert_eq!((set.len(), set.name(0), set.name(1)), (2, "a".into(), "b".into()));
        assert!(set.load(0).unwrap().gt.iter().all(|&d| d == 2.0));
        let b = set.load(1).unwrap();
        assert!(b.gt.iter().all(|&d| d == 2.0) && b.sparse.unwrap().get(0, 0) == Some(1.0));
        // What the caller says goes before the manifest.
        let set = FolderDataset::open(dir.path(), DepthScale::kitti()).unwrap();
        assert!(set.load(0).unwrap().gt.iter().all(|&d| d == 2000.0 / 256.0));

        for bad in ["{}", r#"[{"name": "a"}]"#, r#"[{"name": "a", "scale": -1}]"#, "["] {
            manifest(bad);
            let error = FolderDataset::open(dir.path(), None).unwrap_err().to_string();
            assert!(error.contains(MANIFEST), "{error}");
        }
    }

    #[test]
    fn what_has_no_partner_or_unit_is_named() {
        let dir = tempfile::tempdir().unwrap();
        write(dir.path(), "a", 2000);
        let error = FolderDataset::open(dir.path(), None).unwrap().load(0).unwrap_err().to_string();
        assert!(error.contains("a_gt.png"), "{error}");
        std::fs::remove_file(dir.path().join("a_gt.png")).unwrap();
        let error = FolderDataset::open(dir.path(), None).unwrap_err().to_string();
        assert!(error.contains("a_rgb.png") && error.contains("a_gt"), "{error}");
    }
}
