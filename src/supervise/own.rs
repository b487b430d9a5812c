//! Frames of a user's own camera: pictures with sparse depth, without ground truth.

use crate::depth::{DepthScale, SparseDepth};
use crate::error::{Error, Result};
use crate::image::read_rgb;
use image::RgbImage;
use std::path::{Path, PathBuf};

/// A picture and what was measured in it.
#[derive(Clone, Debug)]
pub struct OwnFrame {
    /// Name of its files without their endings.
    pub name: String,
    /// The picture.
    pub rgb: RgbImage,
    /// Its measurements, of the picture's size.
    pub sparse: SparseDepth,
}

/// Frames of one camera.
#[derive(Clone, Debug, Default)]
pub struct OwnFrames {
    /// Those with enough measurements, in the order of their names.
    pub frames: Vec<OwnFrame>,
    /// Names of those with fewer than [`OwnFrames::FEWEST`].
    pub left_out: Vec<String>,
}

/// Endings of depth files.
const DEPTHS: [&str; 2] = ["npy", "png"];

impl OwnFrames {
    /// Measurements of a frame of which some can be held back.
    pub const FEWEST: usize = 16;

    /// Reads `rgb/NAME.png` or `.jpg` with `sparse/NAME.npy` or `.png`, or `NAME_rgb` and `NAME_sparse` side by side: the layout
    /// `folder` of the benchmarks, of which ground truth is not looked at. `scale` is the unit of integer files.
    ///
    /// # Errors
    /// [`Error::Io`]; [`Error::Format`] names a picture without measurements, a file that cannot be read or has another size
    /// than the first picture, since one camera has one size, and a folder without any frame.
    pub fn read(dir: &Path, scale: Option<DepthScale>) -> Result<Self> {
        let parted = dir.join("rgb").is_dir();
        let (pictures, suffix) = if parted { (dir.join("rgb"), "") } else { (dir.to_path_buf(), "_rgb") };
        let mut listed: Vec<(String, PathBuf)> = Vec::new();
        for entry in std::fs::read_dir(&pictures).map_err(Error::io(&pictures))? {
            let path = entry.map_err(Error::io(&pictures))?.path();
            let ending = path.extension().and_then(|e| e.to_str()).unwrap_or("").to_ascii_lowercase();
            let name = path.file_stem().and_then(|s| s.to_str()).and_then(|s| s.strip_suffix(suffix));
            if let Some(name) = name.filter(|n| !n.starts_with('.'))
                && ["png", "jpg", "jpeg"].contains(&ending.as_str())
            {
                listed.push((name.to_string(), path.clone()));
            }
        }
        listed.sort();
        let mut out = Self::default();
        let mut size = None;
        for (name, path) in listed {
            let measured =
                if parted { dir.join("sparse").join(&name) } else { dir.join(format!("{name}_sparse")) };
            let frame = OwnFrame::read(name, &path, &measured, scale)?;
            let found = frame.rgb.dimensions();
            let (width, height) = *size.get_or_insert(found);
            if found != (width, height) {
                let expected = format!("{width}x{height} as the first picture: frames of one camera");
                return Err(Error::format(&path, format!("{}x{} pixels", found.0, found.1), expected));
            }
            match frame.sparse.measured() < Self::FEWEST {
                true => out.left_out.push(frame.name),
                false => out.frames.push(frame),
            }
        }
        if out.frames.is_empty() {
            let expected = format!(
                "rgb/NAME.png or .jpg with sparse/NAME.npy or .png, at least {} measurements each",
                Self::FEWEST
            );
            return Err(Error::format(dir, "no frame", expected));
        }
        Ok(out)
    }
}

impl OwnFrame {
    fn read(name: String, picture: &Path, measured: &Path, scale: Option<DepthScale>) -> Result<Self> {
        // Names may hold dots.
        let with = |ending: &str| PathBuf::from(format!("{}.{ending}", measured.display()));
        let Some(path) = DEPTHS.iter().map(|ending| with(ending)).find(|path| path.exists()) else {
            let expected = format!("{} or .png", with(DEPTHS[0]).display());
            return Err(Error::format(picture, "no measurements for it", expected));
        };
        let rgb = read_rgb(picture)?;
        let sparse = SparseDepth::read(&path, scale).map_err(|e| match e {
            Error::DepthRange { .. } => {
                Error::format(&path, e.to_string(), "depth in the unit that was told")
            }
            other => other,
        })?;
        if (sparse.width(), sparse.height()) != (rgb.width() as usize, rgb.height() as usize) {
            let found = format!("{}x{} pixels", sparse.width(), sparse.height());
            let expected = format!("{}x{} as its picture", rgb.width(), rgb.height());
            return Err(Error::format(&path, found, expected));
        }
        Ok(Self { name, rgb, sparse })
    }

    /// The frame as a mirror shows it.
    pub(super) fn mirrored(&self) -> Result<Self> {
        let (width, height) = (self.sparse.width(), self.sparse.height());
        let mut values = self.sparse.as_slice().to_vec();
        values.chunks_mut(width).for_each(<[f32]>::reverse);
        let sparse = SparseDepth::new(width, height, values)?;
        Ok(Self { name: self.name.clone(), rgb: image::imageops::flip_horizontal(&self.rgb), sparse })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::depth::io::npy::write_npy;

    fn write(dir: &Path, name: &str, (width, height): (u32, u32), points: usize) {
        for part in ["rgb", "sparse"] {
            std::fs::create_dir_all(dir.join(part)).unwrap();
        }
        RgbImage::new(width, height).save(dir.join("rgb").join(format!("{name}.png"))).unwrap();
        let depth: Vec<f32> =
            (0..(width * height) as usize).map(|i| if i < points { 1.5 } else { f32::NAN }).collect();
        let path = dir.join("sparse").join(format!("{name}.npy"));
        write_npy(path, width as usize, height as usize, &depth).unwrap();
    }

    #[test]
    fn frames_are_read_without_ground_truth_and_poor_ones_are_left_out() {
        let dir = tempfile::tempdir().unwrap();
        write(dir.path(), "b.1", (40, 30), 20);
        write(dir.path(), "a", (40, 30), 50);
        write(dir.path(), "poor", (40, 30), 15);
        let read = OwnFrames::read(dir.path(), None).unwrap();
        let names: Vec<&str> = read.frames.iter().map(|f| f.name.as_str()).collect();
        assert_eq!((names, read.left_out), (vec!["a", "b.1"], vec!["poor".to_string()]));
        assert_eq!(read.frames[0].sparse.measured(), 50);

        let flat = tempfile::tempdir().unwrap();
        for (from, to) in [("rgb/a.png", "a_rgb.png"), ("sparse/a.npy", "a_sparse.npy")] {
            std::fs::copy(dir.path().join(from), flat.path().join(to)).unwrap();
        }
        assert_eq!(OwnFrames::read(flat.path(), None).unwrap().frames[0].name, "a");
    }

    #[test]
    fn what_is_wrong_with_a_folder_is_told() {
        let dir = tempfile::tempdir().unwrap();
        let refused = |file: &str| match OwnFrames::read(dir.path(), None) {
            Err(Error::Format { path, .. }) => assert!(path.ends_with(file), "{path:?}, expected {file}"),
            other => panic!("{file}: {other:?}"),
        };
        assert!(matches!(OwnFrames::read(&dir.path().join("no"), None), Err(Error::Io { .. })));
        refused(dir.path().file_name().unwrap().to_str().unwrap());
        write(dir.path(), "a", (40, 30), 20);
        write(dir.path(), "b", (30, 40), 20);
        refused("b.png");
        write(dir.path(), "b", (40, 30), 20);
        write_npy(dir.path().join("sparse/b.npy"), 30, 40, &[1.0; 1200]).unwrap();
        refused("b.npy");
        std::fs::remove_file(dir.path().join("sparse/b.npy")).unwrap();
        refused("b.png");
        write(dir.path(), "b", (40, 30), 20);
        std::fs::write(dir.path().join("rgb/b.png"), "no picture").unwrap();
        assert!(OwnFrames::read(dir.path(), None).unwrap_err().to_string().contains("b.png"));
    }

    #[test]
    fn a_mirror_turns_picture_and_measurements_alike() {
        let mut rgb = RgbImage::new(40, 30);
        rgb.put_pixel(3, 5, image::Rgb([9, 8, 7]));
        let sparse = SparseDepth::from_points(40, 30, &[(3, 5, 2.5)]).unwrap();
        let turned = OwnFrame { name: "a".into(), rgb, sparse }.mirrored().unwrap();
        assert_eq!(turned.rgb.get_pixel(36, 5).0, [9, 8, 7]);
        assert_eq!(turned.sparse.points().collect::<Vec<_>>(), [(36, 5, 2.5)]);
    }
}
