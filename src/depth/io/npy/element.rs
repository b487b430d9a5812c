//! The element types of an array.

use half::f16;

use super::super::raster::Values;

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Kind {
    F16,
    F32,
    F64,
    I8,
    I16,
    I32,
    I64,
    U8,
    U16,
    U32,
    U64,
}

/// An element type: kind and byte order.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Element {
    kind: Kind,
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
            "f2" => Kind::F16,
            "f4" => Kind::F32,
            "f8" => Kind::F64,
            "i1" => Kind::I8,
            "i2" => Kind::I16,
            "i4" => Kind::I32,
            "i8" => Kind::I64,
            "u1" => Kind::U8,
            "u2" => Kind::U16,
            "u4" => Kind::U32,
            "u8" => Kind::U64,
            _ => return None,
        };
        let element = Self { kind, big };
        // Only one byte has no order.
        (!text.starts_with('|') || element.size() == 1).then_some(element)
    }

    /// Bytes of one value.
    pub(super) fn size(self) -> usize {
        match self.kind {
            Kind::I8 | Kind::U8 => 1,
            Kind::F16 | Kind::I16 | Kind::U16 => 2,
            Kind::F32 | Kind::I32 | Kind::U32 => 4,
            Kind::F64 | Kind::I64 | Kind::U64 => 8,
        }
    }

    /// The values of a buffer of whole elements.
    pub(super) fn decode(self, data: &[u8]) -> Values {
        macro_rules! integers {
            ($of:ty) => {
                Values::Integers(self.each(data, |b| <$of>::from_le_bytes(b).try_into().unwrap_or(i64::MAX)))
            };
        }
        match self.kind {
            Kind::F16 => Values::Floats(self.each(data, |b| f16::from_le_bytes(b).to_f32())),
            Kind::F32 => Values::Floats(self.each(data, f32::from_le_bytes)),
            Kind::F64 => Values::Floats(self.each(data, |b| f64::from_le_bytes(b) as f32)),
            Kind::I8 => integers!(i8),
            Kind::I16 => integers!(i16),
            Kind::I32 => integers!(i32),
            Kind::I64 => integers!(i64),
            Kind::U8 => integers!(u8),
            Kind::U16 => integers!(u16),
            Kind::U32 => integers!(u32),
            Kind::U64 => integers!(u64),
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
