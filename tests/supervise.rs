//! Training: every way of asking can be trained, runs repeat and resume exactly, and the loss falls.

use sdim::Error;
use sdim::internals::model::SdimModel;
use sdim::internals::supervise::{LabelSource, TrainConfig, Trainer};
use sdim::settings::{
    AnswerMode, Generation, LoraConfig, Marker, MeasurementPrompt, NumberFormat, PixelReference,
    PromptTemplate, Settings,
};
use std::path::Path;

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
    // Normalisations freeze between the steps that are compared, and the blur of the targets narrows.
    let config = || TrainConfig { steps: 6, rate: 1.0 / 300.0, seed: 11, ..small() };
    let [one, two] = [(); 2].map(|()| tempfile::tempdir().unwrap());
    let mut whole = Trainer::new(config(), &Settings::tiny()).unwrap();
    let reports: Vec<_> = (0..5).map(|_| whole.train_step().unwrap()).collect();
    whole.save(one.path()).unwrap();

    let mut first = Trainer::new(config(), &Settings::tiny()).unwrap();
    assert_eq!(first.train_step().unwrap(), reports[0], "the same seed gives the same step");
    first.train_step().unwrap();
    first.save(two.path()).unwrap();
    // As if it were interrupted after it had published, before the state was written.
    first.train_step().unwrap();
    first.publish(two.path()).unwrap();
    let mut second = Trainer::resume(two.path()).unwrap();
    assert_eq!((second.step(), second.config()), (2, &config()));
    for expected in &reports[2..] {
        assert_eq!(second.train_step().unwrap(), *expected);
    }
    second.save(two.path()).unwrap();
    for name in FILES {
        let read = |dir: &tempfile::TempDir| std::fs::read(dir.path().join(name)).unwrap();
        assert!(read(&one) == read(&two), "{name}");
    }
}

/// What a run leaves in its directory.
const FILES: [&str; 7] = [
    "config.json",
    "model.safetensors",
    "preprocessor_config.json",
    "sdim.json",
    "tokenizer.json",
    "train.json",
    "trainer.safetensors",
];

#[test]
fn an_interrupted_save_leaves_no_mixture_of_two_runs() {
    let dir = tempfile::tempdir().unwrap();
    let path = |name: &str| dir.path().join(name);
    let blocked = |name: &str| {
        std::fs::remove_file(path(name)).unwrap();
        std::fs::create_dir(path(name)).unwrap();
    };
    let other = TrainConfig { seed: 8, ..small() };
    Trainer::new(small(), &Settings::tiny()).unwrap().save(dir.path()).unwrap();
    blocked("train.json");
    let trainer = Trainer::new(other, &Settings::tiny()).unwrap();
    assert!(matches!(trainer.save(dir.path()), Err(Error::Io { .. })));
    assert!(!path("trainer.safetensors").exists(), "the state of another configuration");
    std::fs::remove_dir(path("train.json")).unwrap();
    trainer.save(dir.path()).unwrap();
    assert_eq!(Trainer::resume(dir.path()).unwrap().config().seed, 8);

    blocked("sdim.json");
    let metres = Settings { unit: sdim::settings::DepthUnit::Metres, ..Settings::tiny() };
    let trainer = Trainer::new(small(), &metres).unwrap();
    assert!(matches!(trainer.publish(dir.path()), Err(Error::Io { .. })));
    assert!(!path("model.safetensors").exists(), "weights beside the files of others");
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
        Settings { number: digits, pixel_reference: pointer, wide_glimpse: None, ..Settings::tiny() },
        // One number token as the answer to the paper's sentences.
        Settings {
            template: PromptTemplate::paper(),
            measurements: MeasurementPrompt::None,
            pixel_reference: PixelReference::Coordinates,
            wide_glimpse: None,
            ..Settings::tiny()
        },
    ];
    for settings in cases {
        let mut trainer = Trainer::new(config.clone(), &settings).unwrap();
        let losses: Vec<f32> = (0..12).map(|_| trainer.train_step().unwrap().loss).collect();
        assert!(losses.iter().all(|l| l.is_finite()), "{losses:?}");
        let mean = |l: &[f32]| l.iter().sum::<f32>() / l.len() as f32;
        assert!(mean(&losses[8..]) < mean(&losses[..4]), "{losses:?}");
        let dir = tempfile::tempdir().unwrap();
        trainer.publish(dir.path()).unwrap();
        let loaded =
            SdimModel::load(dir.path(), &sdim::LoadOptions::default().with_weights(sdim::WeightFormat::F32))
                .unwrap();
        assert_eq!(loaded.prompts.settings(), &settings);
    }
}

#[test]
fn settings_that_would_not_come_out_as_they_are_used_are_refused() {
    let key = |settings: &Settings| match Trainer::new(small(), settings) {
        Err(Error::Config { file, key, .. }) => {
            assert_eq!(file, "sdim.json");
            key
        }
        Err(other) => panic!("{other}"),
        Ok(_) => panic!("{settings:?}"),
    };
    let lora = LoraConfig { rank: 2, alpha: 4.0, targets: vec!["q_proj".into()] };
    let lora = Settings { lora: Some(lora), ..Settings::tiny() };
    assert_eq!(key(&lora), "lora");
    let spoken = Settings { answer_mode: AnswerMode::Generate(Generation::default()), ..Settings::paper() };
    assert_eq!(key(&spoken), "answer_mode.kind");
    let marked = Settings {
        template: PromptTemplate::paper_marked(),
        pixel_reference: PixelReference::Marker(Marker::default()),
        ..Settings::paper()
    };
    assert_eq!(key(&marked), "pixel_reference.kind");
    // Nor is a run of such settings gone on with.
    let dir = tempfile::tempdir().unwrap();
    Trainer::new(small(), &Settings::tiny()).unwrap().save(dir.path()).unwrap();
    std::fs::write(dir.path().join("sdim.json"), lora.to_json().unwrap()).unwrap();
    match Trainer::resume(dir.path()) {
        Err(Error::Config { file, key, .. }) => {
            assert!(key == "lora" && Path::new(&file) == dir.path().join("sdim.json"), "{key} of {file}")
        }
        other => panic!("{:?}", other.err()),
    }
}

#[test]
fn configurations_that_cannot_be_run_are_refused() {
    let key = |config: TrainConfig| match Trainer::new(config, &Settings::tiny()) {
        Err(Error::Config { file, key, .. }) => {
            assert_eq!(file, "train.json");
            key
        }
        Err(other) => panic!("{other}"),
        Ok(_) => panic!("it starts"),
    };
    assert_eq!(key(TrainConfig { steps: 0, ..small() }), "steps");
    assert_eq!(key(TrainConfig { rate: f32::NAN, ..small() }), "rate");
    let mut config = small();
    config.batch.sizes = vec![(96, 64), (100, 64)];
    assert_eq!(key(config), "batch.sizes");
}

#[test]
fn a_run_that_does_not_find_back_ends() {
    // The first step throws the weights so far that nothing finite comes of them.
    let wild = TrainConfig { rate: 1e30, warmup: 0, ..small() };
    let mut trainer = Trainer::new(wild, &Settings::tiny()).unwrap();
    assert!(!trainer.train_step().unwrap().skipped);
    for step in 2..=20 {
        let report = trainer.train_step().unwrap();
        assert!(report.skipped && report.step == step, "{report:?}");
    }
    match trainer.train_step() {
        Err(Error::Diverged { step, skipped }) => assert_eq!((step, skipped), (21, 20)),
        other => panic!("{other:?}"),
    }
    assert_eq!(trainer.skipped(), 20);
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
    let [full, bare] = [(); 2].map(|()| tempfile::tempdir().unwrap());
    Trainer::new(small(), &Settings::tiny()).unwrap().save(full.path()).unwrap();
    let settings = Settings { fusion: None, glimpse: None, wide_glimpse: None, ..Settings::tiny() };
    Trainer::new(small(), &settings).unwrap().save(bare.path()).unwrap();
    let state = |dir: &Path| dir.join("trainer.safetensors");
    let good = std::fs::read(state(full.path())).unwrap();
    std::fs::copy(state(bare.path()), state(full.path())).unwrap();
    std::fs::write(state(bare.path()), good).unwrap();
    assert!(matches!(Trainer::resume(bare.path()), Err(Error::TensorSet { .. })));
    assert!(matches!(Trainer::resume(full.path()), Err(Error::Tensor { .. })));
    std::fs::write(state(full.path()), b"cut").unwrap();
    assert!(matches!(Trainer::resume(full.path()), Err(Error::Format { .. })));
    std::fs::remove_file(state(full.path())).unwrap();
    match Trainer::resume(full.path()) {
        Err(Error::Io { path, .. }) => assert_eq!(path, state(full.path())),
        other => panic!("{:?}", other.err()),
    }
}
