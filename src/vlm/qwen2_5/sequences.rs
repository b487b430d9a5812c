//! Sequences that are prefilled together and decoded together, token by token.

use super::cache::KvCache;
use super::decoder::{Context, Decoder, Keep};
use super::interrupt::Interrupt;
use super::rope::Position;
use crate::error::{Error, Result};
use candle_core::Tensor;

/// Sequences of equal length, each of which sees one shared context and itself: answers in progress.
///
/// Sequences do not see each other: each is decoded as it would be alone.
pub struct Sequences<'a> {
    decoder: &'a Decoder,
    shared: Option<&'a KvCache>,
    own: KvCache,
    /// Text position of the token that follows each.
    next: Vec<f32>,
    last: Tensor,
}

impl<'a> Sequences<'a> {
    /// Prefills `embedded`, `[sequences * tokens, hidden]` with one position per row; `next` holds the text position that follows
    /// each sequence. `shared` is what all of them see before themselves.
    ///
    /// # Errors
    /// As [`Decoder::forward`].
    pub fn prefill(
        decoder: &'a Decoder,
        shared: Option<&'a KvCache>,
        embedded: &Tensor,
        positions: &[Position],
        next: Vec<f32>,
    ) -> Result<Self> {
        let mut own = decoder.cache(next.len());
        let last = pass(decoder, shared, &mut own, embedded, positions)?;
        Ok(Self { decoder, shared, own, next, last })
    }

    /// One sequence that continues where `shared` ends and has no token of its own yet: `last` is the normed hidden state of
    /// the last token there, `[1, hidden]`, and `next` the text position that follows.
    pub fn after(decoder: &'a Decoder, shared: &'a KvCache, last: Tensor, next: f32) -> Self {
        Self { decoder, shared: Some(shared), own: decoder.cache(1), next: vec![next], last }
    }

    /// Number of sequences.
    pub fn count(&self) -> usize {
        self.next.len()
    }

    /// Hidden state of each sequence's last token after the final norm, `[sequences, hidden]`: what the next token is read from.
    pub fn last(&self) -> &Tensor {
        &self.last
    }

    /// One decode step: feeds one more text token to each sequence.
    ///
    /// # Errors
    /// After an error in the middle of a pass the sequences cannot be decoded further.
    /// [`Error::Argument`] on an id outside the vocabulary, or if there is not one for each sequence.
    pub fn decode_step(&mut self, ids: &[u32]) -> Result<()> {
        if ids.len() != self.count() {
            let expected = format!("{}, one for each sequence", self.count());
            return Err(Error::argument("token ids", ids.len(), expected));
        }
        let positions: Vec<Position> = self.next.iter().map(|&p| Position::text(p)).collect();
        self.last = pass(self.decoder, self.shared, &mut self.own, &self.decoder.embed(ids)?, &positions)?;
        self.next.iter_mut().for_each(|p| *p += 1.0);
        Ok(())
    }

    /// Keeps these sequences only, in this order.
    ///
    /// # Errors
    /// [`Error::Argument`] if an index is out of range; nothing has changed then.
    pub fn keep(&mut self, indices: &[usize]) -> Result<()> {
        let own = self.own.select(indices)?;
        let rows: Vec<u32> = indices.iter().map(|&i| i as u32).collect();
        let last = self.last.index_select(&Tensor::from_vec(rows, indices.len(), self.last.device())?, 0)?;
        self.next = indices.iter().filter_map(|&i| self.next.get(i).copied()).collect();
        (self.own, self.last) = (own, last);
        Ok(())
    }
}

/// The normed hidden state of the last token of each sequence.
fn pass(
    decoder: &Decoder,
    shared: Option<&KvCache>,
    own: &mut KvCache,
    embedded: &Tensor,
    positions: &[Position],
) -> Result<Tensor> {
    let table = decoder.rope().table(positions, embedded.device())?;
    let context = Context::Cached { shared, own };
    decoder.final_norm(&decoder.forward_keeping(embedded, &table, context, Keep::Last, Interrupt::NEVER)?)
}
