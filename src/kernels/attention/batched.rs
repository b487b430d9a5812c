//! Attention on a device without kernels of ours, where no gradient is wanted: few large products, no more scores at once than fit.

use super::composed::in_order;
use super::layout::{AttentionLayout, Block, Precision};
use super::rounded::{rounded_piece, takes};
use crate::error::Result;
use crate::kernels::fused;
use crate::kernels::kept::Kept;
use candle_core::{Device, Tensor};
use std::sync::Arc;

/// Scores that are held at once, at most: 512 MB, and as much again for their softmax.
const MAX_SCORES: usize = 1 << 27;
/// Elements of a mask that is kept, at most: 32 MB.
const MAX_KEPT: usize = 1 << 23;

/// [`attention()`](super::attention) of f32 tensors that fit the layout, `shared` being the extra pair.
pub(super) fn batched(
    q: &Tensor,
    k: &Tensor,
    v: &Tensor,
    shared: Option<(&Tensor, &Tensor)>,
    layout: &AttentionLayout,
) -> Result<Tensor> {
    let rounded = layout.precision == Precision::Bf16 && fused::rounds_attention(q.device());
    if let Some(sorted) = sorted(layout, q)? {
        let [q, k, v] = [q, k, v].map(|t| t.index_select(&sorted.order, 0));
        let (q, k, v) = (q?, k?, v?);
        let layout = AttentionLayout { blocks: sorted.blocks.clone(), ..layout.clone() };
        let out = in_pieces(&q, [&k, &v], [&k, &v], &layout, MAX_SCORES, rounded)?;
        return Ok(out.index_select(&sorted.places, 0)?);
    }
    in_pieces(q, [k, v], shared.unwrap_or((k, v)).into(), layout, MAX_SCORES, rounded)
}

/// Blocks in the order of their size.
struct Sorted {
    /// Rows in their order.
    order: Tensor,
    /// Where each row is then.
    places: Tensor,
    blocks: Vec<Block>,
}

/// [`sorted_by_size`] on the device of `q`; the last ones are kept.
fn sorted(layout: &AttentionLayout, q: &Tensor) -> Result<Option<Arc<Sorted>>> {
    /// Of what a picture's windows and a batch of several pictures have.
    static LAST: Kept<(Vec<Block>, usize), Option<Arc<Sorted>>> = Kept::new(4);
    if layout.blocks.len() < 2 {
        return Ok(None);
    }
    let rows = q.dim(0)?;
    LAST.get((layout.blocks.clone(), rows), q.device(), |_| {
        let Some((order, sorted)) = sorted_by_size(layout, rows) else { return Ok(None) };
        let mut places = vec![0u32; order.len()];
        order.iter().zip(0..).for_each(|(&row, place)| places[row as usize] = place);
        let [order, places] = [order, places].map(|rows| Tensor::new(rows, q.device()));
        Ok(Some(Arc::new(Sorted { order: order?, places: places?, blocks: sorted.blocks })))
    })
}

/// Where all of so many rows are in blocks that see themselves alone, and sizes alternate, as windows at the border of a picture do: the rows
/// in an order in which blocks of one size follow each other, and the layout of that order.
fn sorted_by_size(layout: &AttentionLayout, rows: usize) -> Option<(Vec<u32>, AttentionLayout)> {
    let alone = |b: &Block| b.shared.is_empty() && b.own_start == b.queries.start && b.q_period == b.k_period;
    let mut blocks: Vec<&Block> = layout.blocks.iter().filter(|b| !b.queries.is_empty()).collect();
    if !blocks.iter().all(|b| alone(b)) || blocks.iter().map(|b| b.queries.len()).sum::<usize>() != rows {
        return None;
    }
    blocks.sort_by_key(|b| (b.q_period, b.causal, b.queries.start));
    let kinds = 1 + blocks.windows(2).filter(|w| w[0].q_period != w[1].q_period).count();
    if joined(&layout.blocks).len() <= kinds + 1 {
        return None;
    }
    let mut order = Vec::with_capacity(rows);
    let moved = blocks.iter().map(|b| {
        let start = order.len();
        order.extend(b.queries.clone().map(|row| row as u32));
        Block { queries: start..order.len(), own_start: start, ..(*b).clone() }
    });
    let blocks = moved.collect();
    Some((order, AttentionLayout { blocks, ..layout.clone() }))
}

fn in_pieces(
    q: &Tensor,
    own: [&Tensor; 2],
    shared: [&Tensor; 2],
    layout: &AttentionLayout,
    most: usize,
    rounded: bool,
) -> Result<Tensor> {
    let joined = joined(&layout.blocks);
    let all = joined.iter().flat_map(|block| pieces(block, layout.heads, most));
    in_order(q, layout, all, |piece| {
        let attend = if rounded && takes(piece) { rounded_piece } else { one_piece };
        attend(q, own, shared, layout, piece)
    })
}

/// The blocks that have rows, in order; those that go on where the one before ends, with items of the same kind, as one: windows of a
/// picture.
fn joined(blocks: &[Block]) -> Vec<Block> {
    let mut sorted: Vec<&Block> = blocks.iter().filter(|b| !b.queries.is_empty()).collect();
    sorted.sort_by_key(|b| b.queries.start);
    let mut out: Vec<Block> = Vec::new();
    for block in sorted {
        match out.last_mut() {
            Some(last) if goes_on(last, block) => last.queries.end = block.queries.end,
            _ => out.push(block.clone()),
        }
    }
    out
}

fn goes_on(last: &Block, next: &Block) -> bool {
    let kind = |b: &Block| (b.shared.clone(), b.q_period, b.k_period, b.causal);
    kind(last) == kind(next)
        && next.queries.start == last.queries.end
        && next.own_start == last.own_start + last.items() * last.k_period
}

/// A block in parts of at most so many scores, or of one row.
fn pieces(block: &Block, heads: usize, most: usize) -> Vec<Block> {
    let rows = (most / (heads * (block.shared.len() + block.k_period)).max(1)).max(1);
    let (qp, kp, start) = (block.q_period, block.k_period, block.queries.start);
    let mut out = Vec::new();
    if rows >= qp {
        let (step, items) = (rows / qp, block.items());
        for first in (0..items).step_by(step) {
            let last = (first + step).min(items);
            let queries = start + first * qp..start + last * qp;
            out.push(Block { queries, own_start: block.own_start + first * kp, ..block.clone() });
        }
        return out;
    }
    for item in 0..block.items() {
        for first in (0..qp).step_by(rows) {
            let last = (first + rows).min(qp);
            let from = start + item * qp;
            out.push(Block {
                queries: from + first..from + last,
                own_start: block.own_start + item * kp,
                q_period: last - first,
                k_period: if block.causal { block.seen(last - 1) } else { kp },
                ..block.clone()
            });
        }
    }
    out
}

/// Scores against shared and own keys side by side in one tensor, one softmax.
fn one_piece(
    q: &Tensor,
    own: [&Tensor; 2],
    shared: [&Tensor; 2],
    layout: &AttentionLayout,
    block: &Block,
) -> Result<Tensor> {
    let AttentionLayout { heads, kv_heads, head_dim: hd, .. } = *layout;
    let (items, group, qp, kp) = (block.items(), heads / kv_heads, block.q_period, block.k_period);
    let (rows, n_shared) = (block.queries.len(), block.shared.len());
    let q = (q.narrow(0, block.queries.start, rows)? * (1.0 / (hd as f64).sqrt()))?
        .reshape((items, qp, kv_heads, group, hd))?
        .permute((2, 0, 3, 1, 4))?
        .contiguous()?;
    let heads_first = |t: &Tensor| {
        let own = t.narrow(0, block.own_start, items * kp)?;
        own.reshape((items, kp, kv_heads, hd))?.permute((2, 0, 1, 3))?.contiguous()
    };
    let by_item = (kv_heads, items, group * qp, ());
    let own_scores = |k: &Tensor| -> Result<Tensor> {
        let scores =
            q.reshape((kv_heads, items, group * qp, hd))?.matmul(&heads_first(k)?.transpose(2, 3)?)?;
        if !block.causal || qp == 1 {
            return Ok(scores); // All are seen.
        }
        let scores = scores.reshape((kv_heads * items * group, qp, kp))?;
        Ok(scores.broadcast_add(&mask(block, q.device())?)?)
    };
    let out = if n_shared == 0 {
        let scores = own_scores(own[0])?.reshape(by_item)?;
        candle_nn::ops::softmax_last_dim(&scores)?.matmul(&heads_first(own[1])?)?
    } else {
        let before = |t: &Tensor| -> candle_core::Result<Tensor> {
            let t = t.narrow(0, block.shared.start, n_shared)?.reshape((n_shared, kv_heads, hd))?;
            // Room for the own keys: their scores go there, and what their probabilities meet here adds nothing.
            t.permute((1, 0, 2))?.contiguous()?.pad_with_zeros(1, 0, kp)?.contiguous()
        };
        let all = items * group * qp;
        let scores = q.reshape((kv_heads, all, hd))?.matmul(&before(shared[0])?.transpose(1, 2)?)?;
        if kp > 0 {
            let own = own_scores(own[0])?.reshape((kv_heads, all, kp))?.contiguous()?;
            scores.slice_set(&own, 2, n_shared)?;
        }
        let p = candle_nn::ops::softmax_last_dim(&scores)?;
        let mut out = p.matmul(&before(shared[1])?)?;
        if kp > 0 {
            let p = p.narrow(2, n_shared, kp)?.contiguous()?.reshape(by_item)?;
            out = (out + p.matmul(&heads_first(own[1])?)?.reshape((kv_heads, all, hd))?)?;
        }
        out
    };
    let out = out.reshape((kv_heads, items, group, qp, hd))?.permute((1, 3, 0, 2, 4))?.contiguous()?;
    Ok(out.reshape((rows, heads * hd))?)
}

/// 0 where a row sees a key of its item, minus infinity where not: `[q_period, k_period]`. The last ones are kept: all layers of a model
/// ask for the same.
fn mask(block: &Block, device: &Device) -> Result<Tensor> {
    static LAST: Kept<(usize, usize), Tensor> = Kept::new(4);
    let (qp, kp) = (block.q_period, block.k_period);
    let make = || -> Result<Tensor> {
        // Places of keys and of the last key that a row sees; the mask is made of them where it lies.
        let keys = Tensor::arange(0f32, kp as f32, device)?.reshape((1, kp))?;
        let last = (Tensor::arange(0f32, qp as f32, device)? + (kp - qp) as f64)?.reshape((qp, 1))?;
        let unseen = keys.broadcast_gt(&last)?;
        let [hidden, seen] = [f32::NEG_INFINITY, 0.0].map(|value| Tensor::full(value, (qp, kp), device));
        Ok(unseen.where_cond(&hidden?, &seen?)?)
    };
    if qp * kp > MAX_KEPT { make() } else { LAST.get((qp, kp), device, |_| make()) }
}

#[cfg(test)]
mod tests {
    use super::super::composed::composed;
    use super::super::layout::Precision;
    use super::*;
    use crate::kernels::testing::{close, on_device, random};

    fn block(
        queries: std::ops::Range<usize>,
        own_start: usize,
        periods: (usize, usize),
        causal: bool,
    ) -> Block {
        let (q_period, k_period) = periods;
        Block { queries, shared: 0..0, own_start, q_period, k_period, causal }
    }

    fn layout(blocks: Vec<Block>) -> AttentionLayout {
        AttentionLayout { heads: 6, kv_heads: 2, head_dim: 8, blocks, precision: Precision::F32 }
    }

    /// Windows, a causal prompt, answers in progress after a prefix, one token after a prefix, a prefix alone; gaps before and after.
    fn cases() -> Vec<(AttentionLayout, bool)> {
        let prefix = |b: Block, shared| Block { shared, ..b };
        let windows = [0..16, 16..32, 32..40, 40..48, 48..50];
        let bordered = [0..8, 8..16, 16..20, 20..28, 28..36, 36..40, 40..44, 44..48, 48..50];
        let alone = |w: &std::ops::Range<usize>| block(w.clone(), w.start, (w.len(), w.len()), false);
        vec![
            (layout(bordered.iter().map(alone).collect()), false),
            (layout(windows.iter().map(alone).collect()), false),
            (layout(vec![block(3..33, 0, (30, 30), true)]), false),
            (layout(vec![prefix(block(0..36, 0, (3, 5), true), 2..9)]), true),
            (layout(vec![prefix(block(0..40, 0, (1, 1), true), 0..20)]), true),
            (layout(vec![prefix(block(1..9, 0, (1, 0), false), 0..20)]), true),
            (layout(vec![prefix(block(20..41, 20, (3, 3), true), 0..20)]), false),
            (layout(vec![]), false),
        ]
    }

    #[test]
    fn it_is_the_composed_form_in_pieces_of_any_size() {
        for (layout, pair) in cases() {
            let (q, k, v) = (random(&[50, 48], 1), random(&[70, 16], 2), random(&[70, 16], 3));
            let extra = pair.then(|| (random(&[20, 16], 4), random(&[20, 16], 5)));
            let expected = composed(&q, &k, &v, extra.as_ref().map(|(k, v)| (k, v)), &layout).unwrap();
            let [q, k, v] = on_device([&q, &k, &v]);
            let extra = extra.map(|(k, v)| on_device([&k, &v]));
            let extra = extra.as_ref().map(|[k, v]| (k, v));
            close(&batched(&q, &k, &v, extra, &layout).unwrap(), &expected, 1e-5);
            let shared = extra.unwrap_or((&k, &v)).into();
            for most in [1, 200, 700, 2000] {
                close(&in_pieces(&q, [&k, &v], shared, &layout, most, false).unwrap(), &expected, 1e-5);
            }
            // Rounded to bf16: eight bits of each probability and value.
            for most in [200, 2000] {
                let found = in_pieces(&q, [&k, &v], shared, &layout, most, true).unwrap();
                close(&found, &expected, 1e-2);
            }
        }
    }

    #[test]
    fn windows_of_one_size_are_one_block_and_pieces_hold_no_more_than_they_may() {
        let windows = [0..16, 16..32, 32..40, 40..48, 48..50];
        let blocks: Vec<Block> =
            windows.into_iter().map(|w| block(w.clone(), w.start, (w.len(), w.len()), false)).collect();
        let found: Vec<_> = joined(&blocks).iter().map(|b| (b.queries.clone(), b.q_period)).collect();
        assert_eq!(found, [(0..32, 16), (32..48, 8), (48..50, 2)]);
        let bordered =
            [8..12, 0..8, 12..20, 20..24].map(|w| block(w.clone(), w.start, (w.len(), w.len()), false));
        let (order, sorted) = sorted_by_size(&layout(bordered.to_vec()), 24).unwrap();
        assert_eq!(order, (8..12).chain(20..24).chain(0..8).chain(12..20).collect::<Vec<u32>>());
        assert_eq!(joined(&sorted.blocks).len(), 2);
        assert!(sorted_by_size(&layout(bordered.to_vec()), 25).is_none(), "a row of no block");
        // Keys that do not go on, and another prefix.
        assert_eq!(joined(&[block(0..4, 0, (4, 4), true), block(4..8, 5, (4, 4), true)]).len(), 2);
        let other = Block { shared: 0..3, ..block(4..8, 4, (4, 4), true) };
        assert_eq!(joined(&[block(0..4, 0, (4, 4), true), other]).len(), 2);

        let long = block(0..1000, 0, (1000, 1000), true);
        let parts = pieces(&long, 2, 100_000);
        assert_eq!((parts.len(), parts[3].queries.clone(), parts[3].k_period), (20, 150..200, 200));
        assert!(parts.iter().all(|p| p.queries.len() * p.k_period * 2 <= 100_000));
        let many = Block { shared: 0..90, ..block(0..1000, 0, (5, 10), true) };
        let parts = pieces(&many, 4, 10_000);
        assert_eq!((parts.len(), parts[1].queries.clone(), parts[1].own_start), (40, 25..50, 50));
    }
}
