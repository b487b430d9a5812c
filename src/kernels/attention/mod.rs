//! Attention over blocks of rows, without masks.
//!
//! A `layout` says which row sees which keys, a `plan` cuts the work into tiles of rows and sets of keys, and `dispatch` chooses the form:
//! `f32` (with gradients), `bf16` (without), or for other devices and types of candle operations: `batched` (without; `rounded` has
//! its products of bf16) or `composed` (with).

mod batched;
mod bf16;
mod composed;
mod dispatch;
mod f32;
mod inputs;
mod layout;
mod own_keys;
mod plan;
mod rounded;
mod shared_keys;
#[cfg(test)]
mod tests;

pub use dispatch::attention;
pub use layout::{AttentionLayout, Block, Precision};
pub use shared_keys::SharedKeys;
