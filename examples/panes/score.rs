//! Errors at panes and elsewhere.

use anyhow::Context;
use sdim::SparseDepth;
use sdim::internals::scenes::RgbdFrame;
use sdim::metrics::RelativeError;
use serde_json::{Value, json};

/// The pane and what is behind it lie apart by this ratio where answers are said to be nearer to one of them.
const APART: f32 = 1.1;

/// One frame.
#[derive(Default)]
pub struct Frame {
    pane: Mean,
    elsewhere: Mean,
    /// Answers nearer to the pane than to what is behind it: at pixels that were not measured, and at those measured through it.
    near: Mean,
    near_measured: Mean,
    /// Measurements that were not believed, of those that were made through panes and of the others.
    flagged: Mean,
    flagged_wrongly: Mean,
}

/// A sum and a count.
#[derive(Default, Clone, Copy)]
struct Mean(f64, usize);

impl Mean {
    fn add(&mut self, value: f32) {
        self.0 += f64::from(value);
        self.1 += 1;
    }

    fn value(self) -> Option<f64> {
        (self.1 > 0).then(|| self.0 / self.1 as f64)
    }
}

/// Scores a map; `flagged` are the pixels whose measurements were not believed.
pub fn score(
    frame: &RgbdFrame,
    sparse: &SparseDepth,
    map: &[f32],
    flagged: &[usize],
) -> anyhow::Result<Frame> {
    let glass = frame.glass.as_ref().context("a frame without glass")?;
    let mut out = Frame::default();
    for (i, (&answer, &truth)) in map.iter().zip(&frame.depth).enumerate() {
        let (measured, behind) = (sparse.as_slice()[i], glass.behind[i]);
        let was_measured = !measured.is_nan();
        if was_measured {
            let doubted = f32::from(u8::from(flagged.contains(&i)));
            if glass.pane[i] && measured > APART * truth {
                out.flagged.add(doubted);
            } else {
                out.flagged_wrongly.add(doubted);
            }
        }
        if !(truth.is_finite() && answer.is_finite()) {
            continue;
        }
        if !was_measured {
            let part = if glass.pane[i] { &mut out.pane } else { &mut out.elsewhere };
            part.add((answer - truth).abs());
        }
        if glass.pane[i] && behind > APART * truth {
            let nearer = (answer / truth).ln().abs() < (answer / behind).ln().abs();
            let part = match was_measured {
                false => &mut out.near,
                true if measured > APART * truth => &mut out.near_measured,
                true => continue,
            };
            part.add(f32::from(u8::from(nearer)));
        }
    }
    Ok(out)
}

/// A method on all frames.
pub struct Scores {
    name: String,
    frames: Vec<Frame>,
}

impl Scores {
    pub fn new(name: &str) -> Self {
        Self { name: name.into(), frames: Vec::new() }
    }

    pub fn add(&mut self, frame: Frame) {
        self.frames.push(frame);
    }

    /// Mean over the frames that have any.
    fn mean(&self, part: impl Fn(&Frame) -> Mean) -> Option<f64> {
        let all: Vec<f64> = self.frames.iter().filter_map(|f| part(f).value()).collect();
        (!all.is_empty()).then(|| all.iter().sum::<f64>() / all.len() as f64)
    }

    /// Geometric mean over frames of the error by another method's.
    fn ratio(&self, other: &Self, part: impl Fn(&Frame) -> Mean) -> Option<[f64; 3]> {
        let pairs = self.frames.iter().zip(&other.frames);
        let pairs: Vec<_> = pairs.filter_map(|(a, b)| Some((part(a).value()?, part(b).value()?))).collect();
        let mean = RelativeError::over(&pairs, 0)?.geometric_mean?;
        Some([mean.value, mean.low, mean.high])
    }

    /// Beside those of `linear` and of the first checkpoint, which are the first of `all`.
    fn numbers(&self, all: &[Self]) -> Value {
        let (linear, first) = (&all[0], all.get(1).unwrap_or(&all[0]));
        json!({
            "method": self.name,
            "frames": self.frames.len(),
            "pane_mae": self.mean(|f| f.pane),
            "pane_by_linear": self.ratio(linear, |f| f.pane),
            "pane_by_first": self.ratio(first, |f| f.pane),
            "elsewhere_mae": self.mean(|f| f.elsewhere),
            "elsewhere_by_linear": self.ratio(linear, |f| f.elsewhere),
            "elsewhere_by_first": self.ratio(first, |f| f.elsewhere),
            "sees_the_pane": self.mean(|f| f.near),
            "sees_the_pane_where_measured_through": self.mean(|f| f.near_measured),
            "flagged_of_measured_through": self.mean(|f| f.flagged),
            "flagged_of_the_others": self.mean(|f| f.flagged_wrongly),
        })
    }
}

/// By number of measurements.
type Report = [(usize, Vec<Scores>)];

/// The numbers.
pub fn json(report: &Report) -> anyhow::Result<String> {
    let all: Vec<Value> = report
        .iter()
        .map(|(points, scores)| {
            let methods: Vec<Value> = scores.iter().map(|s| s.numbers(scores)).collect();
            json!({ "points": points, "methods": methods })
        })
        .collect();
    Ok(serde_json::to_string_pretty(&all)?)
}

/// Tables for people.
pub fn tables(report: &Report) -> String {
    let mut lines = Vec::new();
    for (points, scores) in report {
        lines.push(format!("{points} points, {} scenes", scores.first().map_or(0, |s| s.frames.len())));
        lines.push(String::new());
        lines.push(
            "| method | pane MAE m | by linear's | by the first checkpoint's | elsewhere MAE m | by linear's | by the first \
             checkpoint's | sees the pane | there, where measured through it | not believed, of measurements through panes | of the \
             others |"
                .into(),
        );
        lines.push("|---|---|---|---|---|---|---|---|---|---|---|".into());
        for s in scores {
            let v = s.numbers(scores);
            let metres = |key: &str| v[key].as_f64().map_or("-".into(), |x| format!("{x:.3}"));
            let share = |key: &str| v[key].as_f64().map_or("-".into(), |x| format!("{:.1} %", 100.0 * x));
            let ratio = |key: &str| match v[key].as_array().map(|a| a.iter().filter_map(Value::as_f64)) {
                Some(mut a) => {
                    let mut next = || a.next().unwrap_or(f64::NAN);
                    format!("{:.3} ({:.3} to {:.3})", next(), next(), next())
                }
                None => "-".into(),
            };
            lines.push(format!(
                "| {} | {} | {} | {} | {} | {} | {} | {} | {} | {} | {} |",
                s.name,
                metres("pane_mae"),
                ratio("pane_by_linear"),
                ratio("pane_by_first"),
                metres("elsewhere_mae"),
                ratio("elsewhere_by_linear"),
                ratio("elsewhere_by_first"),
                share("sees_the_pane"),
                share("sees_the_pane_where_measured_through"),
                share("flagged_of_measured_through"),
                share("flagged_of_the_others"),
            ));
        }
        lines.push(String::new());
    }
    lines.join("\n")
}
