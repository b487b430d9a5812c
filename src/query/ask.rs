//! Batches of per-pixel suffixes against one shared prefix.

use super::answer::AnswerGrammar;
use super::generate::{Spoken, Voice};
use super::marked::MarkedFrame;
use super::mode::{AnswerMode, Generation};
use super::number::{DigitReader, NumberFormat, Reading, read_bins_with};
use super::prefix::Prefix;
use super::prompt::{Glimpse, Query, Tokens};
use super::settings::PixelReference;
use crate::error::{Error, Result};
use crate::kernels;
use crate::model::SdimModel;
use crate::vlm::rope::Position;
use crate::vlm::sequences::Sequences;
use candle_core::Device;
use rayon::prelude::*;
use std::collections::BTreeMap;

/// Rows of one decoder pass, at most: large enough for efficient products, small enough for the caches.
const ROWS: usize = 2048;
/// Rows whose logits are made and read at a time: what stays in the caches.
const LOGITS: usize = 256;
/// Queries whose prompts are written at a time, so that memory does not grow with their number.
const CHUNK: usize = 8 * ROWS;

/// Asks all queries in the checkpoint's own answer mode and returns one reading each, in metres, in their order.
///
/// Queries do not see each other: the result of each is that of asking it alone. `progress` is called with the number
/// of answered queries after each batch; it returns false to stop.
///
/// # Errors
/// [`crate::Error::Cancelled`] if `progress` said so; [`crate::Error::Argument`] if the prefix was not read for the
/// checkpoint's pixel reference; tensor and tokenizer errors.
pub fn ask(
    model: &SdimModel,
    prefix: &Prefix,
    queries: &[Query],
    progress: &mut dyn FnMut(usize) -> bool,
) -> Result<Vec<Reading>> {
    ask_as(model, prefix, queries, &model.prompts.settings().answer_mode, progress)
}

/// As [`ask`], in a given answer mode.
///
/// # Errors
/// As [`ask`], and [`crate::Error::Config`] if the mode does not go with the checkpoint.
pub fn ask_as(
    model: &SdimModel,
    prefix: &Prefix,
    queries: &[Query],
    mode: &AnswerMode,
    progress: &mut dyn FnMut(usize) -> bool,
) -> Result<Vec<Reading>> {
    ask_within(model, prefix, queries, mode, None, progress)
}

/// As [`ask_as`], in batches that take about `max_memory` bytes beside the weights and the prefix, at the least one query
/// at a time. The answers are the same for any limit.
///
/// # Errors
/// As [`ask_as`].
pub fn ask_within(
    model: &SdimModel,
    prefix: &Prefix,
    queries: &[Query],
    mode: &AnswerMode,
    max_memory: Option<usize>,
    progress: &mut dyn FnMut(usize) -> bool,
) -> Result<Vec<Reading>> {
    let unit = prefix.space.unit;
    let rows = rows_within(model, max_memory);
    match mode {
        AnswerMode::Digits => {
            let plan = Plan { forced: true, room: 0, rows };
            in_batches(model, prefix, queries, plan, progress, Reading::INVALID, &mut |mut batch| {
                let readings = forced_numbers(&mut batch)?.into_iter();
                Ok(readings
                    .map(|r| Reading { value: r.value * unit, expected_error: r.expected_error * unit, ..r })
                    .collect())
            })
        }
        AnswerMode::Generate(generation) => {
            let grammar = AnswerGrammar::new(&model.prompts.settings().template, unit);
            let spoken = speak(model, prefix, queries, generation, rows, progress)?;
            spoken.par_iter().map(|s| s.reading(&grammar, &model.tokenizer)).collect()
        }
    }
}

/// Rows of a decoder pass whose activations and own keys and values fit into a limit.
fn rows_within(model: &SdimModel, max_memory: Option<usize>) -> usize {
    let t = &model.vlm.config.text;
    // A layer holds about eight rows of its width at once (sums, norms, heads), and three of the MLP's.
    let passing = 8 * t.hidden_size + 3 * t.intermediate_size;
    let kept = 2 * t.layers * t.kv_heads * t.head_dim();
    let bytes = (passing + kept).max(1) * size_of::<f32>();
    max_memory.map_or(ROWS, |limit| (limit / bytes).clamp(1, ROWS))
}

/// Lets the model answer each query freely, token by token, and returns what it said, in the order of the queries.
///
/// # Errors
/// As [`ask_as`].
pub fn generate(
    model: &SdimModel,
    prefix: &Prefix,
    queries: &[Query],
    generation: &Generation,
    progress: &mut dyn FnMut(usize) -> bool,
) -> Result<Vec<Spoken>> {
    speak(model, prefix, queries, generation, ROWS, progress)
}

fn speak(
    model: &SdimModel,
    prefix: &Prefix,
    queries: &[Query],
    generation: &Generation,
    rows: usize,
    progress: &mut dyn FnMut(usize) -> bool,
) -> Result<Vec<Spoken>> {
    let settings = model.prompts.settings();
    AnswerMode::Generate(generation.clone()).validate("answer mode", settings)?;
    let voice = Voice::new(model, generation)?;
    let plan = Plan { forced: false, room: generation.max_new_tokens, rows };
    in_batches(model, prefix, queries, plan, progress, Spoken::default(), &mut |mut batch| {
        voice.speak(&mut batch)
    })
}

/// What a batch has to hold.
#[derive(Clone, Copy)]
struct Plan {
    /// Whether the answer's words before the number are part of the suffix.
    forced: bool,
    /// Tokens that may follow each suffix.
    room: usize,
    /// Rows of one decoder pass, at most.
    rows: usize,
}

/// Cuts the queries into batches of equally long suffixes, and puts what `answer` makes of them into their order.
fn in_batches<T: Clone + Send>(
    model: &SdimModel,
    prefix: &Prefix,
    queries: &[Query],
    plan: Plan,
    progress: &mut dyn FnMut(usize) -> bool,
    blank: T,
    answer: &mut (dyn FnMut(Batch) -> Result<Vec<T>> + Send),
) -> Result<Vec<T>> {
    let by_marker = matches!(model.prompts.settings().pixel_reference, PixelReference::Marker(_));
    if by_marker != prefix.marked.is_some() {
        let found = if by_marker { "a prefix with one image for all" } else { "a prefix of a marked frame" };
        return Err(Error::argument("prefix", found, "one that SdimModel::read_frame of this model read"));
    }
    let mut out = vec![blank; queries.len()];
    let mut done = 0;
    for (start, chunk) in (0..).step_by(CHUNK).zip(queries.chunks(CHUNK)) {
        let suffixes: Vec<Tokens> = chunk
            .par_iter()
            .map(|q| model.prompts.tokens(q, &prefix.space, &model.tokenizer, plan.forced))
            .collect::<Result<_>>()?;
        let mut by_length: BTreeMap<usize, Vec<usize>> = BTreeMap::new();
        for (i, s) in suffixes.iter().enumerate() {
            by_length.entry(s.len()).or_default().push(i);
        }
        for (length, members) in by_length {
            let rows = match &prefix.marked {
                None => length + plan.room,
                Some(marked) => marked.patches().max(marked.opening().len() + length + plan.room),
            };
            for batch in members.chunks((plan.rows / rows.max(1)).max(1)) {
                let asked: Vec<&Query> = batch.iter().map(|&i| &chunk[i]).collect();
                let tokens: Vec<&Tokens> = batch.iter().map(|&i| &suffixes[i]).collect();
                let read = || answer(Batch::open(model, prefix, &asked, &tokens)?);
                let answers = kernels::in_pool(&model.device, read)?;
                for (&i, a) in batch.iter().zip(answers) {
                    out[start + i] = a;
                }
                done += batch.len();
                if !progress(done) {
                    return Err(Error::Cancelled);
                }
            }
        }
    }
    Ok(out)
}

/// Suffixes of equal length that are read together and go on together, token by token.
pub(super) struct Batch<'a> {
    pub(super) model: &'a SdimModel,
    prefix: &'a Prefix,
    /// All ids of each item, those of the shared prefix first.
    suffixes: Vec<&'a [u32]>,
    pub(super) sequences: Sequences<'a>,
}

impl<'a> Batch<'a> {
    /// Reads the suffixes.
    fn open(
        model: &'a SdimModel,
        prefix: &'a Prefix,
        queries: &[&Query],
        suffixes: &[&'a Tokens],
    ) -> Result<Self> {
        let opening = prefix.marked.as_ref().map(MarkedFrame::opening);
        let parts = || suffixes.iter().flat_map(|s| opening.into_iter().chain([*s]));
        let ids: Vec<u32> = parts().flat_map(|t| t.ids.iter().copied()).collect();
        let positions: Vec<Position> = parts().flat_map(|t| t.positions.iter().copied()).collect();
        let mut before = 0;
        let mut glimpses: Vec<Glimpse> = Vec::new();
        for part in parts() {
            glimpses.extend(part.glimpses.iter().map(|g| Glimpse { token: before + g.token, ..*g }));
            before += part.len();
        }
        let embedded = match &prefix.marked {
            None => model.vlm.decoder.embed(&ids)?,
            Some(marked) => {
                let pixels: Vec<(usize, usize)> = queries.iter().map(|q| (q.x, q.y)).collect();
                model.vlm.embed_prompt(&ids, &marked.encode(model, &pixels)?)?
            }
        };
        let embedded = model.add_glimpses(embedded, &[(&prefix.image, &glimpses)])?;
        let next = suffixes.iter().map(|s| s.next_text(&prefix.space)).collect();
        let shared = Some(&prefix.cache);
        let sequences = Sequences::read(&model.vlm.decoder, shared, &embedded, &positions, next)?;
        let suffixes = suffixes.iter().map(|s| s.ids.as_slice()).collect();
        Ok(Self { model, prefix, suffixes, sequences })
    }

    /// Ids that an item has read, image placeholders included.
    pub(super) fn prompt(&self, item: usize) -> impl Iterator<Item = u32> + '_ {
        let opening = self.prefix.marked.iter().flat_map(|m| m.opening().ids.iter());
        self.prefix.ids.iter().chain(opening).chain(self.suffixes[item]).copied()
    }

    /// Goes on with these items only, in this order.
    pub(super) fn keep(&mut self, items: &[usize]) -> Result<()> {
        self.sequences.keep(items)?;
        self.suffixes = items.iter().map(|&i| self.suffixes[i]).collect();
        Ok(())
    }

    /// What `read` makes of each item's logits of the numbers.
    fn of_numbers<S: Send, T: Send>(
        &self,
        scratch: impl Fn() -> S + Sync,
        read: impl Fn(&mut S, &[f32]) -> T + Sync,
    ) -> Result<Vec<T>> {
        let items = self.sequences.count();
        let mut out = Vec::with_capacity(items);
        for first in (0..items).step_by(LOGITS) {
            let some = self.sequences.last().narrow(0, first, LOGITS.min(items - first))?;
            let logits = self.model.number_rows.linear(&some, None)?;
            let width = logits.dim(1)?.max(1);
            kernels::read(&logits.to_device(&Device::Cpu)?, |logits| {
                out.par_extend(
                    logits.par_chunks(width).map_init(&scratch, |scratch, row| read(scratch, row)),
                );
                Ok(())
            })?;
        }
        Ok(out)
    }
}

/// The number that each item is made to say, in number units: its words are forced, its tokens chosen among numbers.
fn forced_numbers(batch: &mut Batch) -> Result<Vec<Reading>> {
    let numbers = batch.model.prompts.numbers();
    let (decimals, integers) = match numbers.format {
        NumberFormat::Bins { range, .. } => {
            return batch.of_numbers(Vec::new, |scratch, row| read_bins_with(row, range, scratch));
        }
        NumberFormat::Digits { decimals, integers } => (decimals, integers),
    };
    let items = batch.sequences.count();
    let mut readers = vec![DigitReader::new(decimals, integers); items];
    let mut alive = vec![true; items];
    loop {
        let rows = batch.of_numbers(|| (), |(), row| row.to_vec())?;
        let mut ids = vec![numbers.ids[0]; items];
        let mut open = false;
        for (i, row) in rows.iter().enumerate() {
            if alive[i] {
                match readers[i].push(row) {
                    Some(digit) => ids[i] = numbers.ids[digit],
                    None => alive[i] = false,
                }
                alive[i] &= !readers[i].done();
                open |= alive[i];
            }
        }
        if !open {
            return Ok(readers.iter().map(DigitReader::reading).collect());
        }
        batch.sequences.go_on(&ids)?;
    }
}
