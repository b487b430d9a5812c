//! `complete` with a cloud and a calibration, as a user runs it.

use super::common::program::program;
use sdim::cloud::PointCloud;
use sdim::depth::io::write_png16;
use sdim::{RgbImage, SparseDepth};
use serde_json::Value;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

const SIZE: (usize, usize) = (96, 64);
const CALIB: &str = "image_width: 96\nimage_height: 64\ncamera_matrix:\n  rows: 3\n  cols: 3\n  data: [80, 0, 47.5, 0, 80, 31.5, 0, 0, 1]\n\
                     distortion_model: plumb_bob\ndistortion_coefficients:\n  rows: 1\n  cols: 5\n  data: [-0.1, 0.01, 0, 0, 0]\n";
/// A LiDAR (x forward, y left, z up) 20 cm above the camera.
const EXTRINSIC: &str = "0 -1 0 0\n0 0 -1 -0.2\n1 0 0 0\n";

/// A picture, and a wall 3 m away with a box before it as a spinning LiDAR sees them: in its own axes, a third of the points behind it.
struct Place {
    dir: tempfile::TempDir,
}

impl Place {
    fn new() -> Self {
        let dir = tempfile::tempdir().unwrap();
        let place = Self { dir };
        let (w, h) = (SIZE.0 as u32, SIZE.1 as u32);
        let is_box = |x: u32, y: u32| (31..61).contains(&x) && (10..37).contains(&y);
        let colour = |x, y| image::Rgb(if is_box(x, y) { [200, 60, 40] } else { [90, 110, 130] });
        RgbImage::from_fn(w, h, colour).save(place.path("rgb.png")).unwrap();
        let mut points = Vec::new();
        for ring in -8..8 {
            for step in -40..40 {
                let (left, up) = (step as f32 * 0.05, ring as f32 * 0.12);
                let near = (-0.5..0.6).contains(&left) && (-0.6..0.4).contains(&up);
                points.push(if near { [1.5, left * 0.5, up * 0.5] } else { [3.0, left, up] });
            }
        }
        points.extend((0..600).map(|i| [-2.0 - i as f32 * 0.01, 0.3, 0.1]));
        for name in ["cloud.pcd", "cloud.ply"] {
            PointCloud { points: points.clone(), ..PointCloud::default() }.write(place.path(name)).unwrap();
        }
        let bytes: Vec<u8> =
            points.iter().flat_map(|p| [p[0], p[1], p[2], 0.5]).flat_map(f32::to_le_bytes).collect();
        place.write("cloud.bin", &bytes);
        place.write("calib.yaml", CALIB.as_bytes());
        place.write("extrinsic.txt", EXTRINSIC.as_bytes());
        let kitti = "P2: 80 0 47.5 0 0 80 31.5 0 0 0 1 0\nTr: 0 -1 0 0 0 0 -1 -0.2 1 0 0 0\n";
        place.write("calib.txt", kitti.as_bytes());
        place
    }

    fn path(&self, name: &str) -> PathBuf {
        self.dir.path().join(name)
    }

    fn write(&self, name: &str, bytes: &[u8]) {
        std::fs::write(self.path(name), bytes).unwrap();
    }

    /// Words that end in a known file's name become its path.
    fn run(&self, words: &str) -> Output {
        let word = |word: &str| match word.contains('.') && !word.starts_with(|c: char| c.is_ascii_digit()) {
            true => self.path(word),
            false => Path::new(word).to_path_buf(),
        };
        let mut command = Command::new(program("complete"));
        command.args(["--plan", "stride:16", "--json", "--rgb"]).arg(self.path("rgb.png")).arg("--out");
        command.arg(self.path("out")).args(words.split_whitespace().map(word)).output().unwrap()
    }
}

fn said(out: &Output) -> String {
    String::from_utf8_lossy(&out.stderr).into_owned()
}

#[test]
fn a_cloud_and_a_calibration_make_a_map_and_points() {
    let place = Place::new();
    let mut maps = Vec::new();
    for words in [
        "--cloud cloud.pcd --calib calib.yaml --extrinsic extrinsic.txt --cloud-out out.ply",
        "--cloud cloud.ply --calib calib.yaml --extrinsic extrinsic.txt --cloud-out out.pcd --min-confidence 0.3",
        "--cloud cloud.bin --calib calib.txt --camera 2 --cloud-out out.ply --max-error 0.02",
        "--cloud cloud.bin --intrinsics 80,80,47.5,31.5 --extrinsic extrinsic.txt --cloud-out out.pcd",
    ] {
        let out = place.run(words);
        assert!(out.status.success(), "{words}: {}", said(&out));
        let v: Value = serde_json::from_slice(&out.stdout).unwrap();
        assert!(v["measured"].as_u64().unwrap() > 500, "{v}");
        let map = SparseDepth::read(place.path("out/dense.npy"), None).unwrap();
        // The wall above the box, and the box.
        assert_eq!((map.width(), map.height()), SIZE);
        assert!(
            (map.get(10, 10).unwrap() - 3.0).abs() < 0.5 && (map.get(45, 25).unwrap() - 1.5).abs() < 0.3,
            "{words}"
        );
        assert!(place.path("out/normals.png").exists());
        let cloud =
            PointCloud::read(place.path(if words.contains("out.ply") { "out.ply" } else { "out.pcd" }))
                .unwrap();
        let (confidence, valid) = (cloud.confidence.unwrap(), v["valid"].as_u64().unwrap() as usize);
        assert_eq!(
            (cloud.colours.unwrap().len(), cloud.normals.unwrap().len()),
            (confidence.len(), confidence.len())
        );
        match words {
            w if w.contains("--min-confidence") => assert!(confidence.iter().all(|&c| c >= 0.3)),
            w if w.contains("--max-error") => assert!(confidence.len() < valid && !confidence.is_empty()),
            _ => assert_eq!(confidence.len(), valid),
        }
        assert!(cloud.points.iter().all(|p| p[2] > 0.0));
        maps.push(map.as_slice().to_vec());
    }
    assert_eq!(maps[2], maps[3], "KITTI's way and one's own are the same");
}

#[test]
fn what_is_wrong_is_said_and_nothing_is_written() {
    let place = Place::new();
    place.write("small.yaml", CALIB.replace("image_width: 96", "image_width: 640").as_bytes());
    place.write("keyless.yaml", CALIB.replace("camera_matrix", "matrix").as_bytes());
    place.write("turned.txt", b"1 0 0 0 0 1 0 0 0 0 1 0");
    place.write("sheared.txt", b"1 0 0 0 0 1 0 0 0 0 2 0");
    let whole = std::fs::read(place.path("cloud.pcd")).unwrap();
    place.write("cut.pcd", &whole[..whole.len() - 1]);
    place.write("cut.bin", &std::fs::read(place.path("cloud.bin")).unwrap()[..1001]);
    place.write("empty.bin", &[]);
    PointCloud::default().write(place.path("empty.pcd")).unwrap();
    let millimetres = PointCloud { points: vec![[30000.0, 0.0, 0.0]], ..PointCloud::default() };
    millimetres.write(place.path("mm.ply")).unwrap();
    write_png16(place.path("sparse.png"), 96, 64, &[1000; 96 * 64]).unwrap();
    for (words, named) in [
        ("", "--sparse"),
        ("--cloud cloud.pcd", "--calib or --intrinsics"),
        ("--cloud cloud.pcd --calib calib.yaml", "--extrinsic"),
        ("--cloud cloud.pcd --sparse sparse.png --depth-scale mm", "cannot be used with"),
        (
            "--cloud cloud.pcd --calib small.yaml --extrinsic extrinsic.txt",
            "key `image_width` is \"640\"; expected 96",
        ),
        (
            "--cloud cloud.pcd --calib keyless.yaml --extrinsic extrinsic.txt",
            "key `camera_matrix.data` is missing",
        ),
        ("--cloud cloud.pcd --calib calib.txt", "camera = none"),
        ("--cloud cloud.pcd --calib calib.txt --camera 3", "key `P3` is missing"),
        ("--cloud cloud.pcd --calib calib.yaml --extrinsic sheared.txt", "sheared.txt"),
        ("--cloud cloud.pcd --calib calib.yaml --extrinsic turned.txt", "cloud.pcd: 0 of 1880 points"),
        ("--cloud cut.pcd --calib calib.yaml --extrinsic extrinsic.txt", "cut.pcd"),
        ("--cloud cut.bin --calib calib.yaml --extrinsic extrinsic.txt", "1001 bytes"),
        ("--cloud empty.bin --calib calib.yaml --extrinsic extrinsic.txt", "empty.bin: 0 of 0 points"),
        ("--cloud empty.pcd --calib calib.yaml --extrinsic identity", "empty.pcd: 0 of 0 points"),
        ("--cloud mm.ply --calib calib.yaml --extrinsic extrinsic.txt", "mm.ply"),
        ("--cloud none.ply --calib calib.yaml --extrinsic extrinsic.txt", "none.ply"),
        ("--cloud rgb.png --calib calib.yaml --extrinsic extrinsic.txt", "pcd, ply or bin"),
        ("--cloud cloud.pcd --intrinsics 80,80,47.5 --extrinsic extrinsic.txt", "fx,fy,cx,cy"),
        ("--cloud cloud.pcd --intrinsics 0,80,47.5,31.5 --extrinsic extrinsic.txt", "fx = 0"),
        ("--sparse sparse.png --depth-scale mm --cloud-out out.ply", "needs a camera"),
        (
            "--sparse sparse.png --depth-scale mm --intrinsics 80,80,47.5,31.5 --cloud-out out.xyz",
            ".ply or .pcd",
        ),
        ("--sparse sparse.png --depth-scale mm --min-confidence 0.5", "--cloud-out"),
    ] {
        let out = place.run(words);
        assert!(
            !out.status.success() && said(&out).contains(named),
            "{words}: {:?} not in {}",
            named,
            said(&out)
        );
        assert!(
            !said(&out).contains("panicked") && out.stdout.is_empty() && !place.path("out").exists(),
            "{words}"
        );
    }
}
