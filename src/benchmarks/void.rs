//! VOID (Wong et al., RA-L 2020): RealSense frames with points of a visual-inertial odometry.

use std::path::{Path, PathBuf};

use image::RgbImage;

use super::dataset::Sample;
use super::files::{below, depth, frame_name, lines, naming, picture, same_size};
use super::listing::{Frame, Loader};
use crate::depth::io::png16;
use crate::depth::{DepthScale, SparseDepth};
use crate::error::{Error, Result};

#[derive(Clone, Debug)]
pub(super) struct Files {
    rgb: PathBuf,
    sparse: PathBuf,
    validity: PathBuf,
    gt: PathBuf,
}

/// One density of the official release: `void_150`, `void_500` or `void_1500`, 800 test frames of 640 x 480 pixels.
///
/// Frames are those of `test_image.txt`, `test_sparse_depth.txt`, `test_validity_map.txt` and `test_ground_truth.txt`, line by
/// line, with paths like `void_150/data/SEQUENCE/image/TIME.png` relative to the folder above. Depth is stored in 16 bits, 256
/// units per metre, 0 = none; a validity map in 16 bits, 0 where nothing was measured (the release's `data_utils.py`). A
/// measurement counts where it is above 0 and its validity map is not 0. Neither resized nor cropped, no points are drawn.
///
/// Two conventions exist for the ground truth: VOID's own benchmark scores 0.2 to 5 m (`range` of
/// [`super::LayoutOptions`]), Marigold-DC and the paper all of it, which is the default.
#[derive(Clone, Debug)]
pub struct VoidDataset {
    frames: Vec<Frame<Files>>,
}

impl VoidDataset {
    /// Reads the four lists.
    ///
    /// # Errors
    /// [`Error::Io`] for a list that cannot be read; [`Error::Format`] naming the list that is empty, has another length than
    /// the pictures', or leads out of the data set.
    pub fn open(dir: impl AsRef<Path>) -> Result<Self> {
        let dir = dir.as_ref();
        let lists = ["image", "sparse_depth", "validity_map", "ground_truth"];
        let lists = lists.map(|kind| dir.join(format!("test_{kind}.txt")));
        let root = root(dir, &lists[0])?;
        let mut columns = Vec::new();
        for list in &lists {
            let paths = lines(list)?;
            columns.push(paths.iter().map(|p| below(&root, p, list)).collect::<Result<Vec<_>>>()?);
            let (first, this) = (columns[0].len(), paths.len());
            if this != first {
                let expected = format!("{first}, as many as {}", lists[0].display());
                return Err(Error::format(list, format!("{this} paths"), expected));
            }
        }
        let mut columns = columns.into_iter().map(Vec::into_iter);
        let mut next = || columns.next().unwrap_or_default();
        let (rgb, sparse, validity, gt) = (next(), next(), next(), next());
        let frames = rgb.zip(sparse).zip(validity).zip(gt).map(|(((rgb, sparse), validity), gt)| Frame {
            name: name_of(&rgb),
            files: Files { rgb, sparse, validity, gt },
        });
        Ok(Self { frames: frames.collect() })
    }
}

/// What the paths of the lists are relative to: the folder above as released, or the lists' own after moving things.
fn root(dir: &Path, list: &Path) -> Result<PathBuf> {
    let paths = lines(list)?;
    let Some(first) = paths.first() else {
        return Err(Error::format(list, "no path", "one path per frame"));
    };
    let roots = [dir.join(".."), dir.to_path_buf(), dir.join("../..")];
    let found = roots.into_iter().find(|root| below(root, first, list).is_ok_and(|p| p.is_file()));
    found.ok_or_else(|| {
        let expected = format!("a file of this path in or above {}", dir.display());
        Error::format(list, format!("path {first:?}"), expected)
    })
}

/// `SEQUENCE/image/TIME.png` -> `SEQUENCE-TIME`.
fn name_of(rgb: &Path) -> String {
    let text = |p: Option<&std::ffi::OsStr>| p.and_then(|s| s.to_str()).unwrap_or_default().to_string();
    let sequence = rgb.parent().and_then(Path::parent).map(|p| text(p.file_name())).unwrap_or_default();
    frame_name(&sequence, &text(rgb.file_stem()))
}

impl Loader for VoidDataset {
    type Files = Files;

    fn frames(&self) -> &[Frame<Files>] {
        &self.frames
    }

    fn brings_measurements(&self, _: &Files) -> bool {
        true
    }

    fn read(&self, frame: &Frame<Files>, _: usize) -> Result<Sample> {
        let Files { rgb, sparse, validity, gt } = &frame.files;
        let scale = Some(DepthScale::kitti());
        let rgb = picture(rgb)?;
        let gt = depth(gt, scale, &rgb)?.as_slice().to_vec();
        let sparse = valid_only(&depth(sparse, scale, &rgb)?, validity, &rgb)?;
        Ok(Sample { name: frame.name.clone(), rgb, gt, sparse: Some(sparse), masks: Vec::new() })
    }
}

fn valid_only(sparse: &SparseDepth, path: &Path, rgb: &RgbImage) -> Result<SparseDepth> {
    let (w, h, validity) = png16::read_png16(path).map_err(|e| naming(path, e))?;
    same_size(path, (w, h), rgb)?;
    let keep = |(&depth, &valid): (&f32, &u16)| if valid == 0 { f32::NAN } else { depth };
    let kept = sparse.as_slice().iter().zip(&validity).map(keep).collect();
    SparseDepth::new(w, h, kept)
}
