//! A map as it looks from where the camera is now.

use super::picture::Blocks;
use crate::complete::{Prior, SAME_SURFACE};
use crate::depth::{Camera, DepthMap, Transform};

/// Of two depths that come to one pixel the nearer one counts, unless they are as alike as this: then the one that comes closer to the
/// pixel's centre.
const ALIKE: f32 = 1.02;
/// Expected error of a pixel at a depth edge, relative to its depth: its place is doubtful by a pixel.
const EDGE_ERROR: f32 = 0.5;
/// Added to the expected error in each frame, relative to the depth: poses and moving things.
const CREEP: f32 = 0.003;

/// How much of the past counts.
#[derive(Debug, Clone, Copy)]
pub(super) struct Ageing {
    /// Confidences are multiplied by this in each frame, and expected errors divided by it.
    pub(super) fade: f32,
}

impl Ageing {
    /// Half of the confidence is left after so many frames.
    pub(super) fn half_life(frames: f32) -> Self {
        Self { fade: (-frames.recip()).exp2() }
    }

    fn put(self, prior: &mut Prior, to: usize, map: &DepthMap, from: usize, depth: f32, at_edge: bool) {
        // No more than all of it, however short the half-life.
        let error = (map.expected_error()[from] / self.fade + CREEP * depth).min(depth);
        prior.depth[to] = depth;
        prior.confidence[to] = map.confidence()[from] * self.fade;
        prior.expected_error[to] = if at_edge { error.max(EDGE_ERROR * depth) } else { error };
    }
}

/// The same map, where the picture has not changed.
pub(super) fn stay(map: &DepthMap, before: &Blocks, now: &Blocks, ageing: Ageing, turn: usize) -> Prior {
    let (width, depth) = (map.width(), map.depth());
    let mut prior = Prior::unknown(depth.len(), turn);
    let changed = before.changed(now);
    for i in (0..depth.len()).filter(|&i| !depth[i].is_nan()) {
        if !changed[now.at(i % width, i / width)] {
            ageing.put(&mut prior, i, map, i, depth[i], slope(map, i % width, i / width).is_none());
        }
    }
    prior
}

/// The map, moved to another place of the camera: each pixel goes where it is seen now, and the nearest one is seen. `motion` takes points in the
/// axes of the camera before to those of the camera now. Where no pixel comes to lie, or one whose colour is another, nothing is known.
pub(super) fn moved(
    map: &DepthMap,
    (before, now): (&Blocks, &Blocks),
    (camera, motion): (&Camera, &Transform),
    ageing: Ageing,
    turn: usize,
) -> Prior {
    let (width, depth) = (map.width(), map.depth());
    let mut prior = Prior::unknown(depth.len(), turn);
    // Distance of what was seen last at a pixel from the pixel's centre.
    let mut aside = vec![f32::INFINITY; depth.len()];
    for i in (0..depth.len()).filter(|&i| !depth[i].is_nan()) {
        let (x, y) = (i % width, i / width);
        let Some(ray) = camera.ray(x as f32, y as f32) else { continue };
        let point = motion.apply(ray.map(|c| c * depth[i]));
        let Some((u, v)) = camera.project(point) else { continue };
        let (column, row) = (u.round(), v.round());
        if !(column >= 0.0 && row >= 0.0 && column < width as f32 && row < map.height() as f32) {
            continue;
        }
        let (dx, dy) = (column - u, row - v);
        let slope = slope(map, x, y);
        // The surface goes on from where the point is seen to the pixel's centre; inverse depth is linear on planes.
        let inverse = point[2].recip() + slope.map_or(0.0, |[a, b]| a * dx + b * dy);
        let here = inverse.recip();
        if !(here > point[2] / SAME_SURFACE && here < point[2] * SAME_SURFACE) {
            continue;
        }
        let to = row as usize * width + column as usize;
        let distance = dx * dx + dy * dy;
        let held = prior.depth[to];
        let behind = here > held * ALIKE || (here * ALIKE >= held && distance >= aside[to]);
        if !held.is_nan() && behind {
            continue;
        }
        if !now.allows(before.colour(x, y), column as usize, row as usize) {
            continue;
        }
        aside[to] = distance;
        ageing.put(&mut prior, to, map, i, here, slope.is_none());
    }
    prior
}

/// Change of the inverse depth per column and per row; `None` at a depth edge.
fn slope(map: &DepthMap, x: usize, y: usize) -> Option<[f32; 2]> {
    let (width, height, depth) = (map.width(), map.height(), map.depth());
    let own = depth[y * width + x];
    let side = |u: usize, v: usize, inside: bool| -> Option<Option<f32>> {
        if !inside {
            return Some(None);
        }
        let other = depth[v * width + u];
        if other.is_nan() {
            return Some(None);
        }
        let same = own.max(other) <= SAME_SURFACE * own.min(other);
        same.then(|| Some(other.recip() - own.recip()))
    };
    let left = side(x.wrapping_sub(1), y, x > 0)?.map(|s| -s);
    let right = side(x + 1, y, x + 1 < width)?;
    let above = side(x, y.wrapping_sub(1), y > 0)?.map(|s| -s);
    let below = side(x, y + 1, y + 1 < height)?;
    // The smaller of both, so that a crease is not bent over.
    let least = |a: Option<f32>, b: Option<f32>| match (a, b) {
        (Some(a), Some(b)) if a * b <= 0.0 => 0.0,
        (Some(a), Some(b)) => {
            if a.abs() < b.abs() {
                a
            } else {
                b
            }
        }
        (one, other) => one.or(other).unwrap_or(0.0),
    };
    Some([least(left, right), least(above, below)])
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::depth::{Distortion, Intrinsics};
    use crate::stream::picture::BLOCK;
    use image::RgbImage;

    const SIZE: (usize, usize) = (64, 48);
    /// How far a change reaches at most, pixels.
    const REACH: usize = 2 * BLOCK;

    fn camera() -> Camera {
        let k = Intrinsics { fx: 60.0, fy: 60.0, cx: 31.5, cy: 23.5 };
        Camera::new(SIZE.0, SIZE.1, k, Distortion::None).unwrap()
    }

    fn map(depth: impl Fn(usize, usize) -> f32) -> DepthMap {
        let depth: Vec<f32> = (0..SIZE.0 * SIZE.1).map(|i| depth(i % SIZE.0, i / SIZE.0)).collect();
        let n = depth.len();
        let error = depth.iter().map(|d| 0.02 * d).collect();
        DepthMap::new(SIZE.0, SIZE.1, depth, vec![0.8; n], error, vec![false; n]).unwrap()
    }

    fn grey() -> Blocks {
        Blocks::new(&RgbImage::from_pixel(SIZE.0 as u32, SIZE.1 as u32, image::Rgb([90; 3])))
    }

    fn shifted(x: f64, z: f64) -> Transform {
        Transform::from_quaternion([0.0, 0.0, 0.0, 1.0], [x, 0.0, z]).unwrap()
    }

    /// A plane that comes nearer to the right: 1/z = a + b x.
    fn plane(x: f32) -> f32 {
        (0.25 + 0.004 * x).recip()
    }

    #[test]
    fn a_plane_stays_where_it_is_however_often_it_is_moved() {
        let (camera, blocks, ageing) = (camera(), grey(), Ageing::half_life(8.0));
        let step = shifted(0.013, 0.004);
        let mut now = map(|x, _| plane(x as f32));
        for turn in 0..20 {
            let prior = moved(&now, (&blocks, &blocks), (&camera, &step), ageing, turn);
            now = DepthMap::new(
                SIZE.0,
                SIZE.1,
                prior.depth.clone(),
                prior.confidence,
                prior.expected_error,
                vec![false; SIZE.0 * SIZE.1],
            )
            .unwrap();
        }
        let whole = shifted(20.0 * 0.013, 20.0 * 0.004);
        let mut seen = 0;
        for i in 0..SIZE.0 * SIZE.1 {
            let (x, y) = (i % SIZE.0, i / SIZE.0);
            let d = now.depth()[i];
            if d.is_nan() {
                continue;
            }
            // Back to where it came from: there the plane must be.
            let p = whole.inverse().apply(camera.ray(x as f32, y as f32).unwrap().map(|c| c * d));
            let (u, _) = camera.project(p).unwrap();
            assert!((p[2] / plane(u) - 1.0).abs() < 0.01, "({x}, {y}): {} is not {}", p[2], plane(u));
            seen += 1;
        }
        assert!(seen * 4 > SIZE.0 * SIZE.1 * 3, "{seen}");
    }

    #[test]
    fn near_things_hide_far_ones_and_leave_a_hole_where_they_were() {
        let box_ =
            |x: usize, y: usize| if (20..40).contains(&x) && (10..30).contains(&y) { 1.0 } else { 4.0 };
        let blocks = grey();
        // The camera goes to the right by 0.1 m: the box by 6 pixels to the left, the wall by 1.5.
        let (camera, motion) = (camera(), shifted(-0.1, 0.0));
        let prior = moved(&map(box_), (&blocks, &blocks), (&camera, &motion), Ageing::half_life(8.0), 1);
        let at = |x: usize, y: usize| prior.depth[y * SIZE.0 + x];
        for y in 12..28 {
            assert!((16..32).all(|x| (at(x, y) - 1.0).abs() < 1e-3), "row {y}: the box, six pixels on");
            assert!((35..38).all(|x| at(x, y).is_nan()), "row {y}: nobody has seen what was behind it");
            assert!((at(10, y) - 4.0).abs() < 1e-3 && (at(45, y) - 4.0).abs() < 1e-3);
        }
        assert!(prior.depth.iter().all(|d| d.is_nan() || (d - 1.0).abs() < 1e-3 || (d - 4.0).abs() < 1e-3));
        let edge = 15 * SIZE.0 + 14;
        assert!(prior.expected_error[edge] >= 0.5 * prior.depth[edge], "edges are doubtful");
    }

    #[test]
    fn the_past_fades() {
        let (camera, blocks) = (camera(), grey());
        let still = map(|_, _| 2.0);
        for prior in [
            stay(&still, &blocks, &blocks, Ageing::half_life(1.0), 1),
            moved(&still, (&blocks, &blocks), (&camera, &Transform::identity()), Ageing::half_life(1.0), 1),
        ] {
            let middle = 24 * SIZE.0 + 32;
            assert!((prior.depth[middle] - 2.0).abs() < 1e-4);
            assert_eq!(prior.confidence[middle], 0.4);
            assert!((prior.expected_error[middle] - (0.08 + 2.0 * CREEP)).abs() < 1e-5);
        }
    }

    #[test]
    fn what_changed_in_the_picture_is_not_known() {
        let still = map(|_, _| 2.0);
        let mut rgb = RgbImage::from_pixel(SIZE.0 as u32, SIZE.1 as u32, image::Rgb([90; 3]));
        let before = Blocks::new(&rgb);
        for (x, y) in (24..44).flat_map(|x| (14..34).map(move |y| (x, y))) {
            rgb.put_pixel(x, y, image::Rgb([200, 40, 40]));
        }
        let now = Blocks::new(&rgb);
        let ageing = Ageing::half_life(8.0);
        let stayed = stay(&still, &before, &now, ageing, 1);
        let seen = moved(&still, (&before, &now), (&camera(), &Transform::identity()), ageing, 1);
        for i in 0..SIZE.0 * SIZE.1 {
            let (x, y) = (i % SIZE.0, i / SIZE.0);
            let beside = |at: usize, from: usize, to: usize| at + REACH < from || at >= to + REACH;
            if (24..44).contains(&x) && (14..34).contains(&y) {
                assert!(stayed.depth[i].is_nan(), "({x}, {y})");
            } else if beside(x, 24, 44) || beside(y, 14, 34) {
                assert!(!stayed.depth[i].is_nan() && !seen.depth[i].is_nan(), "({x}, {y})");
            }
        }
        assert!(seen.depth[24 * SIZE.0 + 34].is_nan());
    }
}
