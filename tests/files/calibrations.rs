//! Calibrations.

use super::{expected, fixture, numbers, triples};
use sdim::calibration::{Calibration, CalibrationOptions};
use sdim::depth::Distortion;
use sdim::{Error, Intrinsics};

const KITTI: [&str; 3] = ["odometry/calib.txt", "object/000001.txt", "raw/calib_cam_to_cam.txt"];

fn kitti() -> CalibrationOptions {
    CalibrationOptions::new(1242, 375).with_camera(2)
}

/// NumPy has multiplied the published matrices.
#[test]
fn points_of_kittis_velodyne_are_seen_where_its_matrices_say() {
    let truth = expected("kitti");
    let depths = numbers(&truth["depths"]);
    for name in KITTI {
        let Calibration { camera, lidar_to_camera } =
            Calibration::read(fixture("calibrations").join(name), &kitti()).unwrap();
        let lidar = lidar_to_camera.unwrap();
        for (i, point) in triples(&truth["points"]).into_iter().enumerate() {
            let seen = lidar.apply(point);
            let (x, y) = camera.project(seen).unwrap();
            let pixel = numbers(&truth["pixels"][i]);
            assert!(
                (f64::from(x) - pixel[0]).abs() < 1e-2 && (f64::from(y) - pixel[1]).abs() < 1e-2,
                "{name}: {x} {y}"
            );
            assert!((f64::from(seen[2]) - depths[i]).abs() < 1e-4, "{name}: {seen:?}");
        }
    }
}

#[test]
fn another_camera_is_another_place_and_none_is_guessed() {
    let path = fixture("calibrations/odometry/calib.txt");
    let origin = |number: usize| {
        let calibration = Calibration::read(&path, &kitti().with_camera(number)).unwrap();
        calibration.lidar_to_camera.unwrap().apply([0.0; 3])[0]
    };
    assert!((origin(1) - origin(0) + 0.537).abs() < 1e-5, "the baseline");
    for name in KITTI {
        let none = Calibration::read(fixture("calibrations").join(name), &CalibrationOptions::new(1242, 375));
        let none = none.unwrap_err();
        assert!(matches!(none, Error::Argument { name: "camera", .. }), "{none}");
        assert!(
            none.to_string().contains("P0, P1, P2, P3") || none.to_string().contains("P_rect_00"),
            "{none}"
        );
        let fourth =
            Calibration::read(fixture("calibrations").join(name), &kitti().with_camera(4)).unwrap_err();
        assert!(fourth.to_string().contains("is missing"), "{fourth}");
    }
    let raw = Calibration::read(
        fixture(&format!("calibrations/{}", KITTI[2])),
        &CalibrationOptions::new(1241, 376).with_camera(2),
    );
    let raw = raw.unwrap_err().to_string();
    assert!(raw.contains("S_rect_02") && raw.contains("1242 375") && raw.contains("1241 376"), "{raw}");
}

fn read(name: &str, text: &str, options: &CalibrationOptions) -> sdim::Result<Calibration> {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join(name);
    std::fs::write(&path, text).unwrap();
    Calibration::read(path, options)
}

const ROS: &str = "image_width: 640\nimage_height: 480\ncamera_name: head_camera\ncamera_matrix:\n  rows: 3\n  cols: 3\n  \
                   data: [525.     ,   0.     , 319.5    ,\n           0.     , 526.     , 239.5    ,\n           0.     ,   0.     ,   1.     ]\n\
                   distortion_model: plumb_bob\ndistortion_coefficients:\n  rows: 1\n  cols: 5\n  data: [-0.28, 0.07, 0.001, -0.0005, 0.]\n\
                   rectification_matrix:\n  rows: 3\n  cols: 3\n  data: [1., 0., 0.,\n         0., 1., 0.,\n         0., 0., 1.]\n\
                   projection_matrix:\n  rows: 3\n  cols: 4\n  data: [500., 0., 320., 0.,\n         0., 501., 240., 0.,\n         0., 0., 1., 0.]\n";

/// The second is PyYAML's.
#[test]
fn camera_info_files_and_messages() {
    let message = std::fs::read_to_string(fixture("calibrations/camera_info.yaml")).unwrap();
    let options = CalibrationOptions::new(640, 480);
    for text in
        [ROS, &message, &message.replace("\nd:", "\nD:").replace("\nk:", "\nK:").replace("\np:", "\nP:")]
    {
        let raw = read("a.yaml", text, &options).unwrap();
        assert_eq!(raw.camera.intrinsics(), Intrinsics { fx: 525.0, fy: 526.0, cx: 319.5, cy: 239.5 });
        assert_eq!(raw.camera.distortion(), Distortion::PlumbBob([-0.28, 0.07, 0.001, -0.0005, 0.0]));
        assert_eq!((raw.camera.width(), raw.camera.height(), raw.lidar_to_camera), (640, 480, None));
        let flat = read("a.yml", text, &options.with_rectified(true)).unwrap().camera;
        assert_eq!(flat.intrinsics(), Intrinsics { fx: 500.0, fy: 501.0, cx: 320.0, cy: 240.0 });
        assert_eq!(flat.distortion(), Distortion::None);
    }
}

#[test]
fn keys_that_are_wrong_are_named() {
    let options = CalibrationOptions::new(640, 480);
    let changes: [(&str, &str, &[&str]); 11] = [
        ("image_width: 640\n", "", &["image_width", "missing", "640"]),
        ("image_height: 480", "image_height: 481", &["image_height", "481", "480, as the picture has"]),
        ("camera_matrix:\n", "matrix:\n", &["camera_matrix.data", "missing"]),
        ("[525. ", "[", &["camera_matrix.data", "\"\""]),
        ("525. ", "x525 ", &["camera_matrix.data", "x525"]),
        ("525. ", "0 ", &["camera_matrix.data", "focal lengths above 0"]),
        ("525. ", "nan ", &["camera_matrix.data", "NaN"]),
        ("0.001, -0.0005, 0.]", "0.001]", &["distortion", "4 or 5 coefficients"]),
        ("plumb_bob", "fov", &["distortion_model", "fov"]),
        ("distortion_coefficients", "coefficients", &["distortion_coefficients.data", "missing"]),
        ("camera_name: head_camera", "what is this", &["what is this", "line 3"]),
    ];
    for (from, to, named) in changes {
        assert!(ROS.contains(from), "{from}");
        let message = read("a.yaml", &ROS.replacen(from, to, 1), &options).unwrap_err().to_string();
        let all = named.iter().all(|n| message.to_lowercase().contains(&n.to_lowercase()))
            && message.contains("a.yaml");
        assert!(all, "{named:?} in {message}");
    }
    let cut = read("a.yaml", &ROS[..ROS.find("data: [525").unwrap() + 20], &options).unwrap_err().to_string();
    assert!(cut.contains("no `]`"), "{cut}");
    for (text, named) in [
        ("P2: 1 0 0 0 0 1 0 0 0 0 1\n", "P2"),
        ("P2: 1 0 0 0 0 0 0 0 0 0 1 0\n", "P2"),
        ("P2: 1 0 0 0 0 1 0 0 0 0 1 0\nTr: 1 0 0 0 0 1 0 0 0 0 3 0\n", "Tr"),
        ("P2: 1 0 0 0 0 1 0 0 0 0 1 0\nTr_velo_to_cam: 1 0 0 0 0 1 0 0 0 0 1 0\n", "R0_rect"),
        ("hello", "neither `P0`"),
    ] {
        let message = read("a.txt", text, &kitti()).unwrap_err().to_string();
        assert!(message.contains(named) && message.contains("a.txt"), "{message}");
    }
    assert!(read("a.json", "{}", &options).unwrap_err().to_string().contains("yaml or yml"));
}

#[test]
fn every_truncation_and_every_changed_byte_ends_in_an_answer() {
    let options = CalibrationOptions::new(640, 480);
    let message = std::fs::read(fixture("calibrations/camera_info.yaml")).unwrap();
    let object = std::fs::read(fixture("calibrations/object/000001.txt")).unwrap();
    let dir = tempfile::tempdir().unwrap();
    for (name, whole, options) in
        [("a.yaml", ROS.as_bytes(), options), ("b.yaml", &message, options), ("c.txt", &object, kitti())]
    {
        let path = dir.path().join(name);
        for at in 0..whole.len() {
            let mut bytes = whole.to_vec();
            bytes[at] ^= 1 << (at % 8);
            for bytes in [&whole[..at], &bytes] {
                std::fs::write(&path, bytes).unwrap();
                let _ = Calibration::read(&path, &options);
            }
        }
    }
}
