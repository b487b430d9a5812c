//! The Delaunay triangle that holds one position among a few points, without the whole mesh.
//!
//! When a site is taken out of a Delaunay mesh, only the hole that its triangles leave is meshed anew, and only between the
//! corners of that hole: the site's neighbours. So the triangle that then holds the site's position is the one that it has in the
//! Delaunay mesh of its neighbours alone, and any further sites may stand among them.

use super::cross;

/// Indices of the three points whose Delaunay triangle holds `position`, an edge or a corner of it included; `None` outside the
/// hull of the points and if they lie on one line. Where four or more lie on one circle, any of their triangles.
///
/// Lifted to the paraboloid z = x² + y², the Delaunay triangles are the faces of the lower hull (Brown, "Voronoi diagrams from convex
/// hulls", 1979). From any triangle around the position each point that is found inside its circle replaces one of its corners,
/// which lowers the face at the position: the simplex method in three unknowns.
pub(crate) fn holder(position: [f64; 2], points: &[[f64; 2]]) -> Option<[usize; 3]> {
    // Around the position numbers are small, so that those of pixels stay exact.
    let at = |i: usize| [points[i][0] - position[0], points[i][1] - position[1]];
    let mut held = around(points.len(), at)?;
    // No face comes twice but by rounding, which must not keep us here.
    for _ in 0..4 * points.len() {
        let [a, b, c] = held.map(at);
        // The one deepest inside: points along a line are then halved, not walked.
        let depth = |q: usize| in_circle(a, b, c, at(q));
        let others = (0..points.len()).filter(|q| !held.contains(q)).map(|q| (depth(q), q));
        let Some((depth, q)) = others.max_by(|a, b| a.0.total_cmp(&b.0)) else { break };
        if depth <= 0.0 {
            break;
        }
        let [i, j, k] = held;
        let smaller = [[q, j, k], [i, q, k], [i, j, q]];
        let Some(next) = smaller.into_iter().find(|t| holds(t.map(at))) else { break };
        held = next;
    }
    Some(held)
}

const ORIGIN: [f64; 2] = [0.0, 0.0];

/// Some counter-clockwise triangle of points that holds the origin.
fn around(count: usize, at: impl Fn(usize) -> [f64; 2]) -> Option<[usize; 3]> {
    let first = (0..count).min_by(|&a, &b| squared(at(a)).total_cmp(&squared(at(b))))?;
    let ahead = at(first);
    // Of the points on either side, those that lie farthest round from the first.
    let (mut left, mut right): (Option<usize>, Option<usize>) = (None, None);
    for i in 0..count {
        let p = at(i);
        let side = cross(ORIGIN, ahead, p);
        let opposite = ahead[0] * p[0] + ahead[1] * p[1] < 0.0;
        if (side > 0.0 || side == 0.0 && opposite) && left.is_none_or(|l| cross(ORIGIN, at(l), p) > 0.0) {
            left = Some(i);
        }
        if side < 0.0 && right.is_none_or(|r| cross(ORIGIN, at(r), p) < 0.0) {
            right = Some(i);
        }
    }
    let third = match (left, right) {
        (Some(l), Some(r)) => [first, l, r],
        // All on one side: the origin lies on the hull at best, between the first point and one opposite.
        (Some(l), None) => {
            let beyond = (0..count).find(|&i| cross(at(l), at(first), at(i)) > 0.0)?;
            [l, first, beyond]
        }
        (None, _) => return None,
    };
    holds(third.map(at)).then_some(third)
}

fn squared(p: [f64; 2]) -> f64 {
    p[0] * p[0] + p[1] * p[1]
}

/// Whether a counter-clockwise triangle holds the origin, its edges included. None without area does.
fn holds([a, b, c]: [[f64; 2]; 3]) -> bool {
    cross(a, b, c) > 0.0
        && cross(a, b, ORIGIN) >= 0.0
        && cross(b, c, ORIGIN) >= 0.0
        && cross(c, a, ORIGIN) >= 0.0
}

/// Above 0 if `d` lies inside the circle through `a`, `b`, `c`, which are counter-clockwise.
fn in_circle(a: [f64; 2], b: [f64; 2], c: [f64; 2], d: [f64; 2]) -> f64 {
    let from = |p: [f64; 2]| [p[0] - d[0], p[1] - d[1]];
    let (a, b, c) = (from(a), from(b), from(c));
    squared(a) * cross(ORIGIN, b, c) + squared(b) * cross(ORIGIN, c, a) + squared(c) * cross(ORIGIN, a, b)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn inside_outside_and_on_an_edge() {
        let square = [[0.0, 0.0], [4.0, 0.0], [4.0, 4.0], [0.0, 4.0]];
        assert!(holder([1.0, 1.0], &square).is_some());
        assert!(holder([5.0, 1.0], &square).is_none());
        for edge in [[2.0, 0.0], [3.0, 0.0], [0.0, 3.0], [4.0, 1.0], [2.0, 4.0]] {
            let found = holder(edge, &square).expect("on the hull");
            assert!(
                found.iter().filter(|&&i| square[i][0] == edge[0] || square[i][1] == edge[1]).count() >= 2
            );
        }
        assert!(holder([1.0, 1.0], &[]).is_none());
        assert!(holder([1.0, 0.0], &[[0.0, 0.0], [2.0, 0.0], [5.0, 0.0]]).is_none(), "one line");
    }

    #[test]
    fn of_all_triangles_around_the_one_with_the_empty_circle() {
        // Far corners, and a small triangle between them that is given last.
        let points = [[-50.0, -40.0], [60.0, -45.0], [3.0, 70.0], [-4.0, -3.0], [5.0, -2.0], [0.0, 6.0]];
        let mut found = holder([0.0, 0.0], &points).expect("inside");
        found.sort_unstable();
        assert_eq!(found, [3, 4, 5]);
    }
}
