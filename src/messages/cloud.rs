//! `sensor_msgs/PointCloud2`: points with fields at offsets.

use crate::depth::{Camera, DepthMap};
use crate::error::{Error, Result};
use image::RgbImage;

/// Where a number of each point stands.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct PointField {
    /// `x`, `y`, `z`, `rgb`, `intensity`, ..
    pub name: String,
    /// First byte, from the point's first.
    pub offset: u32,
    /// What kind of number: [`PointField::FLOAT32`], [`PointField::FLOAT64`] or one of the integers, 1 to 6.
    pub datatype: u8,
    /// How many numbers.
    pub count: u32,
}

impl PointField {
    /// `datatype` of 32-bit floats.
    pub const FLOAT32: u8 = 7;
    /// `datatype` of 64-bit floats.
    pub const FLOAT64: u8 = 8;

    /// One 32-bit float.
    pub fn float32(name: &str, offset: u32) -> Self {
        Self { name: name.to_string(), offset, datatype: Self::FLOAT32, count: 1 }
    }
}

/// `height` rows of `width` points; a cloud without order has one row.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct PointCloud2 {
    /// Rows.
    pub height: u32,
    /// Points in a row.
    pub width: u32,
    /// What stands in a point.
    pub fields: Vec<PointField>,
    /// Whether the upper byte of a number comes first.
    pub is_bigendian: bool,
    /// Bytes of a point.
    pub point_step: u32,
    /// Bytes from the beginning of a row to that of the next.
    pub row_step: u32,
    /// `row_step * height` bytes.
    pub data: Vec<u8>,
    /// Whether all points are finite.
    pub is_dense: bool,
}

/// A coordinate: where it stands and how it is stored.
#[derive(Clone, Copy)]
struct Coordinate {
    offset: usize,
    wide: bool,
    big: bool,
}

impl Coordinate {
    /// NaN beyond the point's end, which [`PointCloud2::coordinate`] has excluded.
    fn of(self, point: &[u8]) -> f32 {
        let bytes = point.get(self.offset..).unwrap_or_default();
        match (self.wide, bytes.first_chunk::<8>(), bytes.first_chunk::<4>()) {
            (true, Some(&b), _) if self.big => f64::from_be_bytes(b) as f32,
            (true, Some(&b), _) => f64::from_le_bytes(b) as f32,
            (false, _, Some(&b)) if self.big => f32::from_be_bytes(b),
            (false, _, Some(&b)) => f32::from_le_bytes(b),
            _ => f32::NAN,
        }
    }
}

impl PointCloud2 {
    /// The points, metres, in the cloud's own axes: the fields `x`, `y` and `z`, 32-bit or 64-bit floats at any offsets, in either byte order.
    /// Points that are NaN are handed on; [`SparseDepth::from_cloud`](crate::SparseDepth::from_cloud) counts them. An empty cloud has no points.
    ///
    /// # Errors
    /// [`Error::Argument`] for a coordinate that is missing, of another type, or outside of the point, and for a `row_step` below a row's points;
    /// [`Error::BufferLength`] for data that end before the last point does.
    pub fn points(&self) -> Result<Vec<[f32; 3]>> {
        let (width, height) = (u64::from(self.width), u64::from(self.height));
        if width == 0 || height == 0 {
            return Ok(Vec::new());
        }
        let coordinates = [self.coordinate("x")?, self.coordinate("y")?, self.coordinate("z")?];
        let (step, row_step) = (u64::from(self.point_step), u64::from(self.row_step));
        // Two numbers of 32 bits each: none of the products is too large for 64.
        let row = width * step;
        if height > 1 && row_step < row {
            let expected = format!("at least the {row} bytes of {width} points of {step}");
            return Err(Error::argument("row_step", row_step, expected));
        }
        let needed = ((height - 1) * row_step).saturating_add(row);
        if (self.data.len() as u64) < needed {
            let expected = usize::try_from(needed).unwrap_or(usize::MAX);
            return Err(Error::BufferLength { what: "point cloud", expected, found: self.data.len() });
        }
        let rows = self.data.chunks((if height > 1 { row_step } else { row }) as usize).take(height as usize);
        let points = rows.flat_map(|line| line.chunks_exact(step as usize).take(width as usize));
        Ok(points.map(|point| coordinates.map(|c| c.of(point))).collect())
    }

    fn coordinate(&self, name: &str) -> Result<Coordinate> {
        let Some(field) = self.fields.iter().find(|field| field.name == name) else {
            let names: Vec<&str> = self.fields.iter().map(|field| &field.name[..]).collect();
            return Err(Error::argument(
                "fields",
                format!("{names:?}"),
                format!("one named {name}, with x, y and z"),
            ));
        };
        let bytes = match field.datatype {
            PointField::FLOAT32 => 4,
            PointField::FLOAT64 => 8,
            other => {
                let expected = "FLOAT32 (7) or FLOAT64 (8)";
                return Err(Error::argument("datatype", format!("{other} of {name}"), expected));
            }
        };
        // Some drivers leave the count at 0.
        if field.count > 1 {
            return Err(Error::argument("count", format!("{} of {name}", field.count), "1"));
        }
        if field.offset.checked_add(bytes).is_none_or(|end| end > self.point_step) {
            let expected = format!("{bytes} bytes within the point_step of {}", self.point_step);
            return Err(Error::argument("offset", format!("{} of {name}", field.offset), expected));
        }
        Ok(Coordinate { offset: field.offset as usize, wide: bytes == 8, big: self.is_bigendian })
    }

    /// The valid pixels of a map as points in the camera's axes (x right, y down, z forward), metres, row by row, without those whose confidence
    /// is below `min_confidence` or where the lens model has no ray.
    ///
    /// Fields are `x`, `y`, `z`, with a picture `rgb`, and `confidence`, all FLOAT32 and little-endian. As PCL and rviz expect it, `rgb` holds the
    /// bits 0x00RRGGBB.
    ///
    /// # Errors
    /// [`Error::Argument`] unless the map has the size of `camera`, and for a confidence outside of 0..=1; [`Error::SizeMismatch`] for a picture of
    /// another size.
    pub fn from_depth(
        map: &DepthMap,
        camera: &Camera,
        rgb: Option<&RgbImage>,
        min_confidence: f32,
    ) -> Result<Self> {
        let (width, height) = (map.width(), map.height());
        if (camera.width(), camera.height()) != (width, height) {
            let found = format!("{}x{}", camera.width(), camera.height());
            return Err(Error::argument("camera", found, format!("the size of the map, {width}x{height}")));
        }
        if let Some(rgb) = rgb.filter(|rgb| (rgb.width() as usize, rgb.height() as usize) != (width, height))
        {
            let rgb = (rgb.width() as usize, rgb.height() as usize);
            return Err(Error::SizeMismatch { rgb, depth: (width, height) });
        }
        if !(0.0..=1.0).contains(&min_confidence) {
            return Err(Error::argument("min_confidence", min_confidence, "a value in 0..=1"));
        }
        let names = ["x", "y", "z"].into_iter().chain(rgb.map(|_| "rgb")).chain(["confidence"]);
        let fields: Vec<PointField> =
            names.zip(0..).map(|(name, i)| PointField::float32(name, 4 * i)).collect();
        let point_step = 4 * fields.len() as u32;
        let mut data = Vec::new();
        let values = map.depth().iter().zip(map.confidence()).enumerate();
        for (pixel, (&depth, &confidence)) in
            values.filter(|(_, (d, c))| !d.is_nan() && **c >= min_confidence)
        {
            let (x, y) = (pixel % width, pixel / width);
            let Some(ray) = camera.ray(x as f32, y as f32) else { continue };
            ray.iter().for_each(|c| data.extend((c * depth).to_le_bytes()));
            if let Some(rgb) = rgb {
                let [r, g, b] = rgb.get_pixel(x as u32, y as u32).0;
                data.extend([b, g, r, 0]);
            }
            data.extend(confidence.to_le_bytes());
        }
        // A map has at most 2^28 pixels; of so many, one row's bytes are not a number of 32 bits.
        let row_step = u32::try_from(data.len()).map_err(|_| Error::ImageSize {
            width,
            height,
            reason: "expected fewer points than fill 4 GiB".to_string(),
        })?;
        let width = row_step / point_step;
        Ok(Self { height: 1, width, fields, is_bigendian: false, point_step, row_step, data, is_dense: true })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::depth::{Distortion, Intrinsics};

    const POINTS: [[f32; 3]; 4] =
        [[1.0, 2.0, 3.0], [-4.5, 0.25, 9.0], [f32::NAN, 0.0, 0.0], [7.0, 8.0, -1.0]];

    /// Two rows of two points with y before x and four bytes after each row.
    fn cloud(wide: bool, big: bool) -> PointCloud2 {
        let size = if wide { 8 } else { 4 };
        let number = |v: f32| match (wide, big) {
            (true, true) => f64::from(v).to_be_bytes().to_vec(),
            (true, false) => f64::from(v).to_le_bytes().to_vec(),
            (false, true) => v.to_be_bytes().to_vec(),
            (false, false) => v.to_le_bytes().to_vec(),
        };
        let datatype = if wide { PointField::FLOAT64 } else { PointField::FLOAT32 };
        let field = |name: &str, offset| PointField { name: name.into(), offset, datatype, count: 1 };
        let intensity = PointField { name: "intensity".into(), offset: 0, datatype: 2, count: 1 };
        let mut data = Vec::new();
        for row in POINTS.chunks(2) {
            for [x, y, z] in row {
                data.push(77);
                [y, x, z].iter().for_each(|v| data.extend(number(**v)));
            }
            data.extend([1, 2, 3, 4]);
        }
        let point_step = 1 + 3 * size;
        let fields = vec![intensity, field("y", 1), field("x", 1 + size), field("z", 1 + 2 * size)];
        PointCloud2 {
            height: 2,
            width: 2,
            fields,
            is_bigendian: big,
            point_step,
            row_step: 2 * point_step + 4,
            data,
            is_dense: false,
        }
    }

    #[test]
    fn points_of_every_layout() {
        for (wide, big) in [(false, false), (false, true), (true, false), (true, true)] {
            let points = cloud(wide, big).points().unwrap();
            assert_eq!(format!("{points:?}"), format!("{POINTS:?}"));
        }
        let mut exact = cloud(false, false);
        exact.data.truncate(exact.data.len() - 4);
        assert_eq!(exact.points().unwrap().len(), 4);
        assert_eq!(PointCloud2::default().points().unwrap(), Vec::<[f32; 3]>::new());
    }

    #[test]
    fn wrong_clouds_are_refused() {
        let bad = |change: fn(&mut PointCloud2)| {
            let mut cloud = cloud(false, false);
            change(&mut cloud);
            cloud.points().unwrap_err()
        };
        let argument = |name: &str, change| match bad(change) {
            Error::Argument { name: found, .. } => assert_eq!(found, name),
            other => panic!("{other}"),
        };
        argument("fields", |c| c.fields[3].name = "w".into());
        argument("datatype", |c| c.fields[1].datatype = 5);
        argument("count", |c| c.fields[1].count = 3);
        argument("offset", |c| c.fields[1].offset = 10);
        argument("offset", |c| c.fields[1].offset = u32::MAX);
        argument("offset", |c| c.point_step = 0);
        argument("row_step", |c| c.row_step = 25);
        argument("row_step", |c| c.width = u32::MAX);
        let short = bad(|c| c.data.truncate(c.data.len() - 5));
        assert!(matches!(short, Error::BufferLength { expected: 56, found: 55, .. }));
        assert!(matches!(bad(|c| c.height = u32::MAX), Error::BufferLength { .. }));
        let huge = bad(|c| (c.height, c.width) = (1, u32::MAX));
        assert!(matches!(huge, Error::BufferLength { .. }));
    }

    fn map() -> (DepthMap, Camera) {
        let k = Intrinsics { fx: 2.0, fy: 4.0, cx: 1.0, cy: 0.0 };
        let depth = vec![1.0, 2.0, f32::NAN, 4.0];
        let map = DepthMap::new(2, 2, depth, vec![0.9, 0.4, 0.9, 0.5], vec![0.1; 4], vec![false; 4]).unwrap();
        (map, Camera::new(2, 2, k, Distortion::None).unwrap())
    }

    #[test]
    fn maps_become_clouds() {
        let (map, camera) = map();
        let plain = PointCloud2::from_depth(&map, &camera, None, 0.0).unwrap();
        assert_eq!((plain.height, plain.width, plain.point_step), (1, 3, 16));
        assert_eq!(plain.points().unwrap(), [[-0.5, 0.0, 1.0], [0.0, 0.0, 2.0], [0.0, 1.0, 4.0]]);

        let rgb = RgbImage::from_fn(2, 2, |x, y| image::Rgb([10 + x as u8, 20 + y as u8, 30]));
        let coloured = PointCloud2::from_depth(&map, &camera, Some(&rgb), 0.5).unwrap();
        assert_eq!((coloured.width, coloured.point_step, coloured.row_step), (2, 20, 40));
        assert_eq!(coloured.points().unwrap(), [[-0.5, 0.0, 1.0], [0.0, 1.0, 4.0]]);
        let names: Vec<_> = coloured.fields.iter().map(|f| (&f.name[..], f.offset)).collect();
        assert_eq!(names, [("x", 0), ("y", 4), ("z", 8), ("rgb", 12), ("confidence", 16)]);
        assert_eq!(coloured.data[32..36], 0x000b_151eu32.to_le_bytes());
        assert_eq!(coloured.data[36..40], 0.5f32.to_le_bytes());
        let none = PointCloud2::from_depth(&map, &camera, None, 1.0).unwrap();
        assert_eq!((none.width, none.points().unwrap().len()), (0, 0));
    }

    #[test]
    fn sizes_of_map_camera_and_picture_agree() {
        let (map, camera) = map();
        let other = Camera::new(3, 2, camera.intrinsics(), Distortion::None).unwrap();
        let wrong = PointCloud2::from_depth(&map, &other, None, 0.0);
        assert!(matches!(wrong, Err(Error::Argument { name: "camera", .. })));
        let wrong = PointCloud2::from_depth(&map, &camera, Some(&RgbImage::new(2, 3)), 0.0);
        assert!(matches!(wrong, Err(Error::SizeMismatch { rgb: (2, 3), depth: (2, 2) })));
        for confidence in [-0.1, 1.5, f32::NAN] {
            let wrong = PointCloud2::from_depth(&map, &camera, None, confidence);
            assert!(matches!(wrong, Err(Error::Argument { name: "min_confidence", .. })));
        }
    }
}
