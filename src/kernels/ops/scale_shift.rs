//! Scale and shift per channel with LeakyReLU, and batch normalisation by its own statistics.

use crate::error::{Error, Result};
use crate::kernels::exec::{chunk_rows, dims4, expect_dims, on_cpu, output, read, read3, slice, tensor};
use crate::kernels::isa::{Isa, Level, per_level};
use crate::kernels::simd::madd;
use candle_core::{CpuStorage, CustomOp3, Layout, Shape, Tensor};
use rayon::prelude::*;

/// Elements of a task, about.
const CHUNK_ELEMENTS: usize = 32 * 1024;
/// Pixels whose channels are worked on as one vector.
const GROUP_PIXELS: usize = 16;

/// `leaky(x * scale + shift)` per channel, where `leaky(z)` = z for z > 0, else `slope` z.
///
/// `x` is `[b, h, w, c]`, `scale` and `shift` `[c]`; gives `[b, h, w, c]`. Differentiable in all. A
/// batch normalisation with known statistics is `scale = gamma / sqrt(var + eps)`, `shift = beta -
/// mean * scale`. Shapes that do not fit are [`Error::Argument`].
pub fn affine_act(x: &Tensor, scale: &Tensor, shift: &Tensor, slope: f64) -> Result<Tensor> {
    let (_, _, _, c) = dims4("x", x)?;
    expect_dims("scale", scale, &[c])?;
    expect_dims("shift", shift, &[c])?;
    if !on_cpu(&[x, scale, shift]) || x.elem_count() == 0 {
        return leaky(&x.broadcast_mul(scale)?.broadcast_add(shift)?, slope);
    }
    let op = ScaleShift { statistics: None, slope: slope as f32 };
    Ok(x.contiguous()?.apply_op3(&scale.contiguous()?, &shift.contiguous()?, op)?)
}

/// Batch normalisation by the statistics of `x` itself over b, h and w (Ioffe and Szegedy, arXiv
/// 1502.03167), then LeakyReLU: for training.
///
/// `x` is `[b, h, w, c]`, `gamma` and `beta` `[c]`; gives the result `[b, h, w, c]`, and the mean and
/// the biased variance of each channel, for running averages. Differentiable in all, through the
/// statistics too. Shapes that do not fit, and an `x` without elements, are [`Error::Argument`].
pub fn batch_norm_act(
    x: &Tensor,
    gamma: &Tensor,
    beta: &Tensor,
    eps: f64,
    slope: f64,
) -> Result<(Tensor, Vec<f32>, Vec<f32>)> {
    let (_, _, _, c) = dims4("x", x)?;
    expect_dims("gamma", gamma, &[c])?;
    expect_dims("beta", beta, &[c])?;
    if x.elem_count() == 0 {
        return Err(Error::argument("x", format!("shape {:?}", x.dims()), "at least one element"));
    }
    if !on_cpu(&[x, gamma, beta]) {
        return batch_norm_composed(x, gamma, beta, eps, slope);
    }
    let x = x.contiguous()?;
    let (mean, var) = read(&x, |x| Ok(statistics(x, c)))?;
    let inverse = var.iter().map(|v| (1.0 / (*v as f64 + eps).sqrt()) as f32).collect();
    let op = ScaleShift { statistics: Some((mean.clone(), inverse)), slope: slope as f32 };
    let out = x.apply_op3(&gamma.contiguous()?, &beta.contiguous()?, op)?;
    Ok((out, mean, var))
}

fn leaky(z: &Tensor, slope: f64) -> Result<Tensor> {
    Ok((z.relu()? - (z.neg()?.relu()? * slope)?)?)
}

fn batch_norm_composed(
    x: &Tensor,
    gamma: &Tensor,
    beta: &Tensor,
    eps: f64,
    slope: f64,
) -> Result<(Tensor, Vec<f32>, Vec<f32>)> {
    let rows = x.flatten_to(2)?;
    let mean = rows.mean(0)?;
    let var = rows.broadcast_sub(&mean)?.sqr()?.mean(0)?;
    let scale = (gamma / (&var + eps)?.sqrt()?)?;
    let shift = (beta - (&mean * &scale)?)?;
    let out = leaky(&x.broadcast_mul(&scale)?.broadcast_add(&shift)?, slope)?;
    let list = |t: &Tensor| t.to_dtype(candle_core::DType::F32)?.to_vec1::<f32>();
    Ok((out, list(&mean)?, list(&var)?))
}

/// With `statistics` (mean, 1 / standard deviation) the tensors are gamma and beta of a batch
/// normalisation, without they are scale and shift.
struct ScaleShift {
    statistics: Option<(Vec<f32>, Vec<f32>)>,
    slope: f32,
}

/// `row` repeated so that every vector of `GROUP_PIXELS` pixels meets its channels in place.
fn repeated(row: &[f32]) -> Vec<f32> {
    row.repeat(GROUP_PIXELS)
}

/// Folds sums over repeated channels into sums over channels.
fn folded(sums: &[Vec<f32>], c: usize) -> Vec<f64> {
    let mut total = vec![0f64; c];
    for sums in sums {
        for (i, s) in sums.iter().enumerate() {
            total[i % c] += *s as f64;
        }
    }
    total
}

#[inline(always)]
fn apply_body<S: Isa>(isa: S, out: &mut [f32], x: &[f32], scale: &[f32], shift: &[f32], slope: f32) {
    let width = scale.len();
    for (out, x) in out.chunks_mut(width).zip(x.chunks(width)) {
        for (((o, &x), &a), &b) in out.iter_mut().zip(x).zip(scale).zip(shift) {
            let z = madd(isa, x, a, b);
            *o = if z > 0.0 { z } else { z * slope };
        }
    }
}
per_level!(fn apply_chunk(out: &mut [f32], x: &[f32], scale: &[f32], shift: &[f32], slope: f32) = apply_body);

/// Adds to `sum` the deviations from `centre`, to `squares` their squares.
#[inline(always)]
fn moments_body<S: Isa>(isa: S, x: &[f32], centre: &[f32], sum: &mut [f32], squares: &mut [f32]) {
    for x in x.chunks(centre.len()) {
        for (((&x, &m), s), q) in x.iter().zip(centre).zip(&mut *sum).zip(&mut *squares) {
            let d = x - m;
            *s += d;
            *q = madd(isa, d, d, *q);
        }
    }
}
per_level!(fn moments_chunk(x: &[f32], centre: &[f32], sum: &mut [f32], squares: &mut [f32]) = moments_body);

/// Mean and biased variance per channel, in one pass: squares about the first pixels' mean, which
/// is near enough to the true one to leave nothing to cancel.
fn statistics(x: &[f32], c: usize) -> (Vec<f32>, Vec<f32>) {
    let level = Level::current();
    let first = &x[..x.len().min(256 * c)];
    let mut centre = vec![0f32; c];
    for pixel in first.chunks_exact(c) {
        for (m, x) in centre.iter_mut().zip(pixel) {
            *m += x;
        }
    }
    centre.iter_mut().for_each(|m| *m /= (first.len() / c) as f32);
    let wide = repeated(&centre);
    let chunk = chunk_rows(wide.len(), CHUNK_ELEMENTS) * wide.len();
    let (sums, squares): (Vec<_>, Vec<_>) = x
        .par_chunks(chunk)
        .map(|x| {
            let (mut sum, mut squares) = (vec![0f32; wide.len()], vec![0f32; wide.len()]);
            moments_chunk(level, x, &wide, &mut sum, &mut squares);
            (sum, squares)
        })
        .unzip();
    let n = (x.len() / c) as f64;
    let (sums, squares) = (folded(&sums, c), folded(&squares, c));
    let mean = centre.iter().zip(&sums).map(|(m, s)| (*m as f64 + s / n) as f32).collect();
    let var = sums.iter().zip(&squares).map(|(s, q)| ((q / n - (s / n).powi(2)).max(0.0)) as f32).collect();
    (mean, var)
}

/// Sums of dz and of dz * x, where dz is the gradient before the activation.
#[inline(always)]
fn sums_body<S: Isa>(
    isa: S,
    x: &[f32],
    grad: &[f32],
    [scale, shift]: [&[f32]; 2],
    slope: f32,
    sum: &mut [f32],
    dot: &mut [f32],
) {
    let width = scale.len();
    for (x, grad) in x.chunks(width).zip(grad.chunks(width)) {
        let sums = sum.iter_mut().zip(dot.iter_mut());
        for ((((&x, &g), &a), &b), (s, d)) in x.iter().zip(grad).zip(scale).zip(shift).zip(sums) {
            let dz = if madd(isa, x, a, b) > 0.0 { g } else { g * slope };
            *s += dz;
            *d = madd(isa, dz, x, *d);
        }
    }
}
per_level!(fn sums_chunk(x: &[f32], grad: &[f32], channels: [&[f32]; 2], slope: f32, sum: &mut [f32], dot: &mut [f32]) = sums_body);

/// `dx = dz * scale + x * by_x + constant`; `channels` are scale, shift, by_x and constant.
#[inline(always)]
fn dx_body<S: Isa>(isa: S, dx: &mut [f32], x: &[f32], grad: &[f32], channels: [&[f32]; 4], slope: f32) {
    let [scale, shift, by_x, constant] = channels;
    let width = scale.len();
    for ((dx, x), grad) in dx.chunks_mut(width).zip(x.chunks(width)).zip(grad.chunks(width)) {
        let channels = scale.iter().zip(shift).zip(by_x.iter().zip(constant));
        for (((dx, &x), &g), ((&a, &b), (&p, &q))) in dx.iter_mut().zip(x).zip(grad).zip(channels) {
            let dz = if madd(isa, x, a, b) > 0.0 { g } else { g * slope };
            *dx = madd(isa, dz, a, madd(isa, x, p, q));
        }
    }
}
per_level!(fn dx_chunk(dx: &mut [f32], x: &[f32], grad: &[f32], channels: [&[f32]; 4], slope: f32) = dx_body);

impl ScaleShift {
    /// Scale and shift that the tensors' values come to.
    fn fold(&self, first: &[f32], second: &[f32]) -> (Vec<f32>, Vec<f32>) {
        let Some((mean, inverse)) = &self.statistics else {
            return (first.to_vec(), second.to_vec());
        };
        let scale: Vec<f32> = first.iter().zip(inverse).map(|(g, i)| g * i).collect();
        let shift = second.iter().zip(mean).zip(&scale).map(|((b, m), s)| b - m * s).collect();
        (scale, shift)
    }

    /// Gradients of x, of the scale or gamma, and of the shift or beta.
    fn backward(&self, x: &[f32], first: &[f32], second: &[f32], grad: &[f32]) -> [Vec<f32>; 3] {
        let level = Level::current();
        let c = first.len();
        let (scale, shift) = self.fold(first, second);
        let (a, b) = (repeated(&scale), repeated(&shift));
        let chunk = chunk_rows(a.len(), CHUNK_ELEMENTS) * a.len();
        let (sums, dots): (Vec<_>, Vec<_>) = x
            .par_chunks(chunk)
            .zip(grad.par_chunks(chunk))
            .map(|(x, grad)| {
                let (mut sum, mut dot) = (vec![0f32; a.len()], vec![0f32; a.len()]);
                sums_chunk(level, x, grad, [&a, &b], self.slope, &mut sum, &mut dot);
                (sum, dot)
            })
            .unzip();
        let (sums, dots) = (folded(&sums, c), folded(&dots, c));
        let n = (x.len() / c) as f64;
        let (mut by_x, mut constant) = (vec![0f32; c], vec![0f32; c]);
        let mut d_first = vec![0f32; c];
        for i in 0..c {
            d_first[i] = match &self.statistics {
                None => dots[i] as f32,
                Some((mean, inverse)) => {
                    // The paper's formula, with (x - mean) * inverse written out.
                    let (mean, inverse) = (mean[i] as f64, inverse[i] as f64);
                    let d_gamma = (dots[i] - mean * sums[i]) * inverse;
                    let pull = scale[i] as f64 * inverse * d_gamma / n;
                    by_x[i] = -pull as f32;
                    constant[i] = (pull * mean - scale[i] as f64 * sums[i] / n) as f32;
                    d_gamma as f32
                }
            };
        }
        let (p, q) = (repeated(&by_x), repeated(&constant));
        let mut dx = vec![0f32; x.len()];
        dx.par_chunks_mut(chunk)
            .zip(x.par_chunks(chunk).zip(grad.par_chunks(chunk)))
            .for_each(|(dx, (x, grad))| dx_chunk(level, dx, x, grad, [&a, &b, &p, &q], self.slope));
        [dx, d_first, sums.iter().map(|s| *s as f32).collect()]
    }
}

impl CustomOp3 for ScaleShift {
    fn name(&self) -> &'static str {
        "scale-shift-act"
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
        let (x, level) = (slice(s1, l1)?, Level::current());
        let (scale, shift) = self.fold(slice(s2, l2)?, slice(s3, l3)?);
        let (scale, shift) = (repeated(&scale), repeated(&shift));
        let chunk = chunk_rows(scale.len(), CHUNK_ELEMENTS) * scale.len();
        let mut out = vec![0f32; x.len()];
        out.par_chunks_mut(chunk)
            .zip(x.par_chunks(chunk))
            .for_each(|(o, x)| apply_chunk(level, o, x, &scale, &shift, self.slope));
        Ok(output(out, l1.shape().clone()))
    }

    fn bwd(
        &self,
        x: &Tensor,
        first: &Tensor,
        second: &Tensor,
        _res: &Tensor,
        grad: &Tensor,
    ) -> candle_core::Result<(Option<Tensor>, Option<Tensor>, Option<Tensor>)> {
        let [dx, d_first, d_second] = read(grad, |grad| {
            read3(x, first, second, |x, first, second| Ok(self.backward(x, first, second, grad)))
        })?;
        Ok((
            Some(tensor(dx, x.shape().clone())?),
            Some(tensor(d_first, first.shape().clone())?),
            Some(tensor(d_second, second.shape().clone())?),
        ))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::kernels::testing::{
        at_every_level, check_gradients, close, gradients, random, same_on_any_thread_count,
    };

    fn inputs(dims: &[usize]) -> [Tensor; 3] {
        let c = dims[3];
        // A mean far from zero: what a careless variance gets wrong.
        let x = random(dims, 1).affine(0.5, 3.0).unwrap();
        [x, random(&[c], 2), random(&[c], 3)]
    }

    #[test]
    fn batch_norm_is_the_composed_one() {
        for dims in [[1, 1, 2, 1], [2, 5, 7, 3], [3, 17, 20, 16]] {
            let t = inputs(&dims);
            let (expected, mean, var) = batch_norm_composed(&t[0], &t[1], &t[2], 1e-5, 0.1).unwrap();
            let expected_grads =
                gradients(&t, |t| Ok(batch_norm_composed(&t[0], &t[1], &t[2], 1e-5, 0.1)?.0));
            at_every_level(|| {
                let (out, m, v) = batch_norm_act(&t[0], &t[1], &t[2], 1e-5, 0.1).unwrap();
                close(&out, &expected, 1e-4);
                for i in 0..dims[3] {
                    assert!((m[i] - mean[i]).abs() < 1e-5 && (v[i] - var[i]).abs() < 1e-5);
                }
                let grads = gradients(&t, |t| Ok(batch_norm_act(&t[0], &t[1], &t[2], 1e-5, 0.1)?.0));
                for (g, e) in grads.iter().zip(&expected_grads) {
                    close(g, e, 3e-3);
                }
            });
        }
    }

    #[test]
    fn gradients_hold() {
        // Slope 1: differences across the kink say nothing.
        let t = inputs(&[2, 2, 3, 2]);
        at_every_level(|| {
            check_gradients(&t, |t| Ok(batch_norm_act(&t[0], &t[1], &t[2], 1e-3, 1.0)?.0));
            check_gradients(&t, |t| affine_act(&t[0], &t[1], &t[2], 1.0));
        });
    }

    #[test]
    fn affine_is_the_composed_one() {
        let t = [random(&[2, 9, 8, 5], 1), random(&[5], 2), random(&[5], 3)];
        let composed = |t: &[Tensor]| leaky(&t[0].broadcast_mul(&t[1])?.broadcast_add(&t[2])?, 0.2);
        let expected = gradients(&t, composed);
        at_every_level(|| {
            close(&affine_act(&t[0], &t[1], &t[2], 0.2).unwrap(), &composed(&t).unwrap(), 1e-6);
            let grads = gradients(&t, |t| affine_act(&t[0], &t[1], &t[2], 0.2));
            for (g, e) in grads.iter().zip(&expected) {
                close(g, e, 1e-5);
            }
        });
    }

    #[test]
    fn threads_do_not_matter() {
        let t = inputs(&[2, 60, 70, 16]);
        same_on_any_thread_count(|| gradients(&t, |t| Ok(batch_norm_act(&t[0], &t[1], &t[2], 1e-5, 0.1)?.0)));
    }

    #[test]
    fn an_empty_batch_and_a_wrong_gamma_are_errors() {
        let t = inputs(&[1, 1, 1, 2]);
        assert!(batch_norm_act(&random(&[0, 1, 1, 2], 1), &t[1], &t[2], 1e-5, 0.1).is_err());
        assert!(batch_norm_act(&t[0], &random(&[3], 1), &t[2], 1e-5, 0.1).is_err());
    }
}
