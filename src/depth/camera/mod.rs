//! Cameras: pinhole intrinsics, lens distortion, and where sensors stand.
//!
//! Conventions are those of OpenCV and ROS (REP 104 for calibrations): x to the right, y down, z forward along the optical axis, integer
//! pixel coordinates at pixel centres.

mod distortion;
mod polynomial;
mod transform;

pub use distortion::Distortion;
pub use transform::Transform;

use super::pixels::pixel_count;
use crate::error::{Error, Result};

/// Pinhole intrinsics, pixels.
///
/// Pixel `(x, y)` looks along `((x - cx) / fx, (y - cy) / fy, 1)`, with x to the right, y down and integer coordinates
/// at pixel centres.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Intrinsics {
    /// Focal length along x.
    pub fx: f32,
    /// Focal length along y.
    pub fy: f32,
    /// Column of the principal point.
    pub cx: f32,
    /// Row of the principal point.
    pub cy: f32,
}

impl Intrinsics {
    /// Square pixels and a centred principal point for a horizontal field of view in radians.
    pub fn from_fov(width: usize, height: usize, horizontal: f32) -> Self {
        let f = 0.5 * width as f32 / (0.5 * horizontal).tan();
        Self { fx: f, fy: f, cx: 0.5 * (width as f32 - 1.0), cy: 0.5 * (height as f32 - 1.0) }
    }
}

/// A calibrated camera: the size of its picture, pinhole intrinsics, lens distortion.
///
/// ```
/// use sdim::depth::{Camera, Distortion, Intrinsics};
/// let k = Intrinsics { fx: 600.0, fy: 600.0, cx: 319.5, cy: 239.5 };
/// let lens = Distortion::PlumbBob([-0.28, 0.07, 0.0, 0.0, 0.0]); // k1, k2, p1, p2, k3
/// let camera = Camera::new(640, 480, k, lens)?;
/// let (x, y) = camera.project([0.5, 0.25, 2.0]).unwrap(); // metres: right, down, forward
/// let [rx, ry, one] = camera.ray(x, y).unwrap();
/// assert!((rx - 0.25).abs() < 1e-5 && (ry - 0.125).abs() < 1e-5 && one == 1.0);
/// # Ok::<(), sdim::Error>(())
/// ```
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Camera {
    width: usize,
    height: usize,
    intrinsics: Intrinsics,
    distortion: Distortion,
    /// [`Distortion::limit`].
    limit: f64,
}

impl Camera {
    /// Fails unless the camera's pictures have the size of what is named, `of`.
    pub(crate) fn require_size(
        &self,
        name: &'static str,
        of: &str,
        (width, height): (usize, usize),
    ) -> Result<()> {
        if (self.width, self.height) == (width, height) {
            return Ok(());
        }
        let found = format!("{}x{}", self.width, self.height);
        Err(Error::argument(name, found, format!("{of}, {width}x{height}")))
    }

    /// From a calibration of the picture as it is: intrinsics and distortion of the raw one, or those of a rectified one, which has
    /// [`Distortion::None`].
    ///
    /// # Errors
    /// [`Error::ImageSize`] for an empty size or one above 2^28 pixels; [`Error::Argument`] for numbers that are not finite, coefficients
    /// above 1e9 and focal lengths that are not above 0 (ROS's sign of a camera without calibration).
    pub fn new(width: usize, height: usize, intrinsics: Intrinsics, distortion: Distortion) -> Result<Self> {
        pixel_count(width, height)?;
        let Intrinsics { fx, fy, cx, cy } = intrinsics;
        for (name, f) in [("fx", fx), ("fy", fy)] {
            if !(f.is_normal() && f > 0.0) {
                return Err(Error::argument(name, f, "a finite focal length above 0 pixels"));
            }
        }
        for (name, c) in [("cx", cx), ("cy", cy)] {
            if !c.is_finite() {
                return Err(Error::argument(name, c, "a finite principal point, pixels"));
            }
        }
        distortion.check()?;
        Ok(Self { width, height, intrinsics, distortion, limit: distortion.limit() })
    }

    /// Width of the picture, pixels.
    pub fn width(&self) -> usize {
        self.width
    }

    /// Height of the picture, pixels.
    pub fn height(&self) -> usize {
        self.height
    }

    /// Focal lengths and principal point.
    pub fn intrinsics(&self) -> Intrinsics {
        self.intrinsics
    }

    /// What the lens does.
    pub fn distortion(&self) -> Distortion {
        self.distortion
    }

    /// Where a point in the camera's axes (metres, z forward) is seen, in pixels; inside of the picture or beyond its borders.
    ///
    /// `None` behind the camera (z of 0 or less), for numbers that are not finite, and so far to the side that the lens model no longer
    /// holds: where a distortion polynomial turns back, it would put such points into the picture.
    pub fn project(&self, point: [f32; 3]) -> Option<(f32, f32)> {
        let [x, y, z] = point.map(f64::from);
        if !(z > 0.0 && z.is_finite()) {
            return None;
        }
        let (u, v) = self.distortion.distort(x / z, y / z, self.limit)?;
        let Intrinsics { fx, fy, cx, cy } = self.intrinsics;
        let column = (f64::from(fx) * u + f64::from(cx)) as f32;
        let row = (f64::from(fy) * v + f64::from(cy)) as f32;
        (column.is_finite() && row.is_finite()).then_some((column, row))
    }

    /// The direction in which a pixel looks, with z = 1: times a Z-depth it is the point, metres. `None` where no ray leads there, as in
    /// the corners beyond a fisheye's circle.
    pub fn ray(&self, x: f32, y: f32) -> Option<[f32; 3]> {
        let Intrinsics { fx, fy, cx, cy } = self.intrinsics;
        let u = (f64::from(x) - f64::from(cx)) / f64::from(fx);
        let v = (f64::from(y) - f64::from(cy)) / f64::from(fy);
        let (a, b) = self.distortion.undistort(u, v, self.limit)?;
        let (a, b) = (a as f32, b as f32);
        (a.is_finite() && b.is_finite()).then_some([a, b, 1.0])
    }

    /// Column and row of the pixel that a point falls on; `None` outside of the picture, and as [`Camera::project`].
    pub fn pixel(&self, point: [f32; 3]) -> Option<(usize, usize)> {
        let (x, y) = self.project(point)?;
        let (x, y) = (x.round(), y.round());
        let inside = x >= 0.0 && y >= 0.0 && x < self.width as f32 && y < self.height as f32;
        inside.then_some((x as usize, y as usize))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const K: Intrinsics = Intrinsics { fx: 300.0, fy: 310.0, cx: 159.5, cy: 119.5 };

    #[test]
    fn pixels_look_along_their_rays() {
        for lens in [
            Distortion::None,
            Distortion::PlumbBob([-0.28, 0.07, 0.001, -0.0005, 0.0]),
            Distortion::Equidistant([-0.02, 0.004, -0.003, 0.0005]),
        ] {
            let camera = Camera::new(320, 240, K, lens).unwrap();
            for (x, y) in [(0.0, 0.0), (319.0, 0.0), (159.5, 119.5), (12.25, 200.0), (319.0, 239.0)] {
                let [a, b, one] = camera.ray(x, y).unwrap();
                assert_eq!(one, 1.0);
                let (u, v) = camera.project([a * 3.0, b * 3.0, 3.0]).unwrap();
                assert!((u - x).abs() < 1e-3 && (v - y).abs() < 1e-3, "{lens:?}: ({u}, {v}) for ({x}, {y})");
            }
        }
        let pinhole = Camera::new(320, 240, K, Distortion::None).unwrap();
        assert_eq!(pinhole.project([0.0, 0.0, 1.0]), Some((159.5, 119.5)));
        assert_eq!(pinhole.project([1.0, -0.1, 2.0]), Some((309.5, 104.0)));
    }

    #[test]
    fn what_no_camera_sees_has_no_pixel() {
        let camera = Camera::new(320, 240, K, Distortion::None).unwrap();
        for unseen in [[0.0, 0.0, 0.0], [0.1, 0.1, -1.0], [f32::NAN, 0.0, 1.0], [0.0, 0.0, f32::INFINITY]] {
            assert_eq!(camera.project(unseen), None);
        }
        assert_eq!(camera.project([f32::MAX, 0.0, 1e-30]), None);
        assert_eq!(camera.ray(f32::NAN, 0.0), None);
        // Pixel (0, 0) reaches from -0.5 to 0.5; beyond it is no pixel.
        let at = |x: f32, y: f32| camera.pixel([(x - 159.5) / 300.0 * 2.0, (y - 119.5) / 310.0 * 2.0, 2.0]);
        assert_eq!(at(-0.49, 0.49), Some((0, 0)));
        assert_eq!(at(319.49, 239.49), Some((319, 239)));
        assert_eq!((at(-0.51, 5.0), at(5.0, 239.6), at(319.6, 5.0)), (None, None, None));
        // The corners of a wide fisheye picture see nothing in front of the camera.
        let wide = Intrinsics { fx: 60.0, fy: 60.0, ..K };
        let fisheye = Camera::new(320, 240, wide, Distortion::Equidistant([0.0; 4])).unwrap();
        assert_eq!(fisheye.ray(0.0, 0.0), None);
        assert!(fisheye.ray(100.0, 100.0).is_some());
    }

    #[test]
    fn calibrations_are_checked() {
        let camera = |k, lens| Camera::new(320, 240, k, lens);
        for bad in [0.0, -300.0, f32::NAN, f32::INFINITY, 1e-42] {
            let wrong = camera(Intrinsics { fx: bad, ..K }, Distortion::None);
            assert!(matches!(wrong, Err(Error::Argument { name: "fx", .. })));
            assert!(camera(Intrinsics { fy: bad, ..K }, Distortion::None).is_err());
        }
        assert!(camera(Intrinsics { cx: f32::NAN, ..K }, Distortion::None).is_err());
        assert!(camera(Intrinsics { cy: f32::INFINITY, ..K }, Distortion::None).is_err());
        assert!(camera(K, Distortion::PlumbBob([0.0, 0.0, 0.0, f64::NAN, 0.0])).is_err());
        assert!(matches!(Camera::new(0, 240, K, Distortion::None), Err(Error::ImageSize { .. })));
        assert!(Camera::new(usize::MAX, 2, K, Distortion::None).is_err());
    }
}
