//! Training records: the same bytes for the same seed, read back as they were written, and read by the crate's model as the
//! trainer in `training/` reads them. `training/tests/test_parity.py` compares PyTorch with the same fixture.

mod common;

use candle_core::{Device, Tensor};
use common::program::program;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use sdim::internals::model::{CheckpointFiles, SdimModel};
use sdim::internals::query::PromptWriter;
use sdim::internals::scenes::furnished::Library;
use sdim::internals::supervise::{
    Asking, BatchConfig, BinLoss, Example, RecordConfig, RecordSet, SceneMix, Scenes, Shard, Target, VERSION,
    bins, example_of, frame, held_out_seed, training_seed,
};
use sdim::internals::vlm::qwen2_5::{decoder::Keep, sequences::Sequences};
use sdim::settings::{Hint, NumberTokens, Settings};
use sdim::{Error, LoadOptions, Result, WeightFormat};
use std::path::{Path, PathBuf};
use std::process::Command;

fn fixture(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures/records").join(name)
}

/// The fixture's way of asking, with what `change` makes of it.
struct Writer {
    files: CheckpointFiles,
    prompts: PromptWriter,
}

impl Writer {
    fn new(change: impl FnOnce(&mut Settings)) -> Self {
        let mut files = CheckpointFiles::from_dir(&fixture("checkpoint")).unwrap();
        change(&mut files.settings);
        let prompts = PromptWriter::new(&files.settings, &files.tokenizer).unwrap();
        Self { files, prompts }
    }

    fn asking(&self) -> Asking<'_> {
        Asking { config: &self.files.config, prompts: &self.prompts, tokenizer: &self.files.tokenizer }
    }
}

fn config() -> RecordConfig {
    let batch = BatchConfig {
        frames: 3,
        questions: 9,
        prompt_points: 16,
        points: (12, 40),
        sizes: vec![(64, 48), (48, 32)],
        ..Default::default()
    };
    RecordConfig { batch, variants: 2, seed: 3, set: RecordSet::Train }
}

/// Procedural scenes alone.
fn plain() -> Scenes {
    Scenes::new(SceneMix::default())
}

/// Logits of an example's questions, `[questions, bins]`, computed as for a user's frame.
fn logits(model: &SdimModel, example: &Example) -> Result<Tensor> {
    let (w, h) = example.pixels.resized.dimensions();
    let scattered = Tensor::from_slice(&example.scattered, (1, h as usize, w as usize, 1), &Device::Cpu)?;
    let prefix = &example.prefix;
    let embedded = model.vlm.embed_prompt(&prefix.ids, &model.encode(&example.pixels, &scattered)?)?;
    let view = example.view(model)?;
    let embedded = model.add_glimpses(embedded, &[(&view, &prefix.glimpses)])?;
    let decoder = &model.vlm.decoder;
    let mut shared = decoder.cache(1);
    model.vlm.prefill(&embedded, &prefix.positions, &mut shared, Keep::Nothing)?;
    let items = &example.items;
    let ids: Vec<u32> = items.iter().flat_map(|i| i.tokens.ids.clone()).collect();
    let positions: Vec<_> = items.iter().flat_map(|i| i.tokens.positions.clone()).collect();
    let mut glimpses: Vec<_> = items.iter().map(|i| i.tokens.glimpses[0]).collect();
    glimpses.iter_mut().enumerate().for_each(|(i, g)| g.token = i);
    let asked = model.add_glimpses(decoder.embed(&ids)?, &[(&view, &glimpses)])?;
    let sequences = Sequences::prefill(decoder, Some(&shared), &asked, &positions, vec![0.0; items.len()])?;
    model.number_rows.linear(sequences.last(), None)
}

#[test]
fn the_crate_reads_records_as_the_trainer_does() {
    let options = LoadOptions::default().with_weights(WeightFormat::F32);
    let model = SdimModel::load(&fixture("checkpoint"), &options).unwrap();
    let shard = Shard::read(&fixture("000000.safetensors")).unwrap();
    let expected = candle_core::safetensors::load(fixture("expected.safetensors"), &Device::Cpu).unwrap();
    let (mut all, mut targets) = (Vec::new(), Vec::new());
    let of = model.prompts.numbers().format.bins().unwrap();
    for frame in 0..shard.dims.frames {
        for variant in 0..shard.dims.variants {
            let example = shard.example((&model).into(), frame, variant).unwrap();
            let found = logits(&model, &example).unwrap();
            let at = |name: &str| expected[name].get(frame).unwrap().get(variant).unwrap();
            let off: f32 =
                (&found - at("logits")).unwrap().abs().unwrap().max_all().unwrap().to_scalar().unwrap();
            assert!(off < 1e-3, "frame {frame}, variant {variant}: logits differ by {off}");
            let (rows, medians): (Vec<Vec<f32>>, Vec<f32>) =
                (at("logits").to_vec2().unwrap(), at("median").to_vec1().unwrap());
            for (row, median) in rows.iter().zip(medians) {
                let answer = of.read(row, &mut Vec::new()).value;
                assert!((answer - median).abs() < 1e-4, "{answer} is {median} in PyTorch");
            }
            targets.extend(example.items.iter().map(|i| Target { value: i.value, scale: i.scale }));
            all.push(found);
        }
    }
    // The blur of a tenth of the schedule, as in the generator.
    let widen = 1.0 + 7.0 * (1.0 - 0.1 / 0.25);
    let config = BinLoss { bins: of, blur: 0.0015 * widen, blur_slope: 0.008 * widen, l1: 4.0 };
    let parts = bins(&Tensor::cat(&all, 0).unwrap(), targets, config).unwrap();
    let value = |name: &str| expected[name].to_vec1::<f32>().unwrap()[0];
    let total = parts.total.to_scalar::<f32>().unwrap();
    assert!((total - value("loss")).abs() < 1e-4, "loss {total}, {} in PyTorch", value("loss"));
    assert!((parts.l1 - value("l1")).abs() < 1e-4, "L1 {}, {} in PyTorch", parts.l1, value("l1"));
}

#[test]
fn a_shard_follows_from_its_seed_and_is_read_back() {
    let writer = Writer::new(|_| {});
    let shard = config().shard(writer.asking(), &plain(), 5).unwrap();
    let one = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
    assert_eq!(one.install(|| config().shard(writer.asking(), &plain(), 5)).unwrap(), shard, "on one thread");
    let other = RecordConfig { seed: 4, ..config() }.shard(writer.asking(), &plain(), 5).unwrap();
    assert!(other.rgb != shard.rgb && other.seed != shard.seed);
    assert_ne!(config().shard(writer.asking(), &plain(), 6).unwrap().seed, shard.seed);

    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("000005.safetensors");
    shard.write(&path).unwrap();
    assert_eq!(Shard::read(&path).unwrap(), shard);
    let first = std::fs::read(&path).unwrap();
    shard.write(&path).unwrap();
    assert_eq!(std::fs::read(&path).unwrap(), first, "the same bytes");
}

#[test]
fn what_is_read_from_a_shard_is_what_the_trainer_makes() {
    is_what_the_trainer_makes(&Writer::new(|_| {}));
}

/// A vocabulary as large as a published one has ids that records have no room for; rows of number tokens have it.
#[test]
fn numbers_behind_a_large_vocabulary_are_told_by_their_rows() {
    let (mut large, mut rows) = (Writer::new(|_| {}), Writer::new(|s| s.number_tokens = NumberTokens::Rows));
    large.files.config.text.vocab_size = 151_936;
    rows.files.config.text.vocab_size = 151_936;
    let refused = config().shard(large.asking(), &plain(), 0).map(|s| s.dims);
    assert!(matches!(refused, Err(Error::Config { key, .. }) if key == "vocab_size"));
    is_what_the_trainer_makes(&rows);
    let writer = Writer::new(|_| {});
    let [named, shard] = [&writer, &rows].map(|w| config().shard(w.asking(), &plain(), 0).unwrap());
    let first = writer.prompts.numbers().ids[0] as u16;
    let bins: Vec<u16> = named.asked_id.iter().map(|id| id - first).collect();
    assert_eq!(shard.asked_id, bins);
}

fn is_what_the_trainer_makes(writer: &Writer) {
    // A set of one frame with one variant, so that its example can be made beside it.
    let mut config = config();
    (config.batch.frames, config.variants) = (1, 1);
    let shard = config.shard(writer.asking(), &plain(), 0).unwrap();
    let size = (shard.dims.width, shard.dims.height);
    let frame = frame(&plain(), shard.seed[0], size).unwrap();
    let base = sdim::internals::supervise::mix(config.seed, 0);
    let found = (0..9).find_map(|tries| {
        let random = sdim::internals::supervise::mix(base, tries);
        let mut rng = ChaCha8Rng::seed_from_u64(sdim::internals::supervise::mix(random, 1));
        (training_seed(random) == shard.seed[0])
            .then(|| example_of(writer.asking(), &config.batch, &frame, &mut rng))
    });
    let (made, read) = (found.unwrap().unwrap(), shard.example(writer.asking(), 0, 0).unwrap());
    assert_eq!(read.prefix, made.prefix, "ids, positions and crops of the prompt");
    assert_eq!((read.scattered, read.unit), (made.scattered, made.unit));
    assert_eq!((read.pixels.resized, read.pixels.grid), (made.pixels.resized, made.pixels.grid));
    assert_eq!(read.items.len(), 9);
    for (read, made) in read.items.iter().zip(&made.items) {
        assert_eq!(read.tokens, made.tokens);
        assert_eq!((read.supervised, &read.answer), (made.supervised, &made.answer));
        assert_eq!((read.value, read.hint, read.scale), (made.value, made.hint, made.scale));
    }
}

#[test]
fn held_out_scenes_are_the_same_for_any_number_of_points_and_never_trained_on() {
    let writer = Writer::new(|_| {});
    let held = |points, grid| {
        let config = RecordConfig { set: RecordSet::HeldOut { points, grid }, variants: 1, ..config() };
        config.shard(writer.asking(), &plain(), 0).unwrap()
    };
    let (few, many) = (held(10, None), held(30, Some(4)));
    assert_eq!((&few.seed, &few.rgb), (&many.seed, &many.rgb));
    assert_eq!(few.measured_start, [0, 10, 20, 30]);
    assert_eq!(many.measured_start, [0, 30, 60, 90]);
    let d = many.dims;
    assert_eq!(d.asked, d.width / 4 * (d.height / 4));
    let row: Vec<_> = (0..d.width / 4).map(|i| (many.asked_x[i], many.asked_y[i])).collect();
    assert!(row.iter().enumerate().all(|(i, &p)| p == (i as u16 * 4 + 2, 2)), "{row:?}");
    // Three ranges without a common seed, whatever is drawn.
    for random in [0, 1, 77, u64::MAX / 3, u64::MAX] {
        assert!((1 << 62..1 << 63).contains(&training_seed(random)));
        assert!(held_out_seed(random) >= 1 << 63);
    }
    assert!(few.seed.iter().all(|&s| s >= 1 << 63));
    assert!(
        config()
            .shard(writer.asking(), &plain(), 0)
            .unwrap()
            .seed
            .iter()
            .all(|s| (1 << 62..1 << 63).contains(s))
    );
}

/// A folder of boxes that are called furniture.
fn boxes(dir: &Path) -> Library {
    let corner = |i: usize| format!("v {} {} {}\n", i & 1, i >> 1 & 1, i >> 2);
    let faces = "f 1 2 4 3\nf 5 6 8 7\nf 1 2 6 5\nf 3 4 8 7\nf 1 3 7 5\nf 2 4 8 6\n";
    std::fs::write(dir.join("box.obj"), (0..8).map(corner).collect::<String>() + faces).unwrap();
    let mut catalogue = String::new();
    let names = ["Chair", "Table", "Bookcase", "Sofa", "Bed", "Desk"];
    for (i, name) in (1..=60).zip(names.into_iter().cycle()) {
        catalogue += &format!(
            "id#{i}=box{i}\nname#{i}={name}\ncategory#{i}=Living room\nmodel#{i}=/box.obj\n\
             width#{i}=60\ndepth#{i}=50\nheight#{i}=80\nlicense#{i}=CC0\ncreator#{i}=A\n"
        );
    }
    std::fs::write(dir.join("PluginFurnitureCatalog.properties"), catalogue).unwrap();
    Library::open(dir).unwrap()
}

#[test]
fn a_mix_is_the_same_on_any_number_of_threads_and_keeps_its_parts_apart() {
    let (writer, dir) = (Writer::new(|_| {}), tempfile::tempdir().unwrap());
    let library = boxes(dir.path());
    let mix: SceneMix = "procedural=1,furnished=1,streets=1".parse().unwrap();
    let mut train = config();
    (train.batch.mix, train.batch.frames, train.batch.sizes) = (mix, 8, vec![(48, 32)]);
    let set = RecordSet::HeldOut { points: 20, grid: None };
    let held = RecordConfig { set, variants: 1, ..train.clone() };
    let scenes = |held_out| Scenes::new(mix).with_library(&library, held_out).unwrap();
    for (config, held_out) in [(&train, false), (&held, true)] {
        let [one, two] = [1, 2].map(|threads| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| config.shard(writer.asking(), &scenes(held_out), 1)).unwrap()
        });
        assert_eq!(one, two);
        // What each recipe alone makes of the seeds.
        let kinds: Vec<_> =
            one.seed.iter().map(|&s| frame(&scenes(held_out), s, (48, 32)).unwrap()).collect();
        let alone = |name: &str| {
            let scenes = Scenes::new(format!("{name}=1").parse().unwrap());
            let scenes = scenes.with_library(&library, held_out).unwrap();
            let same = |(i, &s): (usize, &u64)| frame(&scenes, s, (48, 32)).unwrap().rgb == kinds[i].rgb;
            one.seed.iter().enumerate().filter(|&f| same(f)).count()
        };
        let counts = ["procedural", "furnished", "streets"].map(alone);
        assert!(counts.iter().sum::<usize>() == 8 && counts.iter().all(|&n| n > 0), "{counts:?}");
        // The other part's models are refused, and so is another mix.
        for wrong in [scenes(!held_out), Scenes::new(mix), plain()] {
            let found = config.shard(writer.asking(), &wrong, 1);
            let name = if wrong.mix() == mix { "library" } else { "mix" };
            assert!(matches!(found, Err(Error::Argument { name: found, .. }) if found == name), "{name}");
        }
    }
    let ids = |held_out| {
        let part = if held_out {
            sdim::internals::scenes::furnished::Split::HeldOut
        } else {
            sdim::internals::scenes::furnished::Split::Train
        };
        library.part(part).unwrap().models().into_iter().map(|m| m.id).collect::<Vec<_>>()
    };
    let (trained, held) = (ids(false), ids(true));
    assert!(!held.is_empty() && !trained.is_empty() && trained.iter().all(|id| !held.contains(id)));
}

#[test]
fn variants_share_the_picture_and_bad_measurements_are_told_but_not_asked() {
    let writer = Writer::new(|_| {});
    let mut config = config();
    (config.variants, config.batch.sensors, config.batch.errors) = (4, 1.0, 1.0);
    let shard = config.shard(writer.asking(), &plain(), 0).unwrap();
    let size = (shard.dims.width, shard.dims.height);
    let mut wrong = 0;
    for (i, &seed) in shard.seed.iter().enumerate() {
        let clean = frame(&plain(), seed, size).unwrap();
        for v in i * 4..(i + 1) * 4 {
            let truth = |x: usize, y: usize| clean.depth[y * size.0 + x] / shard.unit[v];
            for q in v * 9..(v + 1) * 9 {
                let expected = truth(shard.asked_x[q].into(), shard.asked_y[q].into());
                assert!((shard.asked_value[q] / expected - 1.0).abs() < 1e-5);
            }
            let told = shard.measured_start[v] as usize..shard.measured_start[v + 1] as usize;
            let off = told.filter(|&m| {
                let pixel = shard.measured_pixel[m] as usize;
                let ratio = shard.measured_value[m] / truth(pixel % size.0, pixel / size.0);
                !(0.78..1.28).contains(&ratio)
            });
            wrong += usize::from(off.count() > 0);
        }
    }
    assert!(wrong >= 9, "{wrong} of 12 sets of measurements have bad ones");
}

#[test]
fn what_records_cannot_hold_is_refused() {
    let writer = Writer::new(|_| {});
    let refused = |change: fn(&mut RecordConfig), name: &str| {
        let mut config = config();
        change(&mut config);
        match config.shard(writer.asking(), &plain(), 0) {
            Err(Error::Argument { name: found, .. }) => assert_eq!(found, name),
            other => panic!("{name}: {:?}", other.map(|s| s.dims)),
        }
    };
    refused(|c| c.batch.sizes = vec![(64, 40)], "size");
    refused(|c| c.batch.sizes.clear(), "sizes");
    refused(|c| c.batch.points = (9, 8), "points");
    refused(|c| c.variants = 0, "variants");
    refused(|c| c.batch.questions = 0, "questions");
    refused(|c| c.set = RecordSet::HeldOut { points: 0, grid: None }, "held-out set");
    let unhinted = Writer::new(|s| s.hint = Hint::None);
    match config().shard(unhinted.asking(), &plain(), 0) {
        Err(Error::Config { key, .. }) => assert_eq!(key, "hint"),
        other => panic!("{:?}", other.map(|s| s.dims)),
    }
    let shard = Shard::read(&fixture("000000.safetensors")).unwrap();
    let finer = Writer::new(|s| s.glimpse = Some(6));
    assert!(matches!(shard.example(finer.asking(), 0, 0), Err(Error::Argument { name: "sdim.json", .. })));
    assert!(matches!(shard.example(writer.asking(), 2, 0), Err(Error::Argument { name: "frame", .. })));
}

#[test]
fn damaged_shards_are_refused() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("000000.safetensors");
    let whole = Shard::read(&fixture("000000.safetensors")).unwrap();
    let tensor = |change: fn(&mut Shard), name: &str| {
        let mut shard = whole.clone();
        change(&mut shard);
        shard.write(&path).unwrap();
        match Shard::read(&path) {
            Err(Error::Tensor { name: found, .. }) => assert_eq!(found, name),
            other => panic!("{name}: {:?}", other.map(|s| s.dims)),
        }
    };
    tensor(|s| s.measured_pixel[0] = 1 << 20, "measured_pixel");
    tensor(|s| s.measured_start[1] = u32::MAX, "measured_start");
    tensor(|s| s.told_count[0] = 99, "told_count");
    tensor(|s| s.told_x[0] = 4000, "told_x");
    tensor(|s| s.asked_y[0] = 4000, "asked_y");
    let mut later = whole.clone();
    later.about.version = VERSION + 1;
    later.write(&path).unwrap();
    assert!(matches!(Shard::read(&path), Err(Error::Format { .. })));
    std::fs::copy(fixture("expected.safetensors"), &path).unwrap();
    assert!(matches!(Shard::read(&path), Err(Error::Format { .. })), "other tensors");
    std::fs::write(&path, b"cut").unwrap();
    assert!(matches!(Shard::read(&path), Err(Error::Format { .. })));
    assert!(matches!(Shard::read(&dir.path().join("none")), Err(Error::Io { .. })));
}

#[test]
fn the_program_goes_on_where_it_was_and_keeps_sets_apart() {
    let dir = tempfile::tempdir().unwrap();
    let run = |more: &[&str]| {
        let mut command = Command::new(program("records"));
        command.arg("--shape").arg(fixture("shape.json"));
        command.arg("--settings").arg(fixture("checkpoint/sdim.json"));
        command.arg("--out").arg(dir.path().join("set")).args(["--size", "64x48", "--shard", "2"]);
        let out = command.args(["--prompt", "16", "--questions", "6"]).args(more).output().unwrap();
        (out.status.success(), String::from_utf8_lossy(&out.stderr).into_owned())
    };
    let fresh = dir.path().join("fresh");
    let (ok, said) = run(&["--count", "2", "--fresh", fresh.to_str().unwrap()]);
    assert!(ok, "{said}");
    // Where training starts is a checkpoint that loads.
    SdimModel::load(&fresh, &LoadOptions::default()).unwrap();
    let first = dir.path().join("set/000000.safetensors");
    let bytes = std::fs::read(&first).unwrap();
    let written = first.metadata().unwrap().modified().unwrap();
    let (ok, said) = run(&["--count", "4"]);
    assert!(ok && said.contains("2 new frames"), "{said}");
    assert_eq!(first.metadata().unwrap().modified().unwrap(), written, "not made again");
    assert_ne!(std::fs::read(dir.path().join("set/000001.safetensors")).unwrap(), bytes);
    let (ok, said) = run(&["--count", "6", "--seconds", "0"]);
    assert!(ok && said.contains("--seconds is over") && said.contains("0 new frames"), "{said}");
    let (ok, said) = run(&["--count", "6", "--mix", "rooms=1"]);
    assert!(!ok && said.contains("rooms=1") && said.contains("procedural, furnished, streets"), "{said}");
    let (ok, said) = run(&["--count", "6", "--mix", "furnished=1"]);
    assert!(!ok && said.contains("a folder of models"), "{said}");
    let (ok, said) = run(&["--count", "6", "--mix", "streets=1"]);
    assert!(!ok && said.contains("other records are there"), "{said}");
    let (ok, said) = run(&["--count", "6", "--seed", "8"]);
    assert!(!ok && said.contains("other records are there"), "{said}");
}
