//! Which pixels to ask.

use crate::error::{Error, Result};
use std::str::FromStr;
use std::time::Duration;

/// Which pixels of a frame are asked; the others are filled from them.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum QueryPlan {
    /// Each pixel: the paper's traversal (Eq. 5).
    Every,
    /// A lattice: each N-th column and row.
    Stride(usize),
    /// At most this many pixels (those of the alignment come on top): half of them on a lattice, then where neighbours
    /// disagree or the answer is unsure.
    Budget(usize),
    /// As many pixels as can be asked until so much time has passed since [`complete`](crate::DepthCompleter::complete) was called: first a coarse
    /// lattice, then finer ones, then where neighbours disagree or the answer is unsure.
    Deadline(Duration),
}

impl Default for QueryPlan {
    fn default() -> Self {
        Self::Stride(4)
    }
}

impl FromStr for QueryPlan {
    type Err = Error;

    fn from_str(text: &str) -> Result<Self> {
        let number = |s: &str| s.parse::<usize>().ok().filter(|&n| n >= 1);
        let plan = match text.split_once(':') {
            None if text == "every" => Some(Self::Every),
            Some(("stride", n)) => number(n).map(Self::Stride),
            Some(("budget", n)) => number(n).map(Self::Budget),
            Some(("deadline", ms)) => number(ms).map(|ms| Self::Deadline(Duration::from_millis(ms as u64))),
            _ => None,
        };
        let expected =
            "every, stride:N, budget:N or deadline:MS (milliseconds) with a whole number from 1 on";
        plan.ok_or_else(|| Error::argument("plan", text, expected))
    }
}

impl std::fmt::Display for QueryPlan {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Every => write!(f, "every"),
            Self::Stride(n) => write!(f, "stride:{n}"),
            Self::Budget(n) => write!(f, "budget:{n}"),
            Self::Deadline(time) => write!(f, "deadline:{}", time.as_millis()),
        }
    }
}

/// The pixels of a lattice with this stride, row-major. It is centred, so that the border is at most half a stride away.
pub fn lattice(width: usize, height: usize, stride: usize) -> Vec<(usize, usize)> {
    let stride = stride.max(1);
    let first = |size: usize| (size.saturating_sub(1) % stride) / 2;
    let mut out = Vec::new();
    for y in (first(height)..height).step_by(stride) {
        for x in (first(width)..width).step_by(stride) {
            out.push((x, y));
        }
    }
    out
}

/// The pixels of [`lattice`], coarse lattices before the fine ones that hold them, so that those asked up to any moment are spread
/// over the whole frame.
pub fn coarse_to_fine(width: usize, height: usize, stride: usize) -> Vec<(usize, usize)> {
    let mut pixels = lattice(width, height, stride);
    let Some(&(left, top)) = pixels.first() else {
        return pixels;
    };
    let stride = stride.max(1);
    let fineness = |&(x, y): &(usize, usize)| (((x - left) | (y - top)) / stride).trailing_zeros();
    pixels.sort_by_key(|pixel| std::cmp::Reverse(fineness(pixel)));
    pixels
}

/// The smallest stride whose lattice has at most `budget` pixels.
pub fn stride_within(width: usize, height: usize, budget: usize) -> usize {
    let count = |s: usize| width.div_ceil(s) * height.div_ceil(s);
    let mut stride = ((width * height) as f64 / budget.max(1) as f64).sqrt().floor().max(1.0) as usize;
    while count(stride) > budget.max(1) && stride < width.max(height) {
        stride += 1;
    }
    stride
}

/// What one lattice pixel answered, for [`refine_pixels`].
#[derive(Debug, Clone, Copy)]
pub struct Asked {
    /// Metres; NaN if unreadable.
    pub depth: f32,
    /// Expected absolute error, metres.
    pub expected_error: f32,
}

/// Where to spend the rest of a budget: the lattice cells whose corners disagree most, relative to their depth, or are
/// least sure. Each chosen cell gives its centre and its edge midpoints; when all cells have given theirs, each gives the rest of
/// its pixels, in the same order. Only pixels that are `wanted` and not on the lattice are chosen: `budget` of them, or all
/// if there are fewer.
///
/// A corner without a readable answer is as unsure as a corner can be: its depth may be off by all of it.
pub fn refine_pixels(
    width: usize,
    height: usize,
    stride: usize,
    answers: &[Asked],
    budget: usize,
    wanted: impl Fn(usize, usize) -> bool,
) -> Vec<(usize, usize)> {
    let pixels = lattice(width, height, stride);
    if stride < 2 || answers.len() != pixels.len() {
        return Vec::new();
    }
    let cols = pixels.iter().take_while(|p| p.1 == pixels[0].1).count();
    let rows = pixels.len() / cols;
    let mut cells: Vec<(f32, usize, usize)> = Vec::with_capacity(pixels.len());
    for r in 0..rows {
        for c in 0..cols {
            let corners = [(r, c), (r, c + 1), (r + 1, c), (r + 1, c + 1)];
            let inside = corners.iter().filter(|(r, c)| *r < rows && *c < cols);
            cells.push((doubt(inside.map(|(r, c)| &answers[r * cols + c])), r, c));
        }
    }
    cells.sort_by(|a, b| b.0.total_cmp(&a.0));
    let half = stride / 2;
    let middle = cells.iter().flat_map(|&(_, r, c)| {
        let (x, y) = pixels[r * cols + c];
        [(x + half, y + half), (x + half, y), (x, y + half)]
    });
    let mut taken = vec![false; width * height];
    pixels.iter().for_each(|&(x, y)| taken[y * width + x] = true);
    let first = pixels[0];
    let rest = cells.iter().flat_map(|&(_, r, c)| {
        // The cells at the left and the upper border hold what lies before them.
        let span = |at: usize, cell: usize, first: usize| {
            if cell == 0 { 0..first + stride } else { at..at + stride }
        };
        let (x, y) = pixels[r * cols + c];
        let columns = span(x, c, first.0);
        span(y, r, first.1).flat_map(move |y| columns.clone().map(move |x| (x, y)))
    });
    let fresh = |&(x, y): &(usize, usize)| {
        x < width && y < height && wanted(x, y) && !std::mem::replace(&mut taken[y * width + x], true)
    };
    middle.chain(rest).filter(fresh).take(budget).collect()
}

/// How much the corners of a cell disagree and doubt, relative to their depth.
fn doubt<'a>(corners: impl Iterator<Item = &'a Asked>) -> f32 {
    let (mut low, mut high, mut unsure, mut unreadable) = (f32::MAX, 0f32, 0f32, false);
    for corner in corners {
        if corner.depth.is_finite() {
            (low, high) = (low.min(corner.depth), high.max(corner.depth));
            unsure = unsure.max(corner.expected_error);
        } else {
            unreadable = true;
        }
    }
    if unreadable {
        unsure = if high > 0.0 { unsure.max(high) } else { 1.0 };
    }
    let apart = if low < high { high - low } else { 0.0 };
    if high > 0.0 { (apart + unsure) / high } else { unsure }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn plans_parse_and_bad_ones_do_not() {
        assert_eq!("every".parse::<QueryPlan>().unwrap(), QueryPlan::Every);
        assert_eq!("stride:3".parse::<QueryPlan>().unwrap(), QueryPlan::Stride(3));
        assert_eq!("budget:500".parse::<QueryPlan>().unwrap(), QueryPlan::Budget(500));
        let late = QueryPlan::Deadline(Duration::from_millis(200));
        assert_eq!("deadline:200".parse::<QueryPlan>().unwrap(), late);
        assert_eq!(late.to_string(), "deadline:200");
        for bad in ["", "stride", "stride:0", "stride:x", "budget:-1", "deadline:0", "deadline:0.2", "all"] {
            assert!(matches!(bad.parse::<QueryPlan>(), Err(Error::Argument { .. })), "{bad}");
        }
    }

    #[test]
    fn lattices_fit_the_budget_and_the_frame() {
        for (w, h) in [(640, 480), (7, 3), (1, 1), (100, 1)] {
            for budget in [1, 10, 1000, 1_000_000] {
                let s = stride_within(w, h, budget);
                let pixels = lattice(w, h, s);
                assert!(!pixels.is_empty() && pixels.len() <= budget.max(1), "{w}x{h} {budget}");
                assert!(pixels.iter().all(|&(x, y)| x < w && y < h));
            }
        }
        assert_eq!(lattice(4, 2, 1).len(), 8);
    }

    #[test]
    fn the_first_pixels_of_a_lattice_are_spread_over_the_frame() {
        for (w, h, s) in [(640, 480, 4), (37, 22, 3), (5, 1, 1), (1, 1, 9)] {
            let mut ordered = coarse_to_fine(w, h, s);
            for part in [64, 16, 4] {
                // A quarter of a lattice with twice the stride in each direction, and so on.
                let first: std::collections::BTreeSet<_> =
                    ordered.iter().take(ordered.len() / part).collect();
                let (cols, rows) = (w.div_ceil(s), h.div_ceil(s));
                if first.len() >= 16 && cols >= 16 && rows >= 16 {
                    for corner in [(0, 0), (w / 2, 0), (0, h / 2), (w / 2, h / 2)] {
                        let inside = |p: &&&(usize, usize)| {
                            (corner.0..corner.0 + w / 2).contains(&p.0)
                                && (corner.1..corner.1 + h / 2).contains(&p.1)
                        };
                        assert!(first.iter().filter(inside).count() * 6 > first.len(), "{w}x{h} {corner:?}");
                    }
                }
            }
            ordered.sort_by_key(|p| (p.1, p.0));
            assert_eq!(ordered, lattice(w, h, s), "each pixel once");
        }
    }

    #[test]
    fn refinement_goes_where_answers_disagree() {
        let (w, h, s) = (16, 16, 4);
        let n = lattice(w, h, s).len();
        let answers: Vec<Asked> =
            (0..n).map(|i| Asked { depth: if i % 4 < 2 { 1.0 } else { 3.0 }, expected_error: 0.0 }).collect();
        let chosen = refine_pixels(w, h, s, &answers, 6, |_, _| true);
        assert_eq!(chosen.len(), 6);
        let asked = lattice(w, h, s);
        assert!(chosen.iter().all(|p| !asked.contains(p)));
        let between = asked[1].0..asked[2].0 + 1;
        assert!(chosen.iter().all(|(x, _)| between.contains(x)), "{chosen:?}");
    }
    #[test]
    fn cells_with_unreadable_corners_come_first() {
        let (w, h, s) = (32, 32, 4);
        let asked = lattice(w, h, s);
        let unreadable = asked[3 * 8 + 5];
        let answers: Vec<Asked> = (0..asked.len())
            .map(|i| match asked[i] == unreadable {
                true => Asked { depth: f32::NAN, expected_error: f32::NAN },
                // A step and some doubt elsewhere.
                false => Asked { depth: if i % 8 < 2 { 1.0 } else { 2.0 }, expected_error: 0.1 },
            })
            .collect();
        // The four cells around it, three pixels each.
        let chosen = refine_pixels(w, h, s, &answers, 12, |_, _| true);
        let near = |a: usize, b: usize| a.abs_diff(b) <= s;
        assert!(chosen.iter().all(|p| near(p.0, unreadable.0) && near(p.1, unreadable.1)), "{chosen:?}");
        let silent = vec![Asked { depth: f32::NAN, expected_error: f32::NAN }; asked.len()];
        assert_eq!(refine_pixels(w, h, s, &silent, 12, |_, _| true).len(), 12);
    }

    #[test]
    fn a_budget_is_spent_on_wanted_pixels_alone_and_to_the_end() {
        for (w, h, s) in [(37, 22, 3), (64, 48, 5), (9, 30, 8), (5, 5, 7), (40, 1, 2)] {
            let asked = lattice(w, h, s);
            let answers: Vec<Asked> = (0..asked.len())
                .map(|i| Asked { depth: 1.0 + (i * 7 % 5) as f32, expected_error: 0.1 })
                .collect();
            let wanted = |x: usize, y: usize| !(x * 5 + y * 3).is_multiple_of(4);
            let all = refine_pixels(w, h, s, &answers, usize::MAX, wanted);
            let left = (0..w * h).map(|i| (i % w, i / w)).filter(|p| wanted(p.0, p.1) && !asked.contains(p));
            let mut sorted = all.clone();
            sorted.sort_by_key(|p| (p.1, p.0));
            assert_eq!(sorted, left.collect::<Vec<_>>(), "{w}x{h}, {s}: each of them once");
            let some = all.len() / 2;
            assert_eq!(refine_pixels(w, h, s, &answers, some, wanted), all[..some]);
        }
    }
}
