//! `sensor_msgs/CameraInfo`: a calibration.

use crate::depth::{Camera, Distortion, Intrinsics, Transform};
use crate::error::{Error, Result};

/// A part of the sensor; all 0 is the whole of it.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct RegionOfInterest {
    /// First column, pixels of the sensor.
    pub x_offset: u32,
    /// First row.
    pub y_offset: u32,
    /// Rows.
    pub height: u32,
    /// Columns.
    pub width: u32,
    /// Whether the rectified picture shows another part than the raw one.
    pub do_rectify: bool,
}

/// A calibration, for the whole sensor at its full resolution; `binning` and `roi` say what the pictures show of it.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct CameraInfo {
    /// Rows at calibration.
    pub height: u32,
    /// Columns at calibration.
    pub width: u32,
    /// `plumb_bob`, `rational_polynomial` or `equidistant`.
    pub distortion_model: String,
    /// Coefficients of the distortion ([`Distortion::from_ros`]).
    pub d: Vec<f64>,
    /// Intrinsics of the raw picture, row by row: `fx 0 cx / 0 fy cy / 0 0 1`.
    pub k: [f64; 9],
    /// Rotation from the camera's axes to those of the rectified picture, row by row.
    pub r: [f64; 9],
    /// Projection of the rectified picture, row by row: `fx 0 cx tx / 0 fy cy ty / 0 0 1 0`.
    pub p: [f64; 12],
    /// Columns of the sensor that make one of the picture; 0 is 1.
    pub binning_x: u32,
    /// Rows of the sensor that make one of the picture; 0 is 1.
    pub binning_y: u32,
    /// The part of the sensor that pictures show, before binning.
    pub roi: RegionOfInterest,
}

impl CameraInfo {
    /// The camera of raw pictures (`image_raw`, `image_color`): `k` with the distortion.
    ///
    /// A region of interest moves the principal point, binning divides: `(cx + 0.5) / binning - 0.5`, since pixel centres have integer
    /// coordinates. (ROS's `image_geometry` divides `cx` itself, which is a quarter of a pixel off for a binning of 2.)
    ///
    /// # Errors
    /// [`Error::Argument`] for a matrix that is none of a camera (also all 0: ROS's sign of a camera without calibration), unknown
    /// distortion, a region that is empty or reaches beyond the sensor; [`Error::ImageSize`].
    pub fn to_camera(&self) -> Result<Camera> {
        let [fx, skew, cx, zero, fy, cy, last @ ..] = self.k;
        check_matrix("k", &self.k, &[skew, zero, last[0], last[1], last[2] - 1.0])?;
        self.camera([fx, fy, cx, cy], Distortion::from_ros(&self.distortion_model, &self.d)?)
    }

    /// The camera of rectified pictures (`image_rect`, `image_rect_color`): `p`, without distortion. Points must be in its own axes: those that
    /// [`CameraInfo::rectification`] and, for the second camera of a stereo pair, [`CameraInfo::baseline`] lead to.
    ///
    /// # Errors
    /// As [`CameraInfo::to_camera`]; [`Error::Argument`] also for a region with `do_rectify`, of which the message does not tell what the
    /// rectified picture shows.
    pub fn to_rectified_camera(&self) -> Result<Camera> {
        let [fx, skew, cx, _, zero, fy, cy, _, last @ ..] = self.p;
        check_matrix("p", &self.p, &[skew, zero, last[0], last[1], last[2] - 1.0, last[3]])?;
        if self.roi.do_rectify && self.region()? != (0, 0, self.width, self.height) {
            let expected = "false, or a region that is the whole sensor";
            return Err(Error::argument("roi.do_rectify", true, expected));
        }
        self.camera([fx, fy, cx, cy], Distortion::None)
    }

    /// From the raw camera's axes to those of its rectified picture: `r`; no rotation where it is all 0, as drivers leave it.
    ///
    /// # Errors
    /// [`Error::Argument`] unless it is a rotation.
    pub fn rectification(&self) -> Result<Transform> {
        if self.r == [0.0; 9] {
            return Ok(Transform::identity());
        }
        let [a, b, c, d, e, f, g, h, i] = self.r;
        Transform::from_rows([[a, b, c, 0.0], [d, e, f, 0.0], [g, h, i, 0.0]])
    }

    /// From the axes of the first camera of a rectified stereo pair, which name the frame of both, to those of this one: `(tx / fx, ty / fy, 0)`
    /// of `p`, metres. Nothing for the first camera, and for one that is alone.
    ///
    /// # Errors
    /// [`Error::Argument`] for focal lengths of 0 and numbers that are not finite.
    pub fn baseline(&self) -> Result<Transform> {
        let [fx, _, _, tx, _, fy, _, ty, ..] = self.p;
        Transform::from_quaternion([0.0, 0.0, 0.0, 1.0], [tx / fx, ty / fy, 0.0])
    }

    /// A camera's calibration: for its picture as it is, with `p` the same as `k`.
    pub fn from_camera(camera: &Camera) -> Self {
        let Intrinsics { fx, fy, cx, cy } = camera.intrinsics();
        let [fx, fy, cx, cy] = [fx, fy, cx, cy].map(f64::from);
        Self {
            // Sizes of a camera are at most 2^28.
            height: camera.height() as u32,
            width: camera.width() as u32,
            distortion_model: camera.distortion().ros_name().to_string(),
            d: camera.distortion().coefficients().to_vec(),
            k: [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0],
            r: [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
            p: [fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0],
            ..Self::default()
        }
    }

    /// First column, first row, columns and rows of the sensor that pictures show.
    fn region(&self) -> Result<(u32, u32, u32, u32)> {
        let RegionOfInterest { x_offset, y_offset, height, width, .. } = self.roi;
        let (x, y, w, h) = match (x_offset, y_offset, width, height) {
            (0, 0, 0, 0) => return Ok((0, 0, self.width, self.height)),
            region => region,
        };
        let inside = |at: u32, size: u32, limit: u32| at.checked_add(size).is_some_and(|end| end <= limit);
        if w > 0 && h > 0 && inside(x, w, self.width) && inside(y, h, self.height) {
            return Ok((x, y, w, h));
        }
        let found = format!("{width}x{height} from ({x_offset}, {y_offset})");
        let expected = format!("a part of the sensor, {}x{}, or all 0", self.width, self.height);
        Err(Error::argument("roi", found, expected))
    }

    /// Brings full-resolution intrinsics to what the pictures show.
    fn camera(&self, [fx, fy, cx, cy]: [f64; 4], distortion: Distortion) -> Result<Camera> {
        let (x, y, width, height) = self.region()?;
        let (across, down) = (self.binning_x.max(1), self.binning_y.max(1));
        let centre = |c: f64, offset: u32, bin: u32| (c - f64::from(offset) + 0.5) / f64::from(bin) - 0.5;
        let k = Intrinsics {
            fx: (fx / f64::from(across)) as f32,
            fy: (fy / f64::from(down)) as f32,
            cx: centre(cx, x, across) as f32,
            cy: centre(cy, y, down) as f32,
        };
        Camera::new((width / across) as usize, (height / down) as usize, k, distortion)
    }
}

/// Fails unless the numbers that are 0 in a camera's matrix are 0.
fn check_matrix(name: &'static str, matrix: &[f64], zeros: &[f64]) -> Result<()> {
    // Some tools write the skew of their optimisation, which is noise.
    if zeros.iter().all(|z| z.abs() <= 1e-6) {
        return Ok(());
    }
    Err(Error::argument(
        name,
        format!("{matrix:?}"),
        "focal lengths on the diagonal, the principal point in the third column, a last row of 0 0 1, no skew",
    ))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn info() -> CameraInfo {
        let k = Intrinsics { fx: 600.0, fy: 610.0, cx: 321.0, cy: 238.0 };
        let lens = Distortion::PlumbBob([-0.2, 0.1, 0.001, 0.002, -0.03]);
        CameraInfo::from_camera(&Camera::new(640, 480, k, lens).unwrap())
    }

    #[test]
    fn calibrations_come_back() {
        let k = Intrinsics { fx: 600.0, fy: 610.0, cx: 321.0, cy: 238.0 };
        for lens in [
            Distortion::None,
            Distortion::PlumbBob([-0.2, 0.1, 0.001, 0.002, -0.03]),
            Distortion::RationalPolynomial([0.5, -2.6, 0.001, 0.0, 1.5, 0.4, -2.4, 1.4]),
            Distortion::Equidistant([0.1, -0.02, 0.003, 0.0]),
        ] {
            let camera = Camera::new(640, 480, k, lens).unwrap();
            let info = CameraInfo::from_camera(&camera);
            assert_eq!(info.to_camera().unwrap(), camera);
            assert_eq!(
                info.to_rectified_camera().unwrap(),
                Camera::new(640, 480, k, Distortion::None).unwrap()
            );
            assert_eq!(info.rectification().unwrap(), Transform::identity());
            assert_eq!(info.baseline().unwrap(), Transform::identity());
        }
    }

    #[test]
    fn regions_and_binning_are_honoured() {
        let mut info = info();
        info.roi =
            RegionOfInterest { x_offset: 100, y_offset: 40, height: 400, width: 500, do_rectify: false };
        info.binning_x = 2;
        info.binning_y = 4;
        let camera = info.to_camera().unwrap();
        assert_eq!((camera.width(), camera.height()), (250, 100));
        // The same ray meets the same place of the sensor: columns 2 x and 2 x + 1 make column x.
        let point = [0.3, 0.2, 2.0];
        let (full, part) = (self::info().to_camera().unwrap(), camera);
        let ((u, v), (a, b)) = (full.project(point).unwrap(), part.project(point).unwrap());
        assert!((a * 2.0 + 0.5 + 100.0 - u).abs() < 1e-3 && (b * 4.0 + 1.5 + 40.0 - v).abs() < 1e-3);
        assert_eq!(info.to_rectified_camera().unwrap().width(), 250);
        info.roi.do_rectify = true;
        assert!(info.to_camera().is_ok());
        assert!(info.to_rectified_camera().unwrap_err().to_string().contains("do_rectify"));
        for (x_offset, width) in [(100, 541), (0, 0), (u32::MAX, 2), (5, 0)] {
            info.roi = RegionOfInterest { x_offset, width, y_offset: 1, height: 2, do_rectify: false };
            assert!(matches!(info.to_camera(), Err(Error::Argument { name: "roi", .. })));
        }
        info.roi = RegionOfInterest::default();
        info.binning_x = 641;
        assert!(matches!(info.to_camera(), Err(Error::ImageSize { .. })));
    }

    #[test]
    fn the_second_camera_of_a_pair_has_a_baseline() {
        let mut info = info();
        info.p[3] = -600.0 * 0.12;
        assert_eq!(info.baseline().unwrap().apply([1.0, 2.0, 3.0]), [0.88, 2.0, 3.0]);
        info.r = [0.0, -1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0];
        assert_eq!(info.rectification().unwrap().apply([1.0, 2.0, 3.0]), [-2.0, 1.0, 3.0]);
        info.r = [0.0; 9];
        assert_eq!(info.rectification().unwrap(), Transform::identity());
        info.r[0] = 1.0;
        assert!(matches!(info.rectification(), Err(Error::Argument { name: "rotation", .. })));
        info.p[0] = 0.0;
        assert!(matches!(info.baseline(), Err(Error::Argument { name: "translation", .. })));
    }

    #[test]
    fn bad_calibrations_are_refused() {
        let bad = |change: fn(&mut CameraInfo)| {
            let mut info = info();
            change(&mut info);
            info.to_camera().unwrap_err().to_string()
        };
        assert!(bad(|i| i.k = [0.0; 9]).contains("k = "));
        assert!(bad(|i| i.k[0] = 0.0).contains("fx"));
        assert!(bad(|i| i.k[4] = -5.0).contains("fy"));
        assert!(bad(|i| i.k[2] = f64::NAN).contains("cx"));
        assert!(bad(|i| i.k[0] = f64::MAX).contains("fx"));
        assert!(bad(|i| i.k[1] = 3.0).contains("skew"));
        assert!(bad(|i| i.k[8] = f64::NAN).contains("k = "));
        assert!(bad(|i| i.d = vec![0.1; 3]).contains("4 or 5"));
        assert!(bad(|i| i.d[0] = f64::INFINITY).contains("coefficient"));
        assert!(bad(|i| i.distortion_model = "omni".into()).contains("equidistant"));
        assert!(bad(|i| i.width = 0).contains("image 0x480"));
        let mut unset = info();
        unset.p = [0.0; 12];
        assert!(unset.to_rectified_camera().unwrap_err().to_string().contains("p = "));
        assert!(CameraInfo::default().to_camera().is_err());
    }
}
