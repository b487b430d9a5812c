//! Benchmarks stored in HDF5 and MATLAB files, on frames that `tests/reference/make_benchmarks.py` wrote, and on damaged ones.

use std::fs;
use std::path::{Path, PathBuf};

use sdim::Error;
use sdim::benchmarks::Layout;
use sdim::depth::SparsePattern;
use serde_json::Value;

use crate::{all, open, says, without_depth};

fn fixture(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures/benchmarks").join(name)
}

fn copy(from: &str, to: &Path) -> Vec<u8> {
    fs::create_dir_all(to.parent().unwrap()).unwrap();
    fs::copy(fixture(from), to).unwrap();
    fs::read(to).unwrap()
}

/// Replaces one occurrence of some 64-bit numbers.
fn patch(bytes: &[u8], find: &[u64], with: &[u64]) -> Vec<u8> {
    let raw = |numbers: &[u64]| numbers.iter().flat_map(|n| n.to_le_bytes()).collect::<Vec<_>>();
    let (find, with) = (raw(find), raw(with));
    let at = bytes.windows(find.len()).position(|w| w == find).expect("the numbers are in the file");
    [&bytes[..at], &with, &bytes[at + with.len()..]].concat()
}

/// A row of numbers that is the same in every run.
fn scattered(count: usize, below: usize) -> impl Iterator<Item = usize> {
    (0..count as u64).map(move |i| {
        let mixed = (i + 1).wrapping_mul(0x9e37_79b9_7f4a_7c15);
        ((mixed ^ (mixed >> 29)) % below as u64) as usize
    })
}

#[test]
fn nyu_is_halved_and_cropped_as_the_reference_does() {
    let expected: Value = serde_json::from_slice(&fs::read(fixture("nyu_expected.json")).unwrap()).unwrap();
    let sample = all(Layout::Nyu, &fixture("nyu")).unwrap().remove(0);
    assert_eq!((sample.name.as_str(), sample.rgb.dimensions()), ("00001", (304, 228)));
    let valid = sample.gt.iter().filter(|d| !d.is_nan()).count();
    assert_eq!(valid as u64, expected["valid"].as_u64().unwrap());
    let colours: u64 = sample.rgb.as_raw().iter().map(|&v| u64::from(v)).sum();
    assert_eq!(colours, expected["colours"].as_u64().unwrap());
    let mut holes = 0;
    for pixel in expected["pixels"].as_array().unwrap() {
        let number = |i: usize| pixel[i].as_u64().unwrap() as u32;
        let (x, y) = (number(0), number(1));
        assert_eq!(sample.rgb[(x, y)].0.map(u32::from), [number(2), number(3), number(4)], "({x}, {y})");
        let depth = sample.gt[(y * 304 + x) as usize];
        match pixel[5].as_f64() {
            Some(reference) => assert_eq!(depth, reference as f32, "({x}, {y})"),
            None => assert!(depth.is_nan(), "({x}, {y}) {depth}"),
        }
        holes += usize::from(depth.is_nan());
    }
    assert!(holes > 20, "{holes}");
    assert_eq!(sample.measurements(500, SparsePattern::Uniform, 3).unwrap().measured(), 500);
}

#[test]
fn the_nyu_bundle_has_its_own_points() {
    let set = open(Layout::Nyu, &fixture("nyu_bundle")).unwrap();
    assert_eq!((set.len(), set.name(1), set.name(2)), (2, "0001".to_string(), String::new()));
    let sample = set.load(1).unwrap();
    assert_eq!(sample.rgb[(41, 35)].0, [10, 2, 107]);
    assert_eq!((sample.gt[0], sample.gt[303]), (3.0, 5.25));
    let sparse = sample.sparse.unwrap();
    assert!(sparse.measured() > 400, "{}", sparse.measured());
    for (x, y, depth) in sparse.points() {
        assert_eq!((x * 31 + y * 17 + 5) % 139, 0);
        assert_eq!(depth, 3.0 + (x / 32) as f32 / 4.0);
    }
    assert!(matches!(set.load(2), Err(Error::Argument { name: "index", .. })));

    let dir = tempfile::tempdir().unwrap();
    let images = copy("nyu_bundle/nyu_img_gt.h5", &dir.path().join("nyu_img_gt.h5"));
    assert!(open(Layout::Nyu, dir.path()).unwrap().load(0).unwrap().sparse.is_none());
    fs::write(dir.path().join("nyu_pred_with_500.h5"), images).unwrap();
    says(Layout::Nyu, dir.path(), &["nyu_pred_with_500.h5", "hints"]);
}

#[test]
fn other_hdf5_files_are_named() {
    let dir = tempfile::tempdir().unwrap();
    says(Layout::Nyu, dir.path(), &["no frame", ".h5"]);
    says(Layout::Nyu, &dir.path().join("absent"), &["absent"]);
    let path = dir.path().join("00001.h5");
    copy("nyu_bundle/nyu_pred_with_500.h5", &path);
    says(Layout::Nyu, dir.path(), &["00001.h5", "rgb"]);
    fs::write(&path, b"no HDF5").unwrap();
    says(Layout::Nyu, dir.path(), &["00001.h5"]);
    let whole = copy("nyu/val/official/00001.h5", &path);
    // Sizes that lie: refused by shape, before anything of that size is read.
    for shape in [[3, 480, 641], [3, 1 << 40, 640], [u64::MAX, 480, 640]] {
        fs::write(&path, patch(&whole, &[3, 480, 640], &shape)).unwrap();
        says(Layout::Nyu, dir.path(), &["00001.h5", "rgb"]);
    }
    let bundle = tempfile::tempdir().unwrap();
    let path = bundle.path().join("nyu_img_gt.h5");
    let whole = copy("nyu_bundle/nyu_img_gt.h5", &path);
    let lie = patch(&whole, &[2, 228, 304, 3], &[1 << 50, 228, 304, 3]);
    let lie = patch(&lie, &[2, 228, 304, 1], &[1 << 50, 228, 304, 1]);
    fs::write(&path, lie).unwrap();
    says(Layout::Nyu, bundle.path(), &["nyu_img_gt.h5", "shape"]);
    fs::write(&path, patch(&whole, &[2, 228, 304, 3], &[1, 228, 304, 3])).unwrap();
    says(Layout::Nyu, bundle.path(), &["nyu_img_gt.h5", "1 pictures and 2 depth maps"]);
}

#[test]
fn damaged_hdf5_files_never_panic() {
    let dir = tempfile::tempdir().unwrap();
    let images = copy("nyu_bundle/nyu_img_gt.h5", &dir.path().join("nyu_img_gt.h5"));
    let hints = copy("nyu_bundle/nyu_pred_with_500.h5", &dir.path().join("nyu_pred_with_500.h5"));
    for (name, whole) in [("nyu_img_gt.h5", images), ("nyu_pred_with_500.h5", hints)] {
        let path = dir.path().join(name);
        for length in (0..12).map(|i| whole.len() * i / 12) {
            fs::write(&path, &whole[..length]).unwrap();
            says(Layout::Nyu, dir.path(), &[name]);
        }
        // Most of the structure stands in the first kilobytes.
        for at in scattered(60, 4096.min(whole.len())).chain(scattered(20, whole.len())) {
            let mut damaged = whole.clone();
            damaged[at] ^= 0xa5;
            fs::write(&path, damaged).unwrap();
            if let Err(error) = open(Layout::Nyu, dir.path()).and_then(|set| set.load(1)) {
                assert!(matches!(error, Error::Format { .. } | Error::Io { .. }), "{at}: {error:?}");
            }
        }
        fs::write(&path, whole).unwrap();
    }
}

#[test]
fn huge_numbers_in_hdf5_files_set_nothing_aside() {
    let dir = tempfile::tempdir().unwrap();
    let images = copy("nyu_bundle/nyu_img_gt.h5", &dir.path().join("nyu_img_gt.h5"));
    let hints = copy("nyu_bundle/nyu_pred_with_500.h5", &dir.path().join("nyu_pred_with_500.h5"));
    for (start, name, whole) in [(0, "nyu_img_gt.h5", images), (8, "nyu_pred_with_500.h5", hints)] {
        // Addresses, lengths and sizes are 64-bit numbers, most of them aligned; a part of them, for time's sake.
        for (at, huge) in
            (start..4096).step_by(24).zip([u64::MAX, i64::MAX as u64, 1 << 40].into_iter().cycle())
        {
            let mut damaged = whole.clone();
            damaged[at..at + 8].copy_from_slice(&huge.to_le_bytes());
            fs::write(dir.path().join(name), damaged).unwrap();
            if let Err(error) = open(Layout::Nyu, dir.path()).and_then(|set| set.load(1)) {
                assert!(matches!(error, Error::Format { .. } | Error::Io { .. }), "{at}: {error:?}");
            }
        }
        fs::write(dir.path().join(name), whole).unwrap();
    }
    if let Some(peak) = sdim::system::peak_rss_bytes() {
        assert!(peak < 1 << 30, "{peak} bytes");
    }
}

#[test]
fn ibims_counts_what_all_masks_allow() {
    let samples = all(Layout::Ibims, &fixture("ibims")).unwrap();
    assert_eq!(samples.iter().map(|s| s.name.as_str()).collect::<Vec<_>>(), ["office_02", "corridor_01"]);
    for (k, sample) in samples.iter().enumerate() {
        assert_eq!(sample.rgb.dimensions(), (8, 6));
        assert_eq!(sample.rgb[(5, 4)].0, [150, 160, 9 + k as u8]);
        for (i, &depth) in sample.gt.iter().enumerate() {
            let (x, y) = (i % 8, i / 8);
            let names = ["missing", "invalid", "transparent"];
            let at = [(x, y) == (0, 0), (x, y) == (2, 1), y == 3 && (4..6).contains(&x)];
            for (name, at) in names.iter().zip(at) {
                assert_eq!(sample.mask(name).unwrap()[i], at, "{name} ({x}, {y})");
            }
            assert_eq!(sample.mask("edges").unwrap()[i], x == 3);
            if at.contains(&true) {
                assert!(depth.is_nan());
            } else {
                assert_eq!(depth, 1.5 + x as f32 / 4.0 + y as f32 + k as f32);
            }
        }
    }
    assert_eq!(samples[0].mask("wall").unwrap().iter().filter(|&&m| m).count(), 8);
    assert!(samples[1].mask("wall").is_none() && samples[1].mask("floor").is_none());
    let drawn = samples[0].measurements(1000, SparsePattern::Uniform, 0).unwrap();
    assert_eq!(drawn.measured(), 44);
}

#[test]
fn wrong_ibims_folders() {
    let dir = tempfile::tempdir().unwrap();
    says(Layout::Ibims, dir.path(), &["no frame", ".mat"]);
    let file = dir.path().join("kitchen_03.mat");
    copy("ibims/ibims1_core_mat/corridor_01.mat", &file);
    assert_eq!(open(Layout::Ibims, dir.path()).unwrap().name(0), "kitchen_03");
    fs::write(dir.path().join("imagelist.txt"), "kitchen_03.mat\noffice_09\n").unwrap();
    says(Layout::Ibims, dir.path(), &["imagelist.txt", "office_09"]);
    fs::write(dir.path().join("imagelist.txt"), "\n").unwrap();
    says(Layout::Ibims, dir.path(), &["imagelist.txt", "no name"]);
    fs::remove_file(dir.path().join("imagelist.txt")).unwrap();

    let whole = fs::read(&file).unwrap();
    let find = |bytes: &[u8], what: &[u8]| bytes.windows(what.len()).position(|w| w == what).unwrap();
    // Every pixel masked: an empty ground truth, which is no damage.
    let mut empty = whole.clone();
    let ones = find(&whole, &[1; 13]);
    let end = ones + 48;
    empty[ones..end].fill(0);
    fs::write(&file, empty).unwrap();
    assert_eq!(without_depth(Layout::Ibims, dir.path()), 1);
    // A mask that the rule needs is absent.
    let mut renamed = whole.clone();
    let at = find(&whole, b"mask_transp");
    renamed[at] = b'M';
    fs::write(&file, renamed).unwrap();
    says(Layout::Ibims, dir.path(), &["kitchen_03.mat", "mask_transp"]);
    for length in (0..whole.len()).step_by(7) {
        fs::write(&file, &whole[..length]).unwrap();
        says(Layout::Ibims, dir.path(), &["kitchen_03.mat"]);
    }
    for at in 0..whole.len() {
        let mut damaged = whole.clone();
        damaged[at] ^= 0x5a;
        fs::write(&file, damaged).unwrap();
        if let Err(error) = all(Layout::Ibims, dir.path()) {
            assert!(matches!(error, Error::Format { .. }), "{at}: {error:?}");
        }
    }
}
