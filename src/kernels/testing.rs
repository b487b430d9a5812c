//! Helpers of the kernels' tests.

use crate::error::Result;
use crate::kernels::isa::{Level, forced};
use candle_core::{Device, Tensor, Var};
use rand::{Rng, SeedableRng};
use std::sync::LazyLock;

/// Uniform in -1..1.
pub(super) fn random(dims: &[usize], seed: u64) -> Tensor {
    let mut rng = rand_chacha::ChaCha8Rng::seed_from_u64(seed);
    let n = dims.iter().product();
    let data: Vec<f32> = (0..n).map(|_| rng.random_range(-1.0..1.0)).collect();
    Tensor::from_vec(data, dims, &Device::Cpu).unwrap()
}

/// These tensors on the device that `SDIM_TEST_DEVICE` names (`cuda:0`), the CPU without it: where the forms for other devices than the
/// CPU are compared with the kernels, whose results stay on the CPU.
pub(super) fn on_device<const N: usize>(tensors: [&Tensor; N]) -> [Tensor; N] {
    tensors.map(|t| t.to_device(&test_device()).unwrap())
}

/// The device that `SDIM_TEST_DEVICE` names; the CPU without it.
pub(crate) fn test_device() -> Device {
    static DEVICE: LazyLock<Device> = LazyLock::new(|| {
        let name = std::env::var("SDIM_TEST_DEVICE").unwrap_or_else(|_| "cpu".into());
        crate::system::device(&name).unwrap()
    });
    DEVICE.clone()
}

pub(super) fn values(t: &Tensor) -> Vec<f32> {
    t.flatten_all().unwrap().to_vec1().unwrap()
}

/// Fails unless `a` and `b` have one shape and differ by at most `tolerance * (1 + |b|)`.
#[track_caller]
pub(super) fn close(a: &Tensor, b: &Tensor, tolerance: f32) {
    assert_eq!(a.dims(), b.dims());
    for (i, (a, b)) in values(a).iter().zip(values(b)).enumerate() {
        assert!((a - b).abs() <= tolerance * (1.0 + b.abs()), "element {i}: {a}, expected {b}");
    }
}

/// Runs `f` once for each instruction set of this machine.
pub(super) fn at_every_level(f: impl Fn()) {
    for level in Level::available() {
        forced::with(level, &f);
    }
}

/// Gradients of `sum(weights * f(inputs))` with fixed random weights.
pub(super) fn gradients(inputs: &[Tensor], f: impl Fn(&[Tensor]) -> Result<Tensor>) -> Vec<Tensor> {
    let vars: Vec<Var> = inputs.iter().map(|t| Var::from_tensor(t).unwrap()).collect();
    let tensors: Vec<Tensor> = vars.iter().map(|v| v.as_tensor().clone()).collect();
    let out = f(&tensors).unwrap();
    let weights = random(out.dims(), 999);
    let loss = (out * weights).unwrap().sum_all().unwrap();
    let grads = loss.backward().unwrap();
    vars.iter().map(|v| grads.get(v).unwrap().clone()).collect()
}

/// Compares every gradient with central differences of the same function, the sum taken in f64.
#[track_caller]
pub(super) fn check_gradients(inputs: &[Tensor], f: impl Fn(&[Tensor]) -> Result<Tensor>) {
    let grads = gradients(inputs, &f);
    let loss = |inputs: &[Tensor]| -> f64 {
        let out = f(inputs).unwrap();
        let weights = values(&random(out.dims(), 999));
        values(&out).iter().zip(weights).map(|(o, w)| *o as f64 * w as f64).sum()
    };
    const STEP: f32 = 4e-3;
    for (which, input) in inputs.iter().enumerate() {
        let data = values(input);
        let grad = values(&grads[which]);
        for i in 0..data.len() {
            let moved = |by: f32| {
                let mut data = data.clone();
                data[i] += by;
                let mut inputs = inputs.to_vec();
                inputs[which] = Tensor::from_vec(data, input.dims(), &Device::Cpu).unwrap();
                loss(&inputs)
            };
            let numeric = (moved(STEP) - moved(-STEP)) / (2.0 * STEP as f64);
            assert!(
                (numeric - grad[i] as f64).abs() < 2e-3 * (1.0 + numeric.abs()),
                "input {which}, element {i}: gradient {}, by differences {numeric}",
                grad[i]
            );
        }
    }
}

/// Fails unless `f` gives the same bits on one thread and on five.
pub(super) fn same_on_any_thread_count(f: impl Fn() -> Vec<Tensor> + Sync) {
    let on = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| f().iter().map(values).collect::<Vec<_>>())
    };
    assert!(on(1) == on(5), "the result depends on the number of threads");
}
