//! RMS normalisation.

use crate::error::Result;
use crate::kernels::exec::{
    chunk_rows, dims2, expect_dims, on_cpu, one_kernel, output, read3, slice, sum_in_order, tensor,
};
use crate::kernels::isa::{Isa, Level, per_level};
use crate::kernels::written::written;
use candle_core::{CpuStorage, CustomOp2, D, Layout, Shape, Tensor};
use rayon::prelude::*;
use std::mem::MaybeUninit;

/// Elements of a task, about.
const CHUNK_ELEMENTS: usize = 16 * 1024;

/// `x / sqrt(mean(x^2) + eps) * weight`, the mean over each row.
///
/// `x` is `[n, d]`, `weight` `[d]`; gives `[n, d]`. Differentiable in both. Other shapes are
/// [`Error::Argument`](crate::error::Error::Argument).
pub fn rms_norm(x: &Tensor, weight: &Tensor, eps: f64) -> Result<Tensor> {
    let (_, d) = dims2("x", x)?;
    expect_dims("weight", weight, &[d])?;
    if !on_cpu(&[x, weight]) {
        return composed(x, weight, eps);
    }
    let op = RmsNormOp { eps: eps as f32 };
    Ok(x.contiguous()?.apply_op2(&weight.contiguous()?, op)?)
}

/// As one operation of candle's where no gradient is wanted, which that has not.
fn composed(x: &Tensor, weight: &Tensor, eps: f64) -> Result<Tensor> {
    if one_kernel(&[x, weight]) {
        return Ok(candle_nn::ops::rms_norm(&x.contiguous()?, &weight.contiguous()?, eps as f32)?);
    }
    let mean = x.sqr()?.mean_keepdim(D::Minus1)?;
    Ok(x.broadcast_div(&(mean + eps)?.sqrt()?)?.broadcast_mul(weight)?)
}

/// [`rms_norm`] on the CPU, as candle's custom operation.
struct RmsNormOp {
    eps: f32,
}

/// Sum of `f(i)` over a row in 16 lanes, so that the order of additions does not depend on the
/// instruction set and the loop vectorises.
#[inline(always)]
fn lane_sum(len: usize, f: impl Fn(usize) -> f32) -> f32 {
    let mut lanes = [0f32; 16];
    let whole = len / 16 * 16;
    let mut i = 0;
    while i < whole {
        for (l, lane) in lanes.iter_mut().enumerate() {
            *lane += f(i + l);
        }
        i += 16;
    }
    for (l, i) in (whole..len).enumerate() {
        lanes[l] += f(i);
    }
    lanes.iter().sum()
}

#[inline(always)]
fn forward_body<S: Isa>(_: S, out: &mut [MaybeUninit<f32>], x: &[f32], weight: &[f32], eps: f32) {
    let d = weight.len();
    for (out, x) in out.chunks_exact_mut(d).zip(x.chunks_exact(d)) {
        let scale = 1.0 / (lane_sum(d, |i| x[i] * x[i]) / d as f32 + eps).sqrt();
        for ((o, &x), &w) in out.iter_mut().zip(x).zip(weight) {
            o.write(x * scale * w);
        }
    }
}
per_level!(fn forward_chunk(out: &mut [MaybeUninit<f32>], x: &[f32], weight: &[f32], eps: f32) = forward_body);

#[inline(always)]
fn backward_body<S: Isa>(
    _: S,
    dx: &mut [f32],
    dw: &mut [f32],
    x: &[f32],
    weight: &[f32],
    grad: &[f32],
    eps: f32,
) {
    let d = weight.len();
    let rows = dx.chunks_exact_mut(d).zip(x.chunks_exact(d)).zip(grad.chunks_exact(d));
    for ((dx, x), grad) in rows {
        let scale = 1.0 / (lane_sum(d, |i| x[i] * x[i]) / d as f32 + eps).sqrt();
        let dot = lane_sum(d, |i| x[i] * grad[i] * weight[i]);
        let pull = dot * scale * scale * scale / d as f32;
        for i in 0..d {
            dx[i] = grad[i] * weight[i] * scale - x[i] * pull;
            dw[i] += grad[i] * x[i] * scale;
        }
    }
}
per_level!(fn backward_chunk(dx: &mut [f32], dw: &mut [f32], x: &[f32], weight: &[f32], grad: &[f32], eps: f32) = backward_body);

impl CustomOp2 for RmsNormOp {
    fn name(&self) -> &'static str {
        "rms-norm"
    }

    fn cpu_fwd(
        &self,
        s1: &CpuStorage,
        l1: &Layout,
        s2: &CpuStorage,
        l2: &Layout,
    ) -> candle_core::Result<(CpuStorage, Shape)> {
        let (x, weight) = (slice(s1, l1)?, slice(s2, l2)?);
        let level = Level::current();
        let chunk = (chunk_rows(weight.len(), CHUNK_ELEMENTS) * weight.len()).max(1);
        let rows = |out: &mut [MaybeUninit<f32>]| {
            out.par_chunks_mut(chunk)
                .zip(x.par_chunks(chunk))
                .for_each(|(o, x)| forward_chunk(level, o, x, weight, self.eps));
        };
        // SAFETY: `x` is whole rows of the weight's width, and each element of a row is written.
        let out = unsafe { written(x.len(), rows) };
        Ok(output(out, l1.shape().clone()))
    }

    fn bwd(
        &self,
        x: &Tensor,
        weight: &Tensor,
        _res: &Tensor,
        grad: &Tensor,
    ) -> candle_core::Result<(Option<Tensor>, Option<Tensor>)> {
        let level = Level::current();
        let (dx, dw) = read3(x, weight, grad, |x, w, g| {
            let d = w.len();
            let mut dx = vec![0f32; x.len()];
            let chunk = (chunk_rows(d, CHUNK_ELEMENTS) * d).max(1);
            let partials: Vec<Vec<f32>> = dx
                .par_chunks_mut(chunk)
                .zip(x.par_chunks(chunk).zip(g.par_chunks(chunk)))
                .map(|(dx, (x, g))| {
                    let mut dw = vec![0f32; d];
                    backward_chunk(level, dx, &mut dw, x, w, g, self.eps);
                    dw
                })
                .collect();
            Ok((dx, sum_in_order(partials, d)))
        })?;
        Ok((Some(tensor(dx, x.shape().clone())?), Some(tensor(dw, weight.shape().clone())?)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::kernels::testing::{
        at_every_level, check_gradients, close, gradients, on_device, random, same_on_any_thread_count,
    };

    #[test]
    fn forward_is_candles() {
        for (n, d) in [(1, 1), (3, 37), (700, 48)] {
            let (x, w) = (random(&[n, d], 1), random(&[d], 2));
            let expected = candle_nn::ops::rms_norm(&x, &w, 1e-6).unwrap();
            at_every_level(|| close(&rms_norm(&x, &w, 1e-6).unwrap(), &expected, 1e-5));
        }
    }

    #[test]
    fn the_composed_forms_are_the_kernel() {
        let (x, w) = (random(&[70, 48], 1), random(&[48], 2));
        let expected = rms_norm(&x, &w, 1e-6).unwrap();
        let [there, weight] = on_device([&x, &w]);
        let tracked = candle_core::Var::from_tensor(&there).unwrap();
        for form in [&there, tracked.as_tensor()] {
            close(&composed(form, &weight, 1e-6).unwrap(), &expected, 1e-5);
        }
        let rows = x.narrow(0, 0, 0).unwrap();
        assert_eq!(composed(&rows, &w, 1e-6).unwrap().dims(), [0, 48]);
    }

    #[test]
    fn gradients_hold() {
        at_every_level(|| {
            check_gradients(&[random(&[3, 19], 3), random(&[19], 4)], |t| rms_norm(&t[0], &t[1], 1e-5));
        });
    }

    #[test]
    fn threads_do_not_matter() {
        let inputs = [random(&[2000, 33], 5), random(&[33], 6)];
        same_on_any_thread_count(|| gradients(&inputs, |t| rms_norm(&t[0], &t[1], 1e-5)));
    }

    #[test]
    fn a_wrong_weight_is_an_error() {
        assert!(rms_norm(&random(&[2, 3], 1), &random(&[4], 1), 1e-6).is_err());
    }
}
