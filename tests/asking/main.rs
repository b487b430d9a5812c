//! Every way of asking: marks in the image, forced and free answers, against runs from scratch that share no code with them
//! but the model's layers.

mod chain;
#[path = "../common/mod.rs"]
mod common;
mod setup;

use candle_core::Tensor;
use common::{close, relative_difference, tiny};
use sdim::internals::model::FreeAnswer;
use sdim::internals::query::Query;
use sdim::internals::vlm::qwen2_5::decoder::Keep;
use sdim::internals::vlm::qwen2_5::rope::Position;
use sdim::settings::{Generation, Marker, PixelReference, PromptTemplate, Settings};
use setup::{DISC, Setup, by_coordinates, by_marker};

#[test]
fn marked_frames_are_encoded_exactly_as_if_from_scratch() {
    for shape in [tiny::SMALL].iter().chain(&tiny::MIDDLE) {
        for marker in [Marker::default(), DISC] {
            let settings = Settings { pixel_reference: PixelReference::Marker(marker), ..by_marker() };
            let setup = Setup::new(&settings, shape);
            let queries = setup.queries(9);
            let wanted: Vec<Tensor> = queries
                .iter()
                .map(|q| {
                    let (pixels, scattered) = setup.model.preprocess(&setup.shown(q), &setup.sparse).unwrap();
                    setup.model.encode(&pixels, &scattered).unwrap()
                })
                .collect();
            let marked = setup.prefix.marked.as_ref().unwrap();
            let at: Vec<(usize, usize)> = queries.iter().map(|q| (q.x, q.y)).collect();
            let ours = marked.encode(&setup.model, &at).unwrap();
            let difference = relative_difference(&ours, &Tensor::cat(&wanted, 0).unwrap());
            assert!(difference <= 1e-5, "{shape:?}, {marker:?}: {difference:.1e}");
            let one = marked.encode(&setup.model, &at[4..5]).unwrap();
            assert!(relative_difference(&one, &wanted[4]) <= 1e-5, "{shape:?}: one alone");
            let moved = relative_difference(&wanted[5], &wanted[4]);
            assert!(moved > 1e-3, "{shape:?}: marks change {moved:.1e} only");
        }
    }
}

#[test]
fn queries_by_marker_are_answered_as_if_each_were_alone() {
    for shape in [&tiny::SMALL, &tiny::MIDDLE[0]] {
        let setup = Setup::new(&by_marker(), shape);
        // At so many patches an image, a few batches.
        let queries = setup.queries(25);
        let all = setup.digits(&queries);
        for i in (0..queries.len()).step_by(7) {
            close(&format!("query {i}"), &all[i], &setup.digits_from_scratch(&queries[i]));
            close(&format!("query {i}, the only one"), &all[i], &setup.digits(&queries[i..=i])[0]);
        }
        let backwards: Vec<Query> = queries.iter().rev().copied().collect();
        for (a, b) in all.iter().zip(setup.digits(&backwards).iter().rev()) {
            close("backwards", a, b);
        }
        for (a, b) in all.iter().zip(queries.chunks(7).flat_map(|part| setup.digits(part))) {
            close("in parts", a, &b);
        }
    }
}

#[test]
fn free_answers_are_those_of_each_query_alone_and_end_one_by_one() {
    for settings in [by_coordinates(), by_marker()] {
        for shape in [&tiny::MIDDLE[0], &tiny::MIDDLE[2]] {
            let setup = Setup::new(&settings, shape);
            let queries = setup.queries(16);
            let long = Generation { max_new_tokens: 7, ..Generation::default() };
            // A token that some say early and others late or never makes good ends.
            let said = setup.speak(&queries, &long);
            let first = |id: u32| said.iter().map(move |s| s.ids.iter().position(|&i| i == id));
            let stop = said
                .iter()
                .flat_map(|s| &s.ids[1..])
                .max_by_key(|&&id| first(id).collect::<std::collections::BTreeSet<_>>().len())
                .unwrap();
            let ends = first(*stop).collect::<std::collections::BTreeSet<_>>();
            assert!(ends.len() > 1, "all answers end alike");
            let generation =
                Generation { stop: Some(vec![tiny::token(&tiny::files(&settings, shape), *stop)]), ..long };
            let all = setup.speak(&queries, &generation);
            for (i, query) in queries.iter().enumerate() {
                let what = format!("query {i}");
                if i % 4 == 0 {
                    assert_eq!(
                        setup.speak(&[*query], &generation)[0].ids,
                        all[i].ids,
                        "{what}, the only one"
                    );
                    let (ids, ended) = setup.words_from_scratch(query, &generation);
                    assert_eq!((&all[i].ids, all[i].ended), (&ids, ended), "{what}, from scratch");
                }
                assert!(all[i].probabilities.iter().all(|p| (0.0..=1.0).contains(p)));
                assert_eq!(all[i].probabilities.len(), all[i].ids.len());
            }
            let backwards: Vec<Query> = queries.iter().rev().copied().collect();
            let backwards = setup.speak(&backwards, &generation);
            assert!(all.iter().eq_by_ids(backwards.iter().rev()));
        }
    }
}

trait EqByIds<'a>: Iterator<Item = &'a FreeAnswer> + Sized {
    fn eq_by_ids(self, other: impl Iterator<Item = &'a FreeAnswer>) -> bool {
        self.map(|s| &s.ids).eq(other.map(|s| &s.ids))
    }
}

impl<'a, I: Iterator<Item = &'a FreeAnswer>> EqByIds<'a> for I {}

#[test]
fn free_answers_follow_a_pointer_and_mind_the_penalty() {
    let mut settings = by_coordinates();
    settings.template =
        PromptTemplate { query: "at {pixel}?".into(), answer: "{y}".into(), ..settings.template };
    settings.pixel_reference = PixelReference::Pointer { token: "<|point|>".into() };
    let setup = Setup::new(&settings, &tiny::MIDDLE[0]);
    let queries = setup.queries(12);
    let generation =
        |penalty| Generation { max_new_tokens: 6, repetition_penalty: penalty, ..Generation::default() };
    let decoder = &setup.model.vlm.decoder;
    for penalty in [1.0, 1.6] {
        let all = setup.speak(&queries, &generation(penalty));
        for (spoken, query) in all.iter().zip(&queries).step_by(3) {
            // One by one over a cache of its own, from the pointer's suffix on.
            let suffix =
                setup.model.prompts.suffix(query, &setup.prefix.space, &setup.model.tokenizer).unwrap();
            let mut cache = setup.prefix.cache.clone();
            let mut seen = [&setup.prefix.ids[..], &suffix.ids].concat();
            let mut hidden = setup
                .model
                .vlm
                .prefill(&decoder.embed(&suffix.ids).unwrap(), &suffix.positions, &mut cache, Keep::All)
                .unwrap();
            // "at " and "?" are text, the pointer stands elsewhere.
            let mut next = setup.prefix.space.next + 4.0;
            for &id in &spoken.ids {
                let last = hidden.narrow(0, hidden.dim(0).unwrap() - 1, 1).unwrap();
                let mut logits = setup.logits(&decoder.final_norm(&last).unwrap());
                logits.truncate(setup.model.tokenizer.vocab_size());
                for (_, l) in logits.iter_mut().enumerate().filter(|(i, _)| seen.contains(&(*i as u32))) {
                    *l = if *l < 0.0 { *l * penalty } else { *l / penalty };
                }
                let best = (0..logits.len()).max_by(|&a, &b| logits[a].total_cmp(&logits[b])).unwrap();
                assert_eq!(best as u32, id, "penalty {penalty}");
                seen.push(id);
                let embedded = decoder.embed(&[id]).unwrap();
                hidden = setup
                    .model
                    .vlm
                    .prefill(&embedded, &[Position::text(next)], &mut cache, Keep::All)
                    .unwrap();
                next += 1.0;
            }
        }
    }
    let plain = setup.speak(&queries, &generation(1.0));
    assert!(
        !plain.iter().eq_by_ids(setup.speak(&queries, &generation(1.6)).iter()),
        "the penalty does nothing"
    );
}
