//! 3x3 convolution on channels-last images.

use crate::error::Result;
use crate::kernels::exec::{dims4, expect_dims, on_cpu, output, read, read2, slice, sum_in_order, tensor};
use crate::kernels::gemm::f32::{Init, Lhs, Panels, multiply};
use crate::kernels::isa::Level;
use candle_core::{CpuStorage, CustomOp2, CustomOp3, Layout, Shape, Tensor};
use rayon::prelude::*;

/// Image rows in one task.
const TASK_ROWS: usize = 16;

/// 3x3 convolution (cross-correlation, as networks have it), stride 1, zero padding 1.
///
/// `x` is `[b, h, w, cin]` (channels last), `weight` `[cout, cin, 3, 3]` (as checkpoints store it),
/// `bias` `[cout]`; gives `[b, h, w, cout]`. Differentiable in all. Shapes that do not fit are
/// [`Error::Argument`](crate::error::Error::Argument).
pub fn conv3x3(x: &Tensor, weight: &Tensor, bias: Option<&Tensor>) -> Result<Tensor> {
    let (_, _, _, cin) = dims4("x", x)?;
    let (cout, _, _, _) = dims4("weight", weight)?;
    expect_dims("weight", weight, &[cout, cin, 3, 3])?;
    if let Some(bias) = bias {
        expect_dims("bias", bias, &[cout])?;
    }
    let all: Vec<&Tensor> = [Some(x), Some(weight), bias].into_iter().flatten().collect();
    if !on_cpu(&all) || all.iter().any(|t| t.elem_count() == 0) {
        return composed(x, weight, bias);
    }
    let (x, weight) = (x.contiguous()?, weight.contiguous()?);
    match bias {
        Some(bias) => Ok(x.apply_op3(&weight, &bias.contiguous()?, Conv)?),
        None => Ok(x.apply_op2(&weight, Conv)?),
    }
}

fn composed(x: &Tensor, weight: &Tensor, bias: Option<&Tensor>) -> Result<Tensor> {
    let channels_first = x.permute((0, 3, 1, 2))?.contiguous()?;
    let out = channels_first.conv2d(weight, 1, 1, 1, 1)?.permute((0, 2, 3, 1))?.contiguous()?;
    match bias {
        Some(bias) => Ok(out.broadcast_add(bias)?),
        None => Ok(out),
    }
}

struct Conv;

/// Batch, height and width of the images.
#[derive(Clone, Copy)]
struct Images {
    b: usize,
    h: usize,
    w: usize,
}

impl Images {
    fn tasks_per_image(self) -> usize {
        self.h.div_ceil(TASK_ROWS)
    }

    /// First image row (counted over the batch) and number of rows of a task: never of two images.
    fn task(self, i: usize) -> (usize, usize) {
        let (image, y) = (i / self.tasks_per_image(), i % self.tasks_per_image() * TASK_ROWS);
        (image * self.h + y, TASK_ROWS.min(self.h - y))
    }

    fn tasks(self) -> usize {
        self.b * self.tasks_per_image()
    }

    /// Splits a buffer of `c` channels into the tasks' parts.
    fn split(self, mut data: &mut [f32], c: usize) -> Vec<&mut [f32]> {
        let mut parts = Vec::with_capacity(self.tasks());
        for i in 0..self.tasks() {
            let (part, rest) = data.split_at_mut(self.task(i).1 * self.w * c);
            parts.push(part);
            data = rest;
        }
        parts
    }

    /// The rows of a task with the row above and below and a column on either side, zero outside.
    fn pad<'a>(self, out: &'a mut Vec<f32>, x: &[f32], c: usize, first: usize, rows: usize) -> &'a [f32] {
        let (line, y, w) = ((self.w + 2) * c, first % self.h, self.w * c);
        out.resize((rows + 2) * line, 0.0);
        for (r, out) in out.chunks_exact_mut(line).enumerate() {
            if y + r < 1 || y + r > self.h {
                out.fill(0.0);
                continue;
            }
            let from = (first + r - 1) * w;
            out[..c].fill(0.0);
            out[c..c + w].copy_from_slice(&x[from..from + w]);
            out[c + w..].fill(0.0);
        }
        out
    }

    /// The convolution with weights as panels of `9 cin` rows in the order (dy, dx, channel).
    fn convolve(self, x: &[f32], cin: usize, weight: &Panels<'_>, cout: usize, init: Init<'_>) -> Vec<f32> {
        let level = Level::current();
        let mut out = vec![0f32; self.b * self.h * self.w * cout];
        self.split(&mut out, cout).into_par_iter().enumerate().for_each_init(Vec::new, |buffer, (i, out)| {
            let (first, rows) = self.task(i);
            let padded = self.pad(buffer, x, cin, first, rows);
            let line = (self.w + 2) * cin;
            for (y, out) in out.chunks_exact_mut(self.w * cout).enumerate() {
                // A filter's three pixels of one row are neighbours in memory: no im2col.
                let lhs = Lhs::rows(&padded[y * line..], cin, 3 * cin).segments(3, line);
                multiply(level, out, cout, self.w, lhs, weight.view(), init);
            }
        });
        out
    }

    /// The weight's gradient, `[dy][dx][cin][cout]`.
    fn weight_grad(self, x: &[f32], cin: usize, grad: &[f32], cout: usize) -> Vec<f32> {
        let level = Level::current();
        let task = |buffer: &mut Vec<f32>, i: usize| {
            let (first, rows) = self.task(i);
            let padded = self.pad(buffer, x, cin, first, rows);
            let line = (self.w + 2) * cin;
            let grad = Panels::from_rows(&grad[first * self.w * cout..], cout, rows * self.w, cout);
            let mut out = vec![0f32; 9 * cin * cout];
            for y in 0..rows {
                let rhs = grad.view().skip(y * self.w).rows(self.w);
                for (dy, out) in out.chunks_exact_mut(3 * cin * cout).enumerate() {
                    let lhs = Lhs::columns(&padded[(y + dy) * line..], cin, self.w);
                    multiply(level, out, cout, 3 * cin, lhs, rhs, Init::Add);
                }
            }
            out
        };
        let partials = (0..self.tasks()).into_par_iter().map_init(Vec::new, task).collect();
        sum_in_order(partials, 9 * cin * cout)
    }
}

/// `[cout, cin, 3, 3]` as panels of rows (dy, dx, cin).
fn forward_panels(weight: &[f32], cout: usize, cin: usize) -> Panels<'static> {
    let mut rows = vec![0f32; 9 * cin * cout];
    for (i, &w) in weight.iter().enumerate() {
        let (tap, ci, co) = (i % 9, i / 9 % cin, i / 9 / cin);
        rows[(tap * cin + ci) * cout + co] = w;
    }
    Panels::from_rows(&rows, cout, 9 * cin, cout).into_owned()
}

/// The same for the gradient of `x`: the filter turned by 180 degrees, inputs and outputs swapped.
fn backward_panels(weight: &[f32], cout: usize, cin: usize) -> Panels<'static> {
    let mut rows = vec![0f32; 9 * cin * cout];
    for (i, &w) in weight.iter().enumerate() {
        let (tap, ci, co) = (8 - i % 9, i / 9 % cin, i / 9 / cin);
        rows[(tap * cout + co) * cin + ci] = w;
    }
    Panels::from_rows(&rows, cin, 9 * cout, cin).into_owned()
}

fn forward(
    x: &[f32],
    lx: &Layout,
    weight: &[f32],
    lw: &Layout,
    bias: Option<&[f32]>,
) -> candle_core::Result<(CpuStorage, Shape)> {
    let ((b, h, w, cin), (cout, _, _, _)) = (lx.shape().dims4()?, lw.shape().dims4()?);
    let init = bias.map_or(Init::Zero, Init::Bias);
    let panels = forward_panels(weight, cout, cin);
    let out = Images { b, h, w }.convolve(x, cin, &panels, cout, init);
    Ok(output(out, (b, h, w, cout)))
}

fn backward(
    x: &Tensor,
    weight: &Tensor,
    grad: &Tensor,
) -> candle_core::Result<(Option<Tensor>, Option<Tensor>)> {
    let ((b, h, w, cin), cout) = (x.dims4()?, weight.dim(0)?);
    let images = Images { b, h, w };
    read(grad, |grad| {
        read2(x, weight, |xs, ws| {
            let dx = x.track_op().then(|| {
                let panels = backward_panels(ws, cout, cin);
                tensor(images.convolve(grad, cout, &panels, cin, Init::Zero), x.shape().clone())
            });
            let dw = weight.track_op().then(|| {
                let rows = images.weight_grad(xs, cin, grad, cout);
                let at = |i: usize| {
                    let (tap, ci, co) = (i % 9, i / 9 % cin, i / 9 / cin);
                    rows[(tap * cin + ci) * cout + co]
                };
                tensor((0..rows.len()).map(at).collect(), weight.shape().clone())
            });
            Ok((dx.transpose()?, dw.transpose()?))
        })
    })
}

impl CustomOp2 for Conv {
    fn name(&self) -> &'static str {
        "conv3x3"
    }

    fn cpu_fwd(
        &self,
        s1: &CpuStorage,
        l1: &Layout,
        s2: &CpuStorage,
        l2: &Layout,
    ) -> candle_core::Result<(CpuStorage, Shape)> {
        forward(slice(s1, l1)?, l1, slice(s2, l2)?, l2, None)
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

impl CustomOp3 for Conv {
    fn name(&self) -> &'static str {
        "conv3x3-bias"
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
        forward(slice(s1, l1)?, l1, slice(s2, l2)?, l2, Some(slice(s3, l3)?))
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
        let db = match bias.track_op() {
            true => {
                let m = bias.dim(0)?;
                Some(tensor(read(grad, |grad| Ok(super::linear::bias_grad(grad, m)))?, m)?)
            }
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

    #[test]
    fn forward_is_candles() {
        for (b, h, w, cin, cout) in [(1, 1, 1, 1, 1), (2, 19, 7, 3, 5), (1, 5, 40, 16, 32), (1, 3, 3, 33, 40)]
        {
            let (x, weight) = (random(&[b, h, w, cin], 1), random(&[cout, cin, 3, 3], 2));
            let bias = random(&[cout], 3);
            let expected = composed(&x, &weight, Some(&bias)).unwrap();
            at_every_level(|| close(&conv3x3(&x, &weight, Some(&bias)).unwrap(), &expected, 1e-5));
        }
    }

    #[test]
    fn gradients_hold() {
        let inputs = [random(&[2, 3, 4, 2], 1), random(&[3, 2, 3, 3], 2), random(&[3], 3)];
        at_every_level(|| check_gradients(&inputs, |t| conv3x3(&t[0], &t[1], Some(&t[2]))));
        check_gradients(&inputs[..2], |t| conv3x3(&t[0], &t[1], None));
    }

    #[test]
    fn gradients_are_candles() {
        let inputs = [random(&[2, 35, 6, 17], 1), random(&[5, 17, 3, 3], 2), random(&[5], 3)];
        let expected = gradients(&inputs, |t| composed(&t[0], &t[1], Some(&t[2])));
        at_every_level(|| {
            let grads = gradients(&inputs, |t| conv3x3(&t[0], &t[1], Some(&t[2])));
            for (g, e) in grads.iter().zip(&expected) {
                close(g, e, 2e-5);
            }
        });
    }

    #[test]
    fn threads_do_not_matter() {
        let inputs = [random(&[2, 40, 9, 3], 1), random(&[4, 3, 3, 3], 2)];
        same_on_any_thread_count(|| gradients(&inputs, |t| conv3x3(&t[0], &t[1], None)));
    }

    #[test]
    fn shapes_that_do_not_fit_are_errors() {
        assert!(conv3x3(&random(&[1, 2, 2, 3], 1), &random(&[4, 2, 3, 3], 1), None).is_err());
    }
}
