//! Whole files: read within a limit, and written so that a failure leaves nothing half-written behind.

use std::fs;
use std::io::Read;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};

use crate::error::{Error, Result};
use candle_core::Tensor;

/// Bytes of a configuration or vocabulary, at most. Published vocabularies have 7 to 20 MB.
pub(crate) const TEXT_LIMIT: u64 = 64 << 20;

/// Reads a file that holds text. One beyond [`TEXT_LIMIT`], or without an end, is refused before it fills the memory.
pub(crate) fn read_text(path: &Path) -> Result<Vec<u8>> {
    read_within(path, TEXT_LIMIT)
}

/// Reads a whole file of at most `limit` bytes.
pub(crate) fn read_within(path: &Path, limit: u64) -> Result<Vec<u8>> {
    let file = fs::File::open(path).map_err(Error::io(path))?;
    let mut bytes = Vec::new();
    file.take(limit + 1).read_to_end(&mut bytes).map_err(Error::io(path))?;
    if bytes.len() as u64 > limit {
        return Err(Error::format(path, "more bytes", format!("at most {limit} bytes")));
    }
    Ok(bytes)
}

/// The extension of a file's name in lower case; empty where it has none.
pub(crate) fn extension(path: &Path) -> String {
    path.extension().and_then(|e| e.to_str()).unwrap_or("").to_ascii_lowercase()
}

/// The error for an extension that no reader or writer knows.
pub(crate) fn unknown_extension(path: &Path, extension: &str, expected: &str) -> Error {
    Error::format(path, format!("file name extension {extension:?}"), expected)
}

/// Writes the bytes beside the target and renames them into place: on any error the target is as it was before.
pub(crate) fn write_whole(path: &Path, bytes: &[u8]) -> Result<()> {
    place_whole(path, |part| fs::write(part, bytes))
}

/// Lets `make` make a file beside the target, and renames it into place: on any error the target is as it was before.
pub(crate) fn place_whole(path: &Path, make: impl FnOnce(&Path) -> std::io::Result<()>) -> Result<()> {
    let part = part_path(path)?;
    let written = make(&part).and_then(|()| fs::rename(&part, path));
    if written.is_err() {
        // The first error is the one to report; the part file may not even exist.
        let _ = fs::remove_file(&part);
    }
    written.map_err(Error::io(path))
}

/// Writes tensors by name as a whole safetensors file, each in its own type.
pub(crate) fn write_tensors<'a>(
    path: &Path,
    tensors: impl IntoIterator<Item = (&'a String, &'a Tensor)>,
) -> Result<()> {
    let bytes = safetensors::serialize(tensors, None)
        .map_err(|e| Error::format(path, e.to_string(), "tensors that safetensors can hold"))?;
    write_whole(path, &bytes)
}

/// Where the bytes of a file stand until they are whole: a name that no other process of this machine and no other thread writes to.
fn part_path(path: &Path) -> Result<PathBuf> {
    static WRITTEN: AtomicU64 = AtomicU64::new(0);
    let Some(name) = path.file_name() else {
        return Err(Error::argument("path", path.display(), "a path that ends in a file name"));
    };
    let mut part = std::ffi::OsString::from(".");
    part.push(name);
    part.push(format!(".{}-{}.part", std::process::id(), WRITTEN.fetch_add(1, Ordering::Relaxed)));
    Ok(path.with_file_name(part))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn replaces_the_target_and_leaves_no_part_file() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.bin");
        write_whole(&path, b"first").unwrap();
        write_whole(&path, b"second").unwrap();
        assert_eq!(fs::read(&path).unwrap(), b"second");
        assert_eq!(fs::read_dir(dir.path()).unwrap().count(), 1);
    }

    /// With one name of the part for all threads, one would rename what another is still writing.
    #[test]
    fn threads_that_write_one_file_leave_one_of_their_contents() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.bin");
        std::thread::scope(|scope| {
            for byte in 0..4u8 {
                let path = &path;
                scope.spawn(move || {
                    (0..50).for_each(|_| write_whole(path, &vec![byte; 1 << 16]).unwrap());
                });
            }
        });
        let left = fs::read(&path).unwrap();
        assert!(left.len() == 1 << 16 && left.iter().all(|byte| *byte == left[0]));
        assert_eq!(fs::read_dir(dir.path()).unwrap().count(), 1);
    }

    #[test]
    fn a_file_is_read_up_to_the_limit_and_not_beyond() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.json");
        write_whole(&path, b"12345").unwrap();
        assert_eq!(read_within(&path, 5).unwrap(), b"12345");
        let error = read_within(&path, 4).unwrap_err().to_string();
        assert!(error.contains("a.json") && error.contains("at most 4 bytes"), "{error}");
        assert!(matches!(read_text(&dir.path().join("none")), Err(Error::Io { .. })));
        if Path::new("/dev/zero").exists() {
            assert!(matches!(read_text(Path::new("/dev/zero")), Err(Error::Format { .. })));
        }
    }

    #[test]
    fn a_failed_write_leaves_nothing() {
        let dir = tempfile::tempdir().unwrap();
        let target = dir.path().join("is_a_directory");
        fs::create_dir(&target).unwrap();
        assert!(matches!(write_whole(&target, b"x"), Err(Error::Io { .. })));
        assert!(matches!(write_whole(&dir.path().join("no/such/place"), b"x"), Err(Error::Io { .. })));
        assert!(write_whole(Path::new("/"), b"x").is_err());
        assert_eq!(fs::read_dir(dir.path()).unwrap().count(), 1);
    }
}
