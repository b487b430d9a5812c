//! The result: a dense depth map with a confidence per pixel.

use std::path::Path;

use ndarray::ArrayView2;

use super::io::{npy, png16};
use super::pixels::{check_length, is_valid, pixel_count, view2};
use super::{DepthScale, SparseDepth};
use crate::error::{Error, Result};

/// Dense depth in metres (Z-depth) with a confidence, an expected error and a "measured" mark per pixel, all row-major.
///
/// An invalid pixel has NaN depth, confidence 0, NaN expected error and is not measured.
#[derive(Debug, Clone)]
pub struct DepthMap {
    width: usize,
    height: usize,
    depth: Vec<f32>,
    confidence: Vec<f32>,
    expected_error: Vec<f32>,
    measured: Vec<bool>,
}

/// What a [`DepthMap`] is made of, row-major, `width * height` values each, to be taken without a copy.
#[derive(Debug, Clone)]
pub struct DepthParts {
    /// Width, pixels.
    pub width: usize,
    /// Height, pixels.
    pub height: usize,
    /// Depth, metres, NaN where invalid.
    pub depth: Vec<f32>,
    /// Confidence in 0..=1, 0 where invalid.
    pub confidence: Vec<f32>,
    /// Expected absolute error, metres, NaN where invalid.
    pub expected_error: Vec<f32>,
    /// True where the depth is a measurement, kept bit for bit.
    pub measured: Vec<bool>,
}

/// What could not be stored exactly in an integer file.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[must_use = "a saturated pixel holds a wrong depth in the file"]
pub struct Saturation {
    /// Number of pixels whose depth was too large for the file and was stored as its largest value, 65535.
    pub pixels: usize,
}

impl DepthMap {
    /// From its parts, each with `width * height` values.
    ///
    /// `depth` in metres (0, NaN, infinite and negative values are invalid pixels), `confidence` in 0..=1 (higher is surer),
    /// `expected_error` in metres (mean absolute error, at least 0), `measured` true where the depth is a measurement kept
    /// bit for bit. What the other parts hold at invalid pixels is ignored.
    ///
    /// # Errors
    /// [`Error::ImageSize`] for an empty size, [`Error::BufferLength`] for a part of a wrong length, [`Error::Argument`] for
    /// a confidence or expected error out of range and for a measured pixel without depth.
    pub fn new(
        width: usize,
        height: usize,
        depth: Vec<f32>,
        confidence: Vec<f32>,
        expected_error: Vec<f32>,
        measured: Vec<bool>,
    ) -> Result<Self> {
        let pixels = pixel_count(width, height)?;
        check_length("depth", depth.len(), pixels)?;
        check_length("confidence", confidence.len(), pixels)?;
        check_length("expected error", expected_error.len(), pixels)?;
        check_length("measured mask", measured.len(), pixels)?;
        let mut map = Self { width, height, depth, confidence, expected_error, measured };
        for pixel in 0..pixels {
            map.check_pixel(pixel)?;
        }
        Ok(map)
    }

    /// Brings an invalid pixel into its one form, and refuses a valid one with values out of range.
    fn check_pixel(&mut self, pixel: usize) -> Result<()> {
        let place = |value: f32| format!("{value} at pixel ({}, {})", pixel % self.width, pixel / self.width);
        let (confidence, error) = (self.confidence[pixel], self.expected_error[pixel]);
        if !is_valid(self.depth[pixel]) {
            if self.measured[pixel] {
                return Err(Error::argument(
                    "measured depth",
                    place(self.depth[pixel]),
                    "a finite depth above 0 m",
                ));
            }
            self.depth[pixel] = f32::NAN;
            self.confidence[pixel] = 0.0;
            self.expected_error[pixel] = f32::NAN;
        } else if !(0.0..=1.0).contains(&confidence) {
            return Err(Error::argument("confidence", place(confidence), "a value in 0..=1"));
        } else if !(error.is_finite() && error >= 0.0) {
            return Err(Error::argument("expected error", place(error), "a finite value of at least 0 m"));
        }
        Ok(())
    }

    /// Width, pixels.
    pub fn width(&self) -> usize {
        self.width
    }

    /// Height, pixels.
    pub fn height(&self) -> usize {
        self.height
    }

    /// Depth, metres, NaN where invalid.
    pub fn depth(&self) -> &[f32] {
        &self.depth
    }

    /// Confidence in 0..=1, higher is surer; 0 where the depth is invalid.
    pub fn confidence(&self) -> &[f32] {
        &self.confidence
    }

    /// Expected absolute error, metres; NaN where the depth is invalid.
    pub fn expected_error(&self) -> &[f32] {
        &self.expected_error
    }

    /// True where the depth is a measurement, kept bit for bit.
    pub fn measured(&self) -> &[bool] {
        &self.measured
    }

    /// Takes the map apart, without a copy.
    pub fn into_parts(self) -> DepthParts {
        let Self { width, height, depth, confidence, expected_error, measured } = self;
        DepthParts { width, height, depth, confidence, expected_error, measured }
    }

    /// Depth as (rows, columns), metres, NaN where invalid.
    pub fn depth_view(&self) -> ArrayView2<'_, f32> {
        view2(&self.depth, self.width, self.height)
    }

    /// Confidence as (rows, columns), 0..=1.
    pub fn confidence_view(&self) -> ArrayView2<'_, f32> {
        view2(&self.confidence, self.width, self.height)
    }

    /// Expected absolute error as (rows, columns), metres, NaN where invalid.
    pub fn expected_error_view(&self) -> ArrayView2<'_, f32> {
        view2(&self.expected_error, self.width, self.height)
    }

    /// The measured mask as (rows, columns).
    pub fn measured_view(&self) -> ArrayView2<'_, bool> {
        view2(&self.measured, self.width, self.height)
    }

    /// Depth at a pixel, metres; `None` where invalid and outside the frame.
    pub fn get(&self, x: usize, y: usize) -> Option<f32> {
        if x >= self.width || y >= self.height {
            return None;
        }
        Some(self.depth[y * self.width + x]).filter(|d| !d.is_nan())
    }

    /// Number of pixels with a valid depth.
    pub fn valid(&self) -> usize {
        self.depth.iter().filter(|d| !d.is_nan()).count()
    }

    /// Whether every measurement of `sparse` stands in this map bit for bit and is marked as measured, and nothing else is.
    pub fn keeps(&self, sparse: &SparseDepth) -> bool {
        (self.width, self.height) == (sparse.width(), sparse.height())
            && (sparse.as_slice().iter().zip(&self.depth).zip(&self.measured)).all(
                |((given, kept), &measured)| {
                    measured != given.is_nan() && (given.is_nan() || given.to_bits() == kept.to_bits())
                },
            )
    }

    /// The map as a 16-bit grey PNG in memory, with depth in units of `scale`, 0 where invalid.
    ///
    /// # Errors
    /// [`Error::Format`] if the encoder fails.
    pub fn to_png16(&self, scale: DepthScale) -> Result<(Vec<u8>, Saturation)> {
        let (stored, saturation) = self.stored(scale);
        Ok((png16::encode(self.width, self.height, &stored)?, saturation))
    }

    /// The depth in units of `scale`, 0 where invalid.
    pub(crate) fn stored(&self, scale: DepthScale) -> (Vec<u16>, Saturation) {
        let mut pixels = 0;
        let store = |&depth: &f32| {
            let (stored, saturated) = scale.stored(depth);
            pixels += usize::from(saturated);
            stored
        };
        (self.depth.iter().map(store).collect(), Saturation { pixels })
    }

    /// Writes [`DepthMap::to_png16`] to a file; reports how many pixels were too far for it.
    ///
    /// # Errors
    /// [`Error::Format`] if the encoder fails, [`Error::Io`]; the file is then as it was before.
    pub fn write_png16(&self, path: impl AsRef<Path>, scale: DepthScale) -> Result<Saturation> {
        let (bytes, saturation) = self.to_png16(scale)?;
        crate::files::write_whole(path.as_ref(), &bytes)?;
        Ok(saturation)
    }

    /// Writes the depth as `.npy`: f32, shape (height, width), metres, NaN where invalid.
    ///
    /// # Errors
    /// [`Error::Io`]; the file is then as it was before.
    pub fn write_npy(&self, path: impl AsRef<Path>) -> Result<()> {
        npy::write_npy(path, self.width, self.height, &self.depth)
    }

    /// Writes the confidence as `.npy`: f32, shape (height, width), 0..=1.
    ///
    /// # Errors
    /// [`Error::Io`]; the file is then as it was before.
    pub fn write_confidence_npy(&self, path: impl AsRef<Path>) -> Result<()> {
        npy::write_npy(path, self.width, self.height, &self.confidence)
    }
}

#[cfg(test)]
mod tests {
    use super::super::io::Values;
    use super::*;

    fn map(depth: [f32; 4], measured: [bool; 4]) -> Result<DepthMap> {
        DepthMap::new(2, 2, depth.to_vec(), vec![0.5; 4], vec![0.1; 4], measured.to_vec())
    }

    #[test]
    fn invalid_pixels_take_one_form() {
        let map = map([1.0, 0.0, -1.0, f32::INFINITY], [true, false, false, false]).unwrap();
        assert_eq!(map.valid(), 1);
        assert_eq!(map.confidence(), [0.5, 0.0, 0.0, 0.0]);
        assert!(map.depth()[1..].iter().chain(&map.expected_error()[1..]).all(|v| v.is_nan()));
        assert_eq!((map.get(0, 0), map.get(1, 0), map.get(2, 0)), (Some(1.0), None, None));
        assert_eq!(map.depth_view().dim(), (2, 2));
        assert_eq!(map.confidence_view()[[0, 0]], 0.5);
        assert!(map.measured_view()[[0, 0]] && !map.measured_view()[[1, 1]]);
    }

    #[test]
    fn parts_are_checked() {
        let good = || (vec![1.0; 4], vec![0.5; 4], vec![0.1; 4], vec![false; 4]);
        let build = |(d, c, e, m)| DepthMap::new(2, 2, d, c, e, m);
        assert!(build(good()).is_ok());
        assert!(matches!(
            build((vec![1.0; 3], good().1, good().2, good().3)),
            Err(Error::BufferLength { what: "depth", .. })
        ));
        assert!(matches!(
            build((good().0, vec![0.5; 5], good().2, good().3)),
            Err(Error::BufferLength { what: "confidence", .. })
        ));
        assert!(matches!(build((good().0, good().1, vec![], good().3)), Err(Error::BufferLength { .. })));
        assert!(matches!(build((good().0, good().1, good().2, vec![true])), Err(Error::BufferLength { .. })));
        for bad in [-0.1, 1.1, f32::NAN] {
            let result = build((good().0, vec![1.0, bad, 1.0, 1.0], good().2, good().3));
            assert!(matches!(result, Err(Error::Argument { name: "confidence", .. })));
        }
        for bad in [-0.1, f32::INFINITY, f32::NAN] {
            let result = build((good().0, good().1, vec![0.0, 0.0, 0.0, bad], good().3));
            assert!(result.unwrap_err().to_string().contains("(1, 1)"));
        }
        assert!(matches!(map([0.0; 4], [true; 4]), Err(Error::Argument { name: "measured depth", .. })));
        assert!(matches!(DepthMap::new(0, 0, vec![], vec![], vec![], vec![]), Err(Error::ImageSize { .. })));
    }

    #[test]
    fn parts_are_those_of_the_map_and_are_not_copied() {
        let map = map([1.5, f32::NAN, 70.0, 0.3], [true, false, false, false]).unwrap();
        let (copy, at) = (map.clone(), map.depth().as_ptr());
        let p = map.into_parts();
        assert_eq!(p.depth.as_ptr(), at);
        let again =
            DepthMap::new(p.width, p.height, p.depth, p.confidence, p.expected_error, p.measured).unwrap();
        assert_eq!(format!("{again:?}"), format!("{copy:?}"));
    }

    #[test]
    fn kept_measurements_can_be_proven() {
        let sparse = SparseDepth::from_points(2, 2, &[(1, 0, 0.1)]).unwrap();
        let next = f32::from_bits(0.1f32.to_bits() + 1);
        assert!(map([5.0, 0.1, 5.0, 5.0], [false, true, false, false]).unwrap().keeps(&sparse));
        assert!(!map([5.0, next, 5.0, 5.0], [false, true, false, false]).unwrap().keeps(&sparse));
        assert!(!map([5.0, 0.1, 5.0, 5.0], [false; 4]).unwrap().keeps(&sparse));
        assert!(!map([5.0, 0.1, 5.0, 5.0], [true, true, false, false]).unwrap().keeps(&sparse));
        assert!(
            !map([0.1; 4], [true; 4])
                .unwrap()
                .keeps(&SparseDepth::from_points(4, 1, &[(0, 0, 0.1)]).unwrap())
        );
    }

    #[test]
    fn png_round_trip_reports_saturation() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("depth.png");
        let map = map([1.5, f32::NAN, 70.0, 65.535], [false; 4]).unwrap();
        assert_eq!(map.write_png16(&path, DepthScale::millimetres()).unwrap(), Saturation { pixels: 1 });
        assert_eq!(png16::read_png16(&path).unwrap(), (2, 2, vec![1500, 0, 65535, 65535]));
        assert_eq!(map.write_png16(&path, DepthScale::kitti()).unwrap(), Saturation { pixels: 0 });
        let back = SparseDepth::read(&path, Some(DepthScale::kitti())).unwrap();
        assert_eq!((back.get(0, 0), back.get(1, 0), back.get(0, 1)), (Some(1.5), None, Some(70.0)));
    }

    #[test]
    fn npy_files_hold_depth_and_confidence() {
        let dir = tempfile::tempdir().unwrap();
        let (depth, confidence) = (dir.path().join("d.npy"), dir.path().join("c.npy"));
        let map = map([1.5, f32::NAN, 70.0, 0.3], [false; 4]).unwrap();
        map.write_npy(&depth).unwrap();
        map.write_confidence_npy(&confidence).unwrap();
        let back = SparseDepth::read(&depth, None).unwrap();
        assert!(back.as_slice().iter().zip(map.depth()).all(|(a, b)| a.to_bits() == b.to_bits()));
        assert!(
            matches!(npy::read_npy(&confidence).unwrap().values, Values::Floats(c) if c == [0.5, 0.0, 0.5, 0.5])
        );
        assert!(matches!(map.write_npy(dir.path().join("no/d.npy")), Err(Error::Io { .. })));
    }
}
