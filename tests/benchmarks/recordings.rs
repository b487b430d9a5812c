//! TUM and ScanNet: recordings without measurements of their own.

use std::fs;

use image::{Rgb, RgbImage};
use sdim::benchmarks::Layout;
use sdim::internals::image::resize::{bicubic, lanczos};

use crate::copies::{H, W, depth, grey8, picture_of, scannet, tum};
use crate::{all, damage, open, says, without_depth};

#[test]
fn tum_joins_by_time() {
    let dir = tempfile::tempdir().unwrap();
    tum(&dir.path().join("fr1_desk"));
    tum(&dir.path().join("fr2_xyz"));
    let one = all(Layout::Tum, &dir.path().join("fr1_desk")).unwrap();
    assert_eq!(one.iter().map(|s| s.name.as_str()).collect::<Vec<_>>(), ["100.00", "100.10"]);
    assert_eq!((one[0].rgb[(0, 0)][0], one[0].gt[1]), (0, 1.0));
    assert_eq!((one[1].rgb[(0, 0)][0], one[1].gt[1], one[1].gt[0].is_nan()), (2, 2.0, true));
    assert!(one[0].sparse.is_none());
    let both = open(Layout::Tum, dir.path()).unwrap();
    assert_eq!((both.len(), both.name(2)), (4, "fr2_xyz-100.00".to_string()));
}

#[test]
fn damaged_tum() {
    let dir = tempfile::tempdir().unwrap();
    tum(dir.path());
    damage(Layout::Tum, dir.path(), "depth/100.095.png");
    let list = dir.path().join("depth.txt");
    for wrong in ["soon depth/1.png", "nan depth/1.png", "100.0", "100.0 ../x.png", "100.0 /x.png"] {
        fs::write(&list, wrong).unwrap();
        says(Layout::Tum, dir.path(), &["depth.txt"]);
    }
    for empty in ["", "# nothing\n"] {
        fs::write(&list, empty).unwrap();
        says(Layout::Tum, dir.path(), &["depth.txt", "no such time"]);
    }
    fs::write(&list, "300.0 depth/200.0.png").unwrap();
    says(Layout::Tum, dir.path(), &["depth.txt", "0.02"]);
    fs::remove_file(&list).unwrap();
    says(Layout::Tum, dir.path(), &["rgb.txt and depth.txt"]);
}

#[test]
fn scannet_resizes_the_picture_only() {
    let dir = tempfile::tempdir().unwrap();
    scannet(&dir.path().join("scene0707_00"));
    let samples = all(Layout::ScanNet, dir.path()).unwrap();
    let names: Vec<_> = samples.iter().map(|s| s.name.as_str()).collect();
    assert_eq!(names, ["scene0707_00-0", "scene0707_00-2", "scene0707_00-10"]);
    assert_eq!(samples[1].rgb.dimensions(), (W as u32, H as u32));
    assert!(samples[1].rgb[(5, 5)][0].abs_diff(102) <= 2);
    assert_eq!((samples[1].gt[W + 7], samples[1].gt[0].is_nan()), (1.507, true));
}

#[test]
fn scannet_resizes_by_lanczos_filter() {
    let dir = tempfile::tempdir().unwrap();
    scannet(dir.path());
    let stripes = RgbImage::from_fn(2 * W as u32, 2 * H as u32, |x, y| {
        Rgb([[0, 255][(x / 3 % 2) as usize], 9 * y as u8, 70])
    });
    fs::remove_file(dir.path().join("color/0.jpg")).unwrap();
    stripes.save(dir.path().join("color/0.png")).unwrap();
    let rgb = all(Layout::ScanNet, dir.path()).unwrap().remove(0).rgb;
    assert_eq!(rgb, lanczos(&stripes, W, H));
    assert_ne!(rgb, bicubic(&stripes, W, H));
}

#[test]
fn damaged_scannet() {
    let dir = tempfile::tempdir().unwrap();
    scannet(dir.path());
    let file = dir.path().join("depth/10.png");
    for broken in [&b""[..], &fs::read(&file).unwrap()[..50]] {
        fs::write(&file, broken).unwrap();
        says(Layout::ScanNet, dir.path(), &["10.png"]);
    }
    grey8(&file);
    says(Layout::ScanNet, dir.path(), &["10.png", "8-bit"]);
    depth(file.clone(), |_, _| 0);
    assert_eq!(without_depth(Layout::ScanNet, dir.path()), 1);
    depth(file.clone(), |_, _| 7);
    picture_of(dir.path().join("color/10.jpg"), 2 * W, 2 * H + 2, 1);
    says(Layout::ScanNet, dir.path(), &["10.jpg", "48x34", "24x16"]);
    fs::remove_file(&file).unwrap();
    says(Layout::ScanNet, dir.path(), &["10.jpg", "no depth"]);
    fs::rename(dir.path().join("color/10.jpg"), file.with_file_name("11.png")).unwrap();
    says(Layout::ScanNet, dir.path(), &["11.png", "no picture"]);
    says(Layout::ScanNet, &dir.path().join("color"), &["color and depth"]);
    says(Layout::ScanNet, &dir.path().join("absent"), &["absent"]);
}
