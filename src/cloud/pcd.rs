//! PCD files of the Point Cloud Library (format 0.7, "The PCD (Point Cloud Data) file format", pointclouds.org).

use std::path::Path;

use super::columns::{Columns, is_packed_colour};
use super::points::PointCloud;
use crate::depth::io::Scalar;
use crate::depth::io::lzf;
use crate::error::{Error, Result};

const EXPECTED: &str = "a PCD file with fields x, y and z";

/// What was found instead.
type Found<T> = std::result::Result<T, String>;

pub(super) fn decode(bytes: &[u8], path: &Path) -> Result<PointCloud> {
    read(bytes).map_err(|found| Error::format(path, found, EXPECTED))
}

/// A field of a point: `count` numbers, of which the first is taken.
struct Field<'a> {
    name: &'a str,
    kind: Scalar,
    count: usize,
}

impl Field<'_> {
    /// PCL stores four bytes of colour as a number; they are read as the integer that they are.
    fn stored(&self, text: bool) -> Scalar {
        match (self.kind, text) {
            (Scalar::F32, false) if is_packed_colour(self.name) => Scalar::U32,
            (kind, _) => kind,
        }
    }

    fn size(&self) -> Option<usize> {
        self.kind.size().checked_mul(self.count)
    }
}

#[derive(Clone, Copy)]
enum Data {
    Text,
    Binary,
    Compressed,
}

struct Header<'a> {
    fields: Vec<Field<'a>>,
    points: usize,
    data: Data,
}

fn read(bytes: &[u8]) -> Found<PointCloud> {
    let (header, body) = header(bytes)?;
    let names: Vec<&str> = header.fields.iter().map(|f| f.name).collect();
    let columns = Columns::find(&names, |i| header.fields[i].kind == Scalar::U8)?;
    match header.data {
        Data::Text => text(body, &header, &columns),
        Data::Binary => {
            let size = record_size(&header)?;
            let claimed = header.points.checked_mul(size).ok_or("more points than memory has bytes")?;
            let body = body.get(..claimed).ok_or_else(|| cut(body.len(), claimed))?;
            // Where each field begins in a point, and how far the next point's is.
            let starts = header
                .fields
                .iter()
                .scan(0, |at, f| Some(std::mem::replace(at, *at + f.size().unwrap_or(0))));
            let starts: Vec<usize> = starts.collect();
            Ok(binary(body, &header, &columns, |field, point| point * size + starts[field]))
        }
        Data::Compressed => {
            let size = record_size(&header)?;
            let claimed = header.points.checked_mul(size).ok_or("more points than memory has bytes")?;
            let body = unpacked(body, claimed)?;
            // Field by field instead of point by point.
            let starts = header
                .fields
                .iter()
                .scan(0, |at, f| Some(std::mem::replace(at, *at + f.size().unwrap_or(0) * header.points)));
            let starts: Vec<usize> = starts.collect();
            let step: Vec<usize> = header.fields.iter().map(|f| f.size().unwrap_or(0)).collect();
            Ok(binary(&body, &header, &columns, |field, point| starts[field] + point * step[field]))
        }
    }
}

fn cut(found: usize, expected: usize) -> String {
    format!("{found} bytes of points where the header announces {expected}")
}

fn record_size(header: &Header) -> Found<usize> {
    let total = header.fields.iter().try_fold(0usize, |sum, f| sum.checked_add(f.size()?));
    total.ok_or_else(|| "fields of more bytes than memory has".to_string())
}

/// The lines of text up to `DATA`, and what follows them.
fn header(bytes: &[u8]) -> Found<(Header<'_>, &[u8])> {
    let (mut names, mut sizes, mut kinds, mut counts) = (vec![], vec![], vec![], vec![]);
    let (mut width, mut height, mut points) = (None, None, None);
    let mut rest = bytes;
    loop {
        let end = rest.iter().position(|&b| b == b'\n').ok_or("no line DATA")?;
        let line = std::str::from_utf8(&rest[..end]).map_err(|_| "a header that is not text")?;
        rest = &rest[end + 1..];
        let mut words = line.split_whitespace();
        let key = words.next().unwrap_or("");
        let values: Vec<&str> = words.collect();
        match key {
            "" | "VERSION" | "VIEWPOINT" => {}
            comment if comment.starts_with('#') => {}
            "FIELDS" | "COLUMNS" => names = values,
            "SIZE" => sizes = numbers(key, &values)?,
            "TYPE" => kinds = values,
            "COUNT" => counts = numbers(key, &values)?,
            "WIDTH" => width = Some(one(key, &values)?),
            "HEIGHT" => height = Some(one(key, &values)?),
            "POINTS" => points = Some(one(key, &values)?),
            "DATA" => {
                let data = match values[..] {
                    ["ascii"] => Data::Text,
                    ["binary"] => Data::Binary,
                    ["binary_compressed"] => Data::Compressed,
                    _ => return Err(format!("DATA {}", values.join(" "))),
                };
                let fields = fields(&names, &sizes, &kinds, &counts)?;
                let size = width.zip(height).and_then(|(w, h): (usize, usize)| w.checked_mul(h));
                let points = match (points, size) {
                    (Some(points), Some(size)) if points != size => {
                        return Err(format!("POINTS {points} where WIDTH times HEIGHT is {size}"));
                    }
                    (points, size) => points.or(size).ok_or("neither POINTS nor WIDTH and HEIGHT")?,
                };
                return Ok((Header { fields, points, data }, rest));
            }
            _ => return Err(format!("a line that begins with {:.20?} in the header", key)),
        }
    }
}

fn numbers(key: &str, values: &[&str]) -> Found<Vec<usize>> {
    let number = |value: &&str| value.parse().map_err(|_| format!("{key} {value:.20?}"));
    values.iter().map(number).collect()
}

fn one(key: &str, values: &[&str]) -> Found<usize> {
    match numbers(key, values)?[..] {
        [value] => Ok(value),
        _ => Err(format!("{key} with {} values", values.len())),
    }
}

fn fields<'a>(names: &[&'a str], sizes: &[usize], kinds: &[&str], counts: &[usize]) -> Found<Vec<Field<'a>>> {
    let n = names.len();
    if sizes.len() != n || kinds.len() != n || !(counts.is_empty() || counts.len() == n) {
        return Err(format!(
            "{n} FIELDS, {} SIZE, {} TYPE, {} COUNT",
            sizes.len(),
            kinds.len(),
            counts.len()
        ));
    }
    let field = |i: usize| {
        let kind = match (kinds[i], sizes[i]) {
            ("F", 2) => Scalar::F16,
            ("F", 4) => Scalar::F32,
            ("F", 8) => Scalar::F64,
            ("I", 1) => Scalar::I8,
            ("I", 2) => Scalar::I16,
            ("I", 4) => Scalar::I32,
            ("I", 8) => Scalar::I64,
            ("U", 1) => Scalar::U8,
            ("U", 2) => Scalar::U16,
            ("U", 4) => Scalar::U32,
            ("U", 8) => Scalar::U64,
            (kind, size) => return Err(format!("field {} of TYPE {kind:.20} and SIZE {size}", names[i])),
        };
        let count = counts.get(i).copied().unwrap_or(1);
        if count == 0 && ["x", "y", "z"].iter().any(|name| names[i].eq_ignore_ascii_case(name)) {
            return Err(format!("field {} with COUNT 0", names[i]));
        }
        Ok(Field { name: names[i], kind, count })
    };
    (0..n).map(field).collect()
}

/// Points whose numbers lie where `place` says, all within `body`.
fn binary(
    body: &[u8],
    header: &Header,
    columns: &Columns,
    place: impl Fn(usize, usize) -> usize,
) -> PointCloud {
    let mut cloud = columns.cloud();
    let mut record = vec![0.0; header.fields.len()];
    for point in 0..header.points {
        for (i, field) in header.fields.iter().enumerate() {
            let bytes = body.get(place(i, point)..).unwrap_or(&[]);
            record[i] = field.stored(false).read(bytes, false).unwrap_or(f64::NAN);
        }
        columns.push(&record, &mut cloud);
    }
    cloud
}

/// What two sizes and the packed bytes behind them hold.
fn unpacked(body: &[u8], claimed: usize) -> Found<Vec<u8>> {
    let size = |at: usize| Some(u32::from_le_bytes(*body.get(at..)?.first_chunk()?) as usize);
    let (packed, whole) = size(0).zip(size(4)).ok_or("the end of the file before the compressed points")?;
    if whole != claimed {
        return Err(format!("{whole} bytes of unpacked points where the header announces {claimed}"));
    }
    let data = body[8..].get(..packed).ok_or_else(|| cut(body.len() - 8, packed))?;
    lzf::unpack(data, whole)
        .filter(|unpacked| unpacked.len() == whole)
        .ok_or("damaged compressed points".to_string())
}

fn text(body: &[u8], header: &Header, columns: &Columns) -> Found<PointCloud> {
    let body = std::str::from_utf8(body).map_err(|_| "points that are not text")?;
    let lines = body.lines().map(str::trim).filter(|line| !line.is_empty() && !line.starts_with('#'));
    let mut cloud = columns.cloud();
    let mut record = vec![0.0; header.fields.len()];
    for (number, line) in lines.enumerate() {
        if number == header.points {
            return Err(format!("more lines than the {number} points of the header"));
        }
        let mut words = line.split_whitespace();
        for (i, field) in header.fields.iter().enumerate() {
            for nth in 0..field.count {
                let word = words.next().ok_or_else(|| format!("too few numbers for point {number}"))?;
                let value = word.parse().map_err(|_| format!("{word:.20?} in point {number}"))?;
                if nth == 0 {
                    record[i] = packed_text(field, value);
                }
            }
        }
        if words.next().is_some() {
            return Err(format!("too many numbers for point {number}"));
        }
        columns.push(&record, &mut cloud);
    }
    if cloud.len() < header.points {
        return Err(format!("{} lines of points where the header announces {}", cloud.len(), header.points));
    }
    Ok(cloud)
}

/// A colour that is written as a float is the integer with the same bits.
fn packed_text(field: &Field, value: f64) -> f64 {
    match field.stored(true) {
        Scalar::F32 if is_packed_colour(field.name) => f64::from((value as f32).to_bits()),
        _ => value,
    }
}

/// A binary file.
pub(super) fn encode(cloud: &PointCloud) -> Vec<u8> {
    let mut fields = vec!["x", "y", "z"];
    if cloud.normals.is_some() {
        fields.extend(["normal_x", "normal_y", "normal_z"]);
    }
    if cloud.colours.is_some() {
        fields.push("rgb");
    }
    if cloud.confidence.is_some() {
        fields.push("confidence");
    }
    let (n, points) = (fields.len(), cloud.len());
    let each = |word: &str| vec![word; n].join(" ");
    let header = format!(
        "# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\nFIELDS {}\nSIZE {}\nTYPE {}\nCOUNT {}\nWIDTH {points}\n\
         HEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {points}\nDATA binary\n",
        fields.join(" "),
        each("4"),
        each("F"),
        each("1")
    );
    let mut bytes = header.into_bytes();
    bytes.reserve(points * n * 4);
    for (i, point) in cloud.points.iter().enumerate() {
        bytes.extend(point.iter().flat_map(|v| v.to_le_bytes()));
        if let Some(normals) = &cloud.normals {
            bytes.extend(normals[i].iter().flat_map(|v| v.to_le_bytes()));
        }
        if let Some([red, green, blue]) = cloud.colours.as_ref().map(|colours| colours[i]) {
            bytes.extend([blue, green, red, 0]);
        }
        if let Some(confidence) = &cloud.confidence {
            bytes.extend(confidence[i].to_le_bytes());
        }
    }
    bytes
}
