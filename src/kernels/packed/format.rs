//! How the matrices of a model are held.

use super::super::level::Level;
use super::isa;
use crate::error::{Error, Result};
use candle_core::Device;

/// How the weights of a model are held in memory.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum WeightFormat {
    /// 32-bit floats, as plain tensors; the one format that can be trained.
    F32,
    /// 16-bit floats with the exponent range of f32 (8 bits of precision), as checkpoints are published.
    Bf16,
    /// Signed bytes with one scale per output channel.
    Int8,
}

impl WeightFormat {
    /// What this machine multiplies best without losing what a published checkpoint holds: bf16 on a CPU with
    /// instructions for it (AVX512-BF16, AMX), f32 elsewhere.
    pub fn native(device: &Device) -> Self {
        if device.is_cpu() && isa::multiplies_bf16(Level::current()) { Self::Bf16 } else { Self::F32 }
    }
}

impl std::fmt::Display for WeightFormat {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Self::F32 => "f32",
            Self::Bf16 => "bf16",
            Self::Int8 => "int8",
        })
    }
}

impl std::str::FromStr for WeightFormat {
    type Err = Error;

    /// `f32`, `bf16` or `int8`.
    fn from_str(text: &str) -> Result<Self> {
        match text {
            "f32" => Ok(Self::F32),
            "bf16" => Ok(Self::Bf16),
            "int8" => Ok(Self::Int8),
            other => Err(Error::argument("weight format", other, "f32, bf16 or int8")),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_format_is_spelled_as_it_is_read() {
        for format in [WeightFormat::F32, WeightFormat::Bf16, WeightFormat::Int8] {
            assert_eq!(format.to_string().parse::<WeightFormat>().unwrap(), format);
        }
        assert!("f64".parse::<WeightFormat>().is_err());
    }

    #[test]
    fn a_machine_without_bf16_products_keeps_f32() {
        for level in Level::available() {
            let forced =
                super::super::super::level::forced::with(level, || WeightFormat::native(&Device::Cpu));
            let expected = if isa::multiplies_bf16(level) { WeightFormat::Bf16 } else { WeightFormat::F32 };
            assert_eq!(forced, expected, "{}", level.name());
        }
        let portable = Level::available()[0];
        assert!(!isa::multiplies_bf16(portable));
    }
}
