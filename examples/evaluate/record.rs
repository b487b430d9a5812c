//! One frame's scores, and the files that hold them.

use anyhow::{Context, Result};
use sdim::metrics::{ConfidenceScores, Errors};
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::io::Write;
use std::path::{Path, PathBuf};

pub const SETTINGS: &str = "settings.json";

/// What is known of one frame with one number of points.
#[derive(Debug, Serialize, Deserialize)]
pub struct Record {
    pub index: usize,
    pub name: String,
    pub width: usize,
    pub height: usize,
    /// Pixels that were measured.
    pub measured: usize,
    /// Whether they came with the data set and were not drawn.
    pub own: bool,
    /// Why the frame cannot be scored, if it cannot for want of valid depth; there are no scores then. A file that cannot be
    /// read is an error instead: it is mended or fetched again, while means over what is left would pass for those of the whole set.
    pub skipped: Option<String>,
    /// By method, in the order of the table.
    pub scores: Vec<Scores>,
    /// Time and memory; in no report that must be the same twice.
    pub cost: Vec<Cost>,
}

/// One method on one frame.
#[derive(Debug, Serialize, Deserialize)]
pub struct Scores {
    pub method: String,
    pub errors: Errors,
    pub gradient_error: Option<f64>,
    /// By name of the region: distance to the nearest measurement, depth edges, masks of the data set.
    pub regions: Vec<(String, Option<Errors>)>,
    pub confidence: Option<Confidence>,
}

/// The numbers of [`ConfidenceScores`] without their diagrams.
#[derive(Debug, Serialize, Deserialize)]
pub struct Confidence {
    pub ause: f64,
    pub aurg: f64,
    pub confidence_ause: f64,
    pub expected_error_calibration: f64,
    pub confidence_calibration: f64,
}

impl Confidence {
    /// Names, in files, and values.
    pub fn values(&self) -> [(&'static str, f64); 5] {
        [
            ("ause", self.ause),
            ("aurg", self.aurg),
            ("confidence_ause", self.confidence_ause),
            ("expected_error_calibration_m", self.expected_error_calibration),
            ("confidence_calibration", self.confidence_calibration),
        ]
    }
}

impl From<ConfidenceScores> for Confidence {
    fn from(s: ConfidenceScores) -> Self {
        Self {
            ause: s.by_expected_error.ause,
            aurg: s.by_expected_error.aurg,
            confidence_ause: s.by_confidence.ause,
            expected_error_calibration: s.expected_error.error,
            confidence_calibration: s.confidence.error,
        }
    }
}

#[derive(Debug, Serialize, Deserialize)]
pub struct Cost {
    pub seconds: f64,
    /// Peak of the process while the method ran, where the system tells.
    pub peak_bytes: Option<u64>,
}

pub fn path(dir: &Path, points: usize, index: usize) -> PathBuf {
    dir.join("frames").join(points.to_string()).join(format!("{index:06}.json"))
}

/// A file's JSON; `None` if there is no such file.
pub fn read_json<T: DeserializeOwned>(path: &Path) -> Result<Option<T>> {
    let bytes = match std::fs::read(path) {
        Ok(bytes) => bytes,
        Err(e) if e.kind() == std::io::ErrorKind::NotFound => return Ok(None),
        Err(e) => return Err(e).with_context(|| path.display().to_string()),
    };
    let parsed = serde_json::from_slice(&bytes);
    parsed.map(Some).with_context(|| format!("{}: not as it was written; delete it", path.display()))
}

pub fn write_json(path: &Path, value: &impl Serialize) -> Result<()> {
    let mut text = serde_json::to_vec_pretty(value)?;
    text.push(b'\n');
    write_whole(path, &text)
}

/// Writes beside the target and renames into place, so that a file is there whole or not at all; makes the folder.
pub fn write_whole(path: &Path, bytes: &[u8]) -> Result<()> {
    let write = || {
        let folder = path.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."));
        std::fs::create_dir_all(folder)?;
        let mut part = tempfile::Builder::new().prefix(".part").tempfile_in(folder)?;
        part.write_all(bytes)?;
        // Other users of a cluster read the results, too.
        #[cfg(unix)]
        std::fs::set_permissions(part.path(), std::os::unix::fs::PermissionsExt::from_mode(0o644))?;
        part.persist(path).map_err(|e| e.error).map(drop)
    };
    write().with_context(|| path.display().to_string())
}

/// Values by name.
pub type Named<T> = BTreeMap<String, T>;
