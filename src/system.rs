//! What programs around the library ask of the machine.

use crate::error::{Error, Result};
use candle_core::Device;

/// CUDA's handle of the stream that each thread has its own of (`CU_STREAM_PER_THREAD`).
const STREAM_PER_THREAD: usize = 2;

/// Opens a device by its usual name: `cpu`, `cuda`, `cuda:N` or `metal`. One of CUDA has one stream, which does the work of all threads
/// in the order in which it comes.
///
/// # Errors
/// [`Error::Argument`] on another name; [`Error::Tensors`] if this build or machine has no such device.
pub fn device(name: &str) -> Result<Device> {
    let index = |n: &str| n.parse().map_err(|_| Error::argument("device", name, "cpu, cuda:N or metal"));
    match name.split_once(':') {
        None if name == "cpu" => Ok(Device::Cpu),
        None if name == "cuda" => cuda(0),
        None if name == "metal" => Ok(Device::new_metal(0)?),
        Some(("cuda", n)) => cuda(index(n)?),
        _ => Err(Error::argument("device", name, "cpu, cuda:N or metal")),
    }
}

fn cuda(index: usize) -> Result<Device> {
    let device = Device::new_cuda_with_stream(index)?;
    #[cfg(feature = "cuda")]
    if let Device::Cuda(cuda) = &device {
        crate::kernels::prepare(cuda)?;
    }
    Ok(device)
}

/// Bytes of a CUDA device's memory that are in use, by all processes; `None` for other devices. What was freed may stay with the process
/// that had it, so that after some work this is about the most that it took.
pub fn device_memory_bytes(device: &Device) -> Option<u64> {
    match device {
        #[cfg(feature = "cuda")]
        Device::Cuda(cuda) => crate::kernels::held_bytes(cuda),
        _ => None,
    }
}

/// Refuses a device on which the work of one thread does not follow that of another: a model's weights are written by the thread that
/// loads it, and may be read by any.
///
/// # Errors
/// [`Error::Argument`] on a CUDA device that candle made with `Device::new_cuda`.
pub(crate) fn check_order(device: &Device) -> Result<()> {
    if has_one_order(stream(device)) {
        return Ok(());
    }
    let found = format!("{:?} on the stream of each thread", device.location());
    Err(Error::argument(
        "device",
        found,
        "one of sdim::system::device or candle's Device::new_cuda_with_stream",
    ))
}

/// `stream` is the handle of a CUDA stream. The other default stream, of handle 0 or 1, is one for all threads.
fn has_one_order(stream: Option<usize>) -> bool {
    stream != Some(STREAM_PER_THREAD)
}

/// Handle of the stream that a CUDA device works on.
#[cfg(feature = "cuda")]
fn stream(device: &Device) -> Option<usize> {
    match device {
        Device::Cuda(cuda) => Some(cuda.cuda_stream().cu_stream() as usize),
        Device::Cpu | Device::Metal(_) => None,
    }
}

#[cfg(not(feature = "cuda"))]
fn stream(_: &Device) -> Option<usize> {
    None
}

/// The largest resident memory of this process so far, bytes; `None` where the system does not tell (other than Linux).
pub fn peak_rss_bytes() -> Option<u64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find_map(|l| l.strip_prefix("VmHWM:"))?;
    let kilobytes: u64 = line.trim().strip_suffix("kB")?.trim().parse().ok()?;
    Some(kilobytes * 1024)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_stream_of_each_thread_is_refused() {
        // As `cuda.h` numbers them: legacy default, the same by name, per thread, and the address of one of its own.
        for (stream, good) in
            [(None, true), (Some(0), true), (Some(1), true), (Some(2), false), (Some(0x7f00_1234), true)]
        {
            assert_eq!(has_one_order(stream), good, "{stream:?}");
        }
        assert!(check_order(&Device::Cpu).is_ok());
    }

    #[test]
    fn devices_by_name() {
        assert!(device("cpu").unwrap().is_cpu());
        for bad in ["", "gpu", "cuda:x", "cpu:0"] {
            assert!(matches!(device(bad), Err(Error::Argument { .. })), "{bad}");
        }
    }
}
