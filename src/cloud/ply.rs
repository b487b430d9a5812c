//! PLY files (Turk, "The PLY Polygon File Format", 1994).

use std::path::Path;

use super::columns::Columns;
use super::points::PointCloud;
use crate::depth::io::Scalar;
use crate::error::{Error, Result};

const EXPECTED: &str = "a PLY file whose element `vertex` has x, y and z";

/// What was found instead.
type Found<T> = std::result::Result<T, String>;

pub(super) fn decode(bytes: &[u8], path: &Path) -> Result<PointCloud> {
    read(bytes).map_err(|found| Error::format(path, found, EXPECTED))
}

enum Kind {
    Number(Scalar),
    /// Types of the length and of the entries.
    List(Scalar, Scalar),
}

struct Property<'a> {
    name: &'a str,
    kind: Kind,
}

struct Element<'a> {
    name: &'a str,
    count: usize,
    properties: Vec<Property<'a>>,
}

#[derive(Clone, Copy)]
enum Format {
    Text,
    Binary { big: bool },
}

fn read(bytes: &[u8]) -> Found<PointCloud> {
    let (format, elements, body) = header(bytes)?;
    let vertex = elements.iter().position(|e| e.name == "vertex").ok_or("no element `vertex`")?;
    let (before, vertex) = (&elements[..vertex], &elements[vertex]);
    let names: Vec<&str> = vertex.properties.iter().map(|p| p.name).collect();
    let byte = |i: usize| matches!(vertex.properties[i].kind, Kind::Number(Scalar::U8));
    let columns = Columns::find(&names, byte)?;
    let is_list =
        |name: &&Property| ["x", "y", "z"].contains(&name.name) && matches!(name.kind, Kind::List(..));
    if let Some(list) = vertex.properties.iter().find(is_list) {
        return Err(format!("a list as `{}`", list.name));
    }
    let mut source = match format {
        Format::Text => {
            Source::Text(std::str::from_utf8(body).map_err(|_| "elements that are not text")?.lines())
        }
        Format::Binary { big } => Source::Binary { rest: body, big },
    };
    let mut record = Vec::new();
    for element in before {
        // Each entry takes bytes of the file, unless it has no properties.
        for _ in 0..if element.properties.is_empty() { 0 } else { element.count } {
            source.next(element, &mut record)?;
        }
    }
    let mut cloud = columns.cloud();
    for _ in 0..vertex.count {
        source.next(vertex, &mut record)?;
        columns.push(&record, &mut cloud);
    }
    Ok(cloud)
}

/// The lines of text up to `end_header`, and what follows them.
fn header(bytes: &[u8]) -> Found<(Format, Vec<Element<'_>>, &[u8])> {
    let (mut format, mut elements) = (None, Vec::<Element>::new());
    let mut rest = bytes;
    let mut first = true;
    loop {
        let end = rest.iter().position(|&b| b == b'\n');
        let end = end.ok_or(if first { "no PLY header" } else { "no line end_header" })?;
        let line = std::str::from_utf8(&rest[..end]).map_err(|_| "a header that is not text")?;
        rest = &rest[end + 1..];
        let words: Vec<&str> = line.split_whitespace().collect();
        match (first, &words[..]) {
            (true, ["ply"]) => first = false,
            (true, _) => return Err("no PLY header".to_string()),
            (_, ["end_header"]) => {
                return Ok((format.ok_or("a header without a format")?, elements, rest));
            }
            (_, [] | ["comment" | "obj_info", ..]) => {}
            (_, ["format", kind, "1.0"]) => {
                format = Some(match *kind {
                    "ascii" => Format::Text,
                    "binary_little_endian" => Format::Binary { big: false },
                    "binary_big_endian" => Format::Binary { big: true },
                    other => return Err(format!("format {other:.30?}")),
                });
            }
            (_, ["element", name, count]) => {
                let count = count.parse().map_err(|_| format!("{count:.20?} elements `{name:.20}`"))?;
                elements.push(Element { name, count, properties: Vec::new() });
            }
            (_, ["property", "list", length, entry, name]) => {
                let kind = Kind::List(scalar(length)?, scalar(entry)?);
                last(&mut elements)?.properties.push(Property { name, kind });
            }
            (_, ["property", kind, name]) => {
                let kind = Kind::Number(scalar(kind)?);
                last(&mut elements)?.properties.push(Property { name, kind });
            }
            _ => return Err(format!("the line {:.40?} in the header", line.trim())),
        }
    }
}

fn last<'a, 'b>(elements: &'b mut [Element<'a>]) -> Found<&'b mut Element<'a>> {
    elements.last_mut().ok_or_else(|| "a property before the first element".to_string())
}

fn scalar(name: &str) -> Found<Scalar> {
    Ok(match name {
        "char" | "int8" => Scalar::I8,
        "uchar" | "uint8" => Scalar::U8,
        "short" | "int16" => Scalar::I16,
        "ushort" | "uint16" => Scalar::U16,
        "int" | "int32" => Scalar::I32,
        "uint" | "uint32" => Scalar::U32,
        "float" | "float32" => Scalar::F32,
        "double" | "float64" => Scalar::F64,
        other => return Err(format!("the type {other:.20?}")),
    })
}

/// What is left of the file.
enum Source<'a> {
    Text(std::str::Lines<'a>),
    Binary { rest: &'a [u8], big: bool },
}

impl Source<'_> {
    /// Reads the next entry of an element: one number per property, NaN for a list.
    fn next(&mut self, element: &Element, record: &mut Vec<f64>) -> Found<()> {
        record.clear();
        let cut = || {
            format!("the end of the file where the header announces {} `{:.20}`", element.count, element.name)
        };
        match self {
            Source::Text(lines) => {
                let line = lines.by_ref().find(|line| !line.trim().is_empty()).ok_or_else(cut)?;
                let wrong = || format!("the line {line:.40?} of `{:.20}`", element.name);
                text_record(line, element, record).ok_or_else(wrong)
            }
            Source::Binary { rest, big } => {
                *rest = binary_record(rest, *big, element, record).ok_or_else(cut)?;
                Ok(())
            }
        }
    }
}

/// `None` for anything but as many numbers as the element has.
fn text_record(line: &str, element: &Element, record: &mut Vec<f64>) -> Option<()> {
    let mut words = line.split_whitespace().map(|word| word.parse::<f64>().ok());
    for property in &element.properties {
        let number = words.next()??;
        match property.kind {
            Kind::Number(_) => record.push(number),
            Kind::List(..) => {
                for _ in 0..length(number)? {
                    words.next()??;
                }
                record.push(f64::NAN);
            }
        }
    }
    words.next().is_none().then_some(())
}

/// What follows the entry; `None` if it is cut.
fn binary_record<'a>(
    mut rest: &'a [u8],
    big: bool,
    element: &Element,
    record: &mut Vec<f64>,
) -> Option<&'a [u8]> {
    for property in &element.properties {
        match property.kind {
            Kind::Number(kind) => {
                record.push(kind.read(rest, big)?);
                rest = &rest[kind.size()..];
            }
            Kind::List(kind, entry) => {
                let count = length(kind.read(rest, big)?)?;
                rest = rest[kind.size()..].get(count.checked_mul(entry.size())?..)?;
                record.push(f64::NAN);
            }
        }
    }
    Some(rest)
}

/// The length of a list, which is a whole number.
fn length(number: f64) -> Option<usize> {
    (number >= 0.0 && number.fract() == 0.0 && number <= f64::from(u32::MAX)).then_some(number as usize)
}

/// A little-endian binary file.
pub(super) fn encode(cloud: &PointCloud) -> Vec<u8> {
    let mut header = format!("ply\nformat binary_little_endian 1.0\nelement vertex {}\n", cloud.len());
    let mut property = |kind: &str, names: &[&str]| {
        for name in names {
            header.push_str(&format!("property {kind} {name}\n"));
        }
    };
    property("float", &["x", "y", "z"]);
    if cloud.normals.is_some() {
        property("float", &["nx", "ny", "nz"]);
    }
    if cloud.colours.is_some() {
        property("uchar", &["red", "green", "blue"]);
    }
    if cloud.confidence.is_some() {
        property("float", &["confidence"]);
    }
    header.push_str("end_header\n");
    let mut bytes = header.into_bytes();
    bytes.reserve(cloud.len() * 31);
    for (i, point) in cloud.points.iter().enumerate() {
        bytes.extend(point.iter().flat_map(|v| v.to_le_bytes()));
        if let Some(normals) = &cloud.normals {
            bytes.extend(normals[i].iter().flat_map(|v| v.to_le_bytes()));
        }
        if let Some(colours) = &cloud.colours {
            bytes.extend(colours[i]);
        }
        if let Some(confidence) = &cloud.confidence {
            bytes.extend(confidence[i].to_le_bytes());
        }
    }
    bytes
}
