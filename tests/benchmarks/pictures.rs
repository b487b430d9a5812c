//! KITTI, DDAD and VOID: pictures with depth in 16-bit PNG.

use std::fs;

use sdim::Error;
use sdim::benchmarks::{Layout, LayoutOptions};

use crate::copies::{DRIVE, H, W, ddad, depth, kitti, picture, void};
use crate::{all, damage, open, points, says};

#[test]
fn kitti_drops_points_that_show_through() {
    let dir = kitti();
    let samples = all(Layout::Kitti, dir.path()).unwrap();
    assert_eq!(samples[1].name, format!("{DRIVE}_image_0000000013_image_02"));
    assert_eq!(points(&samples[0]), [(6, 6, 5.5), (4, 8, 4.0), (12, 8, 40.0)]);
    assert_eq!((samples[0].gt[5 * W + 8], samples[0].gt[8].is_nan()), (5.0, true));
    assert!(samples[0].masks.is_empty());
    let set = open(Layout::Kitti, &dir.path().join("depth_selection/val_selection_cropped")).unwrap();
    assert!(matches!(set.load(2), Err(Error::Argument { name: "index", .. })));
    assert_eq!((set.len(), set.name(2)), (2, String::new()));
}

#[test]
fn damaged_kitti() {
    let dir = kitti();
    let root = dir.path().join("depth_selection/val_selection_cropped");
    for kind in ["groundtruth_depth", "velodyne_raw"] {
        damage(Layout::Kitti, &root, &format!("{kind}/{DRIVE}_{kind}_0000000013_image_02.png"));
    }
    let rgb = root.join(format!("image/{DRIVE}_image_0000000005_image_02.png"));
    fs::write(&rgb, b"\x89PNG").unwrap();
    says(Layout::Kitti, &root, &["image_0000000005_image_02.png"]);
    fs::remove_file(&rgb).unwrap();
    says(Layout::Kitti, &root, &["groundtruth_depth_0000000005", "no picture"]);
    says(Layout::Kitti, &dir.path().join("depth_selection/val_selection_cropped/image"), &["no image"]);
}

#[test]
fn ddad_takes_the_published_hints_or_a_fifth() {
    let samples = all(Layout::Ddad, ddad(true).path()).unwrap();
    assert_eq!((samples.len(), samples[1].name.as_str()), (2, "0000000001"));
    assert_eq!(points(&samples[0]), [(2, 4, 10.0)]);
    assert_eq!(samples[0].gt[0], 20.0);

    let dir = ddad(false);
    let drawn = all(Layout::Ddad, dir.path()).unwrap();
    // 192 points, a fifth rounded up; none is an outlier.
    assert_eq!(points(&drawn[0]).len(), 39);
    assert!(points(&drawn[0]).iter().all(|&(x, y, d)| drawn[0].gt[y * W + x] == d));
    assert_ne!(points(&drawn[0]), points(&drawn[1]));
    assert_eq!(points(&drawn[1]), points(&all(Layout::Ddad, dir.path()).unwrap()[1]));
    // A frame of which nothing is known has no fifth.
    depth(dir.path().join("pregenerated/val/gt/0000000001.png"), |_, _| 0);
    let empty = all(Layout::Ddad, dir.path()).unwrap().remove(1);
    assert!(empty.gt.iter().all(|d| d.is_nan()) && points(&empty).is_empty());
    let options = LayoutOptions::default().with_seed(1);
    let other = Layout::Ddad.open(dir.path(), &options).unwrap();
    assert_eq!(points(&other.load(0).unwrap()).len(), 39);
    assert_ne!(points(&other.load(0).unwrap()), points(&drawn[0]));
}

#[test]
fn damaged_ddad() {
    let dir = ddad(true);
    let root = dir.path().join("pregenerated/val");
    for kind in ["gt", "hints"] {
        damage(Layout::Ddad, &root, &format!("{kind}/0000000001.png"));
    }
    picture(root.join("rgb/0000000002.png"), 1);
    says(Layout::Ddad, &root, &["0000000002.png", "gt"]);
}

#[test]
fn void_keeps_valid_measurements() {
    let dir = void();
    let samples = all(Layout::Void, &dir.path().join("void_150")).unwrap();
    assert_eq!([&samples[0].name, &samples[1].name], ["classroom0-1552.25", "stairs4-1552.25"]);
    let expected: Vec<_> = (0..H).filter(|&i| i != 3).map(|i| (i, i, 2.0)).collect();
    assert_eq!(points(&samples[0]), expected);
    assert_eq!((samples[0].gt[8], samples[0].gt[0].is_nan()), (6.25, true));
    // VOID's own convention.
    let options = LayoutOptions::default().with_range(0.2, 5.0);
    let near = Layout::Void.open(dir.path().join("void_150"), &options).unwrap().load(0).unwrap();
    assert_eq!((near.gt[6], near.gt[8].is_nan()), (4.6875, true));
}

#[test]
fn damaged_void() {
    let dir = void();
    let root = dir.path().join("void_150");
    for kind in ["sparse_depth", "validity_map", "ground_truth"] {
        damage(Layout::Void, &root, &format!("data/stairs4/{kind}/1552.25.png"));
    }
    let list = root.join("test_ground_truth.txt");
    let whole = fs::read_to_string(&list).unwrap();
    fs::write(&list, whole.lines().next().unwrap()).unwrap();
    says(Layout::Void, &root, &["test_ground_truth.txt", "1 paths", "2, as many as"]);
    for outside in ["../secret.png\nb.png", "/etc/passwd\nb.png", "\u{0}"] {
        fs::write(&list, outside).unwrap();
        says(Layout::Void, &root, &["test_ground_truth.txt"]);
    }
    fs::write(&list, b"\xff\xfe").unwrap();
    says(Layout::Void, &root, &["test_ground_truth.txt", "UTF-8"]);
    fs::write(&list, whole).unwrap();
    fs::write(root.join("test_image.txt"), "").unwrap();
    says(Layout::Void, &root, &["test_image.txt", "no path"]);
    fs::write(root.join("test_image.txt"), "void_150/data/gone/image/1.png").unwrap();
    says(Layout::Void, &root, &["test_image.txt", "gone"]);
    fs::remove_file(root.join("test_image.txt")).unwrap();
    says(Layout::Void, &root, &["test_image.txt"]);
}
