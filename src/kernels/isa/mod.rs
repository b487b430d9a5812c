//! Instruction sets: which ones the machine has, and functions compiled for each.
//!
//! A *token* ([`Avx2`], [`Neon`], ...) is a value without size that detection alone makes: holding one proves that the CPU has
//! the instruction set. Every function that is compiled for an instruction set, or that uses its intrinsics, takes the token, so
//! that safe code cannot run it elsewhere. A [`Level`] is what the kernels work with, chosen once, with its token inside.
//!
//! The features of each token stand in one line of its architecture's table (`x86_64.rs`, `aarch64.rs`).

#[cfg(target_arch = "aarch64")]
mod aarch64;
#[cfg(any(test, target_arch = "x86_64"))]
mod amx;
mod level;
mod token;
#[cfg(target_arch = "x86_64")]
mod x86_64;

#[cfg(target_arch = "aarch64")]
pub(in crate::kernels) use aarch64::{Neon, NeonBf16, NeonDotProd, compiled_for};
#[cfg(test)]
pub(in crate::kernels) use amx::EmulatedUnit;
#[cfg(target_arch = "x86_64")]
pub(in crate::kernels) use amx::{Amx, AmxUnit};
#[cfg(any(test, target_arch = "x86_64"))]
pub(in crate::kernels) use amx::{TILE_SIDE, TileUnit};
#[cfg(test)]
pub(in crate::kernels) use level::forced;
pub(in crate::kernels) use level::{Level, per_level};
#[cfg(not(any(target_arch = "x86_64", target_arch = "aarch64")))]
pub(in crate::kernels) use token::compiled_for;
pub(in crate::kernels) use token::{Isa, Portable, call_compiled};
#[cfg(target_arch = "x86_64")]
pub(in crate::kernels) use x86_64::{Avx2, Avx512, Avx512Bf16, Avx512Vnni, AvxVnni, compiled_for};
