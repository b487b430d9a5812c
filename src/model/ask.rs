//! Batches of per-pixel suffixes against one shared prefix.

use super::batch::Batch;
use super::generate::{FreeAnswer, TokenChooser};
use super::prefix::Prefix;
use super::sdim_model::SdimModel;
use super::wide_glimpse::WIDE_CHANNELS;
use crate::error::{Error, Result};
use crate::kernels;
use crate::query::Query;
use crate::query::grammar::AnswerGrammar;
use crate::query::mode::{AnswerMode, Generation};
use crate::query::number::{DigitReader, NumberFormat};
use crate::query::prompt::Tokens;
use crate::query::settings::PixelReference;
use crate::query::{Reading, Readout};
use crate::vlm::qwen2_5::crops::bytes_per_crop;
use rayon::prelude::*;
use std::collections::BTreeMap;

/// Rows of one decoder pass on the CPU, at most: large enough for efficient products, small enough for the caches.
const BATCH_ROWS: usize = 2048;
/// Bytes that a decoder pass on another device may take where nothing else is said: there a pass costs the least per row if it is large.
const DEVICE_BYTES: usize = 2 << 30;
/// Rows of one decoder pass on another device, at most.
const DEVICE_ROWS: usize = 1 << 16;
/// Bins whose statistics are found on a device, at most: its sums over bins are a product with a square of them.
const DEVICE_BINS: usize = 8192;
/// Queries whose prompts are written at a time, so that memory does not grow with their number; more where one batch holds more.
const QUERY_CHUNK: usize = 8 * BATCH_ROWS;

/// How queries are asked.
#[derive(Default)]
pub struct AskOptions<'a> {
    /// How answers are got; `None` for the checkpoint's own way.
    pub mode: Option<&'a AnswerMode>,
    /// Which number of a distribution over bins is the answer; digits and words have but one.
    pub readout: Readout,
    /// Bytes that a batch may take beside the weights and the prefix, about; at the least one query is asked at a time. The
    /// answers are the same for any limit.
    pub max_memory: Option<usize>,
    /// Called with the number of answered queries after each batch; it returns false to stop.
    pub progress: Option<&'a mut dyn FnMut(usize) -> bool>,
}

/// Asks all queries and returns one reading each, in metres, in their order.
///
/// Queries do not see each other: the result of each is that of asking it alone.
///
/// # Errors
/// [`crate::Error::Cancelled`] if `progress` said so; [`crate::Error::Argument`] if the prefix was not read for the
/// checkpoint's pixel reference; [`crate::Error::Config`] if the mode does not go with the checkpoint; tensor and tokenizer errors.
pub fn ask(
    model: &SdimModel,
    prefix: &Prefix,
    queries: &[Query],
    options: AskOptions,
) -> Result<Vec<Reading>> {
    let unit = prefix.space.unit;
    let rows = rows_within(model, prefix, options.max_memory);
    let mut on = |_: usize| true;
    let progress = options.progress.unwrap_or(&mut on);
    match options.mode.unwrap_or(&model.prompts.settings().answer_mode) {
        AnswerMode::Digits => {
            let plan = Plan { forced: true, room: 0, rows };
            in_batches(model, prefix, queries, plan, progress, Reading::INVALID, &mut |mut batch| {
                let readings = forced_numbers(&mut batch, options.readout)?.into_iter();
                Ok(readings
                    .map(|r| Reading { value: r.value * unit, expected_error: r.expected_error * unit, ..r })
                    .collect())
            })
        }
        AnswerMode::Generate(generation) => {
            let grammar = AnswerGrammar::new(&model.prompts.settings().template, unit);
            let answers = answer_freely(model, prefix, queries, generation, rows, progress)?;
            answers.par_iter().map(|s| s.reading(&grammar, &model.tokenizer)).collect()
        }
    }
}

/// Rows of a decoder pass whose activations and own keys and values fit into a limit.
fn rows_within(model: &SdimModel, prefix: &Prefix, max_memory: Option<usize>) -> usize {
    let t = &model.vlm.config.text;
    // A layer holds about eight rows of its width at once (sums, norms, heads), and three of the MLP's.
    let passing = 8 * t.hidden_size + 3 * t.intermediate_size;
    let kept = 2 * t.layers * t.kv_heads * t.head_dim();
    if model.device.is_cpu() {
        let bytes = (passing + kept).max(1) * size_of::<f32>();
        return max_memory.map_or(BATCH_ROWS, |limit| (limit / bytes).clamp(1, BATCH_ROWS));
    }
    // Scores of every head against the prefix, and their softmax, are there in full.
    let scores = 2 * t.heads * prefix.cache.len();
    // So many values of each bin are there while its statistics are found.
    let read = 8 * model.number_rows.dims().0;
    // Crops are cut before the pass.
    let settings = model.prompts.settings();
    let channels = 3 + settings.wide_glimpse.map_or(0, |_| WIDE_CHANNELS);
    let cut = settings.glimpse.map_or(0, |side| bytes_per_crop(side, channels));
    let bytes = ((passing + kept + scores + read).max(1) * size_of::<f32>()).max(cut);
    (max_memory.unwrap_or(DEVICE_BYTES) / bytes).clamp(1, DEVICE_ROWS)
}

/// Lets the model answer each query freely, token by token, and returns what it said, in the order of the queries.
///
/// # Errors
/// As [`ask`].
pub fn generate(
    model: &SdimModel,
    prefix: &Prefix,
    queries: &[Query],
    generation: &Generation,
    progress: &mut dyn FnMut(usize) -> bool,
) -> Result<Vec<FreeAnswer>> {
    answer_freely(model, prefix, queries, generation, rows_within(model, prefix, None), progress)
}

fn answer_freely(
    model: &SdimModel,
    prefix: &Prefix,
    queries: &[Query],
    generation: &Generation,
    rows: usize,
    progress: &mut dyn FnMut(usize) -> bool,
) -> Result<Vec<FreeAnswer>> {
    let settings = model.prompts.settings();
    settings.validate_mode("answer mode", &AnswerMode::Generate(generation.clone()))?;
    let chooser = TokenChooser::new(model, generation)?;
    let plan = Plan { forced: false, room: generation.max_new_tokens, rows };
    in_batches(model, prefix, queries, plan, progress, FreeAnswer::default(), &mut |mut batch| {
        chooser.answer_freely(&mut batch)
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
        return Err(Error::argument("prefix", found, "one that SdimModel::prefill_frame of this model read"));
    }
    let mut out = vec![blank; queries.len()];
    let mut done = 0;
    let at_a_time = QUERY_CHUNK.max(plan.rows);
    for (start, chunk) in (0..).step_by(at_a_time).zip(queries.chunks(at_a_time)) {
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

/// The number that each item is made to say, in number units: its words are forced, its tokens chosen among numbers.
fn forced_numbers(batch: &mut Batch, readout: Readout) -> Result<Vec<Reading>> {
    let numbers = batch.model.prompts.numbers();
    if let Some(bins) = numbers.format.bins() {
        return bins.with_middle(readout, |middle| {
            if batch.model.device.is_cpu() || bins.count > DEVICE_BINS {
                return batch.of_numbers(Vec::new, |scratch, row| bins.read_middle(row, scratch, middle));
            }
            let stats = batch.of_bins(middle, |at| bins.tolerance(at))?;
            Ok(stats.into_iter().map(|s| s.map_or(Reading::INVALID, |s| bins.reading(s))).collect())
        });
    }
    let NumberFormat::Digits { decimals, integers } = numbers.format else { return Ok(Vec::new()) };
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
        batch.sequences.decode_step(&ids)?;
    }
}
