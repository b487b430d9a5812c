//! Intel AMX: a unit that multiplies tiles of 16 rows by 64 bytes.
//!
//! It has never run on hardware with AMX. It is used only where `SDIM_KERNEL=amx` asks for it, and only if its products are those of
//! the emulation, which the tests run everything above it with.

#[cfg(target_arch = "x86_64")]
mod hardware;
#[cfg(target_arch = "x86_64")]
mod token;
mod unit;

#[cfg(target_arch = "x86_64")]
pub(in crate::kernels) use hardware::{AmxUnit, usable};
#[cfg(target_arch = "x86_64")]
pub(in crate::kernels) use token::Amx;
#[cfg(test)]
pub(in crate::kernels) use unit::EmulatedUnit;
pub(in crate::kernels) use unit::{TILE_SIDE, TileUnit};
