//! In which order the pixels of a frame are asked, and when that ends.

use super::adaptive::ROUNDS;
use super::clock::Clock;
use super::options::{Partial, Progress};
use super::pace::Seconds;
use super::questions::{Answers, Questions};
use crate::error::Result;
use crate::query::QueryPlan;
use crate::query::plan::{coarse_to_fine, lattice, stride_within};
use crate::query::told::choose_evenly;
use rand::SeedableRng;
use rand::seq::SliceRandom;
use rand_chacha::ChaCha8Rng;
use std::collections::HashSet;

/// Measurements asked for the alignment, at most; more are chosen spatially even.
const ALIGN_POINTS: usize = 2048;
/// Pixels asked between two looks at the map, where somebody looks.
const PREVIEW_CHUNK: usize = 4096;
/// Pixels of the first lattice under a deadline: enough for a map of rooms.
const COARSE: usize = 256;
/// One in so many questions of a budget is asked on a lattice, before it is known where they say the most.
const LATTICE_SHARE: usize = 5;
/// Share of the time under a deadline after which the clock is looked at again.
const TICK: f64 = 0.05;
/// Questions asked between two looks at the clock: so many at most; at least so many, for small batches are slow, as far as they take no more
/// than so many seconds; and so many before it is known what one takes.
const MOST: usize = 2048;
const LEAST: usize = 64;
const QUICK: f64 = 0.004;
const UNSEEN: usize = 4;
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
                stride_within(region.width, region.height, n.min(region.pixels()).div_ceil(LATTICE_SHARE))
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
        self.ask_anchors(&anchors, planned, &mut answers)?;
        self.ask_lattice(coarse, planned, &mut answers)?;
        if budget > 0 {
            self.ask_worst(budget, &mut answers)?;
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
        self.ask_anchors(&anchors, planned, &mut answers)?;
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

    /// Asks so many more pixels where they say the most.
    fn ask_worst(&self, budget: usize, into: &mut Answers) -> Result<()> {
        let planned = into.asked + budget;
        let mut left = budget;
        for rounds in (1..=ROUNDS).rev() {
            let pixels = self.worst(into, left.div_ceil(rounds))?;
            left -= pixels.len();
            self.ask_lattice(pixels, planned, into)?;
        }
        // What lies outside of all triangles, and what is left of a budget for nearly all pixels.
        let rest = if left > 0 { self.unasked(into, left) } else { Vec::new() };
        self.ask_lattice(rest, planned, into)
    }

    /// Asks as much as the time allows: a coarse lattice comes first, so that there is a whole map soon.
    fn ask_until(&self, clock: Clock, pace: Seconds) -> Result<Answers> {
        let (width, height) = self.size();
        let mut time = TimeLeft { clock, refining: pace.refining(width * height), answer: pace.answer };
        let region = self.region();
        let stride = stride_within(region.width, region.height, COARSE);
        let mut answers = Answers { spacing: stride, ..Default::default() };
        let coarse = self.wanted_of(coarse_to_fine, stride);
        if !self.ask_while(&mut time, &coarse, &mut answers)? || coarse.is_empty() {
            answers.spacing = self.spacing_of(answers.readings.len()).max(stride);
            return Ok(answers);
        }
        if self.options.align {
            let anchors = choose_evenly(self.sparse, ALIGN_POINTS.min(time.fits() / ALIGN_SHARE), 0);
            let planned = answers.asked + anchors.len();
            self.anchors_while(&mut time, anchors, planned, &mut answers)?;
        }
        let all = time.fits().min(self.all_wanted().saturating_sub(answers.readings.len()));
        let fine = stride_within(region.width, region.height, all.div_ceil(2).max(COARSE)).min(stride);
        let asked: HashSet<(usize, usize)> = answers.readings.iter().map(|(pixel, _)| *pixel).collect();
        let mut pixels = self.wanted_of(coarse_to_fine, fine);
        pixels.retain(|pixel| !asked.contains(pixel));
        if !self.ask_while(&mut time, &pixels, &mut answers)? {
            answers.spacing = self.spacing_of(answers.readings.len());
            return Ok(answers);
        }
        answers.spacing = fine;
        for rounds in (1..=ROUNDS).rev() {
            let pixels = self.worst(&answers, time.fits().div_ceil(rounds))?;
            if !self.ask_while(&mut time, &pixels, &mut answers)? {
                return Ok(answers);
            }
        }
        let rest = self.unasked(&answers, time.fits());
        self.ask_while(&mut time, &rest, &mut answers)?;
        Ok(answers)
    }

    /// Asks pixels until the time is over; whether all were asked.
    pub(super) fn ask_while(
        &self,
        time: &mut TimeLeft,
        pixels: &[(usize, usize)],
        into: &mut Answers,
    ) -> Result<bool> {
        let (planned, spacing) = (into.asked + pixels.len(), into.spacing);
        time.spend(pixels, into, |now, into| {
            self.ask_plan(now, planned, into)?;
            // In a frame that follows another one, what is carried comes last: there is no whole map before.
            if self.options.preview.is_some() && !into.follows {
                into.spacing = self.spacing_of(into.readings.len());
                self.look(into, planned);
                into.spacing = spacing;
            }
            Ok(())
        })
    }

    /// Asks measured pixels until the time is over, those of any moment spread over the frame.
    pub(super) fn anchors_while(
        &self,
        time: &mut TimeLeft,
        anchors: Vec<(usize, usize, f32)>,
        planned: usize,
        into: &mut Answers,
    ) -> Result<()> {
        time.spend(&shuffled(anchors, 0), into, |now, into| self.ask_anchors(now, planned, into))?;
        Ok(())
    }

    /// Shows what there is.
    fn look(&self, answers: &Answers, planned: usize) {
        if let Some(preview) = &self.options.preview {
            let map = || Ok(self.dense(answers)?.0);
            preview(&Partial::new(Progress { answered: answers.asked, planned }, &map));
        }
    }
}

/// The time that questions may take.
pub(super) struct TimeLeft<'a> {
    pub(super) clock: Clock<'a>,
    /// To keep for making a map of the answers, seconds.
    pub(super) refining: f64,
    /// What one answer takes, seconds; `None` before any was seen.
    pub(super) answer: Option<f64>,
}

impl TimeLeft<'_> {
    /// How many more answers fit; none while it is not known what one takes.
    pub(super) fn fits(&self) -> usize {
        // Less than nothing becomes 0.
        self.answer.map_or(0, |answer| self.clock.fits(self.refining, answer) as usize)
    }

    /// How many of so many questions are asked next; 0 when the time is over.
    fn next(&self, questions: usize) -> usize {
        let Some(answer) = self.answer else {
            let some = UNSEEN.min(questions);
            return if self.clock.left() > self.refining { some } else { 0 };
        };
        let within = |seconds: f64| (seconds / answer.max(1e-9)) as usize;
        let least = within(QUICK).clamp(1, LEAST);
        let count = within(TICK * self.clock.all()).clamp(least, MOST).min(questions);
        if self.fits() < count { 0 } else { count }
    }

    /// Has `ask` ask, a batch at a time, until the time is over; whether all were asked. What one answer takes follows what is seen.
    fn spend<T>(
        &mut self,
        mut questions: &[T],
        into: &mut Answers,
        mut ask: impl FnMut(&[T], &mut Answers) -> Result<()>,
    ) -> Result<bool> {
        while !questions.is_empty() {
            let (now, later) = questions.split_at(self.next(questions.len()));
            if now.is_empty() {
                return Ok(false);
            }
            let before = into.seconds;
            ask(now, into)?;
            let seen = (into.seconds - before) / now.len() as f64;
            self.answer = Some(self.answer.map_or(seen, |answer| 0.5 * (answer + seen)));
            questions = later;
        }
        Ok(true)
    }
}

/// In an order that is the same for the same seed, in which those of any moment are spread.
pub(super) fn shuffled<T>(mut items: Vec<T>, seed: usize) -> Vec<T> {
    items.shuffle(&mut ChaCha8Rng::seed_from_u64(seed as u64));
    items
}
