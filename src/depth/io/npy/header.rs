//! What stands before the values: signature, version, and a Python dict literal with three fixed keys.

use std::io::Read;
use std::path::Path;

use super::element::Element;
use crate::error::{Error, Result};

pub(super) const MAGIC: &[u8; 6] = b"\x93NUMPY";
const MAX_HEADER: usize = 1 << 16;
const EXPECTED: &str = "a .npy array of integers or floats, of shape (H, W), (1, H, W) or (H, W, 1)";

/// Whether rows or columns lie together.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Order {
    Rows,
    Columns,
}

#[derive(Debug, Clone, Copy)]
pub(super) struct Header {
    pub(super) element: Element,
    pub(super) order: Order,
    pub(super) height: usize,
    pub(super) width: usize,
}

/// Reads up to the first value.
pub(super) fn read(reader: &mut impl Read, path: &Path) -> Result<Header> {
    let text = read_text(reader, path)?;
    parse(&text).map_err(|found| Error::format(path, found, EXPECTED))
}

fn read_text(reader: &mut impl Read, path: &Path) -> Result<String> {
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

/// Element type, order and shape, or what was found instead.
fn parse(header: &str) -> std::result::Result<Header, String> {
    let descr = quoted(field(header, "descr")?).ok_or("a structured element type")?;
    let element = Element::parse(descr).ok_or_else(|| format!("element type {descr}"))?;
    let order = field(header, "fortran_order")?;
    let order = match (order.starts_with("False"), order.starts_with("True")) {
        (true, _) => Order::Rows,
        (_, true) => Order::Columns,
        _ => return Err("an order that is neither True nor False".to_string()),
    };
    let shape = field(header, "shape")?;
    let inner = shape.strip_prefix('(').and_then(|s| s.split_once(')')).map(|(inner, _)| inner);
    let inner = inner.ok_or("a shape that is not a tuple")?;
    let (height, width) = rows_and_columns(inner).ok_or_else(|| format!("shape ({inner})"))?;
    Ok(Header { element, order, height, width })
}

/// The two axes of a shape that are left without those of length 1 before and behind them.
fn rows_and_columns(inner: &str) -> Option<(usize, usize)> {
    // Python 2 wrote an L behind long integers.
    let sizes =
        inner.split(',').map(|size| size.trim().trim_end_matches('L')).filter(|size| !size.is_empty());
    let sizes = sizes.map(|size| size.parse().ok()).collect::<Option<Vec<usize>>>()?;
    let mut axes = sizes.as_slice();
    while let (3.., [1, rest @ ..]) = (axes.len(), axes) {
        axes = rest;
    }
    while let (3.., [rest @ .., 1]) = (axes.len(), axes) {
        axes = rest;
    }
    match axes {
        &[rows, columns] => Some((rows, columns)),
        _ => None,
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
