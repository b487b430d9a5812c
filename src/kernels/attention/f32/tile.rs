//! Attention of one tile of query rows for one key head, forward and backward.

use crate::kernels::attention::f32::op::Attention;
use crate::kernels::attention::plan::Own;
use crate::kernels::attention::rows::{
    Rows, pair_dots, row_dots, row_scatter, row_sums, softmax, softmax_grad,
};
use crate::kernels::gemm::f32::panels::{Lhs, Panels};
use crate::kernels::gemm::f32::product::{Init, multiply};
use crate::kernels::isa::level::Level;

/// Query, key and value rows, and the extra pair's.
#[derive(Clone, Copy)]
pub(in crate::kernels) struct Data<'a> {
    pub(in crate::kernels) q: &'a [f32],
    pub(in crate::kernels) k: &'a [f32],
    pub(in crate::kernels) v: &'a [f32],
    pub(in crate::kernels) extra: Option<(&'a [f32], &'a [f32])>,
}

/// One key set of one head, packed as the products need it.
pub(in crate::kernels) struct Packed<'a> {
    /// `[n, head_dim]` and its transpose.
    pub(in crate::kernels) keys: Option<Panels<'a>>,
    pub(in crate::kernels) keys_t: Panels<'a>,
    pub(in crate::kernels) values: Panels<'a>,
    pub(in crate::kernels) values_t: Option<Panels<'a>>,
}

/// A tile's matrices, kept between tiles.
#[derive(Default)]
pub(in crate::kernels) struct Scratch {
    /// `[rows * group, head_dim]`, times 1 / sqrt(head_dim).
    q: Vec<f32>,
    scores: Vec<f32>,
    out: Vec<f32>,
    grad: Vec<f32>,
    score_grads: Vec<f32>,
    /// Per row: keys seen in all, own keys seen, first own key.
    seen: Vec<usize>,
    own: Vec<usize>,
    first: Vec<usize>,
    /// Per row: largest score and sum, or log-sum-exp and output . gradient.
    a: Vec<f32>,
    b: Vec<f32>,
}

/// Makes a buffer hold `len` elements, whatever they are.
fn sized(buffer: &mut Vec<f32>, len: usize) -> &mut [f32] {
    if buffer.len() < len {
        buffer.resize(len, 0.0);
    }
    &mut buffer[..len]
}

/// The work of one tile for one key head.
#[derive(Clone, Copy)]
pub(in crate::kernels) struct Work<'a> {
    pub(in crate::kernels) op: &'a Attention,
    pub(in crate::kernels) level: Level,
    pub(in crate::kernels) data: Data<'a>,
    pub(in crate::kernels) packed: &'a [Packed<'a>],
    pub(in crate::kernels) tile: usize,
    pub(in crate::kernels) head: usize,
}

impl<'a> Work<'a> {
    fn group(self) -> usize {
        self.op.layout.heads / self.op.layout.kv_heads
    }

    fn head_dim(self) -> usize {
        self.op.layout.head_dim
    }

    /// Rows of the tile's matrices: query rows times heads of the group.
    fn m(self) -> usize {
        self.op.plan.tiles[self.tile].rows.len() * self.group()
    }

    fn shared(self) -> usize {
        self.op.plan.blocks[self.tile].shared.len()
    }

    /// Keys that some row of the tile sees.
    fn width(self) -> usize {
        self.shared()
            + match self.op.plan.tiles[self.tile].own {
                Own::Set { seen, .. } => seen,
                Own::Rows => self.op.plan.blocks[self.tile].k_period,
            }
    }

    fn stride(self) -> usize {
        self.width().next_multiple_of(16)
    }

    fn set(self, set: usize) -> &'a Packed<'a> {
        &self.packed[set * self.op.layout.kv_heads + self.head]
    }

    /// Fills in what each row of the tile sees.
    pub(in crate::kernels) fn survey(self, scratch: &mut Scratch) {
        let (plan, group, shared) = (&self.op.plan, self.group(), self.shared());
        let (tile, block) = (&plan.tiles[self.tile], &plan.blocks[self.tile]);
        scratch.seen.clear();
        scratch.own.clear();
        scratch.first.clear();
        for r in 0..self.m() {
            let row = tile.rows.start + r / group - block.queries.start;
            let own = block.seen(row % block.q_period);
            scratch.seen.push(shared + own);
            scratch.own.push(own);
            scratch.first.push(block.own_start + row / block.q_period * block.k_period);
        }
    }

    fn rows(self, first: &'a [usize], seen: &'a [usize]) -> Rows<'a> {
        let (head_dim, kv_heads) = (self.head_dim(), self.op.layout.kv_heads);
        let (stride, column) = (kv_heads * head_dim, self.head * head_dim);
        Rows { first, seen, stride, column, head_dim }
    }

    /// Copies the tile's rows of the head's group out of `[nq, heads * head_dim]`.
    fn gather(self, to: &mut [f32], from: &[f32], scale: f32) {
        let part = self.group() * self.head_dim();
        let width = self.op.layout.kv_heads * part;
        let rows = self.op.plan.tiles[self.tile].rows.clone();
        for (row, to) in rows.zip(to.chunks_exact_mut(part)) {
            let at = row * width + self.head * part;
            for (t, f) in to.iter_mut().zip(&from[at..at + part]) {
                *t = f * scale;
            }
        }
    }

    /// `dst = left right^T` over all keys of the tile, where right is the keys or the values, packed
    /// and as they are.
    fn dots(
        self,
        dst: &mut [f32],
        left: &[f32],
        packed: impl Fn(&'a Packed<'a>) -> Option<&'a Panels<'a>>,
        right: &[f32],
        rows: Rows<'_>,
    ) {
        let (hd, m, stride, shared) = (self.head_dim(), self.m(), self.stride(), self.shared());
        let tile = &self.op.plan.tiles[self.tile];
        let lhs = Lhs::rows(left, hd, hd);
        if let Some(panels) = tile.shared.and_then(|set| packed(self.set(set))) {
            multiply(self.level, dst, stride, m, lhs, panels.view(), Init::Zero);
        }
        let dst = &mut dst[shared..];
        match tile.own {
            Own::Rows => row_dots(self.level, dst, stride, left, right, rows),
            Own::Set { set, seen } => {
                if let Some(panels) = packed(self.set(set)) {
                    let rhs = panels.view().columns(seen);
                    multiply(self.level, dst, stride, m, lhs, rhs, Init::Zero);
                }
            }
        }
    }

    /// `dst = weights right` over all keys of the tile.
    fn sums(
        self,
        dst: &mut [f32],
        weights: &[f32],
        packed: impl Fn(&'a Packed<'a>) -> Option<&'a Panels<'a>>,
        right: &[f32],
        rows: Rows<'_>,
    ) {
        let (hd, m, stride, shared) = (self.head_dim(), self.m(), self.stride(), self.shared());
        let tile = &self.op.plan.tiles[self.tile];
        match tile.shared.and_then(|set| packed(self.set(set))) {
            Some(panels) => {
                let lhs = Lhs::rows(weights, stride, shared);
                multiply(self.level, dst, hd, m, lhs, panels.view(), Init::Zero);
            }
            None => dst.fill(0.0),
        }
        let weights = &weights[shared..];
        match tile.own {
            Own::Rows => row_sums(self.level, dst, weights, stride, right, rows),
            Own::Set { set, seen } => {
                if let Some(panels) = packed(self.set(set)) {
                    let (lhs, rhs) = (Lhs::rows(weights, stride, seen), panels.view().rows(seen));
                    multiply(self.level, dst, hd, m, lhs, rhs, Init::Add);
                }
            }
        }
    }

    /// `dst += weights^T left` for the tile's keys, `dst` being the key rows from `base` on. The
    /// extra pair's keys have no gradient.
    fn scatter(self, dst: &mut [f32], base: usize, weights: &[f32], left: &[f32], rows: Rows<'_>) {
        let (hd, m, stride, shared) = (self.head_dim(), self.m(), self.stride(), self.shared());
        let plan = &self.op.plan;
        let tile = &plan.tiles[self.tile];
        let rhs = Panels::from_rows(left, hd, m, hd);
        if let Some(set) = tile.shared.map(|set| &plan.sets[set]).filter(|set| !set.extra) {
            let lhs = Lhs::columns(weights, stride, m);
            let dst = &mut dst[(set.rows.start - base) * hd..];
            multiply(self.level, dst, hd, shared, lhs, rhs.view(), Init::Add);
        }
        let weights = &weights[shared..];
        match tile.own {
            Own::Rows => row_scatter(self.level, dst, base, weights, stride, left, rows),
            Own::Set { set, seen } => {
                let lhs = Lhs::columns(weights, stride, m);
                let dst = &mut dst[(plan.sets[set].rows.start - base) * hd..];
                multiply(self.level, dst, hd, seen, lhs, rhs.view(), Init::Add);
            }
        }
    }

    /// The head's part of `out` and `lse`, which are the tile's rows of all heads.
    pub(in crate::kernels) fn forward(self, scratch: &mut Scratch, out: &mut [f32], lse: &mut [f32]) {
        let (hd, m, stride, group) = (self.head_dim(), self.m(), self.stride(), self.group());
        let (part, heads) = (group * hd, self.op.layout.heads);
        let rows = self.rows(&scratch.first, &scratch.own);
        let q = sized(&mut scratch.q, m * hd);
        let scores = sized(&mut scratch.scores, m * stride);
        let result = sized(&mut scratch.out, m * hd);
        let (maxima, totals) = (sized(&mut scratch.a, m), sized(&mut scratch.b, m));
        self.gather(q, self.data.q, self.op.scale());
        self.dots(scores, q, |p| Some(&p.keys_t), self.data.k, rows);
        softmax(self.level, scores, stride, self.width(), &scratch.seen, maxima, totals);
        self.sums(result, scores, |p| Some(&p.values), self.data.v, rows);
        for r in 0..m {
            let (row, h) = (r / group, self.head * group + r % group);
            let to = row * heads * hd + self.head * part + r % group * hd;
            let scale = 1.0 / totals[r];
            for (o, x) in out[to..to + hd].iter_mut().zip(&result[r * hd..]) {
                *o = x * scale;
            }
            lse[row * heads + h] = maxima[r] + totals[r].ln();
        }
    }

    /// The tile's part of dq (`[rows, group * head_dim]`), and what it adds to dk and dv of the key
    /// rows from `base` on.
    pub(in crate::kernels) fn backward(
        self,
        scratch: &mut Scratch,
        given: Given<'_>,
        dq: &mut [f32],
        dk: &mut [f32],
        dv: &mut [f32],
        base: usize,
    ) {
        let (hd, m, stride, group) = (self.head_dim(), self.m(), self.stride(), self.group());
        let scale = self.op.scale();
        let rows = self.rows(&scratch.first, &scratch.own);
        let q = sized(&mut scratch.q, m * hd);
        let p = sized(&mut scratch.scores, m * stride);
        let ds = sized(&mut scratch.score_grads, m * stride);
        let (result, grad) = (sized(&mut scratch.out, m * hd), sized(&mut scratch.grad, m * hd));
        let (lse, pulls) = (sized(&mut scratch.a, m), sized(&mut scratch.b, m));
        self.gather(q, self.data.q, scale);
        self.gather(grad, given.grad, 1.0);
        self.gather(result, given.out, 1.0);
        pair_dots(self.level, pulls, result, grad, hd);
        let first = self.op.plan.tiles[self.tile].rows.start;
        for (r, lse) in lse.iter_mut().enumerate() {
            let h = self.head * group + r % group;
            *lse = given.lse[(first + r / group) * self.op.layout.heads + h];
        }
        self.dots(p, q, |p| Some(&p.keys_t), self.data.k, rows);
        self.dots(ds, grad, |p| p.values_t.as_ref(), self.data.v, rows);
        softmax_grad(self.level, p, ds, stride, self.width(), &scratch.seen, lse, pulls);
        self.sums(dq, ds, |p| p.keys.as_ref(), self.data.k, rows);
        dq.iter_mut().for_each(|d| *d *= scale);
        self.scatter(dk, base, ds, q, rows);
        self.scatter(dv, base, p, grad, rows);
    }
}

/// What the backward pass starts from: output, its gradient, log-sum-exp.
#[derive(Clone, Copy)]
pub(in crate::kernels) struct Given<'a> {
    pub(in crate::kernels) out: &'a [f32],
    pub(in crate::kernels) grad: &'a [f32],
    pub(in crate::kernels) lse: &'a [f32],
}
