//! Small copies of benchmarks, in the layouts in which they are published.
#![allow(dead_code)]

use std::fs;
use std::path::{Path, PathBuf};

use image::{Rgb, RgbImage};
use sdim::depth::io;

/// Size of a frame.
pub const W: usize = 24;
pub const H: usize = 16;

pub fn make(path: &Path) -> &Path {
    fs::create_dir_all(path.parent().unwrap()).unwrap();
    path
}

pub fn picture(path: PathBuf, shade: u8) {
    picture_of(path, W, H, shade);
}

pub fn picture_of(path: PathBuf, w: usize, h: usize, shade: u8) {
    RgbImage::from_pixel(w as u32, h as u32, Rgb([shade; 3])).save(make(&path)).unwrap();
}

/// Depth in stored units, 0 where `units` gives none.
pub fn depth(path: PathBuf, units: impl Fn(usize, usize) -> u16) {
    let stored: Vec<u16> = (0..W * H).map(|i| units(i % W, i / W)).collect();
    io::write_png16(make(&path), W, H, &stored).unwrap();
}

pub fn grey8(path: &Path) {
    image::GrayImage::new(W as u32, H as u32).save(path).unwrap();
}

pub const DRIVE: &str = "2011_10_03_drive_0047_sync";

/// Two frames of the official selection; the second point of the scanner shows through the first.
pub fn kitti() -> tempfile::TempDir {
    let dir = tempfile::tempdir().unwrap();
    let root = dir.path().join("depth_selection/val_selection_cropped");
    for number in ["0000000005", "0000000013"] {
        let at = |kind: &str, name: &str| root.join(format!("{kind}/{DRIVE}_{name}_{number}_image_02.png"));
        picture(at("image", "image"), 50);
        depth(
            at("groundtruth_depth", "groundtruth_depth"),
            |x, y| if y < 4 { 0 } else { 1024 + 32 * x as u16 },
        );
        depth(at("velodyne_raw", "velodyne_raw"), |x, y| match (x, y) {
            (4, 8) => 4 * 256,
            (6, 9) => 5 * 256 + 129,
            (6, 6) => 5 * 256 + 128,
            (12, 8) => 40 * 256,
            _ => 0,
        });
    }
    dir
}

pub fn ddad(hints: bool) -> tempfile::TempDir {
    let dir = tempfile::tempdir().unwrap();
    for number in ["0000000000", "0000000001"] {
        let at = |kind: &str| dir.path().join(format!("pregenerated/val/{kind}/{number}.png"));
        picture(at("rgb"), 90);
        depth(at("gt"), |x, y| if (x + y) % 2 == 0 { 256 * 20 + y as u16 } else { 0 });
        if hints {
            depth(at("hints"), |x, y| {
                if (x, y) == (2, 4) {
                    2560
                } else if (x, y) == (4, 4) {
                    5120
                } else {
                    0
                }
            });
        }
    }
    dir
}

pub const VOID: [&str; 4] = ["image", "sparse_depth", "validity_map", "ground_truth"];

/// Two frames of two sequences in `void_150`, listed as released.
pub fn void() -> tempfile::TempDir {
    let dir = tempfile::tempdir().unwrap();
    let mut lists = VOID.map(|_| String::new());
    for sequence in ["classroom0", "stairs4"] {
        for (kind, list) in VOID.iter().zip(&mut lists) {
            let relative = format!("void_150/data/{sequence}/{kind}/1552.25.png");
            *list += &format!("{relative}\n");
            let path = dir.path().join(relative);
            match *kind {
                "image" => picture(path, 33),
                "sparse_depth" => depth(path, |x, y| if x == y { 512 } else { 0 }),
                // The release's maps hold 0 and 256; one measurement is not valid, one valid pixel has none.
                "validity_map" => {
                    depth(path, |x, y| if x == y && x != 3 || (x, y) == (1, 0) { 256 } else { 0 })
                }
                _ => depth(path, |x, _| if x == 0 { 0 } else { 200 * x as u16 }),
            }
        }
    }
    for (kind, list) in VOID.iter().zip(lists) {
        fs::write(dir.path().join(format!("void_150/test_{kind}.txt")), list).unwrap();
    }
    dir
}

pub fn tum(dir: &Path) {
    fs::create_dir_all(dir).unwrap();
    for (i, name) in ["100.00", "100.05", "100.10"].iter().enumerate() {
        picture(dir.join(format!("rgb/{name}.png")), i as u8);
    }
    for (i, name) in ["100.011", "100.095", "200.0"].iter().enumerate() {
        depth(dir.join(format!("depth/{name}.png")), |x, _| if x == 0 { 0 } else { 5000 * (i as u16 + 1) });
    }
    let rgb = "# color images\n# timestamp filename\n100.00 rgb/100.00.png\n100.05 rgb/100.05.png\n100.10 rgb/100.10.png\n";
    fs::write(dir.join("rgb.txt"), rgb).unwrap();
    let depth = "# depth maps\n100.011 depth/100.011.png\n100.095 depth/100.095.png\n200.0 depth/200.0.png\n";
    fs::write(dir.join("depth.txt"), depth).unwrap();
}

pub fn scannet(dir: &Path) {
    for (i, number) in ["0", "10", "2"].iter().enumerate() {
        picture_of(dir.join(format!("color/{number}.jpg")), 4 * W + 1, 4 * H, 100 + i as u8);
        depth(dir.join(format!("depth/{number}.png")), |x, y| if y == 0 { 0 } else { 1500 + x as u16 });
    }
}
