//! The part of MATLAB's MAT-files (level 5, "MAT-File Format", The MathWorks) that benchmarks use: a struct of numeric arrays.
//!
//! No crate for it was found that reads structs without panicking on damaged files, so the few element kinds needed are read
//! here. Nothing is set aside by a size that a file claims: a compressed variable may unfold to a fixed limit, and every
//! array's length must be that of the bytes which are there.

use std::fs::File;
use std::io::Read;
use std::ops::Range;
use std::path::{Path, PathBuf};

use flate2::read::ZlibDecoder;

use crate::error::{Error, Result};

const EXPECTED: &str = "a MATLAB file of level 5 (`save -v7`), little-endian";
/// Largest file, and largest variable after decompression.
const LARGEST: u64 = 1 << 26;

const COMPRESSED: u32 = 15;
const MATRIX: u32 = 14;
const STRUCT_CLASS: u32 = 2;
/// Numeric classes are 6 to 15; above stand objects.
const LAST_PLAIN_CLASS: u32 = 15;

/// What was found instead.
type Found<T> = std::result::Result<T, String>;

/// A struct variable's numeric fields.
pub(super) struct Record {
    path: PathBuf,
    bytes: Vec<u8>,
    fields: Vec<(String, Array)>,
}

/// Shape and place of a numeric array; values lie column by column.
pub(super) struct Array {
    /// Lengths, rows first.
    pub(super) shape: Vec<usize>,
    kind: u32,
    range: Range<usize>,
}

impl Record {
    /// Reads the struct variable of this name.
    pub(super) fn read(path: &Path, name: &str) -> Result<Self> {
        let file = File::open(path).map_err(Error::io(path))?;
        let file = limited(file).map_err(Error::io(path))?;
        let file = file.ok_or_else(|| Error::format(path, format!("more than {LARGEST} bytes"), EXPECTED))?;
        Self::parse(&file, path, name)
    }

    fn parse(file: &[u8], path: &Path, name: &str) -> Result<Self> {
        let bad = |found: String| Error::format(path, found, EXPECTED);
        let body = check_header(file).map_err(bad)?;
        let mut elements = Elements { bytes: body, at: 0 };
        while let Some((kind, range)) = elements.next().map_err(bad)? {
            let bytes = match kind {
                COMPRESSED => inflate(&body[range]).map_err(bad)?,
                MATRIX => body[range].to_vec(),
                _ => continue,
            };
            if let Some(fields) = struct_fields(&bytes, name).map_err(bad)? {
                return Ok(Self { path: path.to_path_buf(), bytes, fields });
            }
        }
        Err(Error::format(path, format!("no struct `{name}`"), format!("a struct variable `{name}`")))
    }

    /// A numeric field, if there is one of this name.
    pub(super) fn field(&self, name: &str) -> Option<&Array> {
        self.fields.iter().find(|(n, _)| n == name).map(|(_, array)| array)
    }

    /// A numeric field of this shape, its values column by column.
    pub(super) fn values(&self, name: &str, shape: &[usize]) -> Result<Vec<f64>> {
        let what = || format!("numeric field `{name}` of shape {shape:?}");
        match self.field(name) {
            None => Err(Error::format(&self.path, format!("no numeric field `{name}`"), what())),
            Some(array) if array.shape == shape => Ok(decode(array.kind, &self.bytes[array.range.clone()])),
            Some(array) => {
                Err(Error::format(&self.path, format!("`{name}` of shape {:?}", array.shape), what()))
            }
        }
    }
}

/// All bytes, or nothing when there are too many.
fn limited(reader: impl Read) -> std::io::Result<Option<Vec<u8>>> {
    let mut bytes = Vec::new();
    reader.take(LARGEST + 1).read_to_end(&mut bytes)?;
    Ok(Some(bytes).filter(|b| b.len() as u64 <= LARGEST))
}

/// What follows the 128 bytes of header.
fn check_header(file: &[u8]) -> Found<&[u8]> {
    let (head, body) = file.split_at_checked(128).ok_or("less than the 128 bytes of a header")?;
    match (&head[124..126], &head[126..]) {
        ([0, 1], b"IM") => Ok(body),
        ([0, 2], b"IM") => Err("level 7.3 (an HDF5 file)".to_string()),
        (_, b"MI") => Err("a big-endian file".to_string()),
        _ => Err("no MATLAB header".to_string()),
    }
}

/// The matrix element inside of a compressed one.
fn inflate(bytes: &[u8]) -> Found<Vec<u8>> {
    let whole = limited(ZlibDecoder::new(bytes)).map_err(|e| format!("damaged compressed data ({e})"))?;
    let mut whole = whole.ok_or_else(|| format!("a variable of more than {LARGEST} bytes"))?;
    let mut elements = Elements { bytes: &whole, at: 0 };
    match elements.next()? {
        Some((MATRIX, range)) => {
            whole.truncate(range.end);
            Ok(whole.split_off(range.start))
        }
        _ => Err("compressed data without a matrix".to_string()),
    }
}

/// A row of data elements: each a kind, a length and bytes, padded to a multiple of 8.
struct Elements<'a> {
    bytes: &'a [u8],
    at: usize,
}

impl Elements<'_> {
    /// Kind and place of the next element; `None` at the end.
    fn next(&mut self) -> Found<Option<(u32, Range<usize>)>> {
        if self.at >= self.bytes.len() {
            return Ok(None);
        }
        let first = word(self.bytes, self.at)?;
        let (kind, start, length) = match first >> 16 {
            0 => (first, self.at + 8, word(self.bytes, self.at + 4)? as usize),
            // Up to four bytes stand in the tag itself, whose upper half is their number.
            small => (first & 0xffff, self.at + 4, (small as usize).min(5)),
        };
        let end = start.saturating_add(length);
        if end > self.bytes.len() || (start == self.at + 4 && length > 4) {
            return Err(format!("an element of {length} bytes where {} follow", self.bytes.len() - self.at));
        }
        let padded = if start == self.at + 4 { self.at + 8 } else { end.next_multiple_of(8) };
        self.at = if kind == COMPRESSED { end } else { padded };
        Ok(Some((kind, start..end)))
    }

    /// The next element, which must be of one kind.
    fn expect(&mut self, kind: u32, what: &str) -> Found<Range<usize>> {
        match self.next()? {
            Some((found, range)) if found == kind => Ok(range),
            Some((found, _)) => Err(format!("{what} of type {found} instead of {kind}")),
            None => Err(format!("the end of the data before {what}")),
        }
    }
}

fn word(bytes: &[u8], at: usize) -> Found<u32> {
    let four = at.checked_add(4).and_then(|end| bytes.get(at..end));
    let four = four.and_then(|b| b.try_into().ok()).ok_or("the end of the data inside of an element")?;
    Ok(u32::from_le_bytes(four))
}

/// How each matrix starts.
struct Head {
    class: u32,
    shape: Vec<usize>,
    name: Vec<u8>,
}

/// Reads the head of a matrix; `None` for objects, whose elements are in another order.
fn matrix_head(elements: &mut Elements) -> Found<Option<Head>> {
    let flags = elements.expect(6, "array flags")?;
    let class = word(&elements.bytes[flags], 0)? & 0xff;
    if class > LAST_PLAIN_CLASS {
        return Ok(None);
    }
    let lengths = elements.expect(5, "array dimensions")?;
    let lengths = elements.bytes[lengths].chunks_exact(4);
    let shape = lengths.map(|b| u32::from_le_bytes([b[0], b[1], b[2], b[3]]) as usize).collect();
    let name = elements.expect(1, "array name")?;
    Ok(Some(Head { class, shape, name: elements.bytes[name].to_vec() }))
}

/// The numeric fields of a matrix element that is a struct of this name; `None` for any other matrix.
fn struct_fields(bytes: &[u8], wanted: &str) -> Found<Option<Vec<(String, Array)>>> {
    let mut elements = Elements { bytes, at: 0 };
    let Some(Head { class, shape, name }) = matrix_head(&mut elements)? else { return Ok(None) };
    if name != wanted.as_bytes() {
        return Ok(None);
    }
    if class != STRUCT_CLASS || shape != [1, 1] {
        return Err(format!("`{wanted}` of class {class} and shape {shape:?} instead of one struct"));
    }
    let length = elements.expect(5, "length of field names")?;
    let length = word(&bytes[length], 0)? as usize;
    let names = elements.expect(1, "field names")?;
    if length == 0 {
        return Err("field names of no letters".to_string());
    }
    let mut fields = Vec::new();
    for name in bytes[names].chunks_exact(length) {
        let letters = name.split(|&b| b == 0).next().unwrap_or_default();
        let range = elements.expect(MATRIX, "a field")?;
        if let Some(mut array) = numeric(&bytes[range.clone()])? {
            array.range = array.range.start + range.start..array.range.end + range.start;
            fields.push((String::from_utf8_lossy(letters).into_owned(), array));
        }
    }
    Ok(Some(fields))
}

/// A matrix element's real values if it is numeric; `None` for text, cells, structs, and the empty element.
fn numeric(bytes: &[u8]) -> Found<Option<Array>> {
    if bytes.is_empty() {
        return Ok(None);
    }
    let mut elements = Elements { bytes, at: 0 };
    let Some(Head { class, shape, .. }) = matrix_head(&mut elements)? else { return Ok(None) };
    if !(6..=LAST_PLAIN_CLASS).contains(&class) {
        return Ok(None);
    }
    let Some((kind, range)) = elements.next()? else {
        return Err("an array without values".to_string());
    };
    let size = size_of_kind(kind).ok_or_else(|| format!("values of type {kind}"))?;
    let values = shape.iter().try_fold(size, |n, &length| n.checked_mul(length));
    if values != Some(range.len()) {
        return Err(format!("{} bytes of values for shape {shape:?} of {size} bytes each", range.len()));
    }
    Ok(Some(Array { shape, kind, range }))
}

/// Bytes of one stored value. MATLAB stores values in the smallest type that holds them, whatever the array's class.
fn size_of_kind(kind: u32) -> Option<usize> {
    match kind {
        1 | 2 => Some(1),
        3 | 4 => Some(2),
        5..=7 => Some(4),
        9 | 12 | 13 => Some(8),
        _ => None,
    }
}

fn decode(kind: u32, bytes: &[u8]) -> Vec<f64> {
    fn each<const N: usize>(bytes: &[u8], value: impl Fn([u8; N]) -> f64) -> Vec<f64> {
        bytes.chunks_exact(N).filter_map(|b| b.try_into().ok()).map(value).collect()
    }
    match kind {
        1 => each(bytes, |b| f64::from(i8::from_le_bytes(b))),
        2 => each(bytes, |b| f64::from(u8::from_le_bytes(b))),
        3 => each(bytes, |b| f64::from(i16::from_le_bytes(b))),
        4 => each(bytes, |b| f64::from(u16::from_le_bytes(b))),
        5 => each(bytes, |b| f64::from(i32::from_le_bytes(b))),
        6 => each(bytes, |b| f64::from(u32::from_le_bytes(b))),
        7 => each(bytes, |b| f64::from(f32::from_le_bytes(b))),
        9 => each(bytes, f64::from_le_bytes),
        12 => each(bytes, |b| i64::from_le_bytes(b) as f64),
        _ => each(bytes, |b| u64::from_le_bytes(b) as f64),
    }
}

#[cfg(test)]
mod tests;
