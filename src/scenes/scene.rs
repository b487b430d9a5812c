//! One procedural scene, seen from many places.

use super::camera::Camera;
use super::frame::metres;
use super::space::to_world;
use super::stage::Stage;
use super::{RgbdFrame, cast, furnished_stage, picture, scale};
use crate::depth::{Intrinsics, Transform};
use crate::error::Result;

/// A scene of [`super::procedural`] whose camera can be moved. Nothing else in it moves, and the light stays; the camera's exposure follows what
/// it sees, as it does in [`super::procedural`].
#[derive(Clone, Debug)]
pub struct Scene {
    /// Before the first picture, so that all pictures draw the same numbers.
    stage: Stage,
    scale: f32,
    size: (usize, usize),
}

impl Scene {
    /// The scene of this seed and size.
    ///
    /// # Errors
    /// As [`super::procedural`].
    pub fn procedural(seed: u64, width: usize, height: usize) -> Result<Self> {
        let (stage, hits) = furnished_stage(seed, width, height)?;
        let mut drawn = stage.clone();
        picture(&mut drawn, &hits, width, height);
        Ok(Self { scale: scale(&mut drawn), stage, size: (width, height) })
    }

    /// The camera.
    pub fn intrinsics(&self) -> Intrinsics {
        self.stage.camera.k
    }

    /// What the camera sees from `pose`, metres: its place and attitude in the axes of the scene's first camera (x right, y down, z
    /// forward). The identity gives the frame of [`super::procedural`], bit for bit.
    pub fn render(&self, pose: &Transform) -> RgbdFrame {
        let (width, height) = self.size;
        let mut stage = self.stage.clone();
        if *pose != Transform::identity() {
            let first = &self.stage.camera;
            let rows = pose.rows();
            let axis = |k: usize| to_world(&first.axes, [0, 1, 2].map(|i| rows[i][k] as f32));
            let moved = to_world(&first.axes, [0, 1, 2].map(|i| rows[i][3] as f32 / self.scale));
            let at = [0, 1, 2].map(|i| first.at[i] + moved[i]);
            stage.camera = Camera { k: first.k, at, axes: [axis(0), axis(1), axis(2)] };
        }
        let hits = cast::cast(&stage.solids, &stage.camera, width, height);
        let rgb = picture(&mut stage, &hits, width, height);
        RgbdFrame { rgb, depth: metres(&hits.depth, self.scale), intrinsics: stage.camera.k, glass: None }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::depth::Distortion;
    use crate::scenes::procedural;

    #[test]
    fn the_first_camera_sees_the_procedural_frame() {
        for seed in 0..6 {
            let (still, frame) =
                (procedural(seed, 64, 48).unwrap(), Scene::procedural(seed, 64, 48).unwrap());
            let frame = frame.render(&Transform::identity());
            assert_eq!(frame.rgb, still.rgb);
            assert!(frame.depth.iter().zip(&still.depth).all(|(a, b)| a.to_bits() == b.to_bits()));
            assert_eq!(frame.intrinsics, still.intrinsics);
        }
    }

    #[test]
    fn a_moved_camera_sees_the_same_surfaces_where_its_pose_says() {
        let pose = Transform::from_quaternion([0.02, -0.05, 0.01, 0.9985], [0.06, -0.03, 0.05]).unwrap();
        for seed in [1, 4, 9] {
            let scene = Scene::procedural(seed, 96, 72).unwrap();
            let (a, b) = (scene.render(&Transform::identity()), scene.render(&pose));
            let camera = crate::depth::Camera::new(96, 72, scene.intrinsics(), Distortion::None).unwrap();
            let back = pose.inverse();
            let (mut seen, mut same) = (0, 0);
            for (i, &d) in a.depth.iter().enumerate().filter(|(_, d)| !d.is_nan()) {
                let ray = camera.ray((i % 96) as f32, (i / 96) as f32).unwrap();
                let moved = back.apply(ray.map(|c| c * d));
                if let Some((x, y)) = camera.pixel(moved) {
                    seen += 1;
                    // Half a pixel beside its place a slanted surface has another depth.
                    same += usize::from((b.depth[y * 96 + x] / moved[2] - 1.0).abs() < 0.03);
                }
            }
            assert!(seen > 3000 && same * 100 > seen * 80, "{same} of {seen} in scene {seed}");
            assert_ne!(a.rgb, b.rgb);
        }
    }
}
