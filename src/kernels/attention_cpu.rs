//! Attention on the CPU: tiles of query rows against packed keys, forward and backward.

use super::attention::AttentionLayout;
use super::attention_plan::{Own, Plan};
use super::attention_rows::{Rows, pair_dots, row_dots, row_scatter, row_sums, softmax, softmax_grad};
use super::exec::{output, read2, read3, slice, tensor};
use super::level::Level;
use super::panels::{Init, Lhs, Panels, multiply};
use candle_core::{CpuStorage, CustomOp3, Layout, Shape, Tensor};
use rayon::prelude::*;
use std::sync::OnceLock;

pub(super) struct Attention {
    layout: AttentionLayout,
    plan: Plan,
    /// The extra pair that shared keys and values come from.
    shared: Option<(Tensor, Tensor)>,
    /// Log-sum-exp of each row's scores, `[nq, heads]`, from the forward pass for the backward.
    lse: OnceLock<Vec<f32>>,
}

/// Query, key and value rows, and the extra pair's.
#[derive(Clone, Copy)]
struct Data<'a> {
    q: &'a [f32],
    k: &'a [f32],
    v: &'a [f32],
    extra: Option<(&'a [f32], &'a [f32])>,
}

/// One key set of one head, packed as the products need it.
struct Packed {
    /// `[n, head_dim]` and its transpose.
    keys: Option<Panels>,
    keys_t: Panels,
    values: Panels,
    values_t: Option<Panels>,
}

/// A tile's matrices, kept between tiles.
#[derive(Default)]
struct Scratch {
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
struct Work<'a> {
    op: &'a Attention,
    level: Level,
    data: Data<'a>,
    packed: &'a [Packed],
    tile: usize,
    head: usize,
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

    fn set(self, set: usize) -> &'a Packed {
        &self.packed[set * self.op.layout.kv_heads + self.head]
    }

    /// Fills in what each row of the tile sees.
    fn survey(self, scratch: &mut Scratch) {
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
        packed: impl Fn(&'a Packed) -> Option<&'a Panels>,
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
        packed: impl Fn(&'a Packed) -> Option<&'a Panels>,
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
    fn forward(self, scratch: &mut Scratch, out: &mut [f32], lse: &mut [f32]) {
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
    fn backward(
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
struct Given<'a> {
    out: &'a [f32],
    grad: &'a [f32],
    lse: &'a [f32],
}

impl Attention {
    pub(super) fn new(layout: AttentionLayout, shared: Option<(Tensor, Tensor)>) -> Self {
        let plan = Plan::new(&layout, shared.is_some());
        Attention { layout, plan, shared, lse: OnceLock::new() }
    }

    fn scale(&self) -> f32 {
        1.0 / (self.layout.head_dim as f32).sqrt()
    }

    /// Runs `f` on the data, with the extra pair if there is one.
    fn with_extra<R>(
        &self,
        [q, k, v]: [&[f32]; 3],
        f: impl FnOnce(Data<'_>) -> candle_core::Result<R>,
    ) -> candle_core::Result<R> {
        match &self.shared {
            None => f(Data { q, k, v, extra: None }),
            Some((sk, sv)) => read2(sk, sv, |sk, sv| f(Data { q, k, v, extra: Some((sk, sv)) })),
        }
    }

    /// Packs every key set for every head: `[set * kv_heads + head]`.
    fn pack(&self, data: Data<'_>, back: bool) -> Vec<Packed> {
        let AttentionLayout { kv_heads, head_dim: hd, .. } = self.layout;
        let width = kv_heads * hd;
        let one = |i: usize| {
            let set = &self.plan.sets[i / kv_heads];
            let (k, v) = match data.extra {
                Some(pair) if set.extra => pair,
                _ => (data.k, data.v),
            };
            let (from, n) = (set.rows.start * width + i % kv_heads * hd, set.rows.len());
            let (k, v) = (&k[from..], &v[from..]);
            Packed {
                keys: back.then(|| Panels::from_rows(k, width, n, hd)),
                keys_t: Panels::from_columns(k, width, hd, n),
                values: Panels::from_rows(v, width, n, hd),
                values_t: back.then(|| Panels::from_columns(v, width, hd, n)),
            }
        };
        (0..self.plan.sets.len() * kv_heads).into_par_iter().map(one).collect()
    }

    /// Splits a buffer of query rows of `width` into the tiles' rows.
    fn split<'b>(&self, mut data: &'b mut [f32], width: usize) -> Vec<&'b mut [f32]> {
        let (mut parts, mut at) = (Vec::with_capacity(self.plan.tiles.len()), 0);
        for tile in &self.plan.tiles {
            let (_, rest) = data.split_at_mut((tile.rows.start - at) * width);
            let (part, rest) = rest.split_at_mut(tile.rows.len() * width);
            parts.push(part);
            (data, at) = (rest, tile.rows.end);
        }
        parts
    }

    /// Output `[nq, heads * head_dim]` and log-sum-exp `[nq, heads]`.
    fn forward(&self, data: Data<'_>) -> (Vec<f32>, Vec<f32>) {
        let AttentionLayout { heads, kv_heads, head_dim, .. } = self.layout;
        let packed = self.pack(data, false);
        let mut out = vec![0f32; data.q.len()];
        let mut lse = vec![0f32; data.q.len() / head_dim];
        let level = Level::current();
        let (outs, lses) = (self.split(&mut out, heads * head_dim), self.split(&mut lse, heads));
        outs.into_par_iter().zip(lses).enumerate().for_each_init(
            Scratch::default,
            |scratch, (tile, (out, lse))| {
                for head in 0..kv_heads {
                    let work = Work { op: self, level, data, packed: &packed, tile, head };
                    if head == 0 {
                        work.survey(scratch);
                    }
                    work.forward(scratch, out, lse);
                }
            },
        );
        (out, lse)
    }

    /// Gradients of q, k and v. One task per key head and span of keys: each adds up its own.
    fn backward(&self, data: Data<'_>, given: Given<'_>) -> [Vec<f32>; 3] {
        let AttentionLayout { heads, kv_heads, head_dim: hd, .. } = self.layout;
        let part = heads / kv_heads * hd;
        let (packed, level, spans) = (self.pack(data, true), Level::current(), self.plan.spans());
        let nq = data.q.len() / (heads * hd);
        let nk = data.k.len() / (kv_heads * hd);
        let (mut dq, mut dk, mut dv) =
            (vec![0f32; data.q.len()], vec![0f32; data.k.len()], vec![0f32; data.v.len()]);
        let mut tasks = Vec::new();
        let by_head = dq
            .chunks_mut((nq * part).max(1))
            .zip(dk.chunks_mut((nk * hd).max(1)).zip(dv.chunks_mut((nk * hd).max(1))));
        for (head, (dq, (mut dk, mut dv))) in by_head.enumerate() {
            let mut dq: Vec<_> = self.split(dq, part).into_iter().map(Some).collect();
            let mut at = 0;
            for (span, tiles) in &spans {
                let skip = (span.start - at) * hd;
                let len = span.len() * hd;
                let (own_k, rest_k) = dk[skip..].split_at_mut(len);
                let (own_v, rest_v) = dv[skip..].split_at_mut(len);
                (dk, dv, at) = (rest_k, rest_v, span.end);
                let tiles: Vec<_> = tiles.iter().filter_map(|&t| Some((t, dq[t].take()?))).collect();
                tasks.push((head, span.start, tiles, own_k, own_v));
            }
        }
        tasks.into_par_iter().for_each_init(Scratch::default, |scratch, task| {
            let (head, base, tiles, dk, dv) = task;
            for (tile, dq) in tiles {
                let work = Work { op: self, level, data, packed: &packed, tile, head };
                work.survey(scratch);
                work.backward(scratch, given, dq, dk, dv, base);
            }
        });
        [rows_first(dq, nq, part), rows_first(dk, nk, hd), rows_first(dv, nk, hd)]
    }
}

/// `[heads, n, width]` to `[n, heads * width]`.
fn rows_first(data: Vec<f32>, n: usize, width: usize) -> Vec<f32> {
    const ROWS: usize = 64;
    let heads = data.len() / (n * width).max(1);
    if heads <= 1 {
        return data;
    }
    let mut out = vec![0f32; data.len()];
    out.par_chunks_mut(ROWS * heads * width).enumerate().for_each(|(i, out)| {
        for (r, out) in out.chunks_exact_mut(heads * width).enumerate() {
            for (h, out) in out.chunks_exact_mut(width).enumerate() {
                let from = (h * n + i * ROWS + r) * width;
                out.copy_from_slice(&data[from..from + width]);
            }
        }
    });
    out
}

impl CustomOp3 for Attention {
    fn name(&self) -> &'static str {
        "attention"
    }

    fn cpu_fwd(
        &self,
        s1: &CpuStorage,
        l1: &Layout,
        s2: &CpuStorage,
        l2: &Layout,
        s3: &CpuStorage,
        l3: &Layout,
    ) -> candle_core::Result<(CpuStorage, Shape)> {
        let qkv = [slice(s1, l1)?, slice(s2, l2)?, slice(s3, l3)?];
        let (out, lse) = self.with_extra(qkv, |data| Ok(self.forward(data)))?;
        // Set once: an operation runs forward once.
        let _ = self.lse.set(lse);
        Ok(output(out, l1.shape().clone()))
    }

    fn bwd(
        &self,
        q: &Tensor,
        k: &Tensor,
        v: &Tensor,
        res: &Tensor,
        grad: &Tensor,
    ) -> candle_core::Result<(Option<Tensor>, Option<Tensor>, Option<Tensor>)> {
        let Some(lse) = self.lse.get() else {
            return Err(candle_core::Error::Msg("attention: backward before forward".into()).bt());
        };
        let [dq, dk, dv] = read2(res, grad, |out, grad| {
            read3(q, k, v, |q, k, v| {
                let given = Given { out, grad, lse };
                self.with_extra([q, k, v], |data| Ok(self.backward(data, given)))
            })
        })?;
        let like = |data, t: &Tensor| Ok::<_, candle_core::Error>(Some(tensor(data, t.shape().clone())?));
        Ok((like(dq, q)?, like(dk, k)?, like(dv, v)?))
    }
}
