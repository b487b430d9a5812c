//! The level that the kernels work at, chosen once at run time.

#[cfg(target_arch = "aarch64")]
use super::aarch64::{Neon, NeonBf16};
#[cfg(target_arch = "x86_64")]
use super::amx::{self, Amx};
#[cfg(target_arch = "x86_64")]
use super::x86_64::{Avx2, Avx512, Avx512Bf16};
use std::sync::OnceLock;

/// An instruction set that all kernels are written for, with the proof that this machine has it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(in crate::kernels) enum Level {
    Portable,
    #[cfg(target_arch = "x86_64")]
    Avx2(Avx2),
    #[cfg(target_arch = "x86_64")]
    Avx512(Avx512),
    /// AMX for packed weights and attention in bf16, AVX-512 for everything else.
    #[cfg(target_arch = "x86_64")]
    Amx(Amx),
    #[cfg(target_arch = "aarch64")]
    Neon(Neon),
}

impl Level {
    /// The levels that are chosen from where none is asked for, slowest first.
    fn detected() -> Vec<Level> {
        let levels = [
            Some(Level::Portable),
            #[cfg(target_arch = "x86_64")]
            Avx2::detect().map(Level::Avx2),
            #[cfg(target_arch = "x86_64")]
            Avx512::detect().map(Level::Avx512),
            // The kernels read packed words as little-endian.
            #[cfg(target_arch = "aarch64")]
            Neon::detect().filter(|_| cfg!(target_endian = "little")).map(Level::Neon),
        ];
        levels.into_iter().flatten().collect()
    }

    /// A level that is used only where it is asked for: AMX, which has never run on hardware that has it.
    fn on_request(name: &str) -> Option<Level> {
        #[cfg(target_arch = "x86_64")]
        if name == "amx" {
            return amx::usable().map(Level::Amx);
        }
        let _ = name;
        None
    }

    /// Every level that this machine has, slowest first.
    #[cfg(test)]
    pub(in crate::kernels) fn available() -> Vec<Level> {
        Level::detected().into_iter().chain(Level::on_request("amx")).collect()
    }

    /// The level's name, as `SDIM_KERNEL` spells it.
    pub(in crate::kernels) fn name(self) -> &'static str {
        match self {
            Level::Portable => "portable",
            #[cfg(target_arch = "x86_64")]
            Level::Avx2(_) => "avx2",
            #[cfg(target_arch = "x86_64")]
            Level::Avx512(_) => "avx512",
            #[cfg(target_arch = "x86_64")]
            Level::Amx(_) => "amx",
            #[cfg(target_arch = "aarch64")]
            Level::Neon(_) => "neon",
        }
    }

    /// Whether this machine has instructions that multiply pairs of bf16 at this level.
    pub(in crate::kernels) fn multiplies_bf16(self) -> bool {
        match self {
            Level::Portable => false,
            #[cfg(target_arch = "x86_64")]
            Level::Avx2(_) => false,
            #[cfg(target_arch = "x86_64")]
            Level::Avx512(_) => Avx512Bf16::detect().is_some(),
            #[cfg(target_arch = "x86_64")]
            Level::Amx(_) => true,
            #[cfg(target_arch = "aarch64")]
            Level::Neon(_) => NeonBf16::detect().is_some(),
        }
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
    let detected = Level::detected();
    let fastest = detected.last().copied().unwrap_or(Level::Portable);
    let Some(asked) = asked else { return fastest };
    match detected.into_iter().chain(Level::on_request(asked)).find(|level| level.name() == asked) {
        Some(level) => level,
        None => {
            tracing::warn!("SDIM_KERNEL={asked} is not available here; using {}", fastest.name());
            fastest
        }
    }
}

/// Defines `fn $name(level, arguments...)` that runs `$body(isa, arguments...)` compiled for that level, `isa` being its token. For
/// the body holds what [`call_compiled!`](super::call_compiled) says.
macro_rules! per_level {
    ($(#[$meta:meta])* fn $name:ident($($arg:ident: $ty:ty),* $(,)?) $(-> $out:ty)? = $body:ident) => {
        $(#[$meta])*
        #[allow(clippy::too_many_arguments)]
        pub(in crate::kernels) fn $name(level: $crate::kernels::isa::Level, $($arg: $ty),*) $(-> $out)? {
            #[allow(unused_imports)]
            use $crate::kernels::isa::{Level, Portable, call_compiled};
            match level {
                Level::Portable => $body(Portable, $($arg),*),
                #[cfg(target_arch = "x86_64")]
                Level::Avx2(isa) => call_compiled!(Avx2, isa, $body, ($($arg: $ty),*) $(-> $out)?),
                #[cfg(target_arch = "x86_64")]
                Level::Avx512(isa) => call_compiled!(Avx512, isa, $body, ($($arg: $ty),*) $(-> $out)?),
                #[cfg(target_arch = "x86_64")]
                Level::Amx(isa) => call_compiled!(Avx512, isa.into(), $body, ($($arg: $ty),*) $(-> $out)?),
                #[cfg(target_arch = "aarch64")]
                Level::Neon(isa) => call_compiled!(Neon, isa, $body, ($($arg: $ty),*) $(-> $out)?),
            }
        }
    };
}
pub(in crate::kernels) use per_level;

#[cfg(test)]
pub(in crate::kernels) mod forced {
    use super::Level;
    use std::cell::Cell;

    thread_local!(static FORCED: Cell<Option<Level>> = const { Cell::new(None) });

    pub(super) fn get() -> Option<Level> {
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
        assert_eq!(Some(&choose(None)), Level::detected().last());
    }

    #[test]
    fn amx_is_used_only_where_it_is_asked_for() {
        assert!(Level::detected().iter().all(|level| level.name() != "amx"));
        assert_ne!(choose(None).name(), "amx");
        let asked = choose(Some("amx"));
        assert!(asked.name() == "amx" || asked == choose(None));
    }
}
