//! Layouts and frames of models made up here, and of the library that `SDIM_FURNITURE` names.

use super::geometry::tests::cuboid;
use super::geometry::{Face, Geometry};
use super::look::Look;
use super::mesh::ray;
use super::model::tests::entry;
use super::model::{Cover, Model};
use super::role::role;
use super::room::{Hold, Piece, tangled};
use super::*;
use crate::error::Error;

fn cover(opacity: f32) -> Cover {
    Cover {
        colour: [0.6, 0.5, 0.4],
        texture: None,
        mask: None,
        opacity,
        gloss: 0.1,
        exponent: 20.0,
        glow: 0.0,
    }
}

fn joined(parts: &[Geometry]) -> Geometry {
    let mut all = Geometry::default();
    for part in parts {
        let base = all.points.len() as u32;
        all.points.extend(&part.points);
        all.faces.extend(part.faces.iter().map(|f| Face { points: f.points.map(|i| i + base), ..*f }));
    }
    all
}

/// A top on four legs, a seat with a back, boards between sides, or a box, by the name; half a metre tall parts and so on are
/// scaled to `size`.
fn shape(name: &str, size: V3) -> Geometry {
    let [w, h, d] = [0.5 * size[0], size[1], 0.5 * size[2]];
    let leg = |x: f32, z: f32, top: f32| {
        cuboid([x * w - 0.02, 0.0, z * d - 0.02], [x * w + 0.02, top, z * d + 0.02], 0)
    };
    let legs =
        |top: f32| [leg(0.9, 0.9, top), leg(-0.9, 0.9, top), leg(0.9, -0.9, top), leg(-0.9, -0.9, top)];
    let is = |word: &str| name.to_lowercase().contains(word);
    let parts = match () {
        () if is("table") || is("desk") => {
            [vec![cuboid([-w, h - 0.03, -d], [w, h, d], 0)], legs(h - 0.03).to_vec()].concat()
        }
        () if is("chair") => {
            let seat = cuboid([-w, 0.43, -d], [w, 0.46, d], 0);
            let back = cuboid([-w, 0.46, -d], [w, h, 0.04 - d], 0);
            [vec![seat, back], legs(0.43).to_vec()].concat()
        }
        () if is("bookcase") => {
            let board = |k: usize| {
                let y = (h - 0.02) * k as f32 / 4.0;
                cuboid([-w, y, -d], [w, y + 0.02, d], 0)
            };
            let side = |x: f32| cuboid([x - 0.01, 0.0, -d], [x + 0.01, h, d], 0);
            let back = cuboid([-w, 0.0, -d], [w, h, 0.01 - d], 0);
            [(0..5).map(board).collect(), vec![side(0.01 - w), side(w - 0.01), back]].concat()
        }
        () => vec![cuboid([-w, 0.0, -d], [w, h, d], 0)],
    };
    joined(&parts)
}

/// Models of every kind of room, two of each with other sizes.
fn library() -> Library {
    const LIST: &[(&str, &str, V3)] = &[
        ("Sofa", "Living room", [1.9, 0.8, 0.9]),
        ("Chair", "Living room", [0.45, 0.9, 0.5]),
        ("Armchair", "Living room", [0.8, 0.8, 0.8]),
        ("Table", "Living room", [1.5, 0.75, 0.9]),
        ("Coffee table", "Living room", [1.0, 0.45, 0.5]),
        ("Bookcase", "Living room", [1.0, 1.9, 0.35]),
        ("TV stand", "Living room", [1.3, 0.5, 0.45]),
        ("TV", "Living room", [0.8, 0.5, 0.14]),
        ("Plant", "Living room", [0.5, 1.0, 0.5]),
        ("Little plant", "Living room", [0.2, 0.25, 0.2]),
        ("Rug", "Living room", [1.6, 0.01, 1.2]),
        ("Vase", "Miscellaneous", [0.2, 0.3, 0.2]),
        ("Bed", "Bedroom", [1.6, 0.6, 2.1]),
        ("Bedside table", "Bedroom", [0.45, 0.45, 0.4]),
        ("Wardrobe", "Bedroom", [1.8, 2.0, 0.6]),
        ("Sneakers", "Bedroom", [0.28, 0.12, 0.3]),
        ("Lower cabinet", "Kitchen", [0.6, 0.88, 0.61]),
        ("Upper cabinet", "Kitchen", [0.6, 0.72, 0.4]),
        ("Fridge", "Kitchen", [0.6, 1.8, 0.6]),
        ("Bowl", "Kitchen", [0.3, 0.15, 0.3]),
        ("Mug", "Kitchen", [0.08, 0.1, 0.08]),
        ("Bath", "Bathroom", [1.8, 0.6, 0.7]),
        ("Toilets unit", "Bathroom", [0.4, 0.76, 0.6]),
        ("Washbasin", "Bathroom", [0.6, 0.9, 0.45]),
        ("Soap", "Bathroom", [0.1, 0.05, 0.06]),
        ("Desk", "Office", [1.4, 0.72, 0.7]),
        ("Office chair", "Office", [0.6, 0.95, 0.6]),
        ("Laptop", "Office", [0.34, 0.25, 0.25]),
        ("Stapler", "Office", [0.04, 0.05, 0.12]),
        ("Crate", "Miscellaneous", [0.6, 0.6, 0.6]),
        ("Hammer", "Miscellaneous", [0.3, 0.04, 0.13]),
        ("Lamp", "Lights", [0.3, 0.5, 0.3]),
        ("Hanging light", "Lights", [0.4, 0.5, 0.4]),
        ("Male", "Characters", [0.6, 1.8, 0.4]),
    ];
    let mut models = Vec::new();
    for &(name, category, size) in LIST {
        for k in 0..6 {
            let size = size.map(|v| v * (0.92 + 0.03 * k as f32));
            let e = entry(&format!("{name} {k}"), name, category, size);
            let role = role(&e).unwrap_or_else(|| panic!("{name}"));
            models.push(Arc::new(Model::new(e, role, &shape(name, size), vec![cover(1.0)])));
        }
    }
    for (k, low) in [(0, 0.9f32), (1, 0.0), (2, 0.9), (3, 0.0)] {
        let size = [0.9, if low > 0.0 { 1.1 } else { 2.05 }, 0.2];
        let mut e = entry(&format!("opening {k}"), if low > 0.0 { "Window" } else { "Door" }, "", size);
        (e.opening, e.elevation, e.behind) = (true, low, 0.15);
        let covers = vec![cover(if low > 0.0 { 0.2 } else { 1.0 })];
        models.push(Arc::new(Model::new(e.clone(), role(&e).unwrap(), &shape("", size), covers)));
    }
    Library::new(models, Split::All)
}

fn dice(seed: u64) -> Stage {
    Stage::new(ChaCha8Rng::seed_from_u64(seed), standing(64, 48, [0.0; 3]))
}

/// Pieces are in the room, apart from each other, and stand on something.
fn check(room: &Room, seed: u64) {
    let name = |p: &Piece| format!("seed {seed}: {} {:?} at {:?}", p.model.entry.id, p.hold, p.at);
    for (i, p) in room.pieces.iter().enumerate() {
        let spot = p.spot();
        if p.hold != Hold::Opening {
            assert!(room.plan.inside(&spot), "{} is not in the room", name(p));
        }
        match p.hold {
            Hold::Floor | Hold::Tucked(_) => assert_eq!(p.at[1], 0.0, "{}", name(p)),
            Hold::On(host) => on_something(room, p, host, &name(p)),
            _ => {}
        }
        for q in &room.pieces[..i] {
            // Rugs lie under, doors are in walls; what stands on one piece is checked against what stands there too.
            let apart = |h: Hold| !matches!(h, Hold::Under | Hold::Opening);
            if !apart(p.hold) || !apart(q.hold) || !spot.meets(&q.spot(), 0.0) {
                continue;
            }
            let host = match p.hold {
                Hold::On(h) | Hold::Tucked(h) => Some(h),
                _ => None,
            };
            let with_host = host.is_some_and(|h| std::ptr::eq(&room.pieces[h], q));
            let free = with_host && (matches!(p.hold, Hold::On(_)) || !tangled(p, q));
            // A thing on a table may be under the box of a chair that was pushed below it: neither touches the other.
            assert!(free, "{} stands in {}", name(p), name(q));
        }
    }
    for (host, spot) in &room.small {
        assert!(room.plan.inside(spot), "seed {seed}: a box at {:?}", spot.at);
        let others = room.pieces.iter().filter(|p| p.hold == Hold::On(*host));
        assert!(!others.into_iter().any(|p| p.spot().meets(spot, 0.0)), "seed {seed}: a box in a thing");
    }
}

/// Right below the middle of a thing there is its host, and above its feet there is nothing of it.
fn on_something(room: &Room, p: &Piece, host: usize, name: &str) {
    let h = &room.pieces[host];
    let instance = scene::Instance::new(h.model.mesh.clone(), h.at, h.yaw, 0);
    let from = instance.local([p.at[0], p.at[1] + 0.005, p.at[2]]);
    let down = h.model.mesh.nearest(ray(from, [0.0, -1.0, 0.0], 0.0, 1.0), |_| true);
    let gap = down.map_or(f32::INFINITY, |t| t.t - 0.005);
    assert!(gap.abs() < 0.005, "{name}: {gap} m above its host");
    let up = h.model.mesh.nearest(ray(from, [0.0, 1.0, 0.0], 0.0, p.model.size()[1] - 0.01), |_| true);
    assert!(up.is_none(), "{name}: its host is in it");
}

#[test]
fn pieces_neither_overlap_nor_float_nor_leave_the_room() {
    let library = library();
    let (mut on, mut tucked, mut floor) = (0, 0, 0);
    for seed in 0..60 {
        let room = layout(&library, dice(seed));
        check(&room, seed);
        for p in &room.pieces {
            on += usize::from(matches!(p.hold, Hold::On(_)));
            tucked += usize::from(matches!(p.hold, Hold::Tucked(_)));
            floor += usize::from(p.hold == Hold::Floor);
        }
    }
    assert!(on > 300 && tucked > 60 && floor > 300, "{on} on others, {tucked} tucked, {floor} on the floor");
}

#[test]
fn the_same_seed_gives_the_same_frame_and_parts_share_no_model() {
    let library = library();
    let (train, held) = (library.part(Split::Train).unwrap(), library.part(Split::HeldOut).unwrap());
    let ids = |l: &Library| l.models().into_iter().map(|m| m.id).collect::<Vec<_>>();
    assert!(!ids(&held).is_empty() && ids(&held).iter().all(|id| !ids(&train).contains(id)));
    assert_eq!(ids(&held).len() + ids(&train).len(), ids(&library).len());
    for seed in 0..3 {
        let frame = |l: &Library| furnished(l, seed, 48, 36).unwrap();
        let (a, b) = (frame(&train), frame(&train));
        assert_eq!(a.rgb, b.rgb);
        assert!(a.depth.iter().zip(&b.depth).all(|(a, b)| a.to_bits() == b.to_bits()));
        assert_ne!(a.rgb, frame(&held).rgb);
        assert!(a.depth.iter().any(|d| d.is_finite()) && a.depth.iter().all(|&d| d.is_nan() || d > 0.05));
    }
    assert!(matches!(furnished(&library, 0, 0, 5), Err(Error::Argument { name: "width", .. })));
}

#[test]
fn sizes_and_small_libraries_do_no_harm() {
    let library = library();
    for (seed, w, h) in [(1, 1, 1), (2, 2, 1), (3, 1, 7), (4, 5, 3), (5, 20, 60)] {
        let frame = furnished(&library, seed, w, h).unwrap();
        assert_eq!((frame.width(), frame.height(), frame.depth.len()), (w, h, w * h));
    }
    for one in [0, 40, library.models.len() - 1] {
        let few = Library::new(vec![library.models[one].clone()], Split::All);
        for seed in 0..13 {
            furnished(&few, seed, 16, 12).unwrap();
        }
    }
}

/// A bare room, a box and a pane of glass: what a camera measures, by hand.
fn bare(glass: bool) -> render::Rendered {
    let mut shell = Shell::default();
    let look = shell.look(Look::of(&cover(1.0)));
    let [w, h, l] = [2.0f32, 2.5, 3.0];
    let plan = Plan::new([w, h, l]);
    shell.quad([[-w, 0.0, -l], [w, 0.0, -l], [w, 0.0, l], [-w, 0.0, l]], look);
    shell.quad([[-w, h, -l], [w, h, -l], [w, h, l], [-w, h, l]], look);
    let on = shell::Covering { wall: look, floor: look, skirting: None };
    (0..4).for_each(|k| shell.wall(&plan.wall(k), h, &[], 0.1, &on));
    let mut instances = vec![Instance::new(Arc::new(Mesh::new(&shell.geometry)), [0.0; 3], 0.0, 0)];
    let cube = Arc::new(Mesh::new(&cuboid([-0.5, 0.0, -0.5], [0.5, 1.0, 0.5], 0)));
    instances.push(Instance::new(cube.clone(), [0.5, 0.0, 1.0], 0.6, 0));
    let mut looks = shell.looks;
    if glass {
        looks.push(Look::of(&cover(0.3)));
        instances.push(Instance::new(cube, [-1.0, 0.5, -0.5], 0.0, looks.len() - 1));
    }
    let scene = Scene::new(instances, looks);
    let camera = Camera::new(Intrinsics::from_fov(80, 60, 1.3), [-0.3, 1.2, -2.5], 0.1, -0.2, 0.05);
    let lamps = vec![light::Light::lamp([0.0, 2.3, 0.0], 0.1, [3.0; 3])];
    let lights = Lights { lamps, sun: None, sky: [[1.0; 3]; 2], ambient: [0.1; 3] };
    let (scene, lights, camera) = (&scene, &lights, &camera);
    render::render(&render::View {
        scene,
        lights,
        plan: &plan,
        holes: &[],
        camera,
        width: 80,
        height: 60,
        seed: 1,
    })
}

#[test]
fn depth_is_that_of_the_geometry_and_glass_is_seen_through() {
    let (open, through) = (bare(false), bare(true));
    let camera = Camera::new(Intrinsics::from_fov(80, 60, 1.3), [-0.3, 1.2, -2.5], 0.1, -0.2, 0.05);
    let (mut on_cube, mut tinted) = (0, 0);
    for (i, &found) in open.depth.iter().enumerate() {
        let (d, o) = (camera.ray((i % 80) as f32, (i / 80) as f32), camera.at);
        // The first of the room's six planes, and the box in its own frame.
        let (low, high) = ([-2.0, 0.0, -3.0], [2.0, 2.5, 3.0]);
        let wall = (0..3)
            .map(|k| (if d[k] > 0.0 { high[k] } else { low[k] } - o[k]) / d[k])
            .fold(f32::INFINITY, f32::min);
        let axes = crate::scenes::space::turned(0.6, 0.0, 0.0);
        let local = |v: V3| crate::scenes::space::to_local(&axes, v);
        let (lo, ld) = (local([o[0] - 0.5, o[1] - 0.5, o[2] - 1.0]), local(d));
        let slab = |k: usize| {
            let (a, b) = ((-0.5 - lo[k]) / ld[k], (0.5 - lo[k]) / ld[k]);
            (a.min(b), a.max(b))
        };
        let enter = (0..3).map(|k| slab(k).0).fold(f32::NEG_INFINITY, f32::max);
        let leave = (0..3).map(|k| slab(k).1).fold(f32::INFINITY, f32::min);
        let expected = if enter < leave && enter > 0.0 { enter.min(wall) } else { wall };
        on_cube += usize::from(expected < wall);
        assert!((found / expected - 1.0).abs() < 2e-5, "pixel {i}: {found} for {expected}");
        assert_eq!(found.to_bits(), through.depth[i].to_bits(), "glass is not measured");
        tinted += usize::from((open.colour[i][1] / through.colour[i][1] - 1.0).abs() > 0.15);
    }
    assert!(on_cube > 300 && tinted > 300, "{on_cube} {tinted}");
}

/// Set `SDIM_FURNITURE` to a folder that `scripts/furniture.sh` made, or to a packed one, to run it.
#[test]
fn a_real_library_furnishes_rooms() {
    let Ok(dir) = std::env::var("SDIM_FURNITURE") else {
        eprintln!("skipped: SDIM_FURNITURE names no folder of furniture");
        return;
    };
    let library = Library::open(dir).unwrap();
    for seed in 0..40 {
        check(&layout(&library, dice(seed)), seed);
    }
    let frame = furnished(&library, 7, 64, 48).unwrap();
    assert!(frame.depth.iter().filter(|d| d.is_finite()).count() > 1000);
}
