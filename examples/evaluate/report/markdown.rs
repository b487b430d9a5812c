//! The tables as Markdown.

use crate::Score;

use super::{MethodTable, REFERENCE, RELATIVE, Skipped, Table, Tables};
use sdim::metrics::{Interval, METRICS, Metric};
use std::fmt::Write;

/// Metrics with intervals in the first table; the others follow without.
const MAIN: [&str; 4] = ["mae", "rmse", "abs_rel", "delta_1.25"];

pub fn markdown(report: &Tables) -> String {
    let s = &report.settings;
    let drawn = match s.points[..] {
        [0] => "the data set's own measurements".to_string(),
        _ if s.resample => {
            format!("measurements drawn in pattern {}, the data set's own left aside", s.pattern)
        }
        _ => format!("measurements drawn in pattern {} where a frame has none of its own", s.pattern),
    };
    let counted = match s.score {
        Score::Unseen => "pixels with ground truth that were not measured (`--score unseen`)",
        Score::All => "all pixels with ground truth, measured ones included (`--score all`)",
    };
    let mut text = format!(
        "# Evaluation\n\n{} frames of layout {}, {drawn}, seed {}, plan {}, {} weights. Means over frames, in brackets 95 % bootstrap \
         intervals over frames; errors over {counted}. Always over all pixels: GE. Never over measured ones: errors by region, and \
         confidence.\n",
        s.frames, s.layout, s.seed, s.plan, s.weights
    );
    report.tables.iter().for_each(|t| table(&mut text, t));
    text
}

fn table(text: &mut String, t: &Table) {
    let title = match t.own {
        own if t.points == 0 || own > 0 && own == t.frames => "The data set's own measurements".to_string(),
        0 => format!("{} points", t.points),
        own => format!("{} points ({own} of {} frames: their own measurements)", t.points, t.frames),
    };
    let _ =
        writeln!(text, "\n## {title}\n\n{} frames, {:.0} measured pixels in the mean.", t.frames, t.measured);
    skipped(text, t);
    if t.methods.is_empty() {
        return;
    }
    let (main, others): (Vec<&Metric>, Vec<&Metric>) = METRICS.iter().partition(|m| MAIN.contains(&m.name));
    let columns = main.iter().map(|m| metric(t, m, true)).chain([ratio(t)]);
    rows(text, t, columns.collect());
    relative(text, t);
    let gradient = plain("GE m", t, false, |m| m.gradient_error.map(|g| g.value));
    rows(text, t, others.iter().map(|m| metric(t, m, false)).chain([gradient]).collect());
    let regions = t.methods.first().map_or(&[][..], |m| &m.regions);
    let by_region = regions.iter().map(|r| {
        plain(&format!("MAE {}", r.name), t, false, |m| {
            m.regions.iter().find(|found| found.name == r.name).map(|found| found.mae)
        })
    });
    rows(text, t, by_region.collect());
    let sure: Vec<&MethodTable> = t.methods.iter().filter(|m| !m.confidence.is_empty()).collect();
    if let Some(first) = sure.first() {
        let names: Vec<&String> = first.confidence.keys().collect();
        let heads: Vec<String> = names.iter().map(|n| n.replace('_', " ")).collect();
        let _ =
            writeln!(text, "\n| confidence | {} |\n|---|{}", heads.join(" | "), "---|".repeat(names.len()));
        for m in sure {
            let values: Vec<String> = names.iter().map(|n| digits(m.confidence.get(*n).copied())).collect();
            let _ = writeln!(text, "| {} | {} |", m.name, values.join(" | "));
        }
    }
}

/// Frames by the reason for which they were left out.
fn skipped(text: &mut String, t: &Table) {
    let mut reasons: Vec<(&str, Vec<&str>)> = Vec::new();
    for Skipped { frame, reason } in &t.skipped {
        match reasons.iter_mut().find(|(known, _)| known == reason) {
            Some((_, frames)) => frames.push(frame),
            None => reasons.push((reason, vec![frame])),
        }
    }
    for (reason, frames) in reasons {
        let (n, of) = (frames.len(), t.frames + t.skipped.len());
        let _ = writeln!(text, "\nSkipped, {n} of {of} frames, {reason}: {}.", frames.join(", "));
    }
}

/// A heading and one cell per method.
type Column = (String, Vec<String>);

fn rows(text: &mut String, t: &Table, columns: Vec<Column>) {
    let heads: Vec<&str> = columns.iter().map(|c| c.0.as_str()).collect();
    let _ = writeln!(text, "\n| method | {} |\n|---|{}", heads.join(" | "), "---|".repeat(heads.len()));
    for (row, m) in t.methods.iter().enumerate() {
        let cells: Vec<&str> = columns.iter().map(|c| c.1[row].as_str()).collect();
        let _ = writeln!(text, "| {} | {} |", m.name, cells.join(" | "));
    }
}

fn metric(t: &Table, metric: &Metric, intervals: bool) -> Column {
    let of = |m: &MethodTable| m.metrics.get(metric.name).copied();
    let (head, mut cells) = plain(metric.label, t, metric.higher_is_better, |m| of(m).map(|i| i.value));
    if intervals {
        cells.iter_mut().zip(&t.methods).for_each(|(cell, m)| cell.push_str(&brackets(of(m))));
    }
    (head, cells)
}

/// Geometric means, and on how many frames a method is better than the reference.
fn relative(text: &mut String, t: &Table) {
    if t.methods.len() < 2 {
        return;
    }
    let instead = if t.reference == REFERENCE { "" } else { ", since `linear` was not run" };
    let _ = writeln!(
        text,
        "\nErrors by those of `{}`{instead} on the same frame: geometric mean over frames, and the frames on which the method is better.",
        t.reference
    );
    let columns = RELATIVE.map(|(key, head)| {
        let cell = |m: &MethodTable| match m.relative.get(key).filter(|_| m.name != t.reference) {
            None => String::new(),
            Some(r) => {
                let (value, interval) = (r.geometric_mean.map(|i| i.value), brackets(r.geometric_mean));
                let zero =
                    if r.without_ratio > 0 { format!(", {} at 0", r.without_ratio) } else { String::new() };
                format!("{}{interval}, {} of {}{zero}", digits(value), r.better, r.frames)
            }
        };
        (format!("{head} : {}", t.reference), t.methods.iter().map(cell).collect())
    });
    rows(text, t, columns.into());
    if t.methods.iter().flat_map(|m| m.relative.values()).any(|r| r.without_ratio > 0) {
        let _ = writeln!(
            text,
            "\n`n at 0`: frames on which the method or `{}` has no error at all; they are compared, but in no geometric mean.",
            t.reference
        );
    }
}

fn ratio(t: &Table) -> Column {
    let head = format!("mean MAE : {}'s", t.reference);
    let cell = |m: &MethodTable| match m.mae_ratio {
        Some(i) if m.name != t.reference => format!("{:.2} ({:.2} to {:.2})", i.value, i.low, i.high),
        _ => String::new(),
    };
    (head, t.methods.iter().map(cell).collect())
}

/// The best value in bold.
fn plain(head: &str, t: &Table, higher: bool, value: impl Fn(&MethodTable) -> Option<f64>) -> Column {
    let values: Vec<Option<f64>> = t.methods.iter().map(value).collect();
    let better = |a: f64, b: f64| if higher { a.max(b) } else { a.min(b) };
    let best = values.iter().copied().flatten().reduce(better);
    let cell = |v: &Option<f64>| match v {
        // As written: values that look the same are equally good.
        Some(_) if values.len() > 1 && digits(*v) == digits(best) => format!("**{}**", digits(*v)),
        _ => digits(*v),
    };
    (head.to_string(), values.iter().map(cell).collect())
}

fn brackets(interval: Option<Interval>) -> String {
    interval.map_or(String::new(), |i| format!(" ({} to {})", digits(Some(i.low)), digits(Some(i.high))))
}

/// Three decimals, four for small values, fewer for large ones.
fn digits(value: Option<f64>) -> String {
    match value {
        None => "-".to_string(),
        Some(v) if v.abs() >= 100.0 => format!("{v:.0}"),
        Some(v) if v.abs() >= 10.0 => format!("{v:.1}"),
        Some(v) if v.abs() < 0.1 => format!("{v:.4}"),
        Some(v) => format!("{v:.3}"),
    }
}
