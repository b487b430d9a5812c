use super::*;
use crate::depth::SparseDepth;
use image::RgbImage;

const SIZE: (usize, usize) = (64, 48);

fn lattice(stride: usize, depth: impl Fn(usize, usize) -> f32) -> Vec<Answered> {
    let place = |i: usize| (i % (SIZE.0 / stride) * stride, i / (SIZE.0 / stride) * stride);
    let one =
        |(x, y)| Answered { x, y, depth: depth(x, y), confidence: 0.9, expected_error: 0.025 * depth(x, y) };
    (0..(SIZE.0 / stride) * (SIZE.1 / stride)).map(place).map(one).collect()
}

fn apply(
    filter: MedianFilter,
    asked: &[Answered],
    points: &[(usize, usize, f32)],
    spacing: usize,
) -> Vec<Answered> {
    let rgb = RgbImage::new(SIZE.0 as u32, SIZE.1 as u32);
    let sparse = SparseDepth::from_points(SIZE.0, SIZE.1, points).unwrap();
    let input = FillInput { width: SIZE.0, height: SIZE.1, rgb: &rgb, asked, sparse: &sparse };
    filter.apply(&input, &[], at(spacing)).unwrap()
}

/// Pixels asked so far apart, in a frame that the model saw so that the window is 1.5 times as wide.
fn at(spacing: usize) -> Sampling {
    Sampling { spacing, pixel: 1.5 * spacing.max(3) as f32 / 1.7 }
}

fn filtered(asked: &[Answered], spacing: usize) -> Vec<Answered> {
    apply(MedianFilter::default(), asked, &[], spacing)
}

#[test]
fn a_lone_answer_goes_and_its_neighbours_stay() {
    for stride in [1, 2, 4, 8] {
        let mut asked = lattice(stride, |_, _| 2.0);
        let middle = asked.iter().position(|a| (a.x, a.y) == (32, 24)).unwrap();
        asked[middle].depth = 5.0;
        assert!(filtered(&asked, stride).iter().all(|a| a.depth == 2.0), "stride {stride}");
    }
}

#[test]
fn steps_stay_where_they_are() {
    let step = |x: usize, _: usize| if x < 32 { 1.5 } else { 4.0 };
    for stride in [1, 2, 4] {
        let asked = lattice(stride, step);
        for (a, b) in asked.iter().zip(filtered(&asked, stride)) {
            assert_eq!(a.depth, b.depth, "({}, {})", a.x, a.y);
        }
    }
}

#[test]
fn a_slanted_plane_is_not_bent_at_the_border() {
    // A floor: inverse depth is linear in the row. What the curve of depth itself does to a median is far below the noise of answers.
    let floor = |x: usize, y: usize| 1.0 / (0.2 + 0.004 * y as f32 + 0.001 * x as f32);
    let asked = lattice(4, floor);
    for (a, b) in asked.iter().zip(filtered(&asked, 4)) {
        assert!(
            (b.depth / a.depth - 1.0).abs() < 0.006,
            "({}, {}): {} became {}",
            a.x,
            a.y,
            a.depth,
            b.depth
        );
    }
}

#[test]
fn sure_answers_and_measurements_outweigh_unsure_ones() {
    let mut asked = lattice(4, |_, _| 3.0);
    let middle = asked.iter().position(|a| (a.x, a.y) == (32, 24)).unwrap();
    asked[middle].depth = 2.0;
    for a in &mut asked {
        a.expected_error = if a.depth == 2.0 { 0.001 } else { 2.0 };
    }
    // Alone it is still outvoted; with measurements beside it that say the same, it is not.
    let points: Vec<_> =
        [(31, 24), (33, 24), (32, 23), (32, 25), (30, 26), (34, 22)].map(|(x, y)| (x, y, 2.0)).to_vec();
    assert_eq!(apply(MedianFilter::default(), &asked, &points, 4)[middle].depth, 2.0);
    for a in &mut asked {
        a.expected_error = 0.05;
    }
    assert_eq!(apply(MedianFilter::default(), &asked, &[], 4)[middle].depth, 3.0);
}

#[test]
fn the_interpolation_has_the_say_that_it_is_given() {
    let mut asked = lattice(4, |x, _| if x % 8 == 0 { 2.0 } else { 3.0 });
    asked.iter_mut().for_each(|a| a.expected_error = 0.1 * a.depth);
    let rgb = RgbImage::new(SIZE.0 as u32, SIZE.1 as u32);
    let sparse = SparseDepth::from_points(SIZE.0, SIZE.1, &[]).unwrap();
    let input = FillInput { width: SIZE.0, height: SIZE.1, rgb: &rgb, asked: &asked, sparse: &sparse };
    let with = |share: f32, depth: f32| {
        let filter = MedianFilter { interpolated: share, ..Default::default() };
        let out = filter.apply(&input, &vec![depth; SIZE.0 * SIZE.1], at(4)).unwrap();
        out.iter().find(|a| (a.x, a.y) == (32, 24)).unwrap().depth
    };
    // Columns of 2 m and of 3 m have about the same weight, so a little more decides.
    assert_eq!((with(0.2, 1.0), with(0.2, 9.0)), (2.0, 3.0));
    assert_eq!(with(5.0, 2.5), 2.5);
    assert_eq!(with(0.0, 9.0), with(0.0, 1.0));
}

#[test]
fn the_order_of_answers_says_nothing() {
    let mut asked = lattice(1, |x, y| 2.0 + ((x * 7 + y * 13) % 11) as f32 * 0.1);
    let forwards = filtered(&asked, 1);
    asked.reverse();
    let mut backwards = filtered(&asked, 1);
    backwards.reverse();
    for (a, b) in forwards.iter().zip(&backwards) {
        assert_eq!(a.depth, b.depth, "({}, {})", a.x, a.y);
    }
}

#[test]
fn neighbours_that_disagree_cost_confidence() {
    let calm = filtered(&lattice(4, |_, _| 2.0), 4);
    let torn = filtered(&lattice(4, |x, y| if (x + y) / 4 % 2 == 0 { 2.0 } else { 3.0 }), 4);
    for (a, b) in calm.iter().zip(&torn) {
        assert!((a.confidence - 0.9).abs() < 1e-5 && a.expected_error < 0.05, "{a:?}");
        if (8..SIZE.0 - 8).contains(&b.x) && (8..SIZE.1 - 8).contains(&b.y) {
            assert!(b.confidence < 0.7 && b.expected_error > 0.1, "{b:?}");
        }
    }
}

#[test]
fn unreadable_answers_and_measured_pixels_stay_and_bad_input_is_an_error() {
    let mut asked = lattice(4, |_, _| 2.0);
    asked[40].depth = f32::NAN;
    asked[50].depth = 7.0;
    let out = apply(MedianFilter::default(), &asked, &[(asked[50].x, asked[50].y, 7.5)], 4);
    assert!(out[40].depth.is_nan() && out[50] == asked[50]);
    let rgb = RgbImage::new(SIZE.0 as u32, SIZE.1 as u32);
    let sparse = SparseDepth::from_points(SIZE.0, SIZE.1, &[]).unwrap();
    asked[3].x = SIZE.0;
    let input = FillInput { width: SIZE.0, height: SIZE.1, rgb: &rgb, asked: &asked, sparse: &sparse };
    let filter = MedianFilter::default();
    assert!(matches!(filter.apply(&input, &[], at(4)), Err(Error::Argument { .. })));
    let input = FillInput { asked: &[], ..input };
    assert!(matches!(filter.apply(&input, &[1.0; 3], at(4)), Err(Error::BufferLength { .. })));
    for bad in [f32::NAN, f32::INFINITY, 0.0, -1.0] {
        assert!(MedianFilter { sigma: bad, ..filter }.apply(&input, &[], at(4)).is_err());
        assert!(MedianFilter { doubt: bad, ..filter }.apply(&input, &[], at(4)).is_err());
        assert!(filter.apply(&input, &[], Sampling { pixel: bad, ..at(4) }).is_err());
    }
    assert!(filter.apply(&input, &[], at(0)).is_ok_and(|out| out.is_empty()));
}

/// Read in a frame that the model saw as it is: windows are far narrower than answers lie apart.
fn joined(asked: &[Answered], points: &[(usize, usize, f32)], spacing: usize) -> Vec<Answered> {
    let rgb = RgbImage::new(SIZE.0 as u32, SIZE.1 as u32);
    let sparse = SparseDepth::from_points(SIZE.0, SIZE.1, points).unwrap();
    let input = FillInput { width: SIZE.0, height: SIZE.1, rgb: &rgb, asked, sparse: &sparse };
    MedianFilter::default().apply(&input, &[], Sampling { spacing, pixel: 1.0 }).unwrap()
}

#[test]
fn answers_far_apart_are_read_with_those_around_them() {
    let mut asked = lattice(8, |_, _| 2.0);
    let middle = asked.iter().position(|a| (a.x, a.y) == (32, 24)).unwrap();
    asked[middle].depth = 2.1;
    assert!(joined(&asked, &[], 8).iter().all(|a| a.depth == 2.0), "what is a little off is mended");
    asked[middle].depth = 1.5;
    assert_eq!(joined(&asked, &[], 8)[middle].depth, 1.5, "thin things stay");
    let step = |x: usize, _: usize| if x < 30 { 1.5 } else { 4.0 };
    let asked = lattice(8, step);
    for (a, b) in asked.iter().zip(joined(&asked, &[(29, 20, 1.5), (31, 20, 4.0)], 8)) {
        assert_eq!((a.x, a.y, a.depth), (b.x, b.y, b.depth), "steps stay");
    }
    let floor = |x: usize, y: usize| 1.0 / (0.2 + 0.004 * y as f32 + 0.001 * x as f32);
    let asked = lattice(8, floor);
    for (a, b) in asked.iter().zip(joined(&asked, &[], 8)) {
        assert!((a.depth / b.depth).ln().abs() < 0.01, "({}, {}): {} became {}", a.x, a.y, a.depth, b.depth);
    }
    let unreadable = Answered { depth: f32::NAN, ..asked[0] };
    assert!(joined(&[unreadable], &[], 8)[0].depth.is_nan());
    let at_a_measurement = joined(&asked, &[(asked[9].x, asked[9].y, 3.0)], 8);
    assert_eq!(at_a_measurement[9], asked[9], "what was told its measurement stays as it is");
}
