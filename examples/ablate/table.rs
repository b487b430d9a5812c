//! Tables of all cells that are done.

use crate::cells::{self, PAPER};
use crate::run::{CellResult, Score};
use anyhow::Context;
use serde_json::{Value, json};
use std::fmt::Write;
use std::path::Path;

/// Results by cell, in the order of the tables.
pub struct Table {
    linear: Vec<Score>,
    rows: Vec<Row>,
}

struct Row {
    name: &'static str,
    what: &'static str,
    runs: Vec<CellResult>,
}

/// Mean over runs, and their standard deviation where there are two or more.
#[derive(Clone, Copy)]
struct Spread {
    mean: f64,
    deviation: Option<f64>,
}

impl Spread {
    fn of(values: &[f64]) -> Self {
        let n = values.len() as f64;
        let mean = values.iter().sum::<f64>() / n;
        let squares: f64 = values.iter().map(|v| (v - mean).powi(2)).sum();
        Self { mean, deviation: (values.len() > 1).then(|| (squares / (n - 1.0)).sqrt()) }
    }
}

/// Mean over the frames of one kind, per cent of their depth; `None` without such frames.
fn mean(scores: &[Score], furnished: bool, value: impl Fn(&Score) -> f64) -> Option<f64> {
    let all: Vec<f64> = scores.iter().filter(|s| s.furnished == furnished).map(value).collect();
    (!all.is_empty()).then(|| 100.0 * all.iter().sum::<f64>() / all.len() as f64)
}

/// Procedural MAE and RMSE, furnished MAE and RMSE.
fn columns(scores: &[Score]) -> [Option<f64>; 4] {
    [(false, true), (false, false), (true, true), (true, false)]
        .map(|(furnished, mae)| mean(scores, furnished, |s| if mae { s.mae } else { s.rmse }))
}

impl Table {
    /// Reads all results of a folder; `linear` is what interpolation answers.
    pub fn read(out: &Path, linear: Vec<Score>) -> anyhow::Result<Self> {
        let mut rows = Vec::new();
        for cell in cells::all() {
            let mut runs = Vec::new();
            for seed in 1.. {
                let path = out.join(format!("{}-{seed}.json", cell.name));
                if !path.exists() {
                    break;
                }
                let text = std::fs::read_to_string(&path).with_context(|| path.display().to_string())?;
                runs.push(serde_json::from_str(&text).with_context(|| path.display().to_string())?);
            }
            if !runs.is_empty() {
                rows.push(Row { name: cell.name, what: cell.what, runs });
            }
        }
        Ok(Self { linear, rows })
    }

    /// Two tables: the paper's rows, and ways of asking.
    pub fn markdown(&self) -> String {
        let mut text = String::new();
        let paper = |row: &&Row| PAPER.contains(&row.name);
        for (title, of_paper) in [("Sparse depth injection", true), ("Ways of asking", false)] {
            let _ = writeln!(text, "| {title} | runs | procedural MAE | RMSE | furnished MAE | RMSE |");
            let _ = writeln!(text, "|---|---|---|---|---|---|");
            for row in self.rows.iter().filter(|row| paper(row) == of_paper) {
                let label = if of_paper { format!("({}) {}", row.name, row.what) } else { row.what.into() };
                let cells: Vec<String> = row.spreads().iter().map(shown).collect();
                let _ = writeln!(text, "| {label} | {} | {} |", row.runs.len(), cells.join(" | "));
            }
            let linear = columns(&self.linear).map(|v| v.map_or("".into(), |v| format!("{v:.2}")));
            let _ = writeln!(text, "| linear interpolation | | {} |\n", linear.join(" | "));
        }
        text.trim_end().into()
    }

    /// Writes `table.md` and `ablation.json`.
    pub fn write(&self, out: &Path) -> anyhow::Result<()> {
        let keys = ["procedural_mae", "procedural_rmse", "furnished_mae", "furnished_rmse"];
        let row = |row: &Row| {
            let mut value = json!({"cell": row.name, "what": row.what, "runs": row.runs.len()});
            for (key, spread) in keys.iter().zip(row.spreads()) {
                value[key] =
                    spread.map_or(Value::Null, |s| json!({"mean": s.mean, "deviation": s.deviation}));
            }
            value
        };
        let linear = columns(&self.linear);
        let linear: serde_json::Map<String, Value> =
            keys.iter().zip(linear).map(|(k, v)| (k.to_string(), json!(v))).collect();
        let rows: Vec<Value> = self.rows.iter().map(row).collect();
        let all = json!({"unit": "per cent of a frame's mean depth", "cells": rows, "linear": linear});
        for (name, text) in
            [("table.md", self.markdown()), ("ablation.json", serde_json::to_string_pretty(&all)?)]
        {
            let path = out.join(name);
            std::fs::write(&path, text + "\n").with_context(|| path.display().to_string())?;
        }
        Ok(())
    }
}

impl Row {
    /// Mean over runs and spread of each column.
    fn spreads(&self) -> [Option<Spread>; 4] {
        let each: Vec<[Option<f64>; 4]> = self.runs.iter().map(|r| columns(&r.scores)).collect();
        std::array::from_fn(|i| {
            let values: Option<Vec<f64>> = each.iter().map(|run| run[i]).collect();
            values.map(|values| Spread::of(&values))
        })
    }
}

fn shown(spread: &Option<Spread>) -> String {
    match spread {
        Some(Spread { mean, deviation: Some(deviation) }) => format!("{mean:.2} ± {deviation:.2}"),
        Some(Spread { mean, deviation: None }) => format!("{mean:.2}"),
        None => String::new(),
    }
}
