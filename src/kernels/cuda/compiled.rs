//! Our kernels, compiled for a device.

use candle_core::cuda_backend::cudarc::driver::CudaFunction;
use candle_core::cuda_backend::cudarc::nvrtc::compile_ptx;
use candle_core::{CudaDevice, Error, Result};
use std::sync::Arc;

/// A kernel of `kernels.cu`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Kernel {
    Widen,
    RmsNorm,
    Swiglu,
    HeadsFirst,
    Probabilities,
    SharedProbabilities,
    HeadsLast,
}

/// Names in the source, in the order of [`Kernel`].
const NAMES: [&str; 7] =
    ["widen", "rms_norm", "swiglu", "heads_first", "probabilities", "shared_probabilities", "heads_last"];

/// The kernels of a card, in the order of [`Kernel`].
pub(super) type Functions = Arc<[CudaFunction]>;

/// The kernels of a device.
pub(in super::super) struct Compiled<'a> {
    device: &'a CudaDevice,
    functions: Functions,
}

impl<'a> Compiled<'a> {
    /// With those of the device's card.
    pub(super) fn of(device: &'a CudaDevice, functions: Functions) -> Self {
        Self { device, functions }
    }

    /// Compiles them with NVRTC, for a device that multiplies bf16: of compute capability 8 or more. What it made for the oldest architecture that it knows is translated for the device by its driver.
    pub(super) fn new(device: &'a CudaDevice) -> Result<Self> {
        let context = device.cuda_stream().context().clone();
        let (major, minor) = context.compute_capability().map_err(Error::wrap)?;
        if major < 8 {
            return Err(
                Error::Msg(format!("the device's compute capability is {major}.{minor}, below 8.0")).bt()
            );
        }
        let ptx = compile_ptx(include_str!("kernels.cu")).map_err(Error::wrap)?;
        let module = context.load_module(ptx).map_err(Error::wrap)?;
        let functions = NAMES.iter().map(|name| module.load_function(name).map_err(Error::wrap));
        Ok(Self { device, functions: functions.collect::<Result<_>>()? })
    }

    pub(super) fn functions(&self) -> Functions {
        self.functions.clone()
    }

    pub(super) fn device(&self) -> &CudaDevice {
        self.device
    }

    pub(super) fn function(&self, kernel: Kernel) -> &CudaFunction {
        &self.functions[kernel as usize]
    }
}
