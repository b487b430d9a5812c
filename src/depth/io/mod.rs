//! Files that hold depth: 16-bit PNG and npy. [`SparseDepth::read`](crate::SparseDepth::read) reads both by their name.

pub(crate) mod npy;
pub(crate) mod png16;

pub use npy::write_npy;
pub use png16::{read_png16, write_png16};
