//! Attention of one tile of query rows for one key head, forward and backward.

use super::softmax::{pair_dots, softmax_grad, softmax_rows};
use crate::kernels::attention::inputs::Inputs;
use crate::kernels::attention::layout::AttentionLayout;
use crate::kernels::attention::own_keys::{OwnRows, row_dots, row_scatter, row_sums};
use crate::kernels::attention::plan::{OwnKeys, Plan};
use crate::kernels::gemm::f32::{Init, Lhs, Panels, multiply};
use crate::kernels::isa::Level;

/// One key set of one head, packed as the products need it.
pub(super) struct PackedSet<'a> {
    /// `[n, head_dim]` and its transpose.
    pub(super) keys: Option<Panels<'a>>,
    pub(super) keys_t: Panels<'a>,
    pub(super) values: Panels<'a>,
    pub(super) values_t: Option<Panels<'a>>,
}

/// A tile's matrices, kept between tiles.
#[derive(Default)]
pub(super) struct TileBuffers {
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
pub(super) struct TileWork<'a> {
    pub(super) layout: &'a AttentionLayout,
    pub(super) plan: &'a Plan,
    pub(super) level: Level,
    pub(super) data: Inputs<'a>,
    pub(super) packed: &'a [PackedSet<'a>],
    pub(super) tile: usize,
    pub(super) head: usize,
}

impl<'a> TileWork<'a> {
    fn group(self) -> usize {
        self.layout.heads / self.layout.kv_heads
    }

    fn head_dim(self) -> usize {
        self.layout.head_dim
    }

    /// What scores are multiplied by.
    fn scale(self) -> f32 {
        1.0 / (self.head_dim() as f32).sqrt()
    }

    /// Rows of the tile's matrices: query rows times heads of the group.
    fn m(self) -> usize {
        self.plan.tiles[self.tile].rows.len() * self.group()
    }

    fn shared(self) -> usize {
        self.plan.blocks[self.tile].shared.len()
    }

    /// Keys that some row of the tile sees.
    fn width(self) -> usize {
        self.shared()
            + match self.plan.tiles[self.tile].own {
                OwnKeys::Set { seen, .. } => seen,
                OwnKeys::Rows => self.plan.blocks[self.tile].k_period,
            }
    }

    fn stride(self) -> usize {
        self.width().next_multiple_of(16)
    }

    fn set(self, set: usize) -> &'a PackedSet<'a> {
        &self.packed[set * self.layout.kv_heads + self.head]
    }

    /// Notes which keys each row of the tile sees.
    pub(super) fn note_visible_keys(self, buffers: &mut TileBuffers) {
        let TileBuffers { seen, own, first, .. } = buffers;
        self.plan.visible_own_keys(self.tile, self.group(), 0..self.m(), (own, first));
        seen.clear();
        seen.extend(own.iter().map(|own| self.shared() + own));
    }

    fn rows(self, first: &'a [usize], seen: &'a [usize]) -> OwnRows<'a> {
        let (head_dim, kv_heads) = (self.head_dim(), self.layout.kv_heads);
        let (stride, column) = (kv_heads * head_dim, self.head * head_dim);
        OwnRows { first, seen, stride, column, head_dim }
    }

    /// Copies the tile's rows of the head's group out of `[nq, heads * head_dim]`.
    fn gather(self, to: &mut [f32], from: &[f32], scale: f32) {
        let part = self.group() * self.head_dim();
        let width = self.layout.kv_heads * part;
        let rows = self.plan.tiles[self.tile].rows.clone();
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
        packed: impl Fn(&'a PackedSet<'a>) -> Option<&'a Panels<'a>>,
        right: &[f32],
        rows: OwnRows<'_>,
    ) {
        let (hd, m, stride, shared) = (self.head_dim(), self.m(), self.stride(), self.shared());
        let tile = &self.plan.tiles[self.tile];
        let lhs = Lhs::rows(left, hd, hd);
        if let Some(panels) = tile.shared.and_then(|set| packed(self.set(set))) {
            multiply(self.level, dst, stride, m, lhs, panels.view(), Init::Zero);
        }
        let dst = &mut dst[shared..];
        match tile.own {
            OwnKeys::Rows => row_dots(self.level, dst, stride, left, right, rows),
            OwnKeys::Set { set, seen } => {
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
        packed: impl Fn(&'a PackedSet<'a>) -> Option<&'a Panels<'a>>,
        right: &[f32],
        rows: OwnRows<'_>,
    ) {
        let (hd, m, stride, shared) = (self.head_dim(), self.m(), self.stride(), self.shared());
        let tile = &self.plan.tiles[self.tile];
        match tile.shared.and_then(|set| packed(self.set(set))) {
            Some(panels) => {
                let lhs = Lhs::rows(weights, stride, shared);
                multiply(self.level, dst, hd, m, lhs, panels.view(), Init::Zero);
            }
            None => dst.fill(0.0),
        }
        let weights = &weights[shared..];
        match tile.own {
            OwnKeys::Rows => row_sums(self.level, dst, weights, stride, right, rows),
            OwnKeys::Set { set, seen } => {
                if let Some(panels) = packed(self.set(set)) {
                    let (lhs, rhs) = (Lhs::rows(weights, stride, seen), panels.view().rows(seen));
                    multiply(self.level, dst, hd, m, lhs, rhs, Init::Add);
                }
            }
        }
    }

    /// `dst += weights^T left` for the tile's keys, `dst` being the key rows from `base` on. The
    /// extra pair's keys have no gradient.
    fn scatter(self, dst: &mut [f32], base: usize, weights: &[f32], left: &[f32], rows: OwnRows<'_>) {
        let (hd, m, stride, shared) = (self.head_dim(), self.m(), self.stride(), self.shared());
        let plan = self.plan;
        let tile = &plan.tiles[self.tile];
        let rhs = Panels::from_rows(left, hd, m, hd);
        if let Some(set) = tile.shared.map(|set| &plan.sets[set]).filter(|set| !set.extra) {
            let lhs = Lhs::columns(weights, stride, m);
            let dst = &mut dst[(set.rows.start - base) * hd..];
            multiply(self.level, dst, hd, shared, lhs, rhs.view(), Init::Add);
        }
        let weights = &weights[shared..];
        match tile.own {
            OwnKeys::Rows => row_scatter(self.level, dst, base, weights, stride, left, rows),
            OwnKeys::Set { set, seen } => {
                let lhs = Lhs::columns(weights, stride, m);
                let dst = &mut dst[(plan.sets[set].rows.start - base) * hd..];
                multiply(self.level, dst, hd, seen, lhs, rhs.view(), Init::Add);
            }
        }
    }

    /// The head's part of `out` and `lse`, which are the tile's rows of all heads.
    pub(super) fn forward(self, buffers: &mut TileBuffers, out: &mut [f32], lse: &mut [f32]) {
        let (hd, m, stride, group) = (self.head_dim(), self.m(), self.stride(), self.group());
        let (part, heads) = (group * hd, self.layout.heads);
        let rows = self.rows(&buffers.first, &buffers.own);
        let q = sized(&mut buffers.q, m * hd);
        let scores = sized(&mut buffers.scores, m * stride);
        let result = sized(&mut buffers.out, m * hd);
        let (maxima, totals) = (sized(&mut buffers.a, m), sized(&mut buffers.b, m));
        self.gather(q, self.data.q, self.scale());
        self.dots(scores, q, |p| Some(&p.keys_t), self.data.k, rows);
        softmax_rows(self.level, scores, stride, self.width(), &buffers.seen, maxima, totals);
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
    pub(super) fn backward(
        self,
        buffers: &mut TileBuffers,
        given: BackwardInputs<'_>,
        dq: &mut [f32],
        dk: &mut [f32],
        dv: &mut [f32],
        base: usize,
    ) {
        let (hd, m, stride, group) = (self.head_dim(), self.m(), self.stride(), self.group());
        let scale = self.scale();
        let rows = self.rows(&buffers.first, &buffers.own);
        let q = sized(&mut buffers.q, m * hd);
        let p = sized(&mut buffers.scores, m * stride);
        let ds = sized(&mut buffers.score_grads, m * stride);
        let (result, grad) = (sized(&mut buffers.out, m * hd), sized(&mut buffers.grad, m * hd));
        let (lse, pulls) = (sized(&mut buffers.a, m), sized(&mut buffers.b, m));
        self.gather(q, self.data.q, scale);
        self.gather(grad, given.grad, 1.0);
        self.gather(result, given.out, 1.0);
        pair_dots(self.level, pulls, result, grad, hd);
        let first = self.plan.tiles[self.tile].rows.start;
        for (r, lse) in lse.iter_mut().enumerate() {
            let h = self.head * group + r % group;
            *lse = given.lse[(first + r / group) * self.layout.heads + h];
        }
        self.dots(p, q, |p| Some(&p.keys_t), self.data.k, rows);
        self.dots(ds, grad, |p| p.values_t.as_ref(), self.data.v, rows);
        softmax_grad(self.level, p, ds, stride, self.width(), &buffers.seen, [lse, pulls]);
        self.sums(dq, ds, |p| p.keys.as_ref(), self.data.k, rows);
        dq.iter_mut().for_each(|d| *d *= scale);
        self.scatter(dk, base, ds, q, rows);
        self.scatter(dv, base, p, grad, rows);
    }
}

/// What the backward pass starts from: output, its gradient, log-sum-exp.
#[derive(Clone, Copy)]
pub(super) struct BackwardInputs<'a> {
    pub(super) out: &'a [f32],
    pub(super) grad: &'a [f32],
    pub(super) lse: &'a [f32],
}
