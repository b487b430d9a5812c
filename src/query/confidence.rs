//! How a model's confidence becomes one that comes true as often as it says.

use crate::error::{Error, Result};

/// Turns a confidence into what held-out scenes bear out: the key `confidence` of `sdim.json`.
///
/// Its log-odds are divided by `temperature` and moved by `offset` (Platt, "Probabilistic Outputs for Support Vector Machines", 1999, with
/// the temperature of Guo et al., "On Calibration of Modern Neural Networks", 2017). Order is kept: a threshold leaves out pixels in the same
/// order as without. The example `confidence` finds both numbers.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ConfidenceScale {
    /// What log-odds are divided by: above 1 for a model that is too sure of both, right and wrong. Above 0.
    pub temperature: f32,
    /// What is added to log-odds then; below 0 for a model that is right less often than it says.
    pub offset: f32,
}

impl Default for ConfidenceScale {
    /// What the model states, as it is.
    fn default() -> Self {
        Self { temperature: 1.0, offset: 0.0 }
    }
}

/// Log-odds are cut here: to a model that is surer, scenes by the thousand would have nothing to say.
const SUREST: f64 = 12.0;

/// Rounds of Newton's method; it converges in under ten.
const ROUNDS: usize = 50;

/// What a slope of 1 and an offset of 0 are worth against the observations, in observations: with too few of them little is moved.
const PRIOR: f64 = 1.0;

fn log_odds(confidence: f64) -> f64 {
    (confidence / (1.0 - confidence)).ln().clamp(-SUREST, SUREST)
}

fn share(log_odds: f64) -> f64 {
    1.0 / (1.0 + (-log_odds).exp())
}

impl ConfidenceScale {
    /// Whether nothing is changed.
    pub fn is_identity(&self) -> bool {
        *self == Self::default()
    }

    /// What a stated confidence (0 to 1) is worth; the ends stay.
    pub fn confidence(&self, stated: f32) -> f32 {
        if self.is_identity() || stated <= 0.0 || stated >= 1.0 {
            return stated;
        }
        let moved = log_odds(f64::from(stated)) / f64::from(self.temperature) + f64::from(self.offset);
        share(moved) as f32
    }

    /// The scale under which statements come true as often as they say: the likeliest temperature and offset, by Newton's method. `stated` are
    /// confidences, `hit` whether the truth lay within the tolerance.
    ///
    /// # Errors
    /// [`Error::Argument`] without observations, for lists of different length, a confidence outside of 0 to 1, or where all were right, or all
    /// wrong: nothing can be learnt from them. Also where being surer meant being wrong.
    pub fn fit(stated: &[f64], hit: &[bool]) -> Result<Self> {
        let wrong = |found: String, wanted| Err(Error::argument("observations", found, wanted));
        if stated.len() != hit.len() {
            return wrong(format!("lists of {} and {}", stated.len(), hit.len()), "lists of one length");
        }
        if let Some(c) = stated.iter().find(|c| !(0.0..=1.0).contains(*c)) {
            return wrong(format!("confidence {c}"), "confidences of 0 to 1");
        }
        let right = hit.iter().filter(|h| **h).count();
        if right == 0 || right == hit.len() {
            return wrong(format!("{right} right of {}", hit.len()), "some right and some wrong");
        }
        let (slope, offset) = newton(stated, hit);
        let scale = Self { temperature: (1.0 / slope) as f32, offset: offset as f32 };
        match scale.validate("observations") {
            Ok(()) => Ok(scale),
            Err(_) => wrong(format!("{scale:?}"), "confidence that rises with the share of right answers"),
        }
    }

    /// This scale's work followed by another's, as one.
    pub fn then(&self, next: &Self) -> Self {
        Self {
            temperature: self.temperature * next.temperature,
            offset: self.offset / next.temperature + next.offset,
        }
    }

    /// The scale that takes back what this one does.
    pub fn undone(&self) -> Self {
        Self { temperature: 1.0 / self.temperature, offset: -self.offset * self.temperature }
    }

    pub(crate) fn validate(&self, file: &str) -> Result<()> {
        let positive = |v: f32| v.is_finite() && v > 0.0;
        if positive(self.temperature) && self.offset.is_finite() {
            return Ok(());
        }
        let expected = "a temperature above 0 and a finite offset";
        Err(Error::config(file, "confidence", format!("{self:?}"), expected))
    }
}

/// Slope and offset of the likeliest logistic curve through `hit` over the log-odds of `stated`.
fn newton(stated: &[f64], hit: &[bool]) -> (f64, f64) {
    let (mut slope, mut offset) = (1.0, 0.0);
    for _ in 0..ROUNDS {
        let (mut gradient, mut curve) = ([PRIOR * (slope - 1.0), PRIOR * offset], [PRIOR, 0.0, PRIOR]);
        for (c, h) in stated.iter().zip(hit) {
            let x = log_odds(*c);
            let p = share(slope * x + offset);
            let (miss, weight) = (p - f64::from(u8::from(*h)), p * (1.0 - p));
            gradient = [gradient[0] + miss * x, gradient[1] + miss];
            curve = [curve[0] + weight * x * x, curve[1] + weight * x, curve[2] + weight];
        }
        let [a, b, d] = curve;
        let determinant = a * d - b * b;
        let step = [
            (d * gradient[0] - b * gradient[1]) / determinant,
            (a * gradient[1] - b * gradient[0]) / determinant,
        ];
        // A long step of Newton's can leave the curve's flat part behind it; half a unit of log-odds at a time cannot.
        let short = (0.5 / step[0].abs().max(step[1].abs())).min(1.0);
        (slope, offset) = (slope - short * step[0], offset - short * step[1]);
        if step[0].abs().max(step[1].abs()) < 1e-9 {
            break;
        }
    }
    (slope, offset)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Statements that are worth `scale`, each as often right as it is worth.
    fn observed(scale: ConfidenceScale) -> (Vec<f64>, Vec<bool>) {
        let mut lists = (Vec::new(), Vec::new());
        for step in 1..40 {
            let stated = f64::from(step) / 40.0;
            let worth = f64::from(scale.confidence(stated as f32));
            for i in 0..2000 {
                lists.0.push(stated);
                lists.1.push((f64::from(i) + 0.5) / 2000.0 < worth);
            }
        }
        lists
    }

    #[test]
    fn a_fit_finds_the_scale_that_made_the_observations() {
        for (temperature, offset) in [(1.6, -0.4), (0.7, 0.9), (1.0, 0.0)] {
            let (stated, hit) = observed(ConfidenceScale { temperature, offset });
            let found = ConfidenceScale::fit(&stated, &hit).unwrap();
            assert!((found.temperature - temperature).abs() < 0.01, "{found:?}");
            assert!((found.offset - offset).abs() < 0.01, "{found:?}");
        }
    }

    #[test]
    fn order_and_ends_stay_and_two_scales_are_one() {
        let scale = ConfidenceScale { temperature: 2.0, offset: -0.5 };
        let stated: Vec<f32> = (0..=100).map(|i| i as f32 / 100.0).collect();
        let scaled: Vec<f32> = stated.iter().map(|c| scale.confidence(*c)).collect();
        assert!(scaled.windows(2).all(|w| w[0] < w[1]) && scaled[0] == 0.0 && scaled[100] == 1.0);
        assert!((scaled[50] - 0.3775).abs() < 1e-4, "half, moved by -0.5: {}", scaled[50]);
        let next = ConfidenceScale { temperature: 0.6, offset: 0.2 };
        let both = scale.then(&next);
        for (c, s) in stated.iter().zip(&scaled) {
            assert!((both.confidence(*c) - next.confidence(*s)).abs() < 1e-5);
        }
        let nothing = scale.then(&scale.undone());
        assert!((nothing.temperature - 1.0).abs() < 1e-6 && nothing.offset.abs() < 1e-6, "{nothing:?}");
        assert!(ConfidenceScale::default().confidence(0.3) == 0.3);
    }

    #[test]
    fn what_teaches_nothing_is_an_error() {
        for (stated, hit) in [
            (vec![], vec![]),
            (vec![0.5, 0.6], vec![true, true]),
            (vec![0.5, 0.6], vec![false, false]),
            (vec![0.5, 1.5], vec![false, true]),
            (vec![0.5, f64::NAN], vec![false, true]),
            (vec![0.5], vec![false, true]),
            // The surer, the more often wrong.
            ([vec![0.1; 500], vec![0.9; 500]].concat(), [vec![true; 500], vec![false; 500]].concat()),
        ] {
            assert!(matches!(ConfidenceScale::fit(&stated, &hit), Err(Error::Argument { .. })), "{stated:?}");
        }
    }
}
