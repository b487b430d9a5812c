//! SwiGLU and GELU.

use crate::error::Result;
use crate::kernels::exec::{on_cpu, output, read2, read3, same_shape, slice, tensor};
use crate::kernels::isa::{Isa, Level, per_level};
use crate::kernels::simd::{erf, madd, sigmoid};
use crate::kernels::written::written;
use candle_core::{CpuStorage, CustomOp1, CustomOp2, Layout, Shape, Tensor};
use rayon::prelude::*;
use std::mem::MaybeUninit;

/// Elements of a task, about.
const CHUNK_ELEMENTS: usize = 16 * 1024;

/// `silu(gate) * up`, element by element, where `silu(z) = z / (1 + e^-z)`.
///
/// Both tensors have the same shape (any). Differentiable in both. Shapes that differ are
/// [`Error::Argument`](crate::error::Error::Argument).
pub fn swiglu(gate: &Tensor, up: &Tensor) -> Result<Tensor> {
    same_shape("up", gate, up)?;
    if !on_cpu(&[gate, up]) {
        return Ok((gate.silu()? * up)?);
    }
    Ok(gate.contiguous()?.apply_op2(&up.contiguous()?, SwiGlu)?)
}

/// `x (1 + erf(x / sqrt 2)) / 2`, element by element: the exact GELU, not its tanh form.
///
/// Any shape; differentiable.
pub fn gelu_erf(x: &Tensor) -> Result<Tensor> {
    if !on_cpu(&[x]) {
        return Ok(x.gelu_erf()?);
    }
    Ok(x.contiguous()?.apply_op1(Gelu)?)
}

struct SwiGlu;

#[inline(always)]
fn swiglu_body<S: Isa>(isa: S, out: &mut [MaybeUninit<f32>], gate: &[f32], up: &[f32]) {
    for ((o, &g), &u) in out.iter_mut().zip(gate).zip(up) {
        o.write(g * sigmoid(isa, g) * u);
    }
}
per_level!(fn swiglu_chunk(out: &mut [MaybeUninit<f32>], gate: &[f32], up: &[f32]) = swiglu_body);

#[inline(always)]
fn swiglu_grad_body<S: Isa>(
    isa: S,
    d_gate: &mut [f32],
    d_up: &mut [f32],
    gate: &[f32],
    up: &[f32],
    grad: &[f32],
) {
    let inputs = gate.iter().zip(up).zip(grad);
    for ((dg, du), ((&g, &u), &d)) in d_gate.iter_mut().zip(d_up).zip(inputs) {
        let s = sigmoid(isa, g);
        let silu = g * s;
        *du = d * silu;
        *dg = d * u * madd(isa, silu, 1.0 - s, s);
    }
}
per_level!(fn swiglu_grad_chunk(d_gate: &mut [f32], d_up: &mut [f32], gate: &[f32], up: &[f32], grad: &[f32]) = swiglu_grad_body);

impl CustomOp2 for SwiGlu {
    fn name(&self) -> &'static str {
        "swiglu"
    }

    fn cpu_fwd(
        &self,
        s1: &CpuStorage,
        l1: &Layout,
        s2: &CpuStorage,
        l2: &Layout,
    ) -> candle_core::Result<(CpuStorage, Shape)> {
        let (gate, up) = (slice(s1, l1)?, slice(s2, l2)?);
        let level = Level::current();
        let inputs = gate.par_chunks(CHUNK_ELEMENTS).zip(up.par_chunks(CHUNK_ELEMENTS));
        let products = |out: &mut [MaybeUninit<f32>]| {
            out.par_chunks_mut(CHUNK_ELEMENTS)
                .zip(inputs)
                .for_each(|(o, (g, u))| swiglu_chunk(level, o, g, u));
        };
        // SAFETY: both inputs have the same length, so that each element gets its product.
        let out = unsafe { written(gate.len(), products) };
        Ok(output(out, l1.shape().clone()))
    }

    fn bwd(
        &self,
        gate: &Tensor,
        up: &Tensor,
        _res: &Tensor,
        grad: &Tensor,
    ) -> candle_core::Result<(Option<Tensor>, Option<Tensor>)> {
        let level = Level::current();
        let shape = gate.shape().clone();
        let (dg, du) = read3(gate, up, grad, |g, u, d| {
            let mut dg = vec![0f32; g.len()];
            let mut du = vec![0f32; g.len()];
            let inputs = g
                .par_chunks(CHUNK_ELEMENTS)
                .zip(u.par_chunks(CHUNK_ELEMENTS))
                .zip(d.par_chunks(CHUNK_ELEMENTS));
            dg.par_chunks_mut(CHUNK_ELEMENTS)
                .zip(du.par_chunks_mut(CHUNK_ELEMENTS))
                .zip(inputs)
                .for_each(|((dg, du), ((g, u), d))| swiglu_grad_chunk(level, dg, du, g, u, d));
            Ok((dg, du))
        })?;
        Ok((Some(tensor(dg, shape.clone())?), Some(tensor(du, shape)?)))
    }
}

struct Gelu;

#[inline(always)]
fn gelu_body<S: Isa>(isa: S, out: &mut [MaybeUninit<f32>], x: &[f32]) {
    for (o, &x) in out.iter_mut().zip(x) {
        let (e, _) = erf(isa, x * std::f32::consts::FRAC_1_SQRT_2);
        o.write(0.5 * x * (1.0 + e));
    }
}
per_level!(fn gelu_chunk(out: &mut [MaybeUninit<f32>], x: &[f32]) = gelu_body);

#[inline(always)]
fn gelu_grad_body<S: Isa>(isa: S, dx: &mut [f32], x: &[f32], grad: &[f32]) {
    // 1 / sqrt(2 pi): the height of the normal density.
    const DENSITY_AT_ZERO: f32 = 0.398_942_3;
    for ((dx, &x), &d) in dx.iter_mut().zip(x).zip(grad) {
        let (e, gauss) = erf(isa, x * std::f32::consts::FRAC_1_SQRT_2);
        *dx = d * madd(isa, x * DENSITY_AT_ZERO, gauss, 0.5 * (1.0 + e));
    }
}
per_level!(fn gelu_grad_chunk(dx: &mut [f32], x: &[f32], grad: &[f32]) = gelu_grad_body);

impl CustomOp1 for Gelu {
    fn name(&self) -> &'static str {
        "gelu-erf"
    }

    fn cpu_fwd(&self, s: &CpuStorage, l: &Layout) -> candle_core::Result<(CpuStorage, Shape)> {
        let x = slice(s, l)?;
        let level = Level::current();
        let values = |out: &mut [MaybeUninit<f32>]| {
            out.par_chunks_mut(CHUNK_ELEMENTS)
                .zip(x.par_chunks(CHUNK_ELEMENTS))
                .for_each(|(o, x)| gelu_chunk(level, o, x));
        };
        // SAFETY: each element gets its value.
        let out = unsafe { written(x.len(), values) };
        Ok(output(out, l.shape().clone()))
    }

    fn bwd(&self, x: &Tensor, _res: &Tensor, grad: &Tensor) -> candle_core::Result<Option<Tensor>> {
        let level = Level::current();
        let shape = x.shape().clone();
        let dx = read2(x, grad, |x, d| {
            let mut dx = vec![0f32; x.len()];
            dx.par_chunks_mut(CHUNK_ELEMENTS)
                .zip(x.par_chunks(CHUNK_ELEMENTS).zip(d.par_chunks(CHUNK_ELEMENTS)))
                .for_each(|(dx, (x, d))| gelu_grad_chunk(level, dx, x, d));
            Ok(dx)
        })?;
        Ok(Some(tensor(dx, shape)?))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::kernels::testing::{at_every_level, check_gradients, close, random};

    #[test]
    fn swiglu_is_silu_times_up() {
        let (g, u) = (random(&[5, 37], 1), random(&[5, 37], 2));
        let expected = (g.silu().unwrap() * &u).unwrap();
        at_every_level(|| close(&swiglu(&g, &u).unwrap(), &expected, 1e-6));
    }

    #[test]
    fn swiglu_gradients() {
        at_every_level(|| {
            check_gradients(&[random(&[3, 7], 3), random(&[3, 7], 4)], |t| swiglu(&t[0], &t[1]));
        });
    }

    #[test]
    fn swiglu_rejects_shapes_that_differ() {
        assert!(swiglu(&random(&[2, 3], 1), &random(&[3, 2], 1)).is_err());
    }

    #[test]
    fn gelu_is_candles_and_its_gradient_holds() {
        let x = random(&[3, 41], 5).affine(3.0, 0.0).unwrap();
        at_every_level(|| {
            close(&gelu_erf(&x).unwrap(), &x.gelu_erf().unwrap(), 2e-6);
            check_gradients(&[random(&[3, 5], 6)], |t| gelu_erf(&t[0]));
        });
    }
}
