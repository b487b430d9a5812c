//! Differentiable kernels for the model: each is a function on candle tensors.
//!
//! On the CPU, f32 tensors take a single-pass kernel of this module: vectorised for the instruction
//! set found at run time, parallel over fixed chunks of rows (so no result depends on the number of
//! threads), with its own backward pass. Every other device and type takes the same mathematics
//! composed from candle operations.
//!
//! The environment variable `SDIM_KERNEL` forces one instruction set, if the machine has it: `portable`; `avx2`, `avx512` or
//! `amx` on x86-64; `neon` on 64-bit Arm. It is read once, at the first call. The dot products of AVX-512, AVX2 and NEON, of bf16 and of
//! bytes, are used at these levels where the machine has them. AMX multiplies packed weights only, with AVX-512 for everything else, and
//! is never chosen where it is not asked for: it has not run on hardware yet.
//!
//! From the bottom up: `isa` finds the instruction sets and compiles functions for them, `simd` has their registers; `gemm` multiplies
//! matrices; `attention` and `ops` are what layers call. `exec` and `written` reach tensors' data and make results.
//!
//! This module knows nothing of images or depth, and is the home of `unsafe` in the crate: all of it but the one call that maps files, in
//! `vlm/checkpoint/stored.rs`.

mod attention;
#[cfg(feature = "cuda")]
mod cuda;
mod exec;
mod fused;
#[cfg(test)]
mod fused_tests;
mod gemm;
mod isa;
mod kept;
mod memory;
mod ops;
mod peak;
mod rounded;
mod simd;
#[cfg(test)]
pub(crate) mod testing;
mod threads;
mod written;

pub use attention::{AttentionLayout, Block, Precision, SharedKeys, attention};
#[cfg(feature = "cuda")]
pub(crate) use cuda::{held_bytes, prepare};
pub(crate) use exec::read;
pub use fused::{rms_norm_rounded, swiglu_rounded, widen};
pub use gemm::packed::{PackedGate, PackedWeight, RowMajor, WeightFormat};
pub use memory::keep_freed_memory;
pub use ops::{
    AdamWStep, BinStats, Middle, adamw_step, add, affine_act, batch_norm_act, bin_stats, bin_stats_of_rows,
    conv3x3, gelu_erf, linear, packed_mlp, rms_norm, rope, swiglu,
};
pub use peak::peak_gflops;
pub(crate) use threads::in_pool;
#[cfg(feature = "train")]
pub(crate) use threads::join;
