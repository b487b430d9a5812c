//! What a lens does to straight lines: the models of OpenCV and ROS, and their inverses.
//!
//! Formulas: OpenCV, "Camera Calibration and 3D Reconstruction" and "Fisheye camera model"; names of the models: `distortion_models.hpp`
//! of ROS's `sensor_msgs`. All of them move points of the plane z = 1.

use super::polynomial::{derivative, positive_until, product, value};
use crate::error::{Error, Result};
use std::f64::consts::FRAC_PI_2;

/// How a lens bends rays, with coefficients in the order in which OpenCV and ROS list them.
///
/// With `u = x² + y²` of a point `(x, y)` of the plane z = 1:
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub enum Distortion {
    /// A pinhole camera, or a rectified picture.
    #[default]
    None,
    /// `k1, k2, p1, p2, k3`, by Brown and Conrady: `x' = x (1 + k1 u + k2 u² + k3 u³) + 2 p1 x y + p2 (u + 2 x²)`,
    /// `y' = y (1 + ..) + p1 (u + 2 y²) + 2 p2 x y`.
    PlumbBob([f64; 5]),
    /// `k1, k2, p1, p2, k3, k4, k5, k6`: as plumb-bob, with the sum in brackets divided by `1 + k4 u + k5 u² + k6 u³`.
    RationalPolynomial([f64; 8]),
    /// `k1, k2, k3, k4`, OpenCV's fisheye, by Kannala and Brandt: with the angle `t = atan(sqrt(u))` to the optical axis, the point moves
    /// along its direction to the radius `t (1 + k1 t² + k2 t⁴ + k3 t⁶ + k4 t⁸)`.
    Equidistant([f64; 4]),
}

/// Radius on the plane z = 1 that no model is followed beyond: 89.99 degrees.
const FAR: f64 = 5000.0;
/// Largest coefficient: far above any lens, and its products can be calculated with.
const LARGEST: f64 = 1e9;
/// Newton steps of an inverse, at most; five are usual.
const STEPS: usize = 60;
/// Distance on the plane z = 1 that an inverse may be off: below a millionth of a pixel for any camera.
const CLOSE: f64 = 1e-11;

impl Distortion {
    /// From the name and coefficients of a ROS calibration (`distortion_model` and `d`): `plumb_bob` (4 or 5), `rational_polynomial` (8, or
    /// more if the rest is 0), `equidistant` (4). No coefficients, whatever the name, is [`Distortion::None`].
    ///
    /// # Errors
    /// [`Error::Argument`] for another name, another number of coefficients, and one that is not finite or above 1e9.
    pub fn from_ros(model: &str, d: &[f64]) -> Result<Self> {
        let wrong = |expected: &str| {
            Err(Error::argument("distortion", format!("{model:?} with {} coefficients", d.len()), expected))
        };
        // OpenCV's longer lists go on with thin prisms and a tilted sensor.
        let used = match d.split_at_checked(8) {
            Some((used, more)) if more.iter().all(|&c| c == 0.0) => used,
            _ => d,
        };
        let found = match (model, used) {
            ("" | "none" | "plumb_bob" | "rational_polynomial" | "equidistant", []) => Self::None,
            ("plumb_bob", &[k1, k2, p1, p2]) => Self::PlumbBob([k1, k2, p1, p2, 0.0]),
            ("plumb_bob", &[k1, k2, p1, p2, k3]) => Self::PlumbBob([k1, k2, p1, p2, k3]),
            ("rational_polynomial", &[k1, k2, p1, p2, k3, k4, k5, k6]) => {
                Self::RationalPolynomial([k1, k2, p1, p2, k3, k4, k5, k6])
            }
            ("equidistant", &[k1, k2, k3, k4]) => Self::Equidistant([k1, k2, k3, k4]),
            ("plumb_bob", _) => return wrong("4 or 5 coefficients: k1, k2, p1, p2 and k3"),
            ("rational_polynomial", _) => return wrong("8 coefficients: k1, k2, p1, p2, k3, k4, k5, k6"),
            ("equidistant", _) => return wrong("4 coefficients: k1, k2, k3, k4"),
            _ => return wrong("the model plumb_bob, rational_polynomial or equidistant"),
        };
        found.check()?;
        Ok(found)
    }

    /// The name in ROS calibrations; [`Distortion::None`] is `plumb_bob` without coefficients.
    pub fn ros_name(&self) -> &'static str {
        match self {
            Self::None | Self::PlumbBob(_) => "plumb_bob",
            Self::RationalPolynomial(_) => "rational_polynomial",
            Self::Equidistant(_) => "equidistant",
        }
    }

    /// The coefficients, in the order of the variants.
    pub fn coefficients(&self) -> &[f64] {
        match self {
            Self::None => &[],
            Self::PlumbBob(d) => d,
            Self::RationalPolynomial(d) => d,
            Self::Equidistant(d) => d,
        }
    }

    /// Fails unless all coefficients are numbers that a lens can have.
    pub(super) fn check(&self) -> Result<()> {
        match self.coefficients().iter().find(|c| c.is_nan() || c.abs() > LARGEST) {
            Some(c) => Err(Error::argument("distortion coefficient", c, "a finite number, 1e9 at most")),
            None => Ok(()),
        }
    }

    /// How far from the axis the model maps different rays to different points: a radius on the plane z = 1. Beyond it a polynomial
    /// turns back, so that what lies far to the side would be drawn inside the picture.
    pub(super) fn limit(&self) -> f64 {
        match self {
            Self::None => f64::INFINITY,
            Self::PlumbBob(_) | Self::RationalPolynomial(_) => self.brown().limit(),
            Self::Equidistant(k) => {
                let angle = positive_until(&angle_slope(k), FRAC_PI_2 * FRAC_PI_2).sqrt();
                angle.min(FAR.atan()).tan()
            }
        }
    }

    /// Where the lens puts a point of the plane z = 1; `None` beyond `limit`, the radius that [`Distortion::limit`] gave.
    pub(super) fn distort(&self, x: f64, y: f64, limit: f64) -> Option<(f64, f64)> {
        match self {
            Self::None => Some((x, y)),
            Self::PlumbBob(_) | Self::RationalPolynomial(_) => {
                let (to, slope) = self.brown().at(x, y, limit)?;
                slope.is_positive().then_some(to)
            }
            Self::Equidistant(k) => {
                let radius = x.hypot(y);
                let factor = if radius > 0.0 { angle_value(k, radius.atan()) / radius } else { 1.0 };
                (radius < limit).then_some((x * factor, y * factor))
            }
        }
    }

    /// The point that [`Distortion::distort`] puts at `(x, y)`; `None` where none is put.
    pub(super) fn undistort(&self, x: f64, y: f64, limit: f64) -> Option<(f64, f64)> {
        match self {
            Self::None => Some((x, y)),
            Self::PlumbBob(_) | Self::RationalPolynomial(_) => self.brown().inverse(x, y, limit),
            Self::Equidistant(k) => {
                let radius = x.hypot(y);
                if radius == 0.0 {
                    return Some((x, y));
                }
                let factor = angle_inverse(k, radius, limit.atan())?.tan() / radius;
                Some((x * factor, y * factor))
            }
        }
    }

    /// Plumb-bob and rational polynomial in one form.
    fn brown(&self) -> Brown {
        match *self {
            Self::PlumbBob([k1, k2, p1, p2, k3]) => {
                Brown { above: [1.0, k1, k2, k3], below: [1.0, 0.0, 0.0, 0.0], p1, p2 }
            }
            Self::RationalPolynomial([k1, k2, p1, p2, k3, k4, k5, k6]) => {
                Brown { above: [1.0, k1, k2, k3], below: [1.0, k4, k5, k6], p1, p2 }
            }
            Self::None | Self::Equidistant(_) => {
                Brown { above: [1.0, 0.0, 0.0, 0.0], below: [1.0, 0.0, 0.0, 0.0], p1: 0.0, p2: 0.0 }
            }
        }
    }
}

/// A factor for the radius that is one polynomial of `u` by another, and the tangential terms.
struct Brown {
    above: [f64; 4],
    below: [f64; 4],
    p1: f64,
    p2: f64,
}

/// How the moved point follows the point: a symmetric matrix, since the model is the gradient of a function.
struct Slope {
    xx: f64,
    xy: f64,
    yy: f64,
}

impl Slope {
    /// Whether it is positive definite, as it is at the axis; where it ceases to be, the picture folds over.
    fn is_positive(&self) -> bool {
        self.xx > 0.0 && self.xx * self.yy - self.xy * self.xy > 0.0
    }
}

impl Brown {
    fn limit(&self) -> f64 {
        // The moved radius is r A(u) / B(u); its slope has the sign of A B + 2 u (A' B - A B').
        let ab = product(&self.above, &self.below);
        let (left, right) =
            (product(&derivative(&self.above), &self.below), product(&self.above, &derivative(&self.below)));
        let mut slope = ab;
        for (power, (l, r)) in left.iter().zip(&right).enumerate() {
            if let Some(c) = slope.get_mut(power + 1) {
                *c += 2.0 * (l - r);
            }
        }
        let far = FAR * FAR;
        positive_until(&slope, far).min(positive_until(&self.below, far)).sqrt()
    }

    /// The moved point and its slope; `None` beyond `limit`.
    fn at(&self, x: f64, y: f64, limit: f64) -> Option<((f64, f64), Slope)> {
        let u = x * x + y * y;
        if u.is_nan() || u >= limit * limit {
            return None;
        }
        let (a, b) = (value(&self.above, u), value(&self.below, u));
        let factor = a / b;
        let (da, db) = (three(&self.above, u), three(&self.below, u));
        let change = 2.0 * (da * b - a * db) / (b * b);
        let Self { p1, p2, .. } = *self;
        let to = (
            x * factor + 2.0 * p1 * x * y + p2 * (u + 2.0 * x * x),
            y * factor + p1 * (u + 2.0 * y * y) + 2.0 * p2 * x * y,
        );
        let slope = Slope {
            xx: factor + x * x * change + 2.0 * p1 * y + 6.0 * p2 * x,
            xy: x * y * change + 2.0 * p1 * x + 2.0 * p2 * y,
            yy: factor + y * y * change + 6.0 * p1 * y + 2.0 * p2 * x,
        };
        Some((to, slope))
    }

    /// Newton's method from the axis, with steps halved while they do not lead nearer. Where the slope is positive definite, the
    /// model is the gradient of a convex function, so that there is one solution at most.
    fn inverse(&self, x: f64, y: f64, limit: f64) -> Option<(f64, f64)> {
        let off = |to: (f64, f64)| (to.0 - x).hypot(to.1 - y);
        let (mut at, (mut to, mut slope)) = ((0.0, 0.0), self.at(0.0, 0.0, limit)?);
        for _ in 0..STEPS {
            if off(to) < CLOSE * (1.0 + x.hypot(y)) {
                return Some(at);
            }
            let det = slope.xx * slope.yy - slope.xy * slope.xy;
            let (rx, ry) = (x - to.0, y - to.1);
            let step = ((slope.yy * rx - slope.xy * ry) / det, (slope.xx * ry - slope.xy * rx) / det);
            let mut part = 1.0;
            (at, (to, slope)) = loop {
                let next = (at.0 + part * step.0, at.1 + part * step.1);
                match self.at(next.0, next.1, limit) {
                    Some(found) if found.1.is_positive() && off(found.0) < off(to) => break (next, found),
                    _ => part *= 0.5,
                }
                if part < 1e-6 {
                    return None;
                }
            };
        }
        None
    }
}

/// The derivative of a cubic.
fn three(c: &[f64; 4], u: f64) -> f64 {
    c[1] + u * (2.0 * c[2] + u * 3.0 * c[3])
}

/// Radius for an angle to the axis.
fn angle_value(k: &[f64; 4], angle: f64) -> f64 {
    let [k1, k2, k3, k4] = *k;
    angle * value(&[1.0, k1, k2, k3, k4], angle * angle)
}

/// Coefficients, in the square of the angle, of the slope of [`angle_value`].
fn angle_slope(k: &[f64; 4]) -> [f64; 5] {
    [1.0, 3.0 * k[0], 5.0 * k[1], 7.0 * k[2], 9.0 * k[3]]
}

/// The angle below `limit` with this radius: Newton's method, kept between two angles that enclose it.
fn angle_inverse(k: &[f64; 4], radius: f64, limit: f64) -> Option<f64> {
    if radius.is_nan() || radius >= angle_value(k, limit) {
        return None;
    }
    let slope = angle_slope(k);
    let (mut low, mut high) = (0.0, limit);
    let mut angle = radius.min(0.5 * limit);
    for _ in 0..STEPS {
        let off = angle_value(k, angle) - radius;
        if off.abs() < CLOSE * (1.0 + radius) {
            return Some(angle);
        }
        if off > 0.0 {
            high = angle;
        } else {
            low = angle;
        }
        let newton = angle - off / value(&slope, angle * angle);
        angle = if newton > low && newton < high { newton } else { 0.5 * (low + high) };
    }
    None
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A webcam's barrel, a pincushion, strong tangential terms, an Azure Kinect's rational model, a fisheye.
    const LENSES: [Distortion; 5] = [
        Distortion::PlumbBob([-0.28, 0.07, 0.001, -0.0005, 0.01]),
        Distortion::PlumbBob([0.15, 0.02, 0.0, 0.0, 0.0]),
        Distortion::PlumbBob([-0.1, 0.0, 0.02, -0.03, 0.0]),
        Distortion::RationalPolynomial([0.52, -2.7, 0.0005, -0.0003, 1.6, 0.4, -2.5, 1.5]),
        Distortion::Equidistant([-0.02, 0.004, -0.003, 0.0005]),
    ];

    #[test]
    fn undistorting_undoes_distorting() {
        for lens in LENSES {
            let limit = lens.limit();
            assert!(limit > 0.7, "{lens:?}: {limit}");
            let mut kept = 0;
            for i in 0..41 * 41 {
                let (x, y) = (f64::from(i % 41 - 20) * 0.04, f64::from(i / 41 - 20) * 0.03);
                let Some((u, v)) = lens.distort(x, y, limit) else { continue };
                kept += 1;
                let (a, b) = lens.undistort(u, v, limit).unwrap_or_else(|| panic!("{lens:?} at {x}, {y}"));
                assert!((a - x).hypot(b - y) < 1e-8, "{lens:?} at ({x}, {y}): ({a}, {b})");
            }
            assert!(kept > 1200, "{lens:?}: {kept} of 1681");
        }
    }

    #[test]
    fn a_lens_that_folds_is_not_followed_beyond_the_fold() {
        // r (1 - 0.3 r²) is largest at r² = 1 / 0.9.
        let barrel = Distortion::PlumbBob([-0.3, 0.0, 0.0, 0.0, 0.0]);
        let limit = barrel.limit();
        assert!((limit - (1.0f64 / 0.9).sqrt()).abs() < 1e-9, "{limit}");
        assert!(barrel.distort(1.05, 0.0, limit).is_some());
        // Without the limit it would land at 0.44, well inside of the picture.
        assert_eq!(barrel.distort(1.6, 0.0, limit), None);
        // The largest radius that any point has is 0.703.
        assert!(barrel.undistort(0.7, 0.0, limit).is_some());
        assert_eq!(barrel.undistort(0.71, 0.0, limit), None);

        let tangential = Distortion::PlumbBob([0.0, 0.0, 0.0, 0.1, 0.0]);
        let limit = tangential.limit();
        // x' = x + 0.3 x² turns back at x = -1.67; a pole of a rational model ends it as well.
        assert!(tangential.distort(-1.6, 0.0, limit).is_some());
        assert_eq!(tangential.distort(-1.7, 0.0, limit), None);
        assert_eq!(tangential.distort(-8.0, 0.0, limit), None);
        let pole = Distortion::RationalPolynomial([0.0, 0.0, 0.0, 0.0, 0.0, -0.25, 0.0, 0.0]);
        assert!((pole.limit() - 2.0).abs() < 1e-9);

        // t (1 - 0.4 t²) is largest at t² = 1 / 1.2.
        let fisheye = Distortion::Equidistant([-0.4, 0.0, 0.0, 0.0]);
        let limit = fisheye.limit();
        assert!((limit.atan() - (1.0f64 / 1.2).sqrt()).abs() < 1e-9);
        assert!(fisheye.distort(1.2, 0.0, limit).is_some());
        assert_eq!(fisheye.distort(1.4, 0.0, limit), None);
        assert_eq!(fisheye.undistort(0.7, 0.0, limit), None);
    }

    #[test]
    fn names_and_numbers_of_coefficients() {
        let five = [0.1, 0.2, 0.3, 0.4, 0.5];
        for (model, d) in [("plumb_bob", &five[..]), ("equidistant", &five[..4])] {
            let lens = Distortion::from_ros(model, d).unwrap();
            assert_eq!((lens.ros_name(), lens.coefficients()), (model, d));
        }
        let four = Distortion::from_ros("plumb_bob", &five[..4]).unwrap();
        assert_eq!(four, Distortion::PlumbBob([0.1, 0.2, 0.3, 0.4, 0.0]));
        let mut long = vec![0.25; 8];
        long.resize(14, 0.0);
        let lens = Distortion::from_ros("rational_polynomial", &long).unwrap();
        assert_eq!(lens, Distortion::RationalPolynomial([0.25; 8]));
        assert_eq!(Distortion::from_ros("", &[]).unwrap(), Distortion::None);
        long[9] = 0.1;
        for (model, d) in [
            ("rational_polynomial", &long[..]),
            ("plumb_bob", &five[..3]),
            ("equidistant", &five[..]),
            ("fisheye62", &five[..]),
            ("fisheye62", &[]),
            ("plumb_bob", &[0.0, f64::NAN, 0.0, 0.0]),
            ("plumb_bob", &[0.0, -1e10, 0.0, 0.0]),
        ] {
            assert!(matches!(Distortion::from_ros(model, d), Err(Error::Argument { .. })), "{model} {d:?}");
        }
    }

    #[test]
    fn absurd_coefficients_give_no_point() {
        for c in [LARGEST, -LARGEST, 1e-300] {
            for lens in [
                Distortion::PlumbBob([c; 5]),
                Distortion::RationalPolynomial([c; 8]),
                Distortion::Equidistant([c; 4]),
            ] {
                let limit = lens.limit();
                for at in [0.0, 1e-3, 0.5, 1e30, 1e300, f64::NAN, f64::INFINITY] {
                    let finite =
                        |p: Option<(f64, f64)>| p.is_none_or(|(x, y)| x.is_finite() && y.is_finite());
                    assert!(finite(lens.distort(at, at, limit)), "{lens:?} at {at}");
                    assert!(finite(lens.undistort(at, at, limit)), "{lens:?} at {at}");
                }
            }
        }
    }
}
