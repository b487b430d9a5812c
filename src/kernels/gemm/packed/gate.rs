//! The gated half of a SwiGLU network in one product.

use super::format::WeightFormat;
use super::kernel::GemmKernel;
use super::panels::{HALF_PANEL, PANEL_WIDTH};
use super::product::Finish;
use super::row_major::RowMajor;
use super::select;
use super::weight::{PackedWeight, expect_cpu_f32, pack_channels};
use crate::error::{Error, Result};
use crate::kernels::exec::{dims2, expect_dims, read, tensor};
use candle_core::Tensor;

/// The gate and the up projection of a SwiGLU network as one packed weight, so that
/// `silu(x G^T + g) * (x U^T + u)` needs one pass over `x` and writes neither factor to memory.
#[derive(Debug)]
pub struct PackedGate {
    /// Channels by 16 of the gate and 16 of the up projection in turn.
    pub(in crate::kernels) both: PackedWeight,
    bias: Option<Vec<f32>>,
    outputs: usize,
}

impl PackedGate {
    /// Packs two weights `[m, k]`, each with its bias `[m]` (f32 on the CPU) or none.
    ///
    /// # Errors
    /// [`Error::Argument`] where sizes, types or devices do not fit; as [`PackedWeight::new`].
    pub fn new(
        format: WeightFormat,
        (gate, gate_bias): (RowMajor<'_>, Option<&Tensor>),
        (up, up_bias): (RowMajor<'_>, Option<&Tensor>),
    ) -> Result<Self> {
        let (outputs, k) = gate.dims();
        if up.dims() != (outputs, k) {
            let expected = format!("{:?} as the gate", gate.dims());
            return Err(Error::argument("up projection", format!("{:?}", up.dims()), expected));
        }
        let bias = match (gate_bias, up_bias) {
            (None, None) => None,
            (gate, up) => Some(alternate(&values(gate, outputs)?, &values(up, outputs)?)),
        };
        let channels = outputs.div_ceil(HALF_PANEL) * PANEL_WIDTH;
        let both = pack_channels(format, &[gate, up], (channels, k), |channel| {
            let row = channel / PANEL_WIDTH * HALF_PANEL + channel % HALF_PANEL;
            (row < outputs).then_some((channel % PANEL_WIDTH / HALF_PANEL, row))
        })?;
        Ok(PackedGate { both, bias, outputs })
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
        self.both.format()
    }

    /// `silu(x G^T + g) * (x U^T + u)`, where `silu(z) = z / (1 + e^-z)`: `x` is `[n, k]`, f32 on the CPU; gives `[n, m]`.
    /// Rounding of `x` as in [`PackedWeight::linear`].
    ///
    /// # Errors
    /// [`Error::Argument`] for another shape, type or device.
    pub fn apply(&self, x: &Tensor) -> Result<Tensor> {
        self.apply_by(&select::current(self.both.format()), x)
    }

    fn apply_by(&self, kernel: &GemmKernel, x: &Tensor) -> Result<Tensor> {
        let (n, _) = dims2("x", x)?;
        expect_dims("x", x, &[n, self.both.panels.k])?;
        expect_cpu_f32("x", x)?;
        let finish = self.finish();
        let mut parts = read(x, |x| Ok(self.both.product(kernel, x, n, &[self.outputs], finish)))?;
        Ok(tensor(parts.pop().unwrap_or_default(), (n, self.outputs))?)
    }

    /// What is done to the sums of both.
    pub(in crate::kernels) fn finish(&self) -> Finish<'_> {
        Finish { gated: true, ..self.both.finish(self.bias.as_deref()) }
    }
}

/// The bias, or zeros.
fn values(bias: Option<&Tensor>, m: usize) -> Result<Vec<f32>> {
    let Some(bias) = bias else { return Ok(vec![0.0; m]) };
    expect_dims("bias", bias, &[m])?;
    expect_cpu_f32("bias", bias)?;
    Ok(read(bias, |bias| Ok(bias.to_vec()))?)
}

/// Values of the channels in the order of the panels, zeros where there is none.
fn alternate(gate: &[f32], up: &[f32]) -> Vec<f32> {
    let mut both = vec![0.0; gate.len().div_ceil(HALF_PANEL) * PANEL_WIDTH];
    for (both, (gate, up)) in
        both.chunks_exact_mut(PANEL_WIDTH).zip(gate.chunks(HALF_PANEL).zip(up.chunks(HALF_PANEL)))
    {
        both[..gate.len()].copy_from_slice(gate);
        both[HALF_PANEL..HALF_PANEL + up.len()].copy_from_slice(up);
    }
    both
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::kernels::gemm::packed::tests::{SHAPES, every_kernel, packed_as};
    use crate::kernels::testing::{random, same_on_any_thread_count, values};

    #[test]
    fn it_is_the_two_products_and_their_gate() {
        for (format, (n, k, m)) in
            [WeightFormat::Bf16, WeightFormat::Int8].into_iter().flat_map(|f| SHAPES.map(|s| (f, s)))
        {
            let x = random(&[n, k], 1);
            let [gate, up] = [2, 3].map(|seed| values(&random(&[m, k], seed)));
            let [gate_rows, up_rows] = [&gate, &up].map(|w| RowMajor::f32(w, m, k).unwrap());
            let [gate, up] = [&gate, &up].map(|w| packed_as(format, w, m, k));
            let (gate_bias, up_bias) = (random(&[m], 4), random(&[m], 5));
            for (gate_bias, up_bias) in
                [(None, None), (Some(&gate_bias), Some(&up_bias)), (Some(&gate_bias), None)]
            {
                let both = PackedGate::new(format, (gate_rows, gate_bias), (up_rows, up_bias)).unwrap();
                assert_eq!((both.dims(), both.format()), ((m, k), format));
                for kernel in every_kernel(format) {
                    let found = values(&both.apply_by(&kernel, &x).unwrap());
                    let gates = values(&gate.linear_by(&kernel, &x, gate_bias).unwrap());
                    let ups = values(&up.linear_by(&kernel, &x, up_bias).unwrap());
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
        let w = values(&random(&[301, 40], 2));
        let rows = |m: usize| RowMajor::f32(&w[..m * 40], m, 40).unwrap();
        let gate = |up, bias| PackedGate::new(WeightFormat::Bf16, (rows(300), None), (up, bias));
        let both = gate(rows(300), None).unwrap();
        let x = random(&[250, 40], 1);
        same_on_any_thread_count(|| vec![both.apply(&x).unwrap()]);
        assert!(both.bytes() >= 2 * 2 * 300 * 40);
        assert!(both.apply(&random(&[2, 41], 1)).is_err());
        assert!(gate(rows(301), None).is_err());
        assert!(gate(rows(300), Some(&random(&[299], 1))).is_err());
        assert!(PackedGate::new(WeightFormat::F32, (rows(300), None), (rows(300), None)).is_err());
    }
}
