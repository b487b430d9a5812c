//! The one error type of the crate: what was wrong, where, and what was expected.

use std::path::{Path, PathBuf};

/// Result of every fallible function of this crate.
pub type Result<T, E = Error> = std::result::Result<T, E>;

/// Why a call failed. Messages name the file, tensor, key or value and what was expected there.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// The RGB frame and the depth map have different sizes (width x height, pixels).
    #[error("size mismatch: rgb is {}x{}, depth is {}x{}; both must have the same width and height", rgb.0, rgb.1, depth.0, depth.1)]
    SizeMismatch {
        /// Width and height of the RGB frame.
        rgb: (usize, usize),
        /// Width and height of the depth map.
        depth: (usize, usize),
    },
    /// A buffer does not hold the number of elements its stated size needs.
    #[error("{what}: buffer holds {found} elements, expected {expected}")]
    BufferLength {
        /// Which buffer.
        what: &'static str,
        /// Elements expected.
        expected: usize,
        /// Elements found.
        found: usize,
    },
    /// No pixel of the sparse depth map carries a usable measurement.
    #[error(
        "sparse depth {width}x{height} has no valid measurement; expected at least one finite depth > 0 m"
    )]
    NoMeasurement {
        /// Width of the map.
        width: usize,
        /// Height of the map.
        height: usize,
    },
    /// A measurement is finite and positive but beyond any range sensor: most likely a wrong unit.
    #[error("depth {value} m at pixel ({x}, {y}) is beyond {limit} m; check the depth scale (unit)")]
    DepthRange {
        /// The value, metres.
        value: f32,
        /// Column.
        x: usize,
        /// Row.
        y: usize,
        /// Largest accepted depth, metres.
        limit: f32,
    },
    /// An image size that the model cannot take.
    #[error("image {width}x{height}: {reason}")]
    ImageSize {
        /// Width, pixels.
        width: usize,
        /// Height, pixels.
        height: usize,
        /// What was expected.
        reason: String,
    },
    /// The operating system refused a file operation.
    #[error("{}: {source}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// The cause.
        #[source]
        source: std::io::Error,
    },
    /// A file was read but does not hold what it should.
    #[error("{}: {found}; expected {expected}", path.display())]
    Format {
        /// The file.
        path: PathBuf,
        /// What was found.
        found: String,
        /// What was expected.
        expected: String,
    },
    /// A key of a configuration or calibration is absent or has a value that is not supported.
    #[error("{file}: key `{key}` is {found}; expected {expected}")]
    Config {
        /// Which configuration file.
        file: String,
        /// Path of the key.
        key: String,
        /// Value found, or "missing".
        found: String,
        /// What was expected.
        expected: String,
    },
    /// One tensor of a checkpoint has a wrong shape or type.
    #[error("tensor `{name}` in {file}: found {found}; expected {expected}")]
    Tensor {
        /// File or directory of the checkpoint.
        file: String,
        /// Published tensor name.
        name: String,
        /// Shape or type found.
        found: String,
        /// Shape or type expected.
        expected: String,
    },
    /// The checkpoint's set of tensors is not the one that its config asks for.
    #[error(
        "checkpoint {file}: {} missing tensors {missing:?}, {} unexpected tensors {unexpected:?}, \
         {} tensors of another shape {misshaped:?}",
        missing.len(), unexpected.len(), misshaped.len()
    )]
    TensorSet {
        /// File or directory of the checkpoint.
        file: String,
        /// Names that the config needs and the checkpoint lacks.
        missing: Vec<String>,
        /// Names in the checkpoint that nothing reads.
        unexpected: Vec<String>,
        /// Names with the shape found and the one that the config needs.
        misshaped: Vec<String>,
    },
    /// An argument or option has a value out of its range.
    #[error("{name} = {found}; expected {expected}")]
    Argument {
        /// Name of the argument or option.
        name: &'static str,
        /// The value.
        found: String,
        /// What was expected.
        expected: String,
    },
    /// The tokenizer lacks a token or could not encode.
    #[error("tokenizer: {0}")]
    Tokenizer(String),
    /// A revision of a hub repository is not complete in the local cache, and was not fetched (feature `hub`).
    #[error("{repository} at {revision}: {missing:?} not in the cache {}: {reason}", cache.display())]
    Hub {
        /// `OWNER/NAME`.
        repository: String,
        /// Branch, tag or commit.
        revision: Box<str>,
        /// Folder of the cache.
        cache: Box<Path>,
        /// The files that are needed and not there.
        missing: Vec<String>,
        /// Whether requests were forbidden.
        offline: bool,
        /// Why they were not fetched.
        reason: String,
    },
    /// A training run cannot go on: so many steps in a row had a loss or gradients that are not finite. They changed nothing.
    #[error(
        "training: {skipped} steps in a row, up to step {step}, with a loss or gradients that are not finite; expected a \
         finite number now and then: go on from an earlier checkpoint, or with a lower rate"
    )]
    Diverged {
        /// The last step.
        step: usize,
        /// Steps in a row.
        skipped: usize,
    },
    /// The caller asked to stop.
    #[error("cancelled")]
    Cancelled,
    /// A tensor operation failed inside candle.
    #[error(transparent)]
    Tensors(#[from] candle_core::Error),
}

impl Error {
    pub(crate) fn io(path: impl AsRef<Path>) -> impl FnOnce(std::io::Error) -> Error {
        let path = path.as_ref().to_path_buf();
        move |source| Error::Io { path, source }
    }

    pub(crate) fn format(
        path: impl AsRef<Path>,
        found: impl Into<String>,
        expected: impl Into<String>,
    ) -> Error {
        Error::Format { path: path.as_ref().to_path_buf(), found: found.into(), expected: expected.into() }
    }

    pub(crate) fn config(
        file: &str,
        key: &str,
        found: impl Into<String>,
        expected: impl Into<String>,
    ) -> Error {
        Error::Config {
            file: file.to_string(),
            key: key.to_string(),
            found: found.into(),
            expected: expected.into(),
        }
    }

    pub(crate) fn argument(
        name: &'static str,
        found: impl std::fmt::Display,
        expected: impl Into<String>,
    ) -> Error {
        Error::Argument { name, found: found.to_string(), expected: expected.into() }
    }
}
