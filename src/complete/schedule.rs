//! In which order the pixels of a frame are asked, and when that ends.

use super::options::{Partial, Progress};
use super::pace::{Clock, Seconds};
use super::questions::{Answers, Questions};
use crate::error::Result;
use crate::query::QueryPlan;
use crate::query::plan::{Asked, coarse_to_fine, lattice, refine_pixels, stride_within};
use crate::query::told::choose_evenly;
use std::collections::{HashMap, HashSet};
use std::time::Instant;

/// Measurements asked for the alignment, at most; more are chosen spatially even.
const ALIGN_POINTS: usize = 2048;
/// Pixels asked between two looks at the map, where somebody looks.
const PREVIEW_CHUNK: usize = 4096;
/// Pixels of the first lattice under a deadline: enough for a map of rooms.
const COARSE: usize = 256;
/// Share of the time under a deadline after which the clock is looked at again.
const TICK: f64 = 0.05;
/// Questions asked between two looks at the clock, at least and at most.
const CHUNK: (usize, usize) = (64, 2048);
/// The alignment takes at most this share of the questions under a deadline.
const ALIGN_SHARE: usize = 4;

impl Questions<'_> {
    /// Asks the plan's pixels and those of the alignment.
    pub(super) fn ask_all(&self, clock: Option<Clock>, pace: Seconds) -> Result<Answers> {
        let region = self.region();
        let stride = match self.options.plan {
            QueryPlan::Every => 1,
            QueryPlan::Stride(n) => n,
            QueryPlan::Budget(n) => {
                stride_within(region.width, region.height, n.min(region.pixels()).div_ceil(2))
            }
            QueryPlan::Deadline(_) => match clock {
                Some(clock) => return self.ask_until(clock, pace),
                None => 1,
            },
        };
        let coarse = self.first_lattice(stride);
        let all = self.all_wanted();
        let budget = match self.options.plan {
            QueryPlan::Budget(n) => n.min(all).saturating_sub(coarse.len()),
            _ => 0,
        };
        let anchors = self.chosen_anchors(coarse.len() + budget);
        let planned = coarse.len() + budget + anchors.len();
        let mut answers = Answers { spacing: stride, ..Default::default() };
        // First, so that what is looked at meanwhile is aligned.
        self.ask_anchors(anchors, planned, &mut answers)?;
        self.ask_lattice(coarse, planned, &mut answers)?;
        if budget > 0 {
            let more = self.refinement(stride, &answers, budget);
            let planned = answers.asked + more.len();
            self.ask_lattice(more, planned, &mut answers)?;
        }
        Ok(answers)
    }

    /// Asks these pixels, each once, and those of the alignment.
    pub(super) fn ask_pixels(&self, pixels: &[(usize, usize)]) -> Result<Answers> {
        let mut wanted: Vec<_> = pixels.iter().copied().filter(|&p| self.wanted(p)).collect();
        wanted.sort_unstable();
        wanted.dedup();
        let anchors = self.chosen_anchors(wanted.len());
        let planned = wanted.len() + anchors.len();
        let mut answers = Answers { spacing: 1, ..Default::default() };
        self.ask_anchors(anchors, planned, &mut answers)?;
        self.ask_plan(&wanted, planned, &mut answers)?;
        Ok(answers)
    }

    /// The measured pixels that so many answers are aligned by.
    fn chosen_anchors(&self, answers: usize) -> Vec<(usize, usize, f32)> {
        match self.options.align && answers > 0 {
            true => choose_evenly(self.sparse, ALIGN_POINTS, 0),
            false => Vec::new(),
        }
    }

    /// How many pixels the whole region wants asked.
    fn all_wanted(&self) -> usize {
        let region = self.region();
        let rows = region.y..region.y + region.height;
        rows.map(|y| (region.x..region.x + region.width).filter(|&x| self.wanted((x, y))).count()).sum()
    }

    /// The lattice that is asked first, coarse to fine where somebody looks meanwhile.
    fn first_lattice(&self, stride: usize) -> Vec<(usize, usize)> {
        self.wanted_of(if self.options.preview.is_some() { coarse_to_fine } else { lattice }, stride)
    }

    /// The pixels of a lattice over the region that want an answer.
    fn wanted_of(
        &self,
        order: fn(usize, usize, usize) -> Vec<(usize, usize)>,
        stride: usize,
    ) -> Vec<(usize, usize)> {
        let mut pixels = self.region().lattice(order, stride);
        pixels.retain(|&pixel| self.wanted(pixel));
        pixels
    }

    /// Asks pixels, all at once unless somebody looks at the map meanwhile.
    fn ask_lattice(&self, pixels: Vec<(usize, usize)>, planned: usize, into: &mut Answers) -> Result<()> {
        if self.options.preview.is_none() {
            return self.ask_plan(&pixels, planned, into);
        }
        let spacing = into.spacing;
        for chunk in pixels.chunks(PREVIEW_CHUNK) {
            self.ask_plan(chunk, planned, into)?;
            into.spacing = self.spacing_of(into.readings.len()).max(spacing);
            self.look(into, planned);
        }
        into.spacing = spacing;
        Ok(())
    }

    /// Distance between so many pixels spread evenly.
    pub(super) fn spacing_of(&self, pixels: usize) -> usize {
        (self.region().pixels() as f64 / pixels.max(1) as f64).sqrt().ceil() as usize
    }

    /// Where the rest of a budget goes.
    fn refinement(&self, stride: usize, answers: &Answers, budget: usize) -> Vec<(usize, usize)> {
        let region = self.region();
        let known: HashMap<(usize, usize), Asked> = (answers.readings.iter())
            .map(|(p, r)| (*p, Asked { depth: r.value, expected_error: r.expected_error }))
            .collect();
        let corners: Vec<Asked> = (region.lattice(lattice, stride).into_iter())
            .map(|p| match known.get(&p) {
                Some(asked) => *asked,
                // A measured pixel that was not asked is sure of its depth.
                None => Asked { depth: self.sparse.get(p.0, p.1).unwrap_or(f32::NAN), expected_error: 0.0 },
            })
            .collect();
        let wanted = |x, y| {
            let pixel = region.place((x, y));
            self.wanted(pixel) && !known.contains_key(&pixel)
        };
        let more = refine_pixels(region.width, region.height, stride, &corners, budget, wanted);
        more.into_iter().map(|pixel| region.place(pixel)).collect()
    }

    /// Asks as much as the time allows. A coarse lattice comes first, so that there is always a whole map; nothing is asked where not even
    /// that fits.
    fn ask_until(&self, clock: Clock, pace: Seconds) -> Result<Answers> {
        let (width, height) = self.size();
        let refine = pace.refine * (width * height) as f64;
        let region = self.region();
        let stride = stride_within(region.width, region.height, COARSE);
        let mut answers = Answers { spacing: stride, ..Default::default() };
        let coarse = self.first_lattice(stride);
        let late = clock.left() - refine < pace.answer.unwrap_or(0.0) * coarse.len() as f64;
        if late || coarse.is_empty() {
            return Ok(answers);
        }
        let mark = Instant::now();
        self.ask_plan(&coarse, coarse.len(), &mut answers)?;
        let mut seconds = mark.elapsed().as_secs_f64() / coarse.len() as f64;
        self.look(&answers, answers.asked);
        // Less than nothing becomes 0.
        let fitting = |seconds: f64| clock.fits(refine, seconds) as usize;
        if self.options.align {
            let mark = Instant::now();
            let anchors = choose_evenly(self.sparse, ALIGN_POINTS.min(fitting(seconds) / ALIGN_SHARE), 0);
            let asked = anchors.len();
            self.ask_anchors(anchors, answers.asked + asked, &mut answers)?;
            if asked >= CHUNK.0 {
                seconds = mark.elapsed().as_secs_f64() / asked as f64;
            }
        }
        let all = fitting(seconds).min(self.all_wanted().saturating_sub(answers.readings.len()));
        if all < CHUNK.0 {
            return Ok(answers);
        }
        let fine = stride_within(region.width, region.height, all.div_ceil(2).max(COARSE)).min(stride);
        let asked: HashSet<(usize, usize)> = answers.readings.iter().map(|(pixel, _)| *pixel).collect();
        let mut pixels = self.wanted_of(coarse_to_fine, fine);
        pixels.retain(|pixel| !asked.contains(pixel));
        if !self.ask_while(&clock, refine, &mut seconds, &pixels, &mut answers)? {
            answers.spacing = self.spacing_of(answers.readings.len());
            return Ok(answers);
        }
        answers.spacing = fine;
        let more = self.refinement(fine, &answers, fitting(seconds));
        self.ask_while(&clock, refine, &mut seconds, &more, &mut answers)?;
        Ok(answers)
    }

    /// Asks pixels until the time is over; whether all were asked. `seconds` for one answer follow what is seen.
    pub(super) fn ask_while(
        &self,
        clock: &Clock,
        refine: f64,
        seconds: &mut f64,
        pixels: &[(usize, usize)],
        into: &mut Answers,
    ) -> Result<bool> {
        let (planned, spacing) = (into.asked + pixels.len(), into.spacing);
        let mut rest = pixels;
        while !rest.is_empty() {
            let fits = clock.fits(refine, *seconds);
            let tick = (TICK * clock.all() / seconds.max(1e-9)) as usize;
            let count = tick.clamp(CHUNK.0, CHUNK.1).min(rest.len());
            if fits < count as f64 {
                return Ok(false);
            }
            let (now, later) = rest.split_at(count);
            let mark = Instant::now();
            self.ask_plan(now, planned, into)?;
            *seconds = 0.5 * (*seconds + mark.elapsed().as_secs_f64() / count as f64);
            rest = later;
            // In a frame that follows another one, what is carried comes last: there is no whole map before.
            if self.options.preview.is_some() && !into.follows {
                into.spacing = self.spacing_of(into.readings.len());
                self.look(into, planned);
                into.spacing = spacing;
            }
        }
        Ok(true)
    }

    /// Shows what there is.
    fn look(&self, answers: &Answers, planned: usize) {
        if let Some(preview) = &self.options.preview {
            let map = || Ok(self.dense(answers)?.0);
            preview(&Partial::new(Progress { answered: answers.asked, planned }, &map));
        }
    }
}
