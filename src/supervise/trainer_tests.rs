//! What can be seen of a run only from inside.

use super::super::optimiser::Parameter;
use super::*;
use crate::query::{DepthUnit, NumberFormat};
use candle_core::Tensor;
use std::collections::HashMap;

fn small() -> TrainConfig {
    let mut config = TrainConfig { steps: 40, warmup: 2, rate: 2e-3, ..Default::default() };
    config.batch.frames = 1;
    config.batch.questions = 24;
    config.batch.points = (40, 80);
    config.batch.sizes = vec![(96, 64)];
    config
}

fn values(tensor: &Tensor) -> Vec<f32> {
    tensor.flatten_all().unwrap().to_vec1().unwrap()
}

/// A model of copies of the current values, as a loader would build it in f32.
fn rebuilt(trainer: &Trainer) -> SdimModel {
    let copy = |p: &Parameter| Tensor::from_slice(p.values(), p.var.shape(), &Device::Cpu).unwrap();
    let tensors: HashMap<_, _> = trainer.parameters.all.iter().map(|(n, p)| (n.clone(), copy(p))).collect();
    SdimModel::new(trainer.files.parse().unwrap(), &Weights::from_tensors("copy", tensors), &Device::Cpu)
        .unwrap()
}

#[test]
fn the_model_that_is_trained_is_the_one_that_its_values_load_as() {
    let mut trainer = Trainer::new(small(), &Settings::tiny()).unwrap();
    for _ in 0..20 {
        trainer.train_step().unwrap();
    }
    let examples = trainer.make_batch(1000).unwrap();
    let loaded = rebuilt(&trainer);
    let folded = rebuilt(&trainer).fold().unwrap();
    let close = |what: &str, found: Tensor, expected: Tensor| {
        let (found, expected) = (values(&found), values(&expected));
        let largest = expected.iter().fold(0f32, |m, v| m.max(v.abs()));
        let off = found.iter().zip(&expected).fold(0f32, |m, (a, b)| m.max((a - b).abs()));
        assert!(off <= 1e-5 * largest, "{what}: {off:e} of {largest}");
    };
    type Forward = fn(&SdimModel, &[Example], Normalise) -> Result<Tensor>;
    let passes = [("image tokens", pass::encode as Forward), ("logits", pass::logits)];
    for (what, pass) in passes {
        let running = |model| pass(model, &examples, Normalise::Running).unwrap();
        let batch = |model| pass(model, &examples, Normalise::Batch(&mut Vec::new())).unwrap();
        let own = &trainer.model;
        close(&format!("{what}, statistics of the batch"), batch(own), batch(&loaded));
        close(&format!("{what}, running statistics"), running(own), running(&loaded));
        close(&format!("{what}, folded"), running(own), running(&folded));
    }
}

#[test]
fn errors_are_counted_in_the_largest_measurement_or_in_medians() {
    let tiny = Trainer::new(small(), &Settings::tiny()).unwrap();
    let examples = tiny.make_batch(0).unwrap();
    assert!(examples[0].items.iter().all(|i| i.scale == 2.0), "two medians");
    let metres = Settings {
        unit: DepthUnit::Metres,
        number: NumberFormat::Bins { bins: 1000, range: 100.0 },
        wide_glimpse: None,
        ..Settings::tiny()
    };
    let digits = Settings { number: NumberFormat::Digits { decimals: 2, integers: 3 }, ..metres.clone() };
    for settings in [metres, digits] {
        let trainer = Trainer::new(small(), &settings).unwrap();
        let mut examples = trainer.make_batch(0).unwrap();
        let scale = examples[0].items[0].scale;
        let measured = examples[0].scattered.iter().fold(0f32, |m, v| m.max(*v));
        assert!(scale == measured && scale != 1.0, "{scale} m, {measured} m");
        let once = trainer.loss(&examples, None).unwrap().l1;
        for item in examples.iter_mut().flat_map(|e| &mut e.items) {
            item.scale *= 2.0;
        }
        let half = trainer.loss(&examples, None).unwrap().l1;
        assert!((once - 2.0 * half).abs() < 1e-6 * once, "{once}, {half} of twice as far a frame");
    }
}

#[test]
fn what_is_not_trained_keeps_its_values_and_is_in_no_adapter() {
    let files = FreshFiles::tiny(&Settings::tiny()).unwrap();
    let initial = files.initial(5).unwrap();
    let base = Base::of(files, initial.clone());
    let decoder = |name: &str| name.starts_with("model.");
    let mut trainer = Trainer::of(small(), &base, decoder).unwrap();
    for _ in 0..2 {
        assert!(!trainer.train_step().unwrap().skipped);
    }
    for (name, p) in &trainer.parameters.all {
        assert_eq!(p.values() != values(&initial[name]), decoder(name), "{name}");
    }
    let adapter = trainer.adapter(&base).unwrap();
    assert!(adapter.tensors.contains_key("model.norm.weight") && adapter.tensors.keys().all(|n| decoder(n)));
}

#[test]
fn targets_of_a_model_that_knows_are_sharp_at_once() {
    let width = |widen: f32| {
        let trainer = Trainer::new(TrainConfig { widen, ..small() }, &Settings::tiny()).unwrap();
        let bins = trainer.model.prompts.numbers().format.bins().unwrap();
        trainer.bin_loss(bins).blur
    };
    assert_eq!(width(7.0), 8.0 * width(0.0));
}

/// Values, averages and both moments of all tensors.
fn everything(trainer: &Trainer) -> Vec<[Vec<f32>; 4]> {
    let all = trainer.parameters.all.values();
    all.map(|p| [p.values().to_vec(), p.average.clone(), p.m.clone(), p.v.clone()]).collect()
}

#[test]
fn running_statistics_are_published_averaged_as_weights_are() {
    // The last steps are frozen: averages still come nearer.
    let config = TrainConfig { steps: 10, freeze_norm_at: 0.6, ..small() };
    let mut trainer = Trainer::new(config, &Settings::tiny()).unwrap();
    let name = |n: &&String| n.contains(".running_") || n.ends_with("gate_proj.weight");
    let names: Vec<String> = trainer.parameters.all.keys().filter(name).cloned().collect();
    assert_eq!(names.len(), 8 + 10);
    let mut averages: Vec<Vec<f32>> =
        names.iter().map(|n| trainer.parameters.all[n].values().to_vec()).collect();
    for step in 1..=10 {
        trainer.train_step().unwrap();
        let keep = trainer.config.optimiser.average.min((1 + step) as f32 / (10 + step) as f32);
        for (name, average) in names.iter().zip(&mut averages) {
            for (a, v) in average.iter_mut().zip(trainer.parameters.all[name].values()) {
                *a += (1.0 - keep) * (v - *a);
            }
        }
    }
    let dir = tempfile::tempdir().unwrap();
    trainer.publish(dir.path()).unwrap();
    let published =
        candle_core::safetensors::load(dir.path().join("model.safetensors"), &Device::Cpu).unwrap();
    for (name, average) in names.iter().zip(&averages) {
        let found = values(&published[name].to_dtype(candle_core::DType::F32).unwrap());
        for (found, expected) in found.iter().zip(average) {
            assert_eq!(*found, half::bf16::from_f32(*expected).to_f32(), "{name}");
        }
    }
}

#[test]
fn a_step_that_is_not_finite_changes_nothing() {
    let mut trainer = Trainer::new(small(), &Settings::tiny()).unwrap();
    let first = trainer.train_step().unwrap();
    assert!(!first.skipped && trainer.skipped() == 0);
    let before = everything(&trainer);
    let spoil = |trainer: &mut Trainer, name: &str, value: f32| {
        let p = trainer.parameters.all.get_mut(name).unwrap();
        let mut values = p.values().to_vec();
        let good = std::mem::replace(&mut values[0], value);
        p.set(&values).unwrap();
        good
    };
    let norm = "model.norm.weight";
    let good = spoil(&mut trainer, norm, f32::NAN);
    let report = trainer.train_step().unwrap();
    assert!(report.skipped && report.step == 2 && !report.gradient.is_finite(), "{report:?}");
    spoil(&mut trainer, norm, good);
    assert!(everything(&trainer) == before, "a skipped step left something behind");

    // What was skipped is remembered over an interruption.
    let dir = tempfile::tempdir().unwrap();
    trainer.save(dir.path()).unwrap();
    trainer = Trainer::resume(dir.path()).unwrap();
    assert_eq!(trainer.progress, Progress { step: 2, skipped: 1, skipped_in_a_row: 1 });
    let report = trainer.train_step().unwrap();
    assert!(!report.skipped && report.gradient.is_finite());
    assert_eq!(trainer.progress, Progress { step: 3, skipped: 1, skipped_in_a_row: 0 });
    assert_ne!(everything(&trainer), before);
}

#[test]
fn statistics_that_are_not_finite_are_not_kept() {
    let mut trainer = Trainer::new(small(), &Settings::tiny()).unwrap();
    let before = everything(&trainer);
    // The last normalisation's statistics overflow; behind it all is finite again.
    let name = "sdim.fusion.low.conv.weight";
    let p = trainer.parameters.all.get_mut(name).unwrap();
    let good = p.values().to_vec();
    p.set(&vec![3e30; good.len()]).unwrap();
    assert!(trainer.train_step().unwrap().skipped);
    trainer.parameters.all.get_mut(name).unwrap().set(&good).unwrap();
    assert!(everything(&trainer) == before);
}
