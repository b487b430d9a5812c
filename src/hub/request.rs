//! What is asked of a hub.

use super::files::Files;
use super::names::{check_repository, is_name};
use crate::error::{Error, Result};

/// What is asked of a hub.
pub(super) struct Request<'a> {
    pub(super) repository: &'a str,
    pub(super) revision: &'a str,
    pub(super) files: Files,
}

impl Request<'_> {
    pub(super) fn check(&self) -> Result<()> {
        check_repository(self.repository)?;
        let parts = self.revision.split('/');
        if parts.into_iter().all(|part| is_name(part) && part != "." && part != "..") {
            return Ok(());
        }
        Err(Error::argument("revision", format!("{:?}", self.revision), "a branch, a tag or a commit"))
    }
}
