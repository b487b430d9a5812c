use std::io::Write;

use flate2::Compression;
use flate2::write::ZlibEncoder;

use super::*;

/// A data element: tag, bytes, padding.
fn element(kind: u32, bytes: &[u8]) -> Vec<u8> {
    let mut out = [kind.to_le_bytes(), (bytes.len() as u32).to_le_bytes()].concat();
    out.extend(bytes);
    out.resize(out.len().next_multiple_of(8), 0);
    out
}

/// The short form of an element of at most four bytes.
fn small(kind: u32, bytes: &[u8]) -> Vec<u8> {
    let mut out = (kind | (bytes.len() as u32) << 16).to_le_bytes().to_vec();
    out.extend(bytes);
    out.resize(8, 0);
    out
}

fn head(class: u32, shape: &[u32], name: &str) -> Vec<u8> {
    let flags: Vec<u8> = [class, 0].iter().flat_map(|v| v.to_le_bytes()).collect();
    let shape: Vec<u8> = shape.iter().flat_map(|v| v.to_le_bytes()).collect();
    let name = if name.len() <= 4 { small(1, name.as_bytes()) } else { element(1, name.as_bytes()) };
    [element(6, &flags), element(5, &shape), name].concat()
}

fn array(class: u32, shape: &[u32], values: Vec<u8>) -> Vec<u8> {
    element(MATRIX, &[head(class, shape, ""), values].concat())
}

fn structure(name: &str, fields: &[(&str, Vec<u8>)]) -> Vec<u8> {
    let mut names = Vec::new();
    for (field, _) in fields {
        names.extend(field.bytes());
        names.resize(names.len().next_multiple_of(32), 0);
    }
    let values: Vec<u8> = fields.iter().flat_map(|(_, value)| value.clone()).collect();
    let start = [head(2, &[1, 1], name), small(5, &32u32.to_le_bytes()), element(1, &names)].concat();
    element(MATRIX, &[start, values].concat())
}

fn compressed(matrix: &[u8]) -> Vec<u8> {
    let mut encoder = ZlibEncoder::new(Vec::new(), Compression::default());
    encoder.write_all(matrix).unwrap();
    let bytes = encoder.finish().unwrap();
    // Compressed elements are not padded.
    [&COMPRESSED.to_le_bytes()[..], &(bytes.len() as u32).to_le_bytes(), &bytes].concat()
}

fn file(elements: &[Vec<u8>]) -> Vec<u8> {
    let mut out = vec![b' '; 124];
    out.extend([0, 1, b'I', b'M']);
    out.extend(elements.concat());
    out
}

fn read(bytes: &[u8]) -> Result<Record> {
    Record::parse(bytes, Path::new("x.mat"), "data")
}

fn says(bytes: &[u8], needle: &str) {
    match read(bytes) {
        Err(error @ Error::Format { .. }) => {
            let error = error.to_string();
            assert!(error.contains("x.mat") && error.contains(needle), "{error}");
        }
        Err(other) => panic!("{other}"),
        Ok(_) => panic!("read without the error {needle:?}"),
    }
}

fn example() -> Vec<u8> {
    let doubles: Vec<u8> = [1.5f64, -2.0, 1e300].iter().flat_map(|v| v.to_le_bytes()).collect();
    let text = array(4, &[1, 2], element(16, b"ab"));
    structure(
        "data",
        &[
            ("text", text),
            ("doubles", array(6, &[3, 1], element(9, &doubles))),
            // Doubles without fractions are stored in few bytes.
            ("bytes", array(6, &[2, 2], small(2, &[1, 2, 3, 4]))),
            ("shorts", array(10, &[1, 3], element(3, &[0xff, 0xff, 2, 0, 3, 1]))),
            ("empty", array(6, &[0, 0], element(9, &[]))),
            ("nothing", element(MATRIX, &[])),
        ],
    )
}

#[test]
fn fields_of_every_storage_are_read() {
    let before = element(MATRIX, &[head(6, &[1, 1], "before"), element(9, &[0; 8])].concat());
    for file in [file(&[before.clone(), example()]), file(&[compressed(&before), compressed(&example())])] {
        let record = read(&file).unwrap();
        assert_eq!(record.values("doubles", &[3, 1]).unwrap(), [1.5, -2.0, 1e300]);
        assert_eq!(record.values("bytes", &[2, 2]).unwrap(), [1.0, 2.0, 3.0, 4.0]);
        assert_eq!(record.values("shorts", &[1, 3]).unwrap(), [-1.0, 2.0, 259.0]);
        assert!(record.values("empty", &[0, 0]).unwrap().is_empty());
        assert!(record.field("text").is_none() && record.field("nothing").is_none());
        let wrong = record.values("bytes", &[4, 1]).unwrap_err().to_string();
        assert!(wrong.contains("x.mat") && wrong.contains("[2, 2]") && wrong.contains("[4, 1]"), "{wrong}");
        assert!(record.values("absent", &[1]).unwrap_err().to_string().contains("`absent`"));
    }
}

#[test]
fn other_files_are_named() {
    says(b"too short", "128");
    says(&[0; 200], "no MATLAB header");
    let mut other = file(&[example()]);
    other[124..128].copy_from_slice(&[0, 2, b'I', b'M']);
    says(&other, "7.3");
    other[124..128].copy_from_slice(b"\x01\x00MI");
    says(&other, "big-endian");
    says(&file(&[structure("date", &[])]), "no struct `data`");
    says(&file(&[element(MATRIX, &head(6, &[1, 1], "data"))]), "instead of one struct");
    says(&file(&[compressed(b"no elements")]), "element");
    says(&file(&[element(COMPRESSED, b"no zlib data")]), "damaged");
    says(&file(&[element(COMPRESSED, b"")]), "damaged");
    // The element is whole, the stream in it is not.
    let packed = compressed(&example());
    for length in (8..packed.len() - 1).step_by(5) {
        let mut cut = packed[..length].to_vec();
        cut[4..8].copy_from_slice(&(length as u32 - 8).to_le_bytes());
        says(&file(&[cut]), "damaged");
    }
}

#[test]
fn claims_beyond_the_file_set_nothing_aside() {
    let huge = array(6, &[u32::MAX, u32::MAX, u32::MAX], element(9, &[0; 16]));
    says(&file(&[structure("data", &[("huge", huge)])]), "16 bytes of values");
    let mut long = file(&[example()]);
    long[132..136].copy_from_slice(&u32::MAX.to_le_bytes());
    says(&long, "element of 4294967295 bytes");
    says(&file(&[vec![14, 0, 0xff, 0xff, 0, 0, 0, 0]]), "element");
    let bomb = vec![0; LARGEST as usize + 1];
    says(&file(&[compressed(&bomb)]), "more than");
}

#[test]
fn damaged_files_never_panic() {
    for whole in [file(&[example()]), file(&[compressed(&example())])] {
        for length in 0..whole.len() {
            assert!(matches!(read(&whole[..length]), Err(Error::Format { .. })), "{length}");
        }
        for at in 124..whole.len() {
            for flip in [1, 0x80, 0xff] {
                let mut damaged = whole.clone();
                damaged[at] ^= flip;
                if let Ok(record) = read(&damaged) {
                    for (name, array) in &record.fields {
                        let _ = record.values(name, &array.shape);
                    }
                }
            }
        }
    }
}
