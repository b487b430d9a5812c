//! The operation: tiles of query rows against packed keys, forward and backward.

use super::tile::{BackwardInputs, PackedSet, TileBuffers, TileWork};
use crate::kernels::attention::inputs::Inputs;
use crate::kernels::attention::layout::AttentionLayout;
use crate::kernels::attention::plan::Plan;
use crate::kernels::exec::{output, read2, read3, slice, tensor};
use crate::kernels::gemm::f32::Panels;
use crate::kernels::isa::Level;
use candle_core::{CpuStorage, CustomOp3, Layout, Shape, Tensor};
use rayon::prelude::*;
use std::sync::OnceLock;

pub(in crate::kernels::attention) struct F32Attention {
    layout: AttentionLayout,
    plan: Plan,
    /// The extra pair that shared keys and values come from.
    shared: Option<(Tensor, Tensor)>,
    /// Log-sum-exp of each row's scores, `[nq, heads]`, from the forward pass for the backward.
    lse: OnceLock<Vec<f32>>,
}

impl F32Attention {
    pub(in crate::kernels::attention) fn new(
        layout: AttentionLayout,
        shared: Option<(Tensor, Tensor)>,
    ) -> Self {
        let plan = Plan::new(&layout, shared.is_some());
        F32Attention { layout, plan, shared, lse: OnceLock::new() }
    }

    /// Runs `f` on the data, with the extra pair if there is one.
    fn with_extra<R>(
        &self,
        [q, k, v]: [&[f32]; 3],
        f: impl FnOnce(Inputs<'_>) -> candle_core::Result<R>,
    ) -> candle_core::Result<R> {
        match &self.shared {
            None => f(Inputs { q, k, v, extra: None }),
            Some((sk, sv)) => read2(sk, sv, |sk, sv| f(Inputs { q, k, v, extra: Some((sk, sv)) })),
        }
    }

    /// Packs every key set for every head: `[set * kv_heads + head]`.
    fn pack_key_sets<'b>(&self, data: Inputs<'b>, backward: bool) -> Vec<PackedSet<'b>> {
        let AttentionLayout { kv_heads, head_dim: hd, .. } = self.layout;
        let width = kv_heads * hd;
        let one = |i: usize| {
            let set = &self.plan.sets[i / kv_heads];
            let (k, v) = data.keys_and_values(set, width, i % kv_heads * hd);
            let n = set.rows.len();
            PackedSet {
                keys: backward.then(|| Panels::from_rows(k, width, n, hd)),
                keys_t: Panels::from_columns(k, width, hd, n),
                values: Panels::from_rows(v, width, n, hd),
                values_t: backward.then(|| Panels::from_columns(v, width, hd, n)),
            }
        };
        (0..self.plan.sets.len() * kv_heads).into_par_iter().map(one).collect()
    }

    /// The work of one tile for one key head.
    fn work<'b>(
        &'b self,
        (level, data): (Level, Inputs<'b>),
        packed: &'b [PackedSet<'b>],
        tile: usize,
        head: usize,
    ) -> TileWork<'b> {
        TileWork { layout: &self.layout, plan: &self.plan, level, data, packed, tile, head }
    }

    /// Output `[nq, heads * head_dim]` and log-sum-exp `[nq, heads]`.
    fn forward(&self, data: Inputs<'_>) -> (Vec<f32>, Vec<f32>) {
        let AttentionLayout { heads, kv_heads, head_dim, .. } = self.layout;
        let packed = self.pack_key_sets(data, false);
        let mut out = vec![0f32; data.q.len()];
        let mut lse = vec![0f32; data.q.len() / head_dim];
        let level = Level::current();
        let (outs, lses) = (self.plan.split(&mut out, heads * head_dim), self.plan.split(&mut lse, heads));
        outs.into_par_iter().zip(lses).enumerate().for_each_init(
            TileBuffers::default,
            |scratch, (tile, (out, lse))| {
                for head in 0..kv_heads {
                    let work = self.work((level, data), &packed, tile, head);
                    if head == 0 {
                        work.note_visible_keys(scratch);
                    }
                    work.forward(scratch, out, lse);
                }
            },
        );
        (out, lse)
    }

    /// Gradients of q, k and v. One task per key head and span of keys: each adds up its own.
    fn backward(&self, data: Inputs<'_>, given: BackwardInputs<'_>) -> [Vec<f32>; 3] {
        let AttentionLayout { heads, kv_heads, head_dim: hd, .. } = self.layout;
        let part = heads / kv_heads * hd;
        let (packed, level, spans) = (self.pack_key_sets(data, true), Level::current(), self.plan.spans());
        let nq = data.q.len() / (heads * hd);
        let nk = data.k.len() / (kv_heads * hd);
        let (mut dq, mut dk, mut dv) =
            (vec![0f32; data.q.len()], vec![0f32; data.k.len()], vec![0f32; data.v.len()]);
        let mut tasks = Vec::new();
        let by_head = dq
            .chunks_mut((nq * part).max(1))
            .zip(dk.chunks_mut((nk * hd).max(1)).zip(dv.chunks_mut((nk * hd).max(1))));
        for (head, (dq, (mut dk, mut dv))) in by_head.enumerate() {
            let mut dq: Vec<_> = self.plan.split(dq, part).into_iter().map(Some).collect();
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
        tasks.into_par_iter().for_each_init(TileBuffers::default, |scratch, task| {
            let (head, base, tiles, dk, dv) = task;
            for (tile, dq) in tiles {
                let work = self.work((level, data), &packed, tile, head);
                work.note_visible_keys(scratch);
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

impl CustomOp3 for F32Attention {
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
        // An operation runs forward once, so nothing is set yet.
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
                let given = BackwardInputs { out, grad, lse };
                self.with_extra([q, k, v], |data| Ok(self.backward(data, given)))
            })
        })?;
        let like = |data, t: &Tensor| Ok::<_, candle_core::Error>(Some(tensor(data, t.shape().clone())?));
        Ok((like(dq, q)?, like(dk, k)?, like(dv, v)?))
    }
}
