//! Tensors of a checkpoint by name: files, shards, stored types, what an adapter adds.

pub(crate) mod json;
pub mod lora;
mod options;
pub(crate) mod raw;
pub(crate) mod shards;
mod stored;
pub mod weights;

pub use options::LoadOptions;
pub(crate) use stored::StoredFile;
