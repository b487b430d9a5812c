//! Attention with operands in bf16 and sums in f32, without gradients.

// Only x86-64 has a kernel.
#![cfg_attr(not(target_arch = "x86_64"), allow(dead_code))]

mod call;
mod job;
mod kernel;
mod packed_keys;
#[cfg(target_arch = "x86_64")]
mod x86_64;

pub(super) use call::bf16_attention;
pub(super) use kernel::AttentionKernel;
pub(super) use packed_keys::PackedKeys;
