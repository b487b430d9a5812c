//! The two colours that each pixel of a Bayer pattern lacks.
//!
//! H. Malvar, L. He, R. Cutler, "High-quality linear interpolation for demosaicing of Bayer-patterned color images" (ICASSP 2004):
//! bilinear, corrected by the curvature of the colour that the pixel has. Factors are the paper's, in sixteenths.

use rayon::prelude::*;

/// Where the first red pixel is: columns and rows of the same parity are red ones.
#[derive(Clone, Copy, Debug)]
pub(super) struct Bayer {
    pub red_column: usize,
    pub red_row: usize,
}

/// R, G, B of every pixel. Rows have one length; at least 2x2 pixels. Beyond the border the pattern is mirrored, which keeps colours in their
/// places.
pub(super) fn demosaic(rows: &[&[u8]], bayer: Bayer) -> Vec<u8> {
    let height = rows.len();
    let line = |y: usize| {
        let lines: [&[u8]; 5] = std::array::from_fn(|i| rows[mirrored(y as isize + i as isize - 2, height)]);
        demosaic_row(lines, bayer.red_column, y % 2 == bayer.red_row)
    };
    let rows: Vec<Vec<u8>> = (0..height).into_par_iter().map(line).collect();
    rows.concat()
}

/// The row in the middle of five.
fn demosaic_row(lines: [&[u8]; 5], red_column: usize, red_row: bool) -> Vec<u8> {
    let width = lines[2].len();
    let column = |x: usize| -> [usize; 5] {
        match x >= 2 && x + 2 < width {
            true => std::array::from_fn(|i| x + i - 2),
            false => std::array::from_fn(|i| mirrored(x as isize + i as isize - 2, width)),
        }
    };
    let mut rgb = Vec::with_capacity(3 * width);
    for x in 0..width {
        let columns = column(x);
        let at =
            |right: isize, down: isize| i32::from(lines[(down + 2) as usize][columns[(right + 2) as usize]]);
        let sums = pixel((x % 2 == red_column, red_row), at);
        rgb.extend(sums.map(|sum| ((sum + 8) >> 4).clamp(0, 255) as u8));
    }
    rgb
}

/// R, G and B in sixteenths of a pixel in a red column, a red row, both or neither.
fn pixel(red: (bool, bool), at: impl Fn(isize, isize) -> i32) -> [i32; 3] {
    let own = at(0, 0);
    let aside = at(-1, 0) + at(1, 0);
    let upright = at(0, -1) + at(0, 1);
    let (far_aside, far_upright) = (at(-2, 0) + at(2, 0), at(0, -2) + at(0, 2));
    let diagonal = at(-1, -1) + at(1, -1) + at(-1, 1) + at(1, 1);
    // At red and blue.
    let green = 8 * own + 4 * (aside + upright) - 2 * (far_aside + far_upright);
    let opposite = 12 * own + 4 * diagonal - 3 * (far_aside + far_upright);
    // At green: the colour to the left and right, and the one above and below.
    let of_row = 10 * own + 8 * aside - 2 * (far_aside + diagonal) + far_upright;
    let of_column = 10 * own + 8 * upright - 2 * (far_upright + diagonal) + far_aside;
    match red {
        (true, true) => [16 * own, green, opposite],
        (false, false) => [opposite, green, 16 * own],
        (false, true) => [of_row, 16 * own, of_column],
        (true, false) => [of_column, 16 * own, of_row],
    }
}

/// A place from -2 to 1 beyond the end, mirrored at the first and the last.
fn mirrored(at: isize, size: usize) -> usize {
    let last = size as isize - 1;
    let at = at.abs();
    let at = if at > last { 2 * last - at } else { at };
    // A row of two is mirrored twice.
    at.unsigned_abs().min(size.saturating_sub(1))
}

#[cfg(test)]
mod tests {
    use super::*;

    const PATTERNS: [(usize, usize); 4] = [(0, 0), (1, 0), (0, 1), (1, 1)];

    /// What a sensor with this pattern makes of a picture, and the picture again.
    fn through(
        colour: impl Fn(usize, usize) -> [u8; 3],
        size: (usize, usize),
        red: (usize, usize),
    ) -> Vec<u8> {
        let channel = |x: usize, y: usize| match (x % 2 == red.0, y % 2 == red.1) {
            (true, true) => 0,
            (false, false) => 2,
            _ => 1,
        };
        let row = |y: usize| (0..size.0).map(|x| colour(x, y)[channel(x, y)]).collect::<Vec<u8>>();
        let raw: Vec<Vec<u8>> = (0..size.1).map(row).collect();
        let rows: Vec<&[u8]> = raw.iter().map(|r| &r[..]).collect();
        demosaic(&rows, Bayer { red_column: red.0, red_row: red.1 })
    }

    #[test]
    fn one_colour_stays_one_colour_in_every_size() {
        for red in PATTERNS {
            for size in [(2, 2), (3, 2), (2, 5), (4, 4), (7, 5)] {
                let rgb = through(|_, _| [200, 90, 31], size, red);
                assert_eq!(rgb, [200, 90, 31].repeat(size.0 * size.1), "{red:?} {size:?}");
            }
        }
    }

    #[test]
    fn slopes_of_grey_are_kept() {
        let grey = |x: usize, y: usize| [(20 + 3 * x + 5 * y) as u8; 3];
        for red in PATTERNS {
            let rgb = through(grey, (16, 12), red);
            for (i, found) in rgb.as_chunks::<3>().0.iter().enumerate() {
                let (x, y) = (i % 16, i / 16);
                if (2..14).contains(&x) && (2..10).contains(&y) {
                    assert_eq!(*found, grey(x, y), "{red:?} ({x}, {y})");
                }
            }
        }
    }
}
