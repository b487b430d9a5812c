//! The optimiser's step.

use crate::error::{Error, Result};
use crate::kernels::isa::{Isa, Level, per_level};
use rayon::prelude::*;

/// Elements of a task, about.
const CHUNK_ELEMENTS: usize = 32 * 1024;

/// The settings of one [`adamw_step`].
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct AdamWStep {
    /// The learning rate.
    pub lr: f32,
    /// What of the first moment remains from step to step.
    pub beta1: f32,
    /// The same of the second moment.
    pub beta2: f32,
    /// Added to the root of the second moment.
    pub eps: f32,
    /// Times the learning rate, the part of each parameter that decays.
    pub weight_decay: f32,
    /// The step's number, from 1.
    pub step: usize,
    /// Multiplies every gradient: 1 for none; below 1 to clip or to average.
    pub grad_scale: f32,
}

/// One AdamW step in place, in a single pass: Adam with bias correction and decoupled weight decay
/// (Loshchilov and Hutter, arXiv 1711.05101).
///
/// `params`, `grad`, `m` and `v` have one length; `m` and `v` start as zeros and belong to these
/// parameters. A length that differs is [`Error::BufferLength`], step 0 [`Error::Argument`].
pub fn adamw_step(
    params: &mut [f32],
    grad: &[f32],
    m: &mut [f32],
    v: &mut [f32],
    settings: &AdamWStep,
) -> Result<()> {
    let expected = params.len();
    for (what, found) in [("grad", grad.len()), ("m", m.len()), ("v", v.len())] {
        if found != expected {
            return Err(Error::BufferLength { what, expected, found });
        }
    }
    let AdamWStep { lr, beta1, beta2, eps, weight_decay, step, grad_scale } = *settings;
    if step == 0 {
        return Err(Error::argument("step", step, "1 or more"));
    }
    let correction = |beta: f32| (1.0 - (beta as f64).powf(step as f64)) as f32;
    let rates = Rates {
        lr: lr / correction(beta1),
        keep: 1.0 - lr * weight_decay,
        beta1,
        beta2,
        eps,
        v_scale: 1.0 / correction(beta2),
        grad_scale,
    };
    let level = Level::current();
    params
        .par_chunks_mut(CHUNK_ELEMENTS)
        .zip(grad.par_chunks(CHUNK_ELEMENTS))
        .zip(m.par_chunks_mut(CHUNK_ELEMENTS).zip(v.par_chunks_mut(CHUNK_ELEMENTS)))
        .for_each(|((p, g), (m, v))| adamw_chunk(level, p, g, m, v, &rates));
    Ok(())
}

pub(in crate::kernels) struct Rates {
    /// The learning rate over the first moment's bias correction.
    lr: f32,
    /// What weight decay leaves of a parameter.
    keep: f32,
    beta1: f32,
    beta2: f32,
    eps: f32,
    v_scale: f32,
    grad_scale: f32,
}

#[inline(always)]
fn adamw_body<S: Isa>(_: S, p: &mut [f32], g: &[f32], m: &mut [f32], v: &mut [f32], r: &Rates) {
    for (((p, &g), m), v) in p.iter_mut().zip(g).zip(m).zip(v) {
        let g = g * r.grad_scale;
        *m = r.beta1 * *m + (1.0 - r.beta1) * g;
        *v = r.beta2 * *v + (1.0 - r.beta2) * g * g;
        *p = *p * r.keep - r.lr * *m / ((*v * r.v_scale).sqrt() + r.eps);
    }
}
per_level!(fn adamw_chunk(p: &mut [f32], g: &[f32], m: &mut [f32], v: &mut [f32], r: &Rates) = adamw_body);

#[cfg(test)]
mod tests {
    use super::*;
    use crate::kernels::testing::at_every_level;

    const SETTINGS: AdamWStep = AdamWStep {
        lr: 0.01,
        beta1: 0.9,
        beta2: 0.99,
        eps: 1e-8,
        weight_decay: 0.1,
        step: 1,
        grad_scale: 0.5,
    };

    #[test]
    fn follows_the_paper_in_f64() {
        at_every_level(|| {
            let mut p: Vec<f32> = (0..37).map(|i| i as f32 * 0.1 - 2.0).collect();
            let mut exact: Vec<f64> = p.iter().map(|&p| p as f64).collect();
            let (mut m, mut v) = (vec![0f32; 37], vec![0f32; 37]);
            let (mut em, mut ev) = (vec![0f64; 37], vec![0f64; 37]);
            for step in 1..=5usize {
                let g: Vec<f32> = (0..37).map(|i| ((i * step) as f32).sin()).collect();
                adamw_step(&mut p, &g, &mut m, &mut v, &AdamWStep { step, ..SETTINGS }).unwrap();
                for i in 0..37 {
                    let g = g[i] as f64 * 0.5;
                    em[i] = 0.9 * em[i] + 0.1 * g;
                    ev[i] = 0.99 * ev[i] + 0.01 * g * g;
                    let (mh, vh) =
                        (em[i] / (1.0 - 0.9f64.powi(step as i32)), ev[i] / (1.0 - 0.99f64.powi(step as i32)));
                    exact[i] -= 0.01 * (mh / (vh.sqrt() + 1e-8) + 0.1 * exact[i]);
                }
            }
            for (p, exact) in p.iter().zip(&exact) {
                assert!((*p as f64 - exact).abs() < 2e-5, "{p}, expected {exact}");
            }
        });
    }

    #[test]
    fn lengths_must_agree_and_steps_count_from_one() {
        let mut p = [0f32; 2];
        let (mut m, mut v) = ([0f32; 2], [0f32; 2]);
        assert!(adamw_step(&mut p, &[0.0; 3], &mut m, &mut v, &SETTINGS).is_err());
        assert!(adamw_step(&mut p, &[0.0; 2], &mut m, &mut v, &AdamWStep { step: 0, ..SETTINGS }).is_err());
    }
}
