//! Which measurements a prompt tells.

use super::number::DepthUnit;
use crate::depth::SparseDepth;
use rand::seq::SliceRandom;
use rand_chacha::rand_core::SeedableRng;

/// At most `max` measurements (column, row, metres), as [`choose_evenly`] chooses them; where numbers are counted in the largest one,
/// it is among them.
pub(super) fn told(sparse: &SparseDepth, unit: DepthUnit, max: usize, seed: u64) -> Vec<(usize, usize, f32)> {
    let chosen = choose_evenly(sparse, max, seed);
    match unit {
        DepthUnit::FrameMax => with_largest(chosen, sparse),
        DepthUnit::Metres | DepthUnit::Centimetres | DepthUnit::Millimetres | DepthUnit::FrameMedian => {
            chosen
        }
    }
}

/// The chosen ones with the frame's largest measurement: in the last one's place if it is not there.
fn with_largest(mut chosen: Vec<(usize, usize, f32)>, sparse: &SparseDepth) -> Vec<(usize, usize, f32)> {
    let top = sparse.points().max_by(|a, b| a.2.total_cmp(&b.2));
    let told = |top: &_| chosen.contains(top);
    if let Some(top) = top.filter(|top| !told(top))
        && let Some(last) = chosen.last_mut()
    {
        *last = top;
    }
    chosen
}

/// At most `max` measurements, spread evenly over the frame, in a shuffled order that depends on the seed alone.
///
/// With too many, the frame is cut into about `max` cells and each gives the measurement nearest to its centre; what
/// is left over is filled from the rest.
pub fn choose_evenly(sparse: &SparseDepth, max: usize, seed: u64) -> Vec<(usize, usize, f32)> {
    let mut points: Vec<(usize, usize, f32)> = sparse.points().collect();
    let mut rng = rand_chacha::ChaCha8Rng::seed_from_u64(seed);
    points.shuffle(&mut rng);
    if points.len() <= max || max == 0 {
        points.truncate(max);
        return points;
    }
    let side = ((sparse.width() * sparse.height()) as f32 / max as f32).sqrt().max(1.0);
    let cols = (sparse.width() as f32 / side).ceil() as usize;
    let rows = (sparse.height() as f32 / side).ceil() as usize;
    let mut best: Vec<Option<(f32, usize)>> = vec![None; cols * rows];
    for (i, &(x, y, _)) in points.iter().enumerate() {
        let (fx, fy) = (x as f32 / side, y as f32 / side);
        let cell = (fy as usize).min(rows - 1) * cols + (fx as usize).min(cols - 1);
        let off = (fx.fract() - 0.5).powi(2) + (fy.fract() - 0.5).powi(2);
        if best[cell].is_none_or(|(b, _)| off < b) {
            best[cell] = Some((off, i));
        }
    }
    let mut taken = vec![false; points.len()];
    for (_, i) in best.into_iter().flatten() {
        taken[i] = true;
    }
    let (mut chosen, rest): (Vec<_>, Vec<_>) = points.iter().zip(&taken).partition(|(_, t)| **t);
    chosen.extend(rest);
    let mut chosen: Vec<_> = chosen.into_iter().map(|(p, _)| *p).take(max).collect();
    chosen.shuffle(&mut rng);
    chosen
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A measurement at each pixel, which rises from left to right; the largest is in the upper right corner.
    fn dense() -> SparseDepth {
        let depth = |i: usize| 1.0 + (i % 20) as f32 + if i == 19 { 0.5 } else { 0.0 };
        let points: Vec<_> = (0..400).map(|i| (i % 20, i / 20, depth(i))).collect();
        SparseDepth::from_points(20, 20, &points).unwrap()
    }

    #[test]
    fn the_largest_is_told_where_numbers_are_counted_in_it() {
        let (sparse, top) = (dense(), (19, 0, 20.5));
        for seed in 0..20 {
            let plain = told(&sparse, DepthUnit::FrameMedian, 4, seed);
            // A corner is nowhere near the centre of a cell.
            assert!(plain.len() == 4 && !plain.contains(&top), "{plain:?}");
            let with = told(&sparse, DepthUnit::FrameMax, 4, seed);
            assert_eq!((&with[..3], with[3]), (&plain[..3], top));
        }
        assert_eq!(told(&sparse, DepthUnit::FrameMax, 1, 0), [top]);
        assert!(told(&sparse, DepthUnit::FrameMax, 0, 0).is_empty());
        // Where it was chosen, nothing is put in another one's place.
        let (all, evenly) = (told(&sparse, DepthUnit::FrameMax, 400, 7), choose_evenly(&sparse, 400, 7));
        assert_eq!(all, evenly);
    }

    #[test]
    fn each_part_of_a_frame_is_told_of() {
        let chosen = choose_evenly(&dense(), 16, 3);
        let cells: std::collections::BTreeSet<_> = chosen.iter().map(|p| (p.0 / 5, p.1 / 5)).collect();
        assert_eq!((chosen.len(), cells.len()), (16, 16), "{chosen:?}");
        assert_ne!(chosen, choose_evenly(&dense(), 16, 4), "the order depends on the seed");
    }
}
