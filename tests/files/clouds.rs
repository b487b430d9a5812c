//! Point clouds.

use super::{expected, fixture, triples};
use proptest::collection::vec;
use proptest::prelude::*;
use sdim::Error;
use sdim::cloud::PointCloud;

fn close(found: &[[f32; 3]], truth: &[[f32; 3]], by: f32) -> bool {
    found.len() == truth.len()
        && found.iter().flatten().zip(truth.iter().flatten()).all(|(a, b)| (a - b).abs() <= by)
}

#[test]
fn clouds_of_other_tools_are_read() {
    let truth = expected("cloud");
    let (points, normals) = (triples(&truth["points"]), triples(&truth["normals"]));
    let colours: Vec<[u8; 3]> = triples(&truth["colours"]).into_iter().map(|c| c.map(|v| v as u8)).collect();
    let mut read = 0;
    for entry in std::fs::read_dir(fixture("clouds")).unwrap() {
        let path = entry.unwrap().path();
        let name = path.file_name().unwrap().to_str().unwrap();
        let cloud = PointCloud::read(&path).unwrap();
        // Text is rounded, by Open3D's PLY to six digits.
        let by = if name.contains("ascii") { 1e-4 } else { 0.0 };
        assert!(close(&cloud.points, &points, by), "{name}");
        let (with_normals, with_colours) =
            (name.starts_with("open3d"), !name.contains("pypcd4") && name != "velodyne.bin");
        assert_eq!(
            (cloud.normals.is_some(), cloud.colours.is_some()),
            (with_normals, with_colours),
            "{name}"
        );
        // Open3D's own normals are doubles.
        assert!(cloud.normals.is_none_or(|n| close(&n, &normals, by.max(1e-6))), "{name}");
        assert!(cloud.colours.is_none_or(|c| c == colours), "{name}");
        read += 1;
    }
    assert_eq!(read, 12);
}

fn sample() -> PointCloud {
    PointCloud {
        points: vec![[1.0, -2.5, 3e-3], [f32::NAN; 3], [7.0, 8.0, 9.0]],
        colours: Some(vec![[1, 2, 3], [0, 255, 128], [255, 255, 255]]),
        normals: Some(vec![[0.0, 0.0, -1.0], [f32::NAN; 3], [0.6, 0.0, -0.8]]),
        confidence: Some(vec![0.25, 0.0, 1.0]),
    }
}

/// With every bit, so that NaN is equal to itself.
fn bits(cloud: &PointCloud) -> impl PartialEq + std::fmt::Debug {
    let of = |v: &[[f32; 3]]| v.iter().flatten().map(|c| c.to_bits()).collect::<Vec<_>>();
    let confidence = cloud.confidence.as_ref().map(|c| c.iter().map(|c| c.to_bits()).collect::<Vec<_>>());
    (of(&cloud.points), cloud.normals.as_deref().map(of), cloud.colours.clone(), confidence)
}

#[test]
fn what_is_written_is_read_back_bit_for_bit() {
    let dir = tempfile::tempdir().unwrap();
    for ending in ["ply", "pcd"] {
        let path = dir.path().join(format!("cloud.{ending}"));
        for parts in 0..8 {
            let mut cloud = sample();
            cloud.colours = cloud.colours.filter(|_| parts & 1 != 0);
            cloud.normals = cloud.normals.filter(|_| parts & 2 != 0);
            cloud.confidence = cloud.confidence.filter(|_| parts & 4 != 0);
            cloud.write(&path).unwrap();
            assert_eq!(bits(&PointCloud::read(&path).unwrap()), bits(&cloud), "{ending} {parts}");
        }
        let empty = PointCloud::default();
        empty.write(&path).unwrap();
        assert!(PointCloud::read(&path).unwrap().is_empty());
    }
    let short = PointCloud { colours: Some(vec![[0; 3]]), ..sample() };
    let path = dir.path().join("short.ply");
    assert!(matches!(
        short.write(&path),
        Err(Error::BufferLength { what: "colours", expected: 3, found: 1 })
    ));
    assert!(!path.exists());
    for ending in ["xyz", "bin"] {
        let other = sample().write(dir.path().join(format!("a.{ending}"))).unwrap_err().to_string();
        assert!(other.contains("pcd or ply"), "{other}");
    }
}

/// A file of this name with this content.
fn read(name: &str, bytes: &[u8]) -> sdim::Result<PointCloud> {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join(name);
    std::fs::write(&path, bytes).unwrap();
    PointCloud::read(path)
}

#[test]
fn organised_files_and_packed_fields_of_pcl() {
    let header = |data: &str, size: &str| {
        format!(
            "# .PCD v0.7\nVERSION 0.7\nFIELDS x y z rgb _ label\nSIZE 4 4 4 4 1 2\nTYPE F F F F U U\nCOUNT 1 1 1 1 3 2\n{size}\
             VIEWPOINT 0 0 0 1 0 0 0\nDATA {data}\n"
        )
    };
    // Alpha of 255 makes a NaN of the float that holds the colour.
    let mut bytes = header("binary", "WIDTH 1\nHEIGHT 2\nPOINTS 2\n").into_bytes();
    for (z, colour) in [(3.0f32, 0xff01_0203u32), (f32::NAN, 0x000a_0b0c)] {
        bytes.extend([1.0, 2.0, z].iter().flat_map(|v: &f32| v.to_le_bytes()));
        bytes.extend(colour.to_le_bytes());
        bytes.extend([9; 7]);
    }
    let cloud = read("a.pcd", &bytes).unwrap();
    assert_eq!(cloud.points[0], [1.0, 2.0, 3.0]);
    assert!(cloud.points[1][2].is_nan());
    assert_eq!(cloud.colours, Some(vec![[1, 2, 3], [10, 11, 12]]));
    // Old files write the float, new ones the integer.
    let float = f32::from_bits(0x0001_0203);
    let text = format!(
        "{}1 2 3 {float:e} 9 9 9 7 7\n\n1 2 nan {float:e} 9 9 9 7 7\n",
        header("ascii", "WIDTH 2\nHEIGHT 1\n")
    );
    let cloud = read("a.pcd", text.as_bytes()).unwrap();
    assert_eq!((cloud.len(), cloud.colours), (2, Some(vec![[1, 2, 3]; 2])));
}

#[test]
fn what_is_wrong_is_named() {
    let pcd = |change: fn(&str) -> String, body: &[u8]| {
        let header = "VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 2\nHEIGHT 1\nPOINTS 2\nDATA binary\n";
        read("a.pcd", &[change(header).as_bytes(), body].concat()).unwrap_err().to_string()
    };
    let ply = |header: &str, body: &[u8]| {
        let head = format!("ply\nformat binary_little_endian 1.0\n{header}end_header\n");
        read("a.ply", &[head.as_bytes(), body].concat()).unwrap_err().to_string()
    };
    let xyz = "property float x\nproperty float y\nproperty float z\n";
    for (message, named) in [
        (pcd(str::to_string, &[0; 23]), "23 bytes of points where the header announces 24"),
        (pcd(|h| h.replace("x y z", "x y w"), &[0; 24]), "fields x y w"),
        (pcd(|h| h.replace("TYPE F F", "TYPE F Q"), &[0; 24]), "field y of TYPE Q and SIZE 4"),
        (pcd(|h| h.replace("SIZE 4 4 4", "SIZE 4 4"), &[0; 24]), "2 SIZE"),
        (pcd(|h| h.replace("POINTS 2", "POINTS 3"), &[0; 24]), "POINTS 3 where WIDTH times HEIGHT is 2"),
        (pcd(|h| h.replace("WIDTH 2", "WIDTH -2"), &[0; 24]), "WIDTH \"-2\""),
        (
            pcd(|h| h.replace("WIDTH 2", "WIDTH 18446744073709551615").replace("POINTS 2\n", ""), &[0; 24]),
            "more points",
        ),
        (pcd(|h| h.replace("COUNT 1 1 1", "COUNT 1 1 18446744073709551615"), &[0; 24]), "more bytes"),
        (pcd(|h| h.replace("DATA binary", "DATA zip"), &[0; 24]), "DATA zip"),
        (pcd(|h| h.replace("binary", "binary_compressed"), &[5, 0, 0, 0, 24, 0, 0, 0, 1, 2]), "announces 5"),
        (pcd(|h| h.replace("binary", "binary_compressed"), &[2, 0, 0, 0, 24, 0, 0, 0, 1, 2]), "damaged"),
        (pcd(|h| h.replace("binary", "binary_compressed"), &[2, 0, 0, 0, 99, 0, 0, 0, 1, 2]), "99 bytes"),
        (pcd(|h| h.replace("binary", "ascii"), b"1 2 3\n"), "1 lines of points where the header announces 2"),
        (pcd(|h| h.replace("binary", "ascii"), b"1 2 3\n4 5\n"), "too few numbers for point 1"),
        (pcd(|h| h.replace("binary", "ascii"), b"1 2 3\n4 5 6 7\n"), "too many numbers for point 1"),
        (pcd(|h| h.replace("binary", "ascii"), b"1 2 3\n4 5 a\n"), "\"a\" in point 1"),
        (pcd(|_| String::new(), b"\x89PNG"), "no line DATA"),
        (ply(&format!("element vertex 2\n{xyz}"), &[0; 23]), "announces 2 `vertex`"),
        (ply(&format!("element vertex 99999999999\n{xyz}"), &[0; 23]), "announces 99999999999"),
        (ply("element vertex 2\nproperty float x\n", &[0; 24]), "fields x"),
        (
            ply(
                "element vertex 2\nproperty list uchar float x\nproperty float y\nproperty float z\n",
                &[0; 24],
            ),
            "a list as `x`",
        ),
        (ply(&format!("element face 2\n{xyz}"), &[0; 24]), "no element `vertex`"),
        (ply("property float x\n", &[]), "a property before"),
        (ply("element vertex two\n", &[]), "\"two\" elements"),
        (ply("element vertex 2\nproperty quad x\n", &[]), "the type \"quad\""),
        (read("a.ply", b"ply\nformat ascii 2.0\n").unwrap_err().to_string(), "format ascii 2.0"),
        (read("a.ply", b"solid").unwrap_err().to_string(), "no PLY header"),
        (read("a.xyz", b"1 2 3").unwrap_err().to_string(), "pcd, ply or bin"),
    ] {
        assert!(message.contains(named) && message.contains("expected"), "{named:?} is not in {message:?}");
    }
    // A billion elements without properties take no time.
    let empty = format!(
        "ply\nformat binary_little_endian 1.0\nelement a 9999999999999\nelement vertex 1\n{xyz}end_header\n"
    );
    assert_eq!(read("a.ply", &[empty.as_bytes(), &[0; 12]].concat()).unwrap().len(), 1);
}

#[test]
fn every_truncation_and_every_changed_byte_ends_in_an_answer() {
    for name in [
        "open3d_binary.pcd",
        "open3d_ascii.pcd",
        "pypcd4_binary_compressed.pcd",
        "plyfile_big.ply",
        "plyfile_ascii.ply",
    ] {
        let whole = std::fs::read(fixture("clouds").join(name)).unwrap();
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join(name);
        let read = |bytes: &[u8]| {
            std::fs::write(&path, bytes).unwrap();
            PointCloud::read(&path)
        };
        for length in (0..whole.len()).step_by(3) {
            // The last number of a text may lose digits.
            if !(name.contains("ascii") && length + 20 > whole.len()) {
                assert!(
                    matches!(read(&whole[..length]), Err(Error::Format { .. })),
                    "{name}: {length} bytes"
                );
            }
        }
        for at in (0..whole.len()).filter(|at| *at < 300 || at % 5 == 0) {
            let mut bytes = whole.clone();
            bytes[at] ^= 1 << (at % 8);
            let _ = read(&bytes).map(|cloud| assert!(cloud.len() <= whole.len()));
        }
    }
}

proptest! {
    #[test]
    fn any_cloud_survives_its_files(
        points in vec(any::<[f32; 3]>(), 0..40), colour: [u8; 3], normal: [f32; 3], confidence: f32, parts in 0u8..8,
    ) {
        let n = points.len();
        let cloud = PointCloud {
            points,
            colours: (parts & 1 != 0).then(|| vec![colour; n]),
            normals: (parts & 2 != 0).then(|| vec![normal; n]),
            confidence: (parts & 4 != 0).then(|| vec![confidence; n]),
        };
        let dir = tempfile::tempdir().unwrap();
        for name in ["a.ply", "a.pcd"] {
            let path = dir.path().join(name);
            cloud.write(&path).unwrap();
            let back = PointCloud::read(&path).unwrap();
            prop_assert_eq!(back.len(), n);
            // A signalling NaN may become a quiet one on its way.
            let same = |a: f32, b: f32| a.to_bits() == b.to_bits() || a.is_nan() && b.is_nan();
            prop_assert!(back.points.iter().flatten().zip(cloud.points.iter().flatten()).all(|(&a, &b)| same(a, b)));
            prop_assert_eq!(&back.colours, &cloud.colours);
            prop_assert_eq!(back.normals.is_some(), cloud.normals.is_some());
        }
    }

    #[test]
    fn any_bytes_behind_a_header_end_in_an_answer(
        body in vec(any::<u8>(), 0..300), points in any::<u32>(), count in 0usize..5, kind in 0usize..6,
    ) {
        let pcd = ["ascii", "binary", "binary_compressed"][kind % 3];
        let ply = ["ascii", "binary_little_endian", "binary_big_endian"][kind % 3];
        let points = if kind < 3 { points as usize } else { points as usize % 20 };
        let pcd = format!("FIELDS a x y z\nSIZE 2 4 8 1\nTYPE U F F I\nCOUNT {count} 1 1 1\nPOINTS {points}\nDATA {pcd}\n");
        let ply = format!(
            "ply\nformat {ply} 1.0\nelement face {count}\nproperty list uchar short i\nelement vertex {points}\nproperty float x\n\
             property list ushort int l\nproperty double y\nproperty char z\nend_header\n"
        );
        for (name, header) in [("a.pcd", pcd), ("a.ply", ply)] {
            match read(name, &[header.as_bytes(), &body].concat()) {
                Ok(cloud) => prop_assert!(cloud.len() <= 300 * 88),
                Err(Error::Format { .. }) => {}
                Err(other) => prop_assert!(false, "{other}"),
            }
        }
    }
}

#[test]
fn points_without_bytes_are_refused_however_many_are_announced() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("empty.pcd");
    for data in ["binary", "binary_compressed", "ascii"] {
        for names in ["x y z", "X Y Z"] {
            let header = format!(
                "FIELDS {names}\nSIZE 4 4 4\nTYPE F F F\nCOUNT 0 0 0\nPOINTS {}\nDATA {data}\n",
                usize::MAX
            );
            std::fs::write(&path, header).unwrap();
            assert!(matches!(PointCloud::read(&path), Err(Error::Format { .. })), "{names} {data}");
        }
    }
}
