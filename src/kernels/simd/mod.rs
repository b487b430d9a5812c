//! Registers of f32, scalar functions that the compiler vectorises, and hints to the cache.

#[cfg(target_arch = "aarch64")]
mod aarch64;
mod math;
mod prefetch;
mod vector;
#[cfg(target_arch = "x86_64")]
mod x86_64;

pub(in crate::kernels) use math::{dot, erf, exp, madd, sigmoid};
pub(in crate::kernels) use prefetch::{opaque, prefetch_l1, prefetch_l2};
pub(in crate::kernels) use vector::{Simd, Vector};
