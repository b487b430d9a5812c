//! The AMX unit itself: one instruction to a function, and whether the machine has it.

use super::amx::Unit;
use super::isa::Kernel;
use super::{PackedWeight, Rows, WeightFormat};
use crate::error::Result;
use std::arch::asm;
use std::sync::OnceLock;

/// The tiles of the thread that holds this.
pub(in crate::kernels) struct Tiles(());

/// What `ldtilecfg` reads: palette 1, and for each of eight tiles its rows and the bytes of a row.
#[repr(C, align(64))]
struct Config {
    palette: u8,
    start_row: u8,
    reserved: [u8; 14],
    row_bytes: [u16; 16],
    rows: [u8; 16],
}

static FULL: Config = {
    let (mut row_bytes, mut rows) = ([0; 16], [0; 16]);
    let mut tile = 0;
    while tile < 8 {
        (row_bytes[tile], rows[tile]) = (64, 16);
        tile += 1;
    }
    Config { palette: 1, start_row: 0, reserved: [0; 14], row_bytes, rows }
};

// The compiler has no use for tile registers in code that is not compiled for AMX, as this is not: what one
// block leaves in them the next finds.
impl Unit for Tiles {
    #[inline(always)]
    unsafe fn start() -> Self {
        // SAFETY: the caller has the unit; `FULL` is a valid configuration.
        unsafe { asm!("ldtilecfg [{}]", in(reg) &raw const FULL, options(nostack, preserves_flags)) };
        Tiles(())
    }
    #[inline(always)]
    unsafe fn load<const T: usize>(&mut self, from: *const u32, stride: usize) {
        // SAFETY: the caller's promise.
        unsafe {
            asm!("tileloadd tmm{}, [{} + {}*1]", const T, in(reg) from, in(reg) stride, options(nostack, preserves_flags));
        }
    }
    #[inline(always)]
    unsafe fn store<const T: usize>(&mut self, to: *mut u32, stride: usize) {
        // SAFETY: the caller's promise.
        unsafe {
            asm!("tilestored [{} + {}*1], tmm{}", in(reg) to, in(reg) stride, const T, options(nostack, preserves_flags));
        }
    }
    #[inline(always)]
    unsafe fn add_bf16<const SUM: usize, const A: usize, const B: usize>(&mut self) {
        // SAFETY: the caller has the unit.
        unsafe {
            asm!("tdpbf16ps tmm{}, tmm{}, tmm{}", const SUM, const A, const B, options(nostack, preserves_flags));
        }
    }
    #[inline(always)]
    unsafe fn add_int8<const SUM: usize, const A: usize, const B: usize>(&mut self) {
        // SAFETY: the caller has the unit.
        unsafe {
            asm!("tdpbusd tmm{}, tmm{}, tmm{}", const SUM, const A, const B, options(nostack, preserves_flags));
        }
    }
}

impl Drop for Tiles {
    fn drop(&mut self) {
        // SAFETY: a `Tiles` exists only where the unit was started. Tiles left in use would make each change of
        // threads save them.
        unsafe { asm!("tilerelease", options(nostack, preserves_flags)) };
    }
}

/// Multiplies tiles that stay where they are, in turn, so that no product waits for another; gives the number of operations.
///
/// # Safety
/// The machine must have the unit.
pub(in crate::kernels) unsafe fn busy(format: WeightFormat, steps: usize) -> usize {
    // SAFETY: the caller has the unit.
    unsafe {
        let mut tiles = Tiles::start();
        for _ in 0..steps {
            if format == WeightFormat::Int8 {
                tiles.add_int8::<0, 4, 6>();
                tiles.add_int8::<1, 4, 7>();
                tiles.add_int8::<2, 5, 6>();
                tiles.add_int8::<3, 5, 7>();
            } else {
                tiles.add_bf16::<0, 4, 6>();
                tiles.add_bf16::<1, 4, 7>();
                tiles.add_bf16::<2, 5, 6>();
                tiles.add_bf16::<3, 5, 7>();
            }
        }
    }
    let per_word = if format == WeightFormat::Int8 { 4 } else { 2 };
    steps * 4 * 2 * 16 * 16 * 16 * per_word
}

/// Whether AMX is there, the system lets this process use it, and it computes what the plain kernels do.
pub(in crate::kernels) fn usable() -> bool {
    static USABLE: OnceLock<bool> = OnceLock::new();
    *USABLE.get_or_init(|| {
        if !detected() || !permitted() {
            return false;
        }
        let right = apart(agrees).unwrap_or(false);
        if !right {
            tracing::warn!("the AMX kernels fail their check on this machine and are not used");
        }
        right
    })
}

/// What the processor and the system say: CPUID leaf 7 (AMX-BF16, AMX-TILE, AMX-INT8 in EDX bits 22, 24 and 25), and bits 17 and 18 of
/// XCR0 (tile configuration and data).
fn detected() -> bool {
    use std::arch::x86_64::{__cpuid, __cpuid_count, _xgetbv};
    #[target_feature(enable = "xsave")]
    fn enabled() -> u64 {
        // SAFETY: the feature is enabled here, and the caller checked that the system uses it.
        unsafe { _xgetbv(0) }
    }
    const UNITS: u32 = 1 << 22 | 1 << 24 | 1 << 25;
    const OSXSAVE: u32 = 1 << 27;
    const TILES: u64 = 1 << 17 | 1 << 18;
    if __cpuid(0).eax < 7 || __cpuid_count(7, 0).edx & UNITS != UNITS || __cpuid(1).ecx & OSXSAVE == 0 {
        return false;
    }
    // SAFETY: OSXSAVE says that the instruction is there.
    unsafe { enabled() & TILES == TILES }
}

/// Asks Linux for the tiles, which it gives to a process only on demand: `arch_prctl(ARCH_REQ_XCOMP_PERM, XFEATURE_XTILEDATA)`.
#[cfg(target_os = "linux")]
fn permitted() -> bool {
    const ARCH_PRCTL: i64 = 158;
    const ARCH_REQ_XCOMP_PERM: u64 = 0x1023;
    const XFEATURE_XTILEDATA: u64 = 18;
    let result: i64;
    // SAFETY: this call reads and writes no memory of ours; the system call changes rax, rcx and r11 only.
    unsafe {
        asm!("syscall", inlateout("rax") ARCH_PRCTL => result, in("rdi") ARCH_REQ_XCOMP_PERM, in("rsi") XFEATURE_XTILEDATA,
            lateout("rcx") _, lateout("r11") _, options(nostack));
    }
    result == 0
}

/// Other systems are not known to need a permission, but neither was this tried there.
#[cfg(not(target_os = "linux"))]
fn permitted() -> bool {
    false
}

/// Runs `f` on a thread and a pool of its own: a worker of the common pool would, while it waits, take up tasks that wait for
/// this very answer. None where it failed.
fn apart(f: impl FnOnce() -> Result<bool> + Send) -> Option<bool> {
    let pool = || rayon::ThreadPoolBuilder::new().num_threads(1).build().ok();
    std::thread::scope(|scope| {
        let thread = std::thread::Builder::new().spawn_scoped(scope, || pool()?.install(f).ok()).ok()?;
        thread.join().ok()?
    })
}

/// Multiplies small matrices with every edge by these kernels and by the portable ones.
fn agrees() -> Result<bool> {
    let (n, k, m) = (53, 150, 70);
    let wave = |count: usize, by: f32| -> Vec<f32> { (0..count).map(|i| (i as f32 * by).sin()).collect() };
    let (x, w) = (wave(n * k, 0.37), wave(m * k, 0.23));
    for format in [WeightFormat::Bf16, WeightFormat::Int8] {
        let weight = PackedWeight::new(format, &[Rows::f32(&w, m, k)?])?;
        let by = |kernel: Kernel| weight.product(kernel, &x, n, &[m], weight.finish(None)).concat();
        let (found, expected) = (by(Kernel::amx(format)), by(Kernel::portable(format)));
        if found.iter().zip(&expected).any(|(f, e)| (f - e).abs() > 1e-3) {
            return Ok(false);
        }
    }
    Ok(true)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_configuration_is_as_the_instruction_reads_it() {
        assert_eq!((size_of::<Config>(), align_of::<Config>()), (64, 64));
        assert_eq!(std::mem::offset_of!(Config, row_bytes), 16);
        assert_eq!(std::mem::offset_of!(Config, rows), 48);
        assert_eq!((FULL.row_bytes[7], FULL.rows[7], FULL.row_bytes[8], FULL.rows[8]), (64, 16, 0, 0));
    }

    #[test]
    fn a_check_runs_apart_and_may_fail() {
        assert_eq!(apart(|| Ok(rayon::current_num_threads() == 1)), Some(true));
        assert_eq!(apart(|| Err(crate::error::Error::argument("a", 1, "2"))), None);
    }

    #[test]
    fn a_machine_without_the_unit_says_so() {
        if !detected() {
            assert!(!usable());
        }
    }
}
