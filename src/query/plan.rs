//! Which pixels to ask.

use crate::error::{Error, Result};
use std::str::FromStr;

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
            _ => None,
        };
        plan.ok_or_else(|| Error::argument("plan", text, "every, stride:N or budget:N with N >= 1"))
    }
}

impl std::fmt::Display for QueryPlan {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Every => write!(f, "every"),
            Self::Stride(n) => write!(f, "stride:{n}"),
            Self::Budget(n) => write!(f, "budget:{n}"),
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
/// least sure. Each chosen cell gives its centre and its edge midpoints. At most `budget` pixels, none of them asked before.
pub fn refine_pixels(
    width: usize,
    height: usize,
    stride: usize,
    answers: &[Asked],
    budget: usize,
) -> Vec<(usize, usize)> {
    let pixels = lattice(width, height, stride);
    let cols = pixels.iter().take_while(|p| p.1 == pixels[0].1).count();
    let rows = pixels.len() / cols.max(1);
    if stride < 2 || answers.len() != pixels.len() {
        return Vec::new();
    }
    let mut cells: Vec<(f32, usize, usize)> = Vec::new();
    for r in 0..rows {
        for c in 0..cols {
            let corners = [(r, c), (r, c + 1), (r + 1, c), (r + 1, c + 1)];
            let inside = corners.iter().filter(|(r, c)| *r < rows && *c < cols);
            let values: Vec<Asked> = inside.map(|(r, c)| answers[r * cols + c]).collect();
            let depths = || values.iter().map(|a| a.depth).filter(|d| d.is_finite());
            let (low, high) = depths().fold((f32::MAX, 0f32), |(l, h), d| (l.min(d), h.max(d)));
            let unsure = values.iter().map(|a| a.expected_error).fold(0f32, f32::max);
            let score = if low < high { (high - low + unsure) / high } else { unsure / high.max(1e-6) };
            cells.push((score, r, c));
        }
    }
    cells.sort_by(|a, b| b.0.total_cmp(&a.0));
    let half = stride / 2;
    let mut out = Vec::with_capacity(budget);
    for (_, r, c) in cells {
        let (x, y) = pixels[r * cols + c];
        for (x, y) in [(x + half, y + half), (x + half, y), (x, y + half)] {
            if out.len() == budget {
                return out;
            }
            if x < width && y < height {
                out.push((x, y));
            }
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn plans_parse_and_bad_ones_do_not() {
        assert_eq!("every".parse::<QueryPlan>().unwrap(), QueryPlan::Every);
        assert_eq!("stride:3".parse::<QueryPlan>().unwrap(), QueryPlan::Stride(3));
        assert_eq!("budget:500".parse::<QueryPlan>().unwrap(), QueryPlan::Budget(500));
        for bad in ["", "stride", "stride:0", "stride:x", "budget:-1", "all"] {
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
    fn refinement_goes_where_answers_disagree() {
        let (w, h, s) = (16, 16, 4);
        let n = lattice(w, h, s).len();
        let answers: Vec<Asked> =
            (0..n).map(|i| Asked { depth: if i % 4 < 2 { 1.0 } else { 3.0 }, expected_error: 0.0 }).collect();
        let chosen = refine_pixels(w, h, s, &answers, 6);
        assert_eq!(chosen.len(), 6);
        let asked = lattice(w, h, s);
        assert!(chosen.iter().all(|p| !asked.contains(p)));
        let between = asked[1].0..asked[2].0 + 1;
        assert!(chosen.iter().all(|(x, _)| between.contains(x)), "{chosen:?}");
    }
}
