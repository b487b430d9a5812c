//! One cell: from what is known to a score.

use crate::cells::{Cell, Start, pictures_alone};
use crate::frames::{Frames, SIZE, Test};
use anyhow::Context;
use rand::Rng;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use sdim::internals::model::{AskOptions, SdimModel, ask};
use sdim::internals::query::Query;
use sdim::internals::supervise::{Base, FreshFiles, LabelSource, Shape, TrainConfig, Trainer, VisionShape};
use sdim::internals::vlm::checkpoint::weights::Weights;
use sdim::{Device, Tensor};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::Path;
use std::time::Instant;

/// How much is done.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Plan {
    /// Steps on pictures alone.
    pub first_steps: usize,
    /// Steps of a cell.
    pub steps: usize,
    /// Frames of a step.
    pub batch: usize,
    /// Questions about each frame of a step.
    pub questions: usize,
    /// Frames to train on.
    pub frames: u64,
    /// Frames that score.
    pub tests: u64,
    /// Pixels asked of each of those.
    pub questions_of_tests: usize,
    /// Peak learning rates on pictures alone, and of a cell.
    pub rates: [f32; 2],
}

impl Default for Plan {
    fn default() -> Self {
        Self {
            first_steps: 1500,
            steps: 600,
            batch: 8,
            questions: 32,
            frames: 1024,
            tests: 64,
            questions_of_tests: 32,
            rates: [1.5e-3, 3e-3],
        }
    }
}

impl Plan {
    pub fn quick() -> Self {
        Self {
            first_steps: 2,
            steps: 2,
            batch: 2,
            questions: 4,
            frames: 4,
            tests: 2,
            questions_of_tests: 4,
            ..Self::default()
        }
    }

    fn config(&self, steps: usize, rate: f32, seed: u64) -> TrainConfig {
        let mut config = TrainConfig { steps, warmup: steps / 20 + 1, rate, seed, ..Default::default() };
        config.optimiser.average = 0.98;
        config
    }
}

/// About half a million parameters.
fn shape() -> Shape {
    Shape {
        hidden_size: 96,
        intermediate_size: 256,
        layers: 3,
        heads: 4,
        kv_heads: 2,
        vision: VisionShape {
            hidden_size: 64,
            intermediate_size: 172,
            depth: 3,
            heads: 2,
            window: 64,
            full_attention: vec![0, 2],
        },
        glimpse: None,
        wide_glimpse: None,
        pixels: (SIZE.0 * SIZE.1, SIZE.0 * SIZE.1),
    }
}

/// Errors of one frame, in its mean depth.
#[derive(Clone, Copy, Debug, Serialize, Deserialize)]
pub struct Score {
    pub mae: f64,
    pub rmse: f64,
    pub furnished: bool,
}

/// What one run of a cell came to.
#[derive(Serialize, Deserialize)]
pub struct CellResult {
    pub cell: String,
    pub seed: u64,
    /// Mean loss of the last tenth of the steps.
    pub loss: f32,
    pub seconds: f64,
    pub scores: Vec<Score>,
}

impl CellResult {
    pub fn line(&self) -> String {
        let mae = self.scores.iter().map(|s| s.mae).sum::<f64>() / self.scores.len() as f64;
        let Self { cell, seed, loss, seconds, .. } = self;
        format!("{cell} seed {seed}: MAE {:.2} % of depth, loss {loss:.3}, {seconds:.0} s", 100.0 * mae)
    }

    /// Writes it whole or not at all.
    pub fn write(&self, path: &Path) -> anyhow::Result<()> {
        let part = path.with_extension("part");
        std::fs::write(&part, serde_json::to_string(self)?).with_context(|| part.display().to_string())?;
        std::fs::rename(&part, path).with_context(|| path.display().to_string())
    }
}

/// The model that knows pictures alone: from `dir`, or trained now and kept there.
pub fn known(dir: &Path, plan: &Plan, frames: &Frames) -> anyhow::Result<Weights> {
    if !dir.join("model.safetensors").exists() {
        let cell = Cell {
            name: "pictures",
            what: "pictures alone",
            settings: pictures_alone(),
            start: Start::Zero,
            labels: LabelSource::Dense,
        };
        let files = FreshFiles::of(&shape(), &cell.settings)?;
        let tensors = files.initial(1)?;
        let values: usize = tensors.values().map(Tensor::elem_count).sum();
        eprintln!("{values} parameters, first on pictures alone");
        let config = plan.config(plan.first_steps, plan.rates[0], 1);
        let start = Instant::now();
        let mut trainer = Trainer::of(config, &Base::of(files, tensors), |_| true)?;
        let loss = train(&mut trainer, &cell, plan, frames, 1)?;
        let scores = score(&trainer.averaged_model()?, &frames.tests)?;
        let result = CellResult {
            cell: cell.name.into(),
            seed: 1,
            loss,
            seconds: start.elapsed().as_secs_f64(),
            scores,
        };
        eprintln!("{}", result.line());
        trainer.publish(dir)?;
        result.write(&dir.join("result.json"))?;
    }
    Ok(Weights::from_dir(dir, &Device::Cpu)?)
}

/// Trains a cell from what is known, and scores it.
pub fn cell(
    cell: &Cell,
    seed: u64,
    known: &Weights,
    plan: &Plan,
    frames: &Frames,
) -> anyhow::Result<CellResult> {
    let start = Instant::now();
    let files = FreshFiles::of(&shape(), &cell.settings)?;
    let mut tensors = files.initial(seed)?;
    for (name, tensor) in tensors.iter_mut().filter(|(name, _)| known.has(name)) {
        *tensor = known.get(name, tensor.dims())?;
    }
    begin(cell, &mut tensors, seed)?;
    let mut config = plan.config(plan.steps, plan.rates[1], seed);
    config.widen = 1.0;
    let concatenated = cell.start == Start::Concatenated;
    if concatenated {
        config.freeze_norm_at = 0.0;
    }
    let trained = |name: &str| !(concatenated && name.starts_with("sdim.fusion."));
    let mut trainer = Trainer::of(config, &Base::of(files, tensors), trained)?;
    let loss = train(&mut trainer, cell, plan, frames, seed)?;
    let scores = score(&trainer.averaged_model()?, &frames.tests)?;
    let seconds = start.elapsed().as_secs_f64();
    Ok(CellResult { cell: cell.name.into(), seed, loss, seconds, scores })
}

/// All steps; the mean loss of the last tenth of them.
fn train(trainer: &mut Trainer, cell: &Cell, plan: &Plan, frames: &Frames, seed: u64) -> anyhow::Result<f32> {
    let steps = trainer.config().steps;
    let mut examples = frames.examples(cell, plan, trainer.model(), seed, 0)?;
    let mut last = Vec::new();
    for step in 1..=steps {
        let next = |model: &SdimModel| frames.examples(cell, plan, model, seed, step as u64);
        let (report, coming) = trainer.step_on(&examples, next)?;
        examples = coming;
        if step * 10 > steps * 9 && !report.skipped {
            last.push(report.loss);
        }
    }
    Ok(last.iter().sum::<f32>() / last.len().max(1) as f32)
}

/// Puts what decides the cell's start into the fresh tensors of the fusion block.
fn begin(cell: &Cell, tensors: &mut BTreeMap<String, Tensor>, seed: u64) -> anyhow::Result<()> {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    match cell.start {
        Start::Zero => {}
        Start::He => {
            for name in ["sdim.fusion.depth.conv.weight", "sdim.fusion.out.weight"] {
                let shape = tensors.get(name).with_context(|| name.to_string())?.dims().to_vec();
                let inputs: usize = shape[1..].iter().product();
                let spread = (2.0 / inputs as f32).sqrt();
                let values: Vec<f32> = (0..shape.iter().product()).map(|_| spread * bell(&mut rng)).collect();
                tensors.insert(name.into(), Tensor::from_vec(values, shape, &Device::Cpu)?);
            }
        }
        Start::Concatenated => pass_through(tensors)?,
    }
    Ok(())
}

/// Standard normal, by Box and Muller.
fn bell(rng: &mut ChaCha8Rng) -> f32 {
    let (u, v): (f32, f32) = (rng.random::<f32>().max(1e-9), rng.random());
    (-2.0 * u.ln()).sqrt() * (std::f32::consts::TAU * v).cos()
}

/// A block that hands the measurements on as they are, so that the patch embedding behind it, and so the encoder, sees them beside the
/// colours. Measurements are at least 0, so that the activations let them pass; statistics of a fresh normalisation change nothing.
fn pass_through(tensors: &mut BTreeMap<String, Tensor>) -> anyhow::Result<()> {
    let mut set = |part: &str, from: usize, to: &[usize]| -> anyhow::Result<()> {
        let name = format!("sdim.fusion.{part}.weight");
        let shape = tensors.get(&name).with_context(|| name.clone())?.dims().to_vec();
        let mut values = vec![0f32; shape.iter().product()];
        for out in to {
            // The middle of a 3x3 kernel.
            values[(out * shape[1] + from) * 9 + 4] = 1.0;
        }
        tensors.insert(name, Tensor::from_vec(values, shape, &Device::Cpu)?);
        Ok(())
    };
    set("rgb.conv", 0, &[])?;
    set("depth.conv", 0, &[0])?;
    let branch = crate::cells::all()[0].settings.fusion.map_or(0, |f| f.branch);
    set("high.conv", branch, &[0])?;
    set("low.conv", 0, &[0])?;
    set("out", 0, &[0, 1, 2])
}

/// Errors of the answers as they are, without alignment.
fn score(model: &SdimModel, tests: &[Test]) -> anyhow::Result<Vec<Score>> {
    let one = |test: &Test| {
        let prefix = model.prefill_frame(&test.measured.frame.rgb, &test.measured.sparse)?;
        let query = |&(x, y, _, hint): &(usize, usize, f32, f32)| Query { x, y, measured: None, hint };
        let queries: Vec<Query> = test.asked.iter().map(query).collect();
        let answers = ask(model, &prefix, &queries, AskOptions::default())?;
        Ok(test.score(answers.iter().map(|a| a.value)))
    };
    tests.iter().map(one).collect()
}
