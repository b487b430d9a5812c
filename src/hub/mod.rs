//! Checkpoints of the Hugging Face hub, from the cache that its Python library keeps (feature `hub`).
//!
//! Offline first: a revision whose files are in the cache is used as it is, without a request, also when a branch
//! has moved on meanwhile. What is missing is fetched, and of a repository only what this crate reads: the small files first,
//! which say what else is needed; content that another commit brought is linked, what an interrupted download has left is gone on
//! with, and what the hub names by a checksum is checked by it. Where another program has filled the cache, whether the repository
//! has more files (an `sdim.json`, without which its weights are asked as a plain Qwen2.5-VL) is asked once, and noted
//! where that program notes it too; where nobody can be asked, [`Snapshot::unknown`] tells. The usual variables
//! hold: `HF_HUB_CACHE`, `HUGGINGFACE_HUB_CACHE`, `HF_HOME` and `XDG_CACHE_HOME` (where the cache is), `HF_HUB_OFFLINE` and
//! `TRANSFORMERS_OFFLINE`, `HF_ENDPOINT`, `HF_TOKEN`, `HUGGING_FACE_HUB_TOKEN`, `HF_TOKEN_PATH` and
//! `HF_HUB_DISABLE_IMPLICIT_TOKEN`.
//!
//! ```no_run
//! use sdim::chat::ChatModel;
//! let options = sdim::LoadOptions::default();
//! let model = ChatModel::from_pretrained("Qwen/Qwen2.5-VL-7B-Instruct", None, &options)?;
//! # Ok::<(), sdim::Error>(())
//! ```
//!
//! This feature brings the only C of the crate: requests go through `ureq` with `rustls`, whose cryptography is `ring`.

mod cache;
mod client;
mod environment;
mod fetch;
mod files;
mod names;
mod request;
mod settings;

pub use settings::{Download, Hub, OnDownload, Snapshot};

use crate::complete::DepthCompleter;
use crate::error::{Error, Result};
use crate::vlm::chat::ChatModel;
use crate::vlm::checkpoint::LoadOptions;
use cache::Repository;
use client::Client;
use fetch::Fetch;
use files::Files;
use names::check_repository;
use request::Request;
use std::path::PathBuf;

/// The branch that is meant where no revision is named.
const MAIN: &str = "main";

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
    /// The local folder of a checkpoint: `config.json`, `preprocessor_config.json` or `processor_config.json`,
    /// `tokenizer.json`, and `model.safetensors` or its shards with their index; `generation_config.json`, `sdim.json` and
    /// `sdim.safetensors` where the repository has them, as far as the hub could be asked ([`Hub::snapshot`] tells). `revision` is a
    /// branch, a tag or a commit, `main` if none is given.
    ///
    /// # Errors
    /// [`Error::Hub`] lists the files that are not in the cache, and says why they were not fetched; [`Error::Argument`] on
    /// a name that no repository or revision can have; [`Error::Format`] on a damaged cache; [`Error::Io`].
    pub fn checkpoint(&self, repository: &str, revision: Option<&str>) -> Result<PathBuf> {
        Ok(self.snapshot(repository, revision)?.dir)
    }

    /// The local folder of an adapter repository, with its `sdim.json` and `sdim.safetensors`.
    ///
    /// # Errors
    /// As [`Hub::checkpoint`].
    pub fn adapter(&self, repository: &str, revision: Option<&str>) -> Result<PathBuf> {
        Ok(self.get(&Request { repository, revision: revision.unwrap_or(MAIN), files: Files::Adapter })?.dir)
    }

    /// As [`Hub::checkpoint`], with the commit, and with what is not known of it.
    ///
    /// # Errors
    /// As [`Hub::checkpoint`].
    pub fn snapshot(&self, repository: &str, revision: Option<&str>) -> Result<Snapshot> {
        self.get(&Request { repository, revision: revision.unwrap_or(MAIN), files: Files::Checkpoint })
    }

    fn get(&self, request: &Request) -> Result<Snapshot> {
        request.check()?;
        let repository = Repository::new(&self.cache, request.repository);
        let (missing, complete) = self.cached(request, &repository)?;
        match complete {
            Some(snapshot) if snapshot.unknown.is_empty() => return Ok(snapshot),
            Some(snapshot) if self.offline => return Ok(snapshot.doubted("offline")),
            None if self.offline => {
                return Err(self.error(request, missing, "offline, so it was not fetched"));
            }
            _ => {}
        }
        let client = Client::new(self, request.repository);
        // What is complete stays of its commit, wherever the branch is now.
        let revision = complete.as_ref().map_or(request.revision, |snapshot| &snapshot.commit);
        match (client.listing(revision), complete) {
            (Ok(listing), _) => {
                Fetch { hub: self, request, repository: &repository, client: &client, listing: &listing }
                    .all()
            }
            (Err(refusal), Some(snapshot)) => Ok(snapshot.doubted(&refusal.reason)),
            (Err(refusal), None) => Err(self.error(request, missing, refusal.reason)),
        }
    }

    /// What is missing of the revision as the cache has it; if that is nothing, the revision.
    fn cached(&self, request: &Request, repository: &Repository) -> Result<(Vec<String>, Option<Snapshot>)> {
        let Some(commit) = repository.commit(request.revision)? else {
            // No file of a checkpoint stands among the commits.
            return Ok((request.files.survey(&repository.snapshot(""), &|_| true)?.missing, None));
        };
        let dir = repository.snapshot(&commit);
        let survey = request.files.survey(&dir, &|name| repository.is_known_absent(&commit, name))?;
        let snapshot = survey.missing.is_empty().then_some(Snapshot { dir, commit, unknown: survey.unknown });
        Ok((survey.missing, snapshot))
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

impl DepthCompleter {
    /// Like [`DepthCompleter::load`], for a repository of the hub.
    ///
    /// # Errors
    /// As [`checkpoint`] and [`DepthCompleter::load`].
    pub fn from_pretrained(repository: &str, revision: Option<&str>, options: &LoadOptions) -> Result<Self> {
        Self::load(checkpoint(repository, revision)?, options)
    }
}

impl ChatModel {
    /// Like [`ChatModel::load`], for a repository of the hub such as `Qwen/Qwen2.5-VL-3B-Instruct`.
    ///
    /// # Errors
    /// As [`checkpoint`] and [`ChatModel::load`].
    pub fn from_pretrained(repository: &str, revision: Option<&str>, options: &LoadOptions) -> Result<Self> {
        Self::load(checkpoint(repository, revision)?, options)
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
