//! Checkpoints of the Hugging Face hub, from the cache that its Python library keeps (feature `hub`).
//!
//! Offline first: a revision whose files are in the cache is used as it is, without a single request, also when a branch
//! has moved on meanwhile. What is missing is fetched, and of a repository only what this crate reads. The usual variables
//! hold: `HF_HUB_CACHE`, `HUGGINGFACE_HUB_CACHE`, `HF_HOME` and `XDG_CACHE_HOME` (where the cache is), `HF_HUB_OFFLINE` and
//! `TRANSFORMERS_OFFLINE`, `HF_ENDPOINT`, `HF_TOKEN`, `HUGGING_FACE_HUB_TOKEN`, `HF_TOKEN_PATH` and
//! `HF_HUB_DISABLE_IMPLICIT_TOKEN`.
//!
//! ```no_run
//! use sdim::chat::ChatModel;
//! let model = ChatModel::from_pretrained("Qwen/Qwen2.5-VL-7B-Instruct", None, &candle_core::Device::Cpu)?;
//! # Ok::<(), sdim::Error>(())
//! ```
//!
//! This feature brings the only C of the crate: requests go through `hf-hub` and `ureq` with `rustls`, whose cryptography is `ring`.

mod client;
mod environment;

use crate::error::{Error, Result};
use crate::model::SdimModel;
use crate::model::{SETTINGS, TENSORS};
use crate::vlm::chat::ChatModel;
use crate::vlm::chat::generate::GENERATION;
use crate::vlm::checkpoint::shards::{INDEX, SINGLE, shard_names};
use crate::vlm::files::{CONFIG, PREPROCESSOR, PROCESSOR, TOKENIZER};
use candle_core::Device;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// The branch that is meant where no revision is named.
const MAIN: &str = "main";

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

/// The local folder of a checkpoint, as [`Hub::checkpoint`] of the environment's hub.
///
/// # Errors
/// As [`Hub::from_env`] and [`Hub::checkpoint`].
pub fn checkpoint(repository: &str, revision: Option<&str>) -> Result<PathBuf> {
    Hub::from_env()?.checkpoint(repository, revision)
}

/// Whether a name has the form of a repository, `OWNER/NAME`.
pub fn is_repository(name: &str) -> bool {
    name.contains('/') && check_repository(name).is_ok()
}

impl Hub {
    /// The local folder of a checkpoint, complete: `config.json`, `preprocessor_config.json` or `processor_config.json`,
    /// `tokenizer.json`, and `model.safetensors` or its shards with their index; `generation_config.json`, `sdim.json` and
    /// `sdim.safetensors` where the repository has them. `revision` is a branch, a tag or a commit, `main` if none is given.
    ///
    /// # Errors
    /// [`Error::Hub`] lists the files that are not in the cache, and says why they were not fetched; [`Error::Argument`] on
    /// a name that no repository or revision can have; [`Error::Format`] on a damaged cache; [`Error::Io`].
    pub fn checkpoint(&self, repository: &str, revision: Option<&str>) -> Result<PathBuf> {
        self.get(&Request { repository, revision: revision.unwrap_or(MAIN), files: Files::Checkpoint })
    }

    /// The local folder of an adapter repository, with its `sdim.json` and `sdim.safetensors`.
    ///
    /// # Errors
    /// As [`Hub::checkpoint`].
    pub fn adapter(&self, repository: &str, revision: Option<&str>) -> Result<PathBuf> {
        self.get(&Request { repository, revision: revision.unwrap_or(MAIN), files: Files::Adapter })
    }

    fn get(&self, request: &Request) -> Result<PathBuf> {
        request.check()?;
        let missing = match self.snapshot(request)? {
            Some(dir) => match request.files.missing_in(&dir)? {
                missing if missing.is_empty() => return Ok(dir),
                missing => missing,
            },
            // No file of a checkpoint stands there.
            None => request.files.missing_in(&self.folder(request))?,
        };
        if self.offline {
            return Err(self.error(request, missing, "offline, so it was not fetched"));
        }
        self.fetch(request, missing)
    }

    /// The cached folder of the revision, complete or not.
    fn snapshot(&self, request: &Request) -> Result<Option<PathBuf>> {
        let repository = self.folder(request);
        let reference = repository.join("refs").join(request.revision);
        let commit = if is_commit(request.revision) {
            request.revision.to_string()
        } else {
            match std::fs::read_to_string(&reference) {
                Ok(text) => text.trim().to_string(),
                Err(e) if e.kind() == std::io::ErrorKind::NotFound => return Ok(None),
                Err(e) => return Err(Error::io(reference)(e)),
            }
        };
        // The text becomes part of a path.
        if commit.is_empty() || !commit.bytes().all(|b| b.is_ascii_alphanumeric()) {
            return Err(Error::format(reference, format!("{commit:?}"), "a commit"));
        }
        Ok(Some(repository.join("snapshots").join(commit)).filter(|dir| dir.is_dir()))
    }

    fn folder(&self, request: &Request) -> PathBuf {
        self.cache.join(format!("models--{}", request.repository.replace('/', "--")))
    }

    fn error(&self, request: &Request, missing: Vec<String>, reason: impl Into<String>) -> Error {
        Error::Hub {
            repository: request.repository.to_string(),
            revision: request.revision.into(),
            cache: self.cache.as_path().into(),
            missing,
            offline: self.offline,
            reason: reason.into(),
        }
    }
}

/// What is asked of a hub.
struct Request<'a> {
    repository: &'a str,
    revision: &'a str,
    files: Files,
}

impl Request<'_> {
    fn check(&self) -> Result<()> {
        check_repository(self.repository)?;
        let parts = self.revision.split('/');
        if parts.into_iter().all(|part| is_name(part) && part != "." && part != "..") {
            return Ok(());
        }
        Err(Error::argument("revision", format!("{:?}", self.revision), "a branch, a tag or a commit"))
    }
}

/// Both names become parts of paths and addresses; the rules are those of the hub.
fn check_repository(repository: &str) -> Result<()> {
    let part = |p: &str| {
        is_name(p) && p.len() <= 96 && !p.starts_with(['-', '.']) && !p.contains("--") && !p.contains("..")
    };
    if repository.split('/').count() <= 2 && repository.split('/').all(part) {
        return Ok(());
    }
    Err(Error::argument("repository", format!("{repository:?}"), "OWNER/NAME, as the hub writes it"))
}

fn is_name(part: &str) -> bool {
    !part.is_empty() && part.bytes().all(|b| b.is_ascii_alphanumeric() || b"-._".contains(&b))
}

fn is_commit(revision: &str) -> bool {
    revision.len() == 40 && revision.bytes().all(|b| b.is_ascii_hexdigit())
}

/// Which files of a repository are read.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Files {
    Checkpoint,
    Adapter,
}

/// The file that may stand in a required one's place.
fn newer(name: &str) -> Option<&'static str> {
    (name == PREPROCESSOR).then_some(PROCESSOR)
}

impl Files {
    fn required(self) -> &'static [&'static str] {
        match self {
            Files::Checkpoint => &[CONFIG, PREPROCESSOR, TOKENIZER],
            Files::Adapter => &[SETTINGS, TENSORS],
        }
    }

    fn optional(self) -> &'static [&'static str] {
        match self {
            Files::Checkpoint => &[PROCESSOR, GENERATION, SETTINGS, TENSORS],
            Files::Adapter => &[],
        }
    }

    /// The files that must be there and are not; a link whose target is gone counts as missing.
    fn missing_in(self, dir: &Path) -> Result<Vec<String>> {
        let absent =
            |name: &&str| !dir.join(name).exists() && !newer(name).is_some_and(|n| dir.join(n).exists());
        let mut missing: Vec<String> =
            self.required().iter().copied().filter(absent).map(String::from).collect();
        if self == Files::Checkpoint && absent(&SINGLE) {
            let index = dir.join(INDEX);
            if index.exists() {
                missing.extend(shard_names(&index)?.into_iter().filter(|shard| absent(&shard.as_str())));
            } else {
                missing.push(format!("{SINGLE} (or {INDEX} and its shards)"));
            }
        }
        Ok(missing)
    }
}

impl SdimModel {
    /// Like [`SdimModel::load`], for a repository of the hub.
    ///
    /// # Errors
    /// As [`checkpoint`] and [`SdimModel::load`].
    pub fn from_pretrained(repository: &str, revision: Option<&str>, device: &Device) -> Result<Self> {
        Self::load(&checkpoint(repository, revision)?, device)
    }
}

impl ChatModel {
    /// Like [`ChatModel::load`], for a repository of the hub such as `Qwen/Qwen2.5-VL-3B-Instruct`.
    ///
    /// # Errors
    /// As [`checkpoint`] and [`ChatModel::load`].
    pub fn from_pretrained(repository: &str, revision: Option<&str>, device: &Device) -> Result<Self> {
        Self::load(checkpoint(repository, revision)?, device)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_that_would_leave_the_cache_are_refused() {
        for good in ["Qwen/Qwen2.5-VL-7B-Instruct", "a/b", "o_1/n.m-2", "gpt2"] {
            assert!(check_repository(good).is_ok(), "{good}");
        }
        for bad in ["", "/", "a/", "/etc/passwd", "a/b/c", "../a", "a/..", "a/b--c", "a b/c", "a/b?x", ".a/b"]
        {
            assert!(matches!(check_repository(bad), Err(Error::Argument { .. })), "{bad}");
            assert!(!is_repository(bad));
        }
        let with = |revision| Request { repository: "a/b", revision, files: Files::Adapter }.check();
        for good in ["main", "refs/pr/3", "v1.0"] {
            assert!(with(good).is_ok(), "{good}");
        }
        for bad in ["", "..", "../../x", "a//b", "/a", "a b", "a?b"] {
            assert!(matches!(with(bad), Err(Error::Argument { .. })), "{bad}");
        }
    }

    #[test]
    fn a_token_is_not_printed() {
        let token = Some("hf_secret".to_string());
        let hub = Hub { cache: "c".into(), endpoint: "e".into(), token, offline: true, progress: None };
        assert!(!format!("{hub:?}").contains("secret"));
    }
}
