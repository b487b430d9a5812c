//! What programs around the library ask of the machine.

use crate::error::{Error, Result};
use candle_core::Device;

/// Opens a device by its usual name: `cpu`, `cuda`, `cuda:N` or `metal`.
///
/// # Errors
/// [`Error::Argument`] on another name; [`Error::Tensors`] if this build or machine has no such device.
pub fn device(name: &str) -> Result<Device> {
    let index = |n: &str| n.parse().map_err(|_| Error::argument("device", name, "cpu, cuda:N or metal"));
    match name.split_once(':') {
        None if name == "cpu" => Ok(Device::Cpu),
        None if name == "cuda" => Ok(Device::new_cuda(0)?),
        None if name == "metal" => Ok(Device::new_metal(0)?),
        Some(("cuda", n)) => Ok(Device::new_cuda(index(n)?)?),
        _ => Err(Error::argument("device", name, "cpu, cuda:N or metal")),
    }
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
    fn devices_by_name() {
        assert!(device("cpu").unwrap().is_cpu());
        for bad in ["", "gpu", "cuda:x", "cpu:0"] {
            assert!(matches!(device(bad), Err(Error::Argument { .. })), "{bad}");
        }
    }
}
