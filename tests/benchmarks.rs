//! Benchmarks stored as pictures and 16-bit PNG: each loader on a small copy in the published layout, and on damaged ones.

use std::fs;
use std::path::{Path, PathBuf};

use image::{Rgb, RgbImage};
use sdim::benchmarks::{Dataset, Layout, LayoutOptions, Sample, frame_seed};
use sdim::depth::{npy, png16};
use sdim::scenes::SparsePattern;
use sdim::{DepthScale, Error};

const W: usize = 24;
const H: usize = 16;

fn make(path: &Path) -> &Path {
    fs::create_dir_all(path.parent().unwrap()).unwrap();
    path
}

fn picture(path: PathBuf, shade: u8) {
    picture_of(path, W, H, shade);
}

fn picture_of(path: PathBuf, w: usize, h: usize, shade: u8) {
    RgbImage::from_pixel(w as u32, h as u32, Rgb([shade; 3])).save(make(&path)).unwrap();
}

/// Depth in stored units, 0 where `units` gives none.
fn depth(path: PathBuf, units: impl Fn(usize, usize) -> u16) {
    let stored: Vec<u16> = (0..W * H).map(|i| units(i % W, i / W)).collect();
    png16::write_png16(make(&path), W, H, &stored).unwrap();
}

fn grey8(path: &Path) {
    image::GrayImage::new(W as u32, H as u32).save(path).unwrap();
}

fn open(layout: &str, dir: &Path) -> sdim::Result<Box<dyn Dataset>> {
    layout.parse::<Layout>()?.open(dir, &LayoutOptions::default())
}

fn all(layout: &str, dir: &Path) -> sdim::Result<Vec<Sample>> {
    let set = open(layout, dir)?;
    (0..set.len()).map(|i| set.load(i)).collect()
}

/// Opening and loading everything fails with a message that names these.
#[track_caller]
fn says(layout: &str, dir: &Path, needles: &[&str]) {
    let error = all(layout, dir).map(|s| s.len()).unwrap_err();
    assert!(matches!(error, Error::Format { .. } | Error::Io { .. }), "{error:?}");
    let error = error.to_string();
    for needle in needles {
        assert!(error.contains(needle), "{needle}: {error}");
    }
}

/// The usual damage to a 16-bit depth file, each undone afterwards.
#[track_caller]
fn damage(layout: &str, dir: &Path, file: &str) {
    let path = dir.join(file);
    let name = path.file_name().unwrap().to_str().unwrap();
    let whole = fs::read(&path).unwrap();
    fs::write(&path, &whole[..whole.len() / 2]).unwrap();
    says(layout, dir, &[name]);
    fs::write(&path, b"").unwrap();
    says(layout, dir, &[name]);
    grey8(&path);
    says(layout, dir, &[name, "8-bit grey"]);
    depth(path.clone(), |_, _| 0);
    says(layout, dir, &[name, "no valid depth"]);
    png16::write_png16(&path, W, H + 1, &[300; W * (H + 1)]).unwrap();
    says(layout, dir, &[name, "24x17", "24x16"]);
    let mut lie = whole.clone();
    lie[16..24].copy_from_slice(&[0, 0, 0x3f, 0, 0, 0, 0x3f, 0]);
    fs::write(&path, lie).unwrap();
    says(layout, dir, &[name]);
    fs::remove_file(&path).unwrap();
    says(layout, dir, &[Path::new(name).file_stem().unwrap().to_str().unwrap()]);
    fs::write(&path, whole).unwrap();
    all(layout, dir).unwrap();
}

fn points(sample: &Sample) -> Vec<(usize, usize, f32)> {
    sample.sparse.as_ref().unwrap().points().collect()
}

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
    let mut options = LayoutOptions { scale: Some(DepthScale::millimetres()), ..Default::default() };
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
    let options = LayoutOptions { range: Some((4.5, 5.5)), ..Default::default() };
    let whole = all("kitti", dir.path()).unwrap().remove(0);
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
    npy::write_npy(at("sparse/0000.npy"), W, H, &sparse).unwrap();
    let sample = all("folder", dir.path()).unwrap().remove(0);
    assert_eq!((sample.name.as_str(), sample.gt[2], sample.gt[3].is_nan()), ("0000", 1.5, true));
    assert_eq!(points(&sample), [(2, 1, 1.75)]);
    assert_eq!(sample.measurements(9, SparsePattern::Uniform, 1).unwrap().measured(), 1);

    npy::write_npy(at("sparse/0000.npy"), W, H, &[0.0; W * H]).unwrap();
    says("folder", dir.path(), &["sparse", "0000.npy", "no valid depth"]);
    npy::write_npy(at("sparse/0000.npy"), W, H, &[2.0e4; W * H]).unwrap();
    says("folder", dir.path(), &["0000.npy", "20000"]);
    fs::remove_file(at("sparse/0000.npy")).unwrap();
    let sample = all("folder", dir.path()).unwrap().remove(0);
    let drawn =
        |seed| sample.measurements(40, SparsePattern::Uniform, seed).unwrap().points().collect::<Vec<_>>();
    assert_eq!(drawn(frame_seed(5, 0)), drawn(5));
    assert_ne!(drawn(5), drawn(frame_seed(5, 1)));
    assert_eq!(drawn(5).len(), 40);
}

const DRIVE: &str = "2011_10_03_drive_0047_sync";

/// Two frames of the official selection; the second point of the scanner shows through the first.
fn kitti() -> tempfile::TempDir {
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

#[test]
fn kitti_drops_points_that_show_through() {
    let dir = kitti();
    let samples = all("kitti", dir.path()).unwrap();
    assert_eq!(samples[1].name, format!("{DRIVE}_image_0000000013_image_02"));
    assert_eq!(points(&samples[0]), [(6, 6, 5.5), (4, 8, 4.0), (12, 8, 40.0)]);
    assert_eq!((samples[0].gt[5 * W + 8], samples[0].gt[8].is_nan()), (5.0, true));
    assert!(samples[0].masks.is_empty());
    let set = open("kitti", &dir.path().join("depth_selection/val_selection_cropped")).unwrap();
    assert!(matches!(set.load(2), Err(Error::Argument { name: "index", .. })));
    assert_eq!((set.len(), set.name(2)), (2, String::new()));
}

#[test]
fn damaged_kitti() {
    let dir = kitti();
    let root = dir.path().join("depth_selection/val_selection_cropped");
    for kind in ["groundtruth_depth", "velodyne_raw"] {
        damage("kitti", &root, &format!("{kind}/{DRIVE}_{kind}_0000000013_image_02.png"));
    }
    let rgb = root.join(format!("image/{DRIVE}_image_0000000005_image_02.png"));
    fs::write(&rgb, b"\x89PNG").unwrap();
    says("kitti", &root, &["image_0000000005_image_02.png"]);
    fs::remove_file(&rgb).unwrap();
    says("kitti", &root, &["groundtruth_depth_0000000005", "no picture"]);
    says("kitti", &dir.path().join("depth_selection/val_selection_cropped/image"), &["no image"]);
}

fn ddad(hints: bool) -> tempfile::TempDir {
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

#[test]
fn ddad_takes_the_published_hints_or_a_fifth() {
    let samples = all("ddad", ddad(true).path()).unwrap();
    assert_eq!((samples.len(), samples[1].name.as_str()), (2, "0000000001"));
    assert_eq!(points(&samples[0]), [(2, 4, 10.0)]);
    assert_eq!(samples[0].gt[0], 20.0);

    let dir = ddad(false);
    let drawn = all("ddad", dir.path()).unwrap();
    // 192 points, a fifth rounded up; none is an outlier.
    assert_eq!(points(&drawn[0]).len(), 39);
    assert!(points(&drawn[0]).iter().all(|&(x, y, d)| drawn[0].gt[y * W + x] == d));
    assert_ne!(points(&drawn[0]), points(&drawn[1]));
    assert_eq!(points(&drawn[1]), points(&all("ddad", dir.path()).unwrap()[1]));
    let options = LayoutOptions { seed: 1, ..Default::default() };
    let other = Layout::Ddad.open(dir.path(), &options).unwrap();
    assert_eq!(points(&other.load(0).unwrap()).len(), 39);
    assert_ne!(points(&other.load(0).unwrap()), points(&drawn[0]));
}

#[test]
fn damaged_ddad() {
    let dir = ddad(true);
    let root = dir.path().join("pregenerated/val");
    for kind in ["gt", "hints"] {
        damage("ddad", &root, &format!("{kind}/0000000001.png"));
    }
    picture(root.join("rgb/0000000002.png"), 1);
    says("ddad", &root, &["0000000002.png", "gt"]);
}

const VOID: [&str; 4] = ["image", "sparse_depth", "validity_map", "ground_truth"];

/// Two frames of two sequences in `void_150`, listed as released.
fn void() -> tempfile::TempDir {
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

#[test]
fn void_keeps_valid_measurements() {
    let dir = void();
    let samples = all("void", &dir.path().join("void_150")).unwrap();
    assert_eq!([&samples[0].name, &samples[1].name], ["classroom0-1552.25", "stairs4-1552.25"]);
    let expected: Vec<_> = (0..H).filter(|&i| i != 3).map(|i| (i, i, 2.0)).collect();
    assert_eq!(points(&samples[0]), expected);
    assert_eq!((samples[0].gt[8], samples[0].gt[0].is_nan()), (6.25, true));
    // VOID's own convention.
    let options = LayoutOptions { range: Some((0.2, 5.0)), ..Default::default() };
    let near = Layout::Void.open(dir.path().join("void_150"), &options).unwrap().load(0).unwrap();
    assert_eq!((near.gt[6], near.gt[8].is_nan()), (4.6875, true));
}

#[test]
fn damaged_void() {
    let dir = void();
    let root = dir.path().join("void_150");
    for kind in ["sparse_depth", "validity_map", "ground_truth"] {
        damage("void", &root, &format!("data/stairs4/{kind}/1552.25.png"));
    }
    let list = root.join("test_ground_truth.txt");
    let whole = fs::read_to_string(&list).unwrap();
    fs::write(&list, whole.lines().next().unwrap()).unwrap();
    says("void", &root, &["test_ground_truth.txt", "1 paths", "2, as many as"]);
    for outside in ["../secret.png\nb.png", "/etc/passwd\nb.png", "\u{0}"] {
        fs::write(&list, outside).unwrap();
        says("void", &root, &["test_ground_truth.txt"]);
    }
    fs::write(&list, b"\xff\xfe").unwrap();
    says("void", &root, &["test_ground_truth.txt", "UTF-8"]);
    fs::write(&list, whole).unwrap();
    fs::write(root.join("test_image.txt"), "").unwrap();
    says("void", &root, &["test_image.txt", "no path"]);
    fs::write(root.join("test_image.txt"), "void_150/data/gone/image/1.png").unwrap();
    says("void", &root, &["test_image.txt", "gone"]);
    fs::remove_file(root.join("test_image.txt")).unwrap();
    says("void", &root, &["test_image.txt"]);
}

fn tum(dir: &Path) {
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

#[test]
fn tum_joins_by_time() {
    let dir = tempfile::tempdir().unwrap();
    tum(&dir.path().join("fr1_desk"));
    tum(&dir.path().join("fr2_xyz"));
    let one = all("tum", &dir.path().join("fr1_desk")).unwrap();
    assert_eq!(one.iter().map(|s| s.name.as_str()).collect::<Vec<_>>(), ["100.00", "100.10"]);
    assert_eq!((one[0].rgb[(0, 0)][0], one[0].gt[1]), (0, 1.0));
    assert_eq!((one[1].rgb[(0, 0)][0], one[1].gt[1], one[1].gt[0].is_nan()), (2, 2.0, true));
    assert!(one[0].sparse.is_none());
    let both = open("tum", dir.path()).unwrap();
    assert_eq!((both.len(), both.name(2)), (4, "fr2_xyz-100.00".to_string()));
}

#[test]
fn damaged_tum() {
    let dir = tempfile::tempdir().unwrap();
    tum(dir.path());
    damage("tum", dir.path(), "depth/100.095.png");
    let list = dir.path().join("depth.txt");
    for wrong in ["soon depth/1.png", "nan depth/1.png", "100.0", "100.0 ../x.png", "100.0 /x.png"] {
        fs::write(&list, wrong).unwrap();
        says("tum", dir.path(), &["depth.txt"]);
    }
    fs::write(&list, "300.0 depth/200.0.png").unwrap();
    says("tum", dir.path(), &["depth.txt", "0.02"]);
    fs::remove_file(&list).unwrap();
    says("tum", dir.path(), &["rgb.txt and depth.txt"]);
}

fn scannet(dir: &Path) {
    for (i, number) in ["0", "10", "2"].iter().enumerate() {
        picture_of(dir.join(format!("color/{number}.jpg")), 4 * W + 1, 4 * H, 100 + i as u8);
        depth(dir.join(format!("depth/{number}.png")), |x, y| if y == 0 { 0 } else { 1500 + x as u16 });
    }
}

#[test]
fn scannet_resizes_the_picture_only() {
    let dir = tempfile::tempdir().unwrap();
    scannet(&dir.path().join("scene0707_00"));
    let samples = all("scannet", dir.path()).unwrap();
    let names: Vec<_> = samples.iter().map(|s| s.name.as_str()).collect();
    assert_eq!(names, ["scene0707_00-0", "scene0707_00-2", "scene0707_00-10"]);
    assert_eq!(samples[1].rgb.dimensions(), (W as u32, H as u32));
    assert!(samples[1].rgb[(5, 5)][0].abs_diff(102) <= 2);
    assert_eq!((samples[1].gt[W + 7], samples[1].gt[0].is_nan()), (1.507, true));
}

#[test]
fn damaged_scannet() {
    let dir = tempfile::tempdir().unwrap();
    scannet(dir.path());
    let file = dir.path().join("depth/10.png");
    for broken in [&b""[..], &fs::read(&file).unwrap()[..50]] {
        fs::write(&file, broken).unwrap();
        says("scannet", dir.path(), &["10.png"]);
    }
    grey8(&file);
    says("scannet", dir.path(), &["10.png", "8-bit"]);
    depth(file.clone(), |_, _| 0);
    says("scannet", dir.path(), &["10.png", "no valid depth"]);
    depth(file.clone(), |_, _| 7);
    picture_of(dir.path().join("color/10.jpg"), 2 * W, 2 * H + 2, 1);
    says("scannet", dir.path(), &["10.jpg", "48x34", "24x16"]);
    fs::remove_file(&file).unwrap();
    says("scannet", dir.path(), &["10.jpg", "no depth"]);
    fs::rename(dir.path().join("color/10.jpg"), file.with_file_name("11.png")).unwrap();
    says("scannet", dir.path(), &["11.png", "no picture"]);
    says("scannet", &dir.path().join("color"), &["color and depth"]);
    says("scannet", &dir.path().join("absent"), &["absent"]);
}
