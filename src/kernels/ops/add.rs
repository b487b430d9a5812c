//! The sum of two tensors: residual connections.

use crate::error::Result;
use crate::kernels::exec::{on_cpu, output, same_shape, slice};
use crate::kernels::written::written;
use candle_core::{CpuStorage, CustomOp2, Layout, Shape, Tensor};
use rayon::prelude::*;
use std::mem::MaybeUninit;

/// Elements of a task, about.
const CHUNK_ELEMENTS: usize = 16 * 1024;

/// `a + b`, element by element.
///
/// Both tensors have the same shape (any). Differentiable in both. Shapes that differ are
/// [`Error::Argument`](crate::error::Error::Argument).
///
/// candle's own sum waits in a second thread pool, whose threads spin while ours compute.
pub fn add(a: &Tensor, b: &Tensor) -> Result<Tensor> {
    same_shape("b", a, b)?;
    if !on_cpu(&[a, b]) {
        return Ok((a + b)?);
    }
    Ok(a.contiguous()?.apply_op2(&b.contiguous()?, Add)?)
}

struct Add;

impl CustomOp2 for Add {
    fn name(&self) -> &'static str {
        "sdim-add"
    }

    fn cpu_fwd(
        &self,
        s1: &CpuStorage,
        l1: &Layout,
        s2: &CpuStorage,
        l2: &Layout,
    ) -> candle_core::Result<(CpuStorage, Shape)> {
        let (a, b) = (slice(s1, l1)?, slice(s2, l2)?);
        let inputs = a.par_chunks(CHUNK_ELEMENTS).zip(b.par_chunks(CHUNK_ELEMENTS));
        let sums = |out: &mut [MaybeUninit<f32>]| {
            out.par_chunks_mut(CHUNK_ELEMENTS).zip(inputs).for_each(|(out, (a, b))| {
                for ((o, a), b) in out.iter_mut().zip(a).zip(b) {
                    o.write(a + b);
                }
            });
        };
        // SAFETY: `a` and `b` have the same length, so that each element gets its sum.
        let out = unsafe { written(a.len(), sums) };
        Ok(output(out, l1.shape().clone()))
    }

    fn bwd(
        &self,
        _a: &Tensor,
        _b: &Tensor,
        _res: &Tensor,
        grad: &Tensor,
    ) -> candle_core::Result<(Option<Tensor>, Option<Tensor>)> {
        Ok((Some(grad.clone()), Some(grad.clone())))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::kernels::testing::{check_gradients, close, random};

    #[test]
    fn it_is_the_sum_and_so_are_its_gradients() {
        let (a, b) = (random(&[5, 37], 1), random(&[5, 37], 2));
        close(&add(&a, &b).unwrap(), &(&a + &b).unwrap(), 0.0);
        check_gradients(&[random(&[3, 7], 3), random(&[3, 7], 4)], |t| add(&t[0], &t[1]));
        assert!(add(&random(&[2, 3], 1), &random(&[3, 2], 1)).is_err());
    }
}
