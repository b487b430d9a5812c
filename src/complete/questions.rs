//! The questions about one frame: which pixels are asked, the alignment of their answers to the measurements, and the dense
//! map that comes of both.

use super::alignment::{Alignment, Anchors};
use super::options::{CancelToken, CompleteOptions, Outliers, Preserve, Progress};
use crate::depth::outliers::Outlier;
use crate::depth::{DepthMap, SparseDepth, interpolate};
use crate::error::Result;
use crate::model::{AskOptions, Prefix, SdimModel, ask};
use crate::query::plan::{Asked, lattice, refine_pixels, stride_within};
use crate::query::told::choose_evenly;
use crate::query::{Hint, Query, QueryPlan, Reading};
use crate::refine::{Answered, FillInput};
use image::RgbImage;

/// Measurements asked for the alignment, at most; more are chosen spatially even.
const ALIGN_POINTS: usize = 2048;

/// What was answered in a frame.
pub(super) struct Answers {
    /// The plan's pixels.
    readings: Vec<((usize, usize), Reading)>,
    /// Measured pixels that were asked for the alignment.
    anchors: Anchors,
    /// Pixels asked, those for the alignment included.
    pub(super) asked: usize,
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
            Hint::Linear => interpolate::linear(sparse)?,
            Hint::None => Vec::new(),
        };
        Ok(Self { model, prefix, sparse, options, hint })
    }

    /// What is asked at a pixel; `tell` states its measurement where the template has a place for it.
    fn query(&self, (x, y): (usize, usize), tell: bool) -> Query {
        let hint = self.hint.get(y * self.sparse.width() + x).copied().unwrap_or(f32::NAN);
        Query { x, y, measured: self.sparse.get(x, y).filter(|_| tell), hint }
    }

    /// Whether a pixel of a plan needs an answer: measured ones do not, where they are kept.
    fn wanted(&self, (x, y): (usize, usize)) -> bool {
        self.options.preserve != Preserve::Keep || self.sparse.get(x, y).is_none()
    }

    /// Whether a pixel's own question states its measurement, so that the answer repeats it: what was answered at the pixels
    /// of the alignment, which are not told theirs, says nothing about it.
    fn told(&self, pixel: (usize, usize)) -> bool {
        self.model.prompts.states_measurement(&self.query(pixel, true))
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
        let options =
            AskOptions { mode, readout: self.options.readout, max_memory, progress: Some(&mut progress) };
        ask(self.model, self.prefix, &queries, options)
    }

    /// Asks the plan's pixels and those of the alignment.
    pub(super) fn ask_all(&self) -> Result<Answers> {
        let (width, height) = (self.sparse.width(), self.sparse.height());
        let stride = self.stride();
        let first = lattice(width, height, stride);
        let coarse: Vec<_> = first.iter().copied().filter(|&p| self.wanted(p)).collect();
        let all = match self.options.preserve {
            Preserve::Keep => width * height - self.sparse.measured(),
            Preserve::Ask => width * height,
        };
        let budget = match self.options.plan {
            QueryPlan::Budget(n) => n.min(all).saturating_sub(coarse.len()),
            QueryPlan::Every | QueryPlan::Stride(_) => 0,
        };
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
        let asked = pixels.len() + said.len();
        let mut beside = Anchors::default();
        for (anchor, reading) in anchors.into_iter().zip(&said) {
            beside.push(anchor, reading);
        }
        Ok(Answers { readings: pixels.into_iter().zip(readings).collect(), anchors: beside, asked })
    }

    /// The stride of the lattice that the plan asks first.
    fn stride(&self) -> usize {
        let (width, height) = (self.sparse.width(), self.sparse.height());
        match self.options.plan {
            QueryPlan::Every => 1,
            QueryPlan::Stride(n) => n,
            QueryPlan::Budget(n) => stride_within(width, height, n.min(width * height).div_ceil(2)),
        }
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
        refine_pixels(width, height, stride, &answers, budget, |x, y| self.wanted((x, y)))
    }

    /// The answers, read together with those around them. Measurements have a say also where they are not kept.
    fn filtered(&self, rgb: &RgbImage, asked: Vec<Answered>) -> Result<Vec<Answered>> {
        let Some(filter) = &self.options.filter else {
            return Ok(asked);
        };
        let (width, height) = (self.sparse.width(), self.sparse.height());
        let interpolated = match self.hint.is_empty() {
            true => &interpolate::linear(self.sparse)?,
            false => &self.hint,
        };
        let input = FillInput { width, height, rgb, asked: &asked, sparse: self.sparse };
        filter.apply(&input, interpolated, self.stride())
    }

    /// Aligns the answers, reads them together, fills the rest, keeps the measurements; and says what is expected at the flagged ones, which are kept
    /// where the caller insists.
    pub(super) fn dense(
        &self,
        rgb: &RgbImage,
        answers: Answers,
        flagged: &[(usize, usize, f32)],
    ) -> Result<(DepthMap, Vec<Outlier>)> {
        let (width, height) = (self.sparse.width(), self.sparse.height());
        let alignment = Alignment::new(answers.anchors, width, height)?;
        let asked: Vec<Answered> = (answers.readings)
            .into_iter()
            .filter(|(_, answer)| answer.value.is_finite() && answer.value > 0.0)
            .map(|((x, y), answer)| {
                let aligned = match &alignment {
                    Some(alignment) if !self.told((x, y)) => alignment.apply((x, y), answer),
                    _ => answer,
                };
                Answered {
                    x,
                    y,
                    depth: aligned.value,
                    confidence: aligned.confidence,
                    expected_error: aligned.expected_error,
                }
            })
            .collect();
        let none = SparseDepth::from_points(width, height, &[])?;
        let kept = if self.options.preserve == Preserve::Keep { self.sparse } else { &none };
        let asked = self.filtered(rgb, asked)?;
        let input = FillInput { width, height, rgb, asked: &asked, sparse: kept };
        let mut filled = self.options.fill.fill(&input)?;
        let expected = |&(x, y, measured): &(usize, usize, f32)| Outlier {
            x,
            y,
            measured,
            expected: filled.depth[y * width + x],
        };
        let outliers = flagged.iter().map(expected).collect();
        let insisted = if self.options.outliers == Outliers::Preserve { flagged } else { &[] };
        let mut measured = vec![false; width * height];
        if self.options.preserve == Preserve::Keep {
            for (x, y, depth) in self.sparse.points().chain(insisted.iter().copied()) {
                let i = y * width + x;
                measured[i] = true;
                filled.depth[i] = depth;
                filled.confidence[i] = 1.0;
                filled.expected_error[i] = 0.0;
            }
        }
        let map =
            DepthMap::new(width, height, filled.depth, filled.confidence, filled.expected_error, measured)?;
        Ok((map, outliers))
    }
}
