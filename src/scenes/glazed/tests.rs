use super::super::procedural;
use super::super::shapes::{Kind, Solid};
use super::super::space::{UPRIGHT, V3};
use super::glazing::Cell;
use super::*;

fn same(a: &[f32], b: &[f32]) -> bool {
    a.iter().zip(b).all(|(a, b)| a.to_bits() == b.to_bits())
}

#[test]
fn same_seed_same_frame() {
    for seed in 0..6 {
        let (a, b) = (glazed(seed, 64, 48).unwrap(), glazed(seed, 64, 48).unwrap());
        let (ga, gb) = (a.glass.unwrap(), b.glass.unwrap());
        assert!(a.rgb == b.rgb && ga.pane == gb.pane && same(&a.depth, &b.depth));
        assert!(same(&ga.sensed, &gb.sensed) && same(&ga.behind, &gb.behind));
        assert_ne!(a.rgb, glazed(seed + 100, 64, 48).unwrap().rgb);
        assert_ne!(a.rgb, procedural(seed, 64, 48).unwrap().rgb);
    }
    for (w, h) in [(1, 1), (5, 3), (1, 40)] {
        assert_eq!(glazed(3, w, h).unwrap().depth.len(), w * h);
    }
    assert!(glazed(0, 0, 5).is_err());
}

#[test]
fn a_sensor_sees_through_panes_and_elsewhere_what_is_there() {
    let (mut all, mut glass, mut through, mut nothing, mut itself, mut deep) = (0, 0, 0, 0, 0, 0);
    for seed in 0..48 {
        let frame = glazed(seed, 64, 48).unwrap();
        let maps = frame.glass.as_ref().unwrap();
        assert!(same(frame.sensed(), &maps.sensed));
        let own = maps.pane.iter().filter(|p| **p).count();
        assert!(own * 20 > frame.depth.len(), "seed {seed}: {own} pixels of panes");
        for (i, &depth) in frame.depth.iter().enumerate() {
            let (behind, sensed) = (maps.behind[i], maps.sensed[i]);
            all += 1;
            if !maps.pane[i] {
                assert_eq!((behind.to_bits(), sensed.to_bits()), (depth.to_bits(), depth.to_bits()));
                continue;
            }
            glass += 1;
            // Nothing is behind a pane and nearer than it, or seen nearer.
            let not_nearer = |d: f32| d.is_nan() || d >= depth;
            assert!(depth > 0.0 && not_nearer(behind) && not_nearer(sensed), "{depth} {behind} {sensed}");
            deep += usize::from(behind.is_nan() || behind > 1.15 * depth);
            through += usize::from(sensed.to_bits() == behind.to_bits() && !sensed.is_nan());
            nothing += usize::from(sensed.is_nan());
            itself += usize::from(sensed == depth);
        }
    }
    assert!(glass * 5 > all && deep * 3 > glass * 2, "{glass} of {all}, {deep} before something far");
    assert!(
        through * 5 > glass * 2 && nothing * 8 > glass && itself * 25 > glass,
        "{through} {nothing} {itself}"
    );
}

/// The inverse of a plane's Z-depth is linear in the pixel.
#[test]
fn a_panes_depth_is_that_of_its_plane() {
    let mut seen = 0;
    for seed in 0..24 {
        let view = View::new(&mut ChaCha8Rng::seed_from_u64(seed), 96, 72);
        if view.glazings.len() != 1 {
            continue;
        }
        let frame = view.photograph();
        let panes = frame.glass.unwrap().pane;
        let pixels: Vec<usize> = (0..panes.len()).filter(|&i| panes[i]).collect();
        let point = |i: usize| [(i % 96) as f64, (i / 96) as f64, 1.0 / f64::from(frame.depth[i])];
        let (Some(&first), Some(&last)) = (pixels.first(), pixels.last()) else { continue };
        let (a, b) = (point(first), point(last));
        // The pixel that is farthest from the line through these two.
        let area = |p: [f64; 3]| (b[0] - a[0]) * (p[1] - a[1]) - (b[1] - a[1]) * (p[0] - a[0]);
        let by_area = |i: &usize, k: &usize| area(point(*i)).abs().total_cmp(&area(point(*k)).abs());
        let c = point(pixels.iter().copied().max_by(by_area).unwrap());
        if area(c).abs() < 400.0 {
            continue;
        }
        for &i in &pixels {
            let p = point(i);
            // Barycentric coordinates of the pixel.
            let of = |u: [f64; 3], v: [f64; 3]| {
                ((u[0] - p[0]) * (v[1] - p[1]) - (u[1] - p[1]) * (v[0] - p[0])) / area(c)
            };
            let expected = of(b, c) * a[2] + of(c, a) * b[2] + of(a, b) * c[2];
            assert!((p[2] / expected - 1.0).abs() < 2e-4, "seed {seed}, pixel {i}: {} {expected}", p[2]);
        }
        seen += 1;
    }
    assert!(seen > 8, "{seen}");
}

/// A camera at the origin, a wall 6 m before it, and a ball behind its back.
fn before_a_pane(at: V3) -> (Stage, Glazing) {
    let k = Intrinsics { fx: 60.0, fy: 60.0, cx: 47.5, cy: 35.5 };
    let mut stage = Stage::new(ChaCha8Rng::seed_from_u64(1), Camera::new(k, [0.0, 1.0, 0.0], 0.0, 0.0, 0.0));
    let paint = stage.plain([0.5; 3]);
    let solid = |kind, centre, half| Solid { kind, centre, half, axes: UPRIGHT, material: paint };
    stage.solids.push(solid(Kind::Cuboid, [0.0, 0.0, 6.5], [50.0, 50.0, 0.5]));
    stage.solids.push(solid(Kind::Ellipsoid, at, [0.5; 3]));
    let (sheet, sensing) = (Sheet::draw(&mut stage, 2.0), Sensing::draw(&mut stage));
    let cells = vec![Cell { x: [-9.0, 9.0], y: [-9.0, 9.0], glass: true }];
    (stage, Glazing { place: Place::new([0.0, 0.0, 2.0], 0.0), cells, sheet, sensing })
}

#[test]
fn panes_mirror_what_is_before_them_and_nothing_else() {
    let (stage, glazing) = before_a_pane([0.4, 1.0, -1.0]);
    let mirror = Mirror::new(&stage, &glazing, 96, 72);
    // The ball's image is as far behind the pane as the ball is before it: 5 m away, its front half a metre nearer.
    let (x, y) = ((47.5 + 60.0 * 0.4 / 4.5f32) as usize, 36);
    assert!((mirror.hits.depth[y * 96 + x] - 4.5).abs() < 0.02, "{}", mirror.hits.depth[y * 96 + x]);
    assert_eq!(mirror.hits.depth[y * 96 + 5], f32::INFINITY, "the wall is beyond the pane");
    // One between pane and wall is seen, not mirrored.
    let (stage, glazing) = before_a_pane([0.4, 1.0, 4.0]);
    let mirror = Mirror::new(&stage, &glazing, 96, 72);
    assert!(mirror.hits.depth.iter().all(|t| *t == f32::INFINITY));
}

#[test]
fn what_a_pane_shows_is_what_is_behind_it_and_what_it_mirrors() {
    let (stage, mut glazing) = before_a_pane([0.4, 1.0, -1.0]);
    let s = &mut glazing.sheet;
    (s.tint, s.behind, s.dirt, s.frost, s.edges, s.shine) = ([1.0; 3], [1.0; 3], 0.0, None, false, 1.0);
    let mirror = Mirror::new(&stage, &glazing, 96, 72);
    let (middle, ball) = (36 * 96 + 10, 36 * 96 + 52);
    let seen = |glazing: &Glazing, pixel: usize| {
        let ray = stage.camera.ray((pixel % 96) as f32, (pixel / 96) as f32);
        let at = glazing.crossing(stage.camera.at, ray).unwrap();
        assert_eq!(at.t, 2.0);
        mirror.seen(glazing, &at, pixel, 0.03, [0.5; 3])
    };
    // A twelfth is what the pane mirrors, the rest what is behind it.
    let plain = seen(&glazing, ball)[0];
    glazing.sheet.shine = 4.0;
    let shiny = seen(&glazing, ball)[0];
    assert!((plain - 0.5).abs() < 0.1 && (plain - shiny).abs() > 0.005, "{plain} {shiny}");
    glazing.sheet.tint = [0.5, 1.0, 0.5];
    let green = seen(&glazing, middle);
    assert!(green[1] > 1.3 * green[0], "{green:?}");
    glazing.cells[0].glass = false;
    assert_eq!(seen(&glazing, middle), [0.5; 3], "an opening shows what is behind it");
}

/// One pane fills the picture; what its sensing says is what a sensor has of it.
#[test]
fn a_sensor_has_of_a_pane_what_is_drawn_for_it() {
    let (stage, mut glazing) = before_a_pane([0.4, 1.0, -1.0]);
    (glazing.sheet.dirt, glazing.sheet.frost) = (0.0, None);
    let hits = cast(&stage.solids, &stage.camera, 96, 72);
    let glass = |change: &dyn Fn(&mut Glazing)| {
        let mut glazing = glazing.clone();
        let s = &mut glazing.sensing;
        (s.pane, s.nothing, s.mirrored, s.glint) = (0.0, 0.0, 0.0, 2.0);
        change(&mut glazing);
        let (stage, hits) = (stage.clone(), hits.clone());
        View { stage, glazings: vec![glazing], hits, size: (96, 72) }.photograph().glass.unwrap()
    };
    // The camera's scenes may be scaled as a whole after they were built.
    let scale = glass(&|_| {}).behind[0] / hits.depth[0];
    let at = 36 * 96 + 52;
    let found = |change: &dyn Fn(&mut Glazing)| glass(change).sensed[at] / scale;
    assert!((found(&|_| {}) - 6.0).abs() < 1e-3, "the wall");
    assert!((found(&|g| g.sensing.pane = 1.0) - 2.0).abs() < 1e-3, "the pane");
    assert!(found(&|g| g.sensing.nothing = 1.0).is_nan());
    assert!((found(&|g| g.sensing.mirrored = 1.0) - 4.5).abs() < 0.02, "the ball in the mirror");
    assert!((found(&|g| g.sensing.glint = -1.0) - 2.0).abs() < 1e-3, "seen straight on");
    let open = glass(&|g| g.cells[0].glass = false);
    assert!(!open.pane.contains(&true) && same(&open.sensed, &open.behind), "an opening is no pane");
}

#[test]
fn a_mirrored_frame_is_mirrored_in_all_its_maps() {
    let clean = glazed(5, 64, 48).unwrap();
    let mut frame = clean.clone();
    frame.mirror();
    let (a, b) = (clean.glass.as_ref().unwrap(), frame.glass.as_ref().unwrap());
    for i in 0..64 * 48 {
        let k = i / 64 * 64 + 63 - i % 64;
        assert_eq!(a.pane[i], b.pane[k]);
        for (before, after) in [(&clean.depth, &frame.depth), (&a.behind, &b.behind), (&a.sensed, &b.sensed)]
        {
            assert_eq!(before[i].to_bits(), after[k].to_bits());
        }
    }
    assert_eq!(frame.intrinsics.cx, 63.0 - clean.intrinsics.cx);
    frame.mirror();
    assert!(frame.rgb == clean.rgb && same(&frame.depth, &clean.depth));
}
