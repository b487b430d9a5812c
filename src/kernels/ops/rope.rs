//! Rotary position embedding.

use crate::error::{Error, Result};
use crate::kernels::exec::{chunk_rows, dims2, expect_dims, on_cpu, one_kernel, output, read2, slice};
use crate::kernels::isa::{Isa, Level, per_level};
use crate::kernels::simd::madd;
use crate::kernels::written::written;
use candle_core::{CpuStorage, CustomOp1, Layout, Shape, Tensor};
use rayon::prelude::*;
use std::mem::MaybeUninit;

/// Elements of a task, about.
const CHUNK_ELEMENTS: usize = 16 * 1024;

/// Turns each head's pairs `(x[i], x[i + hd/2])` by the angle whose cosine and sine are given.
///
/// `x` is `[n, heads * hd]`, `cos` and `sin` `[n, hd/2]`, the same for all heads; gives `[n, heads *
/// hd]`. Differentiable in `x`; `cos` and `sin` are constants. Shapes that do not fit are
/// [`Error::Argument`].
pub fn rope(x: &Tensor, cos: &Tensor, sin: &Tensor, heads: usize) -> Result<Tensor> {
    let (n, width) = dims2("x", x)?;
    if heads == 0 || width % (2 * heads) != 0 {
        return Err(Error::argument("heads", heads, format!("a divisor of {width} / 2")));
    }
    let half = width / heads / 2;
    expect_dims("cos", cos, &[n, half])?;
    expect_dims("sin", sin, &[n, half])?;
    if !on_cpu(&[x, cos, sin]) {
        return composed(x, cos, sin, heads);
    }
    let op = Rope { cos: cos.detach().contiguous()?, sin: sin.detach().contiguous()?, heads, back: false };
    Ok(x.contiguous()?.apply_op1(op)?)
}

/// As one operation of candle's where no gradient is wanted, which that has not.
fn composed(x: &Tensor, cos: &Tensor, sin: &Tensor, heads: usize) -> Result<Tensor> {
    let (n, half) = dims2("cos", cos)?;
    if one_kernel(&[x, cos, sin]) {
        let x = x.contiguous()?.reshape((1, n, heads, 2 * half))?;
        let turned = candle_nn::rotary_emb::rope_thd(&x, &cos.contiguous()?, &sin.contiguous()?)?;
        return Ok(turned.reshape((n, heads * 2 * half))?);
    }
    let x = x.reshape((n, heads, 2 * half))?;
    let (cos, sin) = (cos.unsqueeze(1)?, sin.unsqueeze(1)?);
    let (a, b) = (x.narrow(2, 0, half)?, x.narrow(2, half, half)?);
    let first = (a.broadcast_mul(&cos)? - b.broadcast_mul(&sin)?)?;
    let second = (b.broadcast_mul(&cos)? + a.broadcast_mul(&sin)?)?;
    Ok(Tensor::cat(&[first, second], 2)?.reshape((n, heads * 2 * half))?)
}

struct Rope {
    cos: Tensor,
    sin: Tensor,
    heads: usize,
    /// Turn the other way: the transpose, which is the backward pass.
    back: bool,
}

#[inline(always)]
fn rope_body<S: Isa>(
    isa: S,
    out: &mut [MaybeUninit<f32>],
    x: &[f32],
    [cos, sin]: [&[f32]; 2],
    half: usize,
    heads: usize,
    sign: f32,
) {
    let width = 2 * half * heads;
    let angles = cos.chunks_exact(half).zip(sin.chunks_exact(half));
    for ((out, x), (cos, sin)) in out.chunks_exact_mut(width).zip(x.chunks_exact(width)).zip(angles) {
        for (out, x) in out.chunks_exact_mut(2 * half).zip(x.chunks_exact(2 * half)) {
            let (first, second) = out.split_at_mut(half);
            let (a, b) = x.split_at(half);
            for i in 0..half {
                let s = sign * sin[i];
                first[i].write(madd(isa, a[i], cos[i], -(b[i] * s)));
                second[i].write(madd(isa, b[i], cos[i], a[i] * s));
            }
        }
    }
}
per_level!(fn rope_chunk(out: &mut [MaybeUninit<f32>], x: &[f32], angles: [&[f32]; 2], half: usize, heads: usize, sign: f32) = rope_body);

impl CustomOp1 for Rope {
    fn name(&self) -> &'static str {
        "rope"
    }

    fn cpu_fwd(&self, s: &CpuStorage, l: &Layout) -> candle_core::Result<(CpuStorage, Shape)> {
        let x = slice(s, l)?;
        let level = Level::current();
        let (n, half) = self.cos.dims2()?;
        let width = 2 * half * self.heads;
        if n * half == 0 {
            return Ok(output(Vec::new(), l.shape().clone()));
        }
        let rows = chunk_rows(width, CHUNK_ELEMENTS);
        let sign = if self.back { -1.0 } else { 1.0 };
        let out = read2(&self.cos, &self.sin, |cos, sin| {
            let angles = cos.par_chunks(rows * half).zip(sin.par_chunks(rows * half));
            let inputs = x.par_chunks(rows * width).zip(angles);
            let turned = |out: &mut [MaybeUninit<f32>]| {
                out.par_chunks_mut(rows * width).zip(inputs).for_each(|(o, (x, (cos, sin)))| {
                    rope_chunk(level, o, x, [cos, sin], half, self.heads, sign);
                });
            };
            // SAFETY: there are as many angles as rows of `x`; of each row both halves of each head are written.
            Ok(unsafe { written(x.len(), turned) })
        })?;
        Ok(output(out, l.shape().clone()))
    }

    fn bwd(&self, _x: &Tensor, _res: &Tensor, grad: &Tensor) -> candle_core::Result<Option<Tensor>> {
        let op = Rope { cos: self.cos.clone(), sin: self.sin.clone(), heads: self.heads, back: !self.back };
        Ok(Some(grad.contiguous()?.apply_op1_no_bwd(&op)?))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::kernels::testing::{at_every_level, check_gradients, close, on_device, random};

    #[test]
    fn forward_is_the_composed_form() {
        for (n, heads, hd) in [(1, 1, 2), (5, 3, 14), (300, 2, 64)] {
            let angle = random(&[n, hd / 2], 1);
            let (cos, sin) = (angle.cos().unwrap(), angle.sin().unwrap());
            let x = random(&[n, heads * hd], 2);
            let [there, c, s] = on_device([&x, &cos, &sin]);
            let tracked = candle_core::Var::from_tensor(&there).unwrap();
            for form in [&there, tracked.as_tensor()] {
                let expected = composed(form, &c, &s, heads).unwrap();
                at_every_level(|| close(&rope(&x, &cos, &sin, heads).unwrap(), &expected, 1e-6));
            }
        }
    }

    #[test]
    fn a_quarter_turn_moves_the_first_half_to_the_second() {
        let x = Tensor::new(&[[1f32, 2., 3., 4.]], &candle_core::Device::Cpu).unwrap();
        let (cos, sin) = (
            x.narrow(1, 0, 2).unwrap().zeros_like().unwrap(),
            x.narrow(1, 0, 2).unwrap().ones_like().unwrap(),
        );
        let turned = rope(&x, &cos, &sin, 1).unwrap();
        assert_eq!(turned.to_vec2::<f32>().unwrap(), [[-3., -4., 1., 2.]]);
    }

    #[test]
    fn gradients_hold() {
        let angle = random(&[2, 3], 1);
        let (cos, sin) = (angle.cos().unwrap(), angle.sin().unwrap());
        at_every_level(|| check_gradients(&[random(&[2, 12], 3)], |t| rope(&t[0], &cos, &sin, 2)));
    }
}
