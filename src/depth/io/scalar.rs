//! Numbers as files store them: arrays of NumPy, clouds in PLY and PCD.

use half::f16;

/// Type of a stored number.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Scalar {
    I8,
    U8,
    I16,
    U16,
    I32,
    U32,
    I64,
    U64,
    F16,
    F32,
    F64,
}

impl Scalar {
    /// Bytes of one.
    pub fn size(self) -> usize {
        match self {
            Scalar::I8 | Scalar::U8 => 1,
            Scalar::I16 | Scalar::U16 | Scalar::F16 => 2,
            Scalar::I32 | Scalar::U32 | Scalar::F32 => 4,
            Scalar::I64 | Scalar::U64 | Scalar::F64 => 8,
        }
    }

    /// The number in the first bytes; `None` if there are too few. 64-bit integers are rounded.
    pub fn read(self, bytes: &[u8], big: bool) -> Option<f64> {
        fn first<const N: usize>(bytes: &[u8], big: bool) -> Option<[u8; N]> {
            let mut first: [u8; N] = *bytes.first_chunk()?;
            if big {
                first.reverse();
            }
            Some(first)
        }
        Some(match self {
            Scalar::I8 => i8::from_le_bytes(first(bytes, big)?).into(),
            Scalar::U8 => u8::from_le_bytes(first(bytes, big)?).into(),
            Scalar::I16 => i16::from_le_bytes(first(bytes, big)?).into(),
            Scalar::U16 => u16::from_le_bytes(first(bytes, big)?).into(),
            Scalar::I32 => i32::from_le_bytes(first(bytes, big)?).into(),
            Scalar::U32 => u32::from_le_bytes(first(bytes, big)?).into(),
            Scalar::I64 => i64::from_le_bytes(first(bytes, big)?) as f64,
            Scalar::U64 => u64::from_le_bytes(first(bytes, big)?) as f64,
            Scalar::F16 => f16::from_le_bytes(first(bytes, big)?).into(),
            Scalar::F32 => f32::from_le_bytes(first(bytes, big)?).into(),
            Scalar::F64 => f64::from_le_bytes(first(bytes, big)?),
        })
    }
}
