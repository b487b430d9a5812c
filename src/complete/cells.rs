//! The plan's lattice over an expected map: what is known in the cell of each of its pixels.

use super::options::Region;
use super::prior::{Prior, SAME_SURFACE};
use crate::query::plan::lattice;

/// A cell with an edge is asked once in so many turns.
const EDGE_TURNS: usize = 2;
/// A cell is asked where more than this share of its pixels is unknown.
const UNKNOWN: f32 = 0.25;
/// A cell is asked where nothing in it has a smaller expected error, relative to the depth.
const UNSURE: f32 = 0.3;

/// The surroundings of one pixel of the lattice.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Cell {
    /// Column and row of the lattice's pixel.
    pub(super) pixel: (usize, usize),
    /// The pixel that is known best, with its expected error relative to its depth.
    pub(super) best: Option<(usize, f32)>,
    /// Whether what is expected here does not suffice.
    pub(super) ask: bool,
    /// Whether a depth edge runs through it.
    edge: bool,
    /// Whether what is expected here is wrong.
    pub(super) forgotten: bool,
    pixels: u32,
    unknown: u32,
}

/// One cell for each pixel of a lattice.
pub(super) struct Cells {
    cells: Vec<Cell>,
    columns: usize,
    stride: usize,
    first: (usize, usize),
}

impl Cells {
    /// The lattice of a region, over what is expected of a frame of this width.
    pub(super) fn new(prior: &Prior, width: usize, region: Region, stride: usize) -> Self {
        let pixels = region.lattice(lattice, stride);
        let first = pixels.first().copied().unwrap_or_default();
        let columns = pixels.iter().take_while(|p| p.1 == first.1).count().max(1);
        let cells = pixels.iter().map(|&pixel| Cell { pixel, ..Cell::default() }).collect();
        let mut all = Self { cells, columns, stride, first };
        if all.cells.is_empty() {
            return all;
        }
        for y in region.y..region.y + region.height {
            for x in region.x..region.x + region.width {
                all.count(prior, width, region, (x, y));
            }
        }
        for (i, cell) in all.cells.iter_mut().enumerate() {
            let turn = i % columns + i / columns + prior.turn % EDGE_TURNS;
            cell.ask |= (cell.edge && turn.is_multiple_of(EDGE_TURNS))
                || cell.unknown as f32 > UNKNOWN * cell.pixels as f32
                || cell.best.is_none_or(|(_, error)| error > UNSURE);
        }
        all
    }

    /// Takes note of one pixel of the frame.
    fn count(&mut self, prior: &Prior, width: usize, region: Region, (x, y): (usize, usize)) {
        let (at, pixel) = (self.at((x, y)), y * width + x);
        let depth = prior.depth[pixel];
        let beside = [(x + 1, y), (x, y + 1)];
        for (u, v) in beside.into_iter().filter(|&(u, v)| region.contains(u, v)) {
            let other = prior.depth[v * width + u];
            if depth.max(other) > SAME_SURFACE * depth.min(other) {
                let beyond = self.at((u, v));
                self.cells[at].edge = true;
                self.cells[beyond].edge = true;
            }
        }
        let cell = &mut self.cells[at];
        cell.pixels += 1;
        if depth.is_nan() {
            cell.unknown += 1;
            return;
        }
        let error = prior.expected_error[pixel] / depth;
        let apart = |p: usize| (p % width).abs_diff(cell.pixel.0) + (p / width).abs_diff(cell.pixel.1);
        let better = |(p, least): (usize, f32)| error < least || (error == least && apart(pixel) < apart(p));
        if cell.best.is_none_or(better) {
            cell.best = Some((pixel, error));
        }
    }

    /// The cell that a pixel of the region lies in.
    pub(super) fn at(&self, (x, y): (usize, usize)) -> usize {
        let cell = |at: usize, first: usize, count: usize| {
            ((at + self.stride / 2).saturating_sub(first) / self.stride).min(count - 1)
        };
        let rows = self.cells.len() / self.columns;
        cell(y, self.first.1, rows) * self.columns + cell(x, self.first.0, self.columns)
    }

    pub(super) fn get(&self, cell: usize) -> &Cell {
        &self.cells[cell]
    }

    pub(super) fn iter(&self) -> impl Iterator<Item = &Cell> {
        self.cells.iter()
    }

    /// Forgets what is expected in a cell and so many around it.
    pub(super) fn forget(&mut self, cell: usize, around: usize) {
        let (column, row) = (cell % self.columns, cell / self.columns);
        let rows = self.cells.len() / self.columns;
        for r in row.saturating_sub(around)..(row + around + 1).min(rows) {
            for c in column.saturating_sub(around)..(column + around + 1).min(self.columns) {
                let cell = &mut self.cells[r * self.columns + c];
                (cell.ask, cell.forgotten) = (true, true);
            }
        }
    }

    /// Whether a cell is asked as a check in this turn: one of `every` x `every`, each of them once in as many turns.
    pub(super) fn checked(&self, cell: usize, every: usize, turn: usize) -> bool {
        let all = every * every;
        // Steps of an odd number that is prime to most squares: what is asked in turn lies apart.
        let turn = (turn % all) * 7 % all;
        (cell % self.columns) % every == turn % every && (cell / self.columns) % every == turn / every
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIZE: (usize, usize) = (64, 48);
    const WHOLE: Region = Region { x: 0, y: 0, width: SIZE.0, height: SIZE.1 };

    fn prior(depth: impl Fn(usize, usize) -> f32, turn: usize) -> Prior {
        let depth: Vec<f32> = (0..SIZE.0 * SIZE.1).map(|i| depth(i % SIZE.0, i / SIZE.0)).collect();
        let expected_error = depth.iter().map(|d| 0.05 * d).collect();
        Prior { confidence: vec![0.7; depth.len()], depth, expected_error, turn }
    }

    fn asked(cells: &Cells) -> Vec<(usize, usize)> {
        cells.iter().filter(|c| c.ask).map(|c| c.pixel).collect()
    }

    #[test]
    fn every_pixel_lies_in_the_cell_of_the_lattice_pixel_beside_it() {
        for (stride, region) in
            [(1, WHOLE), (4, WHOLE), (5, Region { x: 7, y: 3, width: 31, height: 22 }), (50, WHOLE)]
        {
            let cells = Cells::new(&prior(|_, _| 2.0, 0), SIZE.0, region, stride);
            for (i, cell) in cells.iter().enumerate() {
                assert_eq!(cells.at(cell.pixel), i);
                assert!(!cell.ask && !cell.forgotten && cell.best.is_some());
            }
            for y in region.y..region.y + region.height {
                for x in region.x..region.x + region.width {
                    let (u, v) = cells.get(cells.at((x, y))).pixel;
                    assert!(x.abs_diff(u) <= stride / 2 + stride && y.abs_diff(v) <= stride / 2 + stride);
                }
            }
        }
    }

    #[test]
    fn edges_are_asked_in_turns_and_what_is_unknown_or_unsure_always() {
        let step = |x: usize, _: usize| if x < 30 { 1.0 } else { 2.0 };
        let mut seen: Vec<_> =
            (0..EDGE_TURNS).flat_map(|t| asked(&Cells::new(&prior(step, t), SIZE.0, WHOLE, 4))).collect();
        seen.sort_unstable();
        assert!(seen.len() >= 12 && seen.iter().all(|p| p.0.abs_diff(30) <= 4), "{seen:?}");
        let before = seen.len();
        seen.dedup();
        assert_eq!(seen.len(), before, "each of them in one of the turns");
        let mut holed = prior(|x, y| if x < 10 && y < 10 { f32::NAN } else { 2.0 }, 0);
        holed.expected_error[39 * SIZE.0..].fill(0.5 * 2.0);
        let cells = Cells::new(&holed, SIZE.0, WHOLE, 4);
        for cell in cells.iter() {
            let (x, y) = cell.pixel;
            assert!(cell.ask || (x >= 6 && y < 40) || (x < 10 && (6..40).contains(&y)), "({x}, {y})");
            assert!(!cell.ask || (x <= 10 && y <= 10) || y >= 38, "({x}, {y})");
        }
    }

    #[test]
    fn the_best_pixel_of_a_cell_stands_for_it() {
        let mut prior = prior(|_, _| 2.0, 0);
        prior.expected_error[21 * SIZE.0 + 17] = 0.001;
        let cells = Cells::new(&prior, SIZE.0, WHOLE, 8);
        let cell = cells.at((17, 21));
        assert_eq!(cells.get(cell).best, Some((21 * SIZE.0 + 17, 0.0005)));
        let other = cells.get(cell + 1);
        assert_eq!(
            other.best.map(|b| b.0),
            Some(other.pixel.1 * SIZE.0 + other.pixel.0),
            "the middle one of equals"
        );
    }

    #[test]
    fn every_cell_is_checked_once_in_so_many_turns_and_forgotten_with_its_neighbours() {
        let mut cells = Cells::new(&prior(|_, _| 2.0, 0), SIZE.0, WHOLE, 4);
        let count = cells.iter().count();
        for cell in 0..count {
            let turns = (5..21).filter(|&turn| cells.checked(cell, 4, turn));
            assert_eq!(turns.count(), 1, "cell {cell}");
        }
        let in_turn = |turn| (0..count).filter(|&c| cells.checked(c, 4, turn)).count();
        assert!((0..16).all(|turn| in_turn(turn) == count / 16));
        cells.forget(0, 1);
        assert_eq!(cells.iter().filter(|c| c.forgotten && c.ask).count(), 4);
        cells.forget(count / 2 + 5, 2);
        assert_eq!(cells.iter().filter(|c| c.forgotten).count(), 4 + 25);
    }
}
