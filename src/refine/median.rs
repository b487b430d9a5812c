//! Answers are asked one by one and err one by one; what their neighbours say mends most of that.

use rayon::prelude::*;

use super::fill::{Answered, FillInput};
use crate::depth::interpolate::mesh::Mesh;
use crate::depth::pixels::{CONFIDENT_WITHIN, check_length, is_valid, pixel_count};
use crate::error::{Error, Result};

/// Weighted median filter: each answer becomes the median of the answers and measurements around it and of what the measurements
/// say by linear interpolation, each weighted by nearness and by how sure it is.
///
/// A median keeps edges and planes where they are, and an answer that is alone against its neighbours goes. The window is
/// Gaussian; at the border of the frame it is cut on both sides alike, so that a slanted plane is not bent there. What it is worth: decision 060.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MedianFilter {
    /// Standard deviation of the window, in pixels of the frame as the model sees it.
    pub sigma: f32,
    /// What is added to an answer's expected error, relative to its depth, before it is weighed: how little a sure answer may
    /// outweigh another one.
    pub doubt: f32,
    /// Weight of the linear interpolation of the measurements, relative to that of all answers together; 0 for none.
    pub interpolated: f32,
}

impl Default for MedianFilter {
    fn default() -> Self {
        Self { sigma: 1.7, doubt: 0.03, interpolated: 0.15 }
    }
}

/// Pixels between the votes of a window are at least this many: what lies closer says the same, and takes time.
const LEAST_SPACING: usize = 3;

/// A window ends so many squares from its middle.
const REACH: f32 = 2.5;

/// A square is at least this part of the window's standard deviation wide, so that a window does not end too early.
const SQUARE: f32 = 0.75;

/// Where the asked pixels lie, and how finely the model saw the frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Sampling {
    /// Distance between asked pixels where they lie least dense, pixels.
    pub spacing: usize,
    /// Pixels of the frame per pixel of what the model saw.
    pub pixel: f32,
}

/// Answers that lie farther apart than this, pixels, and of which a window with a deviation of less than so many of their distances holds but one,
/// are read with those that a mesh joins to them.
const SPARSE: usize = 4;
const REACHES: f32 = 0.6;
/// What such a neighbour weighs beside the answer itself, if it does not lie farther from it than this, in log depth: what is so far away from the
/// answer is another surface, and thin things have no neighbour of their own.
const JOINED: f32 = 0.35;
const SAME: f32 = 0.07;

/// Votes of one kind kept per square.
const PER_SQUARE: usize = 2;

/// One answer or measurement, as its neighbours see it.
#[derive(Debug, Clone, Copy, Default)]
struct Vote {
    x: u32,
    y: u32,
    depth: f32,
    confidence: f32,
    error: f32,
}

/// What was said in a square.
#[derive(Debug, Clone, Copy, Default)]
struct Square {
    answers: [Vote; PER_SQUARE],
    measured: [Vote; PER_SQUARE],
    counts: [u8; 2],
}

impl Square {
    fn votes(&self) -> impl Iterator<Item = &Vote> {
        let [answers, measured] = self.counts.map(usize::from);
        self.answers[..answers].iter().chain(&self.measured[..measured])
    }
}

/// Votes by place.
struct Squares {
    squares: Vec<Square>,
    columns: usize,
    spacing: usize,
}

impl Squares {
    fn new(input: &FillInput, spacing: usize) -> Self {
        let (columns, rows) = (input.width.div_ceil(spacing), input.height.div_ceil(spacing));
        let mut squares = vec![Square::default(); columns * rows];
        let at = |x: usize, y: usize| y / spacing * columns + x / spacing;
        for a in input.asked.iter().filter(|a| is_valid(a.depth)) {
            let Square { answers, counts, .. } = &mut squares[at(a.x, a.y)];
            keep(answers, &mut counts[0], Vote::from(a), spacing);
        }
        for (x, y, depth) in input.sparse.points() {
            let Square { measured, counts, .. } = &mut squares[at(x, y)];
            keep(measured, &mut counts[1], Vote::measured(x, y, depth), spacing);
        }
        Self { squares, columns, spacing }
    }

    /// All votes in the squares around a pixel.
    fn around(&self, x: usize, y: usize) -> impl Iterator<Item = &Vote> {
        let span = |at: usize, count: usize| {
            let square = at / self.spacing;
            let reach = REACH.ceil() as usize;
            square.saturating_sub(reach)..(square + reach + 1).min(count)
        };
        let columns = span(x, self.columns);
        let rows = span(y, self.squares.len() / self.columns);
        rows.flat_map(move |row| self.squares[row * self.columns..][columns.clone()].iter())
            .flat_map(Square::votes)
    }
}

/// Keeps those votes of a square that lie nearest to its middle, whatever order they come in.
fn keep(kept: &mut [Vote; PER_SQUARE], count: &mut u8, vote: Vote, spacing: usize) {
    let rank = |v: &Vote| {
        let apart = |at: u32| (2 * (at as usize % spacing)).abs_diff(spacing - 1);
        (apart(v.x).max(apart(v.y)), v.y, v.x)
    };
    let held = usize::from(*count);
    if let Some(free) = kept.get_mut(held) {
        *free = vote;
        *count += 1;
    } else if let Some(worst) =
        kept.iter_mut().max_by_key(|v| rank(v)).filter(|worst| rank(worst) > rank(&vote))
    {
        *worst = vote;
    }
}

impl Vote {
    fn measured(x: usize, y: usize, depth: f32) -> Self {
        Self { x: x as u32, y: y as u32, depth, confidence: 1.0, error: 0.0 }
    }
}

/// Whether a vote's mirror image beyond an answer lies in the frame: what is heard lies on both sides of the answer alike.
fn mirrored(a: &Answered, vote: &Vote, (width, height): (usize, usize)) -> bool {
    let inside = |own: usize, other: u32, size: usize| (2 * own).wrapping_sub(other as usize) < size;
    inside(a.x, vote.x, width) && inside(a.y, vote.y, height)
}

impl From<&Answered> for Vote {
    fn from(a: &Answered) -> Self {
        let (confidence, error) = (a.confidence, a.expected_error);
        Self { x: a.x as u32, y: a.y as u32, depth: a.depth, confidence, error }
    }
}

impl MedianFilter {
    /// The answers of `input`, in their order, each read anew with its neighbours. `interpolated` are the measurements interpolated linearly,
    /// `width * height` metres row by row, or empty. Unreadable answers and those at measured pixels stay as they are.
    ///
    /// # Errors
    /// [`Error::Argument`] for an option or a size of pixels that is not a finite number of at least 0 (`sigma`, `doubt` and the size: above 0),
    /// or for an answer outside the frame; [`Error::BufferLength`]; [`Error::ImageSize`] for an empty frame.
    pub fn apply(
        &self,
        input: &FillInput,
        interpolated: &[f32],
        sampling: Sampling,
    ) -> Result<Vec<Answered>> {
        self.read(input.asked, input, interpolated, sampling)
    }

    /// As [`MedianFilter::apply`], for some of the answers alone; all of `input` have a say.
    pub(crate) fn read(
        &self,
        some: &[Answered],
        input: &FillInput,
        interpolated: &[f32],
        sampling: Sampling,
    ) -> Result<Vec<Answered>> {
        self.check(sampling.pixel)?;
        let pixels = pixel_count(input.width, input.height)?;
        if !interpolated.is_empty() {
            check_length("interpolated depth", interpolated.len(), pixels)?;
        }
        if let Some(a) = input.asked.iter().find(|a| a.x >= input.width || a.y >= input.height) {
            let expected = format!("x below {} and y below {}", input.width, input.height);
            return Err(Error::argument("answer", format!("({}, {})", a.x, a.y), expected));
        }
        let deviation = self.sigma * sampling.pixel;
        if sampling.spacing > SPARSE && deviation < REACHES * sampling.spacing as f32 {
            return self.read_joined(some, input, interpolated);
        }
        // Whole spacings, so that the votes around an answer lie on both sides of it alike.
        let spacing = sampling.spacing.max(1);
        let wide = (SQUARE * deviation / spacing as f32).round() as usize;
        let square = spacing.saturating_mul(wide.max(LEAST_SPACING.div_ceil(spacing)));
        let squares = Squares::new(input, square.clamp(1, input.width.max(input.height)));
        let one = |votes: &mut Vec<(Vote, f32)>, a: &Answered| {
            if !is_valid(a.depth) || input.sparse.get(a.x, a.y).is_some() {
                return *a;
            }
            self.gather(votes, a, &squares, (input.width, input.height), deviation);
            let hint = interpolated.get(a.y * input.width + a.x).copied().filter(|d| is_valid(*d));
            self.elect(votes, a, hint)
        };
        Ok(some.par_iter().map_init(Vec::new, one).collect())
    }

    /// As [`MedianFilter::read`], where answers lie so far apart that no window would hold two of them: those heard are the ones that a mesh joins.
    fn read_joined(
        &self,
        some: &[Answered],
        input: &FillInput,
        interpolated: &[f32],
    ) -> Result<Vec<Answered>> {
        let measured = input.sparse.points().map(|(x, y, depth)| Vote::measured(x, y, depth));
        let readable = input.asked.iter().filter(|a| is_valid(a.depth)).map(Vote::from);
        let votes: Vec<Vote> = measured.chain(readable).collect();
        if votes.is_empty() {
            return Ok(some.to_vec());
        }
        let points: Vec<(f32, f32)> = votes.iter().map(|v| (v.x as f32, v.y as f32)).collect();
        let mesh = Mesh::joined(&points, input.width, input.height)?;
        let at = |x: usize, y: usize| y * input.width + x;
        let mut sites = vec![None; input.width * input.height];
        for (site, &vote) in mesh.origin.iter().enumerate() {
            sites[at(votes[vote].x as usize, votes[vote].y as usize)] = Some(site);
        }
        let one = |heard: &mut Vec<(Vote, f32)>, a: &Answered| {
            let Some(site) = sites[at(a.x, a.y)].filter(|_| input.sparse.get(a.x, a.y).is_none()) else {
                return *a;
            };
            heard.clear();
            let weight = |v: &Vote| (self.doubt + v.error / v.depth).recip();
            for &other in mesh.neighbours(site) {
                let vote = votes[mesh.origin[other as usize]];
                let near = (vote.depth / a.depth).ln().abs() <= SAME;
                if near && mirrored(a, &vote, (input.width, input.height)) {
                    heard.push((vote, JOINED * weight(&vote)));
                }
            }
            let own = Vote::from(a);
            heard.push((own, weight(&own)));
            let hint = interpolated.get(at(a.x, a.y)).copied().filter(|d| is_valid(*d));
            self.elect(heard, a, hint)
        };
        Ok(some.par_iter().map_init(Vec::new, one).collect())
    }

    fn check(&self, pixel: f32) -> Result<()> {
        for (name, value, least) in [
            ("sigma", self.sigma, f32::MIN_POSITIVE),
            ("doubt", self.doubt, f32::MIN_POSITIVE),
            ("pixel", pixel, f32::MIN_POSITIVE),
            ("interpolated", self.interpolated, 0.0),
        ] {
            if !(value.is_finite() && value >= least) {
                let expected =
                    if least > 0.0 { "a finite number above 0" } else { "a finite number of at least 0" };
                return Err(Error::argument(name, value, expected));
            }
        }
        Ok(())
    }

    /// Fills `votes` with what is said around an answer, itself included, and with the weight of each.
    fn gather(
        &self,
        votes: &mut Vec<(Vote, f32)>,
        a: &Answered,
        squares: &Squares,
        size: (usize, usize),
        deviation: f32,
    ) {
        votes.clear();
        let own = Vote::from(a);
        let reach = REACH * squares.spacing as f32;
        for vote in squares.around(a.x, a.y) {
            let (dx, dy) = (vote.x as f32 - a.x as f32, vote.y as f32 - a.y as f32);
            if dx.abs().max(dy.abs()) > reach || !mirrored(a, vote, size) || (dx == 0.0 && dy == 0.0) {
                continue;
            }
            let near = (-0.5 * (dx * dx + dy * dy) / (deviation * deviation)).exp();
            votes.push((*vote, near / (self.doubt + vote.error / vote.depth)));
        }
        votes.push((own, 1.0 / (self.doubt + own.error / own.depth)));
    }

    fn elect(&self, votes: &mut [(Vote, f32)], a: &Answered, interpolated: Option<f32>) -> Answered {
        let total: f32 = votes.iter().map(|(_, weight)| weight).sum();
        votes.sort_unstable_by(|a, b| a.0.depth.total_cmp(&b.0.depth));
        let share = if interpolated.is_some() { self.interpolated * total } else { 0.0 };
        let depth =
            weighted_median(votes, 0.5 * (total + share), interpolated.unwrap_or(f32::INFINITY), share);
        let (mut doubt, mut apart, mut near) = (0.0, 0.0, 0.0);
        for (vote, weight) in votes.iter() {
            let distance = (vote.depth - depth).abs();
            doubt += weight * vote.error;
            apart += weight * distance;
            if distance <= CONFIDENT_WITHIN * depth {
                near += weight * vote.confidence;
            }
        }
        let expected_error = (2.0 * doubt + apart) / (3.0 * total);
        let confidence = (near / total).clamp(0.0, 1.0);
        Answered { depth, confidence, expected_error, ..*a }
    }
}

/// The first depth, from near to far, at which half of the weight is reached; `votes` are sorted, and one more of weight `share` at
/// depth `extra` counts with them.
fn weighted_median(votes: &[(Vote, f32)], half: f32, extra: f32, share: f32) -> f32 {
    let (mut sum, mut counted) = (0.0, false);
    for (vote, weight) in votes {
        if !counted && extra <= vote.depth {
            counted = true;
            sum += share;
            if sum >= half {
                return extra;
            }
        }
        sum += weight;
        if sum >= half {
            return vote.depth;
        }
    }
    // Only rounding, or an interpolation farther than all votes, leads here.
    if share > 0.0 && extra.is_finite() { extra } else { votes.last().map_or(extra, |v| v.0.depth) }
}
