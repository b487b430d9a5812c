//! Many queries against one shared prefix give what each would give alone, read from its first token to its last.

mod common;

use candle_core::Tensor;
use common::{close, relative_difference, tiny};
use image::RgbImage;
use sdim::SparseDepth;
use sdim::internals::kernels::Block;
use sdim::internals::model::{AskOptions, Prefix, SdimModel, ask};
use sdim::internals::query::Query;
use sdim::internals::query::Reading;
use sdim::internals::query::number::DigitReader;
use sdim::internals::query::prompt::Tokens;
use sdim::internals::supervise::FreshFiles;
use sdim::internals::vlm::qwen2_5::cache::KvCache;
use sdim::internals::vlm::qwen2_5::decoder::{Context, Keep};
use sdim::internals::vlm::qwen2_5::grid::Grid;
use sdim::internals::vlm::qwen2_5::rope::Position;
use sdim::internals::vlm::qwen2_5::sequences::Sequences;
use sdim::settings::{
    DepthUnit, Hint, MeasurementPrompt, NumberFormat, PixelReference, RopeLayout, Settings,
};

/// Largest difference, relative to the largest value.
const TOLERANCE: f64 = 1e-4;

/// One model with one frame, its prefix as the crate reads it and as plain tokens.
struct Setup {
    model: SdimModel,
    prefix: Prefix,
    embedded: Tensor,
    positions: Vec<Position>,
    sparse: SparseDepth,
    /// Text tokens of a suffix: those that move the position on.
    text_tokens: Option<usize>,
}

impl Setup {
    /// `text_tokens` of a suffix, if not all of them are.
    fn new(settings: &Settings, small: bool, text_tokens: Option<usize>) -> Self {
        let files = if small { tiny::small_files(settings) } else { FreshFiles::tiny(settings).unwrap() };
        Self::of(files, text_tokens)
    }

    fn of(files: FreshFiles, text_tokens: Option<usize>) -> Self {
        let mut tensors = tiny::tensors(&files, 11);
        tiny::wake(&mut tensors);
        let model = tiny::model(&files, tensors);
        let (rgb, sparse): (RgbImage, SparseDepth) = tiny::frame(90, 70);
        let (pixels, scattered) = model.preprocess(&rgb, &sparse).unwrap();
        let image_tokens = model.encode(&pixels, &scattered).unwrap();
        let prefix = model.prefill_prefix(&pixels, &image_tokens, &sparse).unwrap();
        let resized = (pixels.resized.width() as usize, pixels.resized.height() as usize);
        let (tokens, _) = model.prompts.prefix(&sparse, pixels.grid, resized, &model.vlm.config, 0).unwrap();
        let embedded = model.vlm.embed_prompt(&tokens.ids, &image_tokens).unwrap();
        let embedded = model.add_glimpses(embedded, &[(&prefix.view, &tokens.glimpses)]).unwrap();
        assert_eq!(prefix.cache.len(), tokens.len());
        Self { model, prefix, embedded, positions: tokens.positions, sparse, text_tokens }
    }

    /// Queries all over the frame, at measured pixels too.
    fn queries(&self, count: usize) -> Vec<Query> {
        let (w, h) = (self.sparse.width(), self.sparse.height());
        (0..count)
            .map(|i| {
                let at = i * 37 * 11 % (w * h) + usize::from(i % 3 == 0);
                let (x, y) = (at % w, at / w);
                Query { x, y, measured: self.sparse.get(x, y), hint: 1.0 + (i * 13 % 80) as f32 * 0.1 }
            })
            .collect()
    }

    fn suffix(&self, query: &Query) -> Tokens {
        self.model.prompts.suffix(query, &self.prefix.space, &self.model.tokenizer).unwrap()
    }

    /// Embeddings of suffixes, one after the other, each with its own crops.
    fn embed(&self, suffixes: &[Tokens]) -> Tensor {
        let embedded: Vec<Tensor> = suffixes
            .iter()
            .map(|s| {
                let plain = self.model.vlm.decoder.embed(&s.ids).unwrap();
                self.model.add_glimpses(plain, &[(&self.prefix.view, &s.glimpses)]).unwrap()
            })
            .collect();
        Tensor::cat(&embedded, 0).unwrap()
    }

    /// Hidden states of the last tokens of prefix and suffix, read in one run without any cache before it.
    fn alone(&self, suffix: &Tokens) -> Tensor {
        let decoder = &self.model.vlm.decoder;
        let own = self.embed(std::slice::from_ref(suffix));
        let positions: Vec<Position> = self.positions.iter().chain(&suffix.positions).copied().collect();
        let embedded = Tensor::cat(&[&self.embedded, &own], 0).unwrap();
        let hidden = self.model.vlm.prefill(&embedded, &positions, &mut decoder.cache(1), Keep::All).unwrap();
        hidden.narrow(0, self.positions.len(), suffix.len()).unwrap()
    }

    /// Hidden states of equally long suffixes, one after the other, against the shared prefix.
    fn together(&self, suffixes: &[Tokens]) -> Tensor {
        let decoder = &self.model.vlm.decoder;
        let positions: Vec<Position> = suffixes.iter().flat_map(|s| s.positions.clone()).collect();
        let table = decoder.rope().table(&positions, &common::device()).unwrap();
        let mut own = decoder.cache(suffixes.len());
        let context = Context::Cached { shared: Some(&self.prefix.cache), own: &mut own };
        decoder.forward(&self.embed(suffixes), &table, context, None).unwrap()
    }

    /// The same as the trainer packs it: prefix and suffixes in one sequence, no cache.
    fn packed(&self, suffixes: &[Tokens]) -> Tensor {
        let decoder = &self.model.vlm.decoder;
        let embedded = Tensor::cat(&[&self.embedded, &self.embed(suffixes)], 0).unwrap();
        let own = suffixes.iter().flat_map(|s| &s.positions);
        let positions: Vec<Position> = self.positions.iter().chain(own).copied().collect();
        let table = decoder.rope().table(&positions, &common::device()).unwrap();
        let (p, s, rows) = (self.positions.len(), suffixes[0].len(), positions.len());
        let block = |queries: std::ops::Range<usize>, shared, period| Block {
            own_start: queries.start,
            queries,
            shared,
            q_period: period,
            k_period: period,
            causal: true,
        };
        let layout = decoder.layout(vec![block(0..p, 0..0, p), block(p..rows, 0..p, s)]);
        let hidden = decoder.forward(&embedded, &table, Context::Packed(&layout), None).unwrap();
        hidden.narrow(0, p, rows - p).unwrap()
    }

    fn logits(&self, hidden: &Tensor) -> Vec<f32> {
        let last = hidden.narrow(0, hidden.dim(0).unwrap() - 1, 1).unwrap();
        let normed = self.model.vlm.decoder.final_norm(&last).unwrap();
        self.model.number_rows.linear(&normed, None).unwrap().flatten_all().unwrap().to_vec1().unwrap()
    }

    /// The answer to one query, each of its tokens read in a run of its own from the first token on.
    fn reading_alone(&self, query: &Query) -> Reading {
        let mut tokens = self.suffix(query);
        let numbers = self.model.prompts.numbers();
        let unit = self.prefix.space.unit;
        let metres =
            |r: Reading| Reading { value: r.value * unit, expected_error: r.expected_error * unit, ..r };
        match numbers.format {
            NumberFormat::Bins { .. } | NumberFormat::LogBins { .. } => {
                let bins = numbers.format.bins().unwrap();
                metres(bins.read(&self.logits(&self.alone(&tokens)), &mut Vec::new()))
            }
            NumberFormat::Digits { decimals, integers } => {
                let mut reader = DigitReader::new(decimals, integers);
                let mut next = self.prefix.space.next + self.text_tokens.unwrap_or(tokens.len()) as f32;
                while !reader.done() {
                    let digit = reader.push(&self.logits(&self.alone(&tokens))).unwrap();
                    tokens.ids.push(numbers.ids[digit]);
                    tokens.positions.push(Position::text(next));
                    next += 1.0;
                }
                metres(reader.reading())
            }
        }
    }

    fn ask(&self, queries: &[Query]) -> Vec<Reading> {
        ask(&self.model, &self.prefix, queries, AskOptions::default()).unwrap()
    }

    /// Batches of several sizes and orders against each query alone.
    fn check_readings(&self, count: usize, sample: usize) {
        let queries = self.queries(count);
        let all = self.ask(&queries);
        let errors = || all.iter().map(|r| r.expected_error);
        let spread = errors().fold(f32::MIN, f32::max) - errors().fold(f32::MAX, f32::min);
        assert!(spread > 0.01 * all[0].expected_error, "all answers are the same");
        for i in (0..count).step_by((count / sample).max(1)) {
            let what = format!("query {i} of {count}");
            close(&format!("{what}, from scratch"), &all[i], &self.reading_alone(&queries[i]));
            close(&format!("{what}, as the only one"), &all[i], &self.ask(&queries[i..=i])[0]);
        }
        let backwards: Vec<Query> = queries.iter().rev().copied().collect();
        for (i, reading) in self.ask(&backwards).iter().rev().enumerate() {
            close(&format!("query {i} of {count}, asked backwards"), &all[i], reading);
        }
        let halves = queries.chunks(count / 2 + 1).flat_map(|part| self.ask(part));
        for (i, reading) in halves.enumerate() {
            close(&format!("query {i} of {count}, in two batches"), &all[i], &reading);
        }
    }
}

/// A pixel by its position, the answer as one token: what the tiny model does.
fn pointer_and_bins() -> Settings {
    Settings::tiny()
}

/// As `pointer_and_bins`, with words around the pixel and before the answer.
fn pointer_in_words() -> Settings {
    let mut settings = Settings::tiny();
    settings.template.query = "at {pixel}?".into();
    settings.template.answer = "is {y}".into();
    settings.number = NumberFormat::Bins { bins: 100, range: 1.25 };
    settings.wide_glimpse = None;
    settings
}

/// A pixel in words, a sentence about its measurement, the answer digit by digit: what the paper does.
fn coordinates_and_digits() -> Settings {
    Settings::paper()
}

/// The pointer states a guess of several digits, all of them at the pixel.
fn pointer_and_digits() -> Settings {
    let mut settings = Settings::tiny();
    settings.rope_layout = RopeLayout::Contiguous;
    settings.number = NumberFormat::Digits { decimals: 2, integers: 2 };
    settings.wide_glimpse = None;
    settings.unit = DepthUnit::Metres;
    settings.hint = Hint::Linear;
    settings.measurements = MeasurementPrompt::Prefix { max: 16 };
    settings.template.query = "at {pixel}?".into();
    settings.template.answer = "is {y}".into();
    assert!(matches!(settings.pixel_reference, PixelReference::Pointer { .. }));
    settings
}

#[test]
fn hidden_states_are_those_of_each_query_alone() {
    for (name, settings, small) in [
        ("pointer", pointer_and_bins(), false),
        ("pointer in words", pointer_in_words(), true),
        ("coordinates", coordinates_and_digits(), true),
    ] {
        let setup = Setup::new(&settings, small, None);
        let mut suffixes: Vec<Tokens> = setup.queries(70).iter().map(|q| setup.suffix(q)).collect();
        let length = suffixes[1].len();
        suffixes.retain(|s| s.len() == length);
        assert_eq!(length == 1, name == "pointer", "{name}: {length} tokens");
        let alone: Vec<Tensor> = suffixes.iter().take(33).map(|s| setup.alone(s)).collect();
        let mut worst = 0f64;
        for count in [1, 2, 7, 33] {
            let count = count.min(alone.len());
            let wanted = Tensor::cat(&alone[..count], 0).unwrap();
            for (way, ours) in
                [("cached", setup.together(&suffixes[..count])), ("packed", setup.packed(&suffixes[..count]))]
            {
                let difference = relative_difference(&ours, &wanted);
                assert!(difference <= TOLERANCE, "{name}, {count} {way}: {difference:.1e}");
                worst = worst.max(difference);
            }
        }
        println!("{name}: {length} tokens each, {} of prefix, worst {worst:.1e}", setup.positions.len());
    }
}

#[test]
fn one_token_queries_read_the_same_alone_and_in_any_batch() {
    // More than one pass of the decoder takes.
    Setup::new(&pointer_and_bins(), true, None).check_readings(5000, 12);
}

#[test]
fn queries_in_words_read_the_same_alone_and_in_any_batch() {
    Setup::new(&pointer_in_words(), true, None).check_readings(60, 10);
    Setup::new(&coordinates_and_digits(), true, None).check_readings(64, 6);
}

#[test]
fn digits_after_a_pointer_go_on_where_the_text_stopped() {
    // "at ", "?" and "is " are seven bytes, one token each.
    Setup::new(&pointer_and_digits(), true, Some(7)).check_readings(40, 8);
}

#[test]
fn models_of_other_shapes_read_the_same_alone_and_in_any_batch() {
    for shape in &tiny::MIDDLE {
        println!("{shape:?}");
        Setup::of(tiny::files(&pointer_in_words(), shape), None).check_readings(30, 5);
        Setup::of(tiny::files(&coordinates_and_digits(), shape), None).check_readings(16, 2);
        Setup::of(tiny::files(&pointer_and_digits(), shape), Some(7)).check_readings(20, 4);
    }
}

#[test]
fn text_after_the_image_goes_on_at_its_larger_side_and_not_at_its_number_of_tokens() {
    let setup = Setup::new(&coordinates_and_digits(), true, None);
    let (query, space) = (setup.queries(5)[4], setup.prefix.space);
    let suffix = setup.suffix(&query);
    let ids = &setup.model.vlm.config.ids;
    // Written out here: the positions of one run over all, as the reference counts them.
    let template = &setup.model.prompts.settings().template;
    let text = |t: &str| setup.model.tokenizer.encode(t).unwrap().len();
    let (before, after) = (text(&template.before_image), text(&template.after_image));
    let (rows, cols) = space.merged;
    assert!(rows != cols && rows * cols > rows.max(cols), "{rows}x{cols} tells nothing");
    let by_hand = |step: usize| -> Vec<Position> {
        let start = before as f32;
        let image = (0..rows * cols).map(|i| Position {
            t: start,
            h: start + (i / cols) as f32,
            w: start + (i % cols) as f32,
        });
        let texts = (0..after + suffix.len()).map(|i| Position::text((before + step + i) as f32));
        (0..before).map(|i| Position::text(i as f32)).chain(image).chain(texts).collect()
    };
    let right = by_hand(rows.max(cols));
    assert_eq!(setup.prefix.ids.iter().filter(|&&id| id == ids.image).count(), rows * cols);
    assert_eq!(setup.prefix.cache.len(), before + rows * cols + after, "tokens");
    assert_eq!(space.next, (before + rows.max(cols) + after) as f32, "position");
    assert_eq!([setup.positions.as_slice(), &suffix.positions].concat(), right);
    // The next digit of the answer goes on there, too; and positions that counted tokens would have shown.
    let run = |positions: &[Position]| {
        let own = setup.embed(std::slice::from_ref(&suffix));
        let embedded = Tensor::cat(&[&setup.embedded, &own], 0).unwrap();
        setup
            .model
            .vlm
            .prefill(&embedded, positions, &mut setup.model.vlm.decoder.cache(1), Keep::All)
            .unwrap()
    };
    let last =
        |hidden: Tensor| hidden.narrow(0, hidden.dim(0).unwrap() - suffix.len(), suffix.len()).unwrap();
    let together = setup.together(std::slice::from_ref(&suffix));
    assert!(relative_difference(&together, &last(run(&right))) <= TOLERANCE);
    let counted = relative_difference(&together, &last(run(&by_hand(rows * cols))));
    assert!(counted > 10.0 * TOLERANCE, "token count as position: {counted:.1e}");
}

#[test]
fn sequences_go_on_as_each_would_alone() {
    let setup = Setup::new(&pointer_and_digits(), true, Some(0));
    let suffixes: Vec<Tokens> = setup.queries(3).iter().map(|q| setup.suffix(q)).collect();
    let read = |some: &[usize]| {
        let some: Vec<Tokens> = some.iter().map(|&i| suffixes[i].clone()).collect();
        let positions: Vec<Position> = some.iter().flat_map(|s| s.positions.clone()).collect();
        let next = some.iter().map(|s| s.next_text(&setup.prefix.space)).collect();
        let (decoder, shared) = (&setup.model.vlm.decoder, Some(&setup.prefix.cache));
        Sequences::prefill(decoder, shared, &setup.embed(&some), &positions, next).unwrap()
    };
    let mut all = read(&[0, 1, 2]);
    let ids = [3u32, 5, 4, 6];
    all.decode_step(&ids[..3]).unwrap();
    all.keep(&[2, 0]).unwrap();
    assert_eq!((all.count(), all.last().dim(0).unwrap()), (2, 2));
    let before = all.last().clone();
    all.decode_step(&[ids[3], ids[0]]).unwrap();
    for (row, (i, then)) in [(2, ids[3]), (0, ids[0])].into_iter().enumerate() {
        let mut alone = read(&[i]);
        for (id, together) in [(ids[i], &before), (then, all.last())] {
            alone.decode_step(&[id]).unwrap();
            let difference = relative_difference(&together.narrow(0, row, 1).unwrap(), alone.last());
            assert!(difference <= TOLERANCE, "sequence {i}: {difference:.1e}");
        }
    }
    assert!(matches!(all.decode_step(&ids), Err(sdim::Error::Argument { name: "token ids", .. })));
    assert!(all.keep(&[2]).is_err());
}

#[test]
fn caches_and_grids_that_do_not_fit_are_refused() {
    let setup = Setup::new(&pointer_and_bins(), true, None);
    let (model, decoder) = (&setup.model, &setup.model.vlm.decoder);
    let (one, none) = (decoder.embed(&[1]).unwrap(), decoder.embed(&[1]).unwrap().narrow(0, 0, 0).unwrap());
    let at = [Position::text(0.0)];
    let mut others = KvCache::new(1, 1);
    for (embedded, positions, cache, named) in [
        (&none, &at[..0], &mut decoder.cache(1), "rows"),
        (&none, &at[..0], &mut decoder.cache(0), "rows"),
        (&one, &at[..], &mut decoder.cache(0), "rows"),
        (&one, &at[..], &mut others, "layers of a cache"),
    ] {
        let error = model.vlm.prefill(embedded, positions, cache, Keep::Last).unwrap_err();
        assert!(matches!(&error, sdim::Error::Argument { name, .. } if *name == named), "{error}");
    }
    let grid = Grid { height: 0, width: 0 };
    let error = model.prompts.prefix(&setup.sparse, grid, (0, 0), &model.vlm.config, 0).unwrap_err();
    assert!(matches!(error, sdim::Error::Argument { name: "image tokens", .. }), "{error}");
}

#[test]
fn the_prefix_matters() {
    let setup = Setup::new(&pointer_and_bins(), true, None);
    let suffix = setup.suffix(&setup.queries(1)[0]);
    let decoder = &setup.model.vlm.decoder;
    let table = decoder.rope().table(&suffix.positions, &common::device()).unwrap();
    let mut own = decoder.cache(1);
    let context = Context::Cached { shared: None, own: &mut own };
    let without =
        decoder.forward(&setup.embed(std::slice::from_ref(&suffix)), &table, context, None).unwrap();
    assert!(relative_difference(&without, &setup.alone(&suffix)) > 1e-2);
}
