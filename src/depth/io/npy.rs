//! NumPy `.npy` files with one 2-D array (the NPY format, versions 1 to 3, of NEP 1).
//!
//! Reading trusts nothing in the file: the header is limited in length, and the shape it claims must match the number of
//! bytes that are really there before anything of that size is allocated.

use std::fs::File;
use std::io::Read;
use std::path::Path;

use crate::depth::pixels::{check_length, pixel_count};
use crate::error::{Error, Result};

/// A 2-D array: shape (height, width), row-major.
#[derive(Debug, Clone, PartialEq)]
pub struct Npy {
    /// Number of columns.
    pub width: usize,
    /// Number of rows.
    pub height: usize,
    /// `width * height` values.
    pub values: Values,
}

/// The element types read.
#[derive(Debug, Clone, PartialEq)]
pub enum Values {
    /// `<f4`
    F32(Vec<f32>),
    /// `<f8`
    F64(Vec<f64>),
    /// `<u2`
    U16(Vec<u16>),
}

const MAGIC: &[u8; 6] = b"\x93NUMPY";
const MAX_HEADER: usize = 1 << 16;
const EXPECTED: &str = "a 2-D C-order .npy array of <f4, <f8 or <u2";

/// Reads a file.
///
/// # Errors
/// [`Error::Io`]; [`Error::Format`] for anything but a complete, C-ordered, little-endian 2-D array of f32, f64 or u16.
pub fn read_npy(path: impl AsRef<Path>) -> Result<Npy> {
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

fn read_from(mut reader: impl Read, path: &Path) -> Result<Npy> {
    let header = read_header(&mut reader, path)?;
    let bad = |found: String| Error::format(path, found, EXPECTED);
    let (kind, height, width) = parse_header(&header).map_err(bad)?;
    let pixels = pixel_count(width, height)?;
    let expected = pixels * kind.size();
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
    Ok(Npy { width, height, values: kind.decode(&data) })
}

fn read_header(reader: &mut impl Read, path: &Path) -> Result<String> {
    let start: [u8; 8] = read_array(reader, path)?;
    if &start[..6] != MAGIC {
        return Err(Error::format(path, "no NumPy signature", EXPECTED));
    }
    let length = match start[6] {
        1 => usize::from(u16::from_le_bytes(read_array(reader, path)?)),
        2 | 3 => u32::from_le_bytes(read_array(reader, path)?) as usize,
        version => {
            return Err(Error::format(path, format!("format version {version}"), "version 1, 2 or 3"));
        }
    };
    if length > MAX_HEADER {
        return Err(Error::format(
            path,
            format!("a header of {length} bytes"),
            format!("at most {MAX_HEADER}"),
        ));
    }
    let mut header = vec![0; length];
    reader.read_exact(&mut header).map_err(|e| truncated(e, path))?;
    String::from_utf8(header).map_err(|_| Error::format(path, "a header that is not text", EXPECTED))
}

fn read_array<const N: usize>(reader: &mut impl Read, path: &Path) -> Result<[u8; N]> {
    let mut bytes = [0; N];
    reader.read_exact(&mut bytes).map_err(|e| truncated(e, path))?;
    Ok(bytes)
}

fn truncated(error: std::io::Error, path: &Path) -> Error {
    match error.kind() {
        std::io::ErrorKind::UnexpectedEof => {
            Error::format(path, "the end of the file inside the header", EXPECTED)
        }
        _ => Error::io(path)(error),
    }
}

#[derive(Debug, Clone, Copy)]
enum Kind {
    F32,
    F64,
    U16,
}

impl Kind {
    fn size(self) -> usize {
        match self {
            Kind::F32 => 4,
            Kind::F64 => 8,
            Kind::U16 => 2,
        }
    }

    fn decode(self, data: &[u8]) -> Values {
        match self {
            Kind::F32 => Values::F32(
                data.chunks_exact(4).map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]])).collect(),
            ),
            Kind::F64 => {
                let value = |b: &[u8]| f64::from_le_bytes([b[0], b[1], b[2], b[3], b[4], b[5], b[6], b[7]]);
                Values::F64(data.chunks_exact(8).map(value).collect())
            }
            Kind::U16 => {
                Values::U16(data.chunks_exact(2).map(|b| u16::from_le_bytes([b[0], b[1]])).collect())
            }
        }
    }
}

/// Element type, rows and columns, or what was found instead. The header is a Python dict literal with three fixed keys.
fn parse_header(header: &str) -> std::result::Result<(Kind, usize, usize), String> {
    let descr = quoted(field(header, "descr")?);
    let kind = match descr {
        Some("<f4") => Kind::F32,
        Some("<f8") => Kind::F64,
        Some("<u2") => Kind::U16,
        Some(other) => return Err(format!("element type {other}")),
        None => return Err("a structured element type".to_string()),
    };
    if !field(header, "fortran_order")?.starts_with("False") {
        return Err("Fortran order".to_string());
    }
    let shape = field(header, "shape")?;
    let inner = shape.strip_prefix('(').and_then(|s| s.split_once(')')).map(|(inner, _)| inner);
    let inner = inner.ok_or("a shape that is not a tuple")?;
    let sizes: Vec<&str> = inner.split(',').map(str::trim).filter(|s| !s.is_empty()).collect();
    match sizes[..] {
        [rows, columns] => match (rows.parse(), columns.parse()) {
            (Ok(rows), Ok(columns)) => Ok((kind, rows, columns)),
            _ => Err(format!("shape ({inner})")),
        },
        _ => Err(format!("shape ({inner})")),
    }
}

/// What stands behind a key.
fn field<'a>(header: &'a str, key: &str) -> std::result::Result<&'a str, String> {
    let behind = |quote: char| header.split_once(&format!("{quote}{key}{quote}")).map(|(_, rest)| rest);
    let rest = behind('\'').or_else(|| behind('"')).and_then(|rest| rest.trim_start().strip_prefix(':'));
    rest.map(str::trim_start).ok_or_else(|| format!("a header without `{key}`"))
}

fn quoted(text: &str) -> Option<&str> {
    let quote = text.chars().next().filter(|c| matches!(c, '\'' | '"'))?;
    text[1..].split_once(quote).map(|(inside, _)| inside)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn file(header: &str, data: &[u8]) -> Vec<u8> {
        let mut bytes = b"\x93NUMPY\x01\x00".to_vec();
        bytes.extend((header.len() as u16).to_le_bytes());
        bytes.extend(header.as_bytes());
        bytes.extend(data);
        bytes
    }

    fn read(bytes: &[u8]) -> Result<Npy> {
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
        let Values::F32(back) = back.values else { panic!("not f32") };
        assert!(back.iter().zip(values).all(|(a, b)| a.to_bits() == b.to_bits()));
    }

    #[test]
    fn all_element_types_and_versions() {
        let doubles: Vec<u8> = [1.5f64, -2.0].iter().flat_map(|v| v.to_le_bytes()).collect();
        let expected = Npy { width: 2, height: 1, values: Values::F64(vec![1.5, -2.0]) };
        assert_eq!(read(&file(&header("<f8", "False", "(1, 2)"), &doubles)).unwrap(), expected);
        let short = read(&file(&header("<u2", "False", "(2, 1)"), &[1, 0, 0, 1])).unwrap();
        assert_eq!(short, Npy { width: 1, height: 2, values: Values::U16(vec![1, 256]) });
        let text = header("<u2", "False", "(1,1)").replace('\'', "\"");
        let mut long = b"\x93NUMPY\x02\x00".to_vec();
        long.extend((text.len() as u32).to_le_bytes());
        long.extend(text.as_bytes());
        long.extend([7, 0]);
        assert_eq!(read(&long).unwrap().values, Values::U16(vec![7]));
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
            header("<f4", "False", "(1, 2, 2)"),
            header("<f4", "False", "()"),
            header("<f4", "False", "(2, 2"),
            header("<f4", "True", "(2, 2)"),
            header(">f4", "False", "(2, 2)"),
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
