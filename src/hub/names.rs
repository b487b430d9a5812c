//! Names that a repository, a revision or a file may have.

use crate::error::{Error, Result};

/// Both names become parts of paths and addresses; the rules are those of the hub.
pub(super) fn check_repository(repository: &str) -> Result<()> {
    let part = |p: &str| {
        is_name(p) && p.len() <= 96 && !p.starts_with(['-', '.']) && !p.contains("--") && !p.contains("..")
    };
    if repository.split('/').count() <= 2 && repository.split('/').all(part) {
        return Ok(());
    }
    Err(Error::argument("repository", format!("{repository:?}"), "OWNER/NAME, as the hub writes it"))
}

pub(super) fn is_name(part: &str) -> bool {
    !part.is_empty() && part.bytes().all(|b| b.is_ascii_alphanumeric() || b"-._".contains(&b))
}

pub(super) fn is_commit(revision: &str) -> bool {
    revision.len() == 40 && revision.bytes().all(|b| b.is_ascii_hexdigit())
}
