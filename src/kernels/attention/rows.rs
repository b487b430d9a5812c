//! The row-wise parts of attention: softmax, its backward pass, and own keys that are few.

use crate::kernels::isa::level::per_level;
use crate::kernels::simd::math::{dot, exp, madd};

per_level!(
    /// Each row of `scores` (rows every `stride`, `width` long) becomes `e^(s - max)` over its first
    /// `seen` elements and 0 beyond; gives the row's maximum and sum.
    fn softmax(scores: &mut [f32], stride: usize, width: usize, seen: &[usize], maxima: &mut [f32], sums: &mut [f32]) = softmax_body
);

#[inline(always)]
fn softmax_body<const LANES: usize>(
    scores: &mut [f32],
    stride: usize,
    width: usize,
    seen: &[usize],
    maxima: &mut [f32],
    sums: &mut [f32],
) {
    let rows = scores.chunks_mut(stride).zip(seen).zip(maxima.iter_mut().zip(sums));
    for ((row, &seen), (max, sum)) in rows {
        let (row, rest) = row[..width].split_at_mut(seen);
        let mut lanes = [f32::NEG_INFINITY; 16];
        let mut chunks = row.chunks_exact(16);
        for chunk in &mut chunks {
            for (l, &s) in lanes.iter_mut().zip(chunk) {
                *l = if s > *l { s } else { *l };
            }
        }
        for (l, &s) in lanes.iter_mut().zip(chunks.remainder()) {
            *l = if s > *l { s } else { *l };
        }
        *max = lanes.iter().fold(f32::NEG_INFINITY, |a, &b| if b > a { b } else { a });
        let mut lanes = [0f32; 16];
        let mut chunks = row.chunks_exact_mut(16);
        for chunk in &mut chunks {
            for (l, s) in lanes.iter_mut().zip(chunk) {
                *s = exp::<LANES>(*s - *max);
                *l += *s;
            }
        }
        for (l, s) in lanes.iter_mut().zip(chunks.into_remainder()) {
            *s = exp::<LANES>(*s - *max);
            *l += *s;
        }
        *sum = lanes.iter().sum();
        rest.fill(0.0);
    }
}

per_level!(
    /// Scores become probabilities `e^(s - lse)`, and `grads` (of the probabilities) gradients of the
    /// scores, `p (g - dot)`; both 0 beyond `seen`.
    fn softmax_grad(scores: &mut [f32], grads: &mut [f32], stride: usize, width: usize, seen: &[usize], lse: &[f32], dots: &[f32]) = softmax_grad_body
);

#[inline(always)]
fn softmax_grad_body<const LANES: usize>(
    scores: &mut [f32],
    grads: &mut [f32],
    stride: usize,
    width: usize,
    seen: &[usize],
    lse: &[f32],
    dots: &[f32],
) {
    let rows = scores.chunks_mut(stride).zip(grads.chunks_mut(stride));
    for ((row, grad), ((&seen, &lse), &dot)) in rows.zip(seen.iter().zip(lse).zip(dots)) {
        let (row, row_rest) = row[..width].split_at_mut(seen);
        let (grad, grad_rest) = grad[..width].split_at_mut(seen);
        for (s, g) in row.iter_mut().zip(grad) {
            *s = exp::<LANES>(*s - lse);
            *g = *s * (*g - dot);
        }
        row_rest.fill(0.0);
        grad_rest.fill(0.0);
    }
}

#[inline(always)]
fn axpy<const LANES: usize>(y: &mut [f32], a: f32, x: &[f32]) {
    for (y, &x) in y.iter_mut().zip(x) {
        *y = madd::<LANES>(a, x, *y);
    }
}

/// Where the own keys of a row lie.
#[derive(Clone, Copy)]
pub(in crate::kernels) struct Rows<'a> {
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

impl Rows<'_> {
    #[inline(always)]
    fn row<'b>(&self, data: &'b [f32], row: usize) -> &'b [f32] {
        let from = row * self.stride + self.column;
        &data[from..from + self.head_dim]
    }
}

per_level!(
    /// `scores[r][c] = left[r] . right[first[r] + c]`; the scores' rows start every `stride`.
    fn row_dots(scores: &mut [f32], stride: usize, left: &[f32], right: &[f32], rows: Rows<'_>) = row_dots_body
);

#[inline(always)]
fn row_dots_body<const LANES: usize>(
    scores: &mut [f32],
    stride: usize,
    left: &[f32],
    right: &[f32],
    rows: Rows<'_>,
) {
    for (r, left) in left.chunks_exact(rows.head_dim).enumerate() {
        for c in 0..rows.seen[r] {
            scores[r * stride + c] = dot::<LANES>(left, rows.row(right, rows.first[r] + c));
        }
    }
}

per_level!(
    /// `out[r] += sum_c weights[r][c] * right[first[r] + c]`.
    fn row_sums(out: &mut [f32], weights: &[f32], stride: usize, right: &[f32], rows: Rows<'_>) = row_sums_body
);

#[inline(always)]
fn row_sums_body<const LANES: usize>(
    out: &mut [f32],
    weights: &[f32],
    stride: usize,
    right: &[f32],
    rows: Rows<'_>,
) {
    for (r, out) in out.chunks_exact_mut(rows.head_dim).enumerate() {
        for c in 0..rows.seen[r] {
            axpy::<LANES>(out, weights[r * stride + c], rows.row(right, rows.first[r] + c));
        }
    }
}

per_level!(
    /// `out[first[r] + c - base] += weights[r][c] * left[r]`, `out` being rows of `head_dim`.
    fn row_scatter(out: &mut [f32], base: usize, weights: &[f32], stride: usize, left: &[f32], rows: Rows<'_>) = row_scatter_body
);

#[inline(always)]
fn row_scatter_body<const LANES: usize>(
    out: &mut [f32],
    base: usize,
    weights: &[f32],
    stride: usize,
    left: &[f32],
    rows: Rows<'_>,
) {
    let hd = rows.head_dim;
    for (r, left) in left.chunks_exact(hd).enumerate() {
        for c in 0..rows.seen[r] {
            let from = (rows.first[r] + c - base) * hd;
            axpy::<LANES>(&mut out[from..from + hd], weights[r * stride + c], left);
        }
    }
}

per_level!(
    /// Dot products of the rows of two matrices.
    fn pair_dots(out: &mut [f32], a: &[f32], b: &[f32], width: usize) = pair_dots_body
);

#[inline(always)]
fn pair_dots_body<const LANES: usize>(out: &mut [f32], a: &[f32], b: &[f32], width: usize) {
    for ((o, a), b) in out.iter_mut().zip(a.chunks_exact(width)).zip(b.chunks_exact(width)) {
        *o = dot::<LANES>(a, b);
    }
}
