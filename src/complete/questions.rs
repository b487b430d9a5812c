//! The questions about one frame, the alignment of their answers to the measurements, and the dense map that comes of both.

use super::alignment::{Alignment, Anchors};
use super::clock::Watch;
use super::options::{CancelToken, CompleteOptions, Outliers, Preserve, Progress, Region};
use crate::depth::outliers::Outlier;
use crate::depth::{DepthMap, SparseDepth, interpolate};
use crate::error::Result;
use crate::model::{AskOptions, Prefix, SdimModel, ask};
use crate::query::{ConfidenceScale, Hint, Query, Reading};
use crate::refine::{Answered, FillInput, Filled, Sampling};
use image::RgbImage;
use std::borrow::Cow;

/// Answers that lie at most so many pixels apart speak for the measurements between them, too.
const CLOSE: usize = 4;

/// What was answered in a frame.
#[derive(Default)]
pub(super) struct Answers {
    /// The plan's pixels.
    pub(super) readings: Vec<((usize, usize), Reading)>,
    /// Answers that are aligned already.
    pub(super) settled: Vec<Answered>,
    /// Depths that were expected, aligned, and stand for answers.
    pub(super) carried: Vec<Answered>,
    /// Measured pixels that were asked for the alignment.
    pub(super) anchors: Anchors,
    /// Whether a map was expected before anything was asked.
    pub(super) follows: bool,
    /// Pixels asked, those for the alignment included.
    pub(super) asked: usize,
    /// How long the asking took.
    pub(super) seconds: f64,
    /// Distance between the plan's pixels where they lie least dense.
    pub(super) spacing: usize,
}

impl Answers {
    /// Whether nothing at all is known but the measurements.
    pub(super) fn is_empty(&self) -> bool {
        self.readings.is_empty() && self.settled.is_empty() && self.carried.is_empty()
    }
}

/// The questions about one frame.
pub(super) struct Questions<'a> {
    model: &'a SdimModel,
    prefix: &'a Prefix,
    pub(super) rgb: &'a RgbImage,
    pub(super) sparse: &'a SparseDepth,
    /// Measurements that are not believed: column, row, metres.
    flagged: &'a [(usize, usize, f32)],
    pub(super) options: &'a CompleteOptions,
    /// Linear interpolation of all measurements, metres; empty if the checkpoint takes no hint.
    hint: Cow<'a, [f32]>,
    watch: &'a Watch,
}

impl<'a> Questions<'a> {
    pub(super) fn new(
        model: &'a SdimModel,
        rgb: &'a RgbImage,
        believed: &'a super::belief::Believed<'a>,
        options: &'a CompleteOptions,
        watch: &'a Watch,
    ) -> Result<Self> {
        let (prefix, sparse, flagged) = (&believed.prefix, &*believed.sparse, &*believed.flagged);
        let hint = match model.prompts.settings().hint {
            Hint::Linear => prefix.hints(sparse)?,
            Hint::None => Cow::Borrowed([].as_slice()),
        };
        Ok(Self { model, prefix, rgb, sparse, flagged, options, hint, watch })
    }

    /// What is made of the confidence of answers.
    pub(super) fn scale(&self) -> &ConfidenceScale {
        &self.model.prompts.settings().confidence
    }

    pub(super) fn size(&self) -> (usize, usize) {
        (self.sparse.width(), self.sparse.height())
    }

    /// The part of the frame that is completed.
    pub(super) fn region(&self) -> Region {
        let (width, height) = self.size();
        self.options.region.unwrap_or(Region { x: 0, y: 0, width, height })
    }

    /// What is asked at a pixel; `tell` states its measurement where the template has a place for it.
    fn query(&self, (x, y): (usize, usize), tell: bool) -> Query {
        let hint = self.hint.get(y * self.sparse.width() + x).copied().unwrap_or(f32::NAN);
        Query { x, y, measured: self.sparse.get(x, y).filter(|_| tell), hint }
    }

    /// Whether a pixel of a plan needs an answer: measured ones do not, where they are kept.
    pub(super) fn wanted(&self, (x, y): (usize, usize)) -> bool {
        let kept = self.options.preserve == Preserve::Keep && self.sparse.get(x, y).is_some();
        !kept && self.region().contains(x, y)
    }

    /// Whether a pixel's own question states its measurement, so that the answer repeats it: what was answered at the pixels
    /// of the alignment, which are not told theirs, says nothing about it.
    fn told(&self, pixel: (usize, usize)) -> bool {
        self.model.prompts.states_measurement(&self.query(pixel, true))
    }

    /// Asks at pixels; `planned` will be in all.
    fn ask(
        &self,
        pixels: &[(usize, usize)],
        tell: bool,
        planned: usize,
        into: &mut Answers,
    ) -> Result<Vec<Reading>> {
        let (mark, before) = (self.watch.now(), into.asked);
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
        let readings = ask(self.model, self.prefix, &queries, options)?;
        into.asked += readings.len();
        into.seconds += self.watch.since(mark);
        Ok(readings)
    }

    /// Asks at pixels of the plan.
    pub(super) fn ask_plan(
        &self,
        pixels: &[(usize, usize)],
        planned: usize,
        into: &mut Answers,
    ) -> Result<()> {
        let readings = self.ask(pixels, true, planned, into)?;
        into.readings.extend(pixels.iter().copied().zip(readings));
        Ok(())
    }

    /// Asks at measured pixels, for the alignment. They are not told their measurement: the answer would only repeat it.
    pub(super) fn ask_anchors(
        &self,
        measured: &[(usize, usize, f32)],
        planned: usize,
        into: &mut Answers,
    ) -> Result<()> {
        let pixels: Vec<(usize, usize)> = measured.iter().map(|m| (m.0, m.1)).collect();
        let said = self.ask(&pixels, false, planned, into)?;
        for (&anchor, reading) in measured.iter().zip(&said) {
            into.anchors.push(anchor, reading);
        }
        Ok(())
    }

    /// Readable answers, aligned to the measurements.
    pub(super) fn aligned(&self, answers: &Answers) -> Result<Vec<Answered>> {
        Ok(self.aligned_by(self.alignment(answers)?.as_ref(), &answers.readings))
    }

    /// What the answers at measured pixels say of all others.
    pub(super) fn alignment(&self, answers: &Answers) -> Result<Option<Alignment>> {
        let (width, height) = self.size();
        Alignment::new(answers.anchors.clone(), width, height)
    }

    /// Those of the readings that are readable, aligned.
    pub(super) fn aligned_by(
        &self,
        alignment: Option<&Alignment>,
        readings: &[((usize, usize), Reading)],
    ) -> Vec<Answered> {
        let readable = readings.iter().filter(|(_, a)| a.value.is_finite() && a.value > 0.0);
        let aligned = readable.map(|&(pixel, reading)| match alignment {
            Some(alignment) if !self.told(pixel) => answered(pixel, alignment.apply(pixel, reading)),
            _ => answered(pixel, reading),
        });
        aligned.collect()
    }

    /// All that is known of the frame: aligned answers, read together with those around them, and what was carried, which has been through the
    /// filter when it was answered. Measurements have a say also where they are not kept; an answer that was told its measurement stays as it is.
    fn known(&self, answers: &Answers) -> Result<Vec<Answered>> {
        let mut known = self.aligned(answers)?;
        known.extend(&answers.settled);
        let fresh = known.len();
        known.extend(&answers.carried);
        let scale = self.scale();
        let Some(filter) = &self.options.filter else {
            known[..fresh].iter_mut().for_each(|a| scaled(scale, a));
            return Ok(known);
        };
        let (width, height) = self.size();
        let interpolated = match self.hint.is_empty() {
            true => &interpolate::linear(self.sparse)?,
            false => &*self.hint,
        };
        let input = FillInput { width, height, rgb: self.rgb, asked: &known, sparse: self.sparse };
        let pixel = width as f32 / self.prefix.space.resized.0.max(1) as f32;
        let sampling = Sampling { spacing: answers.spacing, pixel };
        let mut read = filter.read(&known[..fresh], &input, interpolated, sampling)?;
        // What is carried was scaled when it was answered.
        read.iter_mut().for_each(|a| scaled(scale, a));
        read.extend(&answers.carried);
        Ok(read)
    }

    /// The dense map of what was answered so far: answers are aligned, read together and filled in between, measurements are kept.
    /// And what is expected at the flagged ones, which are kept where the caller insists.
    pub(super) fn dense(&self, answers: &Answers) -> Result<(DepthMap, Vec<Outlier>)> {
        let (width, height) = self.size();
        let asked = self.known(answers)?;
        let none = SparseDepth::from_points(width, height, &[])?;
        let kept = if self.options.preserve == Preserve::Keep { self.sparse } else { &none };
        // What was measured between answers that lie this close has been heard by the filter; as corners of the fill such pixels would be
        // spikes at edges, where the depth sensor and the picture differ by some pixels.
        let heard = self.options.filter.is_some() && answers.spacing <= CLOSE && !asked.is_empty();
        let corners = if heard { &none } else { kept };
        let input = FillInput { width, height, rgb: self.rgb, asked: &asked, sparse: corners };
        let filled = self.options.fill.fill(&input)?;
        finished(self.options, self.sparse, self.flagged, filled)
    }
}

/// The map of a frame that is filled: measurements are kept, and what is not wanted is left out. And what is expected at the flagged ones, which are
/// kept where the caller insists.
pub(super) fn finished(
    options: &CompleteOptions,
    sparse: &SparseDepth,
    flagged: &[(usize, usize, f32)],
    mut filled: Filled,
) -> Result<(DepthMap, Vec<Outlier>)> {
    let (width, height) = (sparse.width(), sparse.height());
    let outliers = expected_at(flagged, &filled.depth, width);
    let insisted = if options.outliers == Outliers::Preserve { flagged } else { &[] };
    let mut measured = vec![false; width * height];
    if options.preserve == Preserve::Keep {
        for (x, y, depth) in sparse.points().chain(insisted.iter().copied()) {
            let i = y * width + x;
            measured[i] = true;
            filled.depth[i] = depth;
            filled.confidence[i] = 1.0;
            filled.expected_error[i] = 0.0;
        }
    }
    leave_out(options, width, &measured, &mut filled);
    let map = DepthMap::new(width, height, filled.depth, filled.confidence, filled.expected_error, measured)?;
    Ok((map, outliers))
}

/// What is said at a pixel.
pub(super) fn answered((x, y): (usize, usize), reading: Reading) -> Answered {
    let Reading { value: depth, confidence, expected_error } = reading;
    Answered { x, y, depth, confidence, expected_error }
}

/// Makes an answer's confidence the one that held-out scenes bear out.
pub(super) fn scaled(scale: &ConfidenceScale, answer: &mut Answered) {
    answer.confidence = scale.confidence(answer.confidence);
}

/// What a map has at flagged measurements.
fn expected_at(flagged: &[(usize, usize, f32)], depth: &[f32], width: usize) -> Vec<Outlier> {
    let outlier =
        |&(x, y, measured): &(usize, usize, f32)| Outlier { x, y, measured, expected: depth[y * width + x] };
    flagged.iter().map(outlier).collect()
}

/// Makes what is not measured invalid beyond the far limit and outside of the region.
fn leave_out(options: &CompleteOptions, width: usize, measured: &[bool], map: &mut Filled) {
    let far = options.far_limit.unwrap_or(f32::INFINITY);
    for (i, depth) in map.depth.iter_mut().enumerate().filter(|(i, _)| !measured[*i]) {
        let inside = options.region.is_none_or(|region| region.contains(i % width, i / width));
        if *depth > far || !inside {
            (*depth, map.confidence[i], map.expected_error[i]) = (f32::NAN, 0.0, f32::NAN);
        }
    }
}

/// What is known of a frame before any question: its measurements, interpolated linearly, with confidence 0 where nothing was
/// measured. The expected error is the difference to the nearest measurement. Measurements are kept also where they would be asked;
/// flagged ones as [`Questions::dense`] has them.
pub(super) fn interpolated(
    sparse: &SparseDepth,
    flagged: &[(usize, usize, f32)],
    options: &CompleteOptions,
) -> Result<(DepthMap, Vec<Outlier>)> {
    let (width, height) = (sparse.width(), sparse.height());
    let (mut depth, nearest) = (interpolate::linear(sparse)?, interpolate::nearest(sparse)?);
    let mut expected_error: Vec<f32> = depth.iter().zip(&nearest).map(|(a, b)| (a - b).abs()).collect();
    let mut measured: Vec<bool> = sparse.as_slice().iter().map(|d| !d.is_nan()).collect();
    let outliers = expected_at(flagged, &depth, width);
    if options.outliers == Outliers::Preserve {
        for &(x, y, insisted) in flagged {
            let i = y * width + x;
            (depth[i], expected_error[i], measured[i]) = (insisted, 0.0, true);
        }
    }
    let confidence = measured.iter().map(|&m| if m { 1.0 } else { 0.0 }).collect();
    let mut map = Filled { depth, confidence, expected_error };
    leave_out(options, width, &measured, &mut map);
    let Filled { depth, confidence, expected_error } = map;
    Ok((DepthMap::new(width, height, depth, confidence, expected_error, measured)?, outliers))
}
