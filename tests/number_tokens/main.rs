//! Number tokens that an adapter brings to a checkpoint as published: rows behind its vocabulary, which give the answers of a checkpoint whose
//! embedding and head have them in one piece.

mod base;
#[path = "../common/mod.rs"]
mod common;

use base::{BINS, Base, CPU, EMBEDDING, HEAD, in_words, pointer, wave};
use candle_core::{DType, Tensor};
use common::{close, device, relative_difference, tiny};
use sdim::internals::model::{AskOptions, SdimModel, ask};
use sdim::internals::query::{Query, Reading};
use sdim::internals::vlm::qwen2_5::decoder::Keep;
use sdim::internals::vlm::qwen2_5::token_table::FIRST_ADDED;
use sdim::settings::{Hint, NumberFormat, NumberTokens, PixelReference, Settings};
use sdim::{Adapter, CompleteOptions, DepthCompleter, Error, LoadOptions, QueryPlan, Readout, WeightFormat};
use serde_json::{Value, json};
use std::path::Path;

fn queries(count: usize) -> Vec<Query> {
    let query = |i: usize| Query {
        x: i * 37 % 90,
        y: i * 53 % 70,
        measured: None,
        hint: 0.4 + (i % 11) as f32 * 0.7,
    };
    (0..count).map(query).collect()
}

fn asked(model: &SdimModel, queries: &[Query], readout: Readout) -> Vec<Reading> {
    let (rgb, sparse) = tiny::frame(90, 70);
    let prefix = model.prefill_frame(&rgb, &sparse).unwrap();
    ask(model, &prefix, queries, AskOptions { readout, ..Default::default() }).unwrap()
}

/// Logits of the numbers `[1, bins]`, then of the whole vocabulary, by one run over everything that a query reads.
fn alone(model: &SdimModel, query: &Query) -> (Tensor, Tensor) {
    let (rgb, sparse) = tiny::frame(90, 70);
    let (pixels, scattered) = model.preprocess(&rgb, &sparse).unwrap();
    let image = model.encode(&pixels, &scattered).unwrap();
    let size = (pixels.resized.width() as usize, pixels.resized.height() as usize);
    let (mut tokens, space) = model.prompts.prefix(&sparse, pixels.grid, size, &model.vlm.config, 0).unwrap();
    let suffix = model.prompts.suffix(query, &space, &model.tokenizer).unwrap();
    tokens.ids.extend(suffix.ids);
    tokens.positions.extend(suffix.positions);
    let decoder = &model.vlm.decoder;
    let embedded = model.vlm.embed_prompt(&tokens.ids, &image).unwrap();
    let hidden = model.vlm.prefill(&embedded, &tokens.positions, &mut decoder.cache(1), Keep::All).unwrap();
    let last = decoder.final_norm(&hidden.narrow(0, hidden.dim(0).unwrap() - 1, 1).unwrap()).unwrap();
    (model.number_rows.linear(&last, None).unwrap(), decoder.logits(&last).unwrap())
}

fn bits(tensor: &Tensor) -> Vec<u32> {
    let values: Vec<f32> = tensor.to_dtype(DType::F32).unwrap().flatten_all().unwrap().to_vec1().unwrap();
    values.into_iter().map(f32::to_bits).collect()
}

#[test]
fn they_are_the_rows_of_one_embedding_and_one_head() {
    for tied in [true, false] {
        let base = Base::new(tied);
        for settings in [pointer(NumberTokens::Rows), in_words(NumberTokens::Rows)] {
            let model = base.adapted(&settings, WeightFormat::F32);
            let whole = base.concatenated(&settings).load(None, WeightFormat::F32).unwrap();
            assert_eq!((model.tokenizer.vocab_size(), whole.tokenizer.vocab_size()), (304, 304 + BINS));
            for query in queries(4) {
                let ((numbers, words), (wanted, all)) = (alone(&model, &query), alone(&whole, &query));
                for (what, ours, wanted) in [
                    ("numbers", &numbers, &wanted),
                    ("numbers of the whole head", &numbers, &all.narrow(1, 304, BINS).unwrap()),
                    ("words", &words, &all.narrow(1, 0, 304).unwrap()),
                ] {
                    let off = relative_difference(ours, &wanted.contiguous().unwrap());
                    assert!(off <= 1e-5, "{what}, tied {tied}: {off:.1e}");
                }
            }
            for readout in [Readout::Median, Readout::Mean] {
                let (ours, wanted) =
                    (asked(&model, &queries(60), readout), asked(&whole, &queries(60), readout));
                ours.iter().zip(&wanted).for_each(|(a, b)| close("in one piece", a, b));
                let range = ours.iter().fold((f32::MAX, 0f32), |r, a| (r.0.min(a.value), r.1.max(a.value)));
                assert!(range.1 > range.0 * 1.01, "answers differ: {range:?}");
            }
        }
    }
}

#[test]
fn one_token_asks_and_one_answers() {
    let model = Base::new(true).adapted(&pointer(NumberTokens::Rows), WeightFormat::F32);
    let (rgb, sparse) = tiny::frame(90, 70);
    let prefix = model.prefill_frame(&rgb, &sparse).unwrap();
    let numbers = model.prompts.numbers();
    assert!(numbers.ids.iter().copied().eq((FIRST_ADDED..).take(BINS)), "behind any vocabulary");
    assert_eq!(model.number_rows.dims(), (BINS, 48), "no other row is multiplied");
    let told = prefix.ids.iter().filter(|&&id| id >= FIRST_ADDED).count();
    assert_eq!(told, 20, "a measurement is one token");
    for query in queries(5) {
        let suffix = model.prompts.suffix(&query, &prefix.space, &model.tokenizer).unwrap();
        assert_eq!(suffix.ids, numbers.write_ids(query.hint / prefix.space.unit));
        assert_eq!((suffix.len(), numbers.write(3.7).len()), (1, 1));
        // What that one pass says is the answer.
        let (logits, _) = alone(&model, &query);
        let bins = numbers.format.bins().unwrap();
        let said = bins.read(&logits.flatten_all().unwrap().to_vec1::<f32>().unwrap(), &mut Vec::new());
        let ours = asked(&model, &[query], Readout::Median)[0];
        let unit = prefix.space.unit;
        close(
            "alone",
            &ours,
            &Reading { value: said.value * unit, expected_error: said.expected_error * unit, ..said },
        );
    }
}

#[test]
fn batches_read_what_each_query_reads_alone() {
    for settings in [pointer(NumberTokens::Rows), in_words(NumberTokens::Rows)] {
        let model = Base::new(false).adapted(&settings, WeightFormat::F32);
        let queries = queries(50);
        let all = asked(&model, &queries, Readout::Median);
        for (query, reading) in queries.iter().zip(&all) {
            close("alone", &asked(&model, &[*query], Readout::Median)[0], reading);
        }
    }
}

#[test]
fn every_format_of_weights_has_them() {
    let formats: &[WeightFormat] = match device().is_cpu() {
        true => &[WeightFormat::F32, WeightFormat::Bf16, WeightFormat::Int8],
        false => &[WeightFormat::F32, WeightFormat::Bf16],
    };
    for tied in [true, false] {
        let (base, settings) = (Base::new(tied), pointer(NumberTokens::Rows));
        let whole = base.concatenated(&settings);
        for &format in formats {
            let (ours, wanted) = (base.adapted(&settings, format), whole.load(None, format).unwrap());
            for query in queries(3) {
                let off = relative_difference(&alone(&ours, &query).0, &alone(&wanted, &query).0);
                // Off the CPU products are rounded to bf16, each width's in its own order.
                let rounded = format == WeightFormat::Bf16 && !device().is_cpu();
                assert!(off <= if rounded { 1e-2 } else { 1e-5 }, "{format:?}, tied {tied}: {off:.1e}");
            }
        }
    }
}

#[test]
fn nothing_else_changes_by_them() {
    for format in [WeightFormat::F32, WeightFormat::Bf16] {
        let base = Base::new(true);
        let (plain, with) =
            (base.load(None, format).unwrap(), base.adapted(&pointer(NumberTokens::Rows), format));
        let ids: Vec<u32> = (0..304).collect();
        let mixed =
            [7, FIRST_ADDED + 2, 300, FIRST_ADDED, 7].map(|id| with.vlm.decoder.embed(&[id]).unwrap());
        let together = with.vlm.decoder.embed(&[7, FIRST_ADDED + 2, 300, FIRST_ADDED, 7]).unwrap();
        assert_eq!(bits(&together), bits(&Tensor::cat(&mixed, 0).unwrap()), "in the order of the ids");
        let (a, b) = (&plain.vlm.decoder, &with.vlm.decoder);
        assert_eq!(bits(&a.embed(&ids).unwrap()), bits(&b.embed(&ids).unwrap()));
        let hidden = a.embed(&[3, 50, 200]).unwrap();
        assert_eq!(bits(&a.logits(&hidden).unwrap()), bits(&b.logits(&hidden).unwrap()));
        assert_eq!(plain.prompts.settings(), &Settings::paper(), "digits without an adapter");
        for (model, id) in
            [(&plain, FIRST_ADDED), (&plain, 304), (&with, 304), (&with, FIRST_ADDED + BINS as u32)]
        {
            let error = model.vlm.decoder.embed(&[5, id]).unwrap_err();
            assert!(matches!(error, Error::Argument { .. }), "{error}");
        }
    }
}

/// An adapter's files in the checkpoint's own directory, or its tensors in the checkpoint's own file, are the checkpoint's.
#[test]
fn an_adapter_becomes_part_of_a_checkpoint() {
    let (base, settings) = (Base::new(false), pointer(NumberTokens::Rows));
    let adapter = base.adapter(&settings);
    let readings = |model: &SdimModel| asked(model, &queries(9), Readout::Median);
    let wanted = readings(&base.load(Some(&adapter), WeightFormat::F32).unwrap());
    adapter.save(base.path()).unwrap();
    assert_eq!(readings(&base.load(None, WeightFormat::F32).unwrap()), wanted, "beside it");
    std::fs::remove_file(base.path().join("sdim.safetensors")).unwrap();
    let mut tensors = base.tensors.clone();
    tensors.extend(adapter.tensors.clone());
    base.write(&tensors);
    assert_eq!(readings(&base.load(None, WeightFormat::F32).unwrap()), wanted, "in its file");

    let (rgb, sparse) = tiny::frame(90, 70);
    let completer =
        DepthCompleter::load(base.path(), &LoadOptions::on(&device()).with_weights(WeightFormat::F32));
    let options = CompleteOptions::default().with_plan(QueryPlan::Stride(4));
    let map = completer.unwrap().complete(&rgb, &sparse, &options).unwrap();
    assert!(map.depth().iter().all(|d| d.is_finite() && *d > 0.0));
}

#[test]
fn adapters_start_among_the_digits_and_are_saved_whole() {
    for tied in [true, false] {
        let base = Base::new(tied);
        let start = |seed| Adapter::starting(base.path(), pointer(NumberTokens::Rows), seed).unwrap();
        let adapter = start(3);
        let names: Vec<&str> = adapter.tensors.keys().map(String::as_str).collect();
        assert_eq!(names, if tied { vec![EMBEDDING] } else { vec![EMBEDDING, HEAD] });
        let digits = Tensor::new(&[48u32, 49, 50, 51, 52, 53, 54, 55, 56, 57], &CPU).unwrap();
        for (name, table) in [(EMBEDDING, "model.embed_tokens.weight"), (HEAD, "lm_head.weight")] {
            let Some(rows) = adapter.tensors.get(name) else { continue };
            assert_eq!(rows.dims(), [BINS, 48]);
            let known = base.tensors[table].index_select(&digits, 0).unwrap();
            let mean = known.mean_keepdim(0).unwrap();
            let spread = |t: &Tensor| {
                let off = t.broadcast_sub(&mean).unwrap().sqr().unwrap().mean_all().unwrap();
                off.to_scalar::<f32>().unwrap().sqrt()
            };
            let share = spread(rows) / spread(&known);
            assert!((0.09..0.11).contains(&share), "{name}: {share}");
            let moved = |seed| bits(&start(seed).tensors[name]) != bits(rows);
            assert!(moved(4) && !moved(3), "{name}: the seed decides");
        }
        let dir = tempfile::tempdir().unwrap();
        adapter.save(dir.path()).unwrap();
        let again = Adapter::load(dir.path()).unwrap();
        assert_eq!(again.settings, adapter.settings);
        for (name, tensor) in &adapter.tensors {
            assert_eq!(bits(&again.tensors[name]), bits(tensor), "{name}");
        }
        base.load(Some(&adapter), WeightFormat::F32).unwrap();
    }
}

#[test]
fn a_base_without_digits_or_weights_starts_no_adapter() {
    let base = Base::new(true);
    let start = || Adapter::starting(base.path(), pointer(NumberTokens::Rows), 0).unwrap_err();
    let mut lacking = base.tensors.clone();
    lacking.remove("model.embed_tokens.weight");
    base.write(&lacking);
    match start() {
        Error::TensorSet { missing, .. } => assert_eq!(missing, ["model.embed_tokens.weight"]),
        other => panic!("{other:?}"),
    }
    lacking.insert("model.embed_tokens.weight".into(), wave(304, 47, 0.1));
    base.write(&lacking);
    assert!(matches!(start(), Error::Tensor { name, .. } if name == "model.embed_tokens.weight"));
    let mut wordless = base.tokenizer.clone();
    wordless["model"]["vocab"].as_object_mut().unwrap().remove("7");
    std::fs::write(base.path().join("tokenizer.json"), wordless.to_string()).unwrap();
    assert!(matches!(start(), Error::Tokenizer(said) if said.contains("`7`")));
}

#[test]
fn what_is_wrong_with_them_is_named() {
    for tied in [true, false] {
        let base = Base::new(tied);
        let good = base.adapter(&pointer(NumberTokens::Rows));
        let fails = |change: &dyn Fn(&mut Adapter)| {
            let mut bad = good.clone();
            change(&mut bad);
            base.load(Some(&bad), WeightFormat::F32).err().expect("an error")
        };
        match fails(&|a| drop(a.tensors.remove(EMBEDDING))) {
            Error::TensorSet { missing, unexpected, .. } => {
                assert_eq!((&missing[..], unexpected.len()), (&[EMBEDDING.to_string()][..], 0));
            }
            other => panic!("{other:?}"),
        }
        // Without `rows` in the settings nobody asks for them, and a base that ties its head has none of the numbers.
        match fails(&|a| a.settings.number = NumberFormat::Digits { decimals: 2, integers: 2 }) {
            Error::Config { key, .. } => assert_eq!(key, "number_tokens"),
            other => panic!("{other:?}"),
        }
        let digits = |a: &mut Adapter| {
            a.settings.number = NumberFormat::Digits { decimals: 2, integers: 2 };
            a.settings.number_tokens = NumberTokens::Vocabulary;
        };
        match fails(&digits) {
            Error::TensorSet { unexpected, .. } => assert_eq!(unexpected.len(), if tied { 1 } else { 2 }),
            other => panic!("{other:?}"),
        }
        match fails(&|a| a.settings.number_tokens = NumberTokens::Vocabulary) {
            Error::Tokenizer(said) => assert!(said.contains("<|d0|>"), "{said}"),
            other => panic!("{other:?}"),
        }
        let head = |a: &mut Adapter| match tied {
            true => drop(a.tensors.insert(HEAD.into(), wave(BINS, 48, 0.2))),
            false => drop(a.tensors.remove(HEAD)),
        };
        match fails(&head) {
            Error::TensorSet { missing, unexpected, .. } if tied => {
                assert_eq!((missing.len(), &unexpected[..]), (0, &[HEAD.to_string()][..]));
            }
            Error::TensorSet { missing, unexpected, .. } => {
                assert_eq!((&missing[..], unexpected.len()), (&[HEAD.to_string()][..], 0));
            }
            other => panic!("{other:?}"),
        }
        match fails(&|a| drop(a.tensors.insert(EMBEDDING.into(), wave(BINS, 47, 0.2)))) {
            Error::Tensor { name, expected, .. } => {
                assert_eq!((name.as_str(), expected.as_str()), (EMBEDDING, "shape [40, 48]"));
            }
            other => panic!("{other:?}"),
        }
        for part in if tied { &[EMBEDDING][..] } else { &[EMBEDDING, HEAD] } {
            match fails(&|a| drop(a.tensors.insert(part.to_string(), wave(BINS - 1, 48, 0.2)))) {
                Error::Config { file, key, found, expected } => {
                    assert_eq!((file.as_str(), key.as_str()), ("sdim.json", "number.bins"));
                    assert!(
                        found == "40" && expected.contains("39") && expected.contains(part),
                        "{expected}"
                    );
                }
                other => panic!("{other:?}"),
            }
        }
    }
}

/// The way of asking is part of `sdim.json`: digits, and bins of a vocabulary, are written as they always were.
#[test]
fn settings_say_where_they_come_from() {
    for plain in [Settings::tiny(), Settings::paper()] {
        assert!(!plain.to_json().unwrap().contains("number_tokens"));
    }
    let settings = pointer(NumberTokens::Rows);
    let json: Value = serde_json::from_str(&settings.to_json().unwrap()).unwrap();
    assert_eq!(json["number_tokens"], "rows");
    let path = Path::new("sdim.json");
    assert_eq!(Settings::from_bytes(path, json.to_string().as_bytes()).unwrap(), settings);
    let short = json!({"preset": "tiny", "number_tokens": "rows"}).to_string();
    let short = Settings::from_bytes(path, short.as_bytes()).unwrap();
    assert_eq!((short.number_tokens, short.hint), (NumberTokens::Rows, Hint::Linear));
    assert!(matches!(short.pixel_reference, PixelReference::Pointer { .. }));
}
