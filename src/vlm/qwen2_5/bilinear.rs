//! Bilinear windows of samples on the CPU.

/// Samples along a side of a window, at most; bilinear values read one more.
pub(crate) const LARGEST: usize = 64;

/// Reads a window of `side` x `side` bilinear values around a place between samples, `[height, width, N]`, the border repeated.
/// `put` gets each of its rows with its number: `side` times `N` values.
///
/// Values between two columns are made once per row of samples, and as whole rows, which compilers turn into vectors; each one is
/// `a + (b - a) * part`, first across and then down.
///
/// # Panics
/// If `side` is over [`LARGEST`], or `samples` holds fewer than `width * height * N`; both are checked where they come from.
pub(crate) fn bilinear<const N: usize, T: Copy + Into<f32>>(
    samples: &[T],
    (width, height): (usize, usize),
    (x, y): (f32, f32),
    side: usize,
    mut put: impl FnMut(usize, &[f32]),
) {
    let first = |p: f32| p - (side as f32 - 1.0) / 2.0;
    let (x, y) = (first(x), first(y));
    let (fx, fy) = (x - x.floor(), y - y.floor());
    let (left, top) = (x.floor() as i64, y.floor() as i64);
    let inside = left >= 0 && left + (side as i64) < width as i64;
    let across = |row: i64, out: &mut [f32]| {
        let row = row.clamp(0, height as i64 - 1) as usize * width;
        let mut edge = [[0f32; N]; LARGEST + 1];
        let between = |samples: &[T], out: &mut [f32]| {
            for ((value, &a), &b) in out.iter_mut().zip(samples).zip(&samples[N..]) {
                let (a, b): (f32, f32) = (a.into(), b.into());
                *value = a + (b - a) * fx;
            }
        };
        if inside {
            return between(&samples[(row + left as usize) * N..][..(side + 1) * N], out);
        }
        for (dx, sample) in edge[..=side].iter_mut().enumerate() {
            let column = (left + dx as i64).clamp(0, width as i64 - 1) as usize;
            *sample = std::array::from_fn(|c| samples[(row + column) * N + c].into());
        }
        for (dx, value) in out.chunks_exact_mut(N).enumerate() {
            for (c, value) in value.iter_mut().enumerate() {
                *value = edge[dx][c] + (edge[dx + 1][c] - edge[dx][c]) * fx;
            }
        }
    };
    let (mut above, mut below) = ([[0f32; N]; LARGEST], [[0f32; N]; LARGEST]);
    let (above, below) = (above.as_flattened_mut(), below.as_flattened_mut());
    let (mut above, mut below) = (&mut above[..side * N], &mut below[..side * N]);
    across(top, above);
    for dy in 0..side {
        across(top + dy as i64 + 1, below);
        for (u, &v) in above.iter_mut().zip(below.iter()) {
            *u += (v - *u) * fy;
        }
        put(dy, above);
        std::mem::swap(&mut above, &mut below);
    }
}
