//! Which kernel multiplies packed weights.

use super::format::WeightFormat;
use super::kernel::GemmKernel;
use super::portable;
use crate::kernels::isa::Level;
use std::sync::Once;

/// The kernels of a level: without its extensions, and with those that the machine has.
pub(super) fn kernels(level: Level, format: WeightFormat) -> (GemmKernel, Option<GemmKernel>) {
    match level {
        Level::Portable => (portable::kernel(format), None),
        #[cfg(target_arch = "x86_64")]
        Level::Avx2(isa) => super::x86_64::avx2_kernels(isa, format),
        #[cfg(target_arch = "x86_64")]
        Level::Avx512(isa) => super::x86_64::avx512_kernels(isa, format),
        #[cfg(target_arch = "x86_64")]
        Level::Amx(isa) => (super::amx::kernel(isa, format), None),
        #[cfg(target_arch = "aarch64")]
        Level::Neon(isa) => super::aarch64::neon_kernels(isa, format),
    }
}

/// The fastest kernel of the level in use.
pub(in crate::kernels) fn current(format: WeightFormat) -> GemmKernel {
    static LOGGED: Once = Once::new();
    let (plain, extended) = kernels(Level::current(), format);
    let kernel = extended.unwrap_or(plain);
    LOGGED.call_once(|| tracing::debug!("packed weights are multiplied by the {} kernel", kernel.name));
    kernel
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_level_multiplies_bf16_where_it_has_a_kernel_for_it() {
        for level in Level::available() {
            let (plain, extended) = kernels(level, WeightFormat::Bf16);
            let has = extended.is_some() || plain.name == "amx";
            assert_eq!(level.multiplies_bf16(), has, "{}", level.name());
        }
    }
}
