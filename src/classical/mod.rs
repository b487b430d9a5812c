//! Classical completion, without a model: what any method has to beat, and a fallback where no model can run.
//!
//! All are deterministic, give a finite depth at every pixel from one measurement on, and never leave the range of the
//! measurements. They give no confidence.

mod colorization;
mod inverse_distance;
mod ip_basic;

use std::fmt;
use std::str::FromStr;

use image::RgbImage;

use crate::depth::{SparseDepth, interpolate};
use crate::error::{Error, Result};

/// A classical method.
///
/// ```
/// use sdim::{SparseDepth, classical::Baseline};
/// let rgb = image::RgbImage::new(64, 48);
/// let sparse = SparseDepth::from_points(64, 48, &[(5, 5, 2.0), (60, 8, 2.5), (30, 40, 1.2)])?;
/// let dense = "linear".parse::<Baseline>()?.complete(&rgb, &sparse)?; // metres, row-major
/// assert!(dense.iter().all(|d| (1.2..=2.5).contains(d)));
/// # Ok::<(), sdim::Error>(())
/// ```
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[non_exhaustive]
pub enum Baseline {
    /// The nearest measurement ([`interpolate::nearest`]). Keeps measurements.
    Nearest,
    /// Linear over the Delaunay triangles ([`interpolate::linear`]). Keeps measurements.
    Linear,
    /// Dilations and closings, nearer before farther, then smoothing: Ku, Harakeh, Waslander, "In Defense of Classical Image
    /// Processing: Fast Depth Completion on the CPU", 2018. Made for LiDAR; smooths the measurements as well.
    IpBasic,
    /// Inverse-distance weighting of the 12 nearest measurements: Shepard, "A two-dimensional interpolation function for
    /// irregularly-spaced data", 1968, with the local weights of Franke and Little. Keeps measurements.
    InverseDistance,
    /// Guided by the picture: each pixel as the mean of its neighbours, weighed by how alike they look (Levin, Lischinski, Weiss,
    /// "Colorization using Optimization", 2004; used for depth in the toolbox of NYUv2). Keeps measurements.
    Colorization,
}

impl Baseline {
    /// All of them, in the order of tables.
    pub const ALL: [Baseline; 5] =
        [Self::Nearest, Self::Linear, Self::IpBasic, Self::InverseDistance, Self::Colorization];

    /// The name that [`Baseline::from_str`] reads.
    pub fn name(self) -> &'static str {
        match self {
            Self::Nearest => "nearest",
            Self::Linear => "linear",
            Self::IpBasic => "ip-basic",
            Self::InverseDistance => "inverse-distance",
            Self::Colorization => "colorization",
        }
    }

    /// Dense Z-depth, metres, row-major, one finite value above 0 per pixel. Only [`Baseline::Colorization`] looks at `rgb`.
    ///
    /// # Errors
    /// [`Error::SizeMismatch`] if picture and measurements differ in size, [`Error::NoMeasurement`].
    pub fn complete(self, rgb: &RgbImage, sparse: &SparseDepth) -> Result<Vec<f32>> {
        let (picture, depth) =
            ((rgb.width() as usize, rgb.height() as usize), (sparse.width(), sparse.height()));
        if picture != depth {
            return Err(Error::SizeMismatch { rgb: picture, depth });
        }
        sparse.require_points()?;
        match self {
            Self::Nearest => interpolate::nearest(sparse),
            Self::Linear => interpolate::linear(sparse),
            Self::IpBasic => ip_basic::complete(sparse),
            Self::InverseDistance => Ok(inverse_distance::complete(sparse)),
            Self::Colorization => colorization::complete(rgb, sparse),
        }
    }
}

impl fmt::Display for Baseline {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

impl FromStr for Baseline {
    type Err = Error;

    fn from_str(text: &str) -> Result<Self> {
        let names = || Self::ALL.map(Self::name).join(", ");
        let found = Self::ALL.into_iter().find(|b| b.name() == text);
        found.ok_or_else(|| Error::argument("baseline", format!("{text:?}"), names()))
    }
}
