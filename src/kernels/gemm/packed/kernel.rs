//! A kernel for packed weights: a micro-kernel with the conversion of activations that goes with it, both compiled for an
//! instruction set.

use super::activations::{Activations, RowForm};
use super::micro_kernel::MicroKernel;
use super::product::{Product, TaskOutput};
use std::mem::MaybeUninit;

/// A kernel that this machine can run: it is made of the token of its instruction set.
pub(in crate::kernels) struct GemmKernel {
    pub(super) name: &'static str,
    pub(super) form: RowForm,
    /// Whether integer activations are signed; otherwise 128 stands for zero.
    pub(super) signed: bool,
    /// Made without memory, since tokens have no size.
    compiled: Box<dyn CompiledKernel>,
}

/// What is compiled for the kernel's instruction set.
pub(super) trait CompiledKernel: Send + Sync {
    /// Converts a row of activations; returns its scale.
    fn convert(&self, words: &mut [u32], x: &[f32]) -> f32;
    /// [`run_task`](super::product::run_task) by the kernel's micro-kernel.
    fn run_task(&self, product: &Product<'_>, output: TaskOutput<'_>);
}

impl GemmKernel {
    /// `per_step` values of a row make a step of the micro-kernel `M`.
    pub(super) fn new<M: MicroKernel>(
        name: &'static str,
        per_step: usize,
        compiled: Box<dyn CompiledKernel>,
    ) -> Self {
        let form = RowForm { per_step, words: M::WORDS, spare_rows: M::SPARE_ROWS };
        GemmKernel { name, form, signed: false, compiled }
    }

    /// The kernel, whose activations are signed.
    #[cfg(target_arch = "aarch64")]
    pub(super) fn with_signed_activations(self) -> Self {
        GemmKernel { signed: true, ..self }
    }

    /// Activations in the form that the kernel multiplies.
    pub(super) fn convert(&self, x: &[f32], n: usize, k: usize) -> Activations {
        Activations::new(self.form, |words, x| self.compiled.convert(words, x), x, n, k)
    }

    /// [`Product::write`] of a product whose activations are of this kernel's form.
    pub(super) fn multiply(&self, product: &Product<'_>, results: &mut [&mut [MaybeUninit<f32>]]) {
        product.write(results, |output| self.compiled.run_task(product, output));
    }
}

/// Defines `fn $name(isa: $token) -> GemmKernel`, with the functions compiled for the token's instruction set.
macro_rules! gemm_kernel {
    ($(#[$meta:meta])* $name:ident($token:ident) = $label:literal, $per_step:literal, $convert:path, $micro:ty) => {
        $(#[$meta])*
        fn $name(isa: $crate::kernels::isa::$token) -> $crate::kernels::gemm::packed::kernel::GemmKernel {
            use $crate::kernels::gemm::packed::kernel::{CompiledKernel, GemmKernel};
            use $crate::kernels::gemm::packed::product::{Product, TaskOutput, run_task};
            use $crate::kernels::isa::call_compiled;

            struct Compiled($crate::kernels::isa::$token);

            impl CompiledKernel for Compiled {
                fn convert(&self, words: &mut [u32], x: &[f32]) -> f32 {
                    call_compiled!($token, self.0, $convert, (words: &mut [u32], x: &[f32]) -> f32)
                }
                fn run_task(&self, product: &Product<'_>, output: TaskOutput<'_>) {
                    call_compiled!($token, self.0, run_task::<$micro>, (product: &Product<'_>, output: TaskOutput<'_>))
                }
            }

            GemmKernel::new::<$micro>($label, $per_step, Box::new(Compiled(isa)))
        }
    };
}
pub(super) use gemm_kernel;
