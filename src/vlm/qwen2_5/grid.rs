//! The patch grid of an image, the windows of the vision encoder and the order of its tokens.

use std::ops::Range;

/// Patches of one image: rows and columns (not merged tokens).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Grid {
    /// Patch rows.
    pub height: usize,
    /// Patch columns.
    pub width: usize,
}

impl Grid {
    /// Number of patches.
    pub fn patches(&self) -> usize {
        self.height * self.width
    }

    /// Rows and columns of merged tokens.
    pub fn merged(&self, merge: usize) -> (usize, usize) {
        (self.height / merge, self.width / merge)
    }

    /// Row and column of every patch, in the order of the patch rows: merge blocks row-major, row-major inside a block.
    pub fn patch_positions(&self, merge: usize) -> Vec<(usize, usize)> {
        let (rows, cols) = self.merged(merge);
        let mut out = Vec::with_capacity(self.patches());
        for by in 0..rows {
            for bx in 0..cols {
                for iy in 0..merge {
                    for ix in 0..merge {
                        out.push((by * merge + iy, bx * merge + ix));
                    }
                }
            }
        }
        out
    }
}

/// The window order of merged tokens over several images, and the segments within which attention stays.
///
/// Source: `get_window_index` of the reference's `modeling_qwen2_5_vl.py`, restated without padding.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct WindowOrder {
    /// For each place in window order, the merged token (row-major over all images) that stands there.
    pub index: Vec<u32>,
    /// Patch ranges of the windows, in window order.
    pub windows: Vec<Range<usize>>,
    /// Patch ranges of the images, for the blocks with full attention.
    pub images: Vec<Range<usize>>,
}

impl WindowOrder {
    /// Lays out windows of `window` x `window` merged tokens; those at the right and bottom edges are smaller.
    pub fn new(grids: &[Grid], merge: usize, window: usize) -> Self {
        let mut order = Self { index: Vec::new(), windows: Vec::new(), images: Vec::new() };
        let unit = merge * merge;
        let (mut base, mut patches) = (0, 0);
        for grid in grids {
            let (rows, cols) = grid.merged(merge);
            for wy in (0..rows).step_by(window) {
                for wx in (0..cols).step_by(window) {
                    let start = order.index.len();
                    for y in wy..(wy + window).min(rows) {
                        for x in wx..(wx + window).min(cols) {
                            order.index.push((base + y * cols + x) as u32);
                        }
                    }
                    order.windows.push(start * unit..order.index.len() * unit);
                }
            }
            order.images.push(patches..patches + grid.patches());
            patches += grid.patches();
            base += rows * cols;
        }
        order
    }

    /// For each merged token, its place in window order (the inverse of `index`).
    pub fn inverse(&self) -> Vec<u32> {
        let mut inverse = vec![0; self.index.len()];
        for (place, &token) in self.index.iter().enumerate() {
            inverse[token as usize] = place as u32;
        }
        inverse
    }

    /// Like `index`, for patch rows: each merged token owns `unit` consecutive rows.
    pub fn patch_index(&self, unit: usize) -> Vec<u32> {
        self.index.iter().flat_map(|&t| (0..unit as u32).map(move |j| t * unit as u32 + j)).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn windows_cover_every_token_once_and_shrink_at_the_edges() {
        let grids = [Grid { height: 10, width: 22 }, Grid { height: 8, width: 16 }];
        let order = WindowOrder::new(&grids, 2, 4);
        let mut seen = order.index.clone();
        seen.sort_unstable();
        assert_eq!(seen, (0..(55 + 32) as u32).collect::<Vec<_>>());
        let lens: Vec<usize> = order.windows.iter().map(|w| w.len() / 4).collect();
        assert_eq!(lens, [16, 16, 12, 4, 4, 3, 16, 16]);
        assert_eq!(order.images, [0..220, 220..348]);
        let inverse = order.inverse();
        assert!(order.index.iter().enumerate().all(|(i, &t)| inverse[t as usize] == i as u32));
    }
}
