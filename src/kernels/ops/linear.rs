//! Matrix product with a weight, and a bias.

use crate::error::Result;
use crate::kernels::exec::{
    chunk_rows, dims2, expect_dims, map_chunks, on_cpu, output, read, read2, slice, sum_in_order, tensor,
};
use crate::kernels::gemm::f32::{Init, Lhs, Panels, multiply};
use crate::kernels::isa::{Isa, Level, per_level};
use crate::kernels::simd::dot;
use candle_core::{CpuStorage, CustomOp2, CustomOp3, Layout, Shape, Tensor};
use rayon::prelude::*;

/// Rows of the product in one task.
const TASK_ROWS: usize = 96;
/// Rows summed in one task of the weight's gradient.
const GRADIENT_TASK_ROWS: usize = 1024;

/// `x W^T + b`.
///
/// `x` is `[n, k]`, `weight` `[m, k]` (as checkpoints store it), `bias` `[m]`; gives `[n, m]`.
/// Differentiable in all. Shapes that do not fit are
/// [`Error::Argument`](crate::error::Error::Argument).
pub fn linear(x: &Tensor, weight: &Tensor, bias: Option<&Tensor>) -> Result<Tensor> {
    let (_, k) = dims2("x", x)?;
    let (m, _) = dims2("weight", weight)?;
    expect_dims("weight", weight, &[m, k])?;
    if let Some(bias) = bias {
        expect_dims("bias", bias, &[m])?;
    }
    let all: Vec<&Tensor> = [Some(x), Some(weight), bias].into_iter().flatten().collect();
    if !on_cpu(&all) {
        let product = x.matmul(&weight.t()?)?;
        return match bias {
            Some(bias) => Ok(product.broadcast_add(bias)?),
            None => Ok(product),
        };
    }
    let (x, weight) = (x.contiguous()?, weight.contiguous()?);
    match bias {
        Some(bias) => Ok(x.apply_op3(&weight, &bias.contiguous()?, Linear)?),
        None => Ok(x.apply_op2(&weight, Linear)?),
    }
}

struct Linear;

fn forward(x: &[f32], weight: &[f32], bias: Option<&[f32]>, n: usize, k: usize, m: usize) -> Vec<f32> {
    if n <= 4 {
        return by_dots(x, weight, bias, n, k, m);
    }
    if weight_in_place(n, k, m) {
        let lhs = |row: usize| Lhs::rows(&weight[row * k..], k, k);
        return product_in_place(x, n, k, m, lhs, bias);
    }
    product(x, n, k, &Panels::from_columns(weight, k, k, m), m, bias.map_or(Init::Zero, Init::Bias))
}

/// For the few rows of a decode step: reads each row of the weight once, as it lies.
fn by_dots(x: &[f32], weight: &[f32], bias: Option<&[f32]>, n: usize, k: usize, m: usize) -> Vec<f32> {
    let level = Level::current();
    let rows = chunk_rows(k, 32 * 1024);
    let mut transposed = vec![0f32; n * m];
    transposed.par_chunks_mut((rows * n).max(1)).enumerate().for_each(|(i, out)| {
        let count = out.len() / n;
        dots_chunk(level, out, x, &weight[i * rows * k..(i * rows + count) * k], k);
    });
    finish(transposed, n, m, bias)
}

#[inline(always)]
fn dots_body<S: Isa>(isa: S, out: &mut [f32], x: &[f32], weight: &[f32], k: usize) {
    if k == 0 {
        return;
    }
    let n = x.len() / k;
    for (out, w) in out.chunks_exact_mut(n).zip(weight.chunks_exact(k)) {
        for (o, x) in out.iter_mut().zip(x.chunks_exact(k)) {
            *o = dot(isa, w, x);
        }
    }
}
per_level!(fn dots_chunk(out: &mut [f32], x: &[f32], weight: &[f32], k: usize) = dots_body);

/// `grad W`: `[n, k]`.
fn input_grad(grad: &[f32], weight: &[f32], n: usize, k: usize, m: usize) -> Vec<f32> {
    if weight_in_place(n, m, k) {
        let lhs = |row: usize| Lhs::columns(&weight[row..], k, m);
        return product_in_place(grad, n, m, k, lhs, None);
    }
    product(grad, n, m, &Panels::from_rows(weight, k, m, k), k, Init::Zero)
}

/// Whether to pack the few rows of `x` rather than the weight, which would cost more than the product.
fn weight_in_place(n: usize, k: usize, m: usize) -> bool {
    n <= 32 || (n <= 512 && k * m >= 1 << 20)
}

/// `x [n, k]` times packed panels of `m` columns, in parallel over rows.
fn product(x: &[f32], n: usize, k: usize, rhs: &Panels<'_>, m: usize, init: Init<'_>) -> Vec<f32> {
    let level = Level::current();
    let mut out = vec![0f32; n * m];
    if m > 0 {
        out.par_chunks_mut(TASK_ROWS * m).enumerate().for_each(|(i, out)| {
            let rows = out.len() / m;
            let x = &x[i * TASK_ROWS * k..(i * TASK_ROWS + rows) * k];
            multiply(level, out, m, rows, Lhs::rows(x, k, k), rhs.view(), init);
        });
    }
    out
}

/// The same by its transpose: the weight, whose rows from any row on `lhs` gives, times the packed
/// transpose of `x`, in parallel over the weight's rows.
fn product_in_place<'a>(
    x: &[f32],
    n: usize,
    k: usize,
    m: usize,
    lhs: impl Fn(usize) -> Lhs<'a> + Sync,
    bias: Option<&[f32]>,
) -> Vec<f32> {
    let level = Level::current();
    let rhs = Panels::from_columns(x, k, k, n);
    // A multiple of the micro-kernel's height that stays in the second-level cache.
    let rows = (64 * 1024 / k.max(1) / 12 * 12).clamp(12, 192);
    let mut transposed = vec![0f32; m * n];
    transposed.par_chunks_mut((rows * n).max(1)).enumerate().for_each(|(i, out)| {
        multiply(level, out, n, out.len() / n, lhs(i * rows), rhs.view(), Init::Zero);
    });
    finish(transposed, n, m, bias)
}

/// `[m, n]` to `[n, m]`, plus the bias.
fn finish(transposed: Vec<f32>, n: usize, m: usize, bias: Option<&[f32]>) -> Vec<f32> {
    let mut out = transposed;
    if n > 1 {
        let transposed = out;
        out = vec![0f32; n * m];
        out.par_chunks_mut(m.max(1)).enumerate().for_each(|(r, out)| {
            for (o, t) in out.iter_mut().zip(transposed[r..].iter().step_by(n)) {
                *o = *t;
            }
        });
    }
    if let Some(bias) = bias {
        for row in out.chunks_exact_mut(m.max(1)) {
            for (o, b) in row.iter_mut().zip(bias) {
                *o += b;
            }
        }
    }
    out
}

/// `grad^T x`: `[m, k]`.
fn weight_grad(grad: &[f32], x: &[f32], n: usize, k: usize, m: usize) -> Vec<f32> {
    let level = Level::current();
    let partials = map_chunks(n.div_ceil(GRADIENT_TASK_ROWS), |i| {
        let rows = GRADIENT_TASK_ROWS.min(n - i * GRADIENT_TASK_ROWS);
        let from = i * GRADIENT_TASK_ROWS;
        let rhs = Panels::from_rows(&x[from * k..], k, rows, k);
        let mut out = vec![0f32; m * k];
        let lhs = Lhs::columns(&grad[from * m..(from + rows) * m], m, rows);
        multiply(level, &mut out, k, m, lhs, rhs.view(), Init::Zero);
        out
    });
    sum_in_order(partials, m * k)
}

/// Sums of the columns of `grad [n, m]`.
pub(super) fn bias_grad(grad: &[f32], m: usize) -> Vec<f32> {
    let chunk = (chunk_rows(m, 64 * 1024) * m).max(1);
    let partials = grad
        .par_chunks(chunk)
        .map(|rows| {
            let mut sum = vec![0f32; m];
            for row in rows.chunks_exact(m) {
                for (s, g) in sum.iter_mut().zip(row) {
                    *s += g;
                }
            }
            sum
        })
        .collect();
    sum_in_order(partials, m)
}

/// Gradients of `x` and `weight`, each only where something asks for it: frozen weights are common.
fn backward(
    x: &Tensor,
    weight: &Tensor,
    grad: &Tensor,
) -> candle_core::Result<(Option<Tensor>, Option<Tensor>)> {
    let ((n, k), m) = (x.dims2()?, weight.dim(0)?);
    read(grad, |grad| {
        read2(x, weight, |xs, ws| {
            let dx = x.track_op().then(|| tensor(input_grad(grad, ws, n, k, m), (n, k)));
            let dw = weight.track_op().then(|| tensor(weight_grad(grad, xs, n, k, m), (m, k)));
            Ok((dx.transpose()?, dw.transpose()?))
        })
    })
}

impl CustomOp2 for Linear {
    fn name(&self) -> &'static str {
        "linear"
    }

    fn cpu_fwd(
        &self,
        s1: &CpuStorage,
        l1: &Layout,
        s2: &CpuStorage,
        l2: &Layout,
    ) -> candle_core::Result<(CpuStorage, Shape)> {
        let ((n, k), (m, _)) = (l1.shape().dims2()?, l2.shape().dims2()?);
        Ok(output(forward(slice(s1, l1)?, slice(s2, l2)?, None, n, k, m), (n, m)))
    }

    fn bwd(
        &self,
        x: &Tensor,
        weight: &Tensor,
        _res: &Tensor,
        grad: &Tensor,
    ) -> candle_core::Result<(Option<Tensor>, Option<Tensor>)> {
        backward(x, weight, grad)
    }
}

impl CustomOp3 for Linear {
    fn name(&self) -> &'static str {
        "linear-bias"
    }

    fn cpu_fwd(
        &self,
        s1: &CpuStorage,
        l1: &Layout,
        s2: &CpuStorage,
        l2: &Layout,
        s3: &CpuStorage,
        l3: &Layout,
    ) -> candle_core::Result<(CpuStorage, Shape)> {
        let ((n, k), (m, _)) = (l1.shape().dims2()?, l2.shape().dims2()?);
        let bias = Some(slice(s3, l3)?);
        Ok(output(forward(slice(s1, l1)?, slice(s2, l2)?, bias, n, k, m), (n, m)))
    }

    fn bwd(
        &self,
        x: &Tensor,
        weight: &Tensor,
        bias: &Tensor,
        _res: &Tensor,
        grad: &Tensor,
    ) -> candle_core::Result<(Option<Tensor>, Option<Tensor>, Option<Tensor>)> {
        let (dx, dw) = backward(x, weight, grad)?;
        let m = bias.dim(0)?;
        let db = match bias.track_op() && m > 0 {
            true => Some(tensor(read(grad, |grad| Ok(bias_grad(grad, m)))?, m)?),
            false => None,
        };
        Ok((dx, dw, db))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::kernels::testing::{
        at_every_level, check_gradients, close, gradients, random, same_on_any_thread_count,
    };

    fn composed(x: &Tensor, w: &Tensor, b: &Tensor) -> Result<Tensor> {
        Ok(x.matmul(&w.t()?)?.broadcast_add(b)?)
    }

    #[test]
    fn forward_and_gradients_are_the_composed_ones() {
        for (n, k, m) in [(1, 5, 3), (4, 70, 65), (7, 33, 17), (131, 20, 70), (40, 1030, 1025)] {
            let inputs = [random(&[n, k], 1), random(&[m, k], 2), random(&[m], 3)];
            let expected = composed(&inputs[0], &inputs[1], &inputs[2]).unwrap();
            let expected_grads = gradients(&inputs, |t| composed(&t[0], &t[1], &t[2]));
            at_every_level(|| {
                close(&linear(&inputs[0], &inputs[1], Some(&inputs[2])).unwrap(), &expected, 5e-5);
                let grads = gradients(&inputs, |t| linear(&t[0], &t[1], Some(&t[2])));
                for (g, e) in grads.iter().zip(&expected_grads) {
                    close(g, e, 1e-4);
                }
            });
        }
    }

    #[test]
    fn gradients_hold_without_bias() {
        check_gradients(&[random(&[3, 5], 1), random(&[4, 5], 2)], |t| linear(&t[0], &t[1], None));
    }

    #[test]
    fn views_are_read_right() {
        let (x, w) = (random(&[6, 9], 1), random(&[9, 4], 2));
        let (x, w) = (x.narrow(0, 2, 3).unwrap(), w.t().unwrap());
        close(&linear(&x, &w, None).unwrap(), &x.matmul(&w.t().unwrap()).unwrap(), 1e-5);
    }

    #[test]
    fn threads_do_not_matter() {
        let inputs = [random(&[2500, 9], 1), random(&[11, 9], 2), random(&[11], 3)];
        same_on_any_thread_count(|| gradients(&inputs, |t| linear(&t[0], &t[1], Some(&t[2]))));
    }

    #[test]
    fn shapes_that_do_not_fit_are_errors() {
        assert!(linear(&random(&[2, 3], 1), &random(&[4, 5], 1), None).is_err());
        assert!(linear(&random(&[2, 3], 1), &random(&[4, 3], 1), Some(&random(&[3], 1))).is_err());
    }
}
