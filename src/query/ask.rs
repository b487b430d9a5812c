//! Batches of per-pixel suffixes against one shared prefix.

use super::number::{DigitReader, NumberFormat, Reading, read_bins_with};
use super::prompt::{FrameSpace, Glimpse, Query, Tokens};
use crate::error::Result;
use crate::kernels;
use crate::model::SdimModel;
use crate::vlm::cache::KvCache;
use crate::vlm::decoder::{Context, Keep};
use crate::vlm::rope::Position;
use candle_core::Tensor;
use image::RgbImage;
use rayon::prelude::*;
use std::collections::BTreeMap;
use std::sync::Arc;

/// What all queries of a frame share: its keys and values, read once, and its space.
pub struct Prefix {
    /// Keys and values of the prefix tokens.
    pub cache: KvCache,
    /// Where pixels lie, and what numbers mean.
    pub space: FrameSpace,
    /// The resized frame, for the crops around pixels.
    pub image: Arc<RgbImage>,
}

/// Rows of one decoder pass, at most: large enough for efficient products, small enough for the caches.
const ROWS: usize = 4096;
/// Queries whose prompts are written at a time, so that memory does not grow with their number.
const CHUNK: usize = 4 * ROWS;

/// Asks all queries and returns one reading each, in metres, in their order.
///
/// Queries do not see each other: the result of each is that of asking it alone. `progress` is called with the number
/// of answered queries after each batch; it returns false to stop.
///
/// # Errors
/// [`crate::Error::Cancelled`] if `progress` said so; tensor and tokenizer errors.
pub fn ask(
    model: &SdimModel,
    prefix: &Prefix,
    queries: &[Query],
    progress: &mut dyn FnMut(usize) -> bool,
) -> Result<Vec<Reading>> {
    let mut readings = Vec::with_capacity(queries.len());
    for chunk in queries.chunks(CHUNK) {
        let before = readings.len();
        readings.extend(ask_chunk(model, prefix, chunk, &mut |done| progress(before + done))?);
    }
    Ok(readings)
}

fn ask_chunk(
    model: &SdimModel,
    prefix: &Prefix,
    queries: &[Query],
    progress: &mut dyn FnMut(usize) -> bool,
) -> Result<Vec<Reading>> {
    let suffixes: Vec<Tokens> = queries
        .par_iter()
        .map(|q| model.prompts.suffix(q, &prefix.space, &model.tokenizer))
        .collect::<Result<_>>()?;
    let mut by_length: BTreeMap<usize, Vec<usize>> = BTreeMap::new();
    for (i, s) in suffixes.iter().enumerate() {
        by_length.entry(s.len()).or_default().push(i);
    }
    let mut readings = vec![Reading::INVALID; queries.len()];
    let mut done = 0;
    for (length, members) in by_length {
        for batch in members.chunks((ROWS / length.max(1)).max(1)) {
            let answers = ask_batch(model, prefix, &suffixes, batch)?;
            for (&i, answer) in batch.iter().zip(answers) {
                readings[i] = Reading {
                    value: answer.value * prefix.space.unit,
                    expected_error: answer.expected_error * prefix.space.unit,
                    ..answer
                };
            }
            done += batch.len();
            if !progress(done) {
                return Err(crate::Error::Cancelled);
            }
        }
    }
    Ok(readings)
}

/// One batch of suffixes of equal length; readings in number units.
fn ask_batch(
    model: &SdimModel,
    prefix: &Prefix,
    suffixes: &[Tokens],
    batch: &[usize],
) -> Result<Vec<Reading>> {
    let ids: Vec<u32> = batch.iter().flat_map(|&i| suffixes[i].ids.iter().copied()).collect();
    let positions: Vec<Position> =
        batch.iter().flat_map(|&i| suffixes[i].positions.iter().copied()).collect();
    let length = suffixes[batch[0]].len();
    let glimpses: Vec<Glimpse> = batch
        .iter()
        .enumerate()
        .flat_map(|(n, &i)| {
            suffixes[i].glimpses.iter().map(move |g| Glimpse { token: n * length + g.token, ..*g })
        })
        .collect();
    let mut own = model.vlm.decoder.cache(batch.len());
    let mut logits = number_logits(model, prefix, &ids, &positions, &glimpses, &mut own)?;
    match model.prompts.numbers().format {
        NumberFormat::Bins { range, bins } => {
            let rows: Vec<f32> = logits.flatten_all()?.to_vec1()?;
            let rows = rows.par_chunks(bins);
            Ok(rows.map_init(Vec::new, |scratch, row| read_bins_with(row, range, scratch)).collect())
        }
        NumberFormat::Digits { decimals, integers } => {
            let mut readers = vec![DigitReader::new(decimals, integers); batch.len()];
            let mut alive = vec![true; batch.len()];
            let number_ids = &model.prompts.numbers().ids;
            // Text position of the first digit: one past the last text token of each suffix.
            let mut next: Vec<f32> = batch.iter().map(|&i| suffixes[i].next_text(&prefix.space)).collect();
            loop {
                let rows: Vec<f32> = logits.flatten_all()?.to_vec1()?;
                let mut ids = vec![number_ids[0]; batch.len()];
                let mut open = false;
                for (i, row) in rows.chunks(11).enumerate() {
                    if alive[i] {
                        match readers[i].push(row) {
                            Some(digit) => ids[i] = number_ids[digit],
                            None => alive[i] = false,
                        }
                        alive[i] &= !readers[i].done();
                        open |= alive[i];
                    }
                }
                if !open {
                    return Ok(readers.iter().map(DigitReader::reading).collect());
                }
                let positions: Vec<Position> = next.iter().map(|&p| Position::text(p)).collect();
                next.iter_mut().for_each(|p| *p += 1.0);
                logits = number_logits(model, prefix, &ids, &positions, &[], &mut own)?;
            }
        }
    }
}

/// Reads one more run of tokens per item and returns the number rows of the output head at each item's last token,
/// `[items, numbers]`.
fn number_logits(
    model: &SdimModel,
    prefix: &Prefix,
    ids: &[u32],
    positions: &[Position],
    glimpses: &[Glimpse],
    own: &mut KvCache,
) -> Result<Tensor> {
    let decoder = &model.vlm.decoder;
    let embedded = model.add_glimpses(decoder.embed(ids)?, &[(&prefix.image, glimpses)])?;
    let table = decoder.rope().table(positions, embedded.device())?;
    let context = Context::Cached { shared: Some(&prefix.cache), own };
    let last = decoder.forward_keeping(&embedded, &table, context, Keep::Last)?;
    kernels::linear(&decoder.final_norm(&last)?, &model.number_rows, None)
}
