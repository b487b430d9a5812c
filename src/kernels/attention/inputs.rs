//! The tensors of a call, as slices.

use super::plan::KeySet;

/// Query rows, own key and value rows, and the keys and values of [`SharedKeys`](super::SharedKeys), which the code calls the extra pair.
#[derive(Clone, Copy)]
pub(super) struct Inputs<'a> {
    pub(super) q: &'a [f32],
    pub(super) k: &'a [f32],
    pub(super) v: &'a [f32],
    pub(super) extra: Option<(&'a [f32], &'a [f32])>,
}

impl<'a> Inputs<'a> {
    /// Keys and values from the first row of a set on, at one head's column; rows are `width` apart.
    pub(super) fn keys_and_values(
        &self,
        set: &KeySet,
        width: usize,
        column: usize,
    ) -> (&'a [f32], &'a [f32]) {
        let (k, v) = match self.extra {
            Some(pair) if set.extra => pair,
            _ => (self.k, self.v),
        };
        let from = set.rows.start * width + column;
        (&k[from..], &v[from..])
    }
}
