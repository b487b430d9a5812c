//! Writing files so that a failure leaves nothing half-written behind.

use std::fs;
use std::path::{Path, PathBuf};

use crate::error::{Error, Result};

/// Writes the bytes beside the target and renames them into place: on any error the target is as it was before.
pub(crate) fn write_whole(path: &Path, bytes: &[u8]) -> Result<()> {
    let part = part_path(path)?;
    let written = fs::write(&part, bytes).and_then(|()| fs::rename(&part, path));
    if written.is_err() {
        // The first error is the one to report; the part file may not even exist.
        let _ = fs::remove_file(&part);
    }
    written.map_err(Error::io(path))
}

fn part_path(path: &Path) -> Result<PathBuf> {
    let Some(name) = path.file_name() else {
        return Err(Error::argument("path", path.display(), "a path that ends in a file name"));
    };
    let mut part = std::ffi::OsString::from(".");
    part.push(name);
    part.push(format!(".{}.part", std::process::id()));
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
