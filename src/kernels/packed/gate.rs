//! The gated half of a SwiGLU network in one product.

use super::gemm::Finish;
use super::isa::Kernel;
use super::panel::{HALF, WIDTH};
use super::{PackedWeight, WeightFormat, expect_cpu_f32};
use crate::error::{Error, Result};
use crate::kernels::exec::{dims2, expect_dims, read, tensor};
use candle_core::Tensor;

/// The gate and the up projection of a SwiGLU network as one packed weight, so that
/// `silu(x G^T + g) * (x U^T + u)` needs one pass over `x` and writes neither factor to memory.
#[derive(Debug)]
pub struct PackedGate {
    /// Channels by 16 of the gate and 16 of the up projection in turn.
    both: PackedWeight,
    bias: Option<Vec<f32>>,
    outputs: usize,
}

impl PackedGate {
    /// Joins two weights `[m, k]` of one format, each with its bias `[m]` (f32 on the CPU) or none. The result holds copies: both weights may
    /// be dropped.
    ///
    /// # Errors
    /// [`Error::Argument`] where sizes, formats, types or devices do not fit.
    pub fn new(gate: (&PackedWeight, Option<&Tensor>), up: (&PackedWeight, Option<&Tensor>)) -> Result<Self> {
        let ((gate, gate_bias), (up, up_bias)) = (gate, up);
        if (gate.dims(), gate.format) != (up.dims(), up.format) {
            let found = format!("{:?} of {:?}", up.format, up.dims());
            let expected = format!("{:?} of {:?} as the gate", gate.format, gate.dims());
            return Err(Error::argument("up projection", found, expected));
        }
        let (outputs, _) = gate.dims();
        let bias = match (gate_bias, up_bias) {
            (None, None) => None,
            (gate, up) => Some(alternate(&values(gate, outputs)?, &values(up, outputs)?)),
        };
        let (scales, offsets) = match gate.format {
            WeightFormat::Int8 => {
                (alternate(&gate.scales, &up.scales), alternate(&gate.offsets, &up.offsets))
            }
            _ => (Vec::new(), Vec::new()),
        };
        let panels = gate.panels.interleave(&up.panels);
        Ok(PackedGate { both: PackedWeight { panels, format: gate.format, scales, offsets }, bias, outputs })
    }

    /// Outputs and inputs `(m, k)`.
    pub fn dims(&self) -> (usize, usize) {
        (self.outputs, self.both.panels.k)
    }

    /// Memory held, in bytes.
    pub fn bytes(&self) -> usize {
        self.both.bytes() + 4 * self.bias.as_ref().map_or(0, Vec::len)
    }

    /// The format of the values.
    pub fn format(&self) -> WeightFormat {
        self.both.format
    }

    /// `silu(x G^T + g) * (x U^T + u)`, where `silu(z) = z / (1 + e^-z)`: `x` is `[n, k]`, f32 on the CPU; gives `[n, m]`.
    /// Rounding of `x` as in [`PackedWeight::linear`].
    ///
    /// # Errors
    /// [`Error::Argument`] for another shape, type or device.
    pub fn apply(&self, x: &Tensor) -> Result<Tensor> {
        self.apply_by(Kernel::current(self.both.format), x)
    }

    pub(super) fn apply_by(&self, kernel: Kernel, x: &Tensor) -> Result<Tensor> {
        let (n, _) = dims2("x", x)?;
        expect_dims("x", x, &[n, self.both.panels.k])?;
        expect_cpu_f32("x", x)?;
        let finish = Finish { gated: true, ..self.both.finish(self.bias.as_deref()) };
        let out = read(x, |x| Ok(self.both.product(kernel, x, n, self.outputs, finish)))?;
        Ok(tensor(out, (n, self.outputs))?)
    }
}

/// The bias, or zeros.
fn values(bias: Option<&Tensor>, m: usize) -> Result<Vec<f32>> {
    let Some(bias) = bias else { return Ok(vec![0.0; m]) };
    expect_dims("bias", bias, &[m])?;
    expect_cpu_f32("bias", bias)?;
    Ok(read(bias, |bias| Ok(bias.to_vec()))?)
}

/// Channels in the order of the joined panels, with defaults where there is none.
fn alternate<T: Copy + Default>(gate: &[T], up: &[T]) -> Vec<T> {
    let mut both = vec![T::default(); gate.len().div_ceil(HALF) * WIDTH];
    for (both, (gate, up)) in both.chunks_exact_mut(WIDTH).zip(gate.chunks(HALF).zip(up.chunks(HALF))) {
        both[..gate.len()].copy_from_slice(gate);
        both[HALF..HALF + up.len()].copy_from_slice(up);
    }
    both
}

#[cfg(test)]
mod tests {
    use super::super::super::testing::{random, same_on_any_thread_count, values};
    use super::super::tests::{SHAPES, every_kernel};
    use super::*;

    fn pack(w: &[f32], m: usize, k: usize, format: WeightFormat) -> PackedWeight {
        match format {
            WeightFormat::Int8 => {
                PackedWeight::int8_from_rows(m, k, |i, out| out.copy_from_slice(&w[i * k..(i + 1) * k]))
            }
            _ => PackedWeight::bf16_from_f32(w, m, k),
        }
        .unwrap()
    }

    #[test]
    fn it_is_the_two_products_and_their_gate() {
        for (format, (n, k, m)) in
            [WeightFormat::Bf16, WeightFormat::Int8].into_iter().flat_map(|f| SHAPES.map(|s| (f, s)))
        {
            let x = random(&[n, k], 1);
            let weight = |seed| pack(&values(&random(&[m, k], seed)), m, k, format);
            let (gate, up, gate_bias, up_bias) = (weight(2), weight(3), random(&[m], 4), random(&[m], 5));
            for (gate_bias, up_bias) in
                [(None, None), (Some(&gate_bias), Some(&up_bias)), (Some(&gate_bias), None)]
            {
                let both = PackedGate::new((&gate, gate_bias), (&up, up_bias)).unwrap();
                assert_eq!((both.dims(), both.format()), ((m, k), format));
                for kernel in every_kernel(format) {
                    let found = values(&both.apply_by(kernel, &x).unwrap());
                    let gates = values(&gate.linear_by(kernel, &x, gate_bias).unwrap());
                    let ups = values(&up.linear_by(kernel, &x, up_bias).unwrap());
                    assert_eq!(found.len(), n * m);
                    for ((found, gate), up) in found.iter().zip(gates).zip(ups) {
                        let expected = f64::from(gate) / (1.0 + (-f64::from(gate)).exp()) * f64::from(up);
                        let close = (f64::from(*found) - expected).abs() <= 1e-6 * (1.0 + expected.abs());
                        assert!(close, "{} {n}x{k}x{m}: {found}, expected {expected}", kernel.name);
                    }
                }
            }
        }
    }

    #[test]
    fn threads_do_not_matter_and_misfits_are_errors() {
        let weight = |m, k| pack(&values(&random(&[m, k], 2)), m, k, WeightFormat::Bf16);
        let both = PackedGate::new((&weight(300, 40), None), (&weight(300, 40), None)).unwrap();
        let x = random(&[250, 40], 1);
        same_on_any_thread_count(|| vec![both.apply(&x).unwrap()]);
        assert!(both.bytes() >= 2 * 2 * 300 * 40);
        assert!(both.apply(&random(&[2, 41], 1)).is_err());
        let (gate, bias) = (weight(300, 40), random(&[299], 1));
        assert!(PackedGate::new((&gate, None), (&weight(301, 40), None)).is_err());
        assert!(PackedGate::new((&gate, None), (&gate, Some(&bias))).is_err());
        let bytes = pack(&vec![1.0; 300 * 40], 300, 40, WeightFormat::Int8);
        assert!(PackedGate::new((&gate, None), (&bytes, None)).is_err());
    }
}
