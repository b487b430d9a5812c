//! Hypersim and Virtual KITTI 2, on frames that `tests/reference/make_rendered.py` wrote in their published formats.

use std::fs;
use std::path::{Path, PathBuf};

use sdim::benchmarks::{Layout, LayoutOptions};
use serde_json::Value;

use crate::{all, says};

fn fixture(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures/benchmarks").join(name)
}

/// A copy that may be damaged.
fn copy(name: &str) -> tempfile::TempDir {
    fn put(from: &Path, to: &Path) {
        fs::create_dir_all(to).unwrap();
        for entry in fs::read_dir(from).unwrap() {
            let path = entry.unwrap().path();
            let to = to.join(path.file_name().unwrap());
            if path.is_dir() {
                put(&path, &to);
            } else {
                fs::copy(&path, to).unwrap();
            }
        }
    }
    let dir = tempfile::tempdir().unwrap();
    put(&fixture(name), dir.path());
    dir
}

#[test]
fn distances_of_hypersim_become_z() {
    let expected: Value =
        serde_json::from_slice(&fs::read(fixture("rendered_expected.json")).unwrap()).unwrap();
    let samples = all(Layout::Hypersim, &fixture("hypersim")).unwrap();
    let names: Vec<&str> = samples.iter().map(|s| s.name.as_str()).collect();
    assert_eq!(names, ["ai_001_001-cam_00-0000", "ai_001_001-cam_01-0007", "ai_002_003-cam_00-0012"]);
    for sample in &samples {
        assert_eq!(sample.rgb.dimensions(), (1024, 768));
        // The tone-mapped preview, or the colour where there is none.
        let [left, right] = [(8, 8), (1015, 8)].map(|at| sample.rgb[at].0);
        assert!(left[0] < 20 && right[0] > 235, "{left:?} {right:?}");
        for pixel in expected[&sample.name].as_array().unwrap() {
            let [x, y] = [0, 1].map(|i| pixel[i].as_u64().unwrap() as usize);
            let found = sample.gt[y * 1024 + x];
            match pixel[2].as_f64() {
                Some(z) => assert!(
                    (f64::from(found) - z).abs() < 1e-6 * z,
                    "{} ({x}, {y}): {found}, {z}",
                    sample.name
                ),
                None => assert!(found.is_nan(), "{} ({x}, {y}): {found}", sample.name),
            }
        }
        // 256 columns without a surface, 64 beyond what 16 bits can hold.
        assert_eq!(sample.gt.iter().filter(|d| d.is_nan()).count(), 64 * 320);
    }
    // A scene by itself.
    let one = Layout::Hypersim.open(fixture("hypersim/ai_002_003"), &LayoutOptions::default()).unwrap();
    assert_eq!((one.len(), one.name(0)), (1, "cam_00-0012".into()));
}

#[test]
fn what_is_wrong_with_a_copy_of_hypersim_is_named() {
    let dir = copy("hypersim");
    let images = dir.path().join("ai_001_001/images");
    let distance = images.join("scene_cam_01_geometry_hdf5/frame.0007.depth_meters.hdf5");
    let whole = fs::read(&distance).unwrap();
    for size in [0, 100, whole.len() / 2, whole.len() - 1] {
        fs::write(&distance, &whole[..size]).unwrap();
        says(Layout::Hypersim, dir.path(), &["frame.0007.depth_meters.hdf5"]);
    }
    // 16-bit integers are no distances.
    fs::copy(images.join("scene_cam_00_geometry_hdf5/frame.0000.render_entity_id.hdf5"), &distance).unwrap();
    says(Layout::Hypersim, dir.path(), &["frame.0007.depth_meters.hdf5", "dataset"]);
    fs::write(&distance, &whole).unwrap();
    let picture = images.join("scene_cam_01_final_preview/frame.0007.color.jpg");
    image::RgbImage::new(1024, 767).save(&picture).unwrap();
    says(Layout::Hypersim, dir.path(), &["depth_meters", "1024x768", "1024x767"]);
    fs::remove_file(&picture).unwrap();
    says(Layout::Hypersim, dir.path(), &["frame.0007.depth_meters.hdf5", "no picture"]);
    fs::remove_dir_all(images.join("scene_cam_01_geometry_hdf5")).unwrap();
    assert_eq!(all(Layout::Hypersim, dir.path()).unwrap().len(), 2);
    fs::remove_dir_all(images.join("scene_cam_00_geometry_hdf5")).unwrap();
    says(Layout::Hypersim, dir.path(), &["ai_001_001", "no frame"]);
    says(Layout::Hypersim, &images, &["no recording"]);
}

#[test]
fn virtual_kitti_is_in_centimetres_and_has_no_sky() {
    let samples = all(Layout::VirtualKitti, &fixture("virtual_kitti")).unwrap();
    let names: Vec<&str> = samples.iter().map(|s| s.name.as_str()).collect();
    let expected = [
        "Scene01-15-deg-left-Camera_0-00000",
        "Scene01-15-deg-left-Camera_1-00000",
        "Scene20-fog-Camera_0-00003",
    ];
    assert_eq!(names, expected);
    for sample in &samples {
        assert_eq!(sample.rgb.dimensions(), (1242, 375));
        let at = |x: usize, y: usize| sample.gt[y * 1242 + x];
        assert!(at(0, 0).is_nan() && at(1241, 99).is_nan());
        for (x, y, metres) in [(0, 100, 655.34), (600, 250, 7.05), (1241, 374, 12.34)] {
            assert!((at(x, y) - metres).abs() < 1e-4 * metres, "({x}, {y}): {}", at(x, y));
        }
    }
}

#[test]
fn virtual_kitti_may_lie_in_two_folders() {
    let (dir, whole) = (copy("virtual_kitti"), all(Layout::VirtualKitti, &fixture("virtual_kitti")).unwrap());
    let move_to = |root: &str, kind: &str| {
        for place in ["Scene01/15-deg-left", "Scene20/fog"] {
            let to = dir.path().join(root).join(place).join("frames").join(kind);
            fs::create_dir_all(to.parent().unwrap()).unwrap();
            fs::rename(dir.path().join(place).join("frames").join(kind), to).unwrap();
        }
    };
    move_to("vkitti_2.0.3_rgb", "rgb");
    move_to("vkitti_2.0.3_depth", "depth");
    let apart = all(Layout::VirtualKitti, dir.path()).unwrap();
    assert_eq!(apart.len(), whole.len());
    assert!(apart.iter().zip(&whole).all(|(a, b)| a.name == b.name && a.rgb == b.rgb));
}

#[test]
fn what_is_wrong_with_a_copy_of_virtual_kitti_is_named() {
    let dir = copy("virtual_kitti");
    let frames = dir.path().join("Scene20/fog/frames");
    let depth = frames.join("depth/Camera_0/depth_00003.png");
    let whole = fs::read(&depth).unwrap();
    fs::write(&depth, &whole[..whole.len() / 2]).unwrap();
    says(Layout::VirtualKitti, dir.path(), &["depth_00003.png"]);
    image::GrayImage::new(1242, 375).save(&depth).unwrap();
    says(Layout::VirtualKitti, dir.path(), &["depth_00003.png"]);
    fs::remove_file(&depth).unwrap();
    says(Layout::VirtualKitti, dir.path(), &["rgb_00003.jpg", "depth_00003.png"]);
    fs::write(&depth, &whole).unwrap();
    fs::write(frames.join("depth/Camera_0/depth_00004.png"), &whole).unwrap();
    says(Layout::VirtualKitti, dir.path(), &["depth_00004.png", "rgb_00004.jpg"]);
    says(Layout::VirtualKitti, &frames, &["no frame"]);
}
