//! What can be seen of a run only from inside.

use super::super::optimiser::Parameter;
use super::*;
use crate::query::DepthUnit;
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
fn errors_in_metres_are_counted_in_the_largest_measurement() {
    let metres = Settings {
        unit: DepthUnit::Metres,
        number: NumberFormat::Bins { bins: 1000, range: 100.0 },
        ..Settings::tiny()
    };
    let digits = Settings { number: NumberFormat::Digits { decimals: 2, integers: 3 }, ..metres.clone() };
    for settings in [metres, digits] {
        let trainer = Trainer::new(small(), &settings).unwrap();
        let mut examples = trainer.make_batch(0).unwrap();
        let largest = examples[0].items[0].largest;
        let measured = examples[0].scattered.iter().fold(0f32, |m, v| m.max(*v));
        assert!(largest == measured && largest != 1.0, "{largest} m, {measured} m");
        let once = trainer.loss(&examples, None).unwrap().l1;
        for item in examples.iter_mut().flat_map(|e| &mut e.items) {
            item.largest *= 2.0;
        }
        let half = trainer.loss(&examples, None).unwrap().l1;
        assert!((once - 2.0 * half).abs() < 1e-6 * once, "{once}, {half} of twice as far a frame");
    }
}
