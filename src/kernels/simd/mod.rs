//! Registers of f32, and scalar functions that the compiler vectorises.

pub(in crate::kernels) mod math;
pub(in crate::kernels) mod vector;
