//! Messages with arbitrary headers: an answer of the size that was claimed, or an error; never a panic, never memory for what is not there.

use proptest::collection::vec;
use proptest::prelude::*;
use sdim::depth::{ProjectionReport, Visibility};
use sdim::messages::{CameraInfo, Image, PointCloud2, PointField, RegionOfInterest};
use sdim::{DepthScale, SparseDepth, Transform};

const ENCODINGS: [&str; 18] = [
    "rgb8",
    "bgr8",
    "rgba8",
    "bgra8",
    "mono8",
    "mono16",
    "yuv422",
    "yuv422_yuy2",
    "uyvy",
    "yuyv",
    "bayer_rggb8",
    "bayer_bggr8",
    "bayer_gbrg8",
    "bayer_grbg8",
    "16UC1",
    "32FC1",
    "8UC3",
    "",
];

/// Mostly small, sometimes anything.
fn size() -> impl Strategy<Value = u32> {
    prop_oneof![4 => 0u32..9, 2 => 0u32..70, 1 => any::<u32>(), 1 => Just(u32::MAX)]
}

fn image() -> impl Strategy<Value = Image> {
    let encoding = prop::sample::select(&ENCODINGS[..]);
    (size(), size(), encoding, any::<u8>(), size(), vec(any::<u8>(), 0..400)).prop_map(
        |(height, width, encoding, is_bigendian, step, data)| Image {
            height,
            width,
            encoding: encoding.to_string(),
            is_bigendian,
            step,
            data,
        },
    )
}

fn field() -> impl Strategy<Value = PointField> {
    let name = prop::sample::select(&["x", "y", "z", "rgb"][..]);
    let datatype = prop_oneof![3 => Just(7u8), 2 => Just(8u8), 1 => any::<u8>()];
    let offset = prop_oneof![5 => 0u32..20, 1 => any::<u32>()];
    (name, offset, datatype, prop_oneof![5 => Just(1u32), 1 => any::<u32>()]).prop_map(
        |(name, offset, datatype, count)| PointField { name: name.to_string(), offset, datatype, count },
    )
}

fn cloud() -> impl Strategy<Value = PointCloud2> {
    let fields = prop_oneof![
        3 => vec(field(), 0..5),
        2 => Just(["x", "y", "z"].iter().zip([0, 4, 8]).map(|(n, o)| PointField::float32(n, o)).collect())
    ];
    (size(), size(), fields, any::<bool>(), size(), size(), vec(any::<u8>(), 0..400)).prop_map(
        |(height, width, fields, is_bigendian, point_step, row_step, data)| PointCloud2 {
            height,
            width,
            fields,
            is_bigendian,
            point_step,
            row_step,
            data,
            is_dense: false,
        },
    )
}

/// Numbers of calibrations, and some that are none.
fn number() -> impl Strategy<Value = f64> {
    prop_oneof![
        6 => -1.0f64..1.0,
        3 => 1.0f64..900.0,
        1 => prop::num::f64::ANY,
    ]
}

fn info() -> impl Strategy<Value = CameraInfo> {
    let models = prop::sample::select(&["plumb_bob", "rational_polynomial", "equidistant", "", "other"][..]);
    let roi = (size(), size(), size(), size(), any::<bool>());
    let numbers = (vec(number(), 9), vec(number(), 9), any::<bool>(), vec(number(), 0..15));
    (size(), size(), models, numbers, (size(), size()), prop::option::of(roi)).prop_map(
        |(height, width, model, (k, r, tidy, d), (binning_x, binning_y), roi)| {
            let mut info =
                CameraInfo { height, width, distortion_model: model.to_string(), d, ..Default::default() };
            info.k = std::array::from_fn(|i| k[i]);
            info.r = std::array::from_fn(|i| r[i]);
            if tidy {
                let d = [4, 5, 8].into_iter().rfind(|n| *n <= info.d.len()).unwrap_or(0);
                info.d.truncate(d);
                info.k = [300.0 * k[0].abs() + 1.0, 0.0, 30.0 * k[2], 0.0, 300.0, 20.0, 0.0, 0.0, 1.0];
            }
            let k = info.k;
            info.p = [k[0], k[1], k[2], r[0], k[3], k[4], k[5], r[1], k[6], k[7], k[8], 0.0];
            (info.binning_x, info.binning_y) = (binning_x, binning_y);
            if let Some((x_offset, y_offset, height, width, do_rectify)) = roi {
                info.roi = RegionOfInterest { x_offset, y_offset, height, width, do_rectify };
            }
            info
        },
    )
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 3000, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn pictures_have_the_size_that_was_claimed(image in image()) {
        let claimed = (image.width as usize, image.height as usize);
        // The fewest bytes of any encoding: one for each pixel.
        let enough = image.data.len() >= claimed.0.saturating_mul(claimed.1);
        if let Ok(rgb) = image.to_rgb() {
            prop_assert_eq!((rgb.width() as usize, rgb.height() as usize), claimed);
            prop_assert!(enough);
        }
        for scale in [None, Some(DepthScale::kitti())] {
            if let Ok(depth) = image.to_depth(scale) {
                prop_assert_eq!((depth.width(), depth.height()), claimed);
                prop_assert!(enough);
            }
        }
    }

    #[test]
    fn clouds_have_the_points_that_were_claimed(cloud in cloud()) {
        if let Ok(points) = cloud.points() {
            prop_assert_eq!(points.len() as u64, u64::from(cloud.width) * u64::from(cloud.height));
            let camera = sdim::Camera::new(
                20,
                10,
                sdim::Intrinsics { fx: 10.0, fy: 10.0, cx: 9.5, cy: 4.5 },
                sdim::Distortion::PlumbBob([-0.1, 0.0, 0.0, 0.0, 0.0]),
            ).unwrap();
            let count = points.len();
            let seen = SparseDepth::from_cloud(points, &camera, &Transform::identity(), &Visibility::default());
            if let Ok((sparse, report)) = seen {
                let ProjectionReport { points, measured, not_finite, behind, outside, overdrawn, hidden } = report;
                prop_assert_eq!(points, count);
                prop_assert_eq!(measured + not_finite + behind + outside + overdrawn + hidden, count);
                prop_assert_eq!(sparse.measured(), measured);
            }
        }
    }

    #[test]
    fn calibrations_give_cameras_that_agree_with_themselves(info in info(), x in 0.0f32..1.0, y in 0.0f32..1.0) {
        let _ = (info.rectification(), info.baseline());
        for camera in [info.to_camera(), info.to_rectified_camera()].into_iter().flatten() {
            prop_assert!(camera.width() <= info.width as usize && camera.height() <= info.height as usize);
            let (x, y) = (x * camera.width() as f32, y * camera.height() as f32);
            // Nearly flat rays are known to few digits.
            if let Some(ray) = camera.ray(x, y).filter(|ray| ray[0].hypot(ray[1]) < 10.0)
                && let Some((u, v)) = camera.project(ray)
            {
                // Coordinates are f32: a direction and a pixel have 24 bits each.
                let scale = 1.0 + x.abs() + y.abs() + camera.intrinsics().cx.abs() + camera.intrinsics().cy.abs();
                prop_assert!((u - x).hypot(v - y) < 1e-3 * scale, "({}, {}) for ({}, {}): {:?}", u, v, x, y, camera);
            }
        }
    }
}
