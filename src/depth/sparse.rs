//! The measurements: a depth map with values at a few pixels.

use std::path::Path;

use ndarray::ArrayView2;

use super::DepthScale;
use super::io::{npy, png16};
use super::pixels::{check_length, is_valid, median, pixel_count, rows};
use crate::error::{Error, Result};

/// Measured depth at some pixels of a frame, in metres (Z-depth), NaN where nothing was measured.
///
/// ```
/// use sdim::{DepthScale, SparseDepth};
/// // From pixels with their depth in metres; from a map, in which 0 or NaN means "not measured".
/// let points = SparseDepth::from_points(640, 480, &[(12, 30, 1.5), (600, 470, 2.25)])?;
/// let map = SparseDepth::new(4, 1, vec![0.0, 1.5, f32::NAN, 2.0])?;
/// assert_eq!((points.measured(), map.measured()), (2, 2));
/// // A sensor's integers have a unit that must be named: here 1 is a millimetre. Each row has 4 pixels, and 5 elements.
/// let raw: [u16; 5] = [0, 1500, 0, 2000, 65535];
/// let same = SparseDepth::from_u16(&raw, 4, 1, 5, DepthScale::millimetres())?;
/// assert_eq!(same.get(3, 0), map.get(3, 0));
/// # Ok::<(), sdim::Error>(())
/// ```
#[derive(Debug, Clone)]
pub struct SparseDepth {
    width: usize,
    height: usize,
    depth: Vec<f32>,
    measured: usize,
}

impl SparseDepth {
    /// Largest accepted depth, metres. A larger value is most likely a wrong unit.
    pub const MAX_DEPTH: f32 = 10_000.0;

    /// From a row-major map in metres. 0, NaN, infinite and negative values mean "not measured".
    ///
    /// A map without any measurement is accepted here; see [`SparseDepth::require_points`].
    ///
    /// # Errors
    /// [`Error::ImageSize`] for an empty size, [`Error::BufferLength`] unless `depth` holds `width * height` values,
    /// [`Error::DepthRange`] for a finite value above [`SparseDepth::MAX_DEPTH`].
    pub fn new(width: usize, height: usize, mut depth: Vec<f32>) -> Result<Self> {
        check_length("sparse depth", depth.len(), pixel_count(width, height)?)?;
        let mut measured = 0;
        for (index, value) in depth.iter_mut().enumerate() {
            if !is_valid(*value) {
                *value = f32::NAN;
                continue;
            }
            check_range(index % width, index / width, *value)?;
            measured += 1;
        }
        Ok(Self { width, height, depth, measured })
    }

    /// From a list of `(x, y, metres)`. Where two points fall on one pixel the nearer wins, because it hides the other.
    /// Points with 0, NaN, infinite or negative depth are left out.
    ///
    /// # Errors
    /// [`Error::Argument`] for a point outside the frame, otherwise as [`SparseDepth::new`].
    pub fn from_points(width: usize, height: usize, points: &[(usize, usize, f32)]) -> Result<Self> {
        let mut depth = vec![f32::NAN; pixel_count(width, height)?];
        for &(x, y, value) in points {
            if x >= width || y >= height {
                let expected = format!("x below {width} and y below {height}");
                return Err(Error::argument("point", format!("({x}, {y})"), expected));
            }
            if is_valid(value) {
                let pixel = &mut depth[y * width + x];
                *pixel = pixel.min(value);
            }
        }
        Self::new(width, height, depth)
    }

    /// From a sensor's integers, borrowed: rows of `width` values that begin every `stride` elements, with the unit that `scale` names. 0 means
    /// "not measured".
    ///
    /// # Errors
    /// [`Error::Argument`] for a stride below the width, [`Error::BufferLength`] for a buffer that ends before the last row does, otherwise as
    /// [`SparseDepth::new`].
    pub fn from_u16(
        values: &[u16],
        width: usize,
        height: usize,
        stride: usize,
        scale: DepthScale,
    ) -> Result<Self> {
        Self::from_rows(values, width, height, stride, |v| scale.metres(v))
    }

    /// From metres in a borrowed buffer: rows of `width` values that begin every `stride` elements. 0, NaN, infinite and negative values mean
    /// "not measured". Where rows follow each other without gaps, [`SparseDepth::new`] takes a vector as it is and copies nothing.
    ///
    /// # Errors
    /// As [`SparseDepth::from_u16`].
    pub fn from_f32(values: &[f32], width: usize, height: usize, stride: usize) -> Result<Self> {
        Self::from_rows(values, width, height, stride, |v| v)
    }

    fn from_rows<T: Copy>(
        values: &[T],
        width: usize,
        height: usize,
        stride: usize,
        metres: impl Fn(T) -> f32,
    ) -> Result<Self> {
        let pixels = pixel_count(width, height)?;
        let rows = rows("depth", values, width, height, stride)?;
        let mut depth = Vec::with_capacity(pixels);
        rows.for_each(|row| depth.extend(row.iter().map(|&v| metres(v))));
        Self::new(width, height, depth)
    }

    /// From a file: `.png` (16-bit grey, unit given by `scale`) or `.npy` (f32 or f64 in metres, u16 in units of `scale`).
    ///
    /// # Errors
    /// [`Error::Io`], [`Error::Format`] (also for an unknown file name extension), [`Error::Argument`] when an integer file
    /// is read without a scale, otherwise as [`SparseDepth::new`].
    pub fn read(path: impl AsRef<Path>, scale: Option<DepthScale>) -> Result<Self> {
        let (width, height, depth) = read_metres(path.as_ref(), scale)?;
        Self::new(width, height, depth)
    }

    /// Width, pixels.
    pub fn width(&self) -> usize {
        self.width
    }

    /// Height, pixels.
    pub fn height(&self) -> usize {
        self.height
    }

    /// Number of measured pixels.
    pub fn measured(&self) -> usize {
        self.measured
    }

    /// Fails unless at least one pixel is measured.
    ///
    /// # Errors
    /// [`Error::NoMeasurement`].
    pub fn require_points(&self) -> Result<()> {
        if self.measured > 0 {
            Ok(())
        } else {
            Err(Error::NoMeasurement { width: self.width, height: self.height })
        }
    }

    /// The measurement at a pixel, metres; `None` where there is none and outside the frame.
    pub fn get(&self, x: usize, y: usize) -> Option<f32> {
        if x >= self.width || y >= self.height {
            return None;
        }
        Some(self.depth[y * self.width + x]).filter(|d| !d.is_nan())
    }

    /// All pixels, row-major, metres, NaN where not measured.
    pub fn as_slice(&self) -> &[f32] {
        &self.depth
    }

    /// All pixels as (rows, columns), metres, NaN where not measured.
    pub fn view(&self) -> ArrayView2<'_, f32> {
        crate::depth::pixels::view2(&self.depth, self.width, self.height)
    }

    /// The measurements as `(x, y, metres)`, row by row.
    pub fn points(&self) -> impl Iterator<Item = (usize, usize, f32)> + '_ {
        let width = self.width;
        let all = self.depth.iter().enumerate();
        all.filter(|(_, d)| !d.is_nan()).map(move |(i, &d)| (i % width, i / width, d))
    }

    /// The largest measurement, metres; `None` without any.
    pub fn max(&self) -> Option<f32> {
        self.points().map(|(_, _, d)| d).reduce(f32::max)
    }

    /// The measurement in the middle of all by size, the larger of two, metres; `None` without any.
    pub fn median(&self) -> Option<f32> {
        median(&mut self.points().map(|(_, _, d)| d).collect::<Vec<_>>())
    }
}

fn check_range(x: usize, y: usize, value: f32) -> Result<()> {
    if value <= SparseDepth::MAX_DEPTH {
        return Ok(());
    }
    Err(Error::DepthRange { value, x, y, limit: SparseDepth::MAX_DEPTH })
}

/// A depth file as (width, height, metres); invalid values are left as they are for the caller to judge.
pub(crate) fn read_metres(path: &Path, scale: Option<DepthScale>) -> Result<(usize, usize, Vec<f32>)> {
    let extension = path.extension().and_then(|e| e.to_str()).unwrap_or("").to_ascii_lowercase();
    match extension.as_str() {
        "png" => {
            let scale = need_scale(path, scale)?;
            let (width, height, stored) = png16::read_png16(path)?;
            Ok((width, height, stored.into_iter().map(|s| scale.metres(s)).collect()))
        }
        "npy" => {
            let npy::Npy { width, height, values } = npy::read_npy(path)?;
            let depth = match values {
                npy::Values::U16(stored) => {
                    let scale = need_scale(path, scale)?;
                    stored.into_iter().map(|s| scale.metres(s)).collect()
                }
                npy::Values::F32(depth) => depth,
                npy::Values::F64(depth) => depth.into_iter().map(|d| d as f32).collect(),
            };
            Ok((width, height, depth))
        }
        _ => Err(Error::format(path, format!("file name extension {extension:?}"), "png or npy")),
    }
}

fn need_scale(path: &Path, scale: Option<DepthScale>) -> Result<DepthScale> {
    scale.ok_or_else(|| {
        let expected =
            format!("the unit of the integers in {}: mm, kitti, tum or units per metre", path.display());
        Error::argument("depth scale", "none", expected)
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn unusable_values_are_missing() {
        let raw = vec![1.0, 0.0, f32::NAN, f32::INFINITY, f32::NEG_INFINITY, -2.0];
        let sparse = SparseDepth::new(3, 2, raw).unwrap();
        assert_eq!(sparse.measured(), 1);
        assert_eq!(sparse.points().collect::<Vec<_>>(), [(0, 0, 1.0)]);
        assert!(sparse.as_slice()[1..].iter().all(|d| d.is_nan()));
        assert_eq!(sparse.get(0, 0), Some(1.0));
        assert_eq!((sparse.get(1, 0), sparse.get(3, 0), sparse.get(0, 2)), (None, None, None));
    }

    #[test]
    fn sizes_are_checked() {
        let wrong = SparseDepth::new(3, 2, vec![1.0; 5]);
        assert!(matches!(wrong, Err(Error::BufferLength { expected: 6, found: 5, .. })));
        assert!(matches!(SparseDepth::new(0, 2, vec![]), Err(Error::ImageSize { .. })));
        assert!(matches!(SparseDepth::new(usize::MAX, 2, vec![]), Err(Error::ImageSize { .. })));
        assert!(matches!(SparseDepth::from_points(usize::MAX, 1, &[]), Err(Error::ImageSize { .. })));
    }

    #[test]
    fn a_depth_in_millimetres_is_refused_with_its_pixel() {
        let mut raw = vec![f32::NAN; 12];
        raw[7] = 12_345.0;
        match SparseDepth::new(4, 3, raw) {
            Err(Error::DepthRange { value, x, y, .. }) => {
                assert_eq!((value, x, y), (12_345.0, 3, 1))
            }
            other => panic!("{other:?}"),
        }
        assert!(SparseDepth::new(1, 1, vec![SparseDepth::MAX_DEPTH]).is_ok());
    }

    #[test]
    fn the_nearer_of_two_points_wins() {
        let points = [(1, 0, 5.0), (1, 0, 2.0), (1, 0, 9.0), (0, 1, f32::NAN), (2, 1, 3.0)];
        let sparse = SparseDepth::from_points(3, 2, &points).unwrap();
        assert_eq!(sparse.points().collect::<Vec<_>>(), [(1, 0, 2.0), (2, 1, 3.0)]);
        assert_eq!(sparse.max(), Some(3.0));
        assert_eq!(sparse.view()[[1, 2]], 3.0);
        for outside in [(3, 0, 1.0), (0, 2, 1.0)] {
            assert!(matches!(SparseDepth::from_points(3, 2, &[outside]), Err(Error::Argument { .. })));
        }
    }

    #[test]
    fn rows_may_have_gaps() {
        let raw = [1000, 0, 9, 2000, 500, 9, 1, 65535];
        let scale = DepthScale::millimetres();
        let sparse = SparseDepth::from_u16(&raw, 2, 3, 3, scale).unwrap();
        let expected = [(0, 0, 1.0), (0, 1, 2.0), (1, 1, 0.5), (0, 2, 0.001), (1, 2, 65.535)];
        assert_eq!(sparse.points().collect::<Vec<_>>(), expected);
        let metres = [1.0, f32::NAN, 7.0, -2.0, 0.5];
        let sparse = SparseDepth::from_f32(&metres, 2, 2, 3).unwrap();
        assert_eq!(sparse.points().collect::<Vec<_>>(), [(0, 0, 1.0), (1, 1, 0.5)]);

        let short = SparseDepth::from_u16(&raw[..7], 2, 3, 3, scale);
        assert!(matches!(short, Err(Error::BufferLength { expected: 8, found: 7, .. })));
        let narrow = SparseDepth::from_f32(&metres, 3, 1, 2);
        assert!(matches!(narrow, Err(Error::Argument { name: "stride", .. })));
        let huge = SparseDepth::from_f32(&metres, 2, 3, usize::MAX);
        assert!(matches!(huge, Err(Error::BufferLength { .. })));
        assert!(matches!(SparseDepth::from_f32(&metres, 0, 3, 3), Err(Error::ImageSize { .. })));
        assert!(matches!(SparseDepth::from_f32(&[2e4], 1, 1, 1), Err(Error::DepthRange { .. })));
    }

    #[test]
    fn a_map_without_points_is_accepted_until_points_are_required() {
        let sparse = SparseDepth::new(2, 2, vec![0.0; 4]).unwrap();
        assert_eq!((sparse.measured(), sparse.max()), (0, None));
        assert!(matches!(sparse.require_points(), Err(Error::NoMeasurement { width: 2, height: 2 })));
    }

    #[test]
    fn files_of_every_kind_are_read() {
        let dir = tempfile::tempdir().unwrap();
        let (png, npy) = (dir.path().join("d.PNG"), dir.path().join("d.npy"));
        png16::write_png16(&png, 3, 1, &[0, 512, 256]).unwrap();
        npy::write_npy(&npy, 3, 1, &[f32::NAN, 2.0, 1.0]).unwrap();
        let from_png = SparseDepth::read(&png, Some(DepthScale::kitti())).unwrap();
        let from_npy = SparseDepth::read(&npy, None).unwrap();
        assert_eq!(from_png.points().collect::<Vec<_>>(), from_npy.points().collect::<Vec<_>>());
        assert!(matches!(SparseDepth::read(&png, None), Err(Error::Argument { name: "depth scale", .. })));
        assert!(matches!(SparseDepth::read(dir.path().join("d.exr"), None), Err(Error::Format { .. })));
        assert!(matches!(SparseDepth::read(dir.path().join("none.npy"), None), Err(Error::Io { .. })));
    }
}
