//! The kernels of attention in bf16, and which one is used.

use super::job::{CompiledAttention, QueryRows, Workspace};
#[cfg(target_arch = "x86_64")]
use super::x86_64;
#[cfg(all(test, target_arch = "x86_64"))]
use crate::kernels::isa::Portable;
#[cfg(target_arch = "x86_64")]
use crate::kernels::isa::{Avx512Bf16, Level};

/// A kernel that this machine can run: it is made of the token of its instruction set.
pub(in crate::kernels::attention) struct AttentionKernel {
    /// Most rows of a call.
    pub(super) rows: usize,
    /// Made without memory, since tokens have no size.
    compiled: Box<dyn CompiledAttention>,
}

impl AttentionKernel {
    /// The fastest at the level in use; `None` where bf16 is no faster than f32.
    pub(in crate::kernels::attention) fn current() -> Option<AttentionKernel> {
        #[cfg(target_arch = "x86_64")]
        {
            let isa = Avx512Bf16::detect()?;
            let (rows, compiled) = match Level::current() {
                Level::Avx512(_) => x86_64::dot_products(isa, isa),
                Level::Amx(amx) => x86_64::amx(isa, amx),
                _ => return None,
            };
            Some(AttentionKernel { rows, compiled })
        }
        #[cfg(not(target_arch = "x86_64"))]
        None
    }

    /// Every one that this machine can be tested with.
    #[cfg(test)]
    pub(in crate::kernels::attention) fn every() -> Vec<AttentionKernel> {
        #[cfg(target_arch = "x86_64")]
        if let (Some(current), Some(isa)) = (AttentionKernel::current(), Avx512Bf16::detect()) {
            let others = [x86_64::dot_products(isa, isa), x86_64::emulated_amx(isa, Portable)];
            let others = others.map(|(rows, compiled)| AttentionKernel { rows, compiled });
            return std::iter::once(current).chain(others).collect();
        }
        Vec::new()
    }

    /// The attention of some rows, at most [`AttentionKernel::rows`].
    pub(super) fn run(&self, rows: QueryRows<'_>, workspace: &mut Workspace) {
        self.compiled.run(rows, workspace);
    }
}
