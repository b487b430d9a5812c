//! Memory and frames per second: the paper's Table 4.

use crate::record::{Named, Record};
use serde::Serialize;
use std::fmt::Write;

/// Makes the peak of [`sdim::system::peak_rss_bytes`] start anew, where the system can (Linux); elsewhere it stays that of the
/// whole run.
pub fn forget_peak() {
    let _ = std::fs::write("/proc/self/clear_refs", "5");
}

/// One method's cost over all frames.
#[derive(Clone, Debug, Default, Serialize)]
pub struct MethodSpeed {
    pub frames: usize,
    pub seconds: f64,
    pub frames_per_second: f64,
    pub slowest_seconds: f64,
    /// Largest peak of the process while the method ran; all loaded checkpoints are part of it.
    pub peak_bytes: Option<u64>,
    pub rmse: f64,
}

/// By number of points, then by method, in the order of the table.
#[derive(Debug, Default, Serialize)]
pub struct Speed {
    pub points: Named<Vec<(String, MethodSpeed)>>,
}

impl Speed {
    pub fn add(&mut self, points: usize, record: &Record) {
        // Zeros in front, so that the order of names is that of numbers.
        let methods = self.points.entry(format!("{points:07}")).or_default();
        for (scores, cost) in record.scores.iter().zip(&record.cost) {
            let at = methods.iter().position(|(name, _)| *name == scores.method).unwrap_or_else(|| {
                methods.push((scores.method.clone(), MethodSpeed::default()));
                methods.len() - 1
            });
            let total = &mut methods[at].1;
            let n = total.frames as f64;
            total.rmse = (total.rmse * n + scores.errors.rmse) / (n + 1.0);
            total.frames += 1;
            total.seconds += cost.seconds;
            total.frames_per_second = total.frames as f64 / total.seconds.max(1e-9);
            total.slowest_seconds = total.slowest_seconds.max(cost.seconds);
            total.peak_bytes = total.peak_bytes.max(cost.peak_bytes);
        }
    }

    pub fn table(&self) -> String {
        let mut text = String::new();
        for (points, methods) in &self.points {
            let title = match points.trim_start_matches('0') {
                "" => "own points".to_string(),
                points => format!("{points} points"),
            };
            let _ = writeln!(text, "\n{title:24} frames/s   slowest s   memory MB   RMSE m");
            for (name, s) in methods {
                let memory = s.peak_bytes.map_or("?".to_string(), |b| format!("{:.0}", b as f64 / 1e6));
                let (rate, slowest) = (s.frames_per_second, s.slowest_seconds);
                let _ =
                    writeln!(text, "{name:24} {rate:8.2}    {slowest:8.3}    {memory:>8}   {:6.3}", s.rmse);
            }
        }
        text
    }
}
