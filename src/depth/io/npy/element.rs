//! The element types of an array.

use half::f16;

use super::super::raster::Values;
use super::super::scalar::Scalar;

/// An element type: kind and byte order.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Element {
    kind: Scalar,
    big: bool,
}

impl Element {
    /// From NumPy's short form, such as `<f4`; `None` for what is not read.
    pub(super) fn parse(text: &str) -> Option<Self> {
        let big = match text.chars().next()? {
            '<' | '|' => false,
            '>' => true,
            _ => return None,
        };
        let kind = match text.get(1..)? {
            "f2" => Scalar::F16,
            "f4" => Scalar::F32,
            "f8" => Scalar::F64,
            "i1" => Scalar::I8,
            "i2" => Scalar::I16,
            "i4" => Scalar::I32,
            "i8" => Scalar::I64,
            "u1" => Scalar::U8,
            "u2" => Scalar::U16,
            "u4" => Scalar::U32,
            "u8" => Scalar::U64,
            _ => return None,
        };
        let element = Self { kind, big };
        // Only one byte has no order.
        (!text.starts_with('|') || element.size() == 1).then_some(element)
    }

    /// Bytes of one value.
    pub(super) fn size(self) -> usize {
        self.kind.size()
    }

    /// The values of a buffer of whole elements.
    pub(super) fn decode(self, data: &[u8]) -> Values {
        macro_rules! integers {
            ($of:ty) => {
                Values::Integers(self.each(data, |b| <$of>::from_le_bytes(b).try_into().unwrap_or(i64::MAX)))
            };
        }
        match self.kind {
            Scalar::F16 => Values::Floats(self.each(data, |b| f16::from_le_bytes(b).to_f32())),
            Scalar::F32 => Values::Floats(self.each(data, f32::from_le_bytes)),
            Scalar::F64 => Values::Floats(self.each(data, |b| f64::from_le_bytes(b) as f32)),
            Scalar::I8 => integers!(i8),
            Scalar::I16 => integers!(i16),
            Scalar::I32 => integers!(i32),
            Scalar::I64 => integers!(i64),
            Scalar::U8 => integers!(u8),
            Scalar::U16 => integers!(u16),
            Scalar::U32 => integers!(u32),
            Scalar::U64 => integers!(u64),
        }
    }

    /// One value of each `N` bytes, which are given in little-endian order.
    fn each<const N: usize, T>(self, data: &[u8], value: impl Fn([u8; N]) -> T) -> Vec<T> {
        let (elements, _) = data.as_chunks::<N>();
        let element = |&(mut bytes): &[u8; N]| {
            if self.big {
                bytes.reverse();
            }
            value(bytes)
        };
        elements.iter().map(element).collect()
    }
}
