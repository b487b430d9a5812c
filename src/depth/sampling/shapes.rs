//! Pixels of devices that measure fixed parts of the picture.

use rand::Rng;

/// One row across the picture, slightly tilted, at most `points` columns of it.
pub(super) fn line(width: usize, height: usize, points: usize, rng: &mut impl Rng) -> Vec<usize> {
    let row = height as f32 * (0.25 + 0.6 * rng.random::<f32>());
    let tilt = 0.08 * (rng.random::<f32>() - 0.5);
    let columns = width.min(points);
    let pixel = |k: usize| {
        let x = (2 * k + 1) * width / (2 * columns);
        let y = row + tilt * (x as f32 - 0.5 * width as f32);
        (y >= 0.0 && y < height as f32).then(|| y as usize * width + x)
    };
    (0..columns).filter_map(pixel).collect()
}

/// The middle of each cell of a part of the picture: `from` and `size` in pixels, cells per row and column.
fn lattice(width: usize, from: [f32; 2], size: [f32; 2], cells: [usize; 2]) -> Vec<usize> {
    let place = |k: usize, i: usize| (from[k] + (i as f32 + 0.5) * size[k] / cells[k] as f32) as usize;
    let mut out: Vec<usize> = (0..cells[1])
        .flat_map(|j| (0..cells[0]).map(move |i| (i, j)))
        .map(|(i, j)| place(1, j) * width + place(0, i).min(width - 1))
        .collect();
    out.dedup();
    out
}

/// `side` by `side` zones over the middle of the picture or all of it.
pub(super) fn block(width: usize, height: usize, side: usize, rng: &mut impl Rng) -> Vec<usize> {
    let part = (0.5 + 0.6 * rng.random::<f32>()).min(1.0);
    let sides = [width as f32, height as f32];
    let size = sides.map(|s| s * part);
    let cells = [side.min(size[0] as usize).max(1), side.min(size[1] as usize).max(1)];
    lattice(width, [0, 1].map(|k| 0.5 * (sides[k] - size[k])), size, cells)
}

/// Square cells over the whole picture, at most about `points`.
pub(super) fn grid(width: usize, height: usize, points: usize, rng: &mut impl Rng) -> Vec<usize> {
    let (w, h) = (width as f32, height as f32);
    let cell = (w * h / points as f32).sqrt().max(1.0);
    let cells = [((w / cell) as usize).max(1), ((h / cell) as usize).max(1)];
    let cells = if cells[0] * cells[1] > points { [points.min(width), 1] } else { cells };
    let size = [w, h].map(|s| s - 0.999);
    let spare = [0, 1].map(|k| 0.5 * size[k] / cells[k] as f32);
    let shift = spare.map(|s| s * (rng.random::<f32>() - 0.5));
    // Shifted by less than half of the room before the first cell's middle.
    lattice(width, shift.map(|s| s.max(0.0)), [0, 1].map(|k| size[k] - shift[k].abs()), cells)
}

/// Pixels outside of a large rectangle or ellipse.
pub(super) fn outside_of_a_hole(
    valid: &[usize],
    width: usize,
    height: usize,
    rng: &mut impl Rng,
) -> Vec<usize> {
    let round = rng.random_bool(0.4);
    let mut real = |low: f32, high: f32| low + (high - low) * rng.random::<f32>();
    let half = [width, height].map(|s| s as f32 * real(0.15, 0.4));
    let middle = [width, height].map(|s| s as f32 * real(0.25, 0.75));
    let open = |&i: &usize| {
        let x = ((i % width) as f32 - middle[0]).abs() / half[0];
        let y = ((i / width) as f32 - middle[1]).abs() / half[1];
        if round { x * x + y * y > 1.0 } else { x > 1.0 || y > 1.0 }
    };
    valid.iter().copied().filter(open).collect()
}
