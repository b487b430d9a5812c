//! Attention over blocks of rows: what each row sees, how the work is cut, and its forms in f32, in bf16 and composed
//! from candle operations.

pub(in crate::kernels) mod bf16;
pub(in crate::kernels) mod composed;
pub(in crate::kernels) mod f32;
pub(in crate::kernels) mod layout;
pub(in crate::kernels) mod plan;
pub(in crate::kernels) mod rows;
pub(in crate::kernels) mod shared_keys;
#[cfg(test)]
mod tests;

pub use layout::{AttentionLayout, Block, Precision, attention};
pub use shared_keys::SharedKeys;
