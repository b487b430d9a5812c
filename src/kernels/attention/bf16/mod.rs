//! Attention with operands in bf16, without gradients.

pub(in crate::kernels) mod call;
pub(in crate::kernels) mod kernel;
#[cfg(target_arch = "x86_64")]
mod x86_64;
