//! Fetching what the cache lacks, through the `hf-hub` crate.

use super::{Download, Files, Hub, Request, is_commit, newer};
use crate::error::{Error, Result};
use crate::vlm::checkpoint::shards::{INDEX, SINGLE, shard_names};
use hf_hub::api::Progress;
use hf_hub::api::sync::{Api, ApiBuilder, ApiRepo};
use hf_hub::{Cache, Repo, RepoType};
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

/// Attempts that follow a broken download, each going on where the last one ended.
const RETRIES: usize = 3;

impl Hub {
    /// Fetches what the revision's folder lacks; `missing` is for messages, until the hub was heard.
    pub(super) fn fetch(&self, request: &Request, missing: Vec<String>) -> Result<PathBuf> {
        let api = self.api(request, &missing)?;
        let repo = |revision: &str| {
            Repo::with_revision(request.repository.to_string(), RepoType::Model, revision.to_string())
        };
        let info = api.repo(repo(request.revision)).info();
        let info = info.map_err(|e| self.error(request, missing.clone(), e.to_string()))?;
        if !is_commit(&info.sha) {
            return Err(self.error(request, missing, format!("the hub named the commit {:?}", info.sha)));
        }
        let there: BTreeSet<&str> = info.siblings.iter().map(|s| s.rfilename.as_str()).collect();
        let fetch = Fetch {
            hub: self,
            request,
            // By its commit, so that all files are of one state even if a branch moves meanwhile.
            repo: api.repo(repo(&info.sha)),
            dir: self.folder(request).join("snapshots").join(&info.sha),
        };
        fetch.all(&there)?;
        if !is_commit(request.revision) {
            let reference = Cache::new(self.cache.clone()).repo(repo(request.revision));
            reference.create_ref(&info.sha).map_err(Error::io(&fetch.dir))?;
        }
        Ok(fetch.dir)
    }

    fn api(&self, request: &Request, missing: &[String]) -> Result<Api> {
        ApiBuilder::from_cache(Cache::new(self.cache.clone()))
            .with_endpoint(self.endpoint.clone())
            .with_token(self.token.clone())
            .with_user_agent("sdim", env!("CARGO_PKG_VERSION"))
            .with_retries(RETRIES)
            .with_progress(false)
            .build()
            .map_err(|e| self.error(request, missing.to_vec(), e.to_string()))
    }
}

/// The download of one state of a repository.
struct Fetch<'a> {
    hub: &'a Hub,
    request: &'a Request<'a>,
    repo: ApiRepo,
    /// Where its files appear.
    dir: PathBuf,
}

impl Fetch<'_> {
    fn all(&self, there: &BTreeSet<&str>) -> Result<()> {
        let files = self.request.files;
        let there_or_newer = |name: &&'static str| match newer(name) {
            Some(newer) if !there.contains(name) && there.contains(newer) => newer,
            _ => *name,
        };
        let mut wanted: Vec<&str> = files.required().iter().map(there_or_newer).collect();
        if files == Files::Checkpoint {
            wanted.push(if there.contains(SINGLE) { SINGLE } else { INDEX });
        }
        self.expect(wanted.iter().copied(), there)?;
        let optional = files.optional().iter().filter(|name| there.contains(*name));
        wanted.extend(optional);
        for name in &wanted {
            self.file(name)?;
        }
        if wanted.contains(&INDEX) {
            let shards = shard_names(&self.dir.join(INDEX))?;
            self.expect(shards.iter().map(String::as_str), there)?;
            shards.iter().try_for_each(|shard| self.file(shard))?;
        }
        Ok(())
    }

    /// What the repository does not have is said before gigabytes are fetched.
    fn expect<'n>(&self, names: impl Iterator<Item = &'n str>, there: &BTreeSet<&str>) -> Result<()> {
        let absent: Vec<String> = names.filter(|n| !there.contains(n)).map(String::from).collect();
        if absent.is_empty() {
            return Ok(());
        }
        Err(self.hub.error(self.request, absent, "the repository has no such files"))
    }

    fn file(&self, name: &str) -> Result<()> {
        if self.dir.join(name).exists() {
            return Ok(());
        }
        tracing::info!(repository = self.request.repository, name, "fetching");
        let meter = Meter { hub: self.hub, download: Download { file: name.to_string(), done: 0, total: 0 } };
        let done = self.repo.download_with_progress(name, meter);
        let path = done.map_err(|e| self.hub.error(self.request, vec![name.to_string()], e.to_string()))?;
        if path.as_path() == self.dir.join(name) {
            return Ok(());
        }
        let found = path.parent().and_then(Path::file_name).unwrap_or_default().display().to_string();
        Err(self.hub.error(
            self.request,
            vec![name.to_string()],
            format!("the hub sent that of commit {found}"),
        ))
    }
}

/// Hands the client's counts on.
struct Meter<'a> {
    hub: &'a Hub,
    download: Download,
}

impl Meter<'_> {
    fn tell(&self) {
        if let Some(progress) = &self.hub.progress {
            progress(&self.download);
        }
    }
}

impl Progress for Meter<'_> {
    fn init(&mut self, size: usize, _: &str) {
        // Also called when a broken download goes on: the count starts again at what is already here.
        (self.download.done, self.download.total) = (0, size as u64);
        self.tell();
    }

    fn update(&mut self, size: usize) {
        self.download.done += size as u64;
        self.tell();
    }

    fn finish(&mut self) {
        self.tell();
    }
}
