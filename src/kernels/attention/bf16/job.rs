//! What a kernel is given: some query rows, and the keys that they see.

use super::packed_keys::PackedKeys;

/// Key sets that one row sees, at most: shared ones and its item's own.
pub(super) const MAX_KEY_PARTS: usize = 2;
/// Scores of own keys that come ready with each row, at most.
pub(super) const MAX_READY_SCORES: usize = 16;

/// Keys that some rows see.
#[derive(Clone, Copy)]
pub(super) struct KeyPart<'a> {
    pub(super) keys: &'a PackedKeys,
    /// How many of them each row sees.
    pub(super) seen: &'a [usize],
}

/// Query rows that are worked on together.
pub(super) struct QueryRows<'a> {
    pub(super) head_dim: usize,
    /// `[rows, head_dim]`, times log2(e) / sqrt(head_dim): the scores are exponents of 2.
    pub(super) q: &'a [f32],
    /// At most [`MAX_KEY_PARTS`].
    pub(super) parts: &'a [KeyPart<'a>],
    /// Scores of further keys, `[rows, MAX_READY_SCORES]`, minus infinity where there is none, or empty. They become the weights of
    /// these keys' values, which the caller adds.
    pub(super) ready: &'a mut [f32],
    /// `[rows, head_dim]`: receives the weighted sums of the parts' values.
    pub(super) sums: &'a mut [f32],
    /// Receives each row's sum of weights.
    pub(super) totals: &'a mut [f32],
}

/// A kernel's buffer, kept between calls.
#[derive(Default)]
pub(super) struct Workspace {
    pub(super) words: Vec<u32>,
}

/// What is compiled for a kernel's instruction set.
pub(super) trait CompiledAttention: Send + Sync {
    /// The attention of some rows, each of which depends on that row, its keys and their number only.
    fn run(&self, rows: QueryRows<'_>, workspace: &mut Workspace);
}
