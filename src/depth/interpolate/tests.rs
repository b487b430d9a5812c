use super::*;
use crate::error::Error;
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

fn scattered(seed: u64, count: usize, width: usize, height: usize) -> SparseDepth {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let mut point =
        || (rng.random_range(0..width), rng.random_range(0..height), rng.random_range(0.5..9.0f32));
    let points: Vec<_> = (0..count).map(|_| point()).collect();
    SparseDepth::from_points(width, height, &points).unwrap()
}

/// Squared distance to the nearest measurement, and the depths found at that distance.
fn brute_force(sparse: &SparseDepth, x: usize, y: usize) -> Vec<f32> {
    let distance = |p: &(usize, usize, f32)| p.0.abs_diff(x).pow(2) + p.1.abs_diff(y).pow(2);
    let points: Vec<_> = sparse.points().collect();
    let best = points.iter().map(distance).min().unwrap();
    points.iter().filter(|p| distance(p) == best).map(|p| p.2).collect()
}

fn check_nearest(sparse: &SparseDepth, dense: &[f32]) {
    for y in 0..sparse.height() {
        for x in 0..sparse.width() {
            let (found, allowed) = (dense[y * sparse.width() + x], brute_force(sparse, x, y));
            assert!(allowed.contains(&found), "({x}, {y}): {found} is none of {allowed:?}");
        }
    }
}

#[test]
fn nearest_agrees_with_brute_force() {
    for (seed, count, (w, h)) in [
        (1, 1, (9, 7)),
        (2, 2, (40, 5)),
        (3, 30, (37, 41)),
        (4, 200, (50, 33)),
        (5, 3, (1, 60)),
        (6, 3, (60, 1)),
    ] {
        let sparse = scattered(seed, count, w, h);
        check_nearest(&sparse, &nearest(&sparse).unwrap());
        let far = distance(&sparse).unwrap();
        for (i, &found) in far.iter().enumerate() {
            let squared = |p: (usize, usize, f32)| p.0.abs_diff(i % w).pow(2) + p.1.abs_diff(i / w).pow(2);
            let expected = (sparse.points().map(squared).min().unwrap() as f64).sqrt() as f32;
            assert_eq!(found, expected, "pixel {i}");
        }
    }
}

#[test]
fn a_mesh_without_triangles_is_nearest() {
    let lines: [&[(usize, usize, f32)]; 5] = [
        &[(20, 10, 2.0)],
        &[(3, 4, 2.0), (20, 25, 3.0)],
        &[(3, 4, 2.0), (13, 4, 3.0), (22, 4, 4.0), (7, 4, 9.0)],
        &[(5, 3, 2.0), (5, 30, 3.0), (5, 11, 4.0)],
        &[(2, 2, 2.0), (20, 20, 5.0), (8, 8, 3.0), (11, 11, 4.0)],
    ];
    for points in lines {
        let sparse = SparseDepth::from_points(32, 31, points).unwrap();
        check_nearest(&sparse, &linear(&sparse).unwrap());
    }
}

#[test]
fn outside_the_hull_is_nearest() {
    let points = [(10, 10, 1.0), (20, 11, 2.0), (14, 22, 3.0), (17, 13, 4.0)];
    let sparse = SparseDepth::from_points(40, 40, &points).unwrap();
    let dense = linear(&sparse).unwrap();
    for (x, y) in [(0, 0), (39, 0), (39, 39), (0, 39), (30, 12), (15, 9), (14, 23)] {
        assert!(brute_force(&sparse, x, y).contains(&dense[y * 40 + x]), "({x}, {y})");
    }
}

#[test]
fn a_plane_is_reproduced_inside_the_hull() {
    let (w, h) = (64, 48);
    let plane = |x: f32, y: f32| 2.0 + 0.03 * x + 0.07 * y;
    let mut rng = ChaCha8Rng::seed_from_u64(7);
    let mut points = vec![(0.0, 0.0), (63.0, 0.0), (0.0, 47.0), (63.0, 47.0), (5.0, 5.0), (5.0, 5.0)];
    points.extend((0..60).map(|_| (rng.random_range(0.0..63.0f32), rng.random_range(0.0..47.0f32))));
    let values: Vec<f32> = points.iter().map(|&(x, y)| plane(x, y)).collect();
    let mesh = Interpolator::new(&points, w, h).unwrap();
    for (i, v) in mesh.raster(&values).into_iter().enumerate() {
        let expected = plane((i % w) as f32, (i / w) as f32);
        assert!((v - expected).abs() < 1e-5, "pixel {i}: {v} vs {expected}");
    }
    for _ in 0..500 {
        let (x, y) = (rng.random_range(0.0..63.0f32), rng.random_range(0.0..47.0f32));
        assert!((mesh.at(x, y, &values) - plane(x, y)).abs() < 1e-5, "({x}, {y})");
    }
}

#[test]
fn at_agrees_with_raster() {
    let sparse = scattered(11, 80, 50, 40);
    let points: Vec<_> = sparse.points().map(|(x, y, _)| (x as f32, y as f32)).collect();
    let values: Vec<_> = sparse.points().map(|p| p.2).collect();
    let mesh = Interpolator::new(&points, 50, 40).unwrap();
    let raster = mesh.raster(&values);
    for (i, &expected) in raster.iter().enumerate() {
        let found = mesh.at((i % 50) as f32, (i / 50) as f32, &values);
        // On a hull edge or at equal distances both are right, so only most pixels must agree exactly.
        assert!((found - expected).abs() < 1e-4, "pixel {i}: {found} vs {expected}");
    }
    assert!(mesh.at(-30.0, 90.5, &values).is_finite());
    assert!(mesh.at(f32::NAN, 1.0, &values).is_nan() && mesh.at(1.0, f32::INFINITY, &values).is_nan());
}

#[test]
fn weights_give_the_value() {
    let sparse = scattered(12, 60, 50, 40);
    let points: Vec<_> = sparse.points().map(|(x, y, _)| (x as f32, y as f32)).collect();
    let values: Vec<_> = sparse.points().map(|p| p.2).collect();
    let mesh = Interpolator::new(&points, 50, 40).unwrap();
    let raster = mesh.raster(&values);
    for (i, &expected) in raster.iter().enumerate() {
        let weights = mesh.weights_at(i % 50, i / 50);
        let sum: f32 = weights.iter().map(|w| w.1).sum();
        let found: f32 = weights.iter().map(|&(point, w)| w * values[point]).sum();
        assert!((sum - 1.0).abs() < 1e-5 && (found - expected).abs() < 1e-4, "pixel {i}: {weights:?}");
    }
}

#[test]
fn no_value_leaves_the_range_and_points_are_kept() {
    for (seed, count) in [(21, 5), (22, 100), (23, 1500), (24, 4000)] {
        let sparse = scattered(seed, count, 80, 60);
        let dense = linear(&sparse).unwrap();
        assert!(dense.iter().all(|d| (0.5..9.0).contains(d)));
        assert!(sparse.points().all(|(x, y, d)| dense[y * 80 + x].to_bits() == d.to_bits()));
    }
}

#[test]
fn leaving_out_points_without_holes_around_changes_nothing() {
    let (w, h) = (40, 30);
    // Not a plane, so that a different triangle would give a different value; no two triangulations tie inside a hole of
    // one pixel, whose value is a mean of its neighbours either way.
    let full: Vec<f32> = (0..w * h).map(|i| 2.0 + 0.01 * (i % w) as f32 + 0.02 * (i / w) as f32).collect();
    let mut holes = full.clone();
    for y in 8..20 {
        holes[y * w + 5..y * w + 25].fill(f32::NAN);
    }
    holes[3] = f32::NAN;
    let dense = linear(&SparseDepth::new(w, h, holes).unwrap()).unwrap();
    let all = linear(&SparseDepth::new(w, h, full.clone()).unwrap()).unwrap();
    assert_eq!(all, full);
    assert!(dense.iter().zip(&full).all(|(a, b)| (a - b).abs() < 1e-5));
}

#[test]
fn a_large_set_and_awkward_positions_are_covered() {
    let sparse = scattered(31, 20_000, 320, 240);
    assert!(linear(&sparse).unwrap().iter().all(|d| d.is_finite()));
    let ring: Vec<(f32, f32)> =
        (0..200).map(|i| i as f32 * 0.0314).map(|a| (50.0 + 40.0 * a.cos(), 50.0 + 40.0 * a.sin())).collect();
    let lattice: Vec<(f32, f32)> = (0..400).map(|i| ((i % 20 * 5) as f32, (i / 20 * 5) as f32)).collect();
    let far = vec![
        (-1e30, 5.0),
        (1e30, 5.0),
        (3.0, -1e30),
        (f32::MAX, f32::MAX),
        (1e-40, 0.0),
        (-0.0, 0.0),
        (0.0, -0.0),
    ];
    for points in [ring, lattice, far] {
        let values: Vec<f32> = (0..points.len()).map(|i| i as f32).collect();
        let raster = Interpolator::new(&points, 100, 100).unwrap().raster(&values);
        assert!(raster.iter().all(|v| (0.0..points.len() as f32).contains(v)));
    }
}

#[test]
fn the_first_of_equal_positions_counts() {
    let mesh = Interpolator::new(&[(1.0, 1.0), (1.0, 1.0), (3.0, 1.0)], 5, 3).unwrap();
    assert_eq!(mesh.raster(&[7.0, 8.0, 9.0])[6], 7.0);
    assert_eq!(mesh.at(1.0, 1.0, &[7.0, 8.0, 9.0]), 7.0);
}

#[test]
fn bad_input_is_refused() {
    let none = SparseDepth::new(4, 4, vec![0.0; 16]).unwrap();
    assert!(matches!(nearest(&none), Err(Error::NoMeasurement { .. })));
    assert!(matches!(linear(&none), Err(Error::NoMeasurement { .. })));
    assert!(matches!(Interpolator::new(&[], 4, 4), Err(Error::NoMeasurement { .. })));
    assert!(matches!(Interpolator::new(&[(f32::NAN, 0.0)], 4, 4), Err(Error::Argument { .. })));
    assert!(matches!(Interpolator::new(&[(0.0, 0.0)], 0, 4), Err(Error::ImageSize { .. })));
    let mesh = Interpolator::new(&[(0.0, 0.0), (3.0, 0.0), (0.0, 3.0)], 4, 4).unwrap();
    assert!(mesh.raster(&[1.0]).iter().any(|v| v.is_nan()), "missing values must not be invented");
}
