use super::*;
use image::Rgb;
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

const SIZE: (usize, usize) = (160, 120);

fn grey() -> RgbImage {
    RgbImage::from_pixel(SIZE.0 as u32, SIZE.1 as u32, Rgb([120; 3]))
}

/// Measurements of `depth` at distinct random pixels, with 1 % noise.
fn scattered(count: usize, depth: impl Fn(usize, usize) -> f32) -> SparseDepth {
    let mut rng = ChaCha8Rng::seed_from_u64(count as u64);
    let mut all = vec![f32::NAN; SIZE.0 * SIZE.1];
    for pixel in rand::seq::index::sample(&mut rng, all.len(), count) {
        all[pixel] = depth(pixel % SIZE.0, pixel / SIZE.0) * rng.random_range(0.99..1.01);
    }
    SparseDepth::new(SIZE.0, SIZE.1, all).unwrap()
}

/// The same with others in place of some measurements, chosen by their number.
fn changed(sparse: &SparseDepth, step: usize, to: impl Fn(f32) -> f32) -> (SparseDepth, Vec<usize>) {
    let mut depth = sparse.as_slice().to_vec();
    let measured: Vec<usize> = (0..depth.len()).filter(|&i| !depth[i].is_nan()).collect();
    let some: Vec<usize> = measured.into_iter().skip(step / 2).step_by(step).collect();
    some.iter().for_each(|&i| depth[i] = to(depth[i]));
    (SparseDepth::new(SIZE.0, SIZE.1, depth).unwrap(), some)
}

fn pixels(found: &[Outlier]) -> Vec<usize> {
    found.iter().map(|o| o.y * SIZE.0 + o.x).collect()
}

fn floor(_: usize, y: usize) -> f32 {
    120.0 / (y as f32 + 20.0)
}

fn step(x: usize, _: usize) -> f32 {
    if (50..110).contains(&x) { 1.2 } else { 4.0 }
}

#[test]
fn surfaces_and_steps_are_plausible() {
    for count in [100, 500, 3000, SIZE.0 * SIZE.1] {
        for depth in [floor, step] {
            assert_eq!(find(&grey(), &scattered(count, depth)).unwrap(), []);
        }
    }
}

#[test]
fn lone_wrong_values_are_found_and_nothing_else() {
    for count in [500, 3000, SIZE.0 * SIZE.1] {
        for factor in [0.4, 1.8, 9.0] {
            let (wrong, some) = changed(&scattered(count, floor), 37, |d| d * factor);
            let found = find(&grey(), &wrong).unwrap();
            let right = pixels(&found).iter().filter(|p| some.contains(p)).count();
            assert_eq!(right, found.len(), "{count}, {factor}: a right one was flagged");
            assert!(right * 10 >= some.len() * 8, "{count}, {factor}: {right} of {}", some.len());
            for o in found {
                let (truth, measured) = (floor(o.x, o.y), wrong.get(o.x, o.y).unwrap());
                assert!((o.expected / truth - 1.0).abs() < 0.2 && o.measured == measured, "{o:?}");
            }
        }
    }
}

#[test]
fn a_thing_of_another_colour_is_plausible() {
    let mut depth = scattered(500, |_, _| 3.0).as_slice().to_vec();
    for dy in 0..9 {
        depth[(56 + dy) * SIZE.0 + 75..][..9].fill(f32::NAN);
    }
    depth[60 * SIZE.0 + 79] = 2.3;
    let sparse = SparseDepth::new(SIZE.0, SIZE.1, depth).unwrap();
    let mut rgb = grey();
    assert_eq!(pixels(&find(&rgb, &sparse).unwrap()), [60 * SIZE.0 + 79]);
    for (dx, dy) in (0..25).map(|i| (i % 5, i / 5)) {
        rgb.put_pixel(77 + dx, 58 + dy, Rgb([200, 40, 40]));
    }
    assert_eq!(find(&rgb, &sparse).unwrap(), []);
}

#[test]
fn wrong_values_side_by_side_are_found_by_their_distance_from_all_others() {
    let mut depth = scattered(SIZE.0 * SIZE.1, floor).as_slice().to_vec();
    // A saturated patch, and left-overs along the border.
    let patch: Vec<usize> = (0..400).map(|i| (30 + i / 20) * SIZE.0 + 40 + i % 20).collect();
    let border: Vec<usize> = (0..SIZE.1).map(|y| y * SIZE.0).collect();
    patch.iter().for_each(|&i| depth[i] = 65.535);
    border.iter().for_each(|&i| depth[i] = 0.0001 + 1e-6 * (i % 7) as f32);
    let sparse = SparseDepth::new(SIZE.0, SIZE.1, depth).unwrap();
    let mut all = [patch, border].concat();
    all.sort_unstable();
    assert_eq!(pixels(&find(&grey(), &sparse).unwrap()), all);
    // A far wall behind a door is neither: its values differ, and it is as far as scenes go.
    let door = |x: usize, y: usize| if (30..50).contains(&x) && y > 40 { 45.0 } else { floor(x, y) };
    assert_eq!(find(&grey(), &scattered(3000, door)).unwrap(), []);
}

#[test]
fn measurements_that_never_agree_do_not_judge_each_other() {
    let noise = |x: usize, y: usize| 1.0 + ((y * SIZE.0 + x) * 7919 % 101) as f32 * 0.08;
    for count in [100, 500, 3000] {
        let found = find(&grey(), &scattered(count, noise)).unwrap().len();
        assert!(found * 50 <= count, "{found} of {count}");
    }
}

#[test]
fn few_points_one_line_and_wrong_sizes() {
    let line = |count: usize| {
        let points: Vec<_> = (0..count).map(|i| (3 * i, 7, if i == 4 { 9.0 } else { 2.0 })).collect();
        SparseDepth::from_points(SIZE.0, SIZE.1, &points).unwrap()
    };
    assert_eq!(find(&grey(), &line(11)).unwrap(), []);
    assert_eq!(pixels(&find(&grey(), &line(40)).unwrap()), [7 * SIZE.0 + 12]);
    let none = SparseDepth::new(SIZE.0, SIZE.1, vec![0.0; SIZE.0 * SIZE.1]).unwrap();
    assert_eq!(find(&grey(), &none).unwrap(), []);
    assert!(matches!(find(&RgbImage::new(9, 9), &line(20)), Err(Error::SizeMismatch { .. })));
}
