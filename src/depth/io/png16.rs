//! 16-bit grey PNG files, the common exchange format of depth maps; 0 means missing.

use std::io::Cursor;
use std::path::Path;

use image::codecs::png::{PngDecoder, PngEncoder};
use image::{DynamicImage, ExtendedColorType, ImageEncoder, LumaA};

use crate::depth::pixels::{check_length, pixel_count};
use crate::error::{Error, Result};

const EXPECTED: &str = "a PNG with 16-bit grey pixels, with or without alpha";

/// Reads a file as (width, height, stored integers in row-major order). Where there is alpha, a pixel with alpha 0 is 0, missing,
/// and any other alpha says nothing.
///
/// # Errors
/// [`Error::Io`]; [`Error::Format`] for a file that is not a complete 16-bit grey PNG: an 8-bit one is most likely a picture of
/// a depth map, whose metres cannot be recovered.
pub fn read_png16(path: impl AsRef<Path>) -> Result<(usize, usize, Vec<u16>)> {
    let path = path.as_ref();
    let bytes = std::fs::read(path).map_err(Error::io(path))?;
    decode(&bytes, path)
}

/// Writes `width * height` integers.
///
/// # Errors
/// [`Error::ImageSize`], [`Error::BufferLength`], [`Error::Format`] if the encoder fails, [`Error::Io`]; the file is then as it
/// was before.
pub fn write_png16(path: impl AsRef<Path>, width: usize, height: usize, stored: &[u16]) -> Result<()> {
    crate::files::write_whole(path.as_ref(), &encode(width, height, stored)?)
}

/// The bytes of a PNG file with `width * height` integers.
///
/// # Errors
/// [`Error::ImageSize`], [`Error::BufferLength`], [`Error::Format`] if the encoder fails.
pub fn encode(width: usize, height: usize, stored: &[u16]) -> Result<Vec<u8>> {
    check_length("png pixels", stored.len(), pixel_count(width, height)?)?;
    // The encoder takes samples in the byte order of the machine and swaps them itself.
    let samples: Vec<u8> = stored.iter().flat_map(|s| s.to_ne_bytes()).collect();
    let mut bytes = Vec::new();
    PngEncoder::new(&mut bytes)
        .write_image(&samples, width as u32, height as u32, ExtendedColorType::L16)
        .map_err(|e| Error::format("png in memory", e.to_string(), EXPECTED))?;
    Ok(bytes)
}

fn decode(bytes: &[u8], path: &Path) -> Result<(usize, usize, Vec<u16>)> {
    let (width, height) = check_header(bytes, path)?;
    let bad = |e: image::ImageError| Error::format(path, e.to_string(), EXPECTED);
    let decoder = PngDecoder::with_limits(Cursor::new(bytes), image::Limits::default()).map_err(bad)?;
    match DynamicImage::from_decoder(decoder).map_err(bad)? {
        DynamicImage::ImageLuma16(image) => Ok((width, height, image.into_raw())),
        DynamicImage::ImageLumaA16(image) => {
            let grey = |&LumaA([grey, alpha]): &LumaA<u16>| if alpha == 0 { 0 } else { grey };
            Ok((width, height, image.pixels().map(grey).collect()))
        }
        other => Err(Error::format(path, format!("{:?} pixels", other.color()), EXPECTED)),
    }
}

/// Width and height from the IHDR chunk, if it announces 16-bit grey and the file can really hold that many pixels.
fn check_header(bytes: &[u8], path: &Path) -> Result<(usize, usize)> {
    let head = bytes.get(..26).filter(|b| b.starts_with(b"\x89PNG\r\n\x1a\n") && b[12..16] == *b"IHDR");
    let head = head.ok_or_else(|| Error::format(path, "no PNG header", EXPECTED))?;
    let number =
        |at: usize| u32::from_be_bytes([head[at], head[at + 1], head[at + 2], head[at + 3]]) as usize;
    let (width, height, bits, colour) = (number(16), number(20), head[24], head[25]);
    if !matches!((bits, colour), (16, 0 | 4)) {
        let name = match colour {
            0 => "grey",
            2 => "RGB",
            3 => "palette",
            4 => "grey with alpha",
            6 => "RGB with alpha",
            _ => "unknown",
        };
        return Err(Error::format(path, format!("{bits}-bit {name} pixels"), EXPECTED));
    }
    let pixels = pixel_count(width, height)?;
    // Deflate shrinks at most about 1032-fold, so a larger claim is a lie, and nothing is allocated for it.
    if pixels / 550 > bytes.len() {
        let found = format!("{width}x{height} pixels announced in a file of {} bytes", bytes.len());
        return Err(Error::format(path, found, EXPECTED));
    }
    Ok((width, height))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read(bytes: &[u8]) -> Result<(usize, usize, Vec<u16>)> {
        decode(bytes, Path::new("test.png"))
    }

    fn picture(colour: ExtendedColorType, bytes_per_pixel: usize) -> Vec<u8> {
        let mut bytes = Vec::new();
        PngEncoder::new(&mut bytes).write_image(&vec![9; 6 * bytes_per_pixel], 3, 2, colour).unwrap();
        bytes
    }

    #[test]
    fn round_trip() {
        let stored = [0, 1, 255, 256, 0x1234, 65535];
        assert_eq!(read(&encode(3, 2, &stored).unwrap()).unwrap(), (3, 2, stored.to_vec()));
        let large = vec![7; 2000 * 1000];
        assert_eq!(read(&encode(2000, 1000, &large).unwrap()).unwrap().2, large);
    }

    #[test]
    fn other_pixel_types_are_named() {
        for (colour, size, name) in [
            (ExtendedColorType::L8, 1, "8-bit grey pixels"),
            (ExtendedColorType::Rgb8, 3, "8-bit RGB pixels"),
            (ExtendedColorType::Rgba8, 4, "8-bit RGB with alpha pixels"),
            (ExtendedColorType::Rgb16, 6, "16-bit RGB pixels"),
            (ExtendedColorType::La8, 2, "8-bit grey with alpha pixels"),
        ] {
            let message = read(&picture(colour, size)).unwrap_err().to_string();
            assert!(message.contains(name) && message.contains("test.png"), "{message}");
        }
    }

    #[test]
    fn alpha_says_whether_a_pixel_is_there() {
        let samples: Vec<u8> = [700u16, 65535, 800, 0, 900, 1].iter().flat_map(|s| s.to_ne_bytes()).collect();
        let mut bytes = Vec::new();
        PngEncoder::new(&mut bytes).write_image(&samples, 3, 1, ExtendedColorType::La16).unwrap();
        assert_eq!(read(&bytes).unwrap(), (3, 1, vec![700, 0, 900]));
    }

    #[test]
    fn every_truncation_is_an_error() {
        let stored: Vec<u16> = (0..400).map(|i| i * 163).collect();
        let whole = encode(20, 20, &stored).unwrap();
        // The last 12 bytes are the empty end chunk: without it all pixels are there.
        for length in 0..whole.len() - 12 {
            assert!(
                matches!(read(&whole[..length]), Err(Error::Format { .. })),
                "{length} of {} bytes",
                whole.len()
            );
        }
    }

    #[test]
    fn sizes_that_lie_are_refused() {
        let mut bytes = encode(3, 2, &[1; 6]).unwrap();
        bytes[16..24].copy_from_slice(&[0, 0, 0x40, 0, 0, 0, 0x40, 0]);
        assert!(read(&bytes).unwrap_err().to_string().contains("announced"));
        bytes[16..24].copy_from_slice(&[0x7f; 8]);
        assert!(matches!(read(&bytes), Err(Error::ImageSize { .. })));
        bytes[16..24].fill(0);
        assert!(matches!(read(&bytes), Err(Error::ImageSize { .. })));
    }

    #[test]
    fn a_wrong_buffer_writes_no_file() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.png");
        assert!(matches!(write_png16(&path, 2, 2, &[1; 3]), Err(Error::BufferLength { .. })));
        assert!(matches!(write_png16(&path, 0, 2, &[]), Err(Error::ImageSize { .. })));
        assert!(!path.exists());
        assert!(matches!(read_png16(&path), Err(Error::Io { .. })));
    }
}
