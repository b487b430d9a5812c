//! RGB frames: from files, from cameras' raw frames, and in other sizes.

mod bayer;
mod encodings;
pub mod resize;

pub use encodings::{PixelEncoding, decode_rgb};

use crate::error::{Error, Result};
use image::{ColorType, DynamicImage, ImageDecoder, ImageError, ImageFormat, ImageReader, RgbImage};
use std::path::Path;

const EXPECTED: &str = match cfg!(feature = "formats") {
    true => "a complete RGB image in PNG, JPEG, WebP, BMP or TIFF",
    false => "a complete RGB image in PNG or JPEG",
};

/// Reads a PNG or JPEG, and with the feature `formats` a WebP, BMP or TIFF (its first page), as 8-bit RGB, upright: an EXIF orientation is applied, alpha is dropped, grey is spread, and of 16 bits
/// the upper 8 are taken, as Pillow does with colours.
///
/// # Errors
/// [`Error::Io`]; [`Error::Format`] if the file is not a complete image of these formats, and for floating-point pixels, whose
/// brightness has no fixed scale; [`Error::ImageSize`] over 2^28 pixels.
pub fn read_rgb(path: impl AsRef<Path>) -> Result<RgbImage> {
    let path = path.as_ref();
    let reader = ImageReader::open(path).map_err(Error::io(path))?;
    let reader = reader.with_guessed_format().map_err(Error::io(path))?;
    let wrong = |e: ImageError| image_error(path, e);
    check_format(path, reader.format())?;
    let mut decoder = reader.into_decoder().map_err(wrong)?;
    // A header of a few bytes may claim any size; memory is set aside only for what a camera could have taken.
    let (width, height) = decoder.dimensions();
    crate::depth::pixels::pixel_count(width as usize, height as usize)?;
    let orientation = decoder.orientation().map_err(wrong)?;
    let mut image = DynamicImage::from_decoder(decoder).map_err(wrong)?;
    image.apply_orientation(orientation);
    match image.color() {
        ColorType::L16 | ColorType::La16 | ColorType::Rgb16 | ColorType::Rgba16 => Ok(upper_bytes(image)),
        ColorType::Rgb32F | ColorType::Rgba32F => {
            Err(Error::format(path, "floating-point pixels", "a picture of 8 or 16 bits"))
        }
        _ => Ok(image.into_rgb8()),
    }
}

/// Refuses formats that this build does not read, and says which feature does.
fn check_format(path: &Path, format: Option<ImageFormat>) -> Result<()> {
    let more = match format {
        Some(ImageFormat::WebP) => "a WebP picture",
        Some(ImageFormat::Bmp) => "a BMP picture",
        Some(ImageFormat::Tiff) => "a TIFF picture",
        _ => return Ok(()),
    };
    if cfg!(feature = "formats") {
        return Ok(());
    }
    Err(Error::format(path, more, "PNG or JPEG, or a build with the feature `formats`"))
}

/// The upper byte of each sample, where the image crate would round.
fn upper_bytes(image: DynamicImage) -> RgbImage {
    let (width, height) = (image.width(), image.height());
    let bytes = image.into_rgb16().into_raw().into_iter().map(|v| (v >> 8) as u8).collect();
    // The buffer has exactly width * height * 3 bytes by construction.
    RgbImage::from_raw(width, height, bytes).unwrap_or_default()
}

/// The crate's form of an image error, naming the file.
pub(crate) fn image_error(path: &Path, error: ImageError) -> Error {
    match error {
        ImageError::IoError(e) if e.kind() != std::io::ErrorKind::UnexpectedEof => Error::io(path)(e),
        other => Error::format(path, other.to_string(), EXPECTED),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn more_formats_stand_behind_their_feature() {
        let dir = tempfile::tempdir().unwrap();
        // The first bytes are what the format is known by.
        for (bytes, name) in [
            (&b"RIFF\x20\0\0\0WEBPVP8L"[..], "WebP"),
            (b"BM\x20\0\0\0\0\0\0\0", "BMP"),
            (b"II\x2a\0\x08\0\0\0", "TIFF"),
        ] {
            let path = dir.path().join("picture");
            std::fs::write(&path, bytes).unwrap();
            let message = read_rgb(&path).unwrap_err().to_string();
            assert!(message.contains(name), "{message}");
            assert_eq!(message.contains("the feature `formats`"), !cfg!(feature = "formats"), "{message}");
        }
    }

    #[cfg(feature = "formats")]
    #[test]
    fn more_formats_are_read_and_damage_is_noticed() {
        use image::Rgb;
        let picture = RgbImage::from_fn(7, 5, |x, y| Rgb([(x * 30) as u8, (y * 40) as u8, 90]));
        let dir = tempfile::tempdir().unwrap();
        for ending in ["webp", "bmp", "tiff"] {
            let path = dir.path().join(format!("picture.{ending}"));
            picture.save(&path).unwrap();
            assert_eq!(read_rgb(&path).unwrap(), picture, "{ending}");
            let whole = std::fs::read(&path).unwrap();
            for at in 0..whole.len() {
                std::fs::write(&path, &whole[..at]).unwrap();
                let _ = read_rgb(&path)
                    .map_err(|e| assert!(matches!(e, Error::Format { .. } | Error::ImageSize { .. }), "{e}"));
                let mut changed = whole.clone();
                changed[at] ^= 0xff;
                std::fs::write(&path, &changed).unwrap();
                let _ = read_rgb(&path);
            }
        }
        let float = image::Rgb32FImage::from_pixel(2, 2, Rgb([0.5; 3]));
        let path = dir.path().join("float.tiff");
        float.save(&path).unwrap();
        assert!(read_rgb(&path).unwrap_err().to_string().contains("floating-point"));
    }
}
