//! The frames that all cells share, and the questions about them.

use crate::cells::Cell;
use crate::common::HELD_OUT;
use crate::run::Plan;
use anyhow::Context;
use rand::Rng;
use rand::seq::SliceRandom;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use rayon::prelude::*;
use sdim::depth::{interpolate, sample_points};
use sdim::internals::model::SdimModel;
use sdim::internals::scenes::furnished::{Library, Split, furnished};
use sdim::internals::scenes::{RgbdFrame, procedural};
use sdim::internals::supervise::{self, Asking, Example, LabelSource, Scenes, mix, training_seed, written};
use sdim::settings::PixelReference;
use sdim::{RgbImage, SparseDepth};
use std::path::Path;

/// Columns and rows.
pub const SIZE: (usize, usize) = (96, 64);
/// Measurements of each frame, as in the paper's table.
const POINTS: usize = 150;
/// Share of the measurements that are asked and not told where labels are made of them.
const HELD_BACK: f64 = 0.3;
/// Share of the questions that are about told measurements: the mask sentence has two kinds of pixels.
const MEASURED: f64 = 0.25;

/// A frame with its measurements, which stay the same however often it is seen.
pub struct Measured {
    pub frame: RgbdFrame,
    pub sparse: SparseDepth,
}

/// A frame that scores, and the pixels that are asked of it.
pub struct Test {
    pub measured: Measured,
    /// Column, row, true depth, what linear interpolation says there.
    pub asked: Vec<(usize, usize, f32, f32)>,
    pub furnished: bool,
}

pub struct Frames {
    train: Vec<Measured>,
    pub tests: Vec<Test>,
}

fn measured(frame: RgbdFrame, seed: u64) -> sdim::Result<Measured> {
    let sparse = sample_points(&frame.depth, SIZE.0, SIZE.1, POINTS, seed)?;
    Ok(Measured { frame, sparse })
}

impl Frames {
    /// Frames to train on, and frames of scenes, rooms and furniture that are held out.
    pub fn render(plan: &Plan, library: Option<&Path>) -> anyhow::Result<Self> {
        let library = library.map(Library::open).transpose()?;
        let mut scenes = Scenes::new(match library {
            Some(_) => "procedural=0.5,furnished=0.5".parse()?,
            None => "procedural=1".parse()?,
        });
        if let Some(library) = &library {
            scenes = scenes.with_library(library, false)?;
        }
        let one = |i: u64| measured(supervise::frame(&scenes, training_seed(mix(1, i)), SIZE)?, i);
        let train = (0..plan.frames).into_par_iter().map(one).collect::<sdim::Result<_>>()?;
        let held = library.map(|l| l.part(Split::HeldOut)).transpose()?;
        let test = |i: u64| -> anyhow::Result<Test> {
            let furnished_one = held.is_some() && i % 2 == 1;
            let frame = match &held {
                Some(library) if furnished_one => furnished(library, HELD_OUT + i, SIZE.0, SIZE.1)?,
                _ => procedural(HELD_OUT + i, SIZE.0, SIZE.1)?,
            };
            Test::new(measured(frame, HELD_OUT + i)?, plan.questions_of_tests, furnished_one, i)
        };
        let tests = (0..plan.tests).into_par_iter().map(test).collect::<anyhow::Result<_>>()?;
        Ok(Self { train, tests })
    }

    pub fn count(&self) -> usize {
        self.train.len() + self.tests.len()
    }

    /// What linear interpolation answers, frame by frame.
    pub fn linear(&self) -> Vec<crate::run::Score> {
        self.tests.iter().map(|t| t.score(t.asked.iter().map(|q| q.3))).collect()
    }

    /// The examples of a step. Frames, measurements and questions of a step are the same in all cells, as far as labels allow.
    pub fn examples(
        &self,
        cell: &Cell,
        plan: &Plan,
        model: &SdimModel,
        seed: u64,
        step: u64,
    ) -> sdim::Result<Vec<Example>> {
        let count = self.train.len() as u64;
        let first = step * plan.batch as u64;
        let one = |number: u64| {
            let mut order: Vec<usize> = (0..self.train.len()).collect();
            order.shuffle(&mut ChaCha8Rng::seed_from_u64(mix(seed, number / count)));
            let mut rng = ChaCha8Rng::seed_from_u64(mix(seed ^ 0xAB1A, number));
            let seen = &self.train[order[(number % count) as usize]];
            seen.example(cell, plan, model, &mut rng)
        };
        (first..first + plan.batch as u64).into_par_iter().map(one).collect()
    }
}

impl Measured {
    fn example(
        &self,
        cell: &Cell,
        plan: &Plan,
        model: &SdimModel,
        rng: &mut ChaCha8Rng,
    ) -> sdim::Result<Example> {
        let mut points: Vec<(usize, usize, f32)> = self.sparse.points().collect();
        let (told, labels) = match cell.labels {
            LabelSource::Dense => (self.sparse.clone(), None),
            LabelSource::Sparse => {
                points.shuffle(rng);
                let held = points.split_off((points.len() as f64 * (1.0 - HELD_BACK)) as usize);
                (SparseDepth::from_points(SIZE.0, SIZE.1, &points)?, Some(held))
            }
        };
        let valid: Vec<usize> =
            (0..self.frame.depth.len()).filter(|&i| self.frame.depth[i].is_finite()).collect();
        let mut ask = || match &labels {
            _ if rng.random_bool(MEASURED) => points[rng.random_range(0..points.len())],
            Some(held) => held[rng.random_range(0..held.len())],
            None => {
                let i = valid[rng.random_range(0..valid.len())];
                (i % SIZE.0, i / SIZE.0, self.frame.depth[i])
            }
        };
        let asking = Asking::from(model);
        if let PixelReference::Marker(marker) = cell.settings.pixel_reference {
            // Each question has a picture of its own: one of each frame.
            let question = ask();
            let mut rgb: RgbImage = self.frame.rgb.clone();
            marker.draw(&mut rgb, question.0, question.1);
            return written(asking, &rgb, &told, usize::MAX, &[question], rng.random());
        }
        let asked: Vec<_> = (0..plan.questions).map(|_| ask()).collect();
        written(asking, &self.frame.rgb, &told, usize::MAX, &asked, rng.random())
    }
}

impl Test {
    fn new(measured: Measured, count: usize, furnished: bool, seed: u64) -> anyhow::Result<Self> {
        let linear = interpolate::linear(&measured.sparse)?;
        let depth = &measured.frame.depth;
        let open: Vec<usize> = (0..depth.len())
            .filter(|&i| depth[i].is_finite() && measured.sparse.as_slice()[i].is_nan())
            .collect();
        let mut rng = ChaCha8Rng::seed_from_u64(mix(2, seed));
        let draw = |_| -> anyhow::Result<_> {
            let i =
                *open.get(rng.random_range(0..open.len().max(1))).context("a frame without open pixels")?;
            Ok((i % SIZE.0, i / SIZE.0, depth[i], linear[i]))
        };
        let asked = (0..count).map(draw).collect::<anyhow::Result<_>>()?;
        Ok(Self { measured, asked, furnished })
    }

    /// Errors of answers, in the mean true depth of the pixels that are asked.
    pub fn score(&self, answers: impl Iterator<Item = f32>) -> crate::run::Score {
        let (mut off, mut square, mut depth) = (0f64, 0f64, 0f64);
        for (answer, asked) in answers.zip(&self.asked) {
            let error = f64::from(answer - asked.2);
            (off, square, depth) = (off + error.abs(), square + error * error, depth + f64::from(asked.2));
        }
        let n = self.asked.len() as f64;
        let depth = depth / n;
        crate::run::Score {
            mae: off / n / depth,
            rmse: (square / n).sqrt() / depth,
            furnished: self.furnished,
        }
    }
}
