//! Whether the machine has AMX, and the system lets this process use it.

use crate::kernels::isa::token::Isa;
use crate::kernels::isa::x86_64::Avx512;

/// AMX with bf16 and bytes, beside AVX-512, in a process that may use it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(in crate::kernels) struct Amx(Avx512);

impl Isa for Amx {
    const FUSED_MADD: bool = true;
}

impl From<Amx> for Avx512 {
    fn from(amx: Amx) -> Self {
        amx.0
    }
}

impl Amx {
    /// The token, if the CPU has the unit and the system grants it.
    pub(super) fn detect() -> Option<Self> {
        let base = Avx512::detect()?;
        (in_cpu() && permitted()).then_some(Amx(base))
    }
}

/// What the processor and the system say: CPUID leaf 7 (AMX-BF16, AMX-TILE, AMX-INT8 in EDX bits 22, 24 and 25), and bits 17 and 18 of
/// XCR0 (tile configuration and data).
fn in_cpu() -> bool {
    use std::arch::x86_64::{__cpuid, __cpuid_count, _xgetbv};
    #[target_feature(enable = "xsave")]
    fn enabled() -> u64 {
        // SAFETY: the function is compiled for XSAVE, and its caller saw that the system uses it.
        unsafe { _xgetbv(0) }
    }
    const UNITS: u32 = 1 << 22 | 1 << 24 | 1 << 25;
    const OSXSAVE: u32 = 1 << 27;
    const TILES: u64 = 1 << 17 | 1 << 18;
    // SAFETY: every CPU of this architecture has the instruction. (Newer compilers know.)
    #[allow(unused_unsafe)]
    let (units, features) = unsafe {
        let units = if __cpuid(0).eax < 7 { 0 } else { __cpuid_count(7, 0).edx };
        (units, __cpuid(1).ecx)
    };
    if units & UNITS != UNITS || features & OSXSAVE == 0 {
        return false;
    }
    // SAFETY: OSXSAVE says that the instruction is there.
    unsafe { enabled() & TILES == TILES }
}

/// Asks Linux for the tiles, which it gives to a process only on demand.
#[cfg(target_os = "linux")]
fn permitted() -> bool {
    // From <asm/prctl.h> and the kernel's <asm/fpu/types.h>.
    const ARCH_REQ_XCOMP_PERM: libc::c_ulong = 0x1023;
    const XFEATURE_XTILEDATA: libc::c_ulong = 18;
    // SAFETY: this call reads and writes no memory of ours.
    unsafe { libc::syscall(libc::SYS_arch_prctl, ARCH_REQ_XCOMP_PERM, XFEATURE_XTILEDATA) == 0 }
}

/// Other systems are not known to need a permission, but neither was this tried there.
#[cfg(not(target_os = "linux"))]
fn permitted() -> bool {
    false
}
