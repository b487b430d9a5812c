//! Cameras, raw frames and clouds against OpenCV and NumPy; `tests/reference/make_sensors.py` wrote what they found.

use sdim::messages::{CameraInfo, Image, PointCloud2, PointField};
use sdim::{Camera, Distortion, Intrinsics, SparseDepth, Transform};
use serde_json::Value;

fn fixture(name: &str) -> Vec<Value> {
    let path = format!("{}/tests/fixtures/sensors/{name}", env!("CARGO_MANIFEST_DIR"));
    serde_json::from_str(&std::fs::read_to_string(path).unwrap()).unwrap()
}

fn numbers(value: &Value) -> Vec<f64> {
    value.as_array().unwrap().iter().map(|v| v.as_f64().unwrap()).collect()
}

fn rows<const N: usize>(value: &Value) -> Vec<[f64; N]> {
    value.as_array().unwrap().iter().map(|row| numbers(row).try_into().unwrap()).collect()
}

fn bytes(value: &Value) -> Vec<u8> {
    let text = value.as_str().unwrap().as_bytes();
    let digit = |c: u8| (c as char).to_digit(16).unwrap() as u8;
    text.chunks(2).map(|pair| 16 * digit(pair[0]) + digit(pair[1])).collect()
}

fn camera(case: &Value) -> Camera {
    let size = numbers(&case["size"]);
    let k: [f64; 9] = numbers(&case["k"]).try_into().unwrap();
    let [fx, _, cx, _, fy, cy, ..] = k.map(|v| v as f32);
    let lens = Distortion::from_ros(case["model"].as_str().unwrap(), &numbers(&case["d"])).unwrap();
    Camera::new(size[0] as usize, size[1] as usize, Intrinsics { fx, fy, cx, cy }, lens).unwrap()
}

#[test]
fn points_are_seen_where_opencv_sees_them() {
    for case in fixture("cameras.json") {
        let camera = camera(&case);
        let pose: [[f64; 4]; 3] = rows(&case["lidar_to_camera"]).try_into().unwrap();
        let pose = Transform::from_rows(pose).unwrap();
        let (points, pixels) = (rows::<3>(&case["points"]), rows::<2>(&case["projected"]));
        assert_eq!(points.len(), 24);
        for (point, [x, y]) in points.iter().zip(pixels) {
            let (u, v) = camera.project(pose.apply(point.map(|c| c as f32))).unwrap();
            let off = (f64::from(u) - x).hypot(f64::from(v) - y);
            assert!(off < 1e-3, "{:?} {point:?}: ({u}, {v}), OpenCV ({x}, {y})", camera.distortion());
        }
        // The map that is completed holds these pixels.
        let cloud = points.iter().map(|point| point.map(|c| c as f32));
        let (sparse, report) =
            SparseDepth::from_cloud(cloud, &camera, &pose, &sdim::depth::Visibility::all()).unwrap();
        assert_eq!(report.measured + report.overdrawn + report.outside, 24, "{report}");
        for [x, y] in rows::<2>(&case["projected"]) {
            assert!(sparse.get(x.round() as usize, y.round() as usize).is_some() || x > 639.49 || y > 479.49);
        }
    }
}

#[test]
fn pixels_look_where_opencv_says() {
    for case in fixture("cameras.json") {
        let camera = camera(&case);
        for ([x, y], [a, b]) in rows(&case["pixels"]).into_iter().zip(rows::<2>(&case["rays"])) {
            let ray = camera.ray(x as f32, y as f32).unwrap();
            let off = (f64::from(ray[0]) - a).hypot(f64::from(ray[1]) - b);
            assert!(off < 2e-6, "{:?} ({x}, {y}): {ray:?}, OpenCV ({a}, {b})", camera.distortion());
        }
    }
}

#[test]
fn calibrations_pass_through_messages() {
    for case in fixture("cameras.json") {
        let k: [f64; 9] = numbers(&case["k"]).try_into().unwrap();
        let info = CameraInfo {
            width: 640,
            height: 480,
            distortion_model: case["model"].as_str().unwrap().to_string(),
            d: numbers(&case["d"]),
            k,
            ..CameraInfo::default()
        };
        assert_eq!(info.to_camera().unwrap(), camera(&case));
    }
}

fn image(case: &Value, (width, height): (u32, u32), bytes_per_pixel: u32) -> Image {
    Image {
        height,
        width,
        encoding: case["encoding"].as_str().unwrap().to_string(),
        is_bigendian: 0,
        step: width * bytes_per_pixel,
        data: bytes(&case["raw"]),
    }
}

#[test]
fn yuv_is_converted_as_opencv_converts_it() {
    let mut cases = 0;
    for case in fixture("frames.json").iter().filter(|case| case["size"].is_array()) {
        cases += 1;
        let rgb = image(case, (12, 8), 2).to_rgb().unwrap();
        let worst = rgb.as_raw().iter().zip(bytes(&case["rgb"])).map(|(a, b)| a.abs_diff(b)).max();
        assert!(worst <= Some(1), "{}: {worst:?}", case["encoding"]);
    }
    assert_eq!(cases, 2);
}

/// OpenCV interpolates linearly within a colour; ours also follows the others, and must be nearer to the picture.
#[test]
fn bayer_patterns_come_out_nearer_to_the_truth_than_opencvs() {
    let truth = sdim::read_rgb(format!("{}/assets/example/rgb.png", env!("CARGO_MANIFEST_DIR"))).unwrap();
    let mut cases = 0;
    for case in fixture("frames.json").iter().filter(|case| case["part"].is_array()) {
        cases += 1;
        let [x, y, width, height] = <[f64; 4]>::try_from(numbers(&case["part"])).unwrap().map(|v| v as u32);
        let ours = image(case, (width, height), 1).to_rgb().unwrap();
        let theirs = sdim::RgbImage::from_raw(width, height, bytes(&case["rgb"])).unwrap();
        // Mean square difference, and mean difference of the two; two pixels of border apart, where OpenCV repeats.
        let (mut our_error, mut their_error, mut apart, mut count) = (0.0, 0.0, 0.0, 0.0);
        for (row, column) in (2..height - 2).flat_map(|row| (2..width - 2).map(move |column| (row, column))) {
            for c in 0..3 {
                let at = |image: &sdim::RgbImage| f64::from(image.get_pixel(column, row).0[c]);
                let real = f64::from(truth.get_pixel(x + column, y + row).0[c]);
                our_error += (at(&ours) - real).powi(2);
                their_error += (at(&theirs) - real).powi(2);
                apart += (at(&ours) - at(&theirs)).abs();
                count += 1.0;
            }
        }
        let name = &case["encoding"];
        assert!(our_error < 0.6 * their_error, "{name}: {our_error} against {their_error}");
        assert!(apart / count < 6.0, "{name}: {} levels apart", apart / count);
    }
    assert_eq!(cases, 4);
}

#[test]
fn structured_arrays_are_clouds() {
    let cases = fixture("clouds.json");
    assert_eq!(cases.len(), 6);
    for case in cases {
        let datatype = case["datatype"].as_u64().unwrap() as u8;
        let offsets = numbers(&case["offsets"]);
        let field = |(name, offset): (&str, &f64)| PointField {
            name: name.to_string(),
            offset: *offset as u32,
            datatype,
            count: 1,
        };
        let data = bytes(&case["data"]);
        let cloud = PointCloud2 {
            height: 2,
            width: 3,
            fields: ["x", "y", "z"].into_iter().zip(&offsets).map(field).collect(),
            is_bigendian: case["is_bigendian"].as_bool().unwrap(),
            point_step: case["point_step"].as_u64().unwrap() as u32,
            row_step: data.len() as u32 / 2,
            data,
            is_dense: true,
        };
        let expected: Vec<[f32; 3]> =
            rows::<3>(&case["points"]).iter().map(|p| p.map(|c| c as f32)).collect();
        assert_eq!(cloud.points().unwrap(), expected);
    }
}

/// The bundled frame's own depth, seen from its own camera: nothing is hidden, whatever the share of the pixels that is measured.
#[test]
fn what_the_camera_sees_is_kept() {
    let (mm, example) =
        (sdim::DepthScale::millimetres(), format!("{}/assets/example", env!("CARGO_MANIFEST_DIR")));
    let camera = Camera::new(640, 480, Intrinsics::from_fov(640, 480, 1.1), Distortion::None).unwrap();
    for (name, one_in, lost) in
        [("sparse", 1, 0.0), ("gt", 613, 0.0), ("gt", 97, 0.01), ("gt", 13, 0.006), ("gt", 1, 0.002)]
    {
        let map = SparseDepth::read(format!("{example}/{name}.png"), Some(mm)).unwrap();
        let some = map.points().filter(|(x, y, _)| (x * 31 + y * 17) % one_in == 0);
        let point = |(x, y, d): (usize, usize, f32)| camera.ray(x as f32, y as f32).unwrap().map(|c| c * d);
        let (_, report) =
            SparseDepth::from_cloud(some.map(point), &camera, &Transform::identity(), &Default::default())
                .unwrap();
        assert_eq!(report.measured + report.hidden, report.points);
        assert!(
            report.points >= 500 && report.hidden as f64 <= lost * report.points as f64,
            "1 in {one_in}: {report}"
        );
    }
}
