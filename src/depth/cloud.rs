//! Measurements of another sensor, brought into the camera's picture.

use super::camera::{Camera, Transform};
use super::hidden::Visibility;
use super::pixels::pixel_count;
use super::sparse::SparseDepth;
use crate::error::{Error, Result};
use rayon::prelude::*;

/// What became of the points of a cloud, or of the pixels of a depth camera. All but [`ProjectionReport::points`] add up to it.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct ProjectionReport {
    /// Points that were given; of a depth image, its measured pixels.
    pub points: usize,
    /// Points that became a measurement.
    pub measured: usize,
    /// Coordinates that are NaN or infinite: in most clouds, rays that did not come back.
    pub not_finite: usize,
    /// Behind the camera, or in its plane.
    pub behind: usize,
    /// Before the camera and outside of its picture, or where a lens model does not hold.
    pub outside: usize,
    /// Another point on the same pixel is nearer.
    pub overdrawn: usize,
    /// Seen through a nearer surface ([`Visibility`]).
    pub hidden: usize,
}

impl std::fmt::Display for ProjectionReport {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Self { points, measured, not_finite, behind, outside, overdrawn, hidden } = self;
        write!(
            f,
            "{measured} of {points} points measure a pixel ({not_finite} not finite, {behind} behind the camera, {outside} outside of \
             the picture, {overdrawn} on a pixel with a nearer one, {hidden} hidden by a surface)"
        )
    }
}

impl SparseDepth {
    /// From a cloud of points, metres, in the axes of the sensor that measured them. `cloud_to_camera` brings them into the camera's
    /// (LiDAR to camera: x right, y down, z forward).
    ///
    /// The map lines up with the picture that `camera` describes: the raw one if it has distortion. On each pixel the nearest point stays, and
    /// of those the ones that `visibility` does not find hidden. What became of the others stands in the report. A cloud that is empty or out
    /// of view gives a map without measurements, which is no error, since on a robot it happens; see [`SparseDepth::require_points`].
    ///
    /// ```
    /// use sdim::depth::{Camera, Distortion, Intrinsics, Transform, Visibility};
    /// use sdim::SparseDepth;
    /// let k = Intrinsics { fx: 300.0, fy: 300.0, cx: 159.5, cy: 119.5 };
    /// let camera = Camera::new(320, 240, k, Distortion::None)?;
    /// // A LiDAR looks along x with z up; it stands 10 cm above the camera.
    /// let lidar_to_camera =
    ///     Transform::from_rows([[0.0, -1.0, 0.0, 0.0], [0.0, 0.0, -1.0, -0.1], [1.0, 0.0, 0.0, 0.0]])?;
    /// let cloud = [[4.0, 0.5, 0.0], [8.0, -1.0, 0.3], [-3.0, 0.0, 0.0]];
    /// let (sparse, report) = SparseDepth::from_cloud(cloud, &camera, &lidar_to_camera, &Visibility::default())?;
    /// assert_eq!((report.measured, report.behind), (2, 1));
    /// assert_eq!(sparse.get(122, 112), Some(4.0));
    /// # Ok::<(), sdim::Error>(())
    /// ```
    ///
    /// # Errors
    /// [`Error::DepthRange`] for a point in view beyond [`SparseDepth::MAX_DEPTH`] (millimetres?); [`Error::Argument`] for a `visibility` out of
    /// range.
    pub fn from_cloud(
        points: impl IntoIterator<Item = [f32; 3]>,
        camera: &Camera,
        cloud_to_camera: &Transform,
        visibility: &Visibility,
    ) -> Result<(Self, ProjectionReport)> {
        let mut view = View::new(camera)?;
        let points: Vec<[f32; 3]> = points.into_iter().collect();
        let places: Vec<Place> =
            points.into_par_iter().map(|point| place(camera, cloud_to_camera.apply(point))).collect();
        places.into_iter().for_each(|place| view.draw(place));
        view.finish(visibility)
    }

    /// A depth camera's map, brought into the picture of a colour camera of another size that stands elsewhere: what depth drivers call
    /// registration or alignment.
    ///
    /// `self` is the depth camera's own picture, `depth_to_colour` the extrinsic calibration. Every measured pixel becomes one measurement:
    /// where the colour picture is finer, the map has gaps and nothing is made up for them; where it is coarser, the nearest stays. Hidden points
    /// and the report are as in [`SparseDepth::from_cloud`].
    ///
    /// # Errors
    /// [`Error::Argument`] unless the map has the size of `depth_camera`, and for a `visibility` out of range; [`Error::DepthRange`].
    pub fn register(
        &self,
        depth_camera: &Camera,
        colour_camera: &Camera,
        depth_to_colour: &Transform,
        visibility: &Visibility,
    ) -> Result<(Self, ProjectionReport)> {
        let (width, height) = (self.width(), self.height());
        depth_camera.require_size("depth camera", "the size of the depth map", (width, height))?;
        let mut view = View::new(colour_camera)?;
        // Lenses take the time, so rows are shared out; the pixels are drawn in their order, whatever the number of threads.
        let row = |y: usize| -> Vec<Place> {
            let line = self.as_slice()[y * width..][..width].iter().enumerate();
            let to = |(x, &depth): (usize, &f32)| match depth_camera.ray(x as f32, y as f32) {
                Some(ray) => place(colour_camera, depth_to_colour.apply(ray.map(|c| c * depth))),
                None => Place::Outside,
            };
            line.filter(|(_, depth)| !depth.is_nan()).map(to).collect()
        };
        let rows: Vec<Vec<Place>> = (0..height).into_par_iter().map(row).collect();
        rows.into_iter().flatten().for_each(|place| view.draw(place));
        view.finish(visibility)
    }

    /// A depth image that sees the same field as the picture with fewer (or more) pixels, as ARKit's 256x192 beside 1920x1440: each of
    /// its pixels becomes a measurement at the pixel under its centre, column `(x + 0.5) * width / own width - 0.5`, rounded. Where several
    /// fall on one, the nearest stays. Nothing is interpolated.
    ///
    /// # Errors
    /// [`Error::ImageSize`]; [`Error::Argument`] unless both have one aspect ratio, within one pixel of the smaller picture: then they do not
    /// see the same field, and [`SparseDepth::register`] with both calibrations is what brings them together.
    pub fn from_low_resolution(depth: &Self, width: usize, height: usize) -> Result<Self> {
        pixel_count(width, height)?;
        let (w, h) = (depth.width(), depth.height());
        let (scale_x, scale_y) = (width as f64 / w as f64, height as f64 / h as f64);
        let off = if scale_x >= 1.0 {
            h as f64 - height as f64 / scale_x
        } else {
            height as f64 - h as f64 * scale_x
        };
        if off.abs() >= 1.0 {
            let rows = (h as f64 * scale_x).round();
            let expected =
                format!("{width}x{rows}, the aspect ratio of the depth image, {w}x{h}; else register it");
            return Err(Error::argument("picture", format!("{width}x{height}"), expected));
        }
        let place = |at: usize, scale: f64, size: usize| {
            let centre = (at as f64 + 0.5) * scale - 0.5;
            (centre.round().max(0.0) as usize).min(size - 1)
        };
        let to = |(x, y, d)| (place(x, scale_x, width), place(y, scale_y, height), d);
        let points: Vec<(usize, usize, f32)> = depth.points().map(to).collect();
        Self::from_points(width, height, &points)
    }
}

/// Where a point is seen: a pixel's index and the Z-depth, or why not.
enum Place {
    At(usize, f32),
    NotFinite,
    Behind,
    Outside,
}

/// Where the camera sees a point in its axes.
fn place(camera: &Camera, point: [f32; 3]) -> Place {
    if point.iter().any(|c| !c.is_finite()) {
        Place::NotFinite
    } else if point[2] <= 0.0 {
        Place::Behind
    } else {
        let pixel = camera.pixel(point);
        pixel.map_or(Place::Outside, |(x, y)| Place::At(y * camera.width() + x, point[2]))
    }
}

/// A picture that points are drawn into, the nearest on each pixel.
struct View<'a> {
    camera: &'a Camera,
    depth: Vec<f32>,
    report: ProjectionReport,
}

impl<'a> View<'a> {
    fn new(camera: &'a Camera) -> Result<Self> {
        let pixels = pixel_count(camera.width(), camera.height())?;
        Ok(Self { camera, depth: vec![f32::NAN; pixels], report: ProjectionReport::default() })
    }

    /// Draws a point, and counts it.
    fn draw(&mut self, place: Place) {
        let report = &mut self.report;
        report.points += 1;
        match place {
            Place::NotFinite => report.not_finite += 1,
            Place::Behind => report.behind += 1,
            Place::Outside => report.outside += 1,
            Place::At(pixel, depth) => {
                let pixel = &mut self.depth[pixel];
                *(if pixel.is_nan() { &mut report.measured } else { &mut report.overdrawn }) += 1;
                *pixel = pixel.min(depth);
            }
        }
    }

    fn finish(mut self, visibility: &Visibility) -> Result<(SparseDepth, ProjectionReport)> {
        visibility.check()?;
        let hidden = visibility.remove_hidden(&mut self.depth, self.camera.width());
        self.report.hidden = hidden;
        self.report.measured -= hidden;
        let sparse = SparseDepth::new(self.camera.width(), self.camera.height(), self.depth)?;
        Ok((sparse, self.report))
    }
}

#[cfg(test)]
#[path = "cloud_tests.rs"]
mod tests;
