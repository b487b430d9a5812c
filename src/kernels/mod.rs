//! Differentiable kernels for the model: each is a function on candle tensors.
//!
//! On the CPU, f32 tensors take a single-pass kernel of this module: vectorised for the instruction
//! set found at run time, parallel over fixed chunks of rows (so no result depends on the number of
//! threads), with its own backward pass. Every other device and type takes the same mathematics
//! composed from candle operations.
//!
//! The environment variable `SDIM_KERNEL` forces one instruction set, if the machine has it: `portable`; `avx2`, `avx512` or
//! `amx` on x86-64; `neon` on 64-bit Arm. It is read once, at the first call. (AMX multiplies packed weights only; with
//! it, everything else uses AVX-512. The dot products of AVX-512, AVX2 and NEON, of bf16 and of bytes, are used at these levels where
//! the machine has them.)
//!
//! This module knows nothing of images or depth, and is the only home of `unsafe` in the crate.

mod activation;
mod adamw;
mod add;
mod attention;
mod attention_bf16;
mod attention_composed;
mod attention_cpu;
mod attention_plan;
mod attention_rows;
mod attention_shared;
#[cfg(test)]
mod attention_tests;
mod attention_tile;
mod bins;
mod conv;
mod exec;
mod level;
mod linear;
mod math;
mod memory;
mod norm;
mod packed;
mod panels;
mod peak;
mod product;
mod rope;
mod scale_shift;
#[cfg(test)]
mod testing;
mod threads;
mod vector;

pub use activation::{gelu_erf, swiglu};
pub use adamw::adamw_step;
pub use add::add;
pub use attention::{AttentionLayout, Block, Precision, attention};
pub use attention_shared::SharedKeys;
pub use bins::{BinStats, bin_stats};
pub use conv::conv3x3;
pub(crate) use exec::read;
pub use linear::linear;
pub use memory::keep_freed_memory;
pub use norm::rms_norm;
pub use packed::{PackedGate, PackedWeight, Rows, WeightFormat};
pub use peak::peak_gflops;
pub use rope::rope;
pub use scale_shift::{affine_act, batch_norm_act};
pub(crate) use threads::in_pool;
#[cfg(feature = "train")]
pub(crate) use threads::join;
