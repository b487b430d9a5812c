//! Attention without gradients, with operands in bf16: the plan of [`crate::kernels::attention::f32::op`], in smaller steps whose
//! scores stay in the first-level cache.

use crate::error::Result;
use crate::kernels::attention::bf16::kernel::{Attend, GIVEN, PARTS, PackedKeys, Part, Rows, Space};
use crate::kernels::attention::f32::tile::Data;
use crate::kernels::attention::layout::AttentionLayout;
use crate::kernels::attention::plan::{KeySet, Own, Plan, SHORT};
use crate::kernels::attention::rows::{self, row_dots, row_sums};
use crate::kernels::attention::shared_keys::SharedKeys;
use crate::kernels::exec::{read2, read3, tensor, written};
use crate::kernels::isa::level::Level;
use candle_core::Tensor;
use rayon::prelude::*;
use std::ops::Range;

const _: () = assert!(SHORT <= GIVEN);

/// [`super::attention()`] of f32 CPU tensors that fit the layout.
pub(in crate::kernels) fn attend(
    kernel: Attend,
    [q, k, v]: [&Tensor; 3],
    shared: Option<&SharedKeys>,
    layout: &AttentionLayout,
) -> Result<Tensor> {
    let plan = Plan::new(layout, shared.is_some());
    let run = |data: Data<'_>| {
        let level = Level::current();
        // The set of all shared keys, which is packed once for many calls.
        let whole = shared.and_then(|shared| {
            let rows = 0..shared.keys().dims().first().copied()?;
            let set = plan.sets.iter().position(|set| set.extra && set.rows == rows)?;
            let pack = || pack(level, layout, &[&plan.sets[set]], data);
            Some((set, shared.packed(layout.kv_heads, pack)))
        });
        let kept = whole.as_ref().map_or(usize::MAX, |(set, _)| *set);
        let others: Vec<&KeySet> =
            plan.sets.iter().enumerate().filter(|(i, _)| *i != kept).map(|(_, set)| set).collect();
        let others = pack(level, layout, &others, data);
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
        None => run(Data { q, k, v, extra: None }),
        Some(shared) => {
            let run = |sk: &[f32], sv: &[f32]| run(Data { q, k, v, extra: Some((sk, sv)) });
            read2(shared.keys(), shared.values(), run)
        }
    })?;
    Ok(tensor(out, q.shape().clone())?)
}

/// Packs key sets for every head: `[set * kv_heads + head]`.
fn pack(level: Level, layout: &AttentionLayout, sets: &[&KeySet], data: Data<'_>) -> Vec<PackedKeys> {
    let AttentionLayout { kv_heads, head_dim, .. } = *layout;
    let width = kv_heads * head_dim;
    let one = |i: usize| {
        let set = sets[i / kv_heads];
        let (k, v) = match data.extra {
            Some(pair) if set.extra => pair,
            _ => (data.k, data.v),
        };
        let from = set.rows.start * width + i % kv_heads * head_dim;
        PackedKeys::new(level, &k[from..], &v[from..], width, set.rows.len(), head_dim)
    };
    (0..sets.len() * kv_heads).into_par_iter().map(one).collect()
}

/// Buffers of one thread.
#[derive(Default)]
struct Scratch {
    space: Space,
    /// `[rows, head_dim]`.
    q: Vec<f32>,
    sums: Vec<f32>,
    /// `[rows, GIVEN]`.
    given: Vec<f32>,
    /// Per row.
    totals: Vec<f32>,
    seen: [Vec<usize>; PARTS],
    own: Vec<usize>,
    first: Vec<usize>,
}

struct Call<'a> {
    kernel: Attend,
    layout: &'a AttentionLayout,
    plan: &'a Plan,
    data: Data<'a>,
    /// Of each set, for every head.
    packed: &'a [&'a [PackedKeys]],
    level: Level,
}

impl Call<'_> {
    fn run(&self) -> Vec<f32> {
        let width = self.layout.heads * self.layout.head_dim;
        if self.plan.covers(self.data.q.len() / width) {
            // SAFETY: the tiles do not overlap, so they are all rows, of which each head's elements are written.
            return unsafe { written(self.data.q.len(), |out| self.fill(out, width)) };
        }
        let mut out = vec![0f32; self.data.q.len()];
        self.fill(&mut out, width);
        out
    }

    /// Writes the tiles' rows.
    fn fill(&self, out: &mut [f32], width: usize) {
        let tiles = self.plan.split(out, width).into_par_iter().enumerate();
        tiles.for_each_init(Scratch::default, |scratch, (tile, out)| {
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

    /// Some rows of a tile, which are its query rows times heads of the group, for one key head. `out` is the tile's.
    fn step(&self, s: &mut Scratch, tile: usize, head: usize, rows: Range<usize>, out: &mut [f32]) {
        let AttentionLayout { heads, kv_heads, head_dim: hd, .. } = *self.layout;
        let (group, plan) = (self.group(), &self.plan.tiles[tile]);
        // Of a row: where it lies among the tile's, in elements.
        let place = |r: usize| (r / group * heads + head * group + r % group) * hd;
        self.survey(s, tile, rows.clone());
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
        let set = |set: usize, seen| Part { keys: &self.packed[set][head], seen };
        let shared = plan.shared.map(|shared| set(shared, &s.seen[0]));
        let own = match plan.own {
            Own::Set { set: own, .. } => Some(set(own, &s.seen[1])),
            Own::Rows => None,
        };
        let pair = shared.or(own).map(|part| [part, own.unwrap_or(part)]);
        let count = usize::from(shared.is_some()) + usize::from(own.is_some());
        let parts = pair.as_ref().map_or(&[][..], |pair| &pair[..count]);
        let few = rows::Rows {
            first: &s.first,
            seen: &s.own,
            stride: kv_heads * hd,
            column: head * hd,
            head_dim: hd,
        };
        s.given.clear();
        if own.is_none() {
            s.given.resize(rows.len() * GIVEN, f32::NEG_INFINITY);
            row_dots(self.level, &mut s.given, GIVEN, &s.q, self.data.k, few);
        }
        let job = Rows {
            head_dim: hd,
            q: &s.q,
            parts,
            given: &mut s.given,
            sums: &mut s.sums,
            totals: &mut s.totals,
        };
        self.kernel.run(job, &mut s.space);
        if own.is_none() {
            row_sums(self.level, &mut s.sums, &s.given, GIVEN, self.data.v, few);
        }
        for (r, (sums, total)) in rows.zip(s.sums.chunks_exact(hd).zip(&s.totals)) {
            let scale = 1.0 / total;
            for (to, sum) in out[place(r)..][..hd].iter_mut().zip(sums) {
                *to = sum * scale;
            }
        }
    }

    /// Fills in what each row sees.
    fn survey(&self, s: &mut Scratch, tile: usize, rows: Range<usize>) {
        let (plan, block, group) = (&self.plan.tiles[tile], &self.plan.blocks[tile], self.group());
        s.seen[0].clear();
        s.seen[0].resize(rows.len(), block.shared.len());
        for column in [&mut s.seen[1], &mut s.own, &mut s.first] {
            column.clear();
        }
        for r in rows {
            let row = plan.rows.start + r / group - block.queries.start;
            let own = block.seen(row % block.q_period);
            s.seen[1].push(own);
            s.own.push(own);
            s.first.push(block.own_start + row / block.q_period * block.k_period);
        }
    }
}
