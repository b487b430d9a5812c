//! What holds for all layouts, and plain folders.

use std::fs;

use sdim::benchmarks::{Layout, LayoutOptions, frame_seed};
use sdim::depth::SparsePattern;
use sdim::depth::io;
use sdim::internals::benchmarks::{DepthFile, write_frame};
use sdim::{DepthScale, Error};

use crate::copies::{H, W, kitti, picture, scannet};
use crate::{all, points, says};

#[test]
fn layouts_have_names_and_protocols() {
    for layout in Layout::ALL {
        assert_eq!(layout.to_string().parse::<Layout>().unwrap(), layout);
    }
    let error = "NYU".parse::<Layout>().unwrap_err().to_string();
    assert!(error.contains("NYU") && error.contains("folder, nyu, void, ibims, kitti"), "{error}");
    assert_eq!(
        (Layout::Nyu.points(), Layout::Ibims.points(), Layout::Kitti.points()),
        (Some(500), Some(1000), None)
    );
    assert_eq!((Layout::Void.frames(), Layout::Tum.frames()), (Some(800), None));
}

#[test]
fn options_that_do_not_fit_are_refused() {
    let dir = kitti();
    let mut options = LayoutOptions::default().with_scale(DepthScale::millimetres());
    let error = Layout::Kitti.open(dir.path(), &options).map(|_| ()).unwrap_err().to_string();
    assert!(error.contains("depth scale") && error.contains("kitti"), "{error}");
    options.scale = None;
    options.range = Some((5.0, 0.2));
    assert!(matches!(Layout::Kitti.open(dir.path(), &options), Err(Error::Argument { name: "range", .. })));
    options.range = Some((2.0, f32::NAN));
    assert!(Layout::Kitti.open(dir.path(), &options).is_err());
}

#[test]
fn a_range_takes_away_ground_truth_and_nothing_else() {
    let dir = kitti();
    let options = LayoutOptions::default().with_range(4.5, 5.5);
    let whole = all(Layout::Kitti, dir.path()).unwrap().remove(0);
    let set = Layout::Kitti.open(dir.path(), &options).unwrap();
    let part = set.load(0).unwrap();
    assert_eq!((set.len(), set.name(1)), (2, whole.name.replace("0000000005", "0000000013")));
    assert_eq!(points(&part), points(&whole));
    for (a, b) in part.gt.iter().zip(&whole.gt) {
        assert!(if (4.5..=5.5).contains(b) { a == b } else { a.is_nan() });
    }
    assert!(part.gt.iter().any(|d| d.is_nan()) && part.gt.iter().any(|d| !d.is_nan()));
}

#[test]
fn a_list_chooses_frames_in_its_order() {
    let dir = tempfile::tempdir().unwrap();
    for scene in ["scene0707_00", "scene0708_00"] {
        scannet(&dir.path().join(scene));
    }
    let list = dir.path().join("split.txt");
    let options = LayoutOptions::default().with_frames(&list);
    let open = |names: &str| {
        fs::write(&list, names).unwrap();
        Layout::ScanNet.open(dir.path(), &options)
    };
    // As published, with zeros as another export has them, and by our own name.
    let set = open("# choice\nscene0708_00/10\nscene0707_00/0002\n\nscene0707_00-10\n").unwrap();
    let names: Vec<String> = (0..4).map(|i| set.name(i)).collect();
    assert_eq!(
        (set.len(), &names[..]),
        (3, ["scene0708_00-10", "scene0707_00-2", "scene0707_00-10", ""].map(String::from).as_slice())
    );
    for (index, name) in names[..3].iter().enumerate() {
        assert_eq!(set.load(index).unwrap().name, *name);
    }
    assert!(matches!(set.load(3), Err(Error::Argument { name: "index", .. })));
    assert!(!set.has_measurements(0));
    for (wrong, what) in [
        ("scene0707_00/3", "\"scene0707_00/3\", no such frame; expected names of the data set's 6 frames"),
        ("scene0707_00/2\nscene0707_00-2", "\"scene0707_00-2\" twice"),
        ("# nothing\n", "no name"),
    ] {
        let error = open(wrong).map(|_| ()).unwrap_err().to_string();
        assert!(error.contains("split.txt") && error.contains(what), "{error}");
    }
    fs::remove_file(&list).unwrap();
    assert!(matches!(Layout::ScanNet.open(dir.path(), &options), Err(Error::Io { .. })));

    // Any layout, with its measurements; a name itself goes before what else is spelled like it.
    let dir = tempfile::tempdir().unwrap();
    let frame = sdim::internals::scenes::procedural(3, 16, 12).unwrap();
    for name in ["07", "7", "8"] {
        write_frame(dir.path(), name, &frame, DepthFile::Npy).unwrap();
    }
    fs::create_dir(dir.path().join("sparse")).unwrap();
    io::write_npy(dir.path().join("sparse/7.npy"), 16, 12, &[1.0; 192]).unwrap();
    let list = dir.path().join("list.txt");
    fs::write(&list, "7\n07\n008").unwrap();
    let options = LayoutOptions::default().with_frames(&list);
    let set = Layout::Folder.open(dir.path(), &options).unwrap();
    assert_eq!([0, 1, 2].map(|i| set.name(i)), ["7", "07", "8"]);
    assert_eq!([0, 1, 2, 3].map(|i| set.has_measurements(i)), [true, false, false, false]);
    fs::write(&list, "007").unwrap();
    let error = Layout::Folder.open(dir.path(), &options).map(|_| ()).unwrap_err().to_string();
    assert!(error.contains("007"), "two frames are spelled like it: {error}");
}

#[test]
fn marigolds_folders() {
    let dir = tempfile::tempdir().unwrap();
    let at = |name: &str| dir.path().join(name);
    picture(at("rgb/0000.png"), 7);
    fs::create_dir_all(at("gt")).unwrap();
    fs::create_dir_all(at("sparse")).unwrap();
    fs::create_dir_all(at("intrinsics")).unwrap();
    fs::write(at("intrinsics/0000.txt"), "1 0 0").unwrap();
    // NumPy's default type is f64, and a depth of 0 means none.
    let header = format!("{{'descr': '<f8', 'fortran_order': False, 'shape': ({H}, {W}), }}\n");
    let mut file = b"\x93NUMPY\x01\x00".to_vec();
    file.extend((header.len() as u16).to_le_bytes());
    file.extend(header.as_bytes());
    file.extend((0..W * H).flat_map(|i| (if i == 3 { 0.0 } else { i as f64 * 0.25 + 1.0 }).to_le_bytes()));
    fs::write(at("gt/0000.npy"), &file).unwrap();
    let mut sparse = [0.0; W * H];
    sparse[W + 2] = 1.75;
    io::write_npy(at("sparse/0000.npy"), W, H, &sparse).unwrap();
    let sample = all(Layout::Folder, dir.path()).unwrap().remove(0);
    assert_eq!((sample.name.as_str(), sample.gt[2], sample.gt[3].is_nan()), ("0000", 1.5, true));
    assert_eq!(points(&sample), [(2, 1, 1.75)]);
    assert_eq!(sample.measurements(9, SparsePattern::Uniform, 1).unwrap().measured(), 1);

    io::write_npy(at("sparse/0000.npy"), W, H, &[0.0; W * H]).unwrap();
    let sample = all(Layout::Folder, dir.path()).unwrap().remove(0);
    assert!(points(&sample).is_empty(), "a frame without a measurement is one to skip, not a damaged one");
    assert_eq!(sample.measurements(9, SparsePattern::Uniform, 1).unwrap().measured(), 0);
    io::write_npy(at("sparse/0000.npy"), W, H, &[2.0e4; W * H]).unwrap();
    says(Layout::Folder, dir.path(), &["0000.npy", "20000"]);
    fs::remove_file(at("sparse/0000.npy")).unwrap();
    let sample = all(Layout::Folder, dir.path()).unwrap().remove(0);
    let drawn =
        |seed| sample.measurements(40, SparsePattern::Uniform, seed).unwrap().points().collect::<Vec<_>>();
    assert_eq!(drawn(frame_seed(5, 0)), drawn(5));
    assert_ne!(drawn(5), drawn(frame_seed(5, 1)));
    assert_eq!(drawn(5).len(), 40);
}
