//! Pixels of many maps, with what was stated about them and what was true.

use sdim::internals::query::plan::lattice;
use sdim::metrics::{Calibration, Sparsification, calibration, sparsification};
use sdim::settings::ConfidenceScale;
use sdim::{DepthMap, QueryPlan};
use serde_json::json;

/// What a confidence speaks of: the relative distance of truth and answer.
const WITHIN: f64 = 0.05;

/// Bins of a reliability diagram.
const BINS: usize = 20;

/// Pixels with ground truth that were not measured.
#[derive(Default)]
pub struct Pool {
    confidence: Vec<f64>,
    hit: Vec<bool>,
    expected: Vec<f64>,
    error: Vec<f64>,
    /// Whether a pixel was asked, as far as the plan tells beforehand.
    asked: Vec<bool>,
}

impl Pool {
    /// Adds the pixels of a map.
    pub fn add(&mut self, map: &DepthMap, truth: &[f32], plan: QueryPlan) {
        let mut asked = vec![plan == QueryPlan::Every; truth.len()];
        if let QueryPlan::Stride(stride) = plan {
            lattice(map.width(), map.height(), stride)
                .iter()
                .for_each(|(x, y)| asked[y * map.width() + x] = true);
        }
        for (i, &t) in truth.iter().enumerate() {
            let p = map.depth()[i];
            if !(t.is_finite() && t > 0.0 && p.is_finite()) || map.measured()[i] {
                continue;
            }
            let (p, t) = (f64::from(p), f64::from(t));
            self.confidence.push(f64::from(map.confidence()[i]));
            self.hit.push((p - t).abs() <= WITHIN * p);
            self.expected.push(f64::from(map.expected_error()[i]));
            self.error.push((p - t).abs());
            self.asked.push(asked[i]);
        }
    }

    pub fn len(&self) -> usize {
        self.hit.len()
    }

    /// What these pixels bear out.
    pub fn fit(&self) -> sdim::Result<ConfidenceScale> {
        ConfidenceScale::fit(&self.confidence, &self.hit)
    }

    /// The same pixels with other statements.
    pub fn scaled(&self, scale: &ConfidenceScale) -> Self {
        Self {
            confidence: self.confidence.iter().map(|c| f64::from(scale.confidence(*c as f32))).collect(),
            hit: self.hit.clone(),
            expected: self.expected.clone(),
            error: self.error.clone(),
            asked: self.asked.clone(),
        }
    }

    /// Reliability of the confidence: of all pixels, of those asked, of those filled.
    pub fn parts(&self) -> [(&'static str, Option<Calibration>); 3] {
        [
            ("all pixels", self.reliability(|_| true)),
            ("asked pixels", self.reliability(|asked| asked)),
            ("filled pixels", self.reliability(|asked| !asked)),
        ]
    }

    /// Reliability of the confidence of pixels by whether they were asked.
    pub fn reliability(&self, wanted: impl Fn(bool) -> bool) -> Option<Calibration> {
        let chosen: Vec<usize> = (0..self.len()).filter(|&i| wanted(self.asked[i])).collect();
        let stated: Vec<f64> = chosen.iter().map(|&i| self.confidence[i]).collect();
        let hit: Vec<f64> = chosen.iter().map(|&i| f64::from(u8::from(self.hit[i]))).collect();
        calibration(&stated, &hit, BINS)
    }

    /// Expected against true error, metres.
    pub fn expected_error(&self) -> Option<Calibration> {
        calibration(&self.expected, &self.error, BINS)
    }

    pub fn sparsification(&self) -> Option<Sparsification> {
        sparsification(&self.error, &self.expected)
    }

    /// True errors, metres, with two orders: by expected error, and by lack of confidence.
    pub fn orders(&self) -> (&[f64], [(&'static str, Vec<f64>); 2]) {
        let doubt = self.confidence.iter().map(|c| -c).collect();
        (&self.error, [("by expected error", self.expected.clone()), ("by confidence", doubt)])
    }

    /// All of it as JSON.
    pub fn numbers(&self) -> serde_json::Value {
        let parts =
            self.parts().map(|(name, reliability)| json!({ "pixels": name, "reliability": reliability }));
        json!({
            "pixels": self.len(),
            "confidence": parts,
            "expected_error": self.expected_error(),
            "sparsification": self.sparsification(),
        })
    }
}
