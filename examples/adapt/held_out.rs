//! Frames that are not trained on: what is held back in them says what was won.

use rand::SeedableRng;
use rand::seq::SliceRandom;
use rand_chacha::ChaCha8Rng;
use sdim::internals::supervise::{OwnFrame, hold_back};
use sdim::{CompleteOptions, DepthCompleter, SparseDepth};

/// Frames whose measurements are parted in two, and how far a checkpoint was off at those held back.
pub struct HeldOut {
    frames: Vec<Parted>,
    /// Mean absolute error at the start, metres, frame by frame.
    before: Vec<f64>,
}

struct Parted {
    frame: OwnFrame,
    told: SparseDepth,
    held: Vec<(usize, usize, f32)>,
}

/// What was won against the start.
#[derive(Clone, Copy, Debug)]
pub struct Gain {
    /// Mean absolute error now, metres.
    pub error: f64,
    /// Geometric mean over frames of the error now by the error at the start, which no frame of far things rules.
    pub ratio: f64,
    /// Standard error of its logarithm.
    doubt: f64,
}

impl Gain {
    /// Whether it is better by more than chance would have it.
    pub fn is_better(&self) -> bool {
        self.ratio.ln() + self.doubt < 0.0
    }
}

impl std::fmt::Display for Gain {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let low = (self.ratio.ln() - self.doubt).exp();
        let high = (self.ratio.ln() + self.doubt).exp();
        write!(
            f,
            "held-back error {:.4} m, {:.3} of the start's ({low:.3} to {high:.3})",
            self.error, self.ratio
        )
    }
}

/// One frame in `every`, at least two, drawn by a seed; and the others.
pub fn part(mut frames: Vec<OwnFrame>, every: usize, seed: u64) -> (Vec<OwnFrame>, Vec<OwnFrame>) {
    frames.shuffle(&mut ChaCha8Rng::seed_from_u64(seed));
    let rest = frames.split_off((frames.len() / every).max(2));
    (frames, rest)
}

impl HeldOut {
    /// Holds measurements of these frames back and asks the checkpoint that is to be adapted.
    pub fn new(frames: Vec<OwnFrame>, start: &DepthCompleter, seed: u64) -> sdim::Result<Self> {
        let parted = |(i, frame): (usize, OwnFrame)| {
            let (told, held) = hold_back(&frame.sparse, seed.wrapping_add(i as u64))?;
            Ok(Parted { frame, told, held })
        };
        let frames = frames.into_iter().enumerate().map(parted).collect::<sdim::Result<Vec<_>>>()?;
        let mut out = Self { frames, before: Vec::new() };
        out.before = out.errors(start)?;
        Ok(out)
    }

    /// Number of frames.
    pub fn len(&self) -> usize {
        self.frames.len()
    }

    /// Mean absolute error at the start, metres.
    pub fn error_before(&self) -> f64 {
        mean(&self.before)
    }

    /// What this checkpoint wins.
    pub fn gain(&self, completer: &DepthCompleter) -> sdim::Result<Gain> {
        let errors = self.errors(completer)?;
        let logs: Vec<f64> = errors.iter().zip(&self.before).map(|(now, was)| (now / was).ln()).collect();
        let centre = mean(&logs);
        let spread = logs.iter().map(|l| (l - centre).powi(2)).sum::<f64>() / (logs.len() as f64 - 1.0);
        let doubt = (spread / logs.len() as f64).sqrt();
        Ok(Gain { error: mean(&errors), ratio: centre.exp(), doubt })
    }

    /// Mean absolute error at what is held back of each frame, metres, as a user's maps have it: default plan, filter and fill.
    fn errors(&self, completer: &DepthCompleter) -> sdim::Result<Vec<f64>> {
        let one = |p: &Parted| {
            let map = completer.complete(&p.frame.rgb, &p.told, &CompleteOptions::default())?;
            let off = |&(x, y, depth): &(usize, usize, f32)| {
                map.get(x, y).map_or(f64::INFINITY, |answer| f64::from((answer - depth).abs()))
            };
            // Never 0, of which no ratio can be taken.
            Ok(p.held.iter().map(off).sum::<f64>().max(1e-9) / p.held.len() as f64)
        };
        self.frames.iter().map(one).collect()
    }
}

fn mean(values: &[f64]) -> f64 {
    values.iter().sum::<f64>() / values.len() as f64
}
