use super::camera::Camera;
use super::cast::{NOTHING, cast};
use super::shapes::{Kind, Solid};
use super::space::{UPRIGHT, V3, norm, turned};
use super::*;

fn solid(kind: Kind, centre: V3, half: V3) -> Solid {
    Solid { kind, centre, half, axes: UPRIGHT, material: 0 }
}

fn camera() -> Camera {
    let k = Intrinsics { fx: 90.0, fy: 110.0, cx: 63.0, cy: 50.0 };
    Camera::new(k, [0.0; 3], 0.0, 0.0, 0.0)
}

#[test]
fn same_seed_same_frame() {
    for seed in 0..8 {
        let (a, b) = (procedural(seed, 64, 48).unwrap(), procedural(seed, 64, 48).unwrap());
        assert_eq!(a.rgb, b.rgb);
        assert!(a.depth.iter().zip(&b.depth).all(|(a, b)| a.to_bits() == b.to_bits()));
        assert_ne!(a.rgb, procedural(seed + 100, 64, 48).unwrap().rgb);
    }
}

#[test]
fn a_facing_wall_has_one_z_depth() {
    let wall = solid(Kind::Cuboid, [0.0, 0.0, 3.5], [50.0, 50.0, 0.5]);
    let hits = cast(&[wall], &camera(), 128, 96);
    for (i, d) in hits.depth.iter().enumerate() {
        // Ray distance would grow to 3.9 m in the corners.
        assert!((d - 3.0).abs() < 1e-5, "pixel {i}: {d}");
    }
}

#[test]
fn a_floor_follows_its_rows() {
    let camera = camera();
    let floor = solid(Kind::Cuboid, [0.0, -2.5, 0.0], [500.0, 1.0, 500.0]);
    let hits = cast(&[floor], &camera, 128, 96);
    for y in 0..96 {
        for x in [0, 63, 127] {
            let d = hits.depth[y * 128 + x];
            let v = (y as f32 - 50.0) / 110.0;
            let expected = if v > 0.0 { 1.5 / v } else { f32::INFINITY };
            assert!(d == expected || (d / expected - 1.0).abs() < 1e-5, "row {y}: {d} {expected}");
        }
    }
}

#[test]
fn a_ball_off_the_axis_has_its_z_depth() {
    let camera = camera();
    let (c, r) = ([0.9f64, -0.4, 3.0], 0.6f64);
    let ball = solid(Kind::Ellipsoid, [0.9, -0.4, 3.0], [0.6; 3]);
    let hits = cast(&[ball], &camera, 128, 96);
    let mut seen = 0;
    for y in 0..96 {
        for x in 0..128 {
            let d = [(x as f64 - 63.0) / 90.0, -(y as f64 - 50.0) / 110.0, 1.0];
            let dot = |a: [f64; 3], b: [f64; 3]| a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
            let (a, b) = (dot(d, d), dot(d, c));
            let disc = b * b - a * (dot(c, c) - r * r);
            let found = hits.depth[y * 128 + x];
            if disc > 1e-4 {
                let expected = (b - disc.sqrt()) / a;
                assert!((f64::from(found) - expected).abs() < 1e-4, "{found} {expected}");
                seen += 1;
            } else if disc < -1e-4 {
                assert_eq!(found, f32::INFINITY);
            }
        }
    }
    assert!(seen > 500, "{seen}");
}

/// Every hit lies on the surface, whatever the attitude, and its normal faces the camera.
#[test]
fn hits_lie_on_tilted_solids() {
    let camera = camera();
    let kinds = [
        Kind::Cuboid,
        Kind::Ellipsoid,
        Kind::Frustum { top: 1.0 },
        Kind::Frustum { top: 0.3 },
        Kind::Frustum { top: 0.0 },
        Kind::Cut { normal: [1.0, 1.0, 0.5], offset: 0.4 },
    ];
    for kind in kinds {
        let axes = turned(0.7, -0.5, 0.3);
        let s = Solid { kind, centre: [0.2, 0.1, 4.0], half: [0.8, 1.1, 0.5], axes, material: 0 };
        let hits = cast(std::slice::from_ref(&s), &camera, 128, 96);
        let mut seen = 0;
        for (i, &t) in hits.depth.iter().enumerate().filter(|(_, t)| t.is_finite()) {
            let ray = camera.ray((i % 128) as f32, (i / 128) as f32);
            let p = s.to_unit(super::space::sub(super::space::mul(ray, t), s.centre));
            let side = (p[0] * p[0] + p[2] * p[2]).sqrt();
            let gap = match kind {
                Kind::Cuboid => p.iter().fold(0.0f32, |m, v| m.max(v.abs())) - 1.0,
                Kind::Ellipsoid => norm(p) - 1.0,
                Kind::Frustum { top } => {
                    let radius = 0.5 * (1.0 + top) + 0.5 * (top - 1.0) * p[1];
                    (side - radius).max(p[1].abs() - 1.0)
                }
                Kind::Cut { normal, offset } => {
                    let cube = p.iter().fold(0.0f32, |m, v| m.max(v.abs())) - 1.0;
                    cube.max(super::space::dot(normal, p) - offset)
                }
            };
            assert!(gap.abs() < 2e-4, "{kind:?}: {p:?} is {gap} off");
            assert!(super::space::dot(s.normal(p), ray) < 0.02, "{kind:?}: {p:?}");
            seen += 1;
        }
        assert!(seen > 300, "{kind:?}: {seen}");
    }
}

#[test]
fn thin_poles_are_unbroken() {
    let camera = camera();
    let wall = solid(Kind::Cuboid, [0.0, 0.0, 9.0], [50.0, 50.0, 0.5]);
    // 3 cm at 2 m: 1.35 pixels wide, so every row has at least one pixel on it.
    let pole = solid(Kind::Frustum { top: 1.0 }, [0.31, 0.0, 2.0], [0.015, 5.0, 0.015]);
    let hits = cast(&[wall, pole], &camera, 128, 96);
    for row in hits.depth.chunks(128) {
        let on = row.iter().filter(|d| (**d - 2.0).abs() < 0.02).count();
        assert!((1..=2).contains(&on), "{on}");
    }
}

#[test]
fn solids_around_or_behind_the_camera_are_unseen() {
    let around = solid(Kind::Cuboid, [0.0; 3], [1.0; 3]);
    let behind = solid(Kind::Ellipsoid, [0.0, 0.0, -3.0], [1.0; 3]);
    let hits = cast(&[around, behind], &camera(), 32, 24);
    assert!(hits.solid.iter().all(|&s| s == NOTHING));
}

#[test]
fn frames_are_sane_at_every_size() {
    for (seed, w, h) in [(1, 1, 1), (2, 2, 1), (3, 1, 7), (4, 5, 3), (5, 33, 200), (6, 320, 20)] {
        let frame = procedural(seed, w, h).unwrap();
        assert_eq!((frame.width(), frame.height(), frame.depth.len()), (w, h, w * h));
    }
    assert!(matches!(procedural(0, 0, 5), Err(Error::Argument { name: "width", .. })));
    assert!(matches!(procedural(0, 5, 9000), Err(Error::Argument { name: "height", .. })));
}

#[test]
fn scenes_differ_in_scale_and_content() {
    let mut medians = Vec::new();
    let (mut sky, mut edges) = (0, 0);
    for seed in 0..48 {
        let frame = procedural(seed, 64, 48).unwrap();
        let mut d: Vec<f32> = frame.depth.iter().copied().filter(|d| d.is_finite()).collect();
        assert!(d.iter().all(|&d| d > 0.0 && d < 2000.0));
        assert!(d.len() * 10 > frame.depth.len() * 3, "seed {seed}: {} valid", d.len());
        sky += usize::from(d.len() < frame.depth.len());
        edges += usize::from(frame.depth.windows(2).filter(|p| (p[1] / p[0] - 1.0).abs() > 0.1).count() > 60);
        d.sort_by(f32::total_cmp);
        medians.push(d[d.len() / 2]);
    }
    medians.sort_by(f32::total_cmp);
    assert!(medians[4] < 1.5 && medians[43] > 6.0, "{medians:?}");
    assert!(sky >= 3 && edges >= 30, "{sky} with sky, {edges} with depth edges");
}

#[test]
fn streets_are_seen_from_a_car_and_reach_far() {
    let (mut near, mut far) = (0, 0);
    for seed in 0..12 {
        let frame = street(seed, 96, 48).unwrap();
        let again = street(seed, 96, 48).unwrap();
        assert!(
            frame.rgb == again.rgb
                && frame.depth.iter().zip(&again.depth).all(|(a, b)| a.to_bits() == b.to_bits())
        );
        let mut d: Vec<f32> = frame.depth.iter().copied().filter(|d| d.is_finite()).collect();
        d.sort_by(f32::total_cmp);
        assert!(d[0] > 1.0, "seed {seed}: {} m before the car", d[0]);
        near += usize::from(d[d.len() / 20] < 12.0);
        far += usize::from(d[d.len() * 19 / 20] > 25.0);
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        for rings in [16, 32, 64] {
            let lidar = SpinningLidar::rings(rings).unwrap().mounted(&mut rng);
            let sparse = lidar.scan(&frame.depth, 96, 48, &frame.intrinsics, &mut rng).unwrap();
            assert!(sparse.measured() > 4 * rings, "seed {seed}: {} of {rings} rings", sparse.measured());
        }
    }
    assert!(near >= 9 && far >= 6, "{near} {far}");
}
