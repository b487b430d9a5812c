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
    /// At most this many pixels (those of the alignment come on top): a third of them on a lattice, then between measurements and answers that
    /// disagree or are unsure, where the picture has an edge, and where nothing is near.
    Budget(usize),
    /// As many pixels as can be asked until so much time has passed since [`complete`](crate::DepthCompleter::complete) was called: first a coarse
    /// lattice, then finer ones, then as with a budget.
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
            Some(("deadline", ms)) => milliseconds(ms).map(Self::Deadline),
            _ => None,
        };
        let expected = "every, stride:N or budget:N with a whole number from 1 on, or deadline:MS with milliseconds above 0";
        plan.ok_or_else(|| Error::argument("plan", text, expected))
    }
}

/// Digits of a millisecond's fraction, down to nanoseconds.
const FRACTION: usize = 6;

/// Milliseconds above 0, with at most [`FRACTION`] digits behind a point.
fn milliseconds(text: &str) -> Option<Duration> {
    let (whole, fraction) = text.split_once('.').unwrap_or((text, "0"));
    let digits = |s: &str| !s.is_empty() && s.bytes().all(|b| b.is_ascii_digit());
    if !digits(whole) || !digits(fraction) || fraction.len() > FRACTION {
        return None;
    }
    let nanos = format!("{fraction:0<FRACTION$}").parse().ok()?;
    let time = Duration::from_millis(whole.parse().ok()?).checked_add(Duration::from_nanos(nanos))?;
    (!time.is_zero()).then_some(time)
}

impl std::fmt::Display for QueryPlan {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Every => write!(f, "every"),
            Self::Stride(n) => write!(f, "stride:{n}"),
            Self::Budget(n) => write!(f, "budget:{n}"),
            Self::Deadline(time) => {
                let (whole, nanos) = (time.as_millis(), time.subsec_nanos() % 1_000_000);
                write!(f, "deadline:{whole}")?;
                match format!("{nanos:0FRACTION$}").trim_end_matches('0') {
                    "" => Ok(()),
                    fraction => write!(f, ".{fraction}"),
                }
            }
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
        for (text, time) in [
            ("deadline:0.2", Duration::from_micros(200)),
            ("deadline:16.67", Duration::from_micros(16_670)),
            ("deadline:0.000001", Duration::from_nanos(1)),
            ("deadline:3000000", Duration::from_secs(3000)),
        ] {
            assert_eq!(text.parse::<QueryPlan>().unwrap(), QueryPlan::Deadline(time));
            assert_eq!(QueryPlan::Deadline(time).to_string(), text, "what is told is what was asked for");
        }
        for bad in
            ["", "stride", "stride:0", "stride:x", "budget:-1", "all", "deadline", "deadline:", "deadline:0"]
        {
            assert!(matches!(bad.parse::<QueryPlan>(), Err(Error::Argument { .. })), "{bad}");
        }
        for bad in ["0.0", ".5", "5.", "-5", "+5", "1e3", "0.0000001", "nan", "99999999999999999999"] {
            let bad = format!("deadline:{bad}");
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
}
