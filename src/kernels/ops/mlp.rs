//! A SwiGLU network with packed weights as one operation, so that what lies between its two products has a buffer that stays.

use crate::error::{Error, Result};
use crate::kernels::exec::{dims2, expect_dims, read2, tensor};
use crate::kernels::gemm::packed::{
    Finish, PackedGate, PackedWeight, current_kernel, expect_cpu_f32, read_some,
};
use crate::kernels::written::{rewrite, written};
use candle_core::Tensor;
use std::mem::MaybeUninit;
use std::sync::{Mutex, MutexGuard, PoisonError};

/// Bytes of the gate's outputs that are made before they are multiplied, at most; they stay allocated. With less, both weights are read more
/// often: chunks of 8 MB, which stay in the last-level cache, were slower by a tenth at the 3B shapes.
const MAX_CHUNK_BYTES: usize = 64 << 20;
/// Rows of a chunk even where they take more memory.
const MIN_CHUNK_ROWS: usize = 192;

/// The gate's outputs of the last network: one buffer in the process.
static SPARE: Mutex<Vec<f32>> = Mutex::new(Vec::new());

fn spare() -> MutexGuard<'static, Vec<f32>> {
    SPARE.lock().unwrap_or_else(PoisonError::into_inner)
}

/// `r + (h D^T + d)`, where `h` is [`PackedGate::apply`] of `x` `[n, k]`, `down` `D` `[o, m]`, `bias` `d` `[o]` and `residual` `r`
/// `[n, o]`, f32 on the CPU: the same values as by one product after the other. No gradient flows, not through `residual` either.
///
/// `h` is made in a buffer of 64 MB at most (or 192 rows), which the process keeps for the next call.
///
/// # Errors
/// [`Error::Argument`] for another shape, type or device.
pub fn packed_mlp(
    gate: &PackedGate,
    x: &Tensor,
    down: &PackedWeight,
    bias: Option<&Tensor>,
    residual: &Tensor,
) -> Result<Tensor> {
    let ((m, k), (o, inputs)) = (gate.dims(), down.dims());
    if inputs != m {
        return Err(Error::argument("inputs of the down projection", inputs, m.to_string()));
    }
    let (n, _) = dims2("x", x)?;
    let known = [("x", Some(x), &[n, k][..]), ("bias", bias, &[o]), ("residual", Some(residual), &[n, o])];
    for (name, tensor, dims) in known {
        if let Some(tensor) = tensor {
            expect_dims(name, tensor, dims)?;
            expect_cpu_f32(name, tensor)?;
        }
    }
    let out = read2(x, residual, |x, residual| {
        read_some(bias, |bias| {
            let finish = Finish { residual: Some(residual), ..down.finish(bias) };
            Ok(in_chunks(gate, x, down, finish, n))
        })
    })?;
    Ok(tensor(out, (n, o))?)
}

fn in_chunks(gate: &PackedGate, x: &[f32], down: &PackedWeight, finish: Finish<'_>, n: usize) -> Vec<f32> {
    let ((m, k), (o, _)) = (gate.dims(), down.dims());
    let [gate_kernel, down_kernel] = [gate.format(), down.format()].map(current_kernel);
    let mut gated = std::mem::take(&mut *spare());
    let step = chunk_rows(n, m);
    let chunks = |out: &mut [MaybeUninit<f32>]| {
        for first in (0..n).step_by(step) {
            let rows = first..n.min(first + step);
            let x = &x[rows.start * k..rows.end * k];
            let apply = |inner: &mut [MaybeUninit<f32>]| {
                gate.both.product_into(&gate_kernel, x, &mut [inner], &[m], gate.finish());
            };
            // SAFETY: `product_into` writes every element.
            unsafe { rewrite(&mut gated, rows.len() * m, apply) };
            let residual = finish.residual.map(|r| &r[rows.start * o..rows.end * o]);
            let out = &mut out[rows.start * o..rows.end * o];
            down.product_into(&down_kernel, &gated, &mut [out], &[o], Finish { residual, ..finish });
        }
    };
    // SAFETY: the chunks are all rows, every element of which is written.
    let out = unsafe { written(n * o, chunks) };
    *spare() = gated;
    out
}

/// Rows of a chunk of `n`, of about the same size each, where the gate has `m` outputs.
fn chunk_rows(n: usize, m: usize) -> usize {
    let most = (MAX_CHUNK_BYTES / (m * size_of::<f32>()).max(1)).max(MIN_CHUNK_ROWS);
    n.div_ceil(n.div_ceil(most).max(1)).max(1)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::kernels::gemm::packed::{RowMajor, WeightFormat, packed_as};
    use crate::kernels::testing::{random, same_on_any_thread_count, values};

    fn network(format: WeightFormat, k: usize, m: usize, o: usize) -> (PackedGate, PackedWeight) {
        let [gate, up, down] = [(m, k, 1), (m, k, 2), (o, m, 3)].map(|(m, k, s)| values(&random(&[m, k], s)));
        let rows = |w| (RowMajor::f32(w, m, k).unwrap(), None);
        (PackedGate::new(format, rows(&gate), rows(&up)).unwrap(), packed_as(format, &down, o, m))
    }

    #[test]
    fn it_is_one_product_after_the_other() {
        for format in [WeightFormat::Bf16, WeightFormat::Int8] {
            // The last is cut into chunks.
            for (n, k, m, o) in [(1, 5, 3, 2), (0, 4, 8, 4), (70, 33, 40, 65), (450, 4, 60_000, 3)] {
                let (gate, down) = network(format, k, m, o);
                let (x, residual, bias) = (random(&[n, k], 4), random(&[n, o], 5), random(&[o], 6));
                let found = packed_mlp(&gate, &x, &down, Some(&bias), &residual).unwrap();
                let inner = gate.apply(&x).unwrap();
                let expected = down.linear_onto(&inner, Some(&bias), &residual).unwrap();
                assert_eq!(found.dims(), [n, o]);
                assert_eq!(values(&found), values(&expected), "{format} {n}");
            }
        }
        assert_eq!(chunk_rows(450, 60_000), 225);
        assert_eq!((chunk_rows(0, 3), chunk_rows(100, 0)), (1, 100));
    }

    #[test]
    fn threads_do_not_matter_and_misfits_are_errors() {
        let (gate, down) = network(WeightFormat::Bf16, 20, 70, 9);
        let (x, residual) = (random(&[130, 20], 4), random(&[130, 9], 5));
        same_on_any_thread_count(|| vec![packed_mlp(&gate, &x, &down, None, &residual).unwrap()]);
        assert!(packed_mlp(&gate, &residual, &down, None, &residual).is_err());
        assert!(packed_mlp(&gate, &x, &down, None, &x).is_err());
        assert!(packed_mlp(&gate, &x, &down, Some(&random(&[8], 1)), &residual).is_err());
        assert!(packed_mlp(&gate, &x, &network(WeightFormat::Bf16, 20, 71, 9).1, None, &residual).is_err());
    }
}
