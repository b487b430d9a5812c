//! Where repositories are kept and fetched from, and what is found of one.

use std::path::PathBuf;
use std::sync::Arc;

/// How far the download of one file is.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Download {
    /// Name of the file in its repository.
    pub file: String,
    /// Bytes that are here.
    pub done: u64,
    /// Bytes in all.
    pub total: u64,
}

/// Is told how far a download is.
pub type OnDownload = Arc<dyn Fn(&Download) + Send + Sync>;

/// Where repositories are kept and fetched from.
#[derive(Clone)]
pub struct Hub {
    /// The cache: a folder of `models--OWNER--NAME` folders.
    pub cache: PathBuf,
    /// Address of the hub, without a slash at the end.
    pub endpoint: String,
    /// Sent with every request; gated and private repositories need it.
    pub token: Option<String>,
    /// Whether requests are forbidden.
    pub offline: bool,
    /// Called as a download goes on.
    pub progress: Option<OnDownload>,
}

/// A checkpoint in the cache.
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub struct Snapshot {
    /// Its folder.
    pub dir: PathBuf,
    /// Its commit.
    pub commit: String,
    /// Files that the repository may have and that are not here, since the hub could not be asked. With `sdim.json` among
    /// them, this may be a checkpoint for depth that will be taken for a plain Qwen2.5-VL. Empty once the hub was asked.
    pub unknown: Vec<String>,
}

impl Snapshot {
    /// Used as it is, though something could not be asked.
    pub(super) fn doubted(self, reason: &str) -> Self {
        let (dir, unknown) = (self.dir.display(), &self.unknown);
        tracing::warn!(%dir, ?unknown, reason, "used without knowing whether the repository has more files");
        self
    }
}

impl std::fmt::Debug for Hub {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        // A token does not belong into logs.
        f.debug_struct("Hub")
            .field("cache", &self.cache)
            .field("endpoint", &self.endpoint)
            .field("token", &self.token.as_ref().map(|_| "***"))
            .field("offline", &self.offline)
            .finish_non_exhaustive()
    }
}
