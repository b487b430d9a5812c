//! Where the camera is: carried by a robot, a phone in a hand, or a head.

use super::room::Room;
use super::scene::Scene;
use crate::depth::Intrinsics;
use crate::scenes::camera::Camera;
use crate::scenes::space::{V3, dot, unit};

/// Rays along each side of the picture that tell whether a view is worth rendering.
const GRID: [usize; 2] = [24, 18];

/// Heights above the floor and how far the camera looks up or down, radians.
const CARRIERS: [([f32; 2], [f32; 2]); 3] =
    [([0.2, 1.2], [-0.35, 0.2]), ([1.3, 1.6], [-0.75, 0.15]), ([1.6, 1.8], [-0.6, 0.1])];

/// A camera that sees several things, none too near, or the best of those that were tried, and what its view is worth, 0 to 1;
/// none if there is no free place.
pub(super) fn choose(room: &mut Room, scene: &Scene, width: usize, height: usize) -> Option<(f32, Camera)> {
    let mut best: Option<(f32, Camera)> = None;
    for _ in 0..16 {
        let Some(camera) = random(room, width, height) else { continue };
        let score = worth(scene, &camera, width, height);
        if best.as_ref().is_none_or(|(s, _)| score > *s) {
            best = Some((score, camera));
        }
        if score >= 1.0 {
            break;
        }
    }
    best
}

fn random(room: &mut Room, width: usize, height: usize) -> Option<Camera> {
    let (dice, plan) = (&mut room.dice, &room.plan);
    // Degrees across the longer side.
    let fov = dice.real(50.0, 90.0).to_radians();
    let mut k = Intrinsics::from_fov(width, height, fov);
    if height > width {
        k.fx = Intrinsics::from_fov(height, width, fov).fx;
        k.fy = k.fx;
    }
    k.cx += dice.real(-0.03, 0.03) * width as f32;
    k.cy += dice.real(-0.03, 0.03) * height as f32;
    let (heights, pitches) = dice.pick(&CARRIERS);
    let [w, _, l] = plan.size;
    // Towards the walls more is seen.
    let edge = |v: f32| v.signum() * v.abs().sqrt();
    let at = [
        edge(dice.real(-0.97, 0.97)) * w,
        dice.real(heights[0], heights[1]),
        edge(dice.real(-0.97, 0.97)) * l,
    ];
    if !plan.free(at, 0.12) {
        return None;
    }
    // Most look at something.
    let target = match room.pieces.len().checked_sub(1).filter(|_| dice.chance(0.7)) {
        Some(last) => {
            let at = room.pieces[dice.int(0, last)].at;
            [at[0], at[2]]
        }
        None => [dice.real(-0.6, 0.6) * w, dice.real(-0.6, 0.6) * l],
    };
    let towards = (target[0] - at[0]).atan2(target[1] - at[2]);
    let yaw = towards + dice.real(-0.35, 0.35);
    let pitch = dice.real(pitches[0], pitches[1]);
    let roll = if dice.chance(0.85) { dice.real(-0.05, 0.05) } else { dice.real(-0.3, 0.3) };
    Some(Camera::new(k, at, yaw, pitch, roll))
}

/// 1 for a view of several things of which no plane fills the picture; less the worse it is.
fn worth(scene: &Scene, camera: &Camera, width: usize, height: usize) -> f32 {
    let mut planes: Vec<(V3, f32, usize)> = Vec::new();
    let mut seen: Vec<(u32, usize)> = Vec::new();
    let mut depths = Vec::new();
    let total = GRID[0] * GRID[1];
    for k in 0..total {
        let x = (k % GRID[0]) as f32 + 0.5;
        let y = (k / GRID[0]) as f32 + 0.5;
        let d = camera.ray(x * width as f32 / GRID[0] as f32, y * height as f32 / GRID[1] as f32);
        let Some(hit) = scene.nearest(camera.at, d, 1e-3, f32::INFINITY) else { continue };
        depths.push(hit.touch.t);
        let instance = &scene.instances[hit.instance as usize];
        let normal =
            unit(crate::scenes::space::to_world(&instance.axes, instance.mesh.plane(hit.touch.face)));
        let offset = dot(normal, super::mesh::along(camera.at, d, hit.touch.t));
        let same = |p: &&mut (V3, f32, usize)| dot(p.0, normal).abs() > 0.99 && (p.1 - offset).abs() < 0.03;
        match planes.iter_mut().find(same) {
            Some(plane) => plane.2 += 1,
            None => planes.push((normal, offset, 1)),
        }
        match seen.iter_mut().find(|(i, _)| *i == hit.instance) {
            Some(seen) => seen.1 += 1,
            None => seen.push((hit.instance, 1)),
        }
    }
    if depths.len() * 2 < total {
        return 0.0;
    }
    depths.sort_by(f32::total_cmp);
    let near = depths[depths.len() / 20];
    let middle = depths[depths.len() / 2];
    let largest = planes.iter().map(|p| p.2).max().unwrap_or(0) as f32 / total as f32;
    let things = seen.iter().filter(|(_, n)| *n >= 2).count();
    (near / 0.25).min(1.0)
        * (middle / 0.7).min(1.0)
        * ((1.0 - largest) / 0.55).min(1.0)
        * (things as f32 / 9.0).min(1.0)
}
