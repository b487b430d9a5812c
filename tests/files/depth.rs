//! Depth images and pictures.

use super::{expected, fixture, numbers};
use sdim::{DepthScale, Error, SparseDepth, read_rgb};
use std::path::Path;

/// Names end in the element type.
#[test]
fn every_container_holds_the_same_map() {
    let metres = numbers(&expected("metres"));
    let mut read = 0;
    for entry in std::fs::read_dir(fixture("depth")).unwrap() {
        let path = entry.unwrap().path();
        let kind = path.file_stem().unwrap().to_str().unwrap();
        let integers = matches!(&kind[kind.len() - 2..kind.len() - 1], "i" | "u");
        let several = path.with_file_name("stored_two_f4.npz") == path;
        let path = if several { Path::new(&format!("{}:depth", path.display())).to_path_buf() } else { path };
        if integers {
            let unknown = SparseDepth::read(&path, None);
            assert!(
                matches!(unknown, Err(Error::Argument { name: "depth scale", .. })),
                "{}",
                path.display()
            );
        }
        let map = SparseDepth::read(&path, integers.then(DepthScale::millimetres)).unwrap();
        assert_eq!((map.width(), map.height()), (5, 4), "{}", path.display());
        let close = if path.to_str().unwrap().contains("f2.") {
            5e-3
        } else if integers {
            5.1e-4
        } else {
            1e-9
        };
        for (&found, &truth) in map.as_slice().iter().zip(&metres) {
            let (found, missing) = (f64::from(found), truth == 0.0);
            assert_eq!(found.is_nan(), missing, "{}", path.display());
            assert!(missing || (found - truth).abs() <= close, "{}: {found} for {truth}", path.display());
        }
        read += 1;
    }
    assert_eq!(read, 29);
}

#[test]
fn integers_are_those_of_the_file() {
    let millimetres = numbers(&expected("millimetres"));
    for name in [
        "i2.npy",
        "i4.npy",
        "i8.npy",
        "u2.npy",
        "u4.npy",
        "u8.npy",
        "big_u2.npy",
        "alpha_u2.png",
        "pillow_tiff_lzw_u2.tif",
    ] {
        let map = SparseDepth::read(fixture("depth").join(name), Some(DepthScale::millimetres())).unwrap();
        for (&found, &truth) in map.as_slice().iter().zip(&millimetres) {
            let same = if truth == 0.0 { found.is_nan() } else { found == truth as f32 / 1000.0 };
            assert!(same, "{name}: {found} for {truth}");
        }
    }
}

#[test]
fn archives_of_several_arrays_ask_for_a_name() {
    let path = fixture("depth/stored_two_f4.npz");
    let unclear = SparseDepth::read(&path, None).unwrap_err().to_string();
    assert!(unclear.contains("depth, other") && unclear.contains("`:`"), "{unclear}");
    let other = SparseDepth::read(format!("{}:other", path.display()), None).unwrap();
    assert_eq!(other.get(0, 0), Some(1.0));
    let none = SparseDepth::read(format!("{}:mask", path.display()), None).unwrap_err().to_string();
    assert!(none.contains("`mask`") && none.contains("depth, other"), "{none}");
}

#[test]
fn pictures_of_every_format_are_the_same() {
    let picture = expected("picture");
    let rgb: Vec<u8> = numbers(&picture["rgb"]).into_iter().map(|v| v as u8).collect();
    for ending in ["webp", "bmp", "tif"] {
        let found = read_rgb(fixture(&format!("pictures/picture.{ending}"))).unwrap();
        assert_eq!((found.dimensions(), found.as_raw()), ((7, 6), &rgb), "{ending}");
    }
}
