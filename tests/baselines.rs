//! The classical methods: against SciPy, and what must hold of them for any input.

use image::{Rgb, RgbImage};
use proptest::collection::vec;
use proptest::prelude::*;
use safetensors::SafeTensors;
use sdim::classical::Baseline;
use sdim::depth::sample_points;
use sdim::internals::scenes::procedural;
use sdim::metrics::errors;
use sdim::{Error, SparseDepth};

/// A tensor of the fixture: (width, height, values).
fn tensor(fixture: &SafeTensors, name: &str) -> (usize, usize, Vec<f32>) {
    let view = fixture.tensor(name).unwrap();
    let values = view.data().chunks_exact(4).map(|b| f32::from_le_bytes(b.try_into().unwrap())).collect();
    (view.shape()[1], view.shape()[0], values)
}

#[test]
fn nearest_and_linear_agree_with_scipy() {
    let bytes = include_bytes!("fixtures/scipy.safetensors");
    let fixture = SafeTensors::deserialize(bytes).unwrap();
    let (mut inside, mut outside) = (0, 0);
    for case in 0..10 {
        let (width, height, values) = tensor(&fixture, &format!("{case}.sparse"));
        let sparse = SparseDepth::new(width, height, values).unwrap();
        let rgb = RgbImage::new(width as u32, height as u32);
        let [nearest, linear] =
            [Baseline::Nearest, Baseline::Linear].map(|b| b.complete(&rgb, &sparse).unwrap());
        let (_, _, scipy_nearest) = tensor(&fixture, &format!("{case}.nearest"));
        let (_, _, scipy_linear) = tensor(&fixture, &format!("{case}.linear"));
        for i in 0..width * height {
            let place = format!("case {case}, pixel ({}, {})", i % width, i / width);
            let (n, l) = (scipy_nearest[i], scipy_linear[i]);
            assert!(n.is_nan() || n == nearest[i], "{place}: nearest {} instead of {n}", nearest[i]);
            if !l.is_nan() {
                assert!((l - linear[i]).abs() < 1e-5, "{place}: linear {} instead of {l}", linear[i]);
                inside += 1;
            } else if !n.is_nan() {
                // Outside the hull SciPy gives nothing, this crate the nearest measurement.
                assert_eq!(linear[i], n, "{place}: outside the hull");
                outside += 1;
            }
        }
    }
    assert!(inside > 2000 && outside > 1000, "{inside} and {outside} pixels compared");
}

#[test]
fn names_are_read_and_written() {
    for baseline in Baseline::ALL {
        assert_eq!(baseline.to_string().parse::<Baseline>().unwrap(), baseline);
    }
    match "cubic".parse::<Baseline>() {
        Err(Error::Argument { found, expected, .. }) => {
            assert!(found.contains("cubic") && expected.contains("ip-basic") && expected.contains("linear"));
        }
        other => panic!("{other:?}"),
    }
}

#[test]
fn bad_input_is_refused() {
    let none = SparseDepth::new(4, 3, vec![0.0; 12]).unwrap();
    let some = SparseDepth::from_points(4, 3, &[(1, 1, 2.0)]).unwrap();
    for baseline in Baseline::ALL {
        let (fits, other) = (RgbImage::new(4, 3), RgbImage::new(3, 4));
        assert!(matches!(baseline.complete(&fits, &none), Err(Error::NoMeasurement { .. })), "{baseline}");
        assert!(matches!(baseline.complete(&other, &some), Err(Error::SizeMismatch { .. })), "{baseline}");
    }
}

#[test]
fn every_method_beats_a_constant_on_a_scene() {
    let (w, h) = (160, 120);
    let mut sums = [0.0; 6];
    for seed in 2_000_100..2_000_106 {
        let frame = procedural(seed, w, h).unwrap();
        let sparse = sample_points(&frame.depth, w, h, 300, seed).unwrap();
        let score = |d: &[f32]| errors(d, &frame.depth, &sparse).unwrap().abs_rel;
        let mut known: Vec<f32> = sparse.points().map(|p| p.2).collect();
        known.sort_by(f32::total_cmp);
        sums[5] += score(&vec![known[known.len() / 2]; w * h]);
        for (sum, baseline) in sums.iter_mut().zip(Baseline::ALL) {
            *sum += score(&baseline.complete(&frame.rgb, &sparse).unwrap());
        }
    }
    println!("AbsRel sums: {sums:?}");
    for (sum, baseline) in sums.iter().zip(Baseline::ALL) {
        assert!(*sum < 0.5 * sums[5], "{baseline}: {sum} against {} of a constant", sums[5]);
    }
}

/// Frames of any shape with any measurements.
fn input() -> impl Strategy<Value = (RgbImage, SparseDepth)> {
    (1usize..40, 1usize..30).prop_flat_map(|(w, h)| {
        let point = (0..w, 0..h, 0.001f32..9000.0);
        (vec(point, 1..60), vec(any::<u8>(), w * h), 0u8..3).prop_map(move |(points, shades, kind)| {
            let sparse = SparseDepth::from_points(w, h, &points).unwrap();
            let rgb = RgbImage::from_fn(w as u32, h as u32, |x, y| match kind {
                0 => Rgb([shades[y as usize * w + x as usize]; 3]),
                1 => Rgb([128; 3]),
                _ => Rgb([if x % 2 == 0 { 0 } else { 255 }; 3]),
            });
            (rgb, sparse)
        })
    })
}

proptest! {
    #[test]
    fn every_pixel_gets_a_depth_within_the_measurements((rgb, sparse) in input()) {
        let depths = || sparse.points().map(|p| p.2);
        let (low, high) = (depths().fold(f32::MAX, f32::min), depths().fold(0.0, f32::max));
        for baseline in Baseline::ALL {
            let dense = baseline.complete(&rgb, &sparse).unwrap();
            prop_assert_eq!(dense.len(), sparse.as_slice().len());
            let slack = 1e-5 * high;
            prop_assert!(dense.iter().all(|d| (low - slack..=high + slack).contains(d)), "{baseline}");
            if baseline != Baseline::IpBasic {
                prop_assert!(sparse.points().all(|(x, y, d)| dense[y * sparse.width() + x] == d), "{baseline}");
            }
            prop_assert_eq!(baseline.complete(&rgb, &sparse).unwrap(), dense, "{} twice", baseline);
        }
    }

    #[test]
    fn one_measurement_is_a_constant(w in 1usize..50, h in 1usize..50, at in (0usize..50, 0usize..50), d in 0.01f32..9000.0) {
        let sparse = SparseDepth::from_points(w, h, &[(at.0 % w, at.1 % h, d)]).unwrap();
        let rgb = RgbImage::from_fn(w as u32, h as u32, |x, y| Rgb([(x * 7) as u8, (y * 5) as u8, 9]));
        for baseline in Baseline::ALL {
            let dense = baseline.complete(&rgb, &sparse).unwrap();
            prop_assert!(dense.iter().all(|v| (v - d).abs() <= 1e-5 * d), "{baseline}");
        }
    }

    #[test]
    fn depth_in_another_unit_gives_the_same_map((rgb, sparse) in input()) {
        let scaled: Vec<f32> = sparse.as_slice().iter().map(|d| d * 0.125).collect();
        let scaled = SparseDepth::new(sparse.width(), sparse.height(), scaled).unwrap();
        for baseline in Baseline::ALL {
            let (a, b) = (baseline.complete(&rgb, &sparse).unwrap(), baseline.complete(&rgb, &scaled).unwrap());
            let high = a.iter().fold(0f32, |m, v| m.max(*v));
            prop_assert!(a.iter().zip(&b).all(|(a, b)| (a * 0.125 - b).abs() <= 1e-4 * high), "{baseline}");
        }
    }
}
