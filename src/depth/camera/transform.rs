//! Where one sensor stands in the frame of another.

use crate::error::{Error, Result};

/// A rigid motion: the coordinates of a point in another frame, `R p + t`, metres.
///
/// It is named after both frames in their order: "LiDAR to camera" takes points in the LiDAR's axes and gives them in the camera's. That is
/// the pose of the LiDAR in the camera's frame, or what `tf2`'s `lookup_transform(target = camera, source = lidar)` returns. A camera's
/// axes are x right, y down, z forward ("optical frame" in REP 103), not those of the vehicle.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Transform {
    rotation: [[f64; 3]; 3],
    translation: [f64; 3],
}

/// How far the products of a matrix's rows may be from those of a rotation: what three printed decimals leave.
const ROUNDED: f64 = 5e-3;
/// How far from 1 a quaternion's length may be, as in ROS's tf2.
const NOT_UNIT: f64 = 1e-2;
/// Largest translation, metres: the Earth's radius is within it.
const FAR: f64 = 1e8;

impl Transform {
    /// Both frames are one.
    pub const fn identity() -> Self {
        Self { rotation: [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]], translation: [0.0; 3] }
    }

    /// From the upper three rows of a 4x4 matrix, `[R | t]`, `t` in metres. What rounding left over of the rotation is taken out.
    ///
    /// # Errors
    /// [`Error::Argument`] for a number that is not finite, unless `R` is a rotation (orthonormal within 0.005, determinant 1: no
    /// mirror image), and for a translation above 1e8 m.
    pub fn from_rows(rows: [[f64; 4]; 3]) -> Result<Self> {
        let rotation = rows.map(|[a, b, c, _]| [a, b, c]);
        let mut products = (0..9).map(|i| {
            let (a, b) = (i / 3, i % 3);
            dot(rotation[a], rotation[b]) - f64::from(u8::from(a == b))
        });
        if !products.all(|off| off.abs() <= ROUNDED) {
            let expected = "orthonormal rows: a rotation without scale or shear";
            return Err(Error::argument("rotation", format!("{rotation:?}"), expected));
        }
        if determinant(&rotation) < 0.0 {
            let expected = "determinant 1: a rotation, not a mirror image";
            return Err(Error::argument("rotation", format!("{rotation:?}"), expected));
        }
        Self::of(nearest_rotation(rotation), rows.map(|row| row[3]))
    }

    /// From a unit quaternion in the order x, y, z, w (that of ROS messages) and a translation in metres.
    ///
    /// # Errors
    /// [`Error::Argument`] for a number that is not finite, a quaternion whose length differs from 1 by more than 0.01, and a translation
    /// above 1e8 m.
    pub fn from_quaternion(xyzw: [f64; 4], translation: [f64; 3]) -> Result<Self> {
        let length = xyzw.iter().map(|q| q * q).sum::<f64>().sqrt();
        if length.is_nan() || (length - 1.0).abs() > NOT_UNIT {
            let expected = "a unit quaternion: x, y, z, w of length 1";
            return Err(Error::argument("quaternion", format!("{xyzw:?}"), expected));
        }
        let [x, y, z, w] = xyzw.map(|q| q / length);
        let rotation = [
            [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - z * w), 2.0 * (x * z + y * w)],
            [2.0 * (x * y + z * w), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - x * w)],
            [2.0 * (x * z - y * w), 2.0 * (y * z + x * w), 1.0 - 2.0 * (x * x + y * y)],
        ];
        Self::of(rotation, translation)
    }

    fn of(rotation: [[f64; 3]; 3], translation: [f64; 3]) -> Result<Self> {
        if translation.iter().all(|t| t.abs() <= FAR) {
            return Ok(Self { rotation, translation });
        }
        Err(Error::argument("translation", format!("{translation:?}"), "finite metres, 1e8 at most"))
    }

    /// `[R | t]`, `t` in metres.
    pub fn rows(&self) -> [[f64; 4]; 3] {
        std::array::from_fn(|i| {
            let [a, b, c] = self.rotation[i];
            [a, b, c, self.translation[i]]
        })
    }

    /// The way back: of "LiDAR to camera", "camera to LiDAR".
    pub fn inverse(&self) -> Self {
        let rotation = transposed(&self.rotation);
        Self { rotation, translation: rotation.map(|row| -dot(row, self.translation)) }
    }

    /// This one first, then `next`: `lidar_to_body.then(&body_to_camera)` is LiDAR to camera.
    pub fn then(&self, next: &Self) -> Self {
        let columns = transposed(&self.rotation);
        let rotation = next.rotation.map(|row| columns.map(|column| dot(row, column)));
        Self { rotation, translation: next.moved(self.translation) }
    }

    /// A point's coordinates in the other frame, metres.
    pub fn apply(&self, point: [f32; 3]) -> [f32; 3] {
        self.moved(point.map(f64::from)).map(|c| c as f32)
    }

    fn moved(&self, point: [f64; 3]) -> [f64; 3] {
        std::array::from_fn(|i| dot(self.rotation[i], point) + self.translation[i])
    }
}

impl Default for Transform {
    fn default() -> Self {
        Self::identity()
    }
}

fn dot(a: [f64; 3], b: [f64; 3]) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

fn cross(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}

fn determinant(m: &[[f64; 3]; 3]) -> f64 {
    dot(m[0], cross(m[1], m[2]))
}

fn transposed(m: &[[f64; 3]; 3]) -> [[f64; 3]; 3] {
    std::array::from_fn(|i| m.map(|row| row[i]))
}

/// The rotation that is nearest to a matrix close to one: the mean of the matrix and its inverse's transpose, again and again
/// (N. Higham, "Computing the polar decomposition", 1986). The error is squared each time.
fn nearest_rotation(mut m: [[f64; 3]; 3]) -> [[f64; 3]; 3] {
    for _ in 0..4 {
        let det = determinant(&m);
        let cofactors = [cross(m[1], m[2]), cross(m[2], m[0]), cross(m[0], m[1])];
        m = std::array::from_fn(|i| std::array::from_fn(|j| 0.5 * (m[i][j] + cofactors[i][j] / det)));
    }
    m
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A LiDAR's axes (x forward, y left, z up) in a camera's (x right, y down, z forward).
    const AXES: [[f64; 4]; 3] = [[0.0, -1.0, 0.0, 0.1], [0.0, 0.0, -1.0, -0.2], [1.0, 0.0, 0.0, 0.3]];

    fn close(a: [f32; 3], b: [f32; 3]) -> bool {
        a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-5)
    }

    #[test]
    fn directions_are_as_documented() {
        let lidar_to_camera = Transform::from_rows(AXES).unwrap();
        assert_eq!(lidar_to_camera.rows(), AXES);
        // 5 m ahead, 1 m to the left, 2 m up.
        assert_eq!(lidar_to_camera.apply([5.0, 1.0, 2.0]), [-0.9, -2.2, 5.3]);
        assert!(close(lidar_to_camera.inverse().apply([-0.9, -2.2, 5.3]), [5.0, 1.0, 2.0]));
        let half = std::f64::consts::FRAC_1_SQRT_2;
        // A quarter turn about z takes x to y.
        let turn = Transform::from_quaternion([0.0, 0.0, half, half], [1.0, 0.0, 0.0]).unwrap();
        assert!(close(turn.apply([1.0, 0.0, 0.0]), [1.0, 1.0, 0.0]));
        let both = turn.then(&lidar_to_camera);
        let point = [0.4, -2.0, 1.5];
        assert!(close(both.apply(point), lidar_to_camera.apply(turn.apply(point))));
        assert!(close(both.then(&both.inverse()).apply(point), point));
        assert_eq!(Transform::default().apply(point), point);
    }

    #[test]
    fn rounded_matrices_become_rotations() {
        // The rotation of a KITTI calibration with three decimals.
        let rounded =
            [[0.008, -1.0, -0.004, 0.0], [-0.006, 0.004, -1.0, -0.076], [1.0, 0.008, -0.006, -0.272]];
        let transform = Transform::from_rows(rounded).unwrap();
        let back = transform.then(&transform.inverse());
        assert!(close(back.apply([10.0, 20.0, 30.0]), [10.0, 20.0, 30.0]));
        let r = transform.rows();
        assert!(r.iter().flatten().zip(rounded.iter().flatten()).all(|(a, b)| (a - b).abs() < 5e-3), "{r:?}");
        let long = Transform::from_quaternion([0.0, 0.0, 0.0, 1.005], [0.0; 3]).unwrap();
        assert_eq!(long, Transform::identity());
    }

    #[test]
    fn what_is_no_rigid_motion_is_refused() {
        let bad = |change: fn(&mut [[f64; 4]; 3])| {
            let mut rows = AXES;
            change(&mut rows);
            Transform::from_rows(rows).unwrap_err().to_string()
        };
        assert!(bad(|m| m[0][1] = -1.01).contains("orthonormal"));
        assert!(bad(|m| m[0][0] = 0.1).contains("orthonormal"));
        assert!(bad(|m| m[0][1] = f64::NAN).contains("orthonormal"));
        assert!(bad(|m| m[0][1] = 1.0).contains("mirror"));
        assert!(bad(|m| *m = [[0.0; 4]; 3]).contains("orthonormal"));
        for t in [f64::NAN, f64::INFINITY, 1e9] {
            let mut rows = AXES;
            rows[1][3] = t;
            assert!(Transform::from_rows(rows).unwrap_err().to_string().contains("translation"));
            assert!(Transform::from_quaternion([0.0, 0.0, 0.0, 1.0], [t, 0.0, 0.0]).is_err());
        }
        for q in [[0.0; 4], [0.0, 0.0, 0.0, 1.02], [f64::NAN, 0.0, 0.0, 1.0], [f64::MAX; 4]] {
            assert!(matches!(
                Transform::from_quaternion(q, [0.0; 3]),
                Err(Error::Argument { name: "quaternion", .. })
            ));
        }
    }
}
