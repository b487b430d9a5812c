use super::*;
use crate::depth::{Distortion, Intrinsics};

const K: Intrinsics = Intrinsics { fx: 400.0, fy: 400.0, cx: 319.5, cy: 119.5 };
const LENS: Distortion = Distortion::PlumbBob([-0.2, 0.05, 0.001, -0.0005, 0.0]);

fn camera(lens: Distortion) -> Camera {
    Camera::new(640, 240, K, lens).unwrap()
}

/// The LiDAR stands 25 cm above the camera and 15 cm to its left; axes are those of the camera.
const LIDAR: [f32; 3] = [-0.15, -0.25, 0.0];

fn lidar_to_camera() -> Transform {
    Transform::from_quaternion([0.0, 0.0, 0.0, 1.0], LIDAR.map(f64::from)).unwrap()
}

/// A board 30 cm wide 4 m ahead, before a wall 9 m ahead: Z-depth along a direction with z = 1.
fn pole(from: [f32; 3], ray: [f32; 3]) -> f32 {
    let x = from[0] + 4.0 * ray[0];
    if (-0.15..0.15).contains(&x) { 4.0 } else { 9.0 }
}

/// What a LiDAR with lines every degree and points every fifth of one measures, in its own axes.
fn scan(depth: impl Fn([f32; 3], [f32; 3]) -> f32) -> Vec<[f32; 3]> {
    let mut cloud = Vec::new();
    for line in -15..=15 {
        for step in -200..=200 {
            let (up, aside) = ((line as f32).to_radians(), (step as f32 * 0.2).to_radians());
            let ray = [aside.tan(), up.tan() / aside.cos(), 1.0];
            let z = depth(LIDAR, ray);
            if z.is_finite() && z > 0.0 {
                cloud.push(ray.map(|c| c * z));
            }
        }
    }
    cloud
}

#[test]
fn a_wall_behind_a_pole_is_not_seen_through_it() {
    for lens in [Distortion::None, LENS] {
        let camera = camera(lens);
        let cloud = scan(pole);
        let measure = |visibility: &Visibility| {
            SparseDepth::from_cloud(cloud.iter().copied(), &camera, &lidar_to_camera(), visibility).unwrap()
        };
        // Wall points where the camera has the pole before it: all, and those between two scan lines on it. The rest is right.
        let count = |sparse: &SparseDepth| {
            let truth = |x: usize, y: usize| pole([0.0; 3], camera.ray(x as f32, y as f32).unwrap());
            let through = |&(x, y, d): &(usize, usize, f32)| d > 8.0 && truth(x, y) < 5.0;
            let wrong: Vec<_> = sparse.points().filter(through).collect();
            let between = wrong.iter().filter(|(_, y, _)| (10..200).contains(y)).count();
            (between, wrong.len(), sparse.measured() - wrong.len())
        };
        let (all, _) = measure(&Visibility::all());
        let (seen, report) = measure(&Visibility::default());
        let ((between, through, right), (left, _, kept)) = (count(&all), count(&seen));
        assert!(between > 50 && through > 80, "{between} and {through} points shine through");
        assert_eq!(left, 0, "of {between}");
        assert_eq!(kept, right, "good points are lost");
        assert!((between..=through).contains(&report.hidden), "{report}");
    }
}

#[test]
fn slanted_planes_lose_nothing() {
    // A road 1.6 m below the camera, a wall that runs away to the right, and both sides of a corridor.
    let road = |from: [f32; 3], ray: [f32; 3]| (1.6 - from[1]) / ray[1];
    let wall = |from: [f32; 3], ray: [f32; 3]| (3.0 - from[0] - 0.1 * from[2]) / (ray[0] + 0.05);
    let corridor = |from: [f32; 3], ray: [f32; 3]| {
        let side = if ray[0] > 0.0 { 1.2 } else { -1.2 };
        ((side - from[0]) / ray[0]).min(30.0)
    };
    let scenes: [&dyn Fn([f32; 3], [f32; 3]) -> f32; 3] = [&road, &wall, &corridor];
    for (scene, depth) in scenes.into_iter().enumerate() {
        let cloud = scan(|from, ray| Some(depth(from, ray)).filter(|z| *z < 80.0).unwrap_or(f32::NAN));
        let camera = camera(LENS);
        let (_, report) =
            SparseDepth::from_cloud(cloud, &camera, &lidar_to_camera(), &Visibility::default()).unwrap();
        assert!(report.measured > 2000, "scene {scene}: {report}");
        assert_eq!(report.hidden, 0, "scene {scene}: {report}");
    }
}

#[test]
fn every_point_is_accounted_for() {
    let camera = camera(Distortion::None);
    let cloud = [
        [0.0, 0.0, 5.0],
        [0.0, 0.0, 4.0],
        [0.0, 0.0, -4.0],
        [0.0, 0.0, 0.0],
        [50.0, 0.0, 4.0],
        [f32::NAN, 0.0, 4.0],
        [0.0, f32::INFINITY, 4.0],
        [1.0, 0.5, 2.0],
    ];
    let identity = Transform::identity();
    let (sparse, report) = SparseDepth::from_cloud(cloud, &camera, &identity, &Visibility::all()).unwrap();
    let expected = ProjectionReport {
        points: 8,
        measured: 2,
        not_finite: 2,
        behind: 2,
        outside: 1,
        overdrawn: 1,
        hidden: 0,
    };
    assert_eq!(report, expected);
    assert_eq!(sparse.points().collect::<Vec<_>>(), [(320, 120, 4.0), (520, 220, 2.0)]);

    let (none, report) = SparseDepth::from_cloud([], &camera, &identity, &Visibility::default()).unwrap();
    assert_eq!(report, ProjectionReport::default());
    assert!(matches!(none.require_points(), Err(Error::NoMeasurement { width: 640, height: 240 })));
    let millimetres =
        SparseDepth::from_cloud([[0.0, 0.0, 12_000.0]], &camera, &identity, &Visibility::default());
    assert!(matches!(millimetres, Err(Error::DepthRange { x: 320, y: 120, .. })));
    let wrong = Visibility { margin: -1.0, ..Visibility::default() };
    assert!(matches!(
        SparseDepth::from_cloud(cloud, &camera, &identity, &wrong),
        Err(Error::Argument { .. })
    ));
}

/// A plane before a depth camera, as that camera's map.
fn plane_map(camera: &Camera) -> SparseDepth {
    let depth = |i: usize| {
        let [x, y, _] = camera.ray((i % camera.width()) as f32, (i / camera.width()) as f32).unwrap();
        // z = 2 + 0.3 x + 0.2 y of the point (x, y) z.
        2.0 / (1.0 - 0.3 * x - 0.2 * y)
    };
    let all = (0..camera.width() * camera.height()).map(depth).collect();
    SparseDepth::new(camera.width(), camera.height(), all).unwrap()
}

#[test]
fn depth_is_registered_to_colour() {
    let depth_k = Intrinsics { fx: 210.0, fy: 210.0, cx: 159.5, cy: 119.5 };
    let depth_camera = Camera::new(320, 240, depth_k, LENS).unwrap();
    let map = plane_map(&depth_camera);
    let to_colour = Transform::from_quaternion([0.0, 0.01, 0.0, 0.99995], [0.05, 0.0, 0.002]).unwrap();
    let fine_k = Intrinsics { fx: 600.0, fy: 600.0, cx: 319.5, cy: 239.5 };
    let fine = Camera::new(640, 480, fine_k, Distortion::Equidistant([0.01, 0.0, 0.0, 0.0])).unwrap();
    let coarse_k = Intrinsics { fx: 60.0, fy: 60.0, cx: 31.5, cy: 23.5 };
    let coarse = Camera::new(64, 48, coarse_k, Distortion::None).unwrap();
    let back = to_colour.inverse();
    for (colour, share) in [(fine, 0.05..0.4), (coarse, 0.9..1.01)] {
        let (sparse, report) =
            map.register(&depth_camera, &colour, &to_colour, &Visibility::default()).unwrap();
        let measured = sparse.measured() as f64 / (sparse.width() * sparse.height()) as f64;
        assert!(share.contains(&measured), "{measured}: {report}");
        assert_eq!(report.hidden, 0);
        assert_eq!(report.points, 320 * 240);
        // Each measurement lies on the plane, in the depth camera's axes; half a colour pixel may be off.
        let worst = sparse.points().map(|(x, y, d)| {
            let [x, y, z] = back.apply(colour.ray(x as f32, y as f32).unwrap().map(|c| c * d));
            (z - 2.0 - 0.3 * x - 0.2 * y).abs()
        });
        let (worst, pixel) = (worst.fold(0.0, f32::max), 2.5 / colour.intrinsics().fx);
        assert!(worst < 0.8 * pixel, "{worst} m off, a pixel is {pixel} m");
    }
    let wrong = map.register(&coarse, &fine, &to_colour, &Visibility::default());
    assert!(wrong.unwrap_err().to_string().contains("320x240"));
}

#[test]
fn low_resolution_depth_lies_under_its_centres() {
    // ARKit: each pixel of 256x192 stands for 7.5 x 7.5 of 1920x1440; the first has its centre at 3.25.
    let all: Vec<f32> = (0..256 * 192).map(|i| 1.0 + i as f32 * 1e-4).collect();
    let depth = SparseDepth::new(256, 192, all.clone()).unwrap();
    let placed = SparseDepth::from_low_resolution(&depth, 1920, 1440).unwrap();
    assert_eq!(placed.measured(), 256 * 192);
    assert_eq!((placed.get(3, 3), placed.get(11, 3)), (Some(all[0]), Some(all[1])));
    assert_eq!(placed.get(1916, 1436), Some(all[256 * 192 - 1]));
    // The same centre in both pictures, for every pixel: 0.5 / 7.5 of a depth pixel is what rounding may take.
    for (x, y, d) in placed.points() {
        let index = ((d - 1.0) / 1e-4).round() as usize;
        let (u, v) = ((x as f64 + 0.5) / 7.5 - 0.5, (y as f64 + 0.5) / 7.5 - 0.5);
        let off = (u - (index % 256) as f64).abs().max((v - (index / 256) as f64).abs());
        assert!(off <= 0.07, "({x}, {y}) is {off} off");
    }
    let half = SparseDepth::from_low_resolution(&depth, 128, 96).unwrap();
    assert_eq!((half.measured(), half.get(1, 0)), (128 * 96, Some(all[2])));
    assert_eq!(SparseDepth::from_low_resolution(&depth, 256, 192).unwrap().as_slice(), &all[..]);
    // 1241x376 through 4 is 310.25x94; 310x94 is meant.
    let quarter = SparseDepth::new(310, 94, vec![1.0; 310 * 94]).unwrap();
    assert!(SparseDepth::from_low_resolution(&quarter, 1241, 376).is_ok());
    for (width, height) in [(1920, 1080), (1440, 1920), (128, 94), (0, 0), (usize::MAX, 3)] {
        let wrong = SparseDepth::from_low_resolution(&depth, width, height);
        assert!(matches!(wrong, Err(Error::Argument { .. } | Error::ImageSize { .. })), "{width}x{height}");
    }
    let wide = SparseDepth::from_low_resolution(&depth, 1920, 1080).unwrap_err().to_string();
    assert!(wide.contains("1920x1440"), "{wide}");
}
