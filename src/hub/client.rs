//! Requests to a hub: what a repository holds, what is told of one of its files, and the file's bytes.

use super::names::{is_commit, is_name};
use super::settings::Hub;
use std::collections::BTreeMap;
use std::io::Read;
use std::time::Duration;
use ureq::config::RedirectAuthHeaders;
use ureq::http::header::{
    ACCEPT_ENCODING, AUTHORIZATION, CONTENT_LENGTH, CONTENT_RANGE, ETAG, LOCATION, RANGE,
};
use ureq::http::{HeaderMap, HeaderName, Response};
use ureq::{Agent, Body, RequestBuilder};

/// Bytes of a listing, at most: published repositories have a few hundred files of about 200 bytes each.
const LISTING_LIMIT: u64 = 32 << 20;
/// Redirects that are followed within the hub, at most.
const REDIRECTS: usize = 5;
/// How long to wait for a connection, and for the next bytes on it.
const PATIENCE: Duration = Duration::from_secs(20);

/// Why there is no answer, in words for a message.
#[derive(Debug)]
pub(super) struct Refusal {
    pub(super) reason: String,
    /// Whether asking again may help: the network broke off, or the server has a trouble of its own.
    pub(super) passing: bool,
}

/// What is asked of a hub gives this.
pub(super) type Reply<T> = std::result::Result<T, Refusal>;

/// The state of a repository that a revision names.
#[derive(Debug)]
pub(super) struct Listing {
    pub(super) commit: String,
    /// Names of the files, with their bytes where the hub tells.
    pub(super) files: BTreeMap<String, Option<u64>>,
}

/// What a hub tells of a file.
#[derive(Debug)]
pub(super) struct Facts {
    /// Commit of the state that it is of.
    pub(super) commit: String,
    /// Name of its content; that of a large file is the SHA-256 of its bytes.
    pub(super) etag: String,
    /// Bytes.
    pub(super) size: Option<u64>,
}

/// A file's bytes from some place on.
pub(super) struct Stream {
    pub(super) body: Box<dyn Read>,
    /// Place of the first byte: 0 if the server does not send parts.
    pub(super) start: u64,
    /// Bytes of the entire file.
    pub(super) total: Option<u64>,
}

/// One repository of a hub.
pub(super) struct Client<'a> {
    agent: Agent,
    hub: &'a Hub,
    repository: &'a str,
}

impl<'a> Client<'a> {
    pub(super) fn new(hub: &'a Hub, repository: &'a str) -> Self {
        let config = Agent::config_builder()
            .http_status_as_error(false)
            .timeout_resolve(Some(PATIENCE))
            .timeout_connect(Some(PATIENCE))
            .timeout_recv_response(Some(PATIENCE))
            .timeout_per_read(Some(PATIENCE))
            .redirect_auth_headers(RedirectAuthHeaders::SameHost)
            .user_agent(concat!("sdim/", env!("CARGO_PKG_VERSION")));
        Self { agent: config.build().into(), hub, repository }
    }

    /// The files of a revision.
    pub(super) fn listing(&self, revision: &str) -> Reply<Listing> {
        let (endpoint, escaped) = (&self.hub.endpoint, revision.replace('/', "%2F"));
        let url = format!("{endpoint}/api/models/{}/revision/{escaped}?blobs=true", self.repository);
        let mut answer = expect(&url, self.with_token(self.agent.get(&url)).call())?;
        let text = answer.body_mut().with_config().limit(LISTING_LIMIT).read_to_vec();
        let text = text.map_err(|e| broken(&url, &e))?;
        let listing = read_listing(&text).map_err(|found| refusal(&url, found))?;
        if is_commit(revision) && listing.commit != revision {
            return Err(refusal(&url, format!("a listing of commit {}", listing.commit)));
        }
        Ok(listing)
    }

    /// What is told of a file without its bytes.
    pub(super) fn facts(&self, commit: &str, name: &str) -> Reply<Facts> {
        let mut url = self.file(commit, name);
        for _ in 0..REDIRECTS {
            let request = self.with_token(self.agent.head(&url)).header(ACCEPT_ENCODING, "identity");
            let answer = request.config().max_redirects(0).build().call();
            let answer = expect(&url, answer)?;
            // Within the hub a redirect means another name; to another place it says where the bytes are, and tells the rest itself.
            match text(answer.headers(), LOCATION).and_then(|to| within(&url, &to)) {
                Some(other) if answer.status().is_redirection() => url = other,
                _ => {
                    return facts(answer.headers(), answer.status().is_redirection())
                        .map_err(|f| refusal(&url, f));
                }
            }
        }
        Err(refusal(&url, "redirects in a circle"))
    }

    /// The bytes of a file from `start` on.
    pub(super) fn bytes(&self, commit: &str, name: &str, start: u64) -> Reply<Stream> {
        let url = self.file(commit, name);
        // A redirect to another host takes no token along.
        let mut request = self.with_token(self.agent.get(&url)).header(ACCEPT_ENCODING, "identity");
        if start > 0 {
            request = request.header(RANGE, format!("bytes={start}-"));
        }
        let answer = expect(&url, request.call())?;
        let (start, total) = match text(answer.headers(), CONTENT_RANGE) {
            Some(range) if answer.status() == 206 => {
                part(&range).ok_or_else(|| refusal(&url, format!("the range {range:?}")))?
            }
            _ => (0, text(answer.headers(), CONTENT_LENGTH).and_then(|n| n.parse().ok())),
        };
        Ok(Stream { body: Box::new(answer.into_body().into_reader()), start, total })
    }

    fn file(&self, commit: &str, name: &str) -> String {
        format!("{}/{}/resolve/{commit}/{name}", self.hub.endpoint, self.repository)
    }

    fn with_token<B>(&self, request: RequestBuilder<B>) -> RequestBuilder<B> {
        match &self.hub.token {
            Some(token) => request.header(AUTHORIZATION, format!("Bearer {token}")),
            None => request,
        }
    }
}

fn refusal(url: &str, found: impl std::fmt::Display) -> Refusal {
    Refusal { reason: format!("{url}: {found}"), passing: false }
}

fn broken(url: &str, error: &dyn std::fmt::Display) -> Refusal {
    Refusal { passing: true, ..refusal(url, error) }
}

/// An answer that is none of an error; the hub's own words are the reason.
fn expect(url: &str, answer: Result<Response<Body>, ureq::Error>) -> Reply<Response<Body>> {
    let answer = answer.map_err(|e| broken(url, &e))?;
    let status = answer.status();
    if status.is_success() || status.is_redirection() {
        return Ok(answer);
    }
    let said = answer.headers().get("x-error-message").and_then(|v| v.to_str().ok()).unwrap_or_default();
    let passing = status.is_server_error() || status == 429;
    Err(Refusal { passing, ..refusal(url, format!("{status} {said}").trim()) })
}

fn read_listing(text: &[u8]) -> Result<Listing, &'static str> {
    #[derive(serde::Deserialize)]
    struct Info {
        sha: String,
        siblings: Vec<Sibling>,
    }
    #[derive(serde::Deserialize)]
    struct Sibling {
        rfilename: String,
        size: Option<u64>,
    }
    let info: Info = serde_json::from_slice(text).map_err(|_| "no listing of a repository")?;
    if !is_commit(&info.sha) {
        return Err("a listing of no commit");
    }
    let files = info.siblings.into_iter().map(|s| (s.rfilename, s.size)).collect();
    Ok(Listing { commit: info.sha, files })
}

fn text(headers: &HeaderMap, name: impl Into<HeaderName>) -> Option<String> {
    headers.get(name.into()).and_then(|v| v.to_str().ok()).map(String::from)
}

/// The target of a redirect from `url`, if it is on the same host.
fn within(url: &str, to: &str) -> Option<String> {
    let after_scheme = url.find("://")? + 3;
    let host = &url[..url[after_scheme..].find('/').map_or(url.len(), |slash| after_scheme + slash)];
    match to.strip_prefix(host) {
        Some(path) if path.starts_with('/') => Some(to.to_string()),
        None if to.starts_with('/') && !to.starts_with("//") => Some(format!("{host}{to}")),
        _ => None,
    }
}

/// What a large file links to stands in headers of its own.
fn facts(headers: &HeaderMap, elsewhere: bool) -> Result<Facts, String> {
    let named = |name: &'static str| text(headers, HeaderName::from_static(name));
    let commit = named("x-repo-commit").ok_or("no header X-Repo-Commit")?;
    let etag = named("x-linked-etag").or_else(|| text(headers, ETAG)).ok_or("no header ETag")?;
    let etag = etag.trim_start_matches("W/").trim_matches('"').to_string();
    // It becomes the name of a file.
    if etag.is_empty() || etag.len() > 128 || etag.starts_with('.') || !is_name(&etag) {
        return Err(format!("the header ETag is {etag:?}"));
    }
    let length = || text(headers, CONTENT_LENGTH).filter(|_| !elsewhere);
    let size = named("x-linked-size").or_else(length).and_then(|n| n.parse().ok());
    Ok(Facts { commit, etag, size })
}

/// First byte and length of the whole, of a `Content-Range` such as `bytes 5-9/10`.
fn part(range: &str) -> Option<(u64, Option<u64>)> {
    let (part, total) = range.strip_prefix("bytes ")?.split_once('/')?;
    Some((part.split_once('-')?.0.trim().parse().ok()?, total.trim().parse().ok()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use ureq::http::HeaderValue;

    #[test]
    fn redirects_are_followed_on_the_same_host_alone() {
        let url = "https://hub.example/a/b/resolve/c/config.json";
        let inside = Some("https://hub.example/api/x".to_string());
        assert_eq!(within(url, "/api/x"), inside);
        assert_eq!(within(url, "https://hub.example/api/x"), inside);
        assert_eq!(within("https://hub.example", "/api/x"), inside);
        for outside in ["//cdn.example/x", "https://hub.example.evil/x", "http://hub.example/x", "x", ""] {
            assert_eq!(within(url, outside), None, "{outside}");
        }
    }

    #[test]
    fn ranges() {
        assert_eq!(part("bytes 5-9/10"), Some((5, Some(10))));
        assert_eq!(part("bytes 5-9/*"), Some((5, None)));
        for bad in ["", "bytes */10", "5-9/10", "bytes 5/10", "bytes a-9/10"] {
            assert_eq!(part(bad), None, "{bad}");
        }
    }

    #[test]
    fn what_is_told_of_a_file() {
        let told = |pairs: &[(&'static str, &'static str)], elsewhere| {
            let pairs = pairs.iter().map(|(n, v)| (HeaderName::from_static(n), HeaderValue::from_static(v)));
            facts(&pairs.collect(), elsewhere)
        };
        let plain =
            told(&[("x-repo-commit", "c"), ("etag", "W/\"abc\""), ("content-length", "7")], false).unwrap();
        assert_eq!((plain.commit.as_str(), plain.etag.as_str(), plain.size), ("c", "abc", Some(7)));
        // The redirect to a large file's bytes has a length of its own.
        let large =
            [("x-repo-commit", "c"), ("etag", "\"r\""), ("content-length", "1"), ("x-linked-etag", "\"f\"")];
        let facts = told(&large, true).unwrap();
        assert_eq!((facts.etag.as_str(), facts.size), ("f", None));
        assert_eq!(told(&[&large[..], &[("x-linked-size", "9")]].concat(), true).unwrap().size, Some(9));
        for etag in ["\"../../x\"", "\"\"", "\"a b\"", ".."] {
            assert!(told(&[("x-repo-commit", "c"), ("etag", etag)], false).is_err(), "{etag}");
        }
        assert!(told(&[("etag", "a")], false).is_err());
    }
}
