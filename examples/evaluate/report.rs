//! From the frames' files to tables. Everything is read back from the files, also right after they were written, so that a report
//! cannot depend on how the work was divided.

use crate::record::{self, Named, Record, read_json, write_json, write_whole};
use crate::settings::Settings;
use crate::speed::Speed;
use anyhow::{Context, ensure};
use sdim::metrics::{Interval, METRICS, RelativeError, bootstrap_mean, bootstrap_ratio};
use serde::Serialize;
use std::fmt::Write as _;
use std::io::Write as _;
use std::iter::zip;
use std::path::{Path, PathBuf};

mod markdown;

/// Seed of the bootstrap; the same for all, so that methods are compared on the same draws.
const SEED: u64 = 0;

/// The method that others are compared with, where it is among them.
const REFERENCE: &str = "linear";

/// Errors that are compared frame by frame: their names in files, and in tables.
const RELATIVE: [(&str, &str); 4] =
    [("mae", "MAE"), ("rmse", "RMSE"), ("abs_rel", "AbsRel"), ("gradient_error", "GE")];

/// What was found, by number of points.
#[derive(Debug, Serialize)]
pub struct Tables {
    pub settings: Settings,
    pub tables: Vec<Table>,
}

/// All methods with one number of points.
#[derive(Debug, Serialize)]
pub struct Table {
    /// As asked for; 0: those of the data set.
    pub points: usize,
    /// Frames scored.
    pub frames: usize,
    /// Frames that could not be scored, in no mean and in no count.
    pub skipped: Vec<Skipped>,
    /// Mean number of measured pixels.
    pub measured: f64,
    /// Frames whose measurements came with the data set, whatever `points` says.
    pub own: usize,
    /// The method that `mae_ratio` and `relative` compare with: `linear`, or the first of the table where that was not run.
    pub reference: String,
    pub methods: Vec<MethodTable>,
}

/// A frame without scores.
#[derive(Clone, Debug, Serialize)]
pub struct Skipped {
    pub frame: String,
    pub reason: String,
}

/// One method: means over frames with 95 % confidence intervals.
#[derive(Debug, Serialize)]
pub struct MethodTable {
    pub name: String,
    pub metrics: Named<Interval>,
    pub gradient_error: Option<Interval>,
    /// Mean MAE over that of the reference, frames drawn in pairs.
    pub mae_ratio: Option<Interval>,
    /// Errors by those of the reference on the same frame: MAE, RMSE, AbsRel and gradient error.
    pub relative: Named<RelativeError>,
    /// Pixels with truth that were left out.
    pub missing: usize,
    pub regions: Vec<RegionTable>,
    /// Means over frames; empty for a method without confidence.
    pub confidence: Named<f64>,
}

/// Means over the frames that have such pixels.
#[derive(Debug, Serialize)]
pub struct RegionTable {
    pub name: String,
    pub frames: usize,
    pub pixels: usize,
    pub mae: f64,
    pub rmse: f64,
    pub abs_rel: f64,
}

/// The tables, the frames' lines, and what is not the same twice.
pub struct Report {
    pub tables: Tables,
    pub speed: Speed,
    csv: tempfile::NamedTempFile,
}

impl Report {
    /// Of folders that together hold all frames.
    pub fn read(dirs: &[PathBuf]) -> anyhow::Result<Self> {
        let settings = Settings::read(&dirs[0])?;
        for dir in &dirs[1..] {
            settings.expect(&Settings::read(dir)?, &dir.join(record::SETTINGS))?;
        }
        let mut csv = tempfile::NamedTempFile::new()?;
        let names = METRICS.iter().map(|m| m.name).collect::<Vec<_>>().join(",");
        writeln!(csv, "points,frame,method,measured,pixels,missing,{names},gradient_error")?;
        let (mut speed, mut tables) = (Speed::default(), Vec::new());
        for &points in &settings.points {
            let mut sums = Sums::default();
            let absent: Vec<usize> = (0..settings.frames)
                .filter(|&index| !dirs.iter().any(|d| record::path(d, points, index).is_file()))
                .collect();
            ensure!(
                absent.is_empty(),
                "{} of {} frames with {points} points are not done, the first is number {}; run the shards that are missing",
                absent.len(),
                settings.frames,
                absent[0]
            );
            for index in 0..settings.frames {
                let record = find(dirs, points, index)?;
                speed.add(points, &record);
                lines(&mut csv, points, &record)?;
                sums.add(record);
            }
            tables.push(sums.table(points, &settings));
        }
        csv.flush()?;
        Ok(Self { tables: Tables { settings, tables }, speed, csv })
    }

    /// Writes report.md, report.json, frames.csv and speed.json.
    pub fn write(&self, out: &Path) -> anyhow::Result<()> {
        write_whole(&out.join("report.md"), self.markdown().as_bytes())?;
        write_json(&out.join("report.json"), &self.tables)?;
        write_json(&out.join("speed.json"), &self.speed)?;
        // Through a name of its own, so that a reader never sees half of it.
        let (part, csv) = (out.join(".frames.csv.part"), out.join("frames.csv"));
        let copied = std::fs::copy(self.csv.path(), &part).and_then(|_| std::fs::rename(&part, &csv));
        copied.with_context(|| csv.display().to_string())
    }

    pub fn markdown(&self) -> String {
        markdown::markdown(&self.tables)
    }
}

fn find(dirs: &[PathBuf], points: usize, index: usize) -> anyhow::Result<Record> {
    for dir in dirs {
        if let Some(record) = read_json(&record::path(dir, points, index))? {
            return Ok(record);
        }
    }
    anyhow::bail!("frame number {index} with {points} points went away while it was read")
}

fn lines(csv: &mut impl std::io::Write, points: usize, record: &Record) -> anyhow::Result<()> {
    // A name may hold anything that a file name may.
    let name = format!("\"{}\"", record.name.replace('"', "\"\""));
    for s in &record.scores {
        let mut line = format!(
            "{points},{name},{},{},{},{}",
            s.method, record.measured, s.errors.pixels, s.errors.missing
        );
        for metric in METRICS {
            write!(line, ",{}", (metric.of)(&s.errors))?;
        }
        let gradient = s.gradient_error.map_or(String::new(), |g| g.to_string());
        writeln!(csv, "{line},{gradient}")?;
    }
    Ok(())
}

/// One method's values, frame by frame: what the bootstrap needs, and no more.
#[derive(Default)]
struct Values {
    name: String,
    metrics: [Vec<f64>; METRICS.len()],
    gradient_error: Vec<Option<f64>>,
    missing: usize,
    regions: Vec<RegionTable>,
    confidence: Named<(f64, usize)>,
}

#[derive(Default)]
struct Sums {
    frames: usize,
    skipped: Vec<Skipped>,
    measured: usize,
    own: usize,
    methods: Vec<Values>,
}

impl Sums {
    fn add(&mut self, record: Record) {
        if let Some(reason) = record.skipped {
            self.skipped.push(Skipped { frame: record.name, reason });
            return;
        }
        self.frames += 1;
        self.measured += record.measured;
        self.own += usize::from(record.own);
        for scores in record.scores {
            let at = self.methods.iter().position(|m| m.name == scores.method).unwrap_or_else(|| {
                self.methods.push(Values { name: scores.method.clone(), ..Values::default() });
                self.methods.len() - 1
            });
            self.methods[at].add(scores);
        }
    }

    fn table(&self, points: usize, settings: &Settings) -> Table {
        let named = |name: &str| self.methods.iter().find(|m| m.name == name);
        let reference = named(REFERENCE).or(self.methods.first());
        Table {
            points,
            frames: self.frames,
            skipped: self.skipped.clone(),
            measured: self.measured as f64 / self.frames.max(1) as f64,
            own: self.own,
            reference: reference.map_or(String::new(), |r| r.name.clone()),
            methods: (settings.methods.iter())
                .filter_map(|(name, _)| Some(named(name)?.table(reference?)))
                .collect(),
        }
    }
}

impl Values {
    fn add(&mut self, scores: record::Scores) {
        for (list, metric) in self.metrics.iter_mut().zip(METRICS) {
            list.push((metric.of)(&scores.errors));
        }
        self.gradient_error.push(scores.gradient_error);
        self.missing += scores.errors.missing;
        for (name, errors) in scores.regions {
            let at = self.regions.iter().position(|r| r.name == name).unwrap_or_else(|| {
                self.regions.push(RegionTable {
                    name,
                    frames: 0,
                    pixels: 0,
                    mae: 0.0,
                    rmse: 0.0,
                    abs_rel: 0.0,
                });
                self.regions.len() - 1
            });
            if let Some(errors) = errors {
                let region = &mut self.regions[at];
                region.frames += 1;
                region.pixels += errors.pixels;
                region.mae += errors.mae;
                region.rmse += errors.rmse;
                region.abs_rel += errors.abs_rel;
            }
        }
        for (name, value) in scores.confidence.iter().flat_map(|c| c.values()) {
            let sum = self.confidence.entry(name.to_string()).or_default();
            *sum = (sum.0 + value, sum.1 + 1);
        }
    }

    fn table(&self, reference: &Values) -> MethodTable {
        let metrics = METRICS.iter().zip(&self.metrics);
        let region = |r: &RegionTable| {
            let n = r.frames as f64;
            let (name, mae, rmse, abs_rel) = (r.name.clone(), r.mae / n, r.rmse / n, r.abs_rel / n);
            RegionTable { name, frames: r.frames, pixels: r.pixels, mae, rmse, abs_rel }
        };
        let gradients: Vec<f64> = self.gradient_error.iter().copied().flatten().collect();
        MethodTable {
            name: self.name.clone(),
            metrics: metrics
                .filter_map(|(m, values)| Some((m.name.to_string(), bootstrap_mean(values, SEED)?)))
                .collect(),
            gradient_error: bootstrap_mean(&gradients, SEED),
            mae_ratio: bootstrap_ratio(&self.metrics[0], &reference.metrics[0], SEED),
            relative: self.relative(reference),
            missing: self.missing,
            regions: self.regions.iter().filter(|r| r.frames > 0).map(region).collect(),
            confidence: self.confidence.iter().map(|(k, (s, n))| (k.clone(), s / *n as f64)).collect(),
        }
    }

    /// Frame by frame: all methods were scored on the same frames, in the same order.
    fn relative(&self, reference: &Values) -> Named<RelativeError> {
        let pairs = |name: &str| -> Vec<(f64, f64)> {
            match METRICS.iter().position(|m| m.name == name) {
                Some(at) => zip(&self.metrics[at], &reference.metrics[at]).map(|(&e, &r)| (e, r)).collect(),
                // The one that is no member of `Errors`.
                None => zip(&self.gradient_error, &reference.gradient_error)
                    .filter_map(|(e, r)| e.zip(*r))
                    .collect(),
            }
        };
        let of = |name: &str| Some((name.to_string(), RelativeError::over(&pairs(name), SEED)?));
        RELATIVE.iter().filter_map(|(name, _)| of(name)).collect()
    }
}
