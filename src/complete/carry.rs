//! A frame that follows another one so closely that nothing needs to be asked.

use super::alignment::{Alignment, Anchors};
use super::belief::refutes;
use super::follow::MEASURED_APART;
use super::options::{CancelToken, CompleteOptions, Outliers, Region};
use super::prior::Prior;
use super::questions::{answered, finished};
use super::{Completion, DepthCompleter, StageSeconds};
use crate::depth::SparseDepth;
use crate::depth::outliers::{contradictions, without};
use crate::error::{Error, Result};
use crate::query::Reading;
use crate::refine::{Answered, FillInput};
use image::RgbImage;
use rayon::prelude::*;
use std::borrow::Cow;

/// The model is asked where more than this share of the pixels is unknown: what comes into view, what moves, what looks different.
const UNKNOWN: f32 = 0.04;
/// And where more than this share of the measurements contradicts what is expected.
const CONTRADICTED: f32 = 0.02;
/// What is expected so close to a measurement that contradicts it, pixels, is not taken.
const AROUND: usize = 8;
/// Expected error, relative to the depth, of what was unknown and is filled from around: so much that the next frame asks about it.
const FILLED_ERROR: f32 = 0.5;
/// Its confidence, relative to that of what it is filled from.
const FILLED_CONFIDENCE: f32 = 0.5;

impl DepthCompleter {
    /// A frame made of what is expected, aligned to its measurements, without the model; `None` where that does not suffice.
    ///
    /// # Errors
    /// As [`DepthCompleter::complete`].
    pub(crate) fn carry(
        &self,
        rgb: &RgbImage,
        sparse: &SparseDepth,
        options: &CompleteOptions,
        prior: &Prior,
    ) -> Result<Option<Completion>> {
        let watch = self.pace.watch();
        let start = watch.now();
        self.check(rgb, sparse, options)?;
        if options.cancel.as_ref().is_some_and(CancelToken::is_cancelled) {
            return Err(Error::Cancelled);
        }
        let (width, height) = (sparse.width(), sparse.height());
        let region = options.region.unwrap_or(Region { x: 0, y: 0, width, height });
        if unknown(prior, region, width) > UNKNOWN * region.pixels() as f32 {
            return Ok(None);
        }
        let flagged = flagged(rgb, sparse, options, prior)?;
        let pixels: Vec<usize> = flagged.iter().map(|&(x, y, _)| y * width + x).collect();
        let believed = match pixels.is_empty() {
            true => Cow::Borrowed(sparse),
            false => Cow::Owned(without(sparse, &pixels)?),
        };
        let compared = Compared::new(prior, &believed, region);
        if compared.wrong.len() as f32 > CONTRADICTED * believed.measured() as f32 {
            return Ok(None);
        }
        let depths = compared.depths(prior, &believed, region, options.align)?;
        let none = SparseDepth::from_points(width, height, &[])?;
        let input = FillInput { width, height, rgb, asked: &depths, sparse: &none };
        let mut filled = options.fill.fill(&input)?;
        let mut known = vec![false; width * height];
        depths.iter().for_each(|a| known[a.y * width + a.x] = true);
        for i in (0..known.len()).filter(|&i| !known[i]) {
            filled.confidence[i] *= FILLED_CONFIDENCE;
            filled.expected_error[i] = filled.expected_error[i].max(FILLED_ERROR * filled.depth[i]);
        }
        let (map, flagged) = finished(options, &believed, &flagged, filled)?;
        let seconds = StageSeconds { total: watch.since(start), ..Default::default() };
        Ok(Some(Completion { map, asked: 0, flagged, seconds, interpolated: false }))
    }
}

/// How many pixels of a region nothing is expected of.
fn unknown(prior: &Prior, region: Region, width: usize) -> f32 {
    let rows = region.y..region.y + region.height;
    let line = |y: usize| &prior.depth[y * width + region.x..][..region.width];
    rows.map(|y| line(y).iter().filter(|d| d.is_nan()).count()).sum::<usize>() as f32
}

/// Measurements that their neighbours and what is expected contradict.
fn flagged(
    rgb: &RgbImage,
    sparse: &SparseDepth,
    options: &CompleteOptions,
    prior: &Prior,
) -> Result<Vec<(usize, usize, f32)>> {
    let found = match options.outliers {
        Outliers::Trust => Vec::new(),
        Outliers::Ignore | Outliers::Preserve => contradictions(rgb, sparse)?,
    };
    let measured = sparse.as_slice();
    let mut pixels: Vec<usize> = (found.iter())
        .filter(|c| c.certain || refutes(c, measured[c.pixel], &expected(prior, c.pixel)))
        .map(|c| c.pixel)
        .collect();
    pixels.sort_unstable();
    let width = sparse.width();
    Ok(pixels.into_iter().map(|p| (p % width, p / width, measured[p])).collect())
}

fn expected(prior: &Prior, pixel: usize) -> Reading {
    Reading {
        value: prior.depth[pixel],
        confidence: prior.confidence[pixel],
        expected_error: prior.expected_error[pixel],
    }
}

/// Measurements beside what is expected at their pixels.
struct Compared {
    /// What it is aligned by.
    anchors: Anchors,
    /// Those that contradict it.
    wrong: Vec<(usize, usize, f32)>,
}

impl Compared {
    fn new(prior: &Prior, sparse: &SparseDepth, region: Region) -> Self {
        let (width, height) = (sparse.width(), sparse.height());
        let (mut anchors, mut wrong) = (Anchors::default(), Vec::new());
        for (x, y, measured) in sparse.points().filter(|&(x, y, _)| region.contains(x, y)) {
            let near = |&expected: &f32| (measured / expected).ln().abs() <= MEASURED_APART;
            let here = prior.depth[y * width + x];
            if near(&here) {
                anchors.push((x, y, measured), &expected(prior, y * width + x));
                continue;
            }
            // Beside an edge it may be a pixel off.
            let rows = y.saturating_sub(1)..(y + 2).min(height);
            let mut around =
                rows.flat_map(|v| (x.saturating_sub(1)..(x + 2).min(width)).map(move |u| (u, v)));
            if !here.is_nan() && !around.any(|(u, v)| near(&prior.depth[v * width + u])) {
                wrong.push((x, y, measured));
            }
        }
        Self { anchors, wrong }
    }

    /// What is expected, aligned, but around wrong pixels; and what was measured where nothing is.
    fn depths(
        self,
        prior: &Prior,
        sparse: &SparseDepth,
        region: Region,
        align: bool,
    ) -> Result<Vec<Answered>> {
        let (width, height) = (sparse.width(), sparse.height());
        let alignment = match align {
            true => Alignment::new(self.anchors, width, height)?,
            false => None,
        };
        let beside = |x: usize, y: usize| {
            let close = |a: usize, b: usize| a.abs_diff(b) <= AROUND;
            self.wrong.iter().any(|w| close(w.0, x) && close(w.1, y))
        };
        let one = |x: usize, y: usize| {
            let reading = expected(prior, y * width + x);
            if reading.value.is_nan() || beside(x, y) {
                let measured = sparse.get(x, y)?;
                return Some(Answered { x, y, depth: measured, confidence: 1.0, expected_error: 0.0 });
            }
            let aligned = alignment.as_ref().map_or(reading, |a| a.apply((x, y), reading));
            Some(answered((x, y), aligned))
        };
        let rows = (region.y..region.y + region.height).into_par_iter();
        let row = |y: usize| (region.x..region.x + region.width).filter_map(move |x| one(x, y));
        Ok(rows.flat_map_iter(|y| row(y).collect::<Vec<_>>()).collect())
    }
}
