//! The architecture of Qwen2.5-VL: preprocessing, vision encoder, M-RoPE, decoder, cache.
//!
//! Tokens are rows of `[tokens, width]` tensors; there is no batch axis and no padding. Structs and names are those of the
//! published checkpoints.

pub(crate) mod bilinear;
pub mod cache;
pub mod config;
pub mod crops;
pub mod decoder;
pub mod grid;
mod interrupt;
mod model;
pub mod patch_embed;
pub mod positions;
pub mod preprocess;
pub mod rope;
pub mod sequences;
pub mod token_table;
pub mod vision;

pub use interrupt::Interrupt;
pub use model::QwenVl;
