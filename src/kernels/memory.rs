//! What the C library does with large buffers that are freed.

/// Asks the allocator to keep freed memory for the next buffer rather than return it to the system,
/// for the whole process. Returns whether it could: only with glibc, else nothing happens.
///
/// A training step frees and allocates buffers of tens of megabytes; with glibc's defaults each one
/// comes as fresh pages, whose faults cost several times the arithmetic. The price is that the
/// process keeps its peak memory, so this is for a program to choose, at its start: the library
/// never calls it.
pub fn keep_freed_memory() -> bool {
    #[cfg(all(target_os = "linux", target_env = "gnu"))]
    {
        use libc::{M_ARENA_MAX, M_MMAP_MAX, M_TOP_PAD, M_TRIM_THRESHOLD, mallopt};
        // SAFETY: `mallopt` takes two ints and may be called at any time.
        unsafe {
            // One arena: those of other threads hold no more than 64 MB, and are given back.
            mallopt(M_ARENA_MAX, 1) == 1
                && mallopt(M_MMAP_MAX, 0) == 1
                && mallopt(M_TRIM_THRESHOLD, i32::MAX) == 1
                && mallopt(M_TOP_PAD, 64 << 20) == 1
        }
    }
    #[cfg(not(all(target_os = "linux", target_env = "gnu")))]
    false
}

#[cfg(test)]
mod tests {
    #[test]
    #[cfg(all(target_os = "linux", target_env = "gnu"))]
    fn glibc_takes_the_settings() {
        assert!(super::keep_freed_memory());
        // Allocation goes on as before, small and large.
        for size in [1usize, 1 << 12, 1 << 26] {
            let buffer = vec![1u8; size];
            assert_eq!(buffer[size - 1], 1);
        }
    }
}
