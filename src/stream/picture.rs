//! A small picture of a frame, to see what changed.

use image::RgbImage;

/// Side of a block, pixels.
pub(super) const BLOCK: usize = 4;
/// A block has changed when the mean of a channel differs by more than this, 8-bit steps: noise of 10 steps a pixel moves it by 2.5.
const CHANGED: f32 = 10.0;
/// While the camera moves, a surface is taken for another one when its colour lies farther than this outside of what the blocks around show.
const OTHER: f32 = 24.0;

/// The mean colours of a frame's blocks.
#[derive(Debug, Clone)]
pub(super) struct Blocks {
    colours: Vec<[f32; 3]>,
    columns: usize,
}

impl Blocks {
    pub(super) fn new(rgb: &RgbImage) -> Self {
        let (width, height) = (rgb.width() as usize, rgb.height() as usize);
        let (columns, rows) = (width.div_ceil(BLOCK), height.div_ceil(BLOCK));
        let mut sums = vec![([0u32; 3], 0u32); columns * rows];
        for (y, line) in rgb.as_raw().chunks_exact((3 * width).max(1)).enumerate() {
            for (x, pixel) in line.chunks_exact(3).enumerate() {
                let (sum, count) = &mut sums[y / BLOCK * columns + x / BLOCK];
                *count += 1;
                sum.iter_mut().zip(pixel).for_each(|(s, &v)| *s += u32::from(v));
            }
        }
        let mean = |(sum, count): ([u32; 3], u32)| sum.map(|s| s as f32 / count.max(1) as f32);
        Self { colours: sums.into_iter().map(mean).collect(), columns }
    }

    /// How many blocks there are.
    #[cfg(test)]
    pub(super) fn len(&self) -> usize {
        self.colours.len()
    }

    /// The block of a pixel.
    pub(super) fn at(&self, x: usize, y: usize) -> usize {
        y / BLOCK * self.columns + x / BLOCK
    }

    /// The colour of a pixel's block.
    pub(super) fn colour(&self, x: usize, y: usize) -> [f32; 3] {
        self.colours[self.at(x, y)]
    }

    /// Which blocks differ from those of a later frame of the same size, or stand beside one that does.
    pub(super) fn changed(&self, later: &Self) -> Vec<bool> {
        let apart = |(a, b): (&[f32; 3], &[f32; 3])| a.iter().zip(b).any(|(a, b)| (a - b).abs() > CHANGED);
        let own: Vec<bool> = self.colours.iter().zip(&later.colours).map(apart).collect();
        let around = |i: usize| self.around(i).any(|k| own[k]);
        (0..own.len()).map(around).collect()
    }

    /// Whether a surface of this colour may be seen at a pixel.
    pub(super) fn allows(&self, colour: [f32; 3], x: usize, y: usize) -> bool {
        let (mut low, mut high) = ([f32::INFINITY; 3], [f32::NEG_INFINITY; 3]);
        for k in self.around(self.at(x, y)) {
            for (c, &v) in self.colours[k].iter().enumerate() {
                (low[c], high[c]) = (low[c].min(v), high[c].max(v));
            }
        }
        (0..3).all(|c| colour[c] >= low[c] - OTHER && colour[c] <= high[c] + OTHER)
    }

    /// A block and the eight around it.
    fn around(&self, block: usize) -> impl Iterator<Item = usize> {
        let (column, row) = (block % self.columns, block / self.columns);
        let (columns, rows) = (self.columns, self.colours.len() / self.columns);
        let across = column.saturating_sub(1)..(column + 2).min(columns);
        (row.saturating_sub(1)..(row + 2).min(rows))
            .flat_map(move |r| across.clone().map(move |c| r * columns + c))
    }
}
