//! NumPy `.npy` files with one 2-D array (the NPY format, versions 1 to 3, of NEP 1).
//!
//! Reading trusts nothing in the file: the header is limited in length, and the shape it claims must match the number of
//! bytes that are really there before anything of that size is allocated.

mod element;
mod header;

use std::fs::File;
use std::io::Read;
use std::path::Path;

use super::raster::Raster;
use crate::depth::pixels::{check_length, pixel_count};
use crate::error::{Error, Result};
use header::{Header, MAGIC, Order};

/// Reads a file: integers of 1 to 8 bytes or floats of 2, 4 or 8, in either byte order and either order of rows and columns.
/// Axes of length 1 before or behind (height, width) are left out.
///
/// # Errors
/// [`Error::Io`]; [`Error::Format`] for anything but one complete array of that kind.
pub fn read_npy(path: impl AsRef<Path>) -> Result<Raster> {
    let path = path.as_ref();
    let file = File::open(path).map_err(Error::io(path))?;
    read_from(file, path)
}

/// Writes f32 values, shape (height, width).
///
/// # Errors
/// [`Error::ImageSize`], [`Error::BufferLength`] unless there are `width * height` values, [`Error::Io`]; the file is then as
/// it was before.
pub fn write_npy(path: impl AsRef<Path>, width: usize, height: usize, values: &[f32]) -> Result<()> {
    crate::files::write_whole(path.as_ref(), &encode(width, height, values)?)
}

/// The bytes of a version 1 file with f32 values, shape (height, width).
///
/// # Errors
/// [`Error::ImageSize`], [`Error::BufferLength`] unless there are `width * height` values.
pub fn encode(width: usize, height: usize, values: &[f32]) -> Result<Vec<u8>> {
    check_length("npy array", values.len(), pixel_count(width, height)?)?;
    let mut header = format!("{{'descr': '<f4', 'fortran_order': False, 'shape': ({height}, {width}), }}");
    // The format asks for data that starts at a multiple of 64 bytes and a header that ends in a newline.
    while !(MAGIC.len() + 4 + header.len() + 1).is_multiple_of(64) {
        header.push(' ');
    }
    header.push('\n');
    let mut bytes = Vec::with_capacity(MAGIC.len() + 4 + header.len() + values.len() * 4);
    bytes.extend_from_slice(MAGIC);
    bytes.extend_from_slice(&[1, 0]);
    bytes.extend_from_slice(&(header.len() as u16).to_le_bytes());
    bytes.extend_from_slice(header.as_bytes());
    bytes.extend(values.iter().flat_map(|v| v.to_le_bytes()));
    Ok(bytes)
}

/// The array that stands in a reader, which must end with it; `path` is for errors.
pub(super) fn read_from(mut reader: impl Read, path: &Path) -> Result<Raster> {
    let Header { element, order, height, width } = header::read(&mut reader, path)?;
    let pixels = pixel_count(width, height)?;
    let expected = pixels * element.size();
    let mut data = Vec::new();
    // One byte more than needed, so that a file that is too long is noticed; grows only with what is really there.
    reader.take(expected as u64 + 1).read_to_end(&mut data).map_err(Error::io(path))?;
    if data.len() != expected {
        let found = if data.len() > expected { "more".to_string() } else { data.len().to_string() };
        return Err(Error::format(
            path,
            format!("{found} bytes of data"),
            format!("{expected} for shape ({height}, {width})"),
        ));
    }
    let values = element.decode(&data);
    let values = if order == Order::Columns { values.by_rows(width, height) } else { values };
    Ok(Raster { width, height, values })
}

#[cfg(test)]
mod tests {
    use super::super::raster::Values;
    use super::*;

    fn file(header: &str, data: &[u8]) -> Vec<u8> {
        let mut bytes = b"\x93NUMPY\x01\x00".to_vec();
        bytes.extend((header.len() as u16).to_le_bytes());
        bytes.extend(header.as_bytes());
        bytes.extend(data);
        bytes
    }

    fn read(bytes: &[u8]) -> Result<Raster> {
        read_from(bytes, Path::new("test.npy"))
    }

    fn header(descr: &str, order: &str, shape: &str) -> String {
        format!("{{'descr': '{descr}', 'fortran_order': {order}, 'shape': {shape}, }}\n")
    }

    #[test]
    fn round_trip_keeps_every_bit() {
        let values = [1.0, f32::NAN, -0.0, f32::INFINITY, 1e-42, 3.25];
        let bytes = encode(3, 2, &values).unwrap();
        assert_eq!((bytes.len() - 24) % 64, 0, "data must be aligned");
        let back = read(&bytes).unwrap();
        assert_eq!((back.width, back.height), (3, 2));
        let Values::Floats(back) = back.values else { panic!("not floats") };
        assert!(back.iter().zip(values).all(|(a, b)| a.to_bits() == b.to_bits()));
    }

    /// Each type that is read, with 1 x 3 values in both byte orders.
    #[test]
    fn all_element_types_and_byte_orders() {
        fn cases<const N: usize>(kind: &str, values: [[u8; N]; 3], expected: &Values) {
            for big in [false, true] {
                let order = if N == 1 { '|' } else { ['<', '>'][usize::from(big)] };
                let data = values.into_iter().flat_map(|mut little| {
                    if big {
                        little.reverse();
                    }
                    little
                });
                let data: Vec<u8> = data.collect();
                let found =
                    read(&file(&header(&format!("{order}{kind}{N}"), "False", "(1, 3)"), &data)).unwrap();
                assert_eq!((found.width, found.height, &found.values), (3, 1, expected), "{order}{kind}{N}");
            }
        }
        macro_rules! integers {
            ($kind:literal: $($of:ty),*) => {
                $(cases(
                    $kind,
                    [0, 7, <$of>::MAX].map(<$of>::to_le_bytes),
                    &Values::Integers(vec![0, 7, i64::try_from(<$of>::MAX).unwrap_or(i64::MAX)]),
                );)*
            };
        }
        integers!("u": u8, u16, u32, u64);
        integers!("i": i8, i16, i32, i64);
        cases("i", [-1i16, 2, -3].map(i16::to_le_bytes), &Values::Integers(vec![-1, 2, -3]));
        let expected = Values::Floats(vec![1.5, -2.0, 0.25]);
        let floats = [1.5f32, -2.0, 0.25];
        cases("f", floats.map(|v| half::f16::from_f32(v).to_le_bytes()), &expected);
        cases("f", floats.map(f32::to_le_bytes), &expected);
        cases("f", floats.map(|v| f64::from(v).to_le_bytes()), &expected);
    }

    #[test]
    fn every_version_and_quote() {
        let text = header("<u2", "False", "(1,1)").replace('\'', "\"");
        for version in [2, 3] {
            let mut long = b"\x93NUMPY".to_vec();
            long.extend([version, 0]);
            long.extend((text.len() as u32).to_le_bytes());
            long.extend(text.as_bytes());
            long.extend([7, 0]);
            assert_eq!(read(&long).unwrap().values, Values::Integers(vec![7]));
        }
        // Python 2 wrote long integers.
        let old = read(&file(&header("<u2", "False", "(1L, 2L)"), &[7, 0, 8, 0])).unwrap();
        assert_eq!((old.width, old.values), (2, Values::Integers(vec![7, 8])));
    }

    #[test]
    fn fortran_order_is_turned_into_rows() {
        // [[1, 2, 3], [4, 5, 6]] stored column by column.
        let stored = [1, 4, 2, 5, 3, 6];
        for shape in ["(2, 3)", "(1, 2, 3)", "(2, 3, 1)"] {
            let found = read(&file(&header("|u1", "True", shape), &stored)).unwrap();
            let rows = Values::Integers(vec![1, 2, 3, 4, 5, 6]);
            assert_eq!(found, Raster { width: 3, height: 2, values: rows }, "{shape}");
            let plain = read(&file(&header("|u1", "False", shape), &stored)).unwrap();
            assert_eq!(plain.values, Values::Integers(stored.map(i64::from).to_vec()), "{shape}");
        }
    }

    #[test]
    fn hostile_headers_are_refused() {
        let huge = "(99999999, 99999999999)";
        let cases = [
            header("<f4", "False", huge),
            header("<f4", "False", "(18446744073709551615, 2)"),
            header("<f4", "False", "(99999999999999999999999, 1)"),
            header("<f4", "False", "(-1, 4)"),
            header("<f4", "False", "(0, 4)"),
            header("<f4", "False", "(4,)"),
            header("<f4", "False", "(2, 2, 2)"),
            header("<f4", "False", "(2, 1, 2)"),
            header("<f4", "False", "()"),
            header("<f4", "False", "(2, 2"),
            header("<f4", "Maybe", "(2, 2)"),
            header("=f4", "False", "(2, 2)"),
            header("|f4", "False", "(2, 2)"),
            header("|b1", "False", "(4, 4)"),
            header("<f16", "False", "(1, 1)"),
            header("<c8", "False", "(2, 1)"),
            header("<U1", "False", "(2, 2)"),
            header("<f", "False", "(2, 2)"),
            header("<", "False", "(2, 2)"),
            header("", "False", "(2, 2)"),
            header("|O", "False", "(2, 2)"),
            header("é", "False", "(2, 2)"),
            "{'descr': [('a', '<f4')], 'fortran_order': False, 'shape': (2, 2)}".to_string(),
            "{'descr': é".to_string(),
            "{'descr':".to_string(),
            "{}".to_string(),
            String::new(),
        ];
        for case in cases {
            let result = read(&file(&case, &[0; 16]));
            assert!(
                matches!(result, Err(Error::Format { .. } | Error::ImageSize { .. })),
                "{case}: {result:?}"
            );
        }
        let big_claim = read(&file(&header("<f4", "False", "(16384, 16384)"), &[0; 16]));
        assert!(matches!(big_claim, Err(Error::Format { .. })), "{big_claim:?}");
        for (bytes, what) in [
            (b"\x93NUMPY\x02\x00\xff\xff\xff\xff".to_vec(), "header of 4 GiB"),
            (b"\x93NUMPY\x09\x00\x00\x00".to_vec(), "unknown version"),
            (b"\x89PNG\r\n\x1a\n".to_vec(), "another file type"),
            (b"\x93NUMPY\x01\x00\x04\x00\xff\xff\xff\xff".to_vec(), "header not text"),
        ] {
            assert!(matches!(read(&bytes), Err(Error::Format { .. })), "{what}");
        }
    }

    #[test]
    fn every_truncation_and_extension_is_an_error() {
        let whole = encode(3, 2, &[1.0; 6]).unwrap();
        for length in 0..whole.len() {
            assert!(matches!(read(&whole[..length]), Err(Error::Format { .. })), "{length} bytes");
        }
        let longer = [whole.as_slice(), &[0]].concat();
        assert!(matches!(read(&longer), Err(Error::Format { .. })));
    }

    #[test]
    fn a_wrong_buffer_writes_no_file() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.npy");
        assert!(matches!(write_npy(&path, 2, 2, &[1.0; 3]), Err(Error::BufferLength { .. })));
        assert!(!path.exists());
        assert!(matches!(read_npy(&path), Err(Error::Io { .. })));
    }
}
