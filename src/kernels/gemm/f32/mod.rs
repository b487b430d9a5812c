//! Matrix products of f32.

mod panels;
mod product;

pub(in crate::kernels) use panels::{Lhs, Panels};
pub(in crate::kernels) use product::{Init, multiply};
