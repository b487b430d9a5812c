//! Files that hold depth.

pub mod npy;
pub mod png16;
