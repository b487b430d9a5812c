//! Raw frames of cameras, as drivers hand them over, as 8-bit RGB.

use super::bayer::{Bayer, demosaic};
use crate::depth::pixels::{pixel_count, rows};
use crate::error::{Error, Result};
use image::RgbImage;
use std::str::FromStr;

/// How the bytes of a raw frame are meant. Parses from the names of ROS (`sensor_msgs/image_encodings.hpp`), which the variants state.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PixelEncoding {
    /// `rgb8`.
    Rgb8,
    /// `bgr8`, OpenCV's order.
    Bgr8,
    /// `rgba8`; alpha is dropped.
    Rgba8,
    /// `bgra8`; alpha is dropped.
    Bgra8,
    /// `mono8`: grey, spread to all three.
    Mono8,
    /// `mono16`, the lower byte first; the upper 8 bits are taken, as [`read_rgb`](crate::read_rgb) does.
    Mono16,
    /// `mono16` with `is_bigendian`: the upper byte first.
    Mono16BigEndian,
    /// `yuv422` or `uyvy`: bytes U, Y, V, Y for two pixels. BT.601 of limited range (Y from 16 to 235), as OpenCV and ROS convert it.
    Uyvy,
    /// `yuv422_yuy2` or `yuyv`: bytes Y, U, Y, V, otherwise the same.
    Yuyv,
    /// `bayer_rggb8`: the first row begins with red and green, the second with green and blue. Missing colours by H. Malvar, L. He,
    /// R. Cutler, "High-quality linear interpolation for demosaicing of Bayer-patterned color images" (2004).
    BayerRggb8,
    /// `bayer_bggr8`.
    BayerBggr8,
    /// `bayer_gbrg8`.
    BayerGbrg8,
    /// `bayer_grbg8`.
    BayerGrbg8,
}

use PixelEncoding::*;

/// The names that are parsed.
const NAMES: [(&str, PixelEncoding); 14] = [
    ("rgb8", Rgb8),
    ("bgr8", Bgr8),
    ("rgba8", Rgba8),
    ("bgra8", Bgra8),
    ("mono8", Mono8),
    ("mono16", Mono16),
    ("yuv422", Uyvy),
    ("uyvy", Uyvy),
    ("yuv422_yuy2", Yuyv),
    ("yuyv", Yuyv),
    ("bayer_rggb8", BayerRggb8),
    ("bayer_bggr8", BayerBggr8),
    ("bayer_gbrg8", BayerGbrg8),
    ("bayer_grbg8", BayerGrbg8),
];

impl FromStr for PixelEncoding {
    type Err = Error;

    fn from_str(text: &str) -> Result<Self> {
        let known = NAMES.iter().find(|(name, _)| *name == text);
        known.map(|(_, encoding)| *encoding).ok_or_else(|| {
            let names: Vec<&str> = NAMES.iter().map(|(name, _)| *name).collect();
            Error::argument("encoding", format!("{text:?}"), format!("one of {}", names.join(", ")))
        })
    }
}

impl PixelEncoding {
    /// Bytes of a row without padding.
    fn row_bytes(self, width: usize) -> usize {
        width.saturating_mul(match self {
            Rgb8 | Bgr8 => 3,
            Rgba8 | Bgra8 => 4,
            Mono16 | Mono16BigEndian | Uyvy | Yuyv => 2,
            Mono8 | BayerRggb8 | BayerBggr8 | BayerGbrg8 | BayerGrbg8 => 1,
        })
    }

    fn bayer(self) -> Option<Bayer> {
        let (column, row) = match self {
            BayerRggb8 => (0, 0),
            BayerGrbg8 => (1, 0),
            BayerGbrg8 => (0, 1),
            BayerBggr8 => (1, 1),
            _ => return None,
        };
        Some(Bayer { red_column: column, red_row: row })
    }
}

/// A raw frame as RGB: rows of `width` pixels that begin every `step` bytes.
///
/// ```
/// use sdim::{PixelEncoding, decode_rgb};
/// let bgr = [255, 0, 0, 0, 0, 255, 9, 9]; // blue, red, two bytes of padding
/// let rgb = decode_rgb(&bgr, 2, 1, 8, PixelEncoding::Bgr8)?;
/// assert_eq!(rgb.as_raw()[..], [0, 0, 255, 255, 0, 0]);
/// # Ok::<(), sdim::Error>(())
/// ```
///
/// # Errors
/// [`Error::ImageSize`] for an empty size, one above 2^28 pixels, an odd width of YUV 4:2:2 and a Bayer picture below 2x2;
/// [`Error::Argument`] for a step below a row's bytes; [`Error::BufferLength`] for a buffer that ends before the last row does.
pub fn decode_rgb(
    data: &[u8],
    width: usize,
    height: usize,
    step: usize,
    encoding: PixelEncoding,
) -> Result<RgbImage> {
    let pixels = pixel_count(width, height)?;
    let wrong_size = |reason: &str| Err(Error::ImageSize { width, height, reason: reason.into() });
    if matches!(encoding, Uyvy | Yuyv) && !width.is_multiple_of(2) {
        return wrong_size("expected an even width: two pixels of YUV 4:2:2 share their colour");
    }
    let rows = rows("picture", data, encoding.row_bytes(width), height, step)?;
    let rgb = if let Some(bayer) = encoding.bayer() {
        if width < 2 || height < 2 {
            return wrong_size("expected at least 2x2 pixels of a Bayer pattern");
        }
        demosaic(&rows.collect::<Vec<_>>(), bayer)
    } else {
        let mut rgb = Vec::with_capacity(pixels * 3);
        rows.for_each(|row| convert(row, encoding, &mut rgb));
        rgb
    };
    let found = rgb.len();
    let image = RgbImage::from_raw(width as u32, height as u32, rgb);
    image.ok_or(Error::BufferLength { what: "picture", expected: pixels * 3, found })
}

/// Appends a row of whole pixels.
fn convert(row: &[u8], encoding: PixelEncoding, rgb: &mut Vec<u8>) {
    let (threes, fours, twos) = (row.as_chunks::<3>().0, row.as_chunks::<4>().0, row.as_chunks::<2>().0);
    match encoding {
        Rgb8 => rgb.extend_from_slice(row),
        Bgr8 => rgb.extend(threes.iter().flat_map(|&[b, g, r]| [r, g, b])),
        Rgba8 => rgb.extend(fours.iter().flat_map(|&[r, g, b, _]| [r, g, b])),
        Bgra8 => rgb.extend(fours.iter().flat_map(|&[b, g, r, _]| [r, g, b])),
        Mono16 => rgb.extend(twos.iter().flat_map(|&[_, upper]| [upper; 3])),
        Mono16BigEndian => rgb.extend(twos.iter().flat_map(|&[upper, _]| [upper; 3])),
        Uyvy => fours.iter().for_each(|&[u, y0, v, y1]| rgb.extend(bt601([y0, y1], u, v).as_flattened())),
        Yuyv => fours.iter().for_each(|&[y0, u, y1, v]| rgb.extend(bt601([y0, y1], u, v).as_flattened())),
        Mono8 | BayerRggb8 | BayerBggr8 | BayerGbrg8 | BayerGrbg8 => {
            rgb.extend(row.iter().flat_map(|&grey| [grey; 3]));
        }
    }
}

/// Two pixels with one colour difference. Factors of ITU-R BT.601 for 219 steps of luma and 224 of chroma, in 65536ths.
fn bt601(luma: [u8; 2], u: u8, v: u8) -> [[u8; 3]; 2] {
    let (u, v) = (i32::from(u) - 128, i32::from(v) - 128);
    luma.map(|y| {
        let y = 76309 * (i32::from(y) - 16).max(0) + 32768;
        let [r, g, b] = [y + 104597 * v, y - 25675 * u - 53279 * v, y + 132201 * u];
        [r, g, b].map(|c| (c >> 16).clamp(0, 255) as u8)
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn channels_are_put_in_order() {
        let rgb = |data: &[u8], encoding| decode_rgb(data, 2, 1, data.len(), encoding).unwrap().into_raw();
        assert_eq!(rgb(&[1, 2, 3, 4, 5, 6], Rgb8), [1, 2, 3, 4, 5, 6]);
        assert_eq!(rgb(&[1, 2, 3, 4, 5, 6], Bgr8), [3, 2, 1, 6, 5, 4]);
        assert_eq!(rgb(&[1, 2, 3, 9, 4, 5, 6, 9], Rgba8), [1, 2, 3, 4, 5, 6]);
        assert_eq!(rgb(&[1, 2, 3, 9, 4, 5, 6, 9], Bgra8), [3, 2, 1, 6, 5, 4]);
        assert_eq!(rgb(&[7, 8], Mono8), [7, 7, 7, 8, 8, 8]);
        assert_eq!(rgb(&[1, 7, 2, 8], Mono16), [7, 7, 7, 8, 8, 8]);
        assert_eq!(rgb(&[1, 7, 2, 8], Mono16BigEndian), [1, 1, 1, 2, 2, 2]);
        // White and black; red of full saturation.
        assert_eq!(rgb(&[128, 235, 128, 16], Uyvy), [255, 255, 255, 0, 0, 0]);
        assert_eq!(rgb(&[81, 90, 81, 240], Yuyv), [254, 0, 0, 254, 0, 0]);
    }

    #[test]
    fn rows_are_as_long_as_their_step() {
        let data = [1, 2, 99, 3, 4, 99, 5, 6];
        let rgb = decode_rgb(&data, 2, 3, 3, Mono8).unwrap();
        assert_eq!(rgb.into_raw(), [1, 1, 1, 2, 2, 2, 3, 3, 3, 4, 4, 4, 5, 5, 5, 6, 6, 6]);
        let wrong = |width, height, step, encoding| decode_rgb(&data, width, height, step, encoding);
        assert!(matches!(wrong(2, 3, 1, Mono8), Err(Error::Argument { name: "stride", .. })));
        assert!(matches!(wrong(2, 3, 0, Mono8), Err(Error::Argument { .. })));
        assert!(matches!(wrong(3, 3, 3, Mono8), Err(Error::BufferLength { expected: 9, found: 8, .. })));
        assert!(matches!(wrong(3, 1, 8, Rgb8), Err(Error::Argument { .. })));
        assert!(matches!(wrong(3, 1, 8, Uyvy), Err(Error::ImageSize { .. })));
        assert!(matches!(wrong(8, 1, 8, BayerRggb8), Err(Error::ImageSize { .. })));
        assert!(matches!(wrong(0, 3, 3, Mono8), Err(Error::ImageSize { .. })));
        assert!(matches!(wrong(1 << 28, 1, usize::MAX, Mono8), Err(Error::BufferLength { .. })));
        assert!(matches!(wrong(1, 1 << 28, usize::MAX, Mono8), Err(Error::BufferLength { .. })));
        assert!(matches!(wrong(usize::MAX, usize::MAX, usize::MAX, Rgba8), Err(Error::ImageSize { .. })));
    }

    #[test]
    fn unknown_encodings_are_told_the_known() {
        for (name, encoding) in NAMES {
            assert_eq!(name.parse::<PixelEncoding>().unwrap(), encoding);
        }
        for unknown in ["", "RGB8", "8UC3", "32FC1", "bayer_rggb16"] {
            let message = unknown.parse::<PixelEncoding>().unwrap_err().to_string();
            assert!(message.contains(unknown) && message.contains("yuv422_yuy2"), "{message}");
        }
    }
}
