//! Products with weights that are packed once, when they are loaded, in half or a quarter of the
//! memory of f32.
//!
//! One layout serves every instruction set and both formats: panels of 32 output channels,
//! `[panel][step][channel]` of 32-bit words, a word being the values of a channel for one step
//! through the inner dimension: two bf16 or four signed bytes. That is what the dot-product
//! instructions take (AVX512-BF16, VNNI, AMX, the dot products of NEON), and what others widen in registers.
//!
//! From the bottom up: `panels` holds the words, `activations` the rows that they are multiplied by; a `micro_kernel` multiplies some rows
//! by a panel, by an instruction set (`portable`, `x86_64`, `amx`, `aarch64`); a `product` is cut into tasks of these; a `kernel` is
//! a micro-kernel with its conversion of activations, which `select` chooses; `weight` and `gate` are what layers hold.

#[cfg(target_arch = "aarch64")]
mod aarch64;
mod activations;
#[cfg(any(test, target_arch = "x86_64"))]
mod amx;
mod format;
mod gate;
mod kernel;
mod micro_kernel;
#[cfg(target_arch = "aarch64")]
mod neon;
mod panels;
mod portable;
mod product;
mod quantise;
mod row_major;
mod select;
#[cfg(test)]
mod tests;
#[cfg(test)]
mod tests_int8;
mod weight;
mod widened;
mod words;
#[cfg(target_arch = "x86_64")]
mod x86_64;

#[cfg(target_arch = "aarch64")]
pub(in crate::kernels) use aarch64::{bfdot, sdot};
#[cfg(target_arch = "x86_64")]
pub(in crate::kernels) use amx::AmxMicroKernel;
pub use format::WeightFormat;
pub use gate::PackedGate;
#[cfg(target_arch = "x86_64")]
pub(in crate::kernels) use micro_kernel::{MicroKernel, Operands, multiply_by_registers};
#[cfg(target_arch = "x86_64")]
pub(in crate::kernels) use panels::HALF_PANEL;
pub(in crate::kernels) use panels::{AlignedWords, PANEL_WIDTH, WordPanels};
pub(in crate::kernels) use product::Finish;
pub use row_major::RowMajor;
pub(in crate::kernels) use select::current as current_kernel;
#[cfg(test)]
pub(in crate::kernels) use tests::packed_as;
pub use weight::PackedWeight;
pub(in crate::kernels) use weight::{expect_cpu_f32, read_some};
#[cfg(target_arch = "x86_64")]
pub(in crate::kernels) use words::from_f32;
pub(in crate::kernels) use words::{pair_neighbours, pair_rows};
#[cfg(target_arch = "x86_64")]
pub(in crate::kernels) use x86_64::Bf16Dot;
