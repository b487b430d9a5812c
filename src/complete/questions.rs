//! The questions about one frame: which pixels are asked, the alignment of their answers to the measurements, and the dense
//! map that comes of both.

use super::options::{CancelToken, CompleteOptions, Preserve, Progress};
use crate::depth::interpolate::Interpolator;
use crate::depth::{DepthMap, SparseDepth};
use crate::error::Result;
use crate::model::{AskOptions, Prefix, SdimModel, ask};
use crate::query::plan::{Asked, lattice, refine_pixels, stride_within};
use crate::query::prompt::choose_evenly;
use crate::query::{Hint, Query, QueryPlan, Reading};
use crate::refine::{Answered, FillInput};
use image::RgbImage;

/// Measurements asked for the alignment, at most; more are chosen spatially even.
const ALIGN_POINTS: usize = 2048;

/// A pixel and what was answered there.
pub(super) type PixelReading = ((usize, usize), Reading);

/// Measurement minus answer at the pixels that were asked for the alignment.
#[derive(Default)]
pub(super) struct Residual {
    /// Columns and rows.
    pub(super) points: Vec<(f32, f32)>,
    values: Vec<f32>,
}

/// The questions about one frame.
pub(super) struct Questions<'a> {
    model: &'a SdimModel,
    prefix: &'a Prefix,
    sparse: &'a SparseDepth,
    options: &'a CompleteOptions,
    /// Linear interpolation of all measurements, metres; empty if the checkpoint takes no hint.
    hint: Vec<f32>,
}

impl<'a> Questions<'a> {
    pub(super) fn new(
        model: &'a SdimModel,
        prefix: &'a Prefix,
        sparse: &'a SparseDepth,
        options: &'a CompleteOptions,
    ) -> Result<Self> {
        let hint = match model.prompts.settings().hint {
            Hint::Linear => crate::depth::interpolate::linear(sparse)?,
            Hint::None => Vec::new(),
        };
        Ok(Self { model, prefix, sparse, options, hint })
    }

    /// What is asked at a pixel; `tell` states its measurement where the template has a place for it.
    fn query(&self, (x, y): (usize, usize), tell: bool) -> Query {
        let hint = self.hint.get(y * self.sparse.width() + x).copied().unwrap_or(f32::NAN);
        Query { x, y, measured: self.sparse.get(x, y).filter(|_| tell), hint }
    }

    /// Pixels of a plan that need an answer: measured ones do not, where they are kept.
    fn wanted(&self, pixels: Vec<(usize, usize)>) -> Vec<(usize, usize)> {
        let keep = self.options.preserve == Preserve::Keep;
        pixels.into_iter().filter(|&(x, y)| !keep || self.sparse.get(x, y).is_none()).collect()
    }

    fn ask(
        &self,
        pixels: &[(usize, usize)],
        tell: bool,
        before: usize,
        planned: usize,
    ) -> Result<Vec<Reading>> {
        let queries: Vec<Query> = pixels.iter().map(|&p| self.query(p, tell)).collect();
        let mut progress = |answered| {
            if let Some(callback) = &self.options.progress {
                callback(Progress { answered: before + answered, planned });
            }
            !self.options.cancel.as_ref().is_some_and(CancelToken::is_cancelled)
        };
        let (mode, max_memory) = (self.options.answer.as_ref(), self.options.max_memory);
        let options = AskOptions { mode, max_memory, progress: Some(&mut progress) };
        ask(self.model, self.prefix, &queries, options)
    }

    /// Asks the plan's pixels and those of the alignment.
    pub(super) fn ask_all(&self) -> Result<(Vec<PixelReading>, Residual)> {
        let (width, height) = (self.sparse.width(), self.sparse.height());
        let (first, stride, budget) = match self.options.plan {
            QueryPlan::Every => (lattice(width, height, 1), 1, 0),
            QueryPlan::Stride(n) => (lattice(width, height, n), n, 0),
            QueryPlan::Budget(n) => {
                let n = n.min(width * height);
                let stride = stride_within(width, height, n.div_ceil(2));
                let first = lattice(width, height, stride);
                let rest = n.saturating_sub(first.len());
                (first, stride, rest)
            }
        };
        let coarse = self.wanted(first.clone());
        let anchors = match self.options.align && coarse.len() + budget > 0 {
            true => choose_evenly(self.sparse, ALIGN_POINTS, 0),
            false => Vec::new(),
        };
        let planned = coarse.len() + budget + anchors.len();
        let mut pixels = coarse;
        let mut readings = self.ask(&pixels, true, 0, planned)?;
        if budget > 0 {
            let more = self.refinement(&first, stride, &pixels, &readings, budget);
            let planned = pixels.len() + more.len() + anchors.len();
            readings.extend(self.ask(&more, true, pixels.len(), planned)?);
            pixels.extend(more);
        }
        let anchor_pixels: Vec<(usize, usize)> = anchors.iter().map(|a| (a.0, a.1)).collect();
        // An answer that was told its measurement would only repeat it.
        let said = self.ask(&anchor_pixels, false, pixels.len(), pixels.len() + anchors.len())?;
        let mut residual = Residual::default();
        for ((x, y, measured), reading) in anchors.into_iter().zip(said) {
            if reading.value.is_finite() {
                residual.points.push((x as f32, y as f32));
                residual.values.push(measured - reading.value);
            }
        }
        Ok((pixels.into_iter().zip(readings).collect(), residual))
    }

    /// Where the rest of a budget goes.
    fn refinement(
        &self,
        first: &[(usize, usize)],
        stride: usize,
        asked: &[(usize, usize)],
        readings: &[Reading],
        budget: usize,
    ) -> Vec<(usize, usize)> {
        let mut next = asked.iter().zip(readings).peekable();
        let answers: Vec<Asked> = first
            .iter()
            .map(|p| match next.next_if(|(q, _)| *q == p) {
                Some((_, r)) => Asked { depth: r.value, expected_error: r.expected_error },
                // A measured pixel that was not asked is sure of its depth.
                None => Asked { depth: self.sparse.get(p.0, p.1).unwrap_or(f32::NAN), expected_error: 0.0 },
            })
            .collect();
        let (width, height) = (self.sparse.width(), self.sparse.height());
        self.wanted(refine_pixels(width, height, stride, &answers, budget))
    }

    /// Aligns the answers, fills the rest, keeps the measurements.
    pub(super) fn dense(
        &self,
        rgb: &RgbImage,
        answers: Vec<PixelReading>,
        residual: &Residual,
    ) -> Result<DepthMap> {
        let (width, height) = (self.sparse.width(), self.sparse.height());
        let shift = if residual.points.is_empty() {
            None
        } else {
            Some(Interpolator::new(&residual.points, width, height)?.raster(&residual.values))
        };
        let asked: Vec<Answered> = answers
            .into_iter()
            .filter_map(|((x, y), r)| {
                let moved = r.value + shift.as_ref().map_or(0.0, |s| s[y * width + x]);
                // An alignment that would turn the depth around is not trusted.
                let depth = if moved > 0.0 { moved } else { r.value };
                (depth.is_finite() && depth > 0.0).then_some(Answered {
                    x,
                    y,
                    depth,
                    confidence: r.confidence,
                    expected_error: r.expected_error,
                })
            })
            .collect();
        let none = SparseDepth::from_points(width, height, &[])?;
        let kept = if self.options.preserve == Preserve::Keep { self.sparse } else { &none };
        let input = FillInput { width, height, rgb, asked: &asked, sparse: kept };
        let mut filled = self.options.fill.fill(&input)?;
        let mut measured = vec![false; width * height];
        if self.options.preserve == Preserve::Keep {
            for (x, y, depth) in self.sparse.points() {
                let i = y * width + x;
                measured[i] = true;
                filled.depth[i] = depth;
                filled.confidence[i] = 1.0;
                filled.expected_error[i] = 0.0;
            }
        }
        DepthMap::new(width, height, filled.depth, filled.confidence, filled.expected_error, measured)
    }
}
