//! NumPy `.npz` files: ZIP archives of `.npy` arrays, stored (`numpy.savez`) or deflated (`numpy.savez_compressed`).
//!
//! Of ZIP (PKWARE's APPNOTE 6.3) only what NumPy writes is read: one part, no encryption, methods 0 and 8, sizes of 32 or 64
//! bits. Nothing is set aside by a size that the archive claims, and an array must have the checksum that stands there.

use std::fs::File;
use std::io::{Read, Seek, SeekFrom, Take};
use std::path::Path;

use flate2::Crc;
use flate2::read::DeflateDecoder;

use super::npy;
use super::raster::Raster;
use crate::error::{Error, Result};

const EXPECTED: &str = "a .npz archive as NumPy writes it";
/// The directory of an archive is refused beyond this: 2^20 bytes are more than ten thousand arrays.
const MAX_DIRECTORY: u64 = 1 << 20;
/// The end record and the longest comment behind it.
const LONGEST_END: u64 = 22 + 65535;

/// Reads the array of this name (with or without `.npy`), or without a name the only one.
///
/// # Errors
/// [`Error::Io`]; [`Error::Format`] for a damaged or foreign archive, for an absent name and for several arrays without a name
/// (both list what is there), otherwise as [`npy::read_npy`].
pub fn read_npz(path: &Path, name: Option<&str>) -> Result<Raster> {
    let file = File::open(path).map_err(Error::io(path))?;
    read_from(file, path, name)
}

fn read_from(mut file: impl Read + Seek, path: &Path, name: Option<&str>) -> Result<Raster> {
    let mut archive = Archive { file: &mut file, path };
    let members = archive.members()?;
    let member = choose(members, path, name)?;
    let what = path.join(&member.name);
    let data = archive.open(&member)?;
    let (array, found) = match member.method {
        0 => checked(data, &what)?,
        8 => checked(DeflateDecoder::new(data), &what)?,
        other => return Err(Error::format(&what, format!("compression method {other}"), "0 or 8 (deflate)")),
    };
    if found != member.checksum {
        return Err(Error::format(&what, "another checksum than the archive's", "undamaged data"));
    }
    Ok(array)
}

/// An array and the checksum of its bytes.
fn checked(reader: impl Read, path: &Path) -> Result<(Raster, u32)> {
    let mut summed = Summed { inner: reader, sum: Crc::new() };
    let array = npy::read_from(&mut summed, path)?;
    Ok((array, summed.sum.sum()))
}

struct Summed<R> {
    inner: R,
    sum: Crc,
}

impl<R: Read> Read for Summed<R> {
    fn read(&mut self, buffer: &mut [u8]) -> std::io::Result<usize> {
        let read = self.inner.read(buffer)?;
        self.sum.update(&buffer[..read]);
        Ok(read)
    }
}

/// An entry of the directory.
#[derive(Debug)]
struct Member {
    name: String,
    method: u16,
    encrypted: bool,
    checksum: u32,
    packed: u64,
    at: u64,
}

fn choose(members: Vec<Member>, path: &Path, name: Option<&str>) -> Result<Member> {
    let array = |member: &Member| member.name.strip_suffix(".npy").map(String::from);
    let names: Vec<String> = members.iter().filter_map(array).collect();
    let listed = || match names.len() {
        0 => "no arrays".to_string(),
        n => format!("{n} arrays ({}{})", names[..n.min(8)].join(", "), if n > 8 { ", .." } else { "" }),
    };
    let expected = match name {
        None => "one array, or the file's name followed by `:` and the array's".to_string(),
        Some(name) => format!("an array `{name}`"),
    };
    let wanted = |member: &Member| match name {
        None => names.len() == 1 && array(member).is_some(),
        Some(name) => member.name == name || array(member).is_some_and(|array| array == name),
    };
    members.into_iter().find(wanted).ok_or_else(|| Error::format(path, listed(), expected))
}

struct Archive<'a, F> {
    file: &'a mut F,
    path: &'a Path,
}

impl<F: Read + Seek> Archive<'_, F> {
    fn wrong(&self, found: impl Into<String>) -> Error {
        Error::format(self.path, found, EXPECTED)
    }

    /// So many bytes at a place, all of which must be there.
    fn bytes(&mut self, at: u64, count: u64, what: &str) -> Result<Vec<u8>> {
        self.file.seek(SeekFrom::Start(at)).map_err(Error::io(self.path))?;
        let mut bytes = Vec::new();
        (&mut *self.file).take(count).read_to_end(&mut bytes).map_err(Error::io(self.path))?;
        if (bytes.len() as u64) < count {
            return Err(self.wrong(format!("the end of the file inside {what}")));
        }
        Ok(bytes)
    }

    /// The entries of the directory.
    fn members(&mut self) -> Result<Vec<Member>> {
        let (at, size) = self.directory()?;
        if size > MAX_DIRECTORY {
            return Err(self.wrong(format!("a directory of {size} bytes")));
        }
        let directory = self.bytes(at, size, "the directory")?;
        let mut rest = directory.as_slice();
        let mut members = Vec::new();
        while !rest.is_empty() {
            let (member, behind) = entry(rest).ok_or_else(|| self.wrong("a damaged directory"))?;
            members.push(member);
            rest = behind;
        }
        Ok(members)
    }

    /// Place and size of the directory, from the record at the end.
    fn directory(&mut self) -> Result<(u64, u64)> {
        let length = self.file.seek(SeekFrom::End(0)).map_err(Error::io(self.path))?;
        let tail_at = length.saturating_sub(LONGEST_END);
        let tail = self.bytes(tail_at, length - tail_at, "the end record")?;
        // The record ends with its comment's length and the comment, which reaches to the end of the file.
        let is_end = |at: &usize| {
            tail[*at..].starts_with(b"PK\x05\x06")
                && u16_at(&tail, at + 20).is_some_and(|n| at + 22 + usize::from(n) == tail.len())
        };
        let end = (0..tail.len().saturating_sub(21)).rev().find(is_end);
        let end = end.ok_or_else(|| self.wrong("no end record of a ZIP archive"))?;
        let (Some(size), Some(at)) = (u32_at(&tail, end + 12), u32_at(&tail, end + 16)) else {
            return Err(self.wrong("a cut end record"));
        };
        if size != u32::MAX && at != u32::MAX {
            return Ok((at.into(), size.into()));
        }
        let locator =
            (tail_at + end as u64).checked_sub(20).ok_or_else(|| self.wrong("no 64-bit end record"))?;
        let locator = self.bytes(locator, 20, "the locator of the 64-bit end record")?;
        let long = u64_at(&locator, 8).filter(|_| locator.starts_with(b"PK\x06\x07"));
        let long = long.ok_or_else(|| self.wrong("no locator of the 64-bit end record"))?;
        let long = self.bytes(long, 56, "the 64-bit end record")?;
        match (long.starts_with(b"PK\x06\x06"), u64_at(&long, 48), u64_at(&long, 40)) {
            (true, Some(at), Some(size)) => Ok((at, size)),
            _ => Err(self.wrong("no 64-bit end record")),
        }
    }

    /// The packed bytes of a member, behind its own header.
    fn open(&mut self, member: &Member) -> Result<Take<&mut F>> {
        if member.encrypted {
            return Err(self.wrong(format!("an encrypted {}", member.name)));
        }
        let header = self.bytes(member.at, 30, "the header of an array")?;
        let lengths =
            u16_at(&header, 26).zip(u16_at(&header, 28)).filter(|_| header.starts_with(b"PK\x03\x04"));
        let (name, extra) =
            lengths.ok_or_else(|| self.wrong("no header of an array where the directory says"))?;
        self.file
            .seek(SeekFrom::Start(member.at + 30 + u64::from(name) + u64::from(extra)))
            .map_err(Error::io(self.path))?;
        Ok((&mut *self.file).take(member.packed))
    }
}

/// The first entry of a directory, and what follows it.
fn entry(bytes: &[u8]) -> Option<(Member, &[u8])> {
    let (head, rest) = bytes.split_at_checked(46).filter(|(head, _)| head.starts_with(b"PK\x01\x02"))?;
    let (name, rest) = rest.split_at_checked(u16_at(head, 28)?.into())?;
    let (extra, rest) = rest.split_at_checked(u16_at(head, 30)?.into())?;
    let (_, rest) = rest.split_at_checked(u16_at(head, 32)?.into())?;
    let (packed, whole, at) = (u32_at(head, 20)?, u32_at(head, 24)?, u32_at(head, 42)?);
    // What does not fit into 32 bits stands in the extra field 1, in this order.
    let mut long = long_sizes(extra);
    let mut wide = |short: u32| if short == u32::MAX { long.next() } else { Some(short.into()) };
    wide(whole)?;
    let member = Member {
        name: String::from_utf8_lossy(name).into_owned(),
        method: u16_at(head, 10)?,
        encrypted: u16_at(head, 8)? & 1 != 0,
        checksum: u32_at(head, 16)?,
        packed: wide(packed)?,
        at: wide(at).filter(|&at| at <= i64::MAX as u64 - (1 << 20))?,
    };
    Some((member, rest))
}

/// The 64-bit numbers of the extra field 1, if it is there.
fn long_sizes(mut extra: &[u8]) -> impl Iterator<Item = u64> + '_ {
    let mut found: &[u8] = &[];
    while let (Some(kind), Some(size)) = (u16_at(extra, 0), u16_at(extra, 2)) {
        let Some((field, rest)) = extra[4..].split_at_checked(size.into()) else { break };
        if kind == 1 {
            found = field;
            break;
        }
        extra = rest;
    }
    found.as_chunks::<8>().0.iter().map(|&bytes| u64::from_le_bytes(bytes))
}

fn array_at<const N: usize>(bytes: &[u8], at: usize) -> Option<[u8; N]> {
    bytes.get(at..)?.first_chunk().copied()
}

fn u16_at(bytes: &[u8], at: usize) -> Option<u16> {
    array_at(bytes, at).map(u16::from_le_bytes)
}

fn u32_at(bytes: &[u8], at: usize) -> Option<u32> {
    array_at(bytes, at).map(u32::from_le_bytes)
}

fn u64_at(bytes: &[u8], at: usize) -> Option<u64> {
    array_at(bytes, at).map(u64::from_le_bytes)
}

#[cfg(test)]
mod tests {
    use super::super::raster::Values;
    use super::*;
    use flate2::Compression;
    use flate2::write::DeflateEncoder;
    use std::io::{Cursor, Write};

    /// An archive as NumPy writes it; `long` with 64-bit sizes in every place that has them.
    fn archive(arrays: &[(&str, Vec<u8>)], deflated: bool, long: bool) -> Vec<u8> {
        let (mut bytes, mut directory) = (Vec::new(), Vec::new());
        for (name, data) in arrays {
            let packed = match deflated {
                false => data.clone(),
                true => {
                    let mut encoder = DeflateEncoder::new(Vec::new(), Compression::default());
                    encoder.write_all(data).unwrap();
                    encoder.finish().unwrap()
                }
            };
            let mut crc = Crc::new();
            crc.update(data);
            let at = bytes.len() as u64;
            let size = |n: usize| if long { u32::MAX } else { n as u32 }.to_le_bytes();
            let method: [u8; 2] = if deflated { [8, 0] } else { [0, 0] };
            let mut fields = [[45, 0], [0, 0], method, [0, 0], [0, 33]].concat();
            fields.extend(crc.sum().to_le_bytes());
            fields.extend([size(packed.len()), size(data.len())].concat());
            fields.extend((name.len() as u16).to_le_bytes());
            let mut extra = Vec::new();
            if long {
                extra.extend([9, 0, 1, 0, 7, 1, 0, 24, 0]);
                extra.extend([data.len() as u64, packed.len() as u64, at].map(u64::to_le_bytes).concat());
            }
            fields.extend((extra.len() as u16).to_le_bytes());
            directory.extend(b"PK\x01\x02\x2d\x03");
            directory.extend(&fields);
            directory.extend([0; 10]);
            directory.extend(if long { u32::MAX } else { at as u32 }.to_le_bytes());
            directory.extend([name.as_bytes(), &extra].concat());
            bytes.extend(b"PK\x03\x04");
            bytes.extend([&fields, name.as_bytes(), &extra, &packed].concat());
        }
        let (at, size) = (bytes.len() as u64, directory.len() as u64);
        bytes.extend(&directory);
        if long {
            let end = bytes.len() as u64;
            bytes.extend([&b"PK\x06\x06"[..], &[44, 0, 0, 0, 0, 0, 0, 0], &[0; 28]].concat());
            bytes.extend([size, at].map(u64::to_le_bytes).concat());
            bytes.extend([&b"PK\x06\x07\0\0\0\0"[..], &end.to_le_bytes(), &[1, 0, 0, 0]].concat());
        }
        bytes.extend([&b"PK\x05\x06"[..], &[0; 8]].concat());
        let short = |n: u64| if long { u32::MAX } else { n as u32 }.to_le_bytes();
        bytes.extend([short(size), short(at)].concat());
        bytes.extend([3, 0, b'a', b'b', b'c']);
        bytes
    }

    fn array(value: f32) -> Vec<u8> {
        npy::encode(40, 30, &[value; 1200]).unwrap()
    }

    fn read(bytes: &[u8], name: Option<&str>) -> Result<Raster> {
        read_from(Cursor::new(bytes), Path::new("test.npz"), name)
    }

    #[test]
    fn stored_and_deflated_arrays_by_name() {
        for (deflated, long) in [(false, false), (true, false), (false, true), (true, true)] {
            let bytes = archive(&[("a.npy", array(1.5)), ("depth.npy", array(2.5))], deflated, long);
            for (name, value) in [("a", 1.5), ("depth", 2.5), ("depth.npy", 2.5)] {
                let found = read(&bytes, Some(name)).unwrap();
                assert_eq!((found.width, found.height), (40, 30));
                assert_eq!(found.values, Values::Floats(vec![value; 1200]), "{name}");
            }
            let none = read(&bytes, Some("b")).unwrap_err().to_string();
            assert!(none.contains("2 arrays (a, depth)") && none.contains("`b`"), "{none}");
            let several = read(&bytes, None).unwrap_err().to_string();
            assert!(several.contains("2 arrays (a, depth)") && several.contains("one array"), "{several}");
            let one = archive(&[("a.npy", array(1.5)), ("note.txt", vec![1])], deflated, long);
            assert_eq!(read(&one, None).unwrap().values, Values::Floats(vec![1.5; 1200]));
        }
        assert!(read(&archive(&[], false, false), None).unwrap_err().to_string().contains("no arrays"));
    }

    #[test]
    fn every_truncation_and_every_changed_byte_ends_in_an_answer() {
        for (deflated, long) in [(false, true), (true, false)] {
            let small = npy::encode(3, 2, &[1.0; 6]).unwrap();
            let whole = archive(&[("a.npy", small)], deflated, long);
            for length in 0..whole.len() {
                assert!(matches!(read(&whole[..length], None), Err(Error::Format { .. })), "{length}");
            }
            let truth = read(&whole, None).unwrap();
            for at in 0..whole.len() {
                for flip in [1, 0x80, 0xff] {
                    let mut bytes = whole.clone();
                    bytes[at] ^= flip;
                    match read(&bytes, None) {
                        Ok(same) => assert_eq!(same, truth, "byte {at}"),
                        Err(Error::Format { .. } | Error::Io { .. } | Error::ImageSize { .. }) => {}
                        Err(other) => panic!("byte {at}: {other}"),
                    }
                }
            }
        }
    }

    #[test]
    fn a_bomb_is_not_unpacked() {
        // A megabyte of zeros behind the array of 24 bytes: reading stops one byte behind it.
        let mut bomb = npy::encode(3, 2, &[1.0; 6]).unwrap();
        bomb.resize(bomb.len() + (1 << 20), 0);
        let error = read(&archive(&[("a.npy", bomb)], true, false), None).unwrap_err().to_string();
        assert!(error.contains("more bytes of data"), "{error}");
    }
}
