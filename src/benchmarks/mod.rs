//! Data sets of the depth-completion benchmarks, read in the layout in which they are published.
//!
//! A [`Layout`] names a data set's way of storing frames; [`Layout::open`] lists the frames and gives them as a [`Dataset`],
//! whatever the format: picture, ground truth, and the sensor's measurements where the data set has any. The rules of each
//! (resizing, cropping, validity, outliers) stand at its loader with their source; the protocol is Sec. 4.1 of the paper,
//! which follows Marigold-DC (arXiv 2412.13389).
//!
//! Everything is read from the user's own copy; nothing is downloaded. Files are not trusted: sizes that they claim are
//! checked against what is really there before memory is set aside, and every error names the file.

mod dataset;
mod ddad;
mod files;
mod flat;
pub(crate) mod folder;
mod hdf5;
mod hypersim;
mod ibims;
mod kitti;
mod listing;
mod mat;
mod nyu;
pub(crate) mod outliers;
mod parts;
mod scannet;
mod tum;
mod virtual_kitti;
mod void;

use std::path::{Path, PathBuf};
use std::str::FromStr;

use crate::depth::DepthScale;
use crate::error::{Error, Result};
pub use dataset::{Dataset, Mask, Sample, frame_seed};
use ddad::DdadDataset;
use folder::FolderDataset;
use hypersim::HypersimDataset;
use ibims::IbimsDataset;
use kitti::KittiDataset;
use nyu::NyuDataset;
use parts::{Chosen, Ranged};
use scannet::ScanNetDataset;
use tum::TumDataset;
use virtual_kitti::VirtualKittiDataset;
use void::VoidDataset;

/// The way in which a data set is stored. Parses from its name in lower case.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum Layout {
    /// `folder`: `rgb/`, `gt/` and perhaps `sparse/`, as Marigold-DC's scripts write them; `rgb/` and `sparse/` alone have no ground truth.
    Folder,
    /// `nyu`: NYU Depth V2 in HDF5.
    Nyu,
    /// `void`: one density of VOID.
    Void,
    /// `ibims`: iBims-1 in MATLAB files.
    Ibims,
    /// `kitti`: the validation selection of KITTI depth completion.
    Kitti,
    /// `ddad`: the front camera of DDAD.
    Ddad,
    /// `tum`: TUM RGB-D recordings.
    Tum,
    /// `scannet`: exported ScanNet scenes.
    ScanNet,
    /// `hypersim`: rendered rooms of Hypersim, for training.
    Hypersim,
    /// `virtual-kitti`: rendered streets of Virtual KITTI 2, for training.
    VirtualKitti,
}

/// What may be chosen when a data set is opened.
#[derive(Clone, Debug, Default, PartialEq)]
#[non_exhaustive]
pub struct LayoutOptions {
    /// Unit of the integer files of [`Layout::Folder`]. The other layouts have a unit of their own and refuse another.
    pub scale: Option<DepthScale>,
    /// Seed of measurements that a loader draws itself, as [`frame_seed`] uses it.
    pub seed: u64,
    /// Nearest and farthest ground truth that counts, metres; what lies outside becomes NaN. `None`: all of it, as
    /// Marigold-DC scores. Measurements that the data set brings are never touched; points drawn from the ground truth lie in the
    /// range as it does.
    pub range: Option<(f32, f32)>,
    /// A text file that names the frames to take, one per line and in its order; `#` starts a comment. A name is that of
    /// [`Dataset::name`], or `SCENE/NUMBER` as in the published lists of ScanNet's frames, with or without zeros before the
    /// number. `None`: all frames.
    pub frames: Option<PathBuf>,
}

impl LayoutOptions {
    /// With this unit of integer files.
    pub fn with_scale(mut self, scale: DepthScale) -> Self {
        self.scale = Some(scale);
        self
    }

    /// With this seed of drawn measurements.
    pub fn with_seed(mut self, seed: u64) -> Self {
        self.seed = seed;
        self
    }

    /// With ground truth between these depths alone, metres.
    pub fn with_range(mut self, nearest: f32, farthest: f32) -> Self {
        self.range = Some((nearest, farthest));
        self
    }

    /// With the frames that this text file names.
    pub fn with_frames(mut self, list: impl Into<PathBuf>) -> Self {
        self.frames = Some(list.into());
        self
    }
}

impl Layout {
    /// Every layout.
    pub const ALL: [Layout; 10] = [
        Layout::Folder,
        Layout::Nyu,
        Layout::Void,
        Layout::Ibims,
        Layout::Kitti,
        Layout::Ddad,
        Layout::Tum,
        Layout::ScanNet,
        Layout::Hypersim,
        Layout::VirtualKitti,
    ];

    /// The name that [`Layout::from_str`] reads.
    pub fn name(self) -> &'static str {
        match self {
            Layout::Folder => "folder",
            Layout::Nyu => "nyu",
            Layout::Void => "void",
            Layout::Ibims => "ibims",
            Layout::Kitti => "kitti",
            Layout::Ddad => "ddad",
            Layout::Tum => "tum",
            Layout::ScanNet => "scannet",
            Layout::Hypersim => "hypersim",
            Layout::VirtualKitti => "virtual-kitti",
        }
    }

    /// Number of points that the benchmark's protocol draws from the ground truth (ScanNet: Marigold-DC's); `None` where the
    /// data set has measurements of its own or leaves the number open.
    pub fn points(self) -> Option<usize> {
        match self {
            Layout::Nyu | Layout::ScanNet => Some(500),
            Layout::Ibims => Some(1000),
            Layout::Folder | Layout::Void | Layout::Kitti | Layout::Ddad | Layout::Tum => None,
            Layout::Hypersim | Layout::VirtualKitti => None,
        }
    }

    /// Number of test frames of the whole published benchmark (ScanNet: Marigold-DC's choice), where there is one. A copy may
    /// hold fewer.
    pub fn frames(self) -> Option<usize> {
        match self {
            Layout::Nyu => Some(654),
            Layout::Void => Some(800),
            Layout::Ibims => Some(100),
            Layout::Kitti => Some(1000),
            Layout::Ddad => Some(3950),
            Layout::ScanNet => Some(745),
            Layout::Folder | Layout::Tum | Layout::Hypersim | Layout::VirtualKitti => None,
        }
    }

    /// Lists the frames of a data set.
    ///
    /// # Errors
    /// [`Error::Argument`] for an option that the layout does not take and for a range that is empty; otherwise an error that
    /// names the file or directory which is missing, or has no partner, or the list of frames with the name that is unknown or
    /// stands in it twice.
    pub fn open(self, path: impl AsRef<Path>, options: &LayoutOptions) -> Result<Box<dyn Dataset>> {
        let path = path.as_ref();
        if let (Some(scale), true) = (options.scale, self != Layout::Folder) {
            let expected = format!("none: the files of layout {} have a fixed unit", self.name());
            return Err(Error::argument("depth scale", scale.units(), expected));
        }
        let mut frames: Box<dyn Dataset> = match self {
            Layout::Folder => Box::new(FolderDataset::open(path, options.scale)?),
            Layout::Nyu => Box::new(NyuDataset::open(path)?),
            Layout::Void => Box::new(VoidDataset::open(path)?),
            Layout::Ibims => Box::new(IbimsDataset::open(path)?),
            Layout::Kitti => Box::new(KittiDataset::open(path)?),
            Layout::Ddad => Box::new(DdadDataset::open(path, options.seed)?),
            Layout::Tum => Box::new(TumDataset::open(path)?),
            Layout::ScanNet => Box::new(ScanNetDataset::open(path)?),
            Layout::Hypersim => Box::new(HypersimDataset::open(path)?),
            Layout::VirtualKitti => Box::new(VirtualKittiDataset::open(path)?),
        };
        if let Some(list) = &options.frames {
            frames = Box::new(Chosen::by_list(frames, list)?);
        }
        if let Some(range) = options.range {
            frames = Box::new(Ranged::new(frames, range)?);
        }
        Ok(frames)
    }
}

impl FromStr for Layout {
    type Err = Error;

    fn from_str(text: &str) -> Result<Self> {
        Self::ALL.into_iter().find(|l| l.name() == text).ok_or_else(|| {
            Error::argument("layout", format!("{text:?}"), Self::ALL.map(Self::name).join(", "))
        })
    }
}

impl std::fmt::Display for Layout {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(self.name())
    }
}
