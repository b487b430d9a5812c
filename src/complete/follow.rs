//! Which pixels are asked in a frame of which a map is expected already.

use super::alignment::{Alignment, Anchors};
use super::cells::{Cell, Cells};
use super::clock::Clock;
use super::pace::Seconds;
use super::prior::Prior;
use super::questions::{Answers, Questions, answered, scaled};
use super::schedule::{TimeLeft, shuffled};
use crate::error::Result;
use crate::query::plan::stride_within;
use crate::query::told::choose_evenly;
use crate::query::{QueryPlan, Reading};
use crate::refine::Answered;
use std::collections::HashSet;

/// One of so many rows and columns of the lattice is asked as a check.
const CHECK: usize = 4;
/// Measurements asked for the alignment of new answers: one for so many questions, and at least and at most so many.
const ANCHOR_SHARE: usize = 4;
const ANCHORS: (usize, usize) = (64, 2048);
/// How far a measurement lies from what is expected around it when that is wrong, in log depth. Four frames of one sequence, 96x72 with 40
/// measurements: 236 questions a frame and MAE 0.85 of that of frames alone with 0.25 and one cell around, 281 and 0.90 with 0.1 and two
/// cells, the first frame (471 questions) included.
pub(super) const MEASURED_APART: f32 = 0.25;
/// How far an answer lies from what is expected when that is wrong, in log depth: this, and so many expected errors of both.
const APART: f32 = 0.1;
const PER_ERROR: f32 = 1.5;
/// An answer and what was expected are averaged unless they lie farther apart, in log depth.
const ALIKE: f32 = 0.1;
/// Added to relative expected errors before they are weighed.
const DOUBT: f32 = 0.03;
/// Cells around a wrong one that are forgotten with it.
const AROUND: usize = 1;
/// The lattice's stride under a deadline.
const FOLLOWED: usize = 4;

impl Questions<'_> {
    /// Asks where the expected map is unknown, unsure, has an edge or is contradicted, and some pixels everywhere as a check; elsewhere
    /// the expected depths are taken.
    pub(super) fn ask_following(
        &self,
        prior: &Prior,
        clock: Option<Clock>,
        pace: Seconds,
    ) -> Result<Answers> {
        let (width, height) = self.size();
        let region = self.region();
        let stride = match self.options.plan {
            QueryPlan::Every => 1,
            QueryPlan::Stride(n) => n.max(1),
            QueryPlan::Budget(n) => stride_within(region.width, region.height, n),
            QueryPlan::Deadline(_) => FOLLOWED,
        };
        let mut cells = Cells::new(prior, width, region, stride);
        let anchors = self.compared(prior, &mut cells);
        let alignment = match self.options.align {
            true => Alignment::new(anchors, width, height)?,
            false => None,
        };
        let mut answers = Answers { spacing: stride, follows: true, ..Default::default() };
        let mut time = clock.map(|clock| TimeLeft {
            clock,
            refining: pace.refining(width * height),
            answer: pace.answer,
        });
        // Where the time may end before the pixels do, those that were asked are to be spread over the frame, and others in each frame.
        let ask = |pixels: Vec<(usize, usize)>, into: &mut Answers, time: &mut Option<TimeLeft>| match time {
            Some(time) => self.ask_while(time, &shuffled(pixels, prior.turn), into),
            None => self.ask_plan(&pixels, into.asked + pixels.len(), into).map(|()| true),
        };
        let due = |(i, cell): &(usize, &Cell)| {
            (cell.ask || cells.checked(*i, CHECK, prior.turn)) && self.wanted(cell.pixel)
        };
        let first: Vec<_> = cells.iter().enumerate().filter(due).map(|(_, cell)| cell.pixel).collect();
        if self.options.align {
            let most = time.as_ref().map_or(usize::MAX, |time| time.fits() / ANCHOR_SHARE);
            let count = (first.len() / ANCHOR_SHARE).clamp(ANCHORS.0, ANCHORS.1).min(most);
            let measured = choose_evenly(self.sparse, count, 0);
            let planned = measured.len() + first.len();
            match &mut time {
                Some(time) => self.anchors_while(time, measured, planned, &mut answers)?,
                None => self.ask_anchors(&measured, planned, &mut answers)?,
            }
        }
        let asked: HashSet<(usize, usize)> = first.iter().copied().collect();
        let mut whole = ask(first, &mut answers, &mut time)?;
        let by_answers = self.alignment(&answers)?;
        answers.settled = self.aligned_by(by_answers.as_ref(), &std::mem::take(&mut answers.readings));
        for answer in &answers.settled {
            let cell = cells.at((answer.x, answer.y));
            if !cells.get(cell).ask && contradicts(prior, answer.y * width + answer.x, answer) {
                cells.forget(cell, AROUND);
            }
        }
        let late = |cell: &&Cell| cell.ask && !asked.contains(&cell.pixel) && self.wanted(cell.pixel);
        let second: Vec<_> = cells.iter().filter(late).map(|cell| cell.pixel).collect();
        whole &= ask(second, &mut answers, &mut time)?;
        let late = self.aligned_by(by_answers.as_ref(), &std::mem::take(&mut answers.readings));
        answers.settled.extend(late);
        self.settle(prior, &cells, alignment.as_ref(), &mut answers);
        if !whole {
            let known = answers.settled.len() + answers.carried.len();
            answers.spacing = self.spacing_of(known).max(stride);
        }
        Ok(answers)
    }

    /// Compares measurements with what is expected at their pixels: what they contradict is forgotten, the others are what the expected map
    /// is aligned by.
    fn compared(&self, prior: &Prior, cells: &mut Cells) -> Anchors {
        let (width, height) = self.size();
        let mut anchors = Anchors::default();
        for (x, y, measured) in self.sparse.points().filter(|&(x, y, _)| self.region().contains(x, y)) {
            let near = |&expected: &f32| (measured / expected).ln().abs() <= MEASURED_APART;
            let expected = prior.depth[y * width + x];
            if near(&expected) {
                let value = Reading { value: expected, confidence: 1.0, expected_error: 0.0 };
                anchors.push((x, y, measured), &value);
                continue;
            }
            // Beside an edge it may be a pixel off.
            let rows = y.saturating_sub(1)..(y + 2).min(height);
            let mut around =
                rows.flat_map(|v| (x.saturating_sub(1)..(x + 2).min(width)).map(move |u| (u, v)));
            let known = !expected.is_nan();
            if known && !around.any(|(u, v)| near(&prior.depth[v * width + u])) {
                cells.forget(cells.at((x, y)), AROUND);
            }
        }
        anchors
    }

    /// Puts answers and what was expected together.
    fn settle(&self, prior: &Prior, cells: &Cells, alignment: Option<&Alignment>, answers: &mut Answers) {
        let width = self.size().0;
        let expected = |pixel: usize| {
            let reading = Reading {
                value: prior.depth[pixel],
                confidence: prior.confidence[pixel],
                expected_error: prior.expected_error[pixel],
            };
            let at = (pixel % width, pixel / width);
            let moved = alignment.filter(|_| !reading.value.is_nan()).map(|a| a.apply(at, reading));
            answered(at, moved.unwrap_or(reading))
        };
        let mut said = HashSet::new();
        // What is expected was scaled with the last map, answers will be with this one.
        let unscaled = self.scale().undone();
        for answer in &mut answers.settled {
            said.insert((answer.x, answer.y));
            let cell = cells.get(cells.at((answer.x, answer.y)));
            let mut before = expected(answer.y * width + answer.x);
            scaled(&unscaled, &mut before);
            if !cell.forgotten && (answer.depth / before.depth).ln().abs() <= ALIKE {
                *answer = averaged(answer, &before);
            }
        }
        let kept = cells.iter().filter(|c| !(c.forgotten || c.ask && said.contains(&c.pixel)));
        let kept = kept.filter_map(|c| c.best).map(|(pixel, _)| expected(pixel));
        answers.carried = kept
            .filter(|a| self.wanted((a.x, a.y)) && !said.contains(&(a.x, a.y)) && a.depth.is_finite())
            .collect();
    }
}

/// Whether an answer says that what is expected at a pixel is wrong.
fn contradicts(prior: &Prior, pixel: usize, answer: &Answered) -> bool {
    let (depth, error) = (prior.depth[pixel], prior.expected_error[pixel]);
    let allowed = APART + PER_ERROR * (answer.expected_error / answer.depth + error / depth);
    (answer.depth / depth).ln().abs() > allowed
}

/// Both together, each as far as it is sure.
fn averaged(answer: &Answered, before: &Answered) -> Answered {
    let weight = |a: &Answered| (DOUBT + a.expected_error / a.depth).powi(-2);
    let share = weight(before) / (weight(before) + weight(answer));
    let mix = |a: f32, b: f32| a + share * (b - a);
    Answered {
        depth: mix(answer.depth, before.depth),
        confidence: mix(answer.confidence, before.confidence).clamp(0.0, 1.0),
        expected_error: mix(answer.expected_error, before.expected_error),
        ..*answer
    }
}
