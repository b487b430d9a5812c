//! The cache's folders, as the hub's Python library lays them out:
//!
//! ```text
//! models--OWNER--NAME/refs/REVISION              text: a commit
//! models--OWNER--NAME/snapshots/COMMIT/FILE      a link to its content
//! models--OWNER--NAME/blobs/ETAG                 content, once for all commits; ETAG.incomplete while it is fetched
//! models--OWNER--NAME/.no_exist/COMMIT/FILE      empty: this commit has no such file
//! .locks/models--OWNER--NAME/ETAG.lock           held by who fetches that content
//! ```

use super::names::is_commit;
use crate::error::{Error, Result};
use crate::files::{place_whole, write_whole};
use std::fs::{self, File};
use std::io::ErrorKind;
use std::path::{Path, PathBuf};

/// The folders of one repository.
pub(super) struct Repository {
    cache: PathBuf,
    folder: String,
}

impl Repository {
    pub(super) fn new(cache: &Path, repository: &str) -> Self {
        Self { cache: cache.to_path_buf(), folder: format!("models--{}", repository.replace('/', "--")) }
    }

    fn root(&self) -> PathBuf {
        self.cache.join(&self.folder)
    }

    /// The commit that a revision is known to be.
    pub(super) fn commit(&self, revision: &str) -> Result<Option<String>> {
        if is_commit(revision) {
            return Ok(Some(revision.to_string()));
        }
        let reference = self.reference(revision);
        let text = match fs::read_to_string(&reference) {
            Ok(text) => text,
            Err(e) if e.kind() == ErrorKind::NotFound => return Ok(None),
            Err(e) => return Err(Error::io(reference)(e)),
        };
        let commit = text.trim();
        // It becomes part of a path.
        if commit.is_empty() || !commit.bytes().all(|b| b.is_ascii_alphanumeric()) {
            return Err(Error::format(reference, format!("{commit:?}"), "a commit"));
        }
        Ok(Some(commit.to_string()))
    }

    fn reference(&self, revision: &str) -> PathBuf {
        self.root().join("refs").join(revision)
    }

    /// Notes which commit a revision is. If it is noted already, nothing is written: a cache may be for reading alone.
    pub(super) fn refer(&self, revision: &str, commit: &str) -> Result<()> {
        let noted = || Ok::<_, Error>(self.commit(revision)?.as_deref() == Some(commit));
        if noted()? {
            return Ok(());
        }
        let _lock = self.lock(commit)?;
        if noted()? {
            return Ok(());
        }
        let reference = self.reference(revision);
        make_parent(&reference)?;
        write_whole(&reference, commit.as_bytes())
    }

    /// Where the files of a commit appear.
    pub(super) fn snapshot(&self, commit: &str) -> PathBuf {
        self.root().join("snapshots").join(commit)
    }

    fn absence(&self, commit: &str, name: &str) -> PathBuf {
        self.root().join(".no_exist").join(commit).join(name)
    }

    /// Whether it was noted that this commit has no such file.
    pub(super) fn is_known_absent(&self, commit: &str, name: &str) -> bool {
        self.absence(commit, name).exists()
    }

    /// Notes that this commit has no such file. In a cache that cannot be written it is asked for again another time.
    pub(super) fn note_absent(&self, commit: &str, name: &str) {
        let note = self.absence(commit, name);
        let noted = make_parent(&note).and_then(|()| File::create(&note).map_err(Error::io(&note)));
        if let Err(error) = noted {
            tracing::debug!(%error, "not noted");
        }
    }

    /// Where content of this name is kept.
    pub(super) fn blob(&self, etag: &str) -> PathBuf {
        self.root().join("blobs").join(etag)
    }

    /// Where it is kept until it is complete.
    pub(super) fn incomplete(&self, etag: &str) -> PathBuf {
        self.root().join("blobs").join(format!("{etag}.incomplete"))
    }

    /// Waits until no other process fetches this content, and keeps others from it until the file is dropped.
    pub(super) fn lock(&self, etag: &str) -> Result<File> {
        let path = self.cache.join(".locks").join(&self.folder).join(format!("{etag}.lock"));
        make_parent(&path)?;
        let file =
            File::options().create(true).write(true).truncate(false).open(&path).map_err(Error::io(&path))?;
        match file.lock() {
            // Some network file systems have no locks; what is written is put in place whole there too.
            Err(e) if e.kind() != ErrorKind::Unsupported => Err(Error::io(&path)(e)),
            _ => Ok(file),
        }
    }

    /// Lets a file of a snapshot be this content, in place of what was there.
    pub(super) fn link(&self, commit: &str, name: &str, etag: &str) -> Result<()> {
        let link = self.snapshot(commit).join(name);
        make_parent(&link)?;
        place_whole(&link, |part| {
            // A link that a crashed process with this id left here goes first: a copy would be written through it into the content.
            let _ = fs::remove_file(part);
            if symlink(&Path::new("../../blobs").join(etag), part).is_err() {
                // Where links are not to be had, the content stands in both places.
                fs::copy(self.blob(etag), part)?;
            }
            Ok(())
        })
    }
}

/// Bytes of a file, through links; `None` if it is not there.
pub(super) fn size(path: &Path) -> Option<u64> {
    fs::metadata(path).ok().filter(fs::Metadata::is_file).map(|m| m.len())
}

pub(super) fn make_parent(path: &Path) -> Result<()> {
    path.parent().map_or(Ok(()), |dir| fs::create_dir_all(dir).map_err(Error::io(dir)))
}

#[cfg(unix)]
fn symlink(target: &Path, link: &Path) -> std::io::Result<()> {
    std::os::unix::fs::symlink(target, link)
}

#[cfg(windows)]
fn symlink(target: &Path, link: &Path) -> std::io::Result<()> {
    std::os::windows::fs::symlink_file(target, link)
}

#[cfg(not(any(unix, windows)))]
fn symlink(_: &Path, _: &Path) -> std::io::Result<()> {
    Err(ErrorKind::Unsupported.into())
}
