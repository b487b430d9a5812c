//! The softmax of rows of scores, and its backward pass.

use crate::kernels::isa::{Isa, per_level};
use crate::kernels::simd::{dot, exp};

per_level!(
    /// Each row of `scores` (rows every `stride`, `width` long) becomes `e^(s - max)` over its first
    /// `seen` elements and 0 beyond; gives the row's maximum and sum.
    fn softmax_rows(scores: &mut [f32], stride: usize, width: usize, seen: &[usize], maxima: &mut [f32], sums: &mut [f32]) = softmax_rows_body
);

#[inline(always)]
fn softmax_rows_body<S: Isa>(
    isa: S,
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
                *s = exp(isa, *s - *max);
                *l += *s;
            }
        }
        for (l, s) in lanes.iter_mut().zip(chunks.into_remainder()) {
            *s = exp(isa, *s - *max);
            *l += *s;
        }
        *sum = lanes.iter().sum();
        rest.fill(0.0);
    }
}

per_level!(
    /// Scores become probabilities `e^(s - lse)`, and `grads` (of the probabilities) gradients of the
    /// scores, `p (g - dot)`; both 0 beyond `seen`.
    fn softmax_grad(scores: &mut [f32], grads: &mut [f32], stride: usize, width: usize, seen: &[usize], lse_and_dots: [&[f32]; 2]) = softmax_grad_body
);

#[inline(always)]
fn softmax_grad_body<S: Isa>(
    isa: S,
    scores: &mut [f32],
    grads: &mut [f32],
    stride: usize,
    width: usize,
    seen: &[usize],
    [lse, dots]: [&[f32]; 2],
) {
    let rows = scores.chunks_mut(stride).zip(grads.chunks_mut(stride));
    for ((row, grad), ((&seen, &lse), &dot)) in rows.zip(seen.iter().zip(lse).zip(dots)) {
        let (row, row_rest) = row[..width].split_at_mut(seen);
        let (grad, grad_rest) = grad[..width].split_at_mut(seen);
        for (s, g) in row.iter_mut().zip(grad) {
            *s = exp(isa, *s - lse);
            *g = *s * (*g - dot);
        }
        row_rest.fill(0.0);
        grad_rest.fill(0.0);
    }
}

per_level!(
    /// Dot products of the rows of two matrices.
    fn pair_dots(out: &mut [f32], a: &[f32], b: &[f32], width: usize) = pair_dots_body
);

#[inline(always)]
fn pair_dots_body<S: Isa>(isa: S, out: &mut [f32], a: &[f32], b: &[f32], width: usize) {
    for ((o, a), b) in out.iter_mut().zip(a.chunks_exact(width)).zip(b.chunks_exact(width)) {
        *o = dot(isa, a, b);
    }
}
