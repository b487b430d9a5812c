//! Scores frame after frame. Nothing of a frame stays in memory once its file is written.

use crate::methods::{Answer, Method};
use crate::record::{self, Confidence, Cost, Record, Scores, read_json, write_json};
use crate::report::Report;
use crate::settings::Settings;
use crate::{Args, Score, Shard, figures, frames, methods, speed};
use anyhow::Context;
use indicatif::{ProgressBar, ProgressStyle};
use sdim::SparseDepth;
use sdim::benchmarks::{Dataset, Sample, frame_seed};
use sdim::metrics::{
    DISTANCE_LIMITS, EdgeRule, Regions, errors, errors_everywhere, errors_in, gradient_error,
    score_confidence,
};
use std::path::{Path, PathBuf};
use std::time::Instant;

/// What the confidence of a map speaks of: truth within 5 % of the answer.
const CONFIDENT_WITHIN: f64 = 0.05;

/// Runs what is not done yet. The report, unless this was a shard of something larger.
pub fn run(args: &Args) -> anyhow::Result<Option<Report>> {
    // What is cheap to check comes first: a checkpoint may take minutes to load.
    args.pattern()?;
    let frames = frames::open(args)?;
    args.points(frames::all_own(args, frames.as_ref())?)?;
    let methods = methods::load_all(args)?;
    let settings = Settings::new(args, frames.as_ref(), &methods)?;
    // Removed at the end, where nothing is to be kept.
    let temporary = tempfile::tempdir()?;
    let out = args.out.clone().unwrap_or_else(|| temporary.path().to_path_buf());
    settings.enter(&out)?;
    let shard = args.shard.unwrap_or(Shard { index: 0, of: 1 });
    let mine: Vec<usize> = (shard.index..settings.frames).step_by(shard.of).collect();
    let bar = ProgressBar::new((mine.len() * settings.points.len()) as u64);
    bar.set_style(ProgressStyle::with_template("{bar:40} {pos}/{len} frames, {eta} left {msg}")?);
    for index in mine {
        for &points in &settings.points {
            let task = Task { args, methods: &methods, frames: frames.as_ref(), index, points };
            bar.set_message(frames.name(index));
            if let Some(line) = task.finish(&out)? {
                bar.suspend(|| eprintln!("{line}"));
            }
            bar.inc(1);
        }
    }
    bar.finish_and_clear();
    if shard.of > 1 {
        let n = (shard.index..settings.frames).step_by(shard.of).count();
        eprintln!(
            "shard {}/{}: {n} frames done; when all are, --merge makes the report",
            shard.index, shard.of
        );
        return Ok(None);
    }
    Report::read(&[out]).map(Some)
}

/// One frame with one number of points.
struct Task<'a> {
    args: &'a Args,
    methods: &'a [Method],
    frames: &'a dyn Dataset,
    index: usize,
    points: usize,
}

impl Task<'_> {
    fn figure(&self) -> Option<PathBuf> {
        let dir = self.args.figures.as_ref().filter(|_| self.index < self.args.figure_frames)?;
        Some(dir.join(format!("{}-{}.png", self.frames.name(self.index), self.points)))
    }

    /// Makes the frame's file unless it is there; a line to show, if wanted.
    fn finish(&self, out: &Path) -> anyhow::Result<Option<String>> {
        let path = record::path(out, self.points, self.index);
        let figure = self.figure().filter(|f| !f.exists());
        // A frame that was skipped has no figure and never gets one.
        if read_json::<Record>(&path)?.is_some_and(|done| figure.is_none() || done.skipped.is_some()) {
            return Ok(None);
        }
        let name = self.frames.name(self.index);
        let record = self.score(figure.as_deref()).with_context(|| format!("frame {name}"))?;
        write_json(&path, &record)?;
        let maes = record.scores.iter().map(|s| format!("{} {:.4}", s.method, s.errors.mae));
        let line = maes.collect::<Vec<_>>().join("  ");
        Ok(match &record.skipped {
            Some(reason) => Some(format!("{name}, {} points: skipped: {reason}", self.points)),
            None => self.args.verbose.then(|| format!("{name}, {} points: MAE {line}", self.points)),
        })
    }

    fn score(&self, figure: Option<&Path>) -> anyhow::Result<Record> {
        let mut sample = self.frames.load(self.index)?;
        if self.args.resample {
            sample.sparse = None;
        }
        let (width, height) = (sample.rgb.width() as usize, sample.rgb.height() as usize);
        let mut record = Record {
            index: self.index,
            name: sample.name.clone(),
            width,
            height,
            measured: 0,
            own: sample.sparse.is_some(),
            skipped: None,
            scores: Vec::new(),
            cost: Vec::new(),
        };
        if !sample.gt.iter().any(|d| d.is_finite() && *d > 0.0) {
            record.skipped = Some("no ground truth".to_string());
            return Ok(record);
        }
        let seed = frame_seed(self.args.seed, self.index);
        let sparse = sample.measurements(self.points, self.args.pattern()?, seed)?;
        record.measured = sparse.measured();
        if sparse.measured() == 0 {
            record.skipped = Some("no measurement".to_string());
            return Ok(record);
        }
        let frame = Frame::new(sample, sparse, self.args.score)?;
        if frame.score == Score::Unseen && !frame.unseen {
            record.skipped = Some("no pixel left to predict".to_string());
            return Ok(record);
        }
        let mut drawn = Vec::new();
        for method in self.methods {
            let (answer, cost) = measure(|| method.complete(&frame.sample.rgb, &frame.sparse))?;
            record.scores.push(frame.judge(method, &answer)?);
            record.cost.push(cost);
            if figure.is_some() {
                drawn.push((method.name.clone(), answer.depth().to_vec()));
            }
        }
        if let Some(path) = figure {
            figures::write(path, &frame.sample, &frame.sparse, &drawn, self.args.figure_tile)?;
        }
        Ok(record)
    }
}

fn measure(work: impl FnOnce() -> sdim::Result<Answer>) -> anyhow::Result<(Answer, Cost)> {
    speed::forget_peak();
    let start = Instant::now();
    let answer = work()?;
    let seconds = start.elapsed().as_secs_f64();
    Ok((answer, Cost { seconds, peak_bytes: sdim::system::peak_rss_bytes() }))
}

/// What answers are compared with.
struct Frame {
    sample: Sample,
    sparse: SparseDepth,
    score: Score,
    /// Whether any pixel has ground truth and was not measured.
    unseen: bool,
    /// Taken apart by distance, at edges, and by the masks that the data set has; measured pixels are in none.
    regions: Vec<Regions>,
}

impl Frame {
    fn new(sample: Sample, sparse: SparseDepth, score: Score) -> sdim::Result<Self> {
        let mut regions = vec![
            Regions::by_distance(&sparse, &DISTANCE_LIMITS)?,
            Regions::at_edges(&sample.gt, &sparse, &EdgeRule::default())?,
        ];
        for mask in &sample.masks {
            regions.push(Regions::by_mask(mask.name, &mask.pixels, &sparse)?);
        }
        let to_predict = |(t, s): (&f32, &f32)| t.is_finite() && *t > 0.0 && s.is_nan();
        let unseen = sample.gt.iter().zip(sparse.as_slice()).any(to_predict);
        Ok(Self { sample, sparse, score, unseen, regions })
    }

    fn judge(&self, method: &Method, answer: &Answer) -> anyhow::Result<Scores> {
        let (depth, truth, sparse) = (answer.depth(), &self.sample.gt, &self.sparse);
        let mut regions = Vec::new();
        for part in &self.regions {
            regions.extend(part.names().iter().cloned().zip(errors_in(depth, truth, part)?));
        }
        let confidence = match answer {
            Answer::Map(map) if self.unseen => {
                Some(Confidence::from(score_confidence(map, truth, CONFIDENT_WITHIN)?))
            }
            Answer::Map(_) | Answer::Depth(_) => None,
        };
        let errors = match self.score {
            Score::Unseen => errors(depth, truth, sparse),
            Score::All => errors_everywhere(depth, truth),
        };
        Ok(Scores {
            method: method.name.clone(),
            errors: errors.with_context(|| method.name.clone())?,
            gradient_error: gradient_error(depth, truth, sparse.width(), sparse.height())?,
            regions,
            confidence,
        })
    }
}
