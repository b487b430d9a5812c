//! Invariants over random input.

use proptest::collection::vec;
use proptest::prelude::*;
use sdim::internals::query::bins::{Bins, Spacing};
use sdim::internals::query::number::DigitReader;
use sdim::internals::query::plan::{lattice, stride_within};
use sdim::internals::query::told::choose_evenly;
use sdim::internals::vlm::qwen2_5::preprocess::PreprocessorConfig;
use sdim::{DepthScale, Error, SparseDepth};

proptest! {
    #[test]
    fn smart_resize_stays_within_its_limits(w in 1usize..4000, h in 1usize..4000, max in 4usize..2000) {
        let json = serde_json::json!({"min_pixels": 3136, "max_pixels": max * 784});
        let config = PreprocessorConfig::from_json("t", &json).unwrap();
        match config.smart_resize(w, h) {
            Ok((rw, rh)) => {
                prop_assert!(rw % 28 == 0 && rh % 28 == 0 && rw >= 28 && rh >= 28);
                // A thin frame's short side cannot fall below one token, so it alone may pass the limit.
                prop_assert!(rw * rh <= max * 784 || rw == 28 || rh == 28, "{rw}x{rh}");
            }
            Err(e) => prop_assert!(w.max(h) > 200 * w.min(h), "{e}"),
        }
    }

    #[test]
    fn any_logits_end_in_a_number_or_none(steps in vec(vec(-50f32..50.0, 11), 12), decimals in 1usize..4, integers in 1usize..4) {
        let mut reader = DigitReader::new(decimals, integers);
        let mut used = 0;
        for logits in &steps {
            if reader.done() { break; }
            prop_assert!(reader.push(logits).is_some());
            used += 1;
        }
        prop_assert!(reader.done() && used <= integers + 1 + decimals);
        let r = reader.reading();
        prop_assert!(r.value >= 0.0 && r.value < 10f32.powi(integers as i32) + 1e-3);
        prop_assert!((0.0..=1.0).contains(&r.confidence) && r.expected_error >= 0.0);
    }

    #[test]
    fn any_distribution_gives_a_depth_in_range(logits in vec(-80f32..80.0, 2..300), range in 0.1f64..10.0) {
        let lowest = range / 50.0;
        for (spacing, least) in [(Spacing::Equal { range }, 0.0), (Spacing::Ratio { lowest, highest: range }, lowest)] {
            let r = Bins { count: logits.len(), spacing }.read(&logits, &mut Vec::new());
            prop_assert!(f64::from(r.value) >= least * 0.9999 && f64::from(r.value) <= range * 1.0001);
            prop_assert!((0.0..=1.0).contains(&r.confidence) && r.expected_error >= 0.0);
            prop_assert!(least > 0.0 || f64::from(r.expected_error) <= range);
        }
    }

    #[test]
    fn a_lattice_keeps_to_its_budget(w in 1usize..700, h in 1usize..700, budget in 1usize..5000) {
        let pixels = lattice(w, h, stride_within(w, h, budget));
        prop_assert!(!pixels.is_empty() && pixels.len() <= budget);
        prop_assert!(pixels.iter().all(|&(x, y)| x < w && y < h));
    }

    #[test]
    fn chosen_measurements_are_distinct_and_real(
        points in vec((0usize..60, 0usize..40, 0.1f32..50.0), 1..300), max in 1usize..80, seed: u64,
    ) {
        let sparse = SparseDepth::from_points(60, 40, &points).unwrap();
        let mut chosen = choose_evenly(&sparse, max, seed);
        prop_assert_eq!(chosen.len(), max.min(sparse.measured()));
        prop_assert!(chosen.iter().all(|&(x, y, d)| sparse.get(x, y) == Some(d)));
        prop_assert_eq!(&choose_evenly(&sparse, max, seed), &chosen);
        chosen.sort_by_key(|c| (c.0, c.1));
        chosen.dedup_by_key(|c| (c.0, c.1));
        prop_assert_eq!(chosen.len(), max.min(sparse.measured()));
    }

    #[test]
    fn sparse_depth_holds_what_can_be_used_and_nothing_else(values in vec(any::<f32>(), 48)) {
        match SparseDepth::new(8, 6, values.clone()) {
            Ok(sparse) => {
                for (i, v) in values.iter().enumerate() {
                    let usable = v.is_finite() && *v > 0.0;
                    prop_assert_eq!(sparse.get(i % 8, i / 8), usable.then_some(*v));
                }
            }
            Err(Error::DepthRange { value, .. }) => prop_assert!(value > SparseDepth::MAX_DEPTH),
            Err(e) => prop_assert!(false, "{e}"),
        }
    }

    #[test]
    fn units_round_trip(stored in 1u16.., scale in 1f32..5000.0) {
        let scale = DepthScale::units_per_metre(scale).unwrap();
        prop_assert_eq!(scale.stored(scale.metres(stored)), (stored, false));
    }
}
