//! What a depth file holds: numbers as they are stored, without a unit.

/// A grid of numbers: shape (height, width), row-major.
#[derive(Debug, Clone, PartialEq)]
pub struct Raster {
    /// Number of columns.
    pub width: usize,
    /// Number of rows.
    pub height: usize,
    /// `width * height` values.
    pub values: Values,
}

/// Values of a raster.
#[derive(Debug, Clone, PartialEq)]
pub enum Values {
    /// Of 16, 32 or 64 bits; the last are rounded.
    Floats(Vec<f32>),
    /// Of 8 to 64 bits; those beyond the largest `i64` become it.
    Integers(Vec<i64>),
}

impl Values {
    /// How many there are.
    #[cfg(any(feature = "tiff", feature = "exr"))]
    pub fn len(&self) -> usize {
        match self {
            Values::Floats(values) => values.len(),
            Values::Integers(values) => values.len(),
        }
    }

    /// Puts column by column into row by row.
    pub fn by_rows(self, width: usize, height: usize) -> Self {
        fn turned<T: Copy>(columns: &[T], width: usize, height: usize) -> Vec<T> {
            let row = |y: usize| columns.iter().skip(y).step_by(height).take(width).copied();
            (0..height).flat_map(row).collect()
        }
        match self {
            Values::Floats(values) => Values::Floats(turned(&values, width, height)),
            Values::Integers(values) => Values::Integers(turned(&values, width, height)),
        }
    }
}
