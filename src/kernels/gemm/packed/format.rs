//! How the matrices of a model are held.

use crate::error::{Error, Result};
use crate::kernels::isa::Level;
use candle_core::{Device, DeviceLocation};

/// How the weights of a model are held in memory.
///
/// What rounding costs beside f32; commands and more figures stand in `benches/RESULTS.md`, "Accuracy of the formats":
///
/// | | f32 | bf16 | int8 |
/// |---|---|---|---|
/// | `sdim-tiny`, 12 real frames, 500 points, MAE | 0.2958 m | +0.0004 m | -0.0002 m |
/// | `sdim-tiny`, 100 procedural scenes, 500 points, MAE | 0.3630 m | -0.0001 m | +0.0004 m |
/// | final states of seven small random models, root mean square of the difference | | 1.5 to 7.4 % | 4.7 to 20 % |
/// | 20 best first logits of the full 3B shapes, random weights | | 20 the same, within 0.9 % | 18 the same, within 7.5 % |
///
/// ```sh
/// cargo run --release --example evaluate -- --layout folder --data FRAMES --points 500 --weights int8
/// cargo test --release --test golden formats -- --nocapture
/// ```
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum WeightFormat {
    /// 32-bit floats, as plain tensors; the one format that can be trained.
    F32,
    /// 16-bit floats with the exponent range of f32 (8 bits of precision), as checkpoints are published.
    Bf16,
    /// Signed bytes with one scale per output channel, for every matrix, embedding and output head included. Rows of activations are rounded
    /// to bytes too, each by its largest value.
    ///
    /// A channel far above the others therefore costs those their precision: in a row of 2048, what the others add up to is off by 0.6 %
    /// without one, by 4.3 % beside one of 10 times their range, by 37 % beside one of 100 times (bf16: 0.2, 0.2 and 0.6 %). Trained language
    /// models have such channels and random ones do not: measure a checkpoint in this format before relying on it.
    ///
    /// On the CPU alone: a model that is loaded in this format on another device is an error.
    Int8,
}

impl WeightFormat {
    /// What this machine multiplies best without losing what a published checkpoint holds: bf16 on a CPU with
    /// instructions for it (AVX512-BF16) and on a CUDA device of compute capability 8 or more, f32 elsewhere. On 64-bit Arm it
    /// is f32 even with FEAT_BF16, whose speed was not measured.
    pub fn native(device: &Device) -> Self {
        let bf16 = match device {
            #[cfg(feature = "cuda")]
            Device::Cuda(device) => crate::kernels::cuda::multiplies_bf16(device),
            device => device.is_cpu() && cfg!(target_arch = "x86_64") && Level::current().multiplies_bf16(),
        };
        if bf16 { Self::Bf16 } else { Self::F32 }
    }

    /// Whether matrices that lie there can be held in this form.
    ///
    /// # Errors
    /// [`Error::Argument`] if not: nothing else is held in its place.
    pub(crate) fn check(self, location: DeviceLocation) -> Result<()> {
        match (self, location) {
            (Self::F32 | Self::Bf16, _) | (Self::Int8, DeviceLocation::Cpu) => Ok(()),
            (Self::Int8, DeviceLocation::Cuda { .. } | DeviceLocation::Metal { .. }) => {
                let expected = "f32 or bf16 there; bytes are multiplied on the CPU alone";
                Err(Error::argument("weight format", format!("int8 on {location:?}"), expected))
            }
        }
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
    use crate::kernels::isa::forced;

    #[test]
    fn each_format_is_spelled_as_it_is_read() {
        for format in [WeightFormat::F32, WeightFormat::Bf16, WeightFormat::Int8] {
            assert_eq!(format.to_string().parse::<WeightFormat>().unwrap(), format);
        }
        assert!("f64".parse::<WeightFormat>().is_err());
    }

    #[test]
    fn bytes_are_for_the_cpu_alone() {
        use WeightFormat::{Bf16, F32, Int8};
        for location in [DeviceLocation::Cuda { gpu_id: 1 }, DeviceLocation::Metal { gpu_id: 0 }] {
            for format in [F32, Bf16] {
                assert!(format.check(location).is_ok(), "{format} on {location:?}");
            }
            let error = Int8.check(location).unwrap_err();
            assert!(matches!(error, Error::Argument { name: "weight format", .. }), "{error}");
        }
        assert!([F32, Bf16, Int8].iter().all(|format| format.check(DeviceLocation::Cpu).is_ok()));
    }

    #[test]
    fn a_machine_without_bf16_products_keeps_f32() {
        for level in Level::available() {
            let forced = forced::with(level, || WeightFormat::native(&Device::Cpu));
            let bf16 = cfg!(target_arch = "x86_64") && level.multiplies_bf16();
            let expected = if bf16 { WeightFormat::Bf16 } else { WeightFormat::F32 };
            assert_eq!(forced, expected, "{}", level.name());
        }
        assert!(!Level::Portable.multiplies_bf16());
    }
}
