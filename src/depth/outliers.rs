//! Measurements that those around them and the picture contradict.
//!
//! A measurement is contradicted when it lies outside of the range of its neighbours, in log depth, by more than a threshold. The
//! range, not a fitted surface, is what it is compared with, so that steps, slopes and noise of any kind cost nothing: at an edge
//! one side or the other supports it. What has no support is a lone outlier or a thing so small that a single measurement fell on
//! it; the second has a colour of its own, so the threshold rises with the difference of colour to the neighbour that is most alike.
//! The worst may hide others behind them, so the rest is judged again without those found.
//!
//! Thresholds were chosen on 60 procedural scenes (uniform, SfM and LiDAR-ring measurements, 100 to 1500, 2 and 5 % of them times or
//! divided by 1.5 to 3) for less than one clean measurement in a hundred.

use super::SparseDepth;
use super::interpolate::mesh::Mesh;
use super::interpolate::rim;
use super::pixels::{colours_apart, is_valid, local_colour, median};
use crate::error::{Error, Result};
use image::RgbImage;
use rayon::prelude::*;

/// A measurement that is not believed.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Outlier {
    /// Column.
    pub x: usize,
    /// Row.
    pub y: usize,
    /// What was measured, metres.
    pub measured: f32,
    /// What is expected there without it, metres.
    pub expected: f32,
}

/// How far outside of its neighbours' range a measurement may lie, in log depth: 7 %.
const BEYOND: f32 = 0.07;
/// What the largest difference of colour adds to it; more where neighbours stand side by side and all of them differ, as
/// they do around a thing of one pixel.
const COLOUR: f32 = 0.2;
const COLOUR_IN_A_CROWD: f32 = 1.0;
/// The difference of colour (Euclidean, 8-bit RGB) from which on it adds no more.
const OTHER_COLOUR: f32 = 60.0;
/// Scatter of the whole frame (median difference of a measurement to its neighbours' median, in log depth) up to which its
/// measurements can judge each other, and what is added to the threshold for each unit above. Procedural scenes with 100
/// points have 0.05 in the median and 0.14 at most.
const SCATTER: f32 = 0.1;
const PER_SCATTER: f32 = 5.0;
/// A median distance to the neighbours, in parts of the frame's larger side, from which on these lie too far off to judge alone.
const FAR_OFF: f32 = 0.05;
/// What must be added to the threshold where they judge alone all the same.
const ALONE: f32 = 0.15;
/// Passes over the measurements, at most.
const ROUNDS: usize = 5;
/// Fewer measurements than this cannot judge each other.
const FEWEST: usize = 12;
/// Reaches of the windows whose measurements are a pixel's neighbours, the first with a [`CROWD`] of them; where none has, those that
/// the Delaunay mesh joins to it are.
const REACHES: [usize; 2] = [2, 4];
const CROWD: usize = 8;
/// Points that the scatter of a frame is read from, at most.
const SAMPLE: usize = 4096;
/// A part of the measurements that may be strays at one end of the range, and the factor that parts these from the rest: what no
/// scene has between two measurements. For equal values (a saturated sensor) the smaller one.
const STRAYS: usize = 10;
const APART: f32 = 20.0;
const APART_EQUAL: f32 = 3.0;

/// A measurement outside of its neighbours' range.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Contradiction {
    /// Row-major index of the pixel.
    pub(crate) pixel: usize,
    /// Whether it lies behind all neighbours, or before them.
    pub(crate) behind: bool,
    /// By how much it passes the threshold, in log depth.
    excess: f32,
    /// Whether the neighbours are near enough to judge alone.
    pub(crate) certain: bool,
}

impl Contradiction {
    /// The verdict where nobody else can be asked.
    pub(crate) fn stands_alone(&self) -> bool {
        self.certain || self.excess > ALONE
    }
}

/// The measurements that what lies around them contradicts, row by row; expected is the linear interpolation of the others.
///
/// Works without a model, so few measurements that lie far apart are given the benefit of the doubt;
/// [`DepthCompleter`](crate::DepthCompleter) asks the model about those.
///
/// # Errors
/// [`Error::SizeMismatch`].
pub fn find(rgb: &RgbImage, sparse: &SparseDepth) -> Result<Vec<Outlier>> {
    let found = contradictions(rgb, sparse)?;
    let pixels: Vec<usize> = found.iter().filter(|c| c.stands_alone()).map(|c| c.pixel).collect();
    if pixels.is_empty() {
        return Ok(Vec::new());
    }
    let expected = super::interpolate::linear(&without(sparse, &pixels)?)?;
    let width = sparse.width();
    let outlier = |&pixel: &usize| Outlier {
        x: pixel % width,
        y: pixel / width,
        measured: sparse.as_slice()[pixel],
        expected: expected[pixel],
    };
    Ok(pixels.iter().map(outlier).collect())
}

/// The measurements but for those at these pixels.
pub(crate) fn without(sparse: &SparseDepth, pixels: &[usize]) -> Result<SparseDepth> {
    let mut depth = sparse.as_slice().to_vec();
    pixels.iter().for_each(|&pixel| depth[pixel] = f32::NAN);
    SparseDepth::new(sparse.width(), sparse.height(), depth)
}

/// All contradicted measurements, in ascending order; at least half of the measurements are left.
pub(crate) fn contradictions(rgb: &RgbImage, sparse: &SparseDepth) -> Result<Vec<Contradiction>> {
    let size = (rgb.width() as usize, rgb.height() as usize);
    if size != (sparse.width(), sparse.height()) {
        return Err(Error::SizeMismatch { rgb: size, depth: (sparse.width(), sparse.height()) });
    }
    if sparse.measured() < FEWEST {
        return Ok(Vec::new());
    }
    let mut found: Vec<Contradiction> = strays(sparse)
        .into_iter()
        .map(|(pixel, behind)| Contradiction { pixel, behind, excess: f32::INFINITY, certain: true })
        .collect();
    let mut threshold = None;
    for _ in 0..ROUNDS {
        let pixels: Vec<usize> = found.iter().map(|c| c.pixel).collect();
        let left = without(sparse, &pixels)?;
        let survey = Survey::new(rgb, &left)?;
        let beyond = *threshold.get_or_insert_with(|| survey.threshold());
        let new = survey.contradictions(beyond);
        if new.is_empty() || 2 * (found.len() + new.len()) > sparse.measured() {
            break;
        }
        found.extend(new);
    }
    found.sort_unstable_by_key(|c| c.pixel);
    Ok(found)
}

/// Measurements that a gap which no scene has parts from all others, at either end of the range, with whether it is the far one:
/// several of them side by side (left-overs of rectification at a border, a saturated patch) support each other, so that
/// neighbours cannot tell.
fn strays(sparse: &SparseDepth) -> Vec<(usize, bool)> {
    let depth = sparse.as_slice();
    let mut values: Vec<f32> = depth.iter().copied().filter(|d| is_valid(*d)).collect();
    let few = values.len() / STRAYS;
    let Some(median) = median(&mut values) else { return Vec::new() };
    let mut near: Vec<f32> = values.iter().copied().filter(|d| *d * APART < median).collect();
    near.sort_unstable_by(f32::total_cmp);
    let nearest_usual = values.iter().copied().filter(|d| *d * APART >= median).fold(f32::INFINITY, f32::min);
    // The last gap that is wide enough, with few enough before it.
    let next = |i: usize| near.get(i + 1).copied().unwrap_or(nearest_usual);
    let below = (0..near.len().min(few)).rev().find(|&i| near[i] * APART < next(i)).map(|i| near[i]);
    let farthest = values.iter().copied().fold(0.0, f32::max);
    let second = values.iter().copied().filter(|d| *d < farthest).fold(0.0, f32::max);
    let equal = values.iter().filter(|d| **d == farthest).count();
    let saturated = (2..=few).contains(&equal) && second > 0.0 && second * APART_EQUAL < farthest;
    let far = |d: f32| saturated && d == farthest;
    let near = |d: f32| below.is_some_and(|below| d <= below);
    if below.is_none() && !saturated {
        return Vec::new();
    }
    (depth.iter().enumerate()).filter(|(_, d)| near(**d) || far(**d)).map(|(i, d)| (i, far(*d))).collect()
}

/// Measurements with their neighbours.
struct Survey<'a> {
    rgb: &'a RgbImage,
    size: (usize, usize),
    /// Measured pixels, ascending.
    pixels: Vec<usize>,
    /// Logarithms of the measurements, NaN where there is none.
    logs: Vec<f32>,
    /// Measurements at a hole with the mesh over them, `None` if all have a crowd around them.
    mesh: Option<(Vec<usize>, Mesh)>,
}

impl<'a> Survey<'a> {
    fn new(rgb: &'a RgbImage, sparse: &SparseDepth) -> Result<Self> {
        let (size, depth) = ((sparse.width(), sparse.height()), sparse.as_slice());
        let pixels: Vec<usize> = (0..depth.len()).filter(|&pixel| !depth[pixel].is_nan()).collect();
        let mut logs = vec![f32::NAN; depth.len()];
        pixels.iter().for_each(|&pixel| logs[pixel] = depth[pixel].ln());
        let mut survey = Self { rgb, size, pixels, logs, mesh: None };
        let alone = |around: &mut Vec<usize>, &pixel: &usize| !survey.crowd(pixel, around);
        if survey.pixels.par_iter().map_init(Vec::new, alone).any(|alone| alone) {
            let rim = rim(sparse);
            let positions: Vec<_> = rim.iter().map(|&(x, y, _)| (x as f32, y as f32)).collect();
            let mesh = Mesh::joined(&positions, size.0, size.1)?;
            survey.mesh = Some((rim.iter().map(|&(x, y, _)| y * size.0 + x).collect(), mesh));
        }
        Ok(survey)
    }

    /// Fills `out` with the measured pixels of the window around one; whether they are a crowd.
    fn crowd(&self, pixel: usize, out: &mut Vec<usize>) -> bool {
        let (width, height) = self.size;
        let (x, y) = (pixel % width, pixel / width);
        REACHES.iter().any(|reach| {
            out.clear();
            let columns = x.saturating_sub(*reach)..(x + reach + 1).min(width);
            for row in y.saturating_sub(*reach)..(y + reach + 1).min(height) {
                let pixels = columns.clone().map(|column| row * width + column);
                out.extend(pixels.filter(|&other| other != pixel && !self.logs[other].is_nan()));
            }
            out.len() >= CROWD
        })
    }

    /// Fills `out` with the neighbours of a measurement; whether they are a crowd.
    fn neighbours(&self, pixel: usize, out: &mut Vec<usize>) -> bool {
        if self.crowd(pixel, out) {
            return true;
        }
        if let Some((rim, mesh)) = &self.mesh
            && let Ok(site) = rim.binary_search(&pixel)
        {
            out.clear();
            out.extend(mesh.neighbours(site).iter().map(|&s| rim[s as usize]));
        }
        false
    }

    /// How far outside of its neighbours' range a measurement of this frame may lie.
    fn threshold(&self) -> f32 {
        let step = self.pixels.len().div_ceil(SAMPLE).max(1);
        let pixels: Vec<usize> = self.pixels.iter().copied().step_by(step).collect();
        let mut off: Vec<f32> = (pixels.par_iter())
            .map_init(Vec::new, |around, &pixel| {
                self.neighbours(pixel, around);
                let mut logs: Vec<f32> = around.iter().map(|&n| self.logs[n]).collect();
                median(&mut logs).map(|m| (self.logs[pixel] - m).abs())
            })
            .flatten()
            .collect();
        let scatter = median(&mut off).unwrap_or(0.0);
        BEYOND + PER_SCATTER * (scatter - SCATTER).max(0.0)
    }

    fn contradictions(&self, beyond: f32) -> Vec<Contradiction> {
        let judge = |around: &mut Vec<usize>, &pixel: &usize| self.judge(pixel, beyond, around);
        self.pixels.par_iter().map_init(Vec::new, judge).flatten().collect()
    }

    fn judge(&self, pixel: usize, beyond: f32, around: &mut Vec<usize>) -> Option<Contradiction> {
        let crowd = self.neighbours(pixel, around);
        let own = self.logs[pixel];
        let (mut low, mut high) = ([f32::INFINITY; 2], [f32::NEG_INFINITY; 2]);
        for log in around.iter().map(|&n| self.logs[n]) {
            low = if log < low[0] { [log, low[0]] } else { [low[0], low[1].min(log)] };
            high = if log > high[0] { [log, high[0]] } else { [high[0], high[1].max(log)] };
        }
        // Of a crowd one may be wrong itself; of few, one is support enough.
        let (low, high) = (low[usize::from(crowd)], high[usize::from(crowd)]);
        let over = (own - high).max(low - own);
        // Infinite without neighbours.
        if over <= beyond || !over.is_finite() {
            return None;
        }
        around.retain(|&n| (self.logs[n] - own).abs() > beyond);
        let excess = over - beyond - self.colour_apart(pixel, around, crowd);
        if excess <= 0.0 {
            return None;
        }
        let width = self.size.0;
        let side = width.max(self.size.1) as f32;
        let distance = |&n: &usize| {
            let (dx, dy) = ((n % width).abs_diff(pixel % width), (n / width).abs_diff(pixel / width));
            (dx as f32).hypot(dy as f32)
        };
        let spacing = median(&mut around.iter().map(distance).collect::<Vec<_>>()).unwrap_or(side);
        let certain = spacing < FAR_OFF * side;
        Some(Contradiction { pixel, behind: own > high, excess, certain })
    }

    /// What the difference of colour to the one of these neighbours that is most alike adds to the threshold.
    fn colour_apart(&self, pixel: usize, around: &[usize], crowd: bool) -> f32 {
        let width = self.size.0;
        let colour = |pixel: usize| {
            let (x, y) = (pixel % width, pixel / width);
            match crowd {
                true => self.rgb.get_pixel(x as u32, y as u32).0.map(f32::from),
                false => local_colour(self.rgb, x, y),
            }
        };
        let own = colour(pixel);
        let apart = |&n: &usize| colours_apart(own, colour(n));
        let least = around.iter().map(apart).fold(f32::INFINITY, f32::min);
        let most = if crowd { COLOUR_IN_A_CROWD } else { COLOUR };
        most * least.sqrt().min(OTHER_COLOUR) / OTHER_COLOUR
    }
}

#[cfg(test)]
#[path = "outliers_tests.rs"]
mod tests;
