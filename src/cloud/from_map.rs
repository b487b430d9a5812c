//! The points of a completed map.

use image::RgbImage;

use super::points::PointCloud;
use crate::depth::{Camera, DepthMap, normals};
use crate::error::{Error, Result};

/// Which points of a map are taken, and what is added to them. The default takes every valid pixel and adds no normals.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct CloudOptions {
    min_confidence: f32,
    max_expected_error: Option<f32>,
    normals: Option<usize>,
}

impl CloudOptions {
    /// Leaves out pixels with a lower confidence, 0 to 1.
    pub fn with_min_confidence(mut self, confidence: f32) -> Self {
        self.min_confidence = confidence;
        self
    }

    /// Leaves out pixels with a larger expected error, metres.
    pub fn with_max_expected_error(mut self, metres: f32) -> Self {
        self.max_expected_error = Some(metres);
        self
    }

    /// Adds [`normals`] with windows of this radius.
    pub fn with_normals(mut self, radius: usize) -> Self {
        self.normals = Some(radius);
        self
    }

    fn check(&self) -> Result<()> {
        if !(0.0..=1.0).contains(&self.min_confidence) {
            return Err(Error::argument("min confidence", self.min_confidence, "a number from 0 to 1"));
        }
        match self.max_expected_error {
            Some(metres) if metres.is_nan() || metres < 0.0 => {
                Err(Error::argument("max expected error", metres, "at least 0 m"))
            }
            _ => Ok(()),
        }
    }
}

impl PointCloud {
    /// The valid pixels of a map as points of the camera's frame (x right, y down, z forward), row by row, with their confidence
    /// and, from a picture of the same size, their colour. Pixels without a ray ([`Camera::ray`]) are left out.
    ///
    /// # Errors
    /// [`Error::SizeMismatch`] for a picture of another size; [`Error::Argument`] for options out of range and for a camera with
    /// pictures of another size.
    pub fn from_map(
        map: &DepthMap,
        rgb: Option<&RgbImage>,
        camera: &Camera,
        options: &CloudOptions,
    ) -> Result<Self> {
        options.check()?;
        camera.require_size("camera", "the size of the map", (map.width(), map.height()))?;
        let (width, height) = (map.width(), map.height());
        if let Some(rgb) = rgb
            && (rgb.width() as usize, rgb.height() as usize) != (width, height)
        {
            let rgb = (rgb.width() as usize, rgb.height() as usize);
            return Err(Error::SizeMismatch { rgb, depth: (width, height) });
        }
        let all_normals = options.normals.map(|radius| normals(map, camera, radius)).transpose()?;
        let wanted = |i: usize| {
            let sure = map.confidence()[i] >= options.min_confidence;
            let close = options.max_expected_error.is_none_or(|most| map.expected_error()[i] <= most);
            !map.depth()[i].is_nan() && sure && close
        };
        let point = |i: usize| {
            let ray = camera.ray((i % width) as f32, (i / width) as f32)?;
            Some((i, ray.map(|part| part * map.depth()[i])))
        };
        let (taken, points): (Vec<usize>, Vec<[f32; 3]>) =
            (0..width * height).filter(|&i| wanted(i)).filter_map(point).unzip();
        let colour = |rgb: &RgbImage, i: usize| rgb.get_pixel((i % width) as u32, (i / width) as u32).0;
        Ok(Self {
            points,
            colours: rgb.map(|rgb| taken.iter().map(|&i| colour(rgb, i)).collect()),
            normals: all_normals.map(|all| taken.iter().map(|&i| all[i]).collect()),
            confidence: Some(taken.iter().map(|&i| map.confidence()[i]).collect()),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::depth::{Distortion, Intrinsics};
    use image::Rgb;

    fn camera() -> Camera {
        let intrinsics = Intrinsics { fx: 2.0, fy: 4.0, cx: 1.0, cy: 0.0 };
        Camera::new(3, 2, intrinsics, Distortion::None).unwrap()
    }

    fn map() -> DepthMap {
        let depth = vec![1.0, 2.0, f32::NAN, 4.0, 5.0, 6.0];
        let confidence = vec![0.9, 0.2, 0.0, 0.5, 1.0, 0.6];
        DepthMap::new(3, 2, depth, confidence, vec![0.1, 0.2, 0.3, 0.4, 0.5, 0.6], vec![false; 6]).unwrap()
    }

    #[test]
    fn points_stand_on_their_rays_with_their_colours() {
        let rgb = RgbImage::from_fn(3, 2, |x, y| Rgb([x as u8, y as u8, 7]));
        let all = PointCloud::from_map(&map(), Some(&rgb), &camera(), &CloudOptions::default()).unwrap();
        let points = [[-0.5, 0.0, 1.0], [0.0, 0.0, 2.0], [-2.0, 1.0, 4.0], [0.0, 1.25, 5.0], [3.0, 1.5, 6.0]];
        assert_eq!(all.points, points);
        assert_eq!(all.colours.unwrap(), [[0, 0, 7], [1, 0, 7], [0, 1, 7], [1, 1, 7], [2, 1, 7]]);
        assert_eq!(all.confidence.unwrap(), [0.9, 0.2, 0.5, 1.0, 0.6]);
        assert!(all.normals.is_none());
        let sure = CloudOptions::default().with_min_confidence(0.5);
        let sure = PointCloud::from_map(&map(), None, &camera(), &sure).unwrap();
        assert_eq!(
            (sure.points, sure.colours),
            ([points[0], points[2], points[3], points[4]].to_vec(), None)
        );
        let close =
            CloudOptions::default().with_min_confidence(0.3).with_max_expected_error(0.4).with_normals(2);
        let close = PointCloud::from_map(&map(), None, &camera(), &close).unwrap();
        assert_eq!(close.points, [points[0], points[2]]);
        assert_eq!(close.normals.unwrap().len(), 2);
    }

    #[test]
    fn other_sizes_and_thresholds_are_refused() {
        let refused = |rgb: Option<&RgbImage>, camera: &Camera, options: CloudOptions| {
            PointCloud::from_map(&map(), rgb, camera, &options).unwrap_err()
        };
        let turned = RgbImage::new(2, 3);
        let plain = CloudOptions::default();
        assert!(matches!(refused(Some(&turned), &camera(), plain), Error::SizeMismatch { .. }));
        let other = Camera::new(2, 3, camera().intrinsics(), Distortion::None).unwrap();
        for error in [
            refused(None, &other, plain),
            refused(None, &camera(), plain.with_min_confidence(1.5)),
            refused(None, &camera(), plain.with_min_confidence(f32::NAN)),
            refused(None, &camera(), plain.with_max_expected_error(-1.0)),
            refused(None, &camera(), plain.with_normals(0)),
        ] {
            assert!(matches!(error, Error::Argument { .. }), "{error}");
        }
    }
}
