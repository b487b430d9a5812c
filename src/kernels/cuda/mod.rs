//! CUDA devices: what one is told before it works, and kernels of ours.
//!
//! `kernels.cu` holds the kernels, `compiled` compiles them for a device, `launches` calls them, `trial` says whether they may be used.

mod compiled;
mod launches;
mod trial;

pub(super) use launches::{
    fits, heads_first, heads_last, probabilities, product, rms_norm, shared_probabilities, swiglu, widen,
};

use crate::error::Result;
use candle_core::cuda_backend::cudarc::driver::{DriverError, result, sys};
use candle_core::{CudaDevice, Device};
use std::ffi::c_void;

/// Readies a device that has one stream, on which all of its work runs.
pub(crate) fn prepare(device: &CudaDevice) -> Result<()> {
    // SAFETY: events order what several streams do with one tensor. Tensors of this device are allocated, used and freed on its one
    // stream, and candle refuses to use those of two devices together.
    unsafe { device.disable_event_tracking() };
    // Cards without memory pools take and give back memory directly.
    if device.cuda_stream().context().has_async_alloc() {
        keep_freed_memory(device).map_err(candle_core::Error::wrap)?;
    }
    Ok(())
}

/// Our kernels for a device, where it has some: a CUDA device of compute capability 8 or more.
pub(super) fn kernels(device: &Device) -> Option<compiled::Compiled<'_>> {
    match device {
        Device::Cuda(cuda) => trial::kernels(cuda),
        _ => None,
    }
}

/// Whether candle's kernels for bf16 are there for the device: they are from compute capability 8 (Ampere) on.
pub(crate) fn multiplies_bf16(device: &CudaDevice) -> bool {
    device.cuda_stream().context().compute_capability().is_ok_and(|(major, _)| major >= 8)
}

/// Lets the pool keep what is freed: by default all of it goes back to the driver whenever the host waits for the device, and the next
/// tensors are slow to get.
fn keep_freed_memory(device: &CudaDevice) -> std::result::Result<(), DriverError> {
    let context = device.cuda_stream().context().clone();
    let mut pool = std::ptr::null_mut();
    let mut threshold = u64::MAX;
    let attribute = sys::CUmemPool_attribute_enum::CU_MEMPOOL_ATTR_RELEASE_THRESHOLD;
    // SAFETY: the device is that of a live context; the attribute is a u64, which is read during the call.
    unsafe {
        sys::cuDeviceGetDefaultMemPool(&mut pool, context.cu_device()).result()?;
        sys::cuMemPoolSetAttribute(pool, attribute, (&raw mut threshold).cast::<c_void>()).result()
    }
}

/// Bytes of the device's memory that are in use, by this process and others.
pub(crate) fn held_bytes(device: &CudaDevice) -> Option<u64> {
    let context = device.cuda_stream().context().clone();
    context.bind_to_thread().ok()?;
    let (free, total) = result::mem_get_info().ok()?;
    Some((total - free) as u64)
}
