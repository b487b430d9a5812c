//! `sensor_msgs/Image`: colour and depth.

use crate::depth::pixels::{pixel_count, rows};
use crate::depth::{DepthMap, DepthScale, Saturation, SparseDepth};
use crate::error::{Error, Result};
use crate::image::{PixelEncoding, decode_rgb};
use image::RgbImage;

/// A picture of `height` rows, each of `step` bytes.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Image {
    /// Rows.
    pub height: u32,
    /// Columns.
    pub width: u32,
    /// How a pixel is stored, by its name in `sensor_msgs/image_encodings.hpp`.
    pub encoding: String,
    /// Not 0 where the upper byte of a number comes first.
    pub is_bigendian: u8,
    /// Bytes from the beginning of a row to that of the next.
    pub step: u32,
    /// `step * height` bytes; the last row need not be padded.
    pub data: Vec<u8>,
}

impl Image {
    /// The picture in 8-bit RGB; [`PixelEncoding`] lists what is read.
    ///
    /// # Errors
    /// [`Error::Argument`] for another encoding, otherwise as [`decode_rgb`].
    pub fn to_rgb(&self) -> Result<RgbImage> {
        let encoding = match self.encoding.parse()? {
            PixelEncoding::Mono16 if self.is_bigendian != 0 => PixelEncoding::Mono16BigEndian,
            encoding => encoding,
        };
        decode_rgb(&self.data, self.width as usize, self.height as usize, self.step as usize, encoding)
    }

    /// Depth: `32FC1` holds metres, `16UC1` units of `scale`. Without one these are millimetres, as REP 118 lays down, and `mono16`, which says
    /// nothing of depth, is read with a scale alone. 0, NaN, infinite and negative values are missing.
    ///
    /// # Errors
    /// [`Error::Argument`] for another encoding and a step below a row's bytes, [`Error::BufferLength`] for data that end before the last
    /// row does, otherwise as [`SparseDepth::new`].
    pub fn to_depth(&self, scale: Option<DepthScale>) -> Result<SparseDepth> {
        let big = self.is_bigendian != 0;
        match (&self.encoding[..], scale) {
            ("32FC1", _) => {
                self.depth(|bytes| if big { f32::from_be_bytes(bytes) } else { f32::from_le_bytes(bytes) })
            }
            ("16UC1", _) | ("mono16", Some(_)) => {
                let scale = scale.unwrap_or(DepthScale::millimetres());
                let stored = |bytes| if big { u16::from_be_bytes(bytes) } else { u16::from_le_bytes(bytes) };
                self.depth(|bytes| scale.metres(stored(bytes)))
            }
            (other, _) => {
                let expected = "16UC1 or 32FC1, or mono16 with a depth scale";
                Err(Error::argument("depth encoding", format!("{other:?}"), expected))
            }
        }
    }

    /// Numbers of `N` bytes each.
    fn depth<const N: usize>(&self, metres: impl Fn([u8; N]) -> f32) -> Result<SparseDepth> {
        let (width, height) = (self.width as usize, self.height as usize);
        let pixels = pixel_count(width, height)?;
        let rows = rows("depth image", &self.data, width * N, height, self.step as usize)?;
        let mut depth = Vec::with_capacity(pixels);
        rows.for_each(|row| depth.extend(row.as_chunks::<N>().0.iter().map(|&bytes| metres(bytes))));
        SparseDepth::new(width, height, depth)
    }

    /// A picture as `rgb8`.
    pub fn from_rgb(rgb: &RgbImage) -> Self {
        Self {
            height: rgb.height(),
            width: rgb.width(),
            encoding: "rgb8".to_string(),
            is_bigendian: 0,
            step: rgb.width().saturating_mul(3),
            data: rgb.as_raw().clone(),
        }
    }

    /// A map as `32FC1`: metres, NaN where invalid, little-endian.
    pub fn from_depth(map: &DepthMap) -> Self {
        let data = map.depth().iter().flat_map(|d| d.to_le_bytes()).collect();
        Self::little_endian("32FC1", map, 4, data)
    }

    /// A map as `16UC1` in units of `scale`, 0 where invalid, little-endian; REP 118 lays down millimetres. Also says how many pixels are too
    /// far for it.
    pub fn from_depth_u16(map: &DepthMap, scale: DepthScale) -> (Self, Saturation) {
        let (stored, saturation) = map.stored(scale);
        let data = stored.into_iter().flat_map(u16::to_le_bytes).collect();
        (Self::little_endian("16UC1", map, 2, data), saturation)
    }

    fn little_endian(encoding: &str, map: &DepthMap, bytes: u32, data: Vec<u8>) -> Self {
        // Sizes of a map are at most 2^28.
        let (width, height) = (map.width() as u32, map.height() as u32);
        let step = width.saturating_mul(bytes);
        Self { height, width, encoding: encoding.to_string(), is_bigendian: 0, step, data }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn image(encoding: &str, big: bool, step: u32, data: Vec<u8>) -> Image {
        let is_bigendian = u8::from(big);
        Image { height: 2, width: 2, encoding: encoding.into(), is_bigendian, step, data }
    }

    #[test]
    fn depth_of_every_kind() {
        let expected = [(0, 0, 1.5), (0, 1, 0.25)];
        for big in [false, true] {
            let u16s = |values: [u16; 6]| {
                values.iter().flat_map(|v| if big { v.to_be_bytes() } else { v.to_le_bytes() }).collect()
            };
            let f32s = |values: [f32; 5]| {
                values.iter().flat_map(|v| if big { v.to_be_bytes() } else { v.to_le_bytes() }).collect()
            };
            let points = |image: Image, scale| image.to_depth(scale).unwrap().points().collect::<Vec<_>>();
            // One pixel of padding between the rows.
            let mm = image("16UC1", big, 6, u16s([1500, 0, 7, 250, 0, 7]));
            assert_eq!(points(mm.clone(), None), expected);
            let kitti = image("mono16", big, 6, u16s([384, 0, 7, 64, 0, 7]));
            assert_eq!(points(kitti.clone(), Some(DepthScale::kitti())), expected);
            assert!(matches!(kitti.to_depth(None), Err(Error::Argument { name: "depth encoding", .. })));
            let metres = image("32FC1", big, 12, f32s([1.5, f32::NAN, 7.0, 0.25, f32::INFINITY]));
            assert_eq!(points(metres, None), expected);
        }
        let float = image("32FC1", false, 8, 2e4f32.to_le_bytes().repeat(4));
        assert!(matches!(float.to_depth(None), Err(Error::DepthRange { .. })));
    }

    #[test]
    fn grey_of_sixteen_bits_follows_its_byte_order() {
        let grey = |big| image("mono16", big, 4, vec![1, 9, 2, 9, 3, 9, 4, 9]).to_rgb().unwrap();
        assert_eq!(grey(false).as_raw()[..], [9; 12]);
        assert_eq!(grey(true).as_raw()[..], [1, 1, 1, 2, 2, 2, 3, 3, 3, 4, 4, 4]);
    }

    #[test]
    fn wrong_images_are_refused() {
        let bad = |encoding: &str, step, bytes| image(encoding, false, step, vec![0; bytes]);
        assert!(matches!(bad("16UC1", 3, 8).to_depth(None), Err(Error::Argument { name: "stride", .. })));
        assert!(matches!(bad("16UC1", 4, 7).to_depth(None), Err(Error::BufferLength { .. })));
        assert!(matches!(bad("32FC1", 0, 16).to_depth(None), Err(Error::Argument { .. })));
        assert!(bad("64FC1", 16, 32).to_depth(None).unwrap_err().to_string().contains("64FC1"));
        assert!(bad("32FC1", 8, 16).to_rgb().unwrap_err().to_string().contains("rgb8"));
        assert!(matches!(bad("rgb8", 6, 11).to_rgb(), Err(Error::BufferLength { .. })));
        assert!(matches!(bad("rgb8", 5, 12).to_rgb(), Err(Error::Argument { .. })));
        let (height, width) = (u32::MAX, u32::MAX);
        let huge = Image { height, width, step: u32::MAX, ..bad("16UC1", 4, 8) };
        assert!(matches!(huge.to_depth(None), Err(Error::ImageSize { .. })));
        assert!(matches!(Image { encoding: "bgr8".into(), ..huge }.to_rgb(), Err(Error::ImageSize { .. })));
        assert!(matches!(
            Image { height: 0, ..bad("16UC1", 4, 8) }.to_depth(None),
            Err(Error::ImageSize { .. })
        ));
        assert!(Image::default().to_rgb().is_err());
    }

    #[test]
    fn what_goes_out_comes_back() {
        let rgb = RgbImage::from_fn(5, 3, |x, y| image::Rgb([x as u8, y as u8, 77]));
        let message = Image::from_rgb(&rgb);
        assert_eq!((message.step, &message.encoding[..]), (15, "rgb8"));
        assert_eq!(message.to_rgb().unwrap(), rgb);

        let depth = vec![1.2341, f32::NAN, 70.0, 0.5];
        let map = DepthMap::new(2, 2, depth.clone(), vec![0.5; 4], vec![0.1; 4], vec![false; 4]).unwrap();
        let float = Image::from_depth(&map).to_depth(None).unwrap();
        assert!(float.as_slice().iter().zip(&depth).all(|(a, b)| a.to_bits() == b.to_bits()));
        let (message, saturation) = Image::from_depth_u16(&map, DepthScale::millimetres());
        assert_eq!((saturation.pixels, message.step), (1, 4));
        let back = message.to_depth(None).unwrap();
        assert_eq!(back.points().collect::<Vec<_>>(), [(0, 0, 1.234), (0, 1, 65.535), (1, 1, 0.5)]);
    }
}
