//! The matrix product. One micro-kernel serves every product of f32: the left-hand side is
//! read in place, along rows, along columns (a product with its transpose), or in several segments
//! (the three image rows under a 3x3 filter), so it is never copied.

use super::panels::{Lhs, PanelsView};
use crate::kernels::isa::per_level;
use crate::kernels::simd::{Simd, Vector};
use std::marker::PhantomData;

/// What the product is added to.
#[derive(Clone, Copy)]
pub(in crate::kernels) enum Init<'a> {
    Zero,
    /// One value per column.
    Bias(&'a [f32]),
    /// What the destination holds.
    Add,
}

per_level!(
    /// `dst = init + lhs * rhs`, where `dst` has `m` rows of `rhs.n` that start every `stride` elements.
    fn multiply(dst: &mut [f32], stride: usize, m: usize, lhs: Lhs<'_>, rhs: PanelsView<'_>, init: Init<'_>) = multiply_body
);

#[inline(always)]
fn multiply_body<S: Simd>(
    isa: S,
    dst: &mut [f32],
    stride: usize,
    m: usize,
    lhs: Lhs<'_>,
    rhs: PanelsView<'_>,
    init: Init<'_>,
) {
    if m == 0 || rhs.n == 0 {
        return;
    }
    assert_eq!(lhs.segments * lhs.length, rhs.k, "inner dimensions");
    assert!(rhs.k == 0 || lhs.end(m) <= lhs.data.len(), "left-hand side too short");
    assert!((m - 1) * stride + rhs.n <= dst.len(), "destination too short");
    let panels = rhs.n.div_ceil(rhs.nr);
    assert!((panels - 1) * rhs.jump + rhs.k * rhs.nr <= rhs.data.len(), "panels too short");
    let width = TileShape::<S::F32>::COLUMNS.min(rhs.nr);
    assert!(rhs.nr.is_multiple_of(width), "panels of {} columns", rhs.nr);
    for p in 0..panels {
        let panel = &rhs.data[p * rhs.jump..p * rhs.jump + rhs.k * rhs.nr];
        for off in (0..rhs.nr).step_by(width) {
            let col = p * rhs.nr + off;
            if col < rhs.n {
                let cols = width.min(rhs.n - col);
                let strip = Strip { panel, nr: rhs.nr, off, col, cols };
                // SAFETY: the checks above: for `m` rows and `k` inner indices `lhs` is in bounds, the panel holds `k` rows
                // of `nr`, and a strip's width divides `nr`.
                unsafe { strip_of_tiles::<S::F32>(isa, dst, stride, m, lhs, strip, init) };
            }
        }
    }
}

/// The shape of the register tile, which makes as many sums as the registers hold beside the operands.
struct TileShape<V>(PhantomData<V>);

impl<V: Vector> TileShape<V> {
    /// 12 rows by 2 registers of columns; otherwise there are 6 rows.
    const TALL: bool = V::REGISTERS == 32 && V::LANES > 4;
    /// 6 rows by 4 registers: where registers are many and narrow, a step loads something for each row and each register of
    /// columns, and 6 + 4 are fewer than 12 + 2.
    const WIDE: bool = V::REGISTERS == 32 && V::LANES == 4;
    /// Columns of a strip. (Where panels have 16 columns, one register of AVX-512.)
    const COLUMNS: usize = if Self::WIDE { 4 * V::LANES } else { 2 * V::LANES };
}

/// Columns of the widest strip.
const MAX_STRIP_COLUMNS: usize = 32;

#[derive(Clone, Copy)]
struct Strip<'a> {
    panel: &'a [f32],
    nr: usize,
    /// First column within the panel.
    off: usize,
    /// First column of the product.
    col: usize,
    /// Columns that exist.
    cols: usize,
}

/// One strip of columns, by the tile of the register type.
///
/// # Safety
/// As [`strip`], for the narrower of [`TileShape::COLUMNS`] and `b.nr` columns.
#[inline(always)]
unsafe fn strip_of_tiles<V: Vector>(
    isa: V::Isa,
    dst: &mut [f32],
    stride: usize,
    m: usize,
    lhs: Lhs<'_>,
    b: Strip<'_>,
    init: Init<'_>,
) {
    // SAFETY: the caller's promise; each tile has as many columns as the strip.
    unsafe {
        if TileShape::<V>::TALL {
            match b.nr < TileShape::<V>::COLUMNS {
                true => strip::<V, 12, 1>(isa, dst, stride, m, lhs, b, init),
                false => strip::<V, 12, 2>(isa, dst, stride, m, lhs, b, init),
            }
        } else if TileShape::<V>::WIDE {
            strip::<V, 6, 4>(isa, dst, stride, m, lhs, b, init);
        } else {
            strip::<V, 6, 2>(isa, dst, stride, m, lhs, b, init);
        }
    }
}

/// # Safety
/// For `m` rows and every inner index `lhs` must be in bounds, `b.panel` must hold as many rows of `b.nr`, and `b.off` plus
/// `NV` registers must end within `b.nr`.
#[inline(always)]
unsafe fn strip<V: Vector, const MR: usize, const NV: usize>(
    isa: V::Isa,
    dst: &mut [f32],
    stride: usize,
    m: usize,
    lhs: Lhs<'_>,
    b: Strip<'_>,
    init: Init<'_>,
) {
    let mut r = 0;
    // SAFETY: the caller's promise holds for all `m` rows, and no tile passes row `m`.
    unsafe {
        while r + MR <= m {
            block::<V, MR, NV>(isa, dst, stride, r, lhs, b, init);
            r += MR;
        }
        while r + 4 <= m {
            block::<V, 4, NV>(isa, dst, stride, r, lhs, b, init);
            r += 4;
        }
        while r < m {
            block::<V, 1, NV>(isa, dst, stride, r, lhs, b, init);
            r += 1;
        }
    }
}

/// # Safety
/// As [`strip`], for `MR` rows from `row` on.
#[inline(always)]
unsafe fn block<V: Vector, const MR: usize, const NV: usize>(
    isa: V::Isa,
    dst: &mut [f32],
    stride: usize,
    row: usize,
    lhs: Lhs<'_>,
    b: Strip<'_>,
    init: Init<'_>,
) {
    assert!(NV * V::LANES <= MAX_STRIP_COLUMNS);
    let mut start = [0f32; MAX_STRIP_COLUMNS];
    if let Init::Bias(bias) = init {
        start[..b.cols].copy_from_slice(&bias[b.col..b.col + b.cols]);
    }
    // SAFETY: the caller's promise for the operands; `start` and `line` hold `NV` registers, and so does a destination row
    // where `cols` says that all of them exist.
    unsafe {
        let from: [V; NV] = std::array::from_fn(|c| V::load(isa, start.as_ptr().add(c * V::LANES)));
        let acc = match lhs.transposed {
            true => tile::<V, MR, NV, true>(isa, [from; MR], row, lhs, b),
            false => tile::<V, MR, NV, false>(isa, [from; MR], row, lhs, b),
        };
        for (r, acc) in acc.iter().enumerate() {
            let to = (row + r) * stride + b.col;
            let out = &mut dst[to..to + b.cols];
            if b.cols == NV * V::LANES {
                for (c, &acc) in acc.iter().enumerate() {
                    let at = out.as_mut_ptr().add(c * V::LANES);
                    let old = if let Init::Add = init { V::load(isa, at) } else { V::splat(isa, 0.0) };
                    acc.madd(isa, V::splat(isa, 1.0), old).store(isa, at);
                }
                continue;
            }
            let mut line = [0f32; MAX_STRIP_COLUMNS];
            for (c, acc) in acc.iter().enumerate() {
                acc.store(isa, line.as_mut_ptr().add(c * V::LANES));
            }
            for (o, a) in out.iter_mut().zip(&line) {
                *o = if let Init::Add = init { *o + a } else { *a };
            }
        }
    }
}

/// Sums of `MR` rows by `NV` registers, kept in registers over the whole inner dimension.
///
/// # Safety
/// As [`strip`], for `MR` rows from `row` on.
#[inline(always)]
unsafe fn tile<V: Vector, const MR: usize, const NV: usize, const TRANSPOSED: bool>(
    isa: V::Isa,
    mut acc: [[V; NV]; MR],
    row: usize,
    lhs: Lhs<'_>,
    b: Strip<'_>,
) -> [[V; NV]; MR] {
    // SAFETY: the caller's promise: every index below is one of these rows and inner indices.
    unsafe {
        let mut right = b.panel.as_ptr().add(b.off);
        let start = lhs.data.as_ptr().add(if TRANSPOSED { row } else { row * lhs.stride });
        for segment in 0..lhs.segments {
            let left = start.add(segment * lhs.jump);
            for i in 0..lhs.length {
                let columns: [V; NV] = std::array::from_fn(|c| V::load(isa, right.add(c * V::LANES)));
                for (r, acc) in acc.iter_mut().enumerate() {
                    let at = if TRANSPOSED { i * lhs.stride + r } else { r * lhs.stride + i };
                    let x = V::splat(isa, *left.add(at));
                    for c in 0..NV {
                        acc[c] = x.madd(isa, columns[c], acc[c]);
                    }
                }
                right = right.wrapping_add(b.nr);
            }
        }
    }
    acc
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::kernels::gemm::f32::Panels;
    use crate::kernels::isa::Level;
    use crate::kernels::testing::{random, values};

    fn naive(a: &[f32], b: &[f32], m: usize, k: usize, n: usize) -> Vec<f64> {
        let mut out = vec![0f64; m * n];
        for i in 0..m {
            for j in 0..n {
                out[i * n + j] = (0..k).map(|p| a[i * k + p] as f64 * b[p * n + j] as f64).sum();
            }
        }
        out
    }

    fn transpose(a: &[f32], rows: usize, cols: usize) -> Vec<f32> {
        (0..rows * cols).map(|i| a[i % rows * cols + i / rows]).collect()
    }

    #[test]
    fn every_form_is_the_plain_product() {
        for (m, k, n) in [(1, 1, 1), (13, 7, 16), (29, 5, 17), (3, 70, 33), (37, 12, 100)] {
            let (a, b) = (values(&random(&[m, k], 1)), values(&random(&[k, n], 2)));
            let (at, bt) = (transpose(&a, m, k), transpose(&b, k, n));
            let exact = naive(&a, &b, m, k, n);
            let bias: Vec<f32> = (0..n).map(|j| j as f32).collect();
            for level in Level::available() {
                let panels = [Panels::from_rows(&b, n, k, n), Panels::from_columns(&bt, k, k, n)];
                let lefts = [Lhs::rows(&a, k, k), Lhs::columns(&at, m, k)];
                for (rhs, lhs) in [(0, 0), (0, 1), (1, 0), (1, 1)] {
                    // A stride above n: what lies between the rows must stay.
                    let mut dst = vec![5f32; m * (n + 1)];
                    multiply(level, &mut dst, n + 1, m, lefts[lhs], panels[rhs].view(), Init::Bias(&bias));
                    multiply(level, &mut dst, n + 1, m, lefts[lhs], panels[rhs].view(), Init::Add);
                    for i in 0..m {
                        for j in 0..n {
                            let expected = 2.0 * exact[i * n + j] + j as f64;
                            let found = dst[i * (n + 1) + j] as f64;
                            assert!((found - expected).abs() < 1e-4, "{m}x{k}x{n} {} {i},{j}", level.name());
                        }
                        assert_eq!(dst[i * (n + 1) + n], 5.0);
                    }
                }
            }
        }
    }

    #[test]
    fn segments_are_one_inner_dimension() {
        let a = values(&random(&[40], 1));
        let b = values(&random(&[6, 3], 2));
        for level in Level::available() {
            let mut dst = vec![0f32; 9];
            let lhs = Lhs::rows(&a, 2, 3).segments(2, 20);
            multiply(level, &mut dst, 3, 3, lhs, Panels::from_rows(&b, 3, 6, 3).view(), Init::Zero);
            for (i, found) in dst.iter().enumerate() {
                let (r, c) = (i / 3, i % 3);
                let expected: f32 = (0..6).map(|p| a[r * 2 + p % 3 + p / 3 * 20] * b[p * 3 + c]).sum();
                assert!((found - expected).abs() < 1e-5);
            }
        }
    }
}
