//! What every data set gives, whatever its files.

use crate::depth::{SparseDepth, SparsePattern};
use crate::error::Result;
use image::RgbImage;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

/// Frames with ground truth, in a fixed order. Opening lists files, loading reads them.
pub trait Dataset: Send + Sync {
    /// Number of frames, at least 1.
    fn len(&self) -> usize;

    /// Never true: a data set without frames cannot be opened.
    fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Name of a frame: unique in the data set, without path separators. Empty beyond the last frame.
    fn name(&self, index: usize) -> String;

    /// Whether a frame comes with [`Sample::sparse`], told without reading it; false beyond the last frame.
    fn has_measurements(&self, index: usize) -> bool;

    /// Reads a frame. The same index always gives the same sample.
    ///
    /// A frame without a single valid depth is no error, since sensors deliver such frames: [`Sample::gt`] is then NaN
    /// everywhere, or [`Sample::sparse`] has no measurement, and the caller decides what becomes of it.
    ///
    /// # Errors
    /// [`crate::Error::Argument`] beyond the last frame; otherwise an error that names the file which cannot be read, or has another
    /// format or size than it should.
    fn load(&self, index: usize) -> Result<Sample>;
}

/// One frame of a data set.
#[derive(Clone, Debug)]
pub struct Sample {
    /// As [`Dataset::name`].
    pub name: String,
    /// The picture.
    pub rgb: RgbImage,
    /// Ground-truth Z-depth, metres, row-major, as many values as `rgb` has pixels; NaN where unknown.
    pub gt: Vec<f32>,
    /// The measurements of a sensor, or the points that the benchmark's authors published, where the data set has them, after
    /// its outlier rule; for DDAD without hints those that stand in for them. Perhaps not a single one.
    pub sparse: Option<SparseDepth>,
    /// Regions that the data set marks; empty for most.
    pub masks: Vec<Mask>,
}

/// A marked region of a frame.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Mask {
    /// What is marked.
    pub name: &'static str,
    /// Row-major, as many values as the frame has pixels; true where the pixel is what the name says.
    pub pixels: Vec<bool>,
}

impl Sample {
    /// The frame's own measurements (perhaps none, see [`Dataset::load`]); where it brings none, `points` pixels of the ground
    /// truth drawn in a pattern.
    ///
    /// The draw depends on the seed alone (ChaCha8); give each frame its own, as [`frame_seed`] does.
    ///
    /// # Errors
    /// As [`SparsePattern::sample`]: ground truth without a valid pixel is [`crate::Error::NoMeasurement`].
    pub fn measurements(&self, points: usize, pattern: SparsePattern, seed: u64) -> Result<SparseDepth> {
        if let Some(sparse) = &self.sparse {
            return Ok(sparse.clone());
        }
        let (width, height) = (self.rgb.width() as usize, self.rgb.height() as usize);
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        pattern.sample(&self.rgb, &self.gt, width, height, points, &mut rng)
    }

    /// The mask of this name, where the data set has it.
    pub fn mask(&self, name: &str) -> Option<&[bool]> {
        self.masks.iter().find(|m| m.name == name).map(|m| m.pixels.as_slice())
    }
}

/// The seed of a frame's random choices: the run's seed plus the frame's index, so that a frame gets the same measurements
/// whichever part of the data set is run.
pub fn frame_seed(seed: u64, index: usize) -> u64 {
    seed.wrapping_add(index as u64)
}
