//! Matrix products of f32.

pub(in crate::kernels) mod panels;
pub(in crate::kernels) mod product;
