//! How attention's work is cut: tiles of query rows, sets of keys, spans that share no key.

use super::layout::{AttentionLayout, Block};
use std::collections::HashMap;
use std::ops::Range;

/// Items with at most this many own keys are worked on row by row beside the shared product.
pub(super) const MAX_ROW_WISE_KEYS: usize = 16;
/// Scores of a tile, about: they should stay in the second-level cache.
const TILE_SCORES: usize = 96 * 1024;

/// Keys that whole tiles see, so that they are packed once.
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
pub(super) struct KeySet {
    /// Rows of the extra pair rather than of k and v.
    pub(super) extra: bool,
    pub(super) rows: Range<usize>,
}

/// Consecutive query rows of one block, worked on together.
#[derive(Clone, Debug)]
pub(super) struct QueryTile {
    pub(super) rows: Range<usize>,
    /// Index of the shared key set, if the block has shared keys.
    pub(super) shared: Option<usize>,
    pub(super) own: OwnKeys,
}

/// The own keys of a tile.
#[derive(Clone, Debug)]
pub(super) enum OwnKeys {
    /// All rows are of one item: the key set's index, the keys that the tile's last row sees.
    Set { set: usize, seen: usize },
    /// Few keys each, of several items.
    Rows,
}

/// The plan of one call. Depends on the layout only.
pub(super) struct Plan {
    pub(super) sets: Vec<KeySet>,
    /// In order of their rows, which do not overlap.
    pub(super) tiles: Vec<QueryTile>,
    /// The block of each tile.
    pub(super) blocks: Vec<Block>,
}

impl Plan {
    pub(super) fn new(layout: &AttentionLayout, extra: bool) -> Plan {
        let mut blocks: Vec<Block> =
            layout.blocks.iter().filter(|b| !b.queries.is_empty()).cloned().collect();
        blocks.sort_by_key(|b| b.queries.start);
        let mut plan = Plan { sets: Vec::new(), tiles: Vec::new(), blocks: Vec::new() };
        let mut known = HashMap::new();
        for block in blocks {
            plan.cut(&block, layout.heads / layout.kv_heads, extra, &mut known);
        }
        plan
    }

    fn cut(&mut self, block: &Block, group: usize, extra: bool, known: &mut HashMap<KeySet, usize>) {
        let mut number = |set: KeySet| {
            *known.entry(set.clone()).or_insert_with(|| {
                self.sets.push(set);
                self.sets.len() - 1
            })
        };
        let shared = (!block.shared.is_empty()).then(|| number(KeySet { extra, rows: block.shared.clone() }));
        let height = tile_rows(block.shared.len() + block.k_period, group);
        let start = block.queries.start;
        let mut push = |rows: Range<usize>, own: OwnKeys| {
            self.tiles.push(QueryTile { rows, shared, own });
            self.blocks.push(block.clone());
        };
        if block.k_period <= MAX_ROW_WISE_KEYS {
            for first in (0..block.queries.len()).step_by(height) {
                let last = (first + height).min(block.queries.len());
                push(start + first..start + last, OwnKeys::Rows);
            }
            return;
        }
        for item in 0..block.items() {
            let keys = block.own_start + item * block.k_period;
            let set = number(KeySet { extra: false, rows: keys..keys + block.k_period });
            let start = start + item * block.q_period;
            for first in (0..block.q_period).step_by(height) {
                let last = (first + height).min(block.q_period);
                push(start + first..start + last, OwnKeys::Set { set, seen: block.seen(last - 1) });
            }
        }
    }

    /// Whether each of `rows` query rows is in a tile.
    pub(super) fn covers(&self, rows: usize) -> bool {
        self.tiles.iter().map(|tile| tile.rows.len()).sum::<usize>() == rows
    }

    /// Splits a buffer of query rows of `width` into the tiles' rows.
    pub(super) fn split<'b, T>(&self, mut data: &'b mut [T], width: usize) -> Vec<&'b mut [T]> {
        let (mut parts, mut at) = (Vec::with_capacity(self.tiles.len()), 0);
        for tile in &self.tiles {
            let (_, rest) = data.split_at_mut((tile.rows.start - at) * width);
            let (part, rest) = rest.split_at_mut(tile.rows.len() * width);
            parts.push(part);
            (data, at) = (rest, tile.rows.end);
        }
        parts
    }

    /// Notes which own keys some rows of a tile see, a query row counting once for each head of a group: how many each sees, and
    /// which key row is its first.
    pub(super) fn visible_own_keys(
        &self,
        tile: usize,
        group: usize,
        rows: Range<usize>,
        (seen, first): (&mut Vec<usize>, &mut Vec<usize>),
    ) {
        let (start, block) = (self.tiles[tile].rows.start, &self.blocks[tile]);
        seen.clear();
        first.clear();
        for r in rows {
            let row = start + r / group - block.queries.start;
            seen.push(block.seen(row % block.q_period));
            first.push(block.own_start + row / block.q_period * block.k_period);
        }
    }

    /// Own key rows of all items that the tile touches.
    fn own_rows(&self, tile: usize) -> Range<usize> {
        let (rows, block) = (&self.tiles[tile].rows, &self.blocks[tile]);
        let item = |row: usize| (row - block.queries.start) / block.q_period;
        let key = |item: usize| block.own_start + item * block.k_period;
        key(item(rows.start))..key(item(rows.end - 1) + 1)
    }

    /// Disjoint spans of key rows of k and v, in order, each with the tiles that read only there:
    /// the gradients of different spans can be summed independently.
    pub(super) fn spans(&self) -> Vec<(Range<usize>, Vec<usize>)> {
        let mut spans: Vec<(Range<usize>, Vec<usize>)> = Vec::new();
        for (t, tile) in self.tiles.iter().enumerate() {
            let mut span = self.own_rows(t);
            if let Some(set) = tile.shared.map(|s| &self.sets[s]).filter(|set| !set.extra) {
                span = match span.is_empty() {
                    true => set.rows.clone(),
                    false => span.start.min(set.rows.start)..span.end.max(set.rows.end),
                };
            }
            spans.push((span, vec![t]));
        }
        spans.sort_by_key(|(span, tiles)| (span.start, tiles[0]));
        let mut merged: Vec<(Range<usize>, Vec<usize>)> = Vec::new();
        for (span, tiles) in spans {
            match merged.last_mut() {
                Some((last, members)) if span.start < last.end => {
                    last.end = last.end.max(span.end);
                    members.extend(tiles);
                }
                _ => merged.push((span, tiles)),
            }
        }
        merged.iter_mut().for_each(|(_, tiles)| tiles.sort_unstable());
        merged
    }
}

/// Rows of a tile: a multiple of the micro-kernel's height where the scores allow it.
fn tile_rows(width: usize, group: usize) -> usize {
    (TILE_SCORES / (width * group).max(1) / 12 * 12).clamp(12, 48)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::kernels::attention::layout::Precision;

    fn training(groups: usize) -> AttentionLayout {
        let blocks = (0..groups).flat_map(|g| {
            let start = g * 130;
            let prefix = start..start + 100;
            [
                Block {
                    queries: prefix.clone(),
                    shared: 0..0,
                    own_start: start,
                    q_period: 100,
                    k_period: 100,
                    causal: true,
                },
                Block {
                    queries: start + 100..start + 130,
                    shared: prefix,
                    own_start: start + 100,
                    q_period: 1,
                    k_period: 1,
                    causal: true,
                },
            ]
        });
        AttentionLayout {
            heads: 2,
            kv_heads: 1,
            head_dim: 8,
            blocks: blocks.collect(),
            precision: Precision::F32,
        }
    }

    #[test]
    fn tiles_cover_each_row_once_and_prefixes_are_packed_once() {
        let plan = Plan::new(&training(3), false);
        let rows: Vec<usize> = plan.tiles.iter().flat_map(|t| t.rows.clone()).collect();
        assert_eq!(rows, (0..390).collect::<Vec<_>>());
        assert_eq!(plan.sets.len(), 3);
    }

    #[test]
    fn groups_are_spans_of_their_own() {
        let spans = Plan::new(&training(3), false).spans();
        let ranges: Vec<_> = spans.iter().map(|(span, _)| span.clone()).collect();
        assert_eq!(ranges, [0..130, 130..260, 260..390]);
        let tiles: usize = spans.iter().map(|(_, tiles)| tiles.len()).sum();
        assert_eq!(tiles, Plan::new(&training(3), false).tiles.len());
    }
}
