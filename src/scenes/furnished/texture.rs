//! Pictures on surfaces: at most 256 pixels wide, with their halves, quarters and so on for distant views.

use std::io::Cursor;
use std::path::Path;

use image::{ImageFormat, ImageReader, Limits, RgbaImage, imageops};

use crate::depth::pixels::pixel_count;
use crate::error::{Error, Result};
use crate::files::read_within;
use crate::image::image_error;
use crate::scenes::space::{V3, mix};

/// Pixels along the longer side that are kept.
pub(super) const SIDE: u32 = 256;

/// Bytes of a texture's file, at most.
const LONGEST: u64 = 64 << 20;

/// A picture of 8-bit sRGB with alpha, and its reductions by 2, 4, and so on.
#[derive(Clone, Debug)]
pub(super) struct Texture {
    levels: Vec<RgbaImage>,
    /// Whether some of it is clear.
    pub clear: bool,
}

impl Texture {
    /// Reads a PNG or JPEG and reduces it to [`SIDE`].
    pub fn read(path: &Path) -> Result<Self> {
        Self::decode(path, &read_within(path, LONGEST)?)
    }

    /// The same of bytes that were read; `path` is for messages.
    pub fn decode(path: &Path, bytes: &[u8]) -> Result<Self> {
        let wrong = |e| image_error(path, e);
        let reader = || -> Result<_> {
            ImageReader::new(Cursor::new(bytes)).with_guessed_format().map_err(Error::io(path))
        };
        let (width, height) = reader()?.into_dimensions().map_err(wrong)?;
        pixel_count(width as usize, height as usize)?;
        let mut reader = reader()?;
        reader.limits(Limits::default());
        Ok(Self::new(reader.decode().map_err(wrong)?.into_rgba8()))
    }

    pub fn new(image: RgbaImage) -> Self {
        let (width, height) = image.dimensions();
        let longer = width.max(height);
        let first = if longer > SIDE {
            let side = |n: u32| (n * SIDE / longer).max(1);
            imageops::thumbnail(&image, side(width), side(height))
        } else {
            image
        };
        let clear = first.pixels().any(|p| p.0[3] < 128);
        let mut levels = vec![first];
        while let Some(last) = levels.last().filter(|l| l.width().max(l.height()) > 1) {
            let half = (last.width().div_ceil(2), last.height().div_ceil(2));
            levels.push(imageops::thumbnail(last, half.0, half.1));
        }
        Self { levels, clear }
    }

    /// JPEG where it is opaque, PNG elsewhere.
    pub fn encode(&self, path: &Path) -> Result<Vec<u8>> {
        let wrong = |e| image_error(path, e);
        let mut bytes = Vec::new();
        let opaque = self.levels[0].pixels().all(|p| p.0[3] == 255);
        if opaque {
            let rgb = image::DynamicImage::ImageRgba8(self.levels[0].clone()).into_rgb8();
            let encoder = image::codecs::jpeg::JpegEncoder::new_with_quality(&mut bytes, 85);
            rgb.write_with_encoder(encoder).map_err(wrong)?;
        } else {
            self.levels[0].write_to(&mut Cursor::new(&mut bytes), ImageFormat::Png).map_err(wrong)?;
        }
        Ok(bytes)
    }

    /// Width and height of the largest level.
    pub fn size(&self) -> [f32; 2] {
        [self.levels[0].width() as f32, self.levels[0].height() as f32]
    }

    /// Linear colour at a point, repeated beyond 0 to 1; `texels` is the width of a pixel there.
    pub fn colour(&self, uv: [f32; 2], texels: f32, linear: &[f32; 256]) -> V3 {
        let level = (texels.max(1.0).log2() + 0.25) as usize;
        let image = &self.levels[level.min(self.levels.len() - 1)];
        let (w, h) = image.dimensions();
        let (x, a) = split(uv[0], w);
        let (y, b) = split(1.0 - uv[1], h);
        let at = |x: u32, y: u32| {
            let p = image.get_pixel(x, y).0;
            [linear[p[0] as usize], linear[p[1] as usize], linear[p[2] as usize]]
        };
        let (x1, y1) = ((x + 1) % w, (y + 1) % h);
        mix(mix(at(x, y), at(x1, y), a), mix(at(x, y1), at(x1, y1), a), b)
    }

    /// Alpha at a point, 0 to 255, without smoothing.
    #[inline]
    pub fn alpha(&self, uv: [f32; 2]) -> u8 {
        self.nearest(uv)[3]
    }

    /// Brightness at a point, 0 to 255: what a picture used as a mask says.
    pub fn level(&self, uv: [f32; 2]) -> u8 {
        self.nearest(uv)[1]
    }

    fn nearest(&self, uv: [f32; 2]) -> [u8; 4] {
        let image = &self.levels[0];
        let (x, a) = split(uv[0], image.width());
        let (y, b) = split(1.0 - uv[1], image.height());
        let (x, y) = ((x + u32::from(a > 0.5)) % image.width(), (y + u32::from(b > 0.5)) % image.height());
        image.get_pixel(x, y).0
    }
}

/// Pixel left of (above) a coordinate that repeats, and the share of the next one.
fn split(v: f32, n: u32) -> (u32, f32) {
    let part = if v.is_finite() { v - v.floor() } else { 0.0 };
    let at = part * n as f32 - 0.5;
    let at = if at < 0.0 { at + n as f32 } else { at };
    let i = (at as u32).min(n - 1);
    (i, (at - i as f32).clamp(0.0, 1.0))
}

#[cfg(test)]
mod tests {
    use super::*;
    use image::Rgba;

    fn linear() -> [f32; 256] {
        std::array::from_fn(|i| i as f32 / 255.0)
    }

    #[test]
    fn v_points_up_and_pictures_repeat() {
        let t = Texture::new(RgbaImage::from_fn(2, 2, |x, y| Rgba([255 * x as u8, 255 * y as u8, 0, 255])));
        for uv in [[0.75, 0.25], [1.75, -0.75], [-0.25, 2.25]] {
            assert_eq!(t.colour(uv, 1.0, &linear()), [1.0, 1.0, 0.0], "{uv:?}");
        }
        assert_eq!(t.colour([0.25, 0.75], 1.0, &linear()), [0.0, 0.0, 0.0]);
        let mean = t.colour([0.1, 0.9], 64.0, &linear());
        assert!((mean[0] - 0.5).abs() < 0.01, "{mean:?}");
        assert!(t.colour([f32::NAN, 0.0], 1.0, &linear())[0].is_finite());
    }

    #[test]
    fn large_pictures_shrink_and_come_back_from_their_bytes() {
        let clear = RgbaImage::from_fn(600, 300, |x, _| Rgba([9, 90, 200, if x < 300 { 0 } else { 255 }]));
        let t = Texture::new(clear);
        assert_eq!((t.size(), t.clear), ([256.0, 128.0], true));
        let path = Path::new("t.png");
        let again = Texture::decode(path, &t.encode(path).unwrap()).unwrap();
        assert_eq!((again.alpha([0.1, 0.5]), again.alpha([0.9, 0.5])), (0, 255));
        let opaque = Texture::new(RgbaImage::from_pixel(40, 40, Rgba([200, 100, 50, 255])));
        let bytes = opaque.encode(path).unwrap();
        assert_eq!(bytes[..2], [0xff, 0xd8], "a JPEG");
        assert!(!Texture::decode(path, &bytes).unwrap().clear);
        assert!(matches!(Texture::decode(path, &bytes[..30]), Err(Error::Format { .. })));
        assert!(matches!(Texture::decode(path, b"no picture"), Err(Error::Format { .. })));
    }
}
