//! TIFF files with one channel of depth (the crate `tiff`).

use std::fs::File;
use std::io::{BufRead, BufReader, ErrorKind, Seek};
use std::path::Path;

use tiff::decoder::{Decoder, DecodingResult, Limits};
use tiff::{ColorType, TiffError};

use super::raster::{Raster, Values};
use crate::depth::pixels::{check_length, pixel_count};
use crate::error::{Error, Result};

const EXPECTED: &str = "a TIFF page with one channel of 16- or 32-bit integers or of floats";
/// How often smaller a page may be stored: Deflate shrinks up to 1032-fold, LZW up to 1365-fold.
const SHRINKS: u64 = 1400;

/// Reads the first page of a file.
///
/// # Errors
/// [`Error::Io`]; [`Error::Format`] for a damaged file and for other pixels: 8-bit ones are most likely a picture of a depth
/// map, whose metres cannot be recovered; [`Error::ImageSize`].
pub fn read_tiff(path: &Path) -> Result<Raster> {
    let file = File::open(path).map_err(Error::io(path))?;
    let bytes = file.metadata().map_err(Error::io(path))?.len();
    read_from(BufReader::new(file), bytes, path)
}

fn read_from(reader: impl BufRead + Seek, bytes: u64, path: &Path) -> Result<Raster> {
    let wrong = |error: TiffError| match error {
        TiffError::IoError(e) if e.kind() != ErrorKind::UnexpectedEof => Error::io(path)(e),
        other => Error::format(path, other.to_string(), EXPECTED),
    };
    let mut decoder = Decoder::new(reader).map_err(wrong)?;
    let (width, height) = decoder.dimensions().map_err(wrong)?;
    let (width, height) = (width as usize, height as usize);
    let pixels = pixel_count(width, height)?;
    let bits = match decoder.colortype().map_err(wrong)? {
        ColorType::Gray(bits @ (16 | 32 | 64)) => u64::from(bits),
        other => return Err(Error::format(path, format!("{other:?} pixels"), EXPECTED)),
    };
    // A page that is larger than its file can hold is a lie, and nothing is set aside for it.
    let claimed = pixels as u64 * bits / 8;
    if claimed / SHRINKS > bytes {
        let found = format!("{width}x{height} pixels announced in a file of {bytes} bytes");
        return Err(Error::format(path, found, EXPECTED));
    }
    let mut limits = Limits::default();
    limits.decoding_buffer_size = usize::try_from(claimed).unwrap_or(usize::MAX);
    let mut decoder = decoder.with_limits(limits);
    let values = match decoder.read_image().map_err(wrong)? {
        DecodingResult::U16(v) => Values::Integers(v.into_iter().map(i64::from).collect()),
        DecodingResult::I16(v) => Values::Integers(v.into_iter().map(i64::from).collect()),
        DecodingResult::U32(v) => Values::Integers(v.into_iter().map(i64::from).collect()),
        DecodingResult::I32(v) => Values::Integers(v.into_iter().map(i64::from).collect()),
        DecodingResult::F16(v) => Values::Floats(v.into_iter().map(f32::from).collect()),
        DecodingResult::F32(v) => Values::Floats(v),
        DecodingResult::F64(v) => Values::Floats(v.into_iter().map(|d| d as f32).collect()),
        _ => return Err(Error::format(path, "64-bit integers", EXPECTED)),
    };
    check_length("TIFF page", values.len(), pixels)?;
    Ok(Raster { width, height, values })
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::io::Cursor;
    use tiff::encoder::colortype::{self, ColorType as Stored};
    use tiff::encoder::{Compression, DeflateLevel, TiffEncoder, TiffValue};

    fn written<C: Stored>(compression: Compression, values: &[C::Inner]) -> Vec<u8>
    where
        [C::Inner]: TiffValue,
    {
        let mut bytes = Cursor::new(Vec::new());
        let mut encoder = TiffEncoder::new(&mut bytes).unwrap().with_compression(compression);
        encoder.write_image::<C>(3, 2, values).unwrap();
        bytes.into_inner()
    }

    fn read(bytes: &[u8]) -> Result<Raster> {
        read_from(Cursor::new(bytes), bytes.len() as u64, Path::new("test.tif"))
    }

    #[test]
    fn integers_and_floats() {
        for compression in [
            Compression::Uncompressed,
            Compression::Lzw,
            Compression::Deflate(DeflateLevel::Balanced),
            Compression::Packbits,
        ] {
            let short = read(&written::<colortype::Gray16>(compression, &[0, 1, 2, 3, 4, 65535])).unwrap();
            let expected = Values::Integers(vec![0, 1, 2, 3, 4, 65535]);
            assert_eq!(short, Raster { width: 3, height: 2, values: expected });
            let float =
                read(&written::<colortype::Gray32Float>(compression, &[0.5, 1.5, 2.0, 3.0, -1.0, 0.0]));
            assert_eq!(float.unwrap().values, Values::Floats(vec![0.5, 1.5, 2.0, 3.0, -1.0, 0.0]));
            let long = read(&written::<colortype::Gray32>(compression, &[0, 1, 2, 3, 4, u32::MAX])).unwrap();
            assert_eq!(long.values, Values::Integers(vec![0, 1, 2, 3, 4, i64::from(u32::MAX)]));
        }
    }

    #[test]
    fn other_pixels_are_named() {
        let eight = read(&written::<colortype::Gray8>(Compression::Uncompressed, &[1; 6])).unwrap_err();
        assert!(eight.to_string().contains("Gray(8)"), "{eight}");
        let colours = read(&written::<colortype::RGB16>(Compression::Uncompressed, &[1; 18])).unwrap_err();
        assert!(colours.to_string().contains("RGB(16)"), "{colours}");
    }

    #[test]
    fn damage_ends_in_an_answer() {
        for compression in
            [Compression::Uncompressed, Compression::Lzw, Compression::Deflate(DeflateLevel::Fast)]
        {
            let whole = written::<colortype::Gray32Float>(compression, &[1.0; 6]);
            for length in 0..whole.len() {
                let _ =
                    read(&whole[..length]).map(|raster| assert_eq!((raster.width, raster.height), (3, 2)));
            }
            for at in 0..whole.len() {
                for flip in [1, 0x80, 0xff] {
                    let mut bytes = whole.clone();
                    bytes[at] ^= flip;
                    if let Ok(Raster { width, height, values: Values::Floats(values) }) = read(&bytes) {
                        assert_eq!(values.len(), width * height);
                    }
                }
            }
            assert!(matches!(read(&whole[..20]), Err(Error::Format { .. })));
        }
    }
}
