//! Which pixels of a training frame are asked.

use crate::depth::SparseDepth;
use crate::scenes::RgbdFrame;
use rand::Rng;
use rand_chacha::ChaCha8Rng;

/// Pixels to ask with their true depths, metres.
pub(super) type Asked = Vec<(usize, usize, f32)>;

/// Pixels to ask and their true depths, `count` of them, a share of them near depth edges. Pixels that were measured are
/// asked less the more of them there are: a dense map is asked where it has holes.
pub(super) fn questions(
    frame: &RgbdFrame,
    held_back: Option<&SparseDepth>,
    (count, edges): (usize, f32),
    prompted: Option<&SparseDepth>,
    rng: &mut ChaCha8Rng,
) -> Asked {
    let width = frame.rgb.width() as usize;
    let ask = |i: usize| (i % width, i / width, frame.depth[i]);
    let known: Vec<usize> = match held_back {
        Some(sparse) => return drawn(&sparse.points().collect::<Vec<_>>(), count, rng),
        None => (0..frame.depth.len()).filter(|&i| frame.depth[i].is_finite()).collect(),
    };
    if known.is_empty() {
        return Vec::new();
    }
    let near = if edges > 0.0 { near_edges(&frame.depth, width) } else { Vec::new() };
    let one = |rng: &mut ChaCha8Rng| {
        let at_edge = edges > 0.0 && rng.random::<f32>() < edges && !near.is_empty();
        let from = if at_edge { &near } else { &known };
        from[rng.random_range(0..from.len())]
    };
    (0..count)
        .map(|_| {
            let mut i = one(rng);
            for _ in 0..16 {
                let measured = prompted.is_some_and(|p| !p.as_slice()[i].is_nan());
                if !measured || rng.random_bool(0.1) {
                    break;
                }
                i = one(rng);
            }
            ask(i)
        })
        .collect()
}

fn drawn(from: &[(usize, usize, f32)], count: usize, rng: &mut ChaCha8Rng) -> Vec<(usize, usize, f32)> {
    if from.is_empty() {
        Vec::new()
    } else {
        (0..count).map(|_| from[rng.random_range(0..from.len())]).collect()
    }
}

/// Neighbours whose depths differ by a larger ratio than this stand at an edge.
const EDGE_RATIO: f32 = 1.05;

/// Known pixels at depth edges and the known pixels beside those, to both sides of an edge.
fn near_edges(depth: &[f32], width: usize) -> Vec<usize> {
    let mut edge = vec![false; depth.len()];
    let mut mark = |i: usize, k: usize| {
        let (a, b) = (depth[i], depth[k]);
        // NaN is no edge to NaN, but one to anything else.
        let apart = match (a.is_finite(), b.is_finite()) {
            (true, true) => a.max(b) > EDGE_RATIO * a.min(b),
            (a, b) => a != b,
        };
        if apart {
            (edge[i], edge[k]) = (true, true);
        }
    };
    for i in 0..depth.len() {
        if (i + 1) % width != 0 {
            mark(i, i + 1);
        }
        if i + width < depth.len() {
            mark(i, i + width);
        }
    }
    let beside = |i: usize| {
        let x = i % width;
        edge[i]
            || (x > 0 && edge[i - 1])
            || (x + 1 < width && edge[i + 1])
            || (i >= width && edge[i - width])
            || edge.get(i + width).is_some_and(|&e| e)
    };
    (0..depth.len()).filter(|&i| depth[i].is_finite() && beside(i)).collect()
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use crate::scenes::procedural;
    use rand_chacha::rand_core::SeedableRng;

    /// A wall at 3 m with a post at 1 m before it and sky above.
    pub fn post() -> RgbdFrame {
        let mut frame = procedural(3, 64, 48).unwrap();
        for (i, d) in frame.depth.iter_mut().enumerate() {
            let (x, y) = (i % 64, i / 64);
            *d = if y < 4 {
                f32::NAN
            } else if (30..34).contains(&x) {
                1.0
            } else {
                3.0
            };
        }
        frame
    }

    #[test]
    fn edges_are_asked_more_and_the_sky_never() {
        let (frame, mut rng) = (post(), ChaCha8Rng::seed_from_u64(1));
        let near = |edges: f32, rng: &mut ChaCha8Rng| {
            let asked = questions(&frame, None, (4000, edges), None, rng);
            assert!(asked.iter().all(|&(x, y, d)| y >= 4 && d == frame.depth[y * 64 + x]));
            // Two pixels to each side of an edge, or below the sky.
            asked.iter().filter(|&&(x, y, _)| (28..36).contains(&x) || y < 6).count() as f32 / 4000.0
        };
        let (with, without) = (near(0.3, &mut rng), near(0.0, &mut rng));
        assert!(
            (without - 0.16).abs() < 0.03 && (with - (0.3 + 0.7 * 0.16)).abs() < 0.03,
            "{with} {without}"
        );
    }

    #[test]
    fn dense_maps_are_asked_in_their_holes() {
        let (frame, mut rng) = (post(), ChaCha8Rng::seed_from_u64(2));
        let mut measured = frame.depth.clone();
        for (i, d) in measured.iter_mut().enumerate() {
            if (10..20).contains(&(i % 64)) {
                *d = f32::NAN;
            }
        }
        let sparse = SparseDepth::new(64, 48, measured).unwrap();
        let asked = questions(&frame, None, (500, 0.0), Some(&sparse), &mut rng);
        let inside = asked.iter().filter(|p| (10..20).contains(&p.0)).count();
        assert!(inside > 250, "{inside}");
    }
}
