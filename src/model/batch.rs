//! Queries that are read together.

use super::marked::MarkedFrame;
use super::prefix::Prefix;
use super::sdim_model::SdimModel;
use crate::error::Result;
use crate::kernels::{self, BinStats, Middle};
use crate::query::Query;
use crate::query::prompt::{Glimpse, Tokens};
use crate::vlm::qwen2_5::rope::Position;
use crate::vlm::qwen2_5::sequences::Sequences;
use candle_core::{Device, Tensor};
use rayon::prelude::*;

/// Rows whose logits are made and read at a time on the CPU: what stays in the caches.
const LOGIT_ROWS: usize = 256;
/// Logits that are made at a time on another device, about.
const DEVICE_LOGITS: usize = 1 << 24;

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
    pub(super) fn open(
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
        let embedded = model.add_glimpses(embedded, &[(&prefix.view, &glimpses)])?;
        let next = suffixes.iter().map(|s| s.next_text(&prefix.space)).collect();
        let shared = Some(&prefix.cache);
        let sequences = Sequences::prefill(&model.vlm.decoder, shared, &embedded, &positions, next)?;
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
    pub(super) fn of_numbers<S: Send, T: Send>(
        &self,
        scratch: impl Fn() -> S + Sync,
        read: impl Fn(&mut S, &[f32]) -> T + Sync,
    ) -> Result<Vec<T>> {
        let mut out = Vec::with_capacity(self.sequences.count());
        for logits in self.number_logits() {
            let logits = logits?;
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

    /// Statistics of each item's distribution over the numbers as bins, found where the logits are: what comes off a device that is
    /// not the CPU is a few values of each item. `middle` and `tolerance` are those of [`kernels::bin_stats`].
    pub(super) fn of_bins(
        &self,
        middle: Middle,
        tolerance: impl Fn(f32) -> f32,
    ) -> Result<Vec<Option<BinStats>>> {
        let mut out = Vec::with_capacity(self.sequences.count());
        for logits in self.number_logits() {
            out.extend(kernels::bin_stats_of_rows(&logits?, middle, &tolerance)?);
        }
        Ok(out)
    }

    /// Logits of the numbers, `[some items, numbers]`, those of all items in turn.
    fn number_logits(&self) -> impl Iterator<Item = Result<Tensor>> + '_ {
        let (items, rows) = (self.sequences.count(), &self.model.number_rows);
        let step = if self.model.device.is_cpu() { LOGIT_ROWS } else { DEVICE_LOGITS / rows.dims().0.max(1) };
        let step = step.max(1);
        (0..items).step_by(step).map(move |first| {
            let some = self.sequences.last().narrow(0, first, step.min(items - first))?;
            rows.linear(&some, None)
        })
    }
}
