use super::*;
use crate::depth::SparseDepth;
use image::{Rgb, RgbImage};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

fn answer(x: usize, y: usize, depth: f32) -> Answered {
    Answered { x, y, depth, confidence: 0.9, expected_error: 0.05 }
}

fn lattice(width: usize, height: usize, stride: usize, depth: impl Fn(usize, usize) -> f32) -> Vec<Answered> {
    let rows = (0..height).step_by(stride);
    rows.flat_map(|y| (0..width).step_by(stride).map(move |x| (x, y)))
        .map(|(x, y)| answer(x, y, depth(x, y)))
        .collect()
}

fn no_points(width: usize, height: usize) -> SparseDepth {
    SparseDepth::new(width, height, vec![f32::NAN; width * height]).unwrap()
}

fn fill(rgb: &RgbImage, asked: &[Answered], sparse: &SparseDepth) -> Result<Filled> {
    let input = FillInput { width: rgb.width() as usize, height: rgb.height() as usize, rgb, asked, sparse };
    EdgeAwareFill::default().fill(&input)
}

/// A tilted near square before a far wall, in two colours with noise.
fn scene(width: usize, height: usize) -> (RgbImage, impl Fn(usize, usize) -> f32) {
    let inside = move |x: usize, y: usize| {
        (width / 4 + 3..width * 3 / 4 + 2).contains(&(x + y / 7))
            && (height / 4 + 1..height * 3 / 4 + 2).contains(&y)
    };
    let mut rng = ChaCha8Rng::seed_from_u64(1);
    let rgb = RgbImage::from_fn(width as u32, height as u32, |x, y| {
        let base: [u8; 3] = if inside(x as usize, y as usize) { [180, 90, 60] } else { [60, 90, 150] };
        Rgb(base.map(|c| c + rng.random_range(0..12)))
    });
    (rgb, move |x, y| if inside(x, y) { 1.5 + 0.001 * y as f32 } else { 4.0 })
}

#[test]
fn answers_and_measurements_are_kept_bit_for_bit() {
    let (rgb, truth) = scene(61, 47);
    let asked = lattice(61, 47, 4, &truth);
    // One measurement on an asked pixel, one between, both unlike what the model says.
    let sparse = SparseDepth::from_points(61, 47, &[(8, 8, 3.333), (13, 21, 2.777)]).unwrap();
    let filled = fill(&rgb, &asked, &sparse).unwrap();
    for a in asked.iter().filter(|a| (a.x, a.y) != (8, 8)) {
        assert_eq!(filled.depth[a.y * 61 + a.x].to_bits(), a.depth.to_bits());
        assert_eq!(filled.confidence[a.y * 61 + a.x], 0.9);
    }
    for (x, y, depth) in sparse.points() {
        let pixel = y * 61 + x;
        assert_eq!(
            (filled.depth[pixel].to_bits(), filled.confidence[pixel], filled.expected_error[pixel]),
            (depth.to_bits(), 1.0, 0.0)
        );
    }
}

#[test]
fn every_pixel_is_filled_within_range_from_any_set() {
    let (rgb, truth) = scene(40, 30);
    let mut rng = ChaCha8Rng::seed_from_u64(3);
    let random: Vec<_> = (0..90)
        .map(|_| (rng.random_range(0..40), rng.random_range(0..30)))
        .map(|(x, y)| answer(x, y, truth(x, y)))
        .collect();
    let line: Vec<_> = (0..10).map(|i| answer(i * 3, 7, truth(i * 3, 7))).collect();
    let cases: [&[Answered]; 5] =
        [&random, &line, &[answer(3, 3, 2.0)], &random[..2], &lattice(40, 30, 1, &truth)];
    for asked in cases {
        let filled = fill(&rgb, asked, &no_points(40, 30)).unwrap();
        let (low, high) = asked.iter().fold((f32::MAX, 0.0f32), |(l, h), a| (l.min(a.depth), h.max(a.depth)));
        // Inverting twice may round by one unit in the last place.
        assert!(
            filled.depth.iter().all(|&d| d >= low * 0.999_999 && d <= high * 1.000_001),
            "{} answers",
            asked.len()
        );
        assert!(filled.confidence.iter().all(|c| (0.0..=1.0).contains(c)));
        assert!(filled.expected_error.iter().all(|e| e.is_finite() && *e >= 0.0));
    }
}

#[test]
fn no_pixel_flies_between_the_sides_of_an_edge() {
    for stride in [4, 8] {
        let (rgb, truth) = scene(160, 120);
        let filled = fill(&rgb, &lattice(160, 120, stride, &truth), &no_points(160, 120)).unwrap();
        let mut wrong = 0;
        for (i, &d) in filled.depth.iter().enumerate() {
            assert!(!(1.7..=3.9).contains(&d), "stride {stride}, pixel {i}: {d} is on neither side");
            wrong += usize::from((d - truth(i % 160, i / 160)).abs() > 0.1);
        }
        // The lattice alone cannot know where between two answers the edge lies; the colours do.
        assert!(wrong < 60, "stride {stride}: {wrong} pixels on the wrong side");
    }
}

#[test]
fn measurements_close_to_an_edge_do_not_hide_it() {
    let (rgb, truth) = scene(160, 120);
    for seed in 0..40 {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let places = (0..150).map(|_| (rng.random_range(0..160), rng.random_range(0..120)));
        let points: Vec<_> = places.map(|(x, y)| (x, y, truth(x, y))).collect();
        let sparse = SparseDepth::from_points(160, 120, &points).unwrap();
        let filled = fill(&rgb, &lattice(160, 120, 8, &truth), &sparse).unwrap();
        assert!(filled.depth.iter().all(|d| !(1.7..=3.9).contains(d)), "seed {seed}");
    }
}

#[test]
fn doubt_shows_at_an_edge_without_colour() {
    let grey = RgbImage::from_pixel(64, 32, Rgb([128; 3]));
    let step = |x: usize, _| if x < 30 { 1.0 } else { 3.0 };
    let filled = fill(&grey, &lattice(64, 32, 8, step), &no_points(64, 32)).unwrap();
    let (edge, flat) = (16 * 64 + 28, 16 * 64 + 50);
    assert!(filled.depth.iter().all(|&d| d == 1.0 || d == 3.0));
    assert!(filled.confidence[edge] < 0.7 * filled.confidence[flat]);
    assert!(filled.expected_error[edge] > 5.0 * filled.expected_error[flat]);
}

#[test]
fn a_plane_in_space_is_exact_however_steep() {
    let rgb = RgbImage::from_pixel(97, 81, Rgb([90; 3]));
    // A floor: depth = camera height x focal length / rows below the horizon, from 1.2 m to 20 m in one frame.
    let floor = |_: usize, y: usize| 100.0 / (y as f32 + 5.0);
    let filled = fill(&rgb, &lattice(97, 81, 8, floor), &no_points(97, 81)).unwrap();
    let worst = filled
        .depth
        .iter()
        .enumerate()
        .map(|(i, d)| (d / floor(i % 97, i / 97) - 1.0).abs())
        .fold(0.0, f32::max);
    assert!(worst < 1e-5, "relative error {worst}");
}

#[test]
fn unreadable_answers_are_filled_and_no_answer_fills_nothing() {
    let (rgb, _) = scene(20, 20);
    let filled =
        fill(&rgb, &[answer(2, 2, f32::NAN), answer(5, 5, -1.0), answer(9, 9, 2.5)], &no_points(20, 20))
            .unwrap();
    assert!(filled.depth.iter().all(|&d| d == 2.5));
    let filled = fill(&rgb, &[answer(2, 2, f32::NAN)], &no_points(20, 20)).unwrap();
    assert!(filled.depth.iter().all(|d| d.is_nan()) && filled.confidence.iter().all(|&c| c == 0.0));
    let sparse = SparseDepth::from_points(20, 20, &[(1, 1, 2.0)]).unwrap();
    assert!(fill(&rgb, &[], &sparse).unwrap().depth.iter().all(|&d| d == 2.0));
}

#[test]
fn bad_input_is_refused() {
    let (rgb, _) = scene(20, 10);
    let none = no_points(20, 10);
    for bad in [
        answer(20, 0, 1.0),
        answer(0, 10, 1.0),
        Answered { confidence: 1.5, ..answer(0, 0, 1.0) },
        Answered { confidence: f32::NAN, ..answer(0, 0, 1.0) },
        Answered { expected_error: -1.0, ..answer(0, 0, 1.0) },
    ] {
        assert!(matches!(fill(&rgb, &[bad], &none), Err(Error::Argument { name: "answer", .. })), "{bad:?}");
    }
    assert!(matches!(fill(&rgb, &[], &no_points(10, 20)), Err(Error::SizeMismatch { .. })));
    let input = FillInput { width: 20, height: 11, rgb: &rgb, asked: &[], sparse: &none };
    assert!(matches!(EdgeAwareFill::default().fill(&input), Err(Error::SizeMismatch { .. })));
    let fill = EdgeAwareFill { colour_sigma: 0.0, ..Default::default() };
    assert!(matches!(fill.fill(&FillInput { height: 10, ..input }), Err(Error::Argument { .. })));
}
