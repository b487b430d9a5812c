//! What must hold of the metrics for any prediction.

use proptest::collection::vec;
use proptest::prelude::*;
use sdim::SparseDepth;
use sdim::metrics::*;

/// Prediction and truth of a 12x8 frame, some pixels without one or the other.
fn frame() -> impl Strategy<Value = Vec<(f32, f32)>> {
    let depth =
        prop_oneof![8 => 0.1f32..80.0, 1 => Just(f32::NAN), 1 => Just(0.0f32), 1 => Just(f32::INFINITY)];
    let valid = (0.1f32..80.0, 0.1f32..80.0);
    // The first pixel has both, so that there always is something to compare.
    (valid, vec((depth.clone(), depth), 95)).prop_map(|(first, mut rest)| {
        rest.insert(0, first);
        rest
    })
}

fn parts(frame: &[(f32, f32)]) -> (Vec<f32>, Vec<f32>) {
    frame.iter().copied().unzip()
}

fn score(frame: &[(f32, f32)]) -> Errors {
    let (p, t) = parts(frame);
    errors_everywhere(&p, &t).unwrap()
}

fn close(a: f64, b: f64) -> bool {
    (a - b).abs() <= 1e-9 * a.abs().max(b.abs()).max(1.0)
}

fn values(e: &Errors) -> Vec<f64> {
    METRICS.iter().map(|m| (m.of)(e)).collect()
}

proptest! {
    #[test]
    fn errors_are_finite_and_ordered(frame in frame()) {
        let e = score(&frame);
        prop_assert!(values(&e).iter().all(|v| v.is_finite() && *v >= 0.0), "{e:?}");
        prop_assert!(e.mae <= e.rmse * (1.0 + 1e-12) && e.imae <= e.irmse * (1.0 + 1e-12));
        prop_assert!(e.delta.windows(2).all(|d| d[0] <= d[1]) && e.delta[3] <= 1.0);
        let with_truth = frame.iter().filter(|(_, t)| t.is_finite() && *t > 0.0).count();
        prop_assert_eq!(e.pixels + e.missing, with_truth);
    }

    #[test]
    fn scaling_the_scene_scales_each_error_as_it_should(frame in frame()) {
        // A power of two changes no digit of a float, so thresholds are passed by the same pixels.
        let scaled: Vec<_> = frame.iter().map(|(p, t)| (4.0 * p, 4.0 * t)).collect();
        let (a, b) = (score(&frame), score(&scaled));
        prop_assert!(close(4.0 * a.mae, b.mae) && close(4.0 * a.rmse, b.rmse));
        prop_assert!(close(a.imae, 4.0 * b.imae) && close(a.irmse, 4.0 * b.irmse));
        prop_assert!(close(a.abs_rel, b.abs_rel) && close(a.log10, b.log10));
        prop_assert_eq!(a.delta, b.delta);
    }

    #[test]
    fn the_order_of_pixels_does_not_matter(frame in frame(), turn in 0usize..96) {
        let mut turned = frame.clone();
        turned.rotate_left(turn);
        turned.reverse();
        let (a, b) = (score(&frame), score(&turned));
        prop_assert!(values(&a).iter().zip(values(&b)).all(|(x, y)| close(*x, y)), "{a:?} {b:?}");
    }

    #[test]
    fn pixels_without_truth_change_nothing(frame in frame(), more in vec(any::<f32>(), 20)) {
        let mut longer = frame.clone();
        longer.extend(more.iter().map(|&p| (p, f32::NAN)));
        longer.extend(more.iter().map(|&p| (p, -1.0)));
        prop_assert_eq!(score(&frame), score(&longer));
    }

    #[test]
    fn a_perfect_prediction_has_no_error(frame in frame()) {
        let perfect: Vec<_> = frame.iter().map(|&(_, t)| (t, t)).collect();
        let e = score(&perfect);
        prop_assert_eq!((e.mae, e.rmse, e.imae, e.irmse, e.abs_rel, e.log10), (0.0, 0.0, 0.0, 0.0, 0.0, 0.0));
        prop_assert_eq!((e.delta, e.missing), ([1.0; 4], 0));
        let (p, t) = parts(&perfect);
        prop_assert!(gradient_error(&p, &t, 12, 8).unwrap().is_none_or(|ge| ge == 0.0));
    }

    #[test]
    fn regions_take_the_frame_apart(frame in frame(), at in vec((0usize..12, 0usize..8), 1..9)) {
        let (p, t) = parts(&frame);
        let points: Vec<_> = at.iter().map(|&(x, y)| (x, y, 1.0)).collect();
        let sparse = SparseDepth::from_points(12, 8, &points).unwrap();
        let Ok(all) = errors(&p, &t, &sparse) else { return Ok(()) };
        for regions in [
            Regions::by_distance(&sparse, &DISTANCE_LIMITS).unwrap(),
            Regions::at_edges(&t, &sparse, &EdgeRule::default()).unwrap(),
        ] {
            let each: Vec<Errors> = errors_in(&p, &t, &regions).unwrap().into_iter().flatten().collect();
            let sum: f64 = each.iter().map(|e| e.mae * e.pixels as f64).sum();
            prop_assert_eq!(each.iter().map(|e| e.pixels).sum::<usize>(), all.pixels);
            prop_assert!(close(sum / all.pixels as f64, all.mae));
        }
    }

    #[test]
    fn the_gradient_error_is_blind_to_a_shift_and_bounded(frame in vec((1f32..9.0, 1f32..9.0), 96)) {
        let (p, t) = parts(&frame);
        let ge = gradient_error(&p, &t, 12, 8).unwrap().unwrap();
        let shifted: Vec<f32> = p.iter().map(|p| p + 4.0).collect();
        prop_assert!((gradient_error(&shifted, &t, 12, 8).unwrap().unwrap() - ge).abs() < 1e-4);
        let largest = p.iter().zip(&t).map(|(p, t)| f64::from((p - t).abs())).fold(0.0, f64::max);
        prop_assert!((0.0..=128f64.sqrt() * largest * 1.0001).contains(&ge));
    }

    #[test]
    fn no_order_beats_the_one_by_error(pairs in vec((0f64..5.0, 0u8..6), 1..60)) {
        let (errors, doubt): (Vec<f64>, Vec<f64>) = pairs.iter().map(|&(e, u)| (e, f64::from(u))).unzip();
        let s = sparsification(&errors, &doubt).unwrap();
        prop_assert!(s.ause >= -1e-9 && s.aurg <= 1.0);
        let best = sparsification(&errors, &errors).unwrap();
        prop_assert!(best.ause.abs() < 1e-9 && best.aurg >= s.aurg - 1e-9);
        let mut turned = pairs.clone();
        turned.reverse();
        let (e, u): (Vec<f64>, Vec<f64>) = turned.iter().map(|&(e, u)| (e, f64::from(u))).unzip();
        prop_assert_eq!(sparsification(&e, &u), Some(s));
    }

    #[test]
    fn calibration_bins_hold_every_pixel_once(pairs in vec((0u8..9, 0f64..1.0), 1..80), bins in 1usize..12) {
        let (stated, observed): (Vec<f64>, Vec<f64>) = pairs.iter().map(|&(s, o)| (f64::from(s) / 9.0, o)).unzip();
        let c = calibration(&stated, &observed, bins).unwrap();
        prop_assert_eq!(c.bins.iter().map(|b| b.pixels).sum::<usize>(), pairs.len());
        prop_assert!(c.bins.len() <= bins && c.bins.windows(2).all(|b| b[0].stated < b[1].stated));
        prop_assert!((0.0..=1.0).contains(&c.error));
        prop_assert_eq!(calibration(&stated, &stated, bins).unwrap().error, 0.0);
    }

    #[test]
    fn an_interval_holds_its_figure(values in vec(0.1f64..10.0, 1..40), seed: u64) {
        let i = bootstrap_mean(&values, seed).unwrap();
        let (least, most) = values.iter().fold((f64::MAX, 0f64), |(a, b), &v| (a.min(v), b.max(v)));
        prop_assert!(least - 1e-9 <= i.low && i.low <= i.high && i.high <= most + 1e-9);
        let one = bootstrap_ratio(&values, &values, seed).unwrap();
        prop_assert!(close(one.value, 1.0) && close(one.low, 1.0) && close(one.high, 1.0));
    }
}
