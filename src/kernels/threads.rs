//! Which thread works on tensors.
//!
//! A device other than the CPU does what it is given in the order in which it is given, and what one thread hands it after another
//! need not come in that order. Work on its tensors therefore stays on the thread that asked for it: this file is the only one
//! that moves work on tensors to other threads, and does so on the CPU alone.

use candle_core::{Device, DeviceLocation};

/// Runs `f`, which works on tensors of this device, where it runs best. On the CPU that is a thread of the pool: from any other, each
/// parallel operation inside `f` would put its thread to sleep and wake it again, which costs more than a small operation.
pub(crate) fn in_pool<R: Send>(device: &Device, f: impl FnOnce() -> R + Send) -> R {
    if may_change_threads(location(device)) { rayon::scope(|_| f()) } else { f() }
}

/// Runs both, which work on tensors of this device: side by side on the CPU, else one after the other.
#[cfg(any(feature = "train", test))]
pub(crate) fn join<A: Send, B: Send>(
    device: &Device,
    a: impl FnOnce() -> A + Send,
    b: impl FnOnce() -> B + Send,
) -> (A, B) {
    if may_change_threads(location(device)) { rayon::join(a, b) } else { (a(), b()) }
}

/// Whether work on tensors that lie there may go on on another thread.
fn may_change_threads(location: DeviceLocation) -> bool {
    matches!(location, DeviceLocation::Cpu)
}

#[cfg(not(test))]
fn location(device: &Device) -> DeviceLocation {
    device.location()
}

#[cfg(test)]
fn location(device: &Device) -> DeviceLocation {
    witness::PRETENDED.get().unwrap_or(device.location())
}

/// Tells which threads our kernels were called on, and lets tensors of the CPU pass for those of another device.
#[cfg(test)]
pub(super) mod witness {
    use candle_core::DeviceLocation;
    use std::cell::Cell;
    use std::collections::BTreeSet;
    use std::sync::Mutex;

    thread_local! {
        pub(super) static PRETENDED: Cell<Option<DeviceLocation>> = const { Cell::new(None) };
    }

    /// Threads of this name are watched.
    const NAME: &str = "witness";
    static CALLED: Mutex<BTreeSet<String>> = Mutex::new(BTreeSet::new());
    /// One test watches at a time.
    static WATCH: Mutex<()> = Mutex::new(());

    /// A kernel reads a tensor on this thread.
    pub(in super::super) fn called() {
        if let Some(name) = std::thread::current().name().filter(|name| name.starts_with(NAME)) {
            CALLED.lock().unwrap().insert(name.to_string());
        }
    }

    /// Runs `f` on a thread of a pool with others at hand, its tensors passing for those of `location`. Gives that thread's name
    /// and those of all whose kernels were called.
    pub(super) fn watched(location: DeviceLocation, f: impl FnOnce() + Send) -> (String, BTreeSet<String>) {
        let _watch = WATCH.lock().unwrap_or_else(|e| e.into_inner());
        CALLED.lock().unwrap().clear();
        let pool = rayon::ThreadPoolBuilder::new().num_threads(3).thread_name(|i| format!("{NAME}-{i}"));
        let caller = pool.build().unwrap().install(|| {
            PRETENDED.set(Some(location));
            f();
            std::thread::current().name().unwrap().to_string()
        });
        (caller, CALLED.lock().unwrap().clone())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use candle_core::Tensor;
    use std::thread::current;

    const ELSEWHERE: [DeviceLocation; 2] =
        [DeviceLocation::Cuda { gpu_id: 0 }, DeviceLocation::Metal { gpu_id: 0 }];

    /// Runs `f` as if tensors lay there, on a thread of its own that is not of the pool.
    fn pretending<R: Send>(location: DeviceLocation, f: impl FnOnce() -> R + Send) -> R {
        std::thread::scope(|scope| {
            let run = || {
                witness::PRETENDED.set(Some(location));
                f()
            };
            scope.spawn(run).join().unwrap()
        })
    }

    #[test]
    fn work_stays_with_the_caller_off_the_cpu_and_goes_to_the_pool_on_it() {
        let here = || (current().id(), rayon::current_thread_index().is_some());
        for location in ELSEWHERE {
            pretending(location, || {
                assert_eq!(in_pool(&Device::Cpu, here), (current().id(), false), "{location:?}");
                let (a, b) = join(&Device::Cpu, here, here);
                assert_eq!([a.0, b.0], [current().id(); 2], "{location:?}");
            });
        }
        pretending(DeviceLocation::Cpu, || assert!(in_pool(&Device::Cpu, here).1));
    }

    fn call_a_kernel() {
        let x = Tensor::zeros((1, 8), candle_core::DType::F32, &Device::Cpu).unwrap();
        crate::kernels::add(&x, &x).unwrap();
    }

    #[test]
    fn kernels_on_other_threads_are_seen() {
        let both = std::sync::Barrier::new(2);
        let called = || {
            both.wait();
            call_a_kernel();
        };
        let (_, threads) = witness::watched(DeviceLocation::Cpu, || {
            join(&Device::Cpu, called, called);
        });
        assert_eq!(threads.len(), 2, "{threads:?}");
        let (caller, threads) = witness::watched(ELSEWHERE[0], || {
            join(&Device::Cpu, call_a_kernel, call_a_kernel);
        });
        assert_eq!(threads, [caller].into());
    }

    /// From a frame to its map, in parallel where it is no work on tensors.
    #[cfg(feature = "tiny")]
    #[test]
    fn a_frame_off_the_cpu_is_completed_on_one_thread() {
        use crate::{CompleteOptions, DepthCompleter, QueryPlan, SparseDepth};
        let completer = DepthCompleter::tiny().unwrap();
        let rgb = image::RgbImage::from_fn(96, 64, |x, y| image::Rgb([x as u8, y as u8, (x * y) as u8]));
        let sparse =
            SparseDepth::from_points(96, 64, &[(5, 5, 2.0), (90, 9, 3.0), (40, 60, 4.0), (60, 30, 2.5)]);
        let (sparse, options) =
            (sparse.unwrap(), CompleteOptions { plan: QueryPlan::Stride(8), ..Default::default() });
        for location in ELSEWHERE {
            let complete = || drop(completer.complete(&rgb, &sparse, &options).unwrap());
            let (caller, threads) = witness::watched(location, complete);
            assert_eq!(threads, [caller].into(), "{location:?}");
        }
    }

    /// Files that start threads or move work to them: this one, and those whose threads see no tensor.
    #[test]
    fn no_other_file_moves_work_to_other_threads() {
        const MOVES: [&str; 7] = [
            "rayon::scope",
            "rayon::join",
            "rayon::spawn",
            "in_place_scope",
            "thread::spawn",
            "thread::scope",
            ".install(",
        ];
        // A test and an example of `Latest` complete on a thread of their own, as its users do; a test of files writes one from several.
        const KNOWN: [&str; 4] = ["kernels/threads.rs", "kernels/testing.rs", "stream/latest.rs", "files.rs"];
        let src = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("src");
        let (mut folders, mut found, mut files) = (vec![src.clone()], Vec::new(), 0);
        while let Some(folder) = folders.pop() {
            for entry in std::fs::read_dir(folder).unwrap() {
                let path = entry.unwrap().path();
                if path.is_dir() {
                    folders.push(path);
                    continue;
                }
                let name = path.strip_prefix(&src).unwrap().to_str().unwrap().replace('\\', "/");
                let text = std::fs::read_to_string(&path).unwrap();
                files += 1;
                if MOVES.iter().any(|m| text.contains(m)) {
                    found.push(name);
                }
            }
        }
        found.sort();
        let mut known = KNOWN;
        known.sort();
        assert!(files > 100 && found == known, "{found:?} in {files} files");
    }
}
