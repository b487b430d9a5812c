//! RGB frames: from files, from cameras' raw frames, and in other sizes.

mod bayer;
mod encodings;
pub mod resize;

pub use encodings::{PixelEncoding, decode_rgb};

use crate::error::{Error, Result};
use image::{ColorType, DynamicImage, ImageDecoder, ImageError, ImageReader, RgbImage};
use std::path::Path;

/// Reads a PNG or JPEG as 8-bit RGB, upright: an EXIF orientation is applied, alpha is dropped, grey is spread, and of 16 bits
/// the upper 8 are taken, as Pillow does with colours.
///
/// # Errors
/// [`Error::Io`]; [`Error::Format`] if the file is not a complete image; [`Error::ImageSize`] over 2^28 pixels.
pub fn read_rgb(path: impl AsRef<Path>) -> Result<RgbImage> {
    let path = path.as_ref();
    let reader = ImageReader::open(path).map_err(Error::io(path))?;
    let reader = reader.with_guessed_format().map_err(Error::io(path))?;
    let wrong = |e: ImageError| image_error(path, e);
    let mut decoder = reader.into_decoder().map_err(wrong)?;
    // A header of a few bytes may claim any size; memory is set aside only for what a camera could have taken.
    let (width, height) = decoder.dimensions();
    crate::depth::pixels::pixel_count(width as usize, height as usize)?;
    let orientation = decoder.orientation().map_err(wrong)?;
    let mut image = DynamicImage::from_decoder(decoder).map_err(wrong)?;
    image.apply_orientation(orientation);
    Ok(match image.color() {
        ColorType::L16 | ColorType::La16 | ColorType::Rgb16 | ColorType::Rgba16 => upper_bytes(image),
        _ => image.into_rgb8(),
    })
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
        other => Error::format(path, other.to_string(), "a complete RGB image in PNG or JPEG"),
    }
}
