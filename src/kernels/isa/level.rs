//! Which instruction set the kernels use, found once at run time.

use std::sync::OnceLock;

/// An instruction set that this machine is known to have: values come only from this module's
/// checks, so that holding one is the proof that the matching kernel may be called.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(in crate::kernels) struct Level(Isa);

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Isa {
    Portable,
    #[cfg(target_arch = "x86_64")]
    Avx2,
    #[cfg(target_arch = "x86_64")]
    Avx512,
    /// AVX-512, and AMX for packed weights.
    #[cfg(target_arch = "x86_64")]
    Amx,
    #[cfg(target_arch = "aarch64")]
    Neon,
}

impl Level {
    /// Every level that this machine has, slowest first.
    pub(in crate::kernels) fn available() -> Vec<Level> {
        #[allow(unused_mut)]
        let mut levels = vec![Level(Isa::Portable)];
        #[cfg(target_arch = "x86_64")]
        {
            let avx2 = is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma");
            if avx2 {
                levels.push(Level(Isa::Avx2));
            }
            if avx2
                && is_x86_feature_detected!("avx512f")
                && is_x86_feature_detected!("avx512vl")
                && is_x86_feature_detected!("avx512dq")
                && is_x86_feature_detected!("avx512bw")
            {
                levels.push(Level(Isa::Avx512));
                if crate::kernels::gemm::packed::amx_usable() {
                    levels.push(Level(Isa::Amx));
                }
            }
        }
        // The packed words are read as little-endian.
        #[cfg(target_arch = "aarch64")]
        if cfg!(target_endian = "little") && std::arch::is_aarch64_feature_detected!("neon") {
            levels.push(Level(Isa::Neon));
        }
        levels
    }

    /// The level's name, as `SDIM_KERNEL` spells it.
    pub(in crate::kernels) fn name(self) -> &'static str {
        match self.0 {
            Isa::Portable => "portable",
            #[cfg(target_arch = "x86_64")]
            Isa::Avx2 => "avx2",
            #[cfg(target_arch = "x86_64")]
            Isa::Avx512 => "avx512",
            #[cfg(target_arch = "x86_64")]
            Isa::Amx => "amx",
            #[cfg(target_arch = "aarch64")]
            Isa::Neon => "neon",
        }
    }

    /// AVX-512 at least.
    #[cfg(target_arch = "x86_64")]
    pub(in crate::kernels) fn is_avx512(self) -> bool {
        matches!(self.0, Isa::Avx512 | Isa::Amx)
    }

    #[cfg(target_arch = "x86_64")]
    pub(in crate::kernels) fn is_amx(self) -> bool {
        self.0 == Isa::Amx
    }

    #[cfg(target_arch = "x86_64")]
    pub(in crate::kernels) fn is_avx2(self) -> bool {
        self.0 == Isa::Avx2
    }

    #[cfg(target_arch = "aarch64")]
    pub(in crate::kernels) fn is_neon(self) -> bool {
        self.0 == Isa::Neon
    }

    /// The level in use. A `SDIM_KERNEL` that the machine lacks, or that is no level's name, is
    /// ignored with a warning: the fastest is used.
    pub(in crate::kernels) fn current() -> Level {
        #[cfg(test)]
        if let Some(level) = forced::get() {
            return level;
        }
        static LEVEL: OnceLock<Level> = OnceLock::new();
        *LEVEL.get_or_init(|| choose(std::env::var("SDIM_KERNEL").ok().as_deref()))
    }
}

fn choose(asked: Option<&str>) -> Level {
    let available = Level::available();
    let fastest = available.last().copied().unwrap_or(Level(Isa::Portable));
    let Some(asked) = asked else { return fastest };
    match available.iter().find(|level| level.name() == asked) {
        Some(level) => *level,
        None => {
            tracing::warn!("SDIM_KERNEL={asked} is not available here; using {}", fastest.name());
            fastest
        }
    }
}

/// Defines `fn $name(level, args..)` that runs `$body::<LANES>(args..)` compiled for that level, with
/// `LANES` f32 to a register: 4, 8 or 16, or 1 where that is left to the compiler. The body must be `#[inline(always)]` and contain no closure that another thread runs.
macro_rules! per_level {
    ($(#[$meta:meta])* fn $name:ident $(<$(const $c:ident : usize),+>)? ($($arg:ident : $ty:ty),* $(,)?) $(-> $out:ty)? = $body:ident) => {
        $(#[$meta])*
        #[allow(clippy::too_many_arguments)]
        pub(in crate::kernels) fn $name $(<$(const $c: usize),+>)? (level: $crate::kernels::isa::level::Level, $($arg: $ty),*) $(-> $out)? {
            #[cfg(target_arch = "x86_64")]
            {
                #[target_feature(enable = "avx512f,avx512vl,avx512dq,avx512bw,avx2,fma")]
                #[allow(clippy::too_many_arguments)]
                fn avx512 $(<$(const $c: usize),+>)? ($($arg: $ty),*) $(-> $out)? {
                    $body::<16 $($(, $c)+)?>($($arg),*)
                }
                #[target_feature(enable = "avx2,fma")]
                #[allow(clippy::too_many_arguments)]
                fn avx2 $(<$(const $c: usize),+>)? ($($arg: $ty),*) $(-> $out)? {
                    $body::<8 $($(, $c)+)?>($($arg),*)
                }
                if level.is_avx512() {
                    // SAFETY: a `Level` says AVX-512 only where the CPU reported these features.
                    return unsafe { avx512 $(::<$($c),+>)? ($($arg),*) };
                }
                if level.is_avx2() {
                    // SAFETY: a `Level` says AVX2 only where the CPU reported AVX2 and FMA.
                    return unsafe { avx2 $(::<$($c),+>)? ($($arg),*) };
                }
            }
            // NEON is part of what this architecture's code is compiled for.
            #[cfg(target_arch = "aarch64")]
            if level.is_neon() {
                return $body::<4 $($(, $c)+)?>($($arg),*);
            }
            let _ = level;
            $body::<1 $($(, $c)+)?>($($arg),*)
        }
    };
}
pub(in crate::kernels) use per_level;

#[cfg(test)]
pub(in crate::kernels) mod forced {
    use super::Level;
    use std::cell::Cell;

    thread_local!(static FORCED: Cell<Option<Level>> = const { Cell::new(None) });

    pub(in crate::kernels) fn get() -> Option<Level> {
        FORCED.get()
    }

    /// Runs `f` with the operations that this thread calls at `level`.
    pub(in crate::kernels) fn with<R>(level: Level, f: impl FnOnce() -> R) -> R {
        FORCED.set(Some(level));
        let result = f();
        FORCED.set(None);
        result
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn portable_is_always_there_and_can_be_forced() {
        assert_eq!(choose(Some("portable")).name(), "portable");
        assert_eq!(Level::available()[0].name(), "portable");
    }

    /// So that no run of the tests which asks for a level is one of another.
    #[test]
    fn the_level_that_is_asked_for_is_used() {
        match std::env::var("SDIM_KERNEL") {
            Ok(asked) => assert_eq!(Level::current().name(), asked, "SDIM_KERNEL asks for what is not here"),
            Err(_) => assert_eq!(Level::current(), choose(None)),
        }
    }

    #[test]
    fn an_unknown_level_gives_the_fastest() {
        assert_eq!(choose(Some("quantum")), choose(None));
        assert_eq!(Some(&choose(None)), Level::available().last());
    }
}
