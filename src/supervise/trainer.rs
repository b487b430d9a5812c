//! The training loop.

use super::base::Base;
use super::batch::{self, Example};
use super::config::{CONFIG, TrainConfig};
use super::init::FreshFiles;
use super::loss::{self, BinLoss, LossParts, Target};
use super::mix::Scenes;
use super::optimiser::{Gradients, Parameters};
use super::pass;
use super::store::{self, Progress};
use crate::error::{Error, Result};
use crate::fusion::{BatchStats, Normalise};
use crate::kernels;
use crate::model::{Adapter, SETTINGS, SdimModel};
use crate::query::bins::Bins;
use crate::query::number::POINT;
use crate::query::{AnswerMode, PixelReference, Settings};
use crate::vlm::checkpoint::weights::Weights;
use candle_core::Device;
use std::path::Path;

/// What a step reports.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct StepReport {
    /// Steps done, this one included.
    pub step: usize,
    /// Loss.
    pub loss: f32,
    /// Mean absolute error of the expected number, in what its frame's errors are counted in.
    pub l1: f32,
    /// Norm of the gradients before clipping.
    pub gradient: f32,
    /// Learning rate.
    pub rate: f32,
    /// Whether the step was skipped: its loss, its gradients or the statistics of its batch are not finite, so that it
    /// changed neither weights nor moments nor statistics.
    pub skipped: bool,
}

/// A run: the model, its parameters, and how far it is.
pub struct Trainer {
    config: TrainConfig,
    files: FreshFiles,
    parameters: Parameters,
    model: SdimModel,
    /// Where its frames come from.
    scenes: Scenes,
    progress: Progress,
    /// The batch of a coming step.
    prefetched: Option<(u64, Vec<Example>)>,
}

/// Momentum of the running statistics.
const BN_MOMENTUM: f32 = 0.05;

/// Steps skipped in a row that end a run: it will not find back by itself.
const SKIPPED_AT_MOST: usize = 20;

/// Refuses settings of a model whose batches cannot be made here; `file` is for messages.
pub(super) fn check_shared(settings: &Settings, file: &str) -> Result<()> {
    if let PixelReference::Marker(_) = settings.pixel_reference {
        let expected = "a pixel reference that leaves the image as it is: batches share it between questions";
        return Err(Error::config(file, "pixel_reference.kind", "marker", expected));
    }
    Ok(())
}

/// Refuses settings of a model that would not come out as it is to be used; `file` is for messages.
fn check_settings(settings: &Settings, file: &str) -> Result<()> {
    if let AnswerMode::Generate(_) = settings.answer_mode {
        let expected = "digits: numbers are trained, not the words of a free answer";
        return Err(Error::config(file, "answer_mode.kind", "generate", expected));
    }
    if let Some(lora) = &settings.lora {
        let expected = "none: all weights are trained themselves, without low-rank additions";
        return Err(Error::config(file, "lora", format!("{lora:?}"), expected));
    }
    Ok(())
}

/// Refuses frames that are rendered in a size that the model's patches do not fill; `dir` is for messages.
fn check_sizes(config: &TrainConfig, files: &FreshFiles, dir: &Path) -> Result<()> {
    let vision = files.parse_of(dir)?.config.vision;
    let side = vision.patch_size * vision.merge_size;
    match config.batch.sizes.iter().find(|s| s.0 % side != 0 || s.1 % side != 0) {
        None => Ok(()),
        Some(size) => {
            let file = dir.join(CONFIG).display().to_string();
            let expected = format!("sides that are multiples of {side} pixels");
            Err(Error::config(&file, "batch.sizes", format!("{size:?}"), expected))
        }
    }
}

impl Trainer {
    /// A fresh tiny model.
    ///
    /// # Errors
    /// [`Error::Config`] names what is out of range in the configuration (as of `train.json`), or cannot be trained of the
    /// settings (as of `sdim.json`): a marker, free answers, LoRA.
    pub fn new(config: TrainConfig, settings: &Settings) -> Result<Self> {
        let here = Path::new("");
        check_shared(settings, SETTINGS)?;
        check_settings(settings, SETTINGS)?;
        let files = FreshFiles::tiny(settings)?;
        check_sizes(&config, &files, here)?;
        let parameters = Parameters::new(files.initial(config.seed)?)?;
        Self::start(config, files, here, parameters)
    }

    /// Continues a run from the directory that [`Trainer::save`] wrote: with its configuration (`train.json`), its model's
    /// files and its state. The steps that follow are those of a run that was never interrupted, bit for bit.
    ///
    /// # Errors
    /// As [`TrainConfig::load`]; what the model's files and the state can have wrong, naming the file.
    pub fn resume(dir: &Path) -> Result<Self> {
        let (config, files) = (TrainConfig::load(dir)?, FreshFiles::load(dir)?);
        check_shared(&files.parse_of(dir)?.settings, &dir.join(SETTINGS).display().to_string())?;
        check_sizes(&config, &files, dir)?;
        let parameters = Parameters::new(files.initial(config.seed)?)?;
        let mut trainer = Self::start(config, files, dir, parameters)?;
        trainer.progress = store::load_state(dir, &mut trainer.parameters)?;
        Ok(trainer)
    }

    /// Goes on from a checkpoint of any shape, with its files, from its weights and with fresh moments at step 0.
    ///
    /// # Errors
    /// As [`Trainer::new`]; [`Error::Tensor`] or [`Error::TensorSet`] if weights and files do not belong together.
    pub fn going_on(config: TrainConfig, base: &Base) -> Result<Self> {
        let settings = base.files.parse_of(&base.dir)?.settings;
        check_shared(&settings, &base.dir.join(SETTINGS).display().to_string())?;
        check_sizes(&config, &base.files, &base.dir)?;
        Self::of(config, base, |_| true)
    }

    /// Goes on from a checkpoint of any shape, with its files, and trains the tensors of these names alone, on batches of the caller's
    /// ([`Trainer::step_on`]).
    ///
    /// # Errors
    /// As [`Trainer::going_on`], sizes and markers aside.
    pub fn of(config: TrainConfig, base: &Base, trained: impl Fn(&str) -> bool) -> Result<Self> {
        let mut parameters = Parameters::new(base.files.initial(config.seed)?)?;
        base.fill(&mut parameters)?;
        parameters.train_only(trained);
        Self::start(config, base.files.clone(), &base.dir, parameters)
    }

    /// A run at its first step; `dir` is where the files are from, for messages.
    fn start(config: TrainConfig, files: FreshFiles, dir: &Path, parameters: Parameters) -> Result<Self> {
        let place = |name: &str| dir.join(name).display().to_string();
        config.validate(&place(CONFIG))?;
        check_settings(&files.parse_of(dir)?.settings, &place(SETTINGS))?;
        let weights = Weights::from_tensors("training", parameters.tensors());
        let model = SdimModel::new(files.parse()?, &weights, &Device::Cpu)?;
        let (scenes, progress) = (Scenes::new(config.batch.mix), Progress::default());
        Ok(Self { config, files, parameters, model, scenes, progress, prefetched: None })
    }

    /// Furnishes the rooms of the mix with models of a library.
    ///
    /// # Errors
    /// As [`Scenes::with_library`].
    #[cfg(feature = "meshes")]
    pub fn with_library(mut self, library: &crate::scenes::furnished::Library) -> Result<Self> {
        self.scenes = self.scenes.with_library(library, false)?;
        Ok(self)
    }

    /// Checks that there are models for all scenes of the mix.
    ///
    /// # Errors
    /// As [`Scenes::check`].
    pub fn check_scenes(&self) -> Result<()> {
        self.scenes.check(false)
    }

    /// The run's configuration.
    pub fn config(&self) -> &TrainConfig {
        &self.config
    }

    /// Writes the published checkpoint, the configuration, and the state to resume from.
    ///
    /// Each file is written whole, and the state last. Whenever it is interrupted, the directory holds this run as it was
    /// saved before, or no state if it held that of another run: never one run's state beside another's configuration.
    ///
    /// # Errors
    /// [`Error::Io`], [`Error::Tensors`].
    pub fn save(&self, dir: &Path) -> Result<()> {
        let same = TrainConfig::load(dir).is_ok_and(|there| there == self.config)
            && FreshFiles::load(dir).is_ok_and(|there| there == self.files);
        if !same {
            store::remove_state(dir)?;
        }
        self.publish(dir)?;
        self.config.save(dir)?;
        store::save_state(dir, &self.parameters, self.progress)
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
    #[doc(hidden)]
    pub fn averaged_model(&self) -> Result<SdimModel> {
        let tensors = self.parameters.averages()?.into_iter().collect();
        let weights = Weights::from_tensors("average", tensors);
        SdimModel::new(self.files.parse()?, &weights, &Device::Cpu)?.fold()
    }

    /// What became of a checkpoint: an adapter that holds, in f32, the averages that differ from its weights.
    ///
    /// # Errors
    /// [`Error::Argument`] for a checkpoint with other files than this run's; [`Error::Tensors`] if a tensor cannot be copied.
    pub fn adapter(&self, base: &Base) -> Result<Adapter> {
        if self.files != base.files {
            return Err(Error::argument("base", base.dir.display(), "what this run went on from"));
        }
        let mut before = Parameters::new(base.files.initial(self.config.seed)?)?;
        base.fill(&mut before)?;
        let mut tensors = self.parameters.averages()?;
        tensors.retain(|name, _| {
            before.all.get(name).is_none_or(|p| p.values() != self.parameters.all[name].average)
        });
        Ok(Adapter { settings: self.files.parse()?.settings, tensors })
    }

    /// The model as it is trained.
    pub fn model(&self) -> &SdimModel {
        &self.model
    }

    /// Steps done, those that were skipped included.
    pub fn step(&self) -> usize {
        self.progress.step
    }

    /// Steps that were skipped (see [`StepReport::skipped`]).
    pub fn skipped(&self) -> usize {
        self.progress.skipped
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

    /// One step on the next batch. It is skipped if it would write numbers that are not finite.
    ///
    /// # Errors
    /// [`Error::Diverged`] when 20 steps in a row were skipped; errors of the scenes and the model.
    pub fn train_step(&mut self) -> Result<StepReport> {
        let step = self.progress.step as u64;
        let examples = match self.prefetched.take() {
            Some((for_step, examples)) if for_step == step => examples,
            _ => self.make_batch(step)?,
        };
        let (config, scenes, seed) = (self.config.batch.clone(), self.scenes.clone(), self.config.seed);
        let next = |model: &SdimModel| batch::make(model, &config, &scenes, seed, step + 1);
        let (report, next) = self.step_on(&examples, next)?;
        self.prefetched = Some((step + 1, next));
        Ok(report)
    }

    /// One step on these examples, while `next` makes those of the step that follows. It is skipped if it would write numbers
    /// that are not finite.
    ///
    /// # Errors
    /// As [`Trainer::train_step`], and those of `next`.
    pub fn step_on<T: Send>(
        &mut self,
        examples: &[Example],
        next: impl FnOnce(&SdimModel) -> Result<T> + Send,
    ) -> Result<(StepReport, T)> {
        let mut stats = Vec::new();
        let frozen = self.progress.step as f32 >= self.config.freeze_norm_at * self.config.steps as f32;
        // The next batch is rendered in the gaps of this one: much of a backward pass runs on one thread.
        let (passes, next) = kernels::join(
            &self.model.device,
            || -> Result<_> {
                let parts = self.loss(examples, if frozen { None } else { Some(&mut stats) })?;
                let grads = parts.total.backward()?;
                Ok((parts, grads))
            },
            || next(&self.model),
        );
        let (parts, grads) = passes?;
        let next = next?;
        let loss = parts.total.to_scalar::<f32>()?;
        let rate = self.rate(self.progress.step);
        let gradients = self.parameters.gradients(&grads)?;
        let gradient = gradients.norm();
        let measured = stats.iter().flat_map(|s| s.mean.iter().chain(&s.var));
        let skipped = ![loss, gradient].iter().chain(measured).all(|v| v.is_finite());
        self.progress.step += 1;
        if skipped {
            self.skip()?;
        } else {
            self.update(gradients, &stats, rate)?;
        }
        let report = StepReport { step: self.progress.step, loss, l1: parts.l1, gradient, rate, skipped };
        Ok((report, next))
    }

    fn skip(&mut self) -> Result<()> {
        let p = &mut self.progress;
        p.skipped += 1;
        p.skipped_in_a_row += 1;
        if p.skipped_in_a_row >= SKIPPED_AT_MOST {
            return Err(Error::Diverged { step: p.step, skipped: p.skipped_in_a_row });
        }
        Ok(())
    }

    fn update(&mut self, gradients: Gradients, stats: &[BatchStats], rate: f32) -> Result<()> {
        self.progress.skipped_in_a_row = 0;
        let updates = self.progress.updates();
        self.parameters.step(gradients, &self.config.optimiser, rate, updates)?;
        self.update_statistics(stats)?;
        self.parameters.average(&self.config.optimiser, updates);
        Ok(())
    }

    fn make_batch(&self, step: u64) -> Result<Vec<Example>> {
        batch::make(&self.model, &self.config.batch, &self.scenes, self.config.seed, step)
    }

    fn update_statistics(&mut self, stats: &[BatchStats]) -> Result<()> {
        for s in stats {
            for (part, new) in [("running_mean", &s.mean), ("running_var", &s.var)] {
                let name = format!("{}.{part}", s.name);
                if let Some(p) = self.parameters.all.get_mut(&name).filter(|p| !p.frozen()) {
                    let pairs = p.values().iter().zip(new);
                    let mixed: Vec<f32> = pairs.map(|(old, new)| old + BN_MOMENTUM * (new - old)).collect();
                    p.set(&mixed)?;
                }
            }
        }
        Ok(())
    }

    /// Blur of the targets: wide at first, so that near misses teach, then narrow.
    fn bin_loss(&self, bins: Bins) -> BinLoss {
        let progress = self.progress.step as f32 / (0.25 * self.config.steps as f32).max(1.0);
        let widen = 1.0 + self.config.widen * (1.0 - progress).max(0.0);
        BinLoss { bins, blur: 0.0015 * widen, blur_slope: 0.008 * widen, l1: self.config.l1 }
    }

    /// Loss of all examples in one pass.
    fn loss(&self, examples: &[Example], stats: Option<&mut Vec<BatchStats>>) -> Result<LossParts> {
        let normalise = stats.map_or(Normalise::Running, Normalise::Batch);
        let logits = pass::logits(&self.model, examples, normalise)?;
        let items = || examples.iter().flat_map(|e| &e.items);
        match self.model.prompts.numbers().format.bins() {
            Some(bins) => {
                let targets = items().map(|i| Target { value: i.value, scale: i.scale });
                loss::bins(&logits, targets.collect(), self.bin_loss(bins))
            }
            None => {
                let (mut chosen, mut place, mut number) = (vec![], vec![], vec![]);
                for (n, item) in items().enumerate() {
                    let point = item.answer.iter().position(|&c| c == POINT).unwrap_or(item.answer.len());
                    for (i, &c) in item.answer.iter().enumerate() {
                        let exponent = point as i32 - i as i32 - i32::from(i < point);
                        chosen.push(c as u32);
                        place.push(if c == POINT { 0.0 } else { 10f32.powi(exponent) / item.scale });
                        number.push(n as u32);
                    }
                }
                let numbers = items().count();
                loss::digits(&logits, &chosen, &place, &number, numbers, f64::from(self.config.l1))
            }
        }
    }
}

#[cfg(test)]
#[path = "trainer_tests.rs"]
mod tests;
