//! Products of query rows with own keys that are few and differ from row to row: one row after the other.

use crate::kernels::isa::{Isa, per_level};
use crate::kernels::simd::{dot, madd};

#[inline(always)]
fn axpy<S: Isa>(isa: S, y: &mut [f32], a: f32, x: &[f32]) {
    for (y, &x) in y.iter_mut().zip(x) {
        *y = madd(isa, a, x, *y);
    }
}

/// Where the own keys of some query rows lie.
#[derive(Clone, Copy)]
pub(in crate::kernels) struct OwnRows<'a> {
    /// First key row of each row's item.
    pub(in crate::kernels) first: &'a [usize],
    /// Own keys that each row sees.
    pub(in crate::kernels) seen: &'a [usize],
    /// Elements from one key row to the next, in memory.
    pub(in crate::kernels) stride: usize,
    /// Column of the head.
    pub(in crate::kernels) column: usize,
    pub(in crate::kernels) head_dim: usize,
}

impl OwnRows<'_> {
    #[inline(always)]
    fn row<'b>(&self, data: &'b [f32], row: usize) -> &'b [f32] {
        let from = row * self.stride + self.column;
        &data[from..from + self.head_dim]
    }
}

per_level!(
    /// `scores[r][c] = left[r] . right[first[r] + c]`; the scores' rows start every `stride`.
    fn row_dots(scores: &mut [f32], stride: usize, left: &[f32], right: &[f32], rows: OwnRows<'_>) = row_dots_body
);

#[inline(always)]
fn row_dots_body<S: Isa>(
    isa: S,
    scores: &mut [f32],
    stride: usize,
    left: &[f32],
    right: &[f32],
    rows: OwnRows<'_>,
) {
    for (r, left) in left.chunks_exact(rows.head_dim).enumerate() {
        for c in 0..rows.seen[r] {
            scores[r * stride + c] = dot(isa, left, rows.row(right, rows.first[r] + c));
        }
    }
}

per_level!(
    /// `out[r] += sum_c weights[r][c] * right[first[r] + c]`.
    fn row_sums(out: &mut [f32], weights: &[f32], stride: usize, right: &[f32], rows: OwnRows<'_>) = row_sums_body
);

#[inline(always)]
fn row_sums_body<S: Isa>(
    isa: S,
    out: &mut [f32],
    weights: &[f32],
    stride: usize,
    right: &[f32],
    rows: OwnRows<'_>,
) {
    for (r, out) in out.chunks_exact_mut(rows.head_dim).enumerate() {
        for c in 0..rows.seen[r] {
            axpy(isa, out, weights[r * stride + c], rows.row(right, rows.first[r] + c));
        }
    }
}

per_level!(
    /// `out[first[r] + c - base] += weights[r][c] * left[r]`, `out` being rows of `head_dim`.
    fn row_scatter(out: &mut [f32], base: usize, weights: &[f32], stride: usize, left: &[f32], rows: OwnRows<'_>) = row_scatter_body
);

#[inline(always)]
fn row_scatter_body<S: Isa>(
    isa: S,
    out: &mut [f32],
    base: usize,
    weights: &[f32],
    stride: usize,
    left: &[f32],
    rows: OwnRows<'_>,
) {
    let hd = rows.head_dim;
    for (r, left) in left.chunks_exact(hd).enumerate() {
        for c in 0..rows.seen[r] {
            let from = (rows.first[r] + c - base) * hd;
            axpy(isa, &mut out[from..from + hd], weights[r * stride + c], left);
        }
    }
}
