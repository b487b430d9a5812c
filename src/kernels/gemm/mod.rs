//! Matrix products: of f32 operands, and with weights that are packed when they are loaded.

pub(in crate::kernels) mod f32;
pub(in crate::kernels) mod packed;
