//! One row per token: the embedding, or the output head, with tokens that were put behind the vocabulary.

use crate::error::Result;
use crate::kernels::WeightFormat;
use crate::vlm::checkpoint::weights::Weights;
use crate::vlm::layers::matrix::Matrix;
use candle_core::Tensor;

/// Id of the first token behind the vocabulary. `config.json` allows no vocabulary above it, so that such ids are those of no token of any
/// tokenizer and of no row of any embedding, padding included, and are the same for checkpoints of all sizes.
pub const FIRST_ADDED: u32 = 1 << 24;

/// Rows by token id. Cheap to clone: a tied head shares its embedding.
#[derive(Clone)]
pub struct TokenTable {
    /// `[vocab, hidden]`
    vocabulary: Matrix,
    /// `[added, hidden]`: rows of the ids from [`FIRST_ADDED`] on.
    added: Option<Matrix>,
}

impl TokenTable {
    /// The rows of the vocabulary.
    pub(super) fn read(weights: &Weights, name: &str, shape: [usize; 2]) -> Result<Self> {
        Ok(Self { vocabulary: Matrix::read(weights, name, shape)?, added: None })
    }

    /// Reads the rows behind the vocabulary.
    pub(super) fn add(&mut self, weights: &Weights, name: &str, shape: [usize; 2]) -> Result<()> {
        self.added = Some(Matrix::read(weights, name, shape)?);
        Ok(())
    }

    /// The rows of the vocabulary alone.
    pub(super) fn vocabulary(&self) -> &Matrix {
        &self.vocabulary
    }

    /// Rows as f32, `[ids, hidden]`.
    ///
    /// # Errors
    /// [`Error::Argument`](crate::Error::Argument) on an id that has no row.
    pub fn rows(&self, ids: &[u32]) -> Result<Tensor> {
        let Some(added) = self.added.as_ref().filter(|_| ids.iter().any(|&id| id >= FIRST_ADDED)) else {
            return self.vocabulary.rows(ids);
        };
        let (mut words, mut behind) = (Vec::new(), Vec::new());
        for &id in ids {
            match id.checked_sub(FIRST_ADDED) {
                Some(row) => behind.push(row),
                None => words.push(id),
            }
        }
        let behind = added.rows(&behind)?;
        if words.is_empty() {
            return Ok(behind);
        }
        let both = Tensor::cat(&[&self.vocabulary.rows(&words)?, &behind], 0)?;
        let (mut word, mut other) = (0, words.len() as u32);
        let order: Vec<u32> =
            ids.iter().map(|&id| next(if id < FIRST_ADDED { &mut word } else { &mut other })).collect();
        if order.is_sorted() {
            return Ok(both);
        }
        Ok(both.index_select(&Tensor::from_vec(order, ids.len(), both.device())?, 0)?)
    }

    /// Rows as a matrix in a format; those behind the vocabulary are shared if they are asked for in their order.
    ///
    /// # Errors
    /// As [`TokenTable::rows`] and [`Matrix::from_tensor`].
    pub(super) fn matrix_of(&self, ids: &[u32], format: WeightFormat) -> Result<Matrix> {
        match &self.added {
            Some(added) if ids.iter().copied().eq((FIRST_ADDED..).take(added.dims().0)) => Ok(added.clone()),
            _ => Matrix::from_tensor(&self.rows(ids)?, format),
        }
    }
}

/// The counter's value, which goes on by one.
fn next(counter: &mut u32) -> u32 {
    *counter += 1;
    *counter - 1
}
