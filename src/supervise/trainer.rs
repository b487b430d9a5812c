//! The training loop.

use super::batch::{self, BatchConfig, Example};
use super::init::FreshFiles;
use super::loss::{self, BinLoss, LossParts};
use super::optimiser::{AdamW, Parameters};
use super::store;
use crate::error::{Error, Result};
use crate::fusion::{BatchStats, Normalise};
use crate::kernels::{self, Block};
use crate::model::SdimModel;
use crate::query::number::{NumberFormat, POINT};
use crate::query::prompt::Glimpse;
use crate::query::{PixelReference, Settings};
use crate::vlm::decoder::Context;
use crate::vlm::preprocess::Pixels;
use crate::vlm::rope::Position;
use crate::vlm::weights::Weights;
use candle_core::{Device, Tensor};
use std::path::Path;

/// Everything that decides a run.
#[derive(Debug, Clone, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct TrainConfig {
    /// Steps of the whole schedule.
    pub steps: usize,
    /// Steps of linear warm-up.
    pub warmup: usize,
    /// Peak learning rate; falls to a hundredth along a cosine.
    pub rate: f32,
    /// Seed of weights and data.
    pub seed: u64,
    /// What a step is made of.
    pub batch: BatchConfig,
    /// The optimiser.
    pub optimiser: AdamW,
    /// Weight of the L1 on the expected depth against the cross-entropy.
    pub l1: f32,
    /// Share of the steps after which normalisations use their running statistics, as inference does.
    pub freeze_norm_at: f32,
}

impl Default for TrainConfig {
    fn default() -> Self {
        Self {
            steps: 5000,
            warmup: 200,
            rate: 1.2e-3,
            seed: 7,
            batch: BatchConfig::default(),
            optimiser: AdamW::default(),
            l1: 4.0,
            freeze_norm_at: 0.5,
        }
    }
}

/// What a step reports.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct StepReport {
    /// Steps done, this one included.
    pub step: usize,
    /// Loss.
    pub loss: f32,
    /// Mean absolute error of the expected number, number units.
    pub l1: f32,
    /// Norm of the gradients before clipping.
    pub gradient: f32,
    /// Learning rate.
    pub rate: f32,
}

/// A run: the model, its parameters, and how far it is.
pub struct Trainer {
    config: TrainConfig,
    files: FreshFiles,
    parameters: Parameters,
    model: SdimModel,
    step: usize,
    /// The batch of a coming step.
    prefetched: Option<(u64, Vec<Example>)>,
}

/// Momentum of the running statistics.
const BN_MOMENTUM: f32 = 0.05;

impl Trainer {
    /// A fresh tiny model.
    ///
    /// # Errors
    /// [`Error::Argument`] on an empty schedule or batch.
    pub fn new(config: TrainConfig, settings: &Settings) -> Result<Self> {
        let b = &config.batch;
        if config.steps == 0 || b.frames == 0 || b.questions == 0 || b.sizes.is_empty() {
            return Err(Error::argument("train config", format!("{config:?}"), "at least one of everything"));
        }
        if let PixelReference::Marker(_) = settings.pixel_reference {
            let expected =
                "a pixel reference that leaves the image as it is: batches share it between questions";
            return Err(Error::argument("pixel_reference", "marker", expected));
        }
        let files = FreshFiles::tiny(settings)?;
        let start = files.initial(config.seed)?;
        let parameters = Parameters::new(start)?;
        let weights = Weights::from_tensors("training", parameters.tensors());
        let model = SdimModel::new(files.parse()?, &weights, &Device::Cpu)?;
        Ok(Self { config, files, parameters, model, step: 0, prefetched: None })
    }

    /// Continues from a state written by [`Trainer::save`].
    ///
    /// # Errors
    /// As [`store::load_state`].
    pub fn resume(&mut self, dir: &Path) -> Result<()> {
        self.step = store::load_state(dir, &mut self.parameters)?;
        Ok(())
    }

    /// Writes the published checkpoint and the state to resume from.
    ///
    /// # Errors
    /// [`Error::Io`], [`Error::Tensors`].
    pub fn save(&self, dir: &Path) -> Result<()> {
        self.publish(dir)?;
        store::save_state(dir, &self.parameters, self.step)
    }

    /// Writes the published checkpoint alone.
    ///
    /// # Errors
    /// [`Error::Io`], [`Error::Tensors`].
    pub fn publish(&self, dir: &Path) -> Result<()> {
        store::publish(dir, &self.files, &self.parameters)
    }

    /// A model of the averaged weights, for evaluation.
    ///
    /// # Errors
    /// [`Error::Tensors`] if a tensor cannot be copied.
    pub fn averaged_model(&self) -> Result<SdimModel> {
        let tensors = self.parameters.averages()?.into_iter().collect();
        let weights = Weights::from_tensors("average", tensors);
        SdimModel::new(self.files.parse()?, &weights, &Device::Cpu)?.fold()
    }

    /// Steps done.
    pub fn step(&self) -> usize {
        self.step
    }

    /// Number of trained values.
    pub fn parameter_count(&self) -> usize {
        self.parameters.all.values().map(|p| p.values().len()).sum()
    }

    /// Learning rate of a step: linear warm-up, then a cosine.
    fn rate(&self, step: usize) -> f32 {
        let c = &self.config;
        if step < c.warmup {
            return c.rate * (step + 1) as f32 / c.warmup as f32;
        }
        let progress = (step - c.warmup) as f32 / (c.steps.saturating_sub(c.warmup)).max(1) as f32;
        c.rate * (0.01 + 0.99 * 0.5 * (1.0 + (std::f32::consts::PI * progress.min(1.0)).cos()))
    }

    /// One step on the next batch.
    ///
    /// # Errors
    /// [`Error::Argument`] if the gradients are not finite; errors of the scenes and the model.
    pub fn train_step(&mut self) -> Result<StepReport> {
        let step = self.step as u64;
        let examples = match self.prefetched.take() {
            Some((for_step, examples)) if for_step == step => examples,
            _ => self.make_batch(step)?,
        };
        let mut stats = Vec::new();
        let frozen = self.step as f32 >= self.config.freeze_norm_at * self.config.steps as f32;
        // The next batch is rendered in the gaps of this one: much of a backward pass runs on one thread.
        let (passes, next) = rayon::join(
            || -> Result<_> {
                let parts = self.loss(&examples, if frozen { None } else { Some(&mut stats) })?;
                let grads = parts.total.backward()?;
                Ok((parts, grads))
            },
            || self.make_batch(step + 1),
        );
        let (parts, grads) = passes?;
        self.prefetched = Some((step + 1, next?));
        let loss = parts.total.to_scalar::<f32>()?;
        let rate = self.rate(self.step);
        let gradient = self.parameters.step(&grads, &self.config.optimiser, rate, self.step + 1)?;
        self.update_statistics(&stats)?;
        self.step += 1;
        Ok(StepReport { step: self.step, loss, l1: parts.l1, gradient, rate })
    }

    fn make_batch(&self, step: u64) -> Result<Vec<Example>> {
        batch::make(&self.model, &self.config.batch, self.config.seed, step)
    }

    fn update_statistics(&mut self, stats: &[BatchStats]) -> Result<()> {
        for s in stats {
            for (part, new) in [("running_mean", &s.mean), ("running_var", &s.var)] {
                if let Some(p) = self.parameters.all.get_mut(&format!("{}.{part}", s.name)) {
                    let pairs = p.values().iter().zip(new);
                    let mixed: Vec<f32> = pairs.map(|(old, new)| old + BN_MOMENTUM * (new - old)).collect();
                    p.set(&mixed, &mixed)?;
                }
            }
        }
        Ok(())
    }

    /// Blur of the targets: wide at first, so that near misses teach, then narrow.
    fn bin_loss(&self, range: f64) -> BinLoss {
        let progress = self.step as f32 / (0.25 * self.config.steps as f32).max(1.0);
        let widen = 1.0 + 7.0 * (1.0 - progress).max(0.0);
        BinLoss { range, blur: 0.0015 * widen, blur_slope: 0.008 * widen, l1: self.config.l1 }
    }

    /// Forward pass over all examples, packed into one sequence of tokens.
    fn loss(&self, examples: &[Example], stats: Option<&mut Vec<BatchStats>>) -> Result<LossParts> {
        let image_tokens = self.encode(examples, stats)?;
        let decoder = &self.model.vlm.decoder;
        let packed = Packed::new(examples);
        let embedded = self.model.vlm.embed_prompt(&packed.ids, &image_tokens)?;
        let pairs = examples.iter().zip(&packed.glimpses);
        let groups: Vec<_> = pairs.map(|(e, g)| (&e.pixels.resized, g.as_slice())).collect();
        let embedded = self.model.add_glimpses(embedded, &groups)?;
        let table = decoder.rope().table(&packed.positions, &Device::Cpu)?;
        let layout = decoder.layout(packed.blocks);
        let hidden = decoder.forward(&embedded, &table, Context::Packed(&layout), None)?;
        let count = packed.supervised.len();
        let rows = hidden.index_select(&Tensor::from_vec(packed.supervised, count, &Device::Cpu)?, 0)?;
        let head = decoder.head_rows(&self.model.prompts.numbers().ids)?;
        let logits = kernels::linear(&decoder.final_norm(&rows)?, &head, None)?;
        let items = || examples.iter().flat_map(|e| &e.items);
        match self.model.prompts.numbers().format {
            NumberFormat::Bins { range, .. } => {
                loss::bins(&logits, items().map(|i| i.value).collect(), self.bin_loss(range))
            }
            NumberFormat::Digits { .. } => {
                let (mut chosen, mut place, mut number) = (vec![], vec![], vec![]);
                for (n, item) in items().enumerate() {
                    let point = item.answer.iter().position(|&c| c == POINT).unwrap_or(item.answer.len());
                    for (i, &c) in item.answer.iter().enumerate() {
                        let exponent = point as i32 - i as i32 - i32::from(i < point);
                        chosen.push(c as u32);
                        place.push(if c == POINT { 0.0 } else { 10f32.powi(exponent) / item.largest });
                        number.push(n as u32);
                    }
                }
                let numbers = items().count();
                loss::digits(&logits, &chosen, &place, &number, numbers, f64::from(self.config.l1))
            }
        }
    }

    /// Image tokens of all examples, which have one size (Eq. 1-3).
    fn encode(&self, examples: &[Example], stats: Option<&mut Vec<BatchStats>>) -> Result<Tensor> {
        let frames: Vec<&Pixels> = examples.iter().map(|e| &e.pixels).collect();
        let (width, height) = frames.first().map_or((0, 0), |p| p.resized.dimensions());
        let sparse: Vec<f32> = examples.iter().flat_map(|e| e.scattered.iter().copied()).collect();
        let shape = (examples.len(), height as usize, width as usize, 1);
        let sparse = Tensor::from_vec(sparse, shape, &Device::Cpu)?;
        self.model.encode_batch(&frames, &sparse, stats.map_or(Normalise::Running, Normalise::Batch))
    }
}

/// All examples' tokens in one sequence: each prefix, followed by its questions, which see it and themselves.
struct Packed {
    ids: Vec<u32>,
    positions: Vec<Position>,
    blocks: Vec<Block>,
    supervised: Vec<u32>,
    /// Per example.
    glimpses: Vec<Vec<Glimpse>>,
}

impl Packed {
    fn new(examples: &[Example]) -> Self {
        let mut out =
            Self { ids: vec![], positions: vec![], blocks: vec![], supervised: vec![], glimpses: vec![] };
        for e in examples {
            out.glimpses.push(Vec::new());
            let start = out.ids.len();
            out.extend(&e.prefix);
            let end = out.ids.len();
            let p = end - start;
            let block = Block {
                queries: start..end,
                shared: 0..0,
                own_start: start,
                q_period: p,
                k_period: p,
                causal: true,
            };
            out.blocks.push(block);
            for run in e.items.chunk_by(|a, b| a.tokens.len() == b.tokens.len()) {
                let (from, s) = (out.ids.len(), run[0].tokens.len());
                for item in run {
                    out.extend(&item.tokens);
                    let last = out.ids.len();
                    out.supervised.extend((last - item.supervised..last).map(|r| r as u32));
                }
                out.blocks.push(Block {
                    queries: from..out.ids.len(),
                    shared: start..end,
                    own_start: from,
                    q_period: s,
                    k_period: s,
                    causal: true,
                });
            }
        }
        out
    }

    fn extend(&mut self, tokens: &crate::query::prompt::Tokens) {
        let start = self.ids.len();
        if let Some(list) = self.glimpses.last_mut() {
            list.extend(tokens.glimpses.iter().map(|g| Glimpse { token: start + g.token, ..*g }));
        }
        self.ids.extend(&tokens.ids);
        self.positions.extend(&tokens.positions);
    }
}
