//! The operands of the matrix product: a right-hand side packed into panels, a left-hand side as it
//! lies in memory.

use rayon::prelude::*;
use std::borrow::Cow;

/// A right-hand side `[k, n]` as panels of 16 or 32 columns, zero-padded: `[panel][k][nr]`.
pub(in crate::kernels) struct Panels<'a> {
    data: Cow<'a, [f32]>,
    k: usize,
    n: usize,
    nr: usize,
}

impl<'a> Panels<'a> {
    /// Fills each panel by `fill(panel, first column, columns)`.
    fn build(k: usize, n: usize, fill: impl Fn(&mut [f32], usize, usize) + Sync) -> Self {
        let nr = panel_width(n);
        let mut data = vec![0f32; n.div_ceil(nr) * nr * k];
        let fill = |(p, panel): (usize, &mut [f32])| fill(panel, p * nr, nr.min(n - p * nr));
        if k > 0 && data.len() < SERIAL_ELEMENTS {
            data.chunks_exact_mut(nr * k).enumerate().for_each(fill);
        } else if k > 0 {
            data.par_chunks_exact_mut(nr * k).enumerate().for_each(fill);
        }
        Panels { data: Cow::Owned(data), k, n, nr }
    }

    /// Packs `b`, whose rows of `n` start every `stride` elements. What is a panel already is not
    /// copied.
    pub(in crate::kernels) fn from_rows(b: &'a [f32], stride: usize, k: usize, n: usize) -> Self {
        let nr = panel_width(n);
        if n == nr && stride == n {
            return Panels { data: Cow::Borrowed(&b[..k * n]), k, n, nr };
        }
        Panels::build(k, n, |panel, first, cols| {
            for (i, row) in panel.chunks_exact_mut(nr).enumerate() {
                let from = i * stride + first;
                row[..cols].copy_from_slice(&b[from..from + cols]);
            }
        })
    }

    /// Packs the transpose of `b`, whose `n` rows of `k` start every `stride` elements.
    pub(in crate::kernels) fn from_columns(b: &[f32], stride: usize, k: usize, n: usize) -> Self {
        let nr = panel_width(n);
        Panels::build(k, n, |panel, first, cols| {
            for (block, rows) in panel.chunks_mut(nr * BLOCK_ROWS).enumerate() {
                for c in 0..cols {
                    let from = (first + c) * stride + block * BLOCK_ROWS;
                    let column = &b[from..from + rows.len() / nr];
                    for (row, value) in rows.chunks_exact_mut(nr).zip(column) {
                        row[c] = *value;
                    }
                }
            }
        })
    }

    /// Panels that borrow nothing.
    pub(in crate::kernels) fn into_owned(self) -> Panels<'static> {
        Panels { data: Cow::Owned(self.data.into_owned()), k: self.k, n: self.n, nr: self.nr }
    }

    pub(in crate::kernels) fn view(&self) -> PanelsView<'_> {
        let Panels { data, k, n, nr } = self;
        PanelsView { data, jump: k * nr, k: *k, n: *n, nr: *nr }
    }
}

/// Columns of each panel of a matrix with `n` columns.
fn panel_width(n: usize) -> usize {
    if n <= 16 { 16 } else { 32 }
}

/// Elements below which one thread packs alone.
const SERIAL_ELEMENTS: usize = 1 << 17;
/// Rows written together when a transpose is packed: their panel stays in the first-level cache.
const BLOCK_ROWS: usize = 32;

/// Panels, or the first columns and rows of them.
#[derive(Clone, Copy)]
pub(in crate::kernels) struct PanelsView<'a> {
    pub(in crate::kernels) data: &'a [f32],
    /// Elements from one panel to the next.
    pub(in crate::kernels) jump: usize,
    pub(in crate::kernels) k: usize,
    pub(in crate::kernels) n: usize,
    pub(in crate::kernels) nr: usize,
}

impl PanelsView<'_> {
    /// Only the first `n` columns.
    pub(in crate::kernels) fn columns(self, n: usize) -> Self {
        PanelsView { n: n.min(self.n), ..self }
    }

    /// Only the first `k` rows.
    pub(in crate::kernels) fn rows(self, k: usize) -> Self {
        PanelsView { k: k.min(self.k), ..self }
    }

    /// Without the first `rows` rows.
    pub(in crate::kernels) fn skip(self, rows: usize) -> Self {
        PanelsView { data: &self.data[rows * self.nr..], k: self.k - rows, ..self }
    }
}

/// How the left-hand side's rows and inner dimension lie in memory. The inner dimension is
/// `segments` runs of `length`, which start every `jump` elements.
#[derive(Clone, Copy)]
pub(in crate::kernels) struct Lhs<'a> {
    pub(in crate::kernels) data: &'a [f32],
    /// Elements from one row to the next (or, transposed, from one inner index to the next).
    pub(in crate::kernels) stride: usize,
    pub(in crate::kernels) transposed: bool,
    pub(in crate::kernels) segments: usize,
    pub(in crate::kernels) length: usize,
    pub(in crate::kernels) jump: usize,
}

impl<'a> Lhs<'a> {
    /// Rows of `k` that start every `stride` elements.
    pub(in crate::kernels) fn rows(data: &'a [f32], stride: usize, k: usize) -> Self {
        Lhs { data, stride, transposed: false, segments: 1, length: k, jump: 0 }
    }

    /// The transpose of a matrix of `k` rows that start every `stride` elements.
    pub(in crate::kernels) fn columns(data: &'a [f32], stride: usize, k: usize) -> Self {
        Lhs { data, stride, transposed: true, segments: 1, length: k, jump: 0 }
    }

    /// Repeats the inner dimension `segments` times, each `jump` elements on.
    pub(in crate::kernels) fn segments(self, segments: usize, jump: usize) -> Self {
        Lhs { segments, jump, ..self }
    }

    /// One past the largest index read for `m` rows.
    pub(in crate::kernels) fn end(&self, m: usize) -> usize {
        let inner = (self.segments - 1) * self.jump;
        let (m, length) = (m - 1, self.length - 1);
        let run = if self.transposed { length * self.stride + m } else { m * self.stride + length };
        inner + run + 1
    }
}
