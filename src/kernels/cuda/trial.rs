//! Whether our kernels may be used on a device: each is tried once on little, and must give what the composed forms give.

use super::compiled::{Compiled, Functions};
use super::launches;
use crate::error::Result;
use crate::kernels::rounded::{self, Heads, OwnKeys};
use candle_core::backend::BackendDevice;
use candle_core::{CudaDevice, DType, Device, DeviceLocation, Tensor};
use std::sync::{LazyLock, Mutex, PoisonError};

/// By the number of a card, whose devices all have one context; `None` where they cannot be used.
type Known = Vec<(DeviceLocation, Option<Functions>)>;

/// The kernels of a device, made at the first call for its card. `None` where they cannot be compiled or do not give the right values, which is said
/// once, as a warning, and where the environment variable `SDIM_CUDA_KERNELS` is `off`.
pub(in super::super) fn kernels(device: &CudaDevice) -> Option<Compiled<'_>> {
    static OFF: LazyLock<bool> =
        LazyLock::new(|| std::env::var("SDIM_CUDA_KERNELS").is_ok_and(|value| value == "off"));
    static KNOWN: Mutex<Known> = Mutex::new(Vec::new());
    if *OFF {
        return None;
    }
    let mut known = KNOWN.lock().unwrap_or_else(PoisonError::into_inner);
    let card = device.location();
    if let Some((_, functions)) = known.iter().find(|(of, _)| *of == card) {
        return functions.clone().map(|functions| Compiled::of(device, functions));
    }
    let kernels = match tried(device) {
        Ok(kernels) => Some(kernels),
        Err(error) => {
            tracing::warn!("kernels for CUDA are left out, those of candle stand in: {error}");
            None
        }
    };
    known.push((card, kernels.as_ref().map(Compiled::functions)));
    kernels
}

fn tried(device: &CudaDevice) -> Result<Compiled<'_>> {
    let kernels = Compiled::new(device)?;
    for (name, wanted, found) in results(&kernels)? {
        let found = found.to_device(&Device::Cpu)?;
        if !alike(&found, &wanted)? {
            return Err(candle_core::Error::Msg(format!("the kernel `{name}` gives wrong values")).into());
        }
    }
    Ok(kernels)
}

/// Whether two tensors are the same but for rounding: to bf16, where one of them is.
fn alike(found: &Tensor, wanted: &Tensor) -> Result<bool> {
    if found.dims() != wanted.dims() || found.dtype() != wanted.dtype() {
        return Ok(false);
    }
    let tolerance = if wanted.dtype() == DType::BF16 { 1e-2 } else { 1e-4 };
    let values = |t: &Tensor| t.to_dtype(DType::F32)?.flatten_all()?.to_vec1::<f32>();
    let pairs = values(found)?.into_iter().zip(values(wanted)?);
    Ok(pairs.into_iter().all(|(a, b)| (a - b).abs() <= tolerance * (0.1 + b.abs())))
}

/// Numbers between -2 and 2, each time the same, none like its neighbours.
fn some(dims: &[usize], seed: usize) -> Result<Tensor> {
    let n = dims.iter().product();
    let values: Vec<f32> =
        (0..n).map(|i| ((i + 7 * seed) * 2_654_435_761 % 65_521) as f32 / 16_380.0 - 2.0).collect();
    Ok(Tensor::from_vec(values, dims, &Device::Cpu)?)
}

/// Of each kernel its name, what the composed form gives on the CPU, and what it gives itself.
fn results(kernels: &Compiled) -> Result<Vec<(&'static str, Tensor, Tensor)>> {
    let there = Device::Cuda(kernels.device().clone());
    let up = |t: &Tensor| t.to_device(&there);
    let half = |t: Tensor| t.to_dtype(DType::BF16);
    let mut out = Vec::new();

    let (x, y, z) = (some(&[5, 70], 1)?, half(some(&[5, 70], 2)?)?, half(some(&[5, 70], 3)?)?);
    let (bias, other) = (some(&[70], 4)?, some(&[70], 5)?);
    let (there_x, there_y, there_z) = (up(&x)?, up(&y)?, up(&z)?);
    let (there_bias, there_other) = (up(&bias)?, up(&other)?);
    let part = |t: &Tensor| t.narrow(1, 20, 40);
    out.push((
        "widen",
        rounded::widen(&part(&y)?, None, None)?,
        launches::widen(kernels, &part(&there_y)?, None, None)?,
    ));
    let found = launches::widen(kernels, &there_y, Some(&there_bias), Some(&there_x))?;
    out.push(("widen", rounded::widen(&y, Some(&bias), Some(&x))?, found));
    let wanted = half(candle_nn::ops::rms_norm(&x, &bias, 1e-6)?)?;
    out.push(("rms_norm", wanted, launches::rms_norm(kernels, &there_x, &there_bias, 1e-6)?));
    let wanted =
        rounded::swiglu([&y.to_dtype(DType::F32)?, &z.to_dtype(DType::F32)?], [Some(&bias), Some(&other)])?;
    let found = launches::swiglu(kernels, [&there_y, &there_z], [Some(&there_bias), Some(&there_other)])?;
    out.push(("swiglu", half(wanted)?, found));

    attention(kernels, &there, &mut out)?;
    Ok(out)
}

/// Answers in progress against a prefix, and a causal prompt.
fn attention(
    kernels: &Compiled,
    there: &Device,
    out: &mut Vec<(&'static str, Tensor, Tensor)>,
) -> Result<()> {
    let up = |t: &Tensor| t.to_device(there);
    let heads = Heads { items: 3, key_heads: 2, group: 3, period: 2, head_dim: 40 };
    let keys = OwnKeys { shared: 37, own: 3, causal: true };
    let x = some(&[6, heads.width()], 6)?;
    let q = rounded::heads_first(&x, heads, 0.2, 2)?;
    out.push(("heads_first", q.clone(), launches::heads_first(kernels, &up(&x)?, heads, 0.2, 2)?));
    let prefix = Heads { items: 1, group: 1, period: 37, ..heads };
    let read = some(&[37, prefix.width()], 7)?;
    let k = rounded::heads_first(&read, prefix, 1.0, 40)?;
    out.push(("heads_first", k.clone(), launches::heads_first(kernels, &up(&read)?, prefix, 1.0, 40)?));

    let (q, k) = (q.reshape((2, 18, 40))?, k.reshape((2, 40, 40))?);
    let (there_q, there_k) = (up(&q)?, up(&k)?);
    let scores = rounded::product(&q, &k, true)?;
    out.push(("product", scores.clone(), launches::product(kernels, &there_q, &there_k, true)?));
    let scores = scores.reshape((36, 40))?;
    let there_scores = up(&scores)?;
    let own = [some(&[9, 80], 8)?, some(&[9, 80], 9)?];
    let there_own = [up(&own[0])?, up(&own[1])?];
    let p = rounded::shared_probabilities(&scores, [&q, &own[0]], keys, heads)?;
    let found =
        launches::shared_probabilities(kernels, &there_scores, [&there_q, &there_own[0]], keys, heads)?;
    out.push(("shared_probabilities", p.clone(), found));
    let p3 = p.reshape((2, 18, 40))?;
    let values = rounded::product(&p3, &k, false)?;
    out.push(("product", values.clone(), launches::product(kernels, &up(&p3)?, &there_k, false)?));
    let wanted = rounded::heads_last(&values, Some((&p, &own[1], keys)), heads)?;
    let found = launches::heads_last(kernels, &up(&values)?, Some((&up(&p)?, &there_own[1], keys)), heads)?;
    out.push(("heads_last", wanted, found));
    for causal in [false, true] {
        let wanted = rounded::probabilities(&scores, 38, 9, causal)?;
        out.push(("probabilities", wanted, launches::probabilities(kernels, &there_scores, 38, 9, causal)?));
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use crate::kernels::testing::test_device;
    use candle_core::Device;

    /// On a device: without a CUDA device there is nothing to try.
    #[test]
    fn the_kernels_pass_on_the_device_of_the_tests() {
        if let Device::Cuda(device) = test_device() {
            super::tried(&device).map(|_| ()).unwrap();
            assert!(super::kernels(&device).is_some(), "SDIM_CUDA_KERNELS is off");
        }
    }
}
