//! Forced and free answers on a model that says what it is told to say, and what is refused.

use crate::common::{beside, close, tiny};
use crate::setup::{DISC, Setup, by_coordinates, by_marker};
use candle_core::{Device, Tensor};
use sdim::internals::model::{AskOptions, SdimModel, ask, generate};
use sdim::internals::query::Query;
use sdim::internals::vlm::chat::tokenizer::Tokenizer;
use sdim::settings::{
    AnswerMode, Generation, Marker, MeasurementPrompt, PixelReference, PromptTemplate, Settings,
};
use sdim::{CompleteOptions, DepthCompleter, Error, Preserve, QueryPlan};

/// A model whose next token hangs on the last one alone: after an unmeasured pixel it says `d=4.25m`, where the 4 might
/// have been a 9, after a measured one `7m`, and then it stops.
fn chain(settings: &Settings) -> SdimModel {
    let shape = tiny::Shape { tied: false, ..tiny::SMALL };
    let files = tiny::files(settings, &shape);
    let tokenizer = files.parse().unwrap().tokenizer;
    let mut tensors = tiny::tensors(&files, 3);
    for (name, tensor) in tensors.iter_mut() {
        if name.starts_with("model.layers") && (name.contains("o_proj") || name.contains("down_proj")) {
            *tensor = tensor.zeros_like().unwrap();
        }
    }
    let dims = tensors["model.embed_tokens.weight"].dims().to_vec();
    let (mut embed, mut head) = (vec![0f32; dims[0] * dims[1]], vec![0f32; dims[0] * dims[1]]);
    let words = ["a", "d", "=", "4", ".", "2", "5", "m", "<|im_end|>", "b", "7", "9"];
    let id = |word: &str| tokenizer.id(word).unwrap() as usize;
    for (axis, word) in words.iter().enumerate() {
        embed[id(word) * dims[1] + axis] = 1.0;
    }
    let mut follows = |word: &str, next: &str, weight: f32| {
        head[id(next) * dims[1] + words.iter().position(|w| *w == word).unwrap()] = weight;
    };
    words[..9].windows(2).for_each(|w| follows(w[0], w[1], 3.0));
    follows("=", "9", 2.9);
    follows("b", "7", 3.0);
    follows("7", "m", 3.0);
    for (name, values) in [("model.embed_tokens.weight", embed), ("lm_head.weight", head)] {
        tensors.insert(name.into(), Tensor::from_vec(values, &dims[..], &Device::Cpu).unwrap());
    }
    tiny::model(&files, tensors)
}

/// A way of asking whose last word tells whether the pixel was measured.
fn for_chain(reference: PixelReference) -> Settings {
    let query = if matches!(reference, PixelReference::Marker(_)) { "{mask}" } else { "{pixel}{mask}" };
    let template = PromptTemplate {
        query: query.into(),
        mask_missing: "a".into(),
        mask_measured: "{x}b".into(),
        answer: "d={y}m".into(),
        ..by_coordinates().template
    };
    Settings { template, pixel_reference: reference, ..by_coordinates() }
}

#[test]
fn forced_and_free_answers_agree_where_the_words_are_the_same() {
    for reference in [
        PixelReference::Coordinates,
        PixelReference::Pointer { token: "<|point|>".into() },
        PixelReference::Marker(Marker::default()),
    ] {
        let setup = Setup::of(chain(&for_chain(reference)));
        let queries = setup.queries(60);
        let mode = AnswerMode::Generate(Generation { max_new_tokens: 8, ..Generation::default() });
        let free = ask(
            &setup.model,
            &setup.prefix,
            &queries,
            AskOptions { mode: Some(&mode), ..Default::default() },
        )
        .unwrap();
        let forced = ask(&setup.model, &setup.prefix, &queries, AskOptions::default()).unwrap();
        let (mut measured, mut open) = (0, 0);
        for ((query, free), forced) in queries.iter().zip(&free).zip(&forced) {
            assert!((forced.value - 4.25).abs() < 1e-6);
            // 1 / (1 + exp(-0.8)): the norm makes 8 of the 1 in the embedding's one entry.
            assert!((forced.confidence - 0.69).abs() < 0.01, "{forced:?}");
            if query.measured.is_some() {
                assert!((free.value - 7.0).abs() < 1e-6 && free.confidence > 0.99, "{free:?}");
                measured += 1;
            } else {
                close("free and forced", free, forced);
                open += 1;
            }
        }
        assert!(measured > 0 && open > 0);
        // Cut before its unit, an answer is none.
        let cut = AnswerMode::Generate(Generation { max_new_tokens: 6, ..Generation::default() });
        let cut =
            ask(&setup.model, &setup.prefix, &queries, AskOptions { mode: Some(&cut), ..Default::default() })
                .unwrap();
        for (query, reading) in queries.iter().zip(cut) {
            assert_eq!(reading.value.is_nan(), query.measured.is_none());
        }
    }
}

#[test]
fn a_frame_is_completed_by_every_way_of_asking() {
    for reference in [PixelReference::Coordinates, PixelReference::Marker(Marker::default())] {
        let model = chain(&for_chain(reference));
        let completer = DepthCompleter::new(model);
        let (rgb, sparse) = tiny::frame(90, 70);
        let free = AnswerMode::Generate(Generation::default());
        for answer in [None, Some(AnswerMode::Digits), Some(free)] {
            let mut options = CompleteOptions::default().with_plan(QueryPlan::Stride(16)).with_align(false);
            options.answer = answer;
            let map = completer.complete(&rgb, &sparse, &options).unwrap();
            assert!(map.keeps(&sparse) && map.valid() == 90 * 70);
            let asked = map.get(3, 3).unwrap();
            assert!((1.0..9.5).contains(&asked), "{asked}");
        }
    }
}

#[test]
fn an_answer_that_was_told_its_measurement_is_not_moved() {
    let completer = DepthCompleter::new(chain(&for_chain(PixelReference::Coordinates)));
    let (rgb, sparse) = tiny::frame(90, 70);
    let short = Generation { max_new_tokens: 8, ..Generation::default() };
    let options = CompleteOptions::default()
        .with_plan(QueryPlan::Stride(10))
        .with_preserve(Preserve::Ask)
        .with_answer(AnswerMode::Generate(short));
    let map = completer.complete(&rgb, &sparse, &options).unwrap();
    let asked = sdim::internals::query::plan::lattice(90, 70, 10);
    let (told, open): (Vec<_>, Vec<_>) = asked.iter().partition(|p| sparse.get(p.0, p.1).is_some());
    assert!(!told.is_empty());
    for (x, y) in told {
        assert!((map.get(x, y).unwrap() - 7.0).abs() < 1e-5, "({x}, {y}): {:?}", map.get(x, y));
    }
    let moved = open.iter().filter(|p| (map.get(p.0, p.1).unwrap() - 4.25).abs() > 0.1).count();
    assert!(moved * 2 > open.len(), "the others are aligned: {moved} of {}", open.len());
}

#[test]
fn what_does_not_go_together_is_refused() {
    let (rgb, sparse) = tiny::frame(90, 70);
    let tiny_completer = DepthCompleter::tiny().unwrap();
    let options = CompleteOptions::default().with_answer(AnswerMode::Generate(Generation::default()));
    let error = tiny_completer.complete(&rgb, &sparse, &options).unwrap_err();
    assert!(matches!(&error, Error::Config { key, .. } if key == "answer_mode.kind"), "{error}");

    let large = Marker { size: 35, ..DISC };
    let settings = Settings { pixel_reference: PixelReference::Marker(large), ..by_marker() };
    let files = tiny::small_files(&settings);
    let model = tiny::model(&files, tiny::tensors(&files, 1));
    let error = model.prefill_frame(&rgb, &sparse).err().unwrap();
    assert!(matches!(&error, Error::Config { key, .. } if key == "pixel_reference.size"), "{error}");
    // A prefix that was read without marks cannot be asked by marks.
    let (pixels, scattered) = model.preprocess(&rgb, &sparse).unwrap();
    let tokens = model.encode(&pixels, &scattered).unwrap();
    let prefix = model.prefill_prefix(&pixels, &tokens, &sparse).unwrap();
    let query = Query { x: 1, y: 1, measured: None, hint: 1.0 };
    let error = ask(&model, &prefix, &[query], AskOptions::default()).unwrap_err();
    assert!(matches!(error, Error::Argument { name: "prefix", .. }), "{error}");

    let setup = Setup::of(chain(&for_chain(PixelReference::Coordinates)));
    let unknown = Generation { stop: Some(vec!["<|no such|>".into()]), ..Generation::default() };
    let error = generate(&setup.model, &setup.prefix, &[query], &unknown, &mut |_| true).unwrap_err();
    assert!(matches!(error, Error::Tokenizer(_)), "{error}");
    let error = ask(
        &setup.model,
        &setup.prefix,
        &[query],
        AskOptions { mode: Some(&AnswerMode::Digits), progress: Some(&mut |_| false), ..Default::default() },
    )
    .unwrap_err();
    assert!(matches!(error, Error::Cancelled));
}

#[test]
fn the_published_tokenizer_writes_forced_and_free_answers_alike() {
    let Some(dir) = beside("tokenizer", "tokenizer.json") else { return };
    let tokenizer = Tokenizer::from_file(&dir.join("tokenizer.json")).unwrap();
    let encode = |text: &str| tokenizer.encode(text).unwrap();
    for (template, number) in [(PromptTemplate::paper(), "4.230"), (PromptTemplate::depthlm(), "12.05")] {
        let (before, after) = template.answer.split_once("{y}").unwrap();
        let parts = [encode(before), encode(number), encode(after)].concat();
        assert_eq!(parts, encode(&template.answer.replace("{y}", number)), "{}", template.answer);
        assert_eq!(encode(number).len(), number.len(), "one token per digit");
        // The chat template, for one image and one question.
        let whole =
            format!("{}<|image_pad|>{}{}", template.before_image, template.after_image, template.query);
        let question = template.query.split_once("<|im_end|>").unwrap().0;
        let published = format!(
            "<|im_start|>system\nYou are a helpful assistant.<|im_end|>\n<|im_start|>user\n<|vision_start|><|image_pad|>\
             <|vision_end|>{question}<|im_end|>\n<|im_start|>assistant\n"
        );
        assert_eq!(whole, published);
        let seams = [encode(&template.before_image), encode("<|image_pad|>"), encode(&template.after_image)];
        assert_eq!([seams.concat(), encode(&template.query)].concat(), encode(&whole));
    }
    // What tells measurements must not be lost when the query says nothing of them.
    assert_eq!(Settings::depthlm().measurements, MeasurementPrompt::None);
}
