//! Training: every way of asking can be trained, runs repeat and resume exactly, and the loss falls.

use sdim::query::{MeasurementPrompt, NumberFormat, PixelReference, PromptTemplate, Settings};
use sdim::supervise::{LabelSource, TrainConfig, Trainer};

fn small() -> TrainConfig {
    let mut config = TrainConfig { steps: 40, warmup: 2, rate: 2e-3, ..Default::default() };
    config.batch.frames = 1;
    config.batch.questions = 24;
    config.batch.points = (40, 80);
    config.batch.sizes = vec![(96, 64)];
    config
}

#[test]
fn the_loss_falls() {
    let mut trainer = Trainer::new(small(), &Settings::tiny()).unwrap();
    let losses: Vec<f32> = (0..30).map(|_| trainer.train_step().unwrap().loss).collect();
    let mean = |l: &[f32]| l.iter().sum::<f32>() / l.len() as f32;
    let (first, last) = (mean(&losses[..5]), mean(&losses[25..]));
    assert!(last < 0.8 * first, "{first} to {last}");
}

#[test]
fn a_resumed_run_is_the_run() {
    let dir = tempfile::tempdir().unwrap();
    let mut whole = Trainer::new(small(), &Settings::tiny()).unwrap();
    let reports: Vec<_> = (0..4).map(|_| whole.train_step().unwrap()).collect();

    let mut first = Trainer::new(small(), &Settings::tiny()).unwrap();
    assert_eq!(first.train_step().unwrap(), reports[0], "the same seed gives the same step");
    first.train_step().unwrap();
    first.save(dir.path()).unwrap();
    let mut second = Trainer::new(small(), &Settings::tiny()).unwrap();
    second.resume(dir.path()).unwrap();
    assert_eq!(second.step(), 2);
    assert_eq!(second.train_step().unwrap(), reports[2]);
    assert_eq!(second.train_step().unwrap(), reports[3]);
}

#[test]
fn the_papers_words_and_digits_are_trained_on_sparse_labels() {
    let mut config = small();
    config.batch.labels = LabelSource::Sparse;
    config.batch.questions = 4;
    // At full weight the L1 of single frames, near and far, differs more than twelve steps can learn.
    config.l1 = 0.1;
    let digits = NumberFormat::Digits { decimals: 2, integers: 2 };
    let pointer = PixelReference::Pointer { token: "<|point|>".into() };
    let cases = [
        // The paper: sentences, coordinates, mask per query.
        Settings { number: digits, fusion: Settings::tiny().fusion, ..Settings::paper() },
        // Digits at a pointer, measurements in the prefix.
        Settings { number: digits, pixel_reference: pointer, ..Settings::tiny() },
        // One number token as the answer to the paper's sentences.
        Settings {
            template: PromptTemplate::paper(),
            measurements: MeasurementPrompt::None,
            pixel_reference: PixelReference::Coordinates,
            ..Settings::tiny()
        },
    ];
    for settings in cases {
        let mut trainer = Trainer::new(config.clone(), &settings).unwrap();
        let losses: Vec<f32> = (0..12).map(|_| trainer.train_step().unwrap().loss).collect();
        assert!(losses.iter().all(|l| l.is_finite()), "{losses:?}");
        let mean = |l: &[f32]| l.iter().sum::<f32>() / l.len() as f32;
        assert!(mean(&losses[8..]) < mean(&losses[..4]), "{losses:?}");
    }
}

#[test]
fn running_statistics_are_measured_and_never_trained() {
    let dir = tempfile::tempdir().unwrap();
    let frozen = TrainConfig { freeze_norm_at: 0.0, ..small() };
    let mut trainer = Trainer::new(frozen, &Settings::tiny()).unwrap();
    let statistics = |trainer: &Trainer| -> Vec<Vec<f32>> {
        trainer.save(dir.path()).unwrap();
        let state =
            candle_core::safetensors::load(dir.path().join("trainer.safetensors"), &candle_core::Device::Cpu);
        let mut parts: Vec<_> = state
            .unwrap()
            .into_iter()
            .filter(|(n, _)| n.starts_with("value/") && n.contains("running_"))
            .collect();
        parts.sort_by(|a, b| a.0.cmp(&b.0));
        assert_eq!(parts.len(), 8);
        parts.iter().map(|(_, t)| t.to_vec1().unwrap()).collect()
    };
    let before = statistics(&trainer);
    trainer.train_step().unwrap();
    assert_eq!(statistics(&trainer), before, "frozen");
    let mut moving = Trainer::new(small(), &Settings::tiny()).unwrap();
    moving.train_step().unwrap();
    assert_ne!(statistics(&moving), before, "measured");
}

#[test]
fn a_state_of_another_model_is_refused() {
    let dir = tempfile::tempdir().unwrap();
    Trainer::new(small(), &Settings::tiny()).unwrap().save(dir.path()).unwrap();
    let bare = Settings { fusion: None, glimpse: None, ..Settings::tiny() };
    let mut other = Trainer::new(small(), &bare).unwrap();
    assert!(matches!(other.resume(dir.path()), Err(sdim::Error::TensorSet { .. })));
    std::fs::write(dir.path().join("trainer.safetensors"), b"cut").unwrap();
    assert!(matches!(other.resume(dir.path()), Err(sdim::Error::Format { .. })));
    std::fs::remove_file(dir.path().join("trainer.safetensors")).unwrap();
    assert!(matches!(other.resume(dir.path()), Err(sdim::Error::Io { .. })));
    other.save(dir.path()).unwrap();
    let mut full = Trainer::new(small(), &Settings::tiny()).unwrap();
    assert!(matches!(full.resume(dir.path()), Err(sdim::Error::Tensor { .. })));
    let none = TrainConfig { steps: 0, ..small() };
    assert!(matches!(Trainer::new(none, &Settings::tiny()), Err(sdim::Error::Argument { .. })));
}
