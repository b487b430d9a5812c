//! Attention in f32, with gradients.

pub(in crate::kernels) mod op;
pub(in crate::kernels) mod tile;
