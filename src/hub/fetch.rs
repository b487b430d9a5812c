//! Fetching one state of a repository: small files first, content that is here already linked, the rest resumed.

use super::cache::{self, Repository};
use super::client::{Client, Facts, Listing, Refusal};
use super::files::{Files, is_whole};
use super::request::Request;
use super::settings::{Download, Hub, Snapshot};
use crate::error::{Error, Result};
use crate::model::TENSORS;
use crate::vlm::checkpoint::shards::{INDEX, SINGLE, shard_names};
use ring::digest;
use std::fs::File;
use std::io::{Read, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};
use std::time::Duration;

/// Attempts that follow a broken download, each going on where the last one ended.
const RETRIES: u32 = 3;
/// How long the first of them waits; each other waits twice as long.
const WAIT: Duration = Duration::from_millis(250);
/// Bytes that are written at once.
const BUFFER: usize = 1 << 20;

/// The download of one state of a repository.
pub(super) struct Fetch<'a> {
    pub(super) hub: &'a Hub,
    pub(super) request: &'a Request<'a>,
    pub(super) repository: &'a Repository,
    pub(super) client: &'a Client<'a>,
    pub(super) listing: &'a Listing,
}

impl Fetch<'_> {
    /// Fetches what the snapshot lacks and notes what the repository lacks.
    pub(super) fn all(&self) -> Result<Snapshot> {
        let (files, commit) = (self.request.files, &self.listing.commit);
        let dir = self.repository.snapshot(commit);
        let mut small = files.required_of(&|name| self.has(name));
        // Where a repository has both forms of the weights, those that are here are enough.
        let in_shards = || self.has(INDEX) && dir.join(INDEX).exists() && !dir.join(SINGLE).exists();
        let sharded = files == Files::Checkpoint && (!self.has(SINGLE) || in_shards());
        let whole = files == Files::Checkpoint && !sharded;
        if sharded {
            small.push(INDEX);
        }
        self.expect(small.iter().copied())?;
        let optional = files.optional().iter().copied();
        small.extend(optional.filter(|name| *name != TENSORS && self.has(name)));
        small.iter().try_for_each(|name| self.file(&dir, name))?;
        // What the small files ask for is known before gigabytes are fetched.
        let mut large: Vec<String> =
            if sharded { shard_names(&dir.join(INDEX))?.into_iter().collect() } else { vec![] };
        large.extend(whole.then(|| SINGLE.to_string()));
        let survey = files.survey(&dir, &|name| !self.has(name))?;
        if self.has(TENSORS) || survey.missing.iter().any(|name| name == TENSORS) {
            large.push(TENSORS.into());
        }
        self.expect(large.iter().map(String::as_str))?;
        large.iter().try_for_each(|name| self.file(&dir, name))?;
        self.finish(dir)
    }

    /// Nothing may be missing now; only then does the revision name this state.
    fn finish(&self, dir: PathBuf) -> Result<Snapshot> {
        let (files, commit) = (self.request.files, &self.listing.commit);
        for name in files.optional().iter().filter(|name| !self.has(name)) {
            self.repository.note_absent(commit, name);
        }
        let missing = files.survey(&dir, &|name| !self.has(name))?.missing;
        if !missing.is_empty() {
            let reason = "the repository has no such files, or damaged ones";
            return Err(self.hub.error(self.request, missing, reason));
        }
        self.repository.refer(self.request.revision, commit)?;
        Ok(Snapshot { dir, commit: commit.clone(), unknown: Vec::new() })
    }

    fn has(&self, name: &str) -> bool {
        self.listing.files.contains_key(name)
    }

    /// What the repository does not have is told before more is fetched.
    fn expect<'n>(&self, names: impl Iterator<Item = &'n str>) -> Result<()> {
        let absent: Vec<String> = names.filter(|name| !self.has(name)).map(String::from).collect();
        if absent.is_empty() {
            return Ok(());
        }
        Err(self.hub.error(self.request, absent, "the repository has no such files"))
    }

    /// Puts a file of the listing into the snapshot.
    fn file(&self, dir: &Path, name: &str) -> Result<()> {
        if self.is_here(dir, name)? {
            return Ok(());
        }
        let commit = &self.listing.commit;
        let facts = self.client.facts(commit, name).map_err(|refusal| self.refused(name, refusal))?;
        if facts.commit != *commit {
            let reason = format!("the hub sent that of commit {}", facts.commit);
            return Err(self.hub.error(self.request, vec![name.into()], reason));
        }
        let facts = Facts { size: facts.size.or(self.listed(name)), ..facts };
        let _lock = self.repository.lock(&facts.etag)?;
        // Who held the lock may have put it in place, and others read it there by now.
        if self.is_here(dir, name)? {
            return Ok(());
        }
        let blob = self.repository.blob(&facts.etag);
        let kept = cache::size(&blob);
        if kept.is_none() || (facts.size.is_some() && kept != facts.size) || !is_whole(name, &blob)? {
            tracing::info!(repository = self.request.repository, name, "fetching");
            self.content(name, &facts)?;
        }
        self.repository.link(commit, name, &facts.etag)
    }

    /// Bytes of a file, where the listing says so.
    fn listed(&self, name: &str) -> Option<u64> {
        self.listing.files.get(name).copied().flatten()
    }

    /// Whether the snapshot has this file as the repository lists it.
    fn is_here(&self, dir: &Path, name: &str) -> Result<bool> {
        let (listed, here) = (self.listed(name), cache::size(&dir.join(name)));
        Ok(here.is_some() && (listed.is_none() || here == listed) && is_whole(name, &dir.join(name))?)
    }

    /// Fetches content to where it is kept.
    fn content(&self, name: &str, facts: &Facts) -> Result<()> {
        let path = self.repository.incomplete(&facts.etag);
        cache::make_parent(&path)?;
        let mut part = Part::open(&path, facts)?;
        let mut resumed = part.len > 0;
        let mut waits = (0..RETRIES).map(|retry| WAIT * 2u32.pow(retry));
        loop {
            match self.rest(name, facts, &mut part)? {
                Ok(()) if part.is_right() => {
                    drop(part);
                    let blob = self.repository.blob(&facts.etag);
                    return std::fs::rename(&path, &blob).map_err(Error::io(blob));
                }
                // What was left here may be of anything: once more, from the start.
                Ok(()) if resumed => {
                    part.cut()?;
                    resumed = false;
                }
                Ok(()) => {
                    part.cut()?;
                    let reason = format!("its bytes are not those of {}", facts.etag);
                    return Err(self.hub.error(self.request, vec![name.into()], reason));
                }
                Err(refusal) => match waits.next().filter(|_| refusal.passing) {
                    Some(wait) => {
                        tracing::info!(name, reason = refusal.reason, "going on");
                        std::thread::sleep(wait);
                    }
                    None => return Err(self.refused(name, refusal)),
                },
            }
        }
    }

    /// Appends what is not here yet. The outer result is that of the disk, the inner one the network's.
    fn rest(&self, name: &str, facts: &Facts, part: &mut Part) -> Result<std::result::Result<(), Refusal>> {
        let broke = |reason: String| Ok(Err(Refusal { reason: format!("{name}: {reason}"), passing: true }));
        if facts.size.is_some_and(|size| part.len == size) && part.hash.is_some() {
            return Ok(Ok(()));
        }
        // All that is needed may be here, or what is too much; only from the start can that be told.
        if facts.size.is_none_or(|size| part.len >= size) {
            part.cut()?;
        }
        let mut stream = match self.client.bytes(&facts.commit, name, part.len) {
            Ok(stream) => stream,
            Err(refusal) => return Ok(Err(refusal)),
        };
        if stream.start != part.len {
            part.cut()?;
            if stream.start != 0 {
                return broke(format!("bytes from {} on, not from {}", stream.start, part.len));
            }
        }
        let total = match (facts.size, stream.total) {
            (Some(size), Some(total)) if size != total => {
                return broke(format!("{total} bytes, expected {size}"));
            }
            (size, total) => size.or(total),
        };
        let mut buffer = vec![0; BUFFER];
        loop {
            self.tell(name, part.len, total);
            match stream.body.read(&mut buffer) {
                Ok(0) => break,
                Ok(count) => part.append(&buffer[..count])?,
                Err(e) if e.kind() == std::io::ErrorKind::Interrupted => {}
                Err(e) => return broke(e.to_string()),
            }
        }
        match total {
            Some(total) if part.len != total => broke(format!("{} bytes, expected {total}", part.len)),
            _ => Ok(Ok(())),
        }
    }

    fn tell(&self, name: &str, done: u64, total: Option<u64>) {
        if let Some(progress) = &self.hub.progress {
            progress(&Download { file: name.to_string(), done, total: total.unwrap_or(done) });
        }
    }

    fn refused(&self, name: &str, refusal: Refusal) -> Error {
        self.hub.error(self.request, vec![name.to_string()], refusal.reason)
    }
}

/// A file on its way, and what its bytes so far add up to.
struct Part {
    path: PathBuf,
    file: File,
    len: u64,
    /// Of content that is named by its SHA-256.
    hash: Option<(digest::Context, String)>,
}

impl Part {
    /// Goes on with what an earlier attempt has left.
    fn open(path: &Path, facts: &Facts) -> Result<Self> {
        let file = File::options().read(true).write(true).create(true).truncate(false).open(path);
        let mut file = file.map_err(Error::io(path))?;
        let named = facts.etag.len() == 64 && facts.etag.bytes().all(|b| b.is_ascii_hexdigit());
        let mut hash =
            named.then(|| (digest::Context::new(&digest::SHA256), facts.etag.to_ascii_lowercase()));
        if hash.is_none() {
            // Whether it is what was left of this content cannot be told.
            file.set_len(0).map_err(Error::io(path))?;
        }
        let (mut len, mut buffer) = (0, vec![0; BUFFER]);
        loop {
            let count = file.read(&mut buffer).map_err(Error::io(path))?;
            if count == 0 {
                break;
            }
            len += count as u64;
            if let Some((hash, _)) = &mut hash {
                hash.update(&buffer[..count]);
            }
        }
        Ok(Self { path: path.to_path_buf(), file, len, hash })
    }

    fn append(&mut self, bytes: &[u8]) -> Result<()> {
        self.file.write_all(bytes).map_err(Error::io(&self.path))?;
        self.len += bytes.len() as u64;
        if let Some((hash, _)) = &mut self.hash {
            hash.update(bytes);
        }
        Ok(())
    }

    /// Starts anew.
    fn cut(&mut self) -> Result<()> {
        let emptied = self.file.set_len(0).and_then(|()| self.file.seek(SeekFrom::Start(0)));
        emptied.map_err(Error::io(&self.path))?;
        self.len = 0;
        if let Some((hash, _)) = &mut self.hash {
            *hash = digest::Context::new(&digest::SHA256);
        }
        Ok(())
    }

    /// Whether the bytes are those that the content is named by, where that can be told.
    fn is_right(&self) -> bool {
        self.hash.as_ref().is_none_or(|(hash, name)| {
            let found = hash.clone().finish();
            let found: String = found.as_ref().iter().map(|b| format!("{b:02x}")).collect();
            found == *name
        })
    }
}
