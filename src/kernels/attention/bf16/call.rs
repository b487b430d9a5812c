//! Attention without gradients, with operands in bf16: the plan of the f32 form, in smaller steps whose
//! scores stay in the first-level cache.

use super::job::{KeyPart, MAX_KEY_PARTS, MAX_READY_SCORES, QueryRows, Workspace};
use super::kernel::AttentionKernel;
use super::packed_keys::PackedKeys;
use crate::error::Result;
use crate::kernels::attention::inputs::Inputs;
use crate::kernels::attention::layout::AttentionLayout;
use crate::kernels::attention::own_keys::{OwnRows, row_dots, row_sums};
use crate::kernels::attention::plan::{KeySet, MAX_ROW_WISE_KEYS, OwnKeys, Plan};
use crate::kernels::attention::shared_keys::SharedKeys;
use crate::kernels::exec::{read2, read3, tensor};
use crate::kernels::isa::Level;
use crate::kernels::written::written;
use candle_core::Tensor;
use rayon::prelude::*;
use std::mem::MaybeUninit;
use std::ops::Range;

const _: () = assert!(MAX_ROW_WISE_KEYS <= MAX_READY_SCORES);

/// [`attention()`](crate::kernels::attention()) of f32 CPU tensors that fit the layout.
pub(in crate::kernels::attention) fn bf16_attention(
    kernel: &AttentionKernel,
    [q, k, v]: [&Tensor; 3],
    shared: Option<&SharedKeys>,
    layout: &AttentionLayout,
) -> Result<Tensor> {
    let plan = Plan::new(layout, shared.is_some());
    let run = |data: Inputs<'_>| {
        let level = Level::current();
        // The set of all shared keys, which is packed once for many calls.
        let whole = shared.and_then(|shared| {
            let rows = 0..shared.keys().dims().first().copied()?;
            let set = plan.sets.iter().position(|set| set.extra && set.rows == rows)?;
            let pack = || pack_key_sets(level, layout, &[&plan.sets[set]], data);
            Some((set, shared.packed(layout.kv_heads, pack)))
        });
        let kept = whole.as_ref().map_or(usize::MAX, |(set, _)| *set);
        let others: Vec<&KeySet> =
            plan.sets.iter().enumerate().filter(|(i, _)| *i != kept).map(|(_, set)| set).collect();
        let others = pack_key_sets(level, layout, &others, data);
        let mut others = others.chunks(layout.kv_heads);
        let packed = (0..plan.sets.len()).map(|set| match &whole {
            Some((kept, packed)) if *kept == set => packed,
            _ => others.next().unwrap_or_default(),
        });
        let packed: Vec<&[PackedKeys]> = packed.collect();
        let call = Call { kernel, layout, plan: &plan, data, packed: &packed, level };
        Ok(call.run())
    };
    let out = read3(q, k, v, |q, k, v| match shared {
        None => run(Inputs { q, k, v, extra: None }),
        Some(shared) => {
            let run = |sk: &[f32], sv: &[f32]| run(Inputs { q, k, v, extra: Some((sk, sv)) });
            read2(shared.keys(), shared.values(), run)
        }
    })?;
    Ok(tensor(out, q.shape().clone())?)
}

/// Packs key sets for every head: `[set * kv_heads + head]`.
fn pack_key_sets(
    level: Level,
    layout: &AttentionLayout,
    sets: &[&KeySet],
    data: Inputs<'_>,
) -> Vec<PackedKeys> {
    let AttentionLayout { kv_heads, head_dim, .. } = *layout;
    let width = kv_heads * head_dim;
    let one = |i: usize| {
        let set = sets[i / kv_heads];
        let (k, v) = data.keys_and_values(set, width, i % kv_heads * head_dim);
        PackedKeys::new(level, k, v, width, set.rows.len(), head_dim)
    };
    (0..sets.len() * kv_heads).into_par_iter().map(one).collect()
}

/// Buffers of one thread.
#[derive(Default)]
struct StepBuffers {
    workspace: Workspace,
    /// `[rows, head_dim]`.
    q: Vec<f32>,
    sums: Vec<f32>,
    /// `[rows, MAX_READY_SCORES]`.
    ready: Vec<f32>,
    /// Per row.
    totals: Vec<f32>,
    /// Keys that each row sees: shared ones, and own ones from `first` on.
    seen: [Vec<usize>; MAX_KEY_PARTS],
    first: Vec<usize>,
}

struct Call<'a> {
    kernel: &'a AttentionKernel,
    layout: &'a AttentionLayout,
    plan: &'a Plan,
    data: Inputs<'a>,
    /// Of each set, for every head.
    packed: &'a [&'a [PackedKeys]],
    level: Level,
}

impl Call<'_> {
    fn run(&self) -> Vec<f32> {
        let width = self.layout.heads * self.layout.head_dim;
        let fill = |out: &mut [MaybeUninit<f32>]| {
            if !self.plan.covers(self.data.q.len() / width) {
                out.fill(MaybeUninit::new(0.0));
            }
            self.fill(out, width);
        };
        // SAFETY: of the tiles' rows each head's elements are written; where the tiles, which do not overlap, are not all rows, the
        // zeros are.
        unsafe { written(self.data.q.len(), fill) }
    }

    /// Writes the tiles' rows.
    fn fill(&self, out: &mut [MaybeUninit<f32>], width: usize) {
        let tiles = self.plan.split(out, width).into_par_iter().enumerate();
        tiles.for_each_init(StepBuffers::default, |scratch, (tile, out)| {
            let rows = self.plan.tiles[tile].rows.len() * self.group();
            // Even steps, so that none is too low to keep the multipliers busy.
            let steps = rows.div_ceil(self.kernel.rows);
            for head in 0..self.layout.kv_heads {
                for step in 0..steps {
                    let rows = step * rows / steps..(step + 1) * rows / steps;
                    self.step(scratch, tile, head, rows, out);
                }
            }
        });
    }

    fn group(&self) -> usize {
        self.layout.heads / self.layout.kv_heads
    }

    /// Some rows of a tile for one key head; a row is a query row with one head of the group. `out` is the tile's.
    fn step(
        &self,
        s: &mut StepBuffers,
        tile: usize,
        head: usize,
        rows: Range<usize>,
        out: &mut [MaybeUninit<f32>],
    ) {
        let AttentionLayout { heads, kv_heads, head_dim: hd, .. } = *self.layout;
        let (group, plan) = (self.group(), &self.plan.tiles[tile]);
        // Where a row's elements lie among the tile's.
        let place = |r: usize| (r / group * heads + head * group + r % group) * hd;
        s.seen[0].clear();
        s.seen[0].resize(rows.len(), self.plan.blocks[tile].shared.len());
        self.plan.visible_own_keys(tile, group, rows.clone(), (&mut s.seen[1], &mut s.first));
        s.q.resize(rows.len() * hd, 0.0);
        s.sums.resize(rows.len() * hd, 0.0);
        s.totals.resize(rows.len(), 0.0);
        let scale = std::f32::consts::LOG2_E / (hd as f32).sqrt();
        let q = &self.data.q[plan.rows.start * heads * hd..];
        for (r, to) in rows.clone().zip(s.q.chunks_exact_mut(hd)) {
            for (to, from) in to.iter_mut().zip(&q[place(r)..]) {
                *to = from * scale;
            }
        }
        let set = |set: usize, seen| KeyPart { keys: &self.packed[set][head], seen };
        let shared = plan.shared.map(|shared| set(shared, &s.seen[0]));
        let own = match plan.own {
            OwnKeys::Set { set: own, .. } => Some(set(own, &s.seen[1])),
            OwnKeys::Rows => None,
        };
        let pair = shared.or(own).map(|part| [part, own.unwrap_or(part)]);
        let count = usize::from(shared.is_some()) + usize::from(own.is_some());
        let parts = pair.as_ref().map_or(&[][..], |pair| &pair[..count]);
        let few = OwnRows {
            first: &s.first,
            seen: &s.seen[1],
            stride: kv_heads * hd,
            column: head * hd,
            head_dim: hd,
        };
        s.ready.clear();
        if own.is_none() {
            s.ready.resize(rows.len() * MAX_READY_SCORES, f32::NEG_INFINITY);
            row_dots(self.level, &mut s.ready, MAX_READY_SCORES, &s.q, self.data.k, few);
        }
        let job = QueryRows {
            head_dim: hd,
            q: &s.q,
            parts,
            ready: &mut s.ready,
            sums: &mut s.sums,
            totals: &mut s.totals,
        };
        self.kernel.run(job, &mut s.workspace);
        if own.is_none() {
            row_sums(self.level, &mut s.sums, &s.ready, MAX_READY_SCORES, self.data.v, few);
        }
        for (r, (sums, total)) in rows.zip(s.sums.chunks_exact(hd).zip(&s.totals)) {
            let scale = 1.0 / total;
            for (to, sum) in out[place(r)..][..hd].iter_mut().zip(sums) {
                to.write(sum * scale);
            }
        }
    }
}
