//! A hub with one state of one repository, which notes what is asked of it.

use super::{REPOSITORY, offline};
use ring::digest;
use sdim::hub::Hub;
use serde_json::{Value, json};
use std::collections::BTreeMap;
use std::io::{BufRead, BufReader, Write};
use std::net::{TcpListener, TcpStream};
use std::path::Path;
use std::sync::{Arc, Mutex};

/// Lives until the test ends.
pub struct Server {
    endpoint: String,
    pub state: Arc<State>,
}

/// What the server has, and how it behaves.
pub struct State {
    commit: String,
    files: BTreeMap<String, Vec<u8>>,
    port: u16,
    pub seen: Mutex<Vec<Seen>>,
    pub behaviour: Mutex<Behaviour>,
}

#[derive(Default)]
pub struct Behaviour {
    /// Names of which the next answer breaks off in the middle.
    pub breaks: Vec<String>,
    /// Names of which other bytes are sent, as many as there should be.
    pub damaged: Vec<String>,
    /// Files of which bytes are sent before all is refused.
    pub patience: Option<usize>,
    /// Answers with the entire file, whatever part is asked for.
    pub without_parts: bool,
    /// The listing says nothing of sizes.
    pub without_sizes: bool,
}

/// A request.
#[derive(Debug, Clone)]
pub struct Seen {
    pub method: String,
    pub path: String,
    pub token: Option<String>,
    pub range: Option<String>,
}

/// The name that the hub gives to content: for large files the SHA-256 of the bytes.
pub fn etag(name: &str, bytes: &[u8]) -> String {
    let algorithm = if is_large(name) { &digest::SHA256 } else { &digest::SHA1_FOR_LEGACY_USE_ONLY };
    digest::digest(algorithm, bytes).as_ref().iter().map(|b| format!("{b:02x}")).collect()
}

fn is_large(name: &str) -> bool {
    name.ends_with(".safetensors")
}

impl Server {
    pub fn new(commit: &str, files: &BTreeMap<String, Vec<u8>>) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let port = listener.local_addr().unwrap().port();
        let (seen, behaviour) = (Mutex::default(), Mutex::default());
        let state = State { commit: commit.into(), files: files.clone(), port, seen, behaviour };
        let state = Arc::new(state);
        let answering = state.clone();
        std::thread::spawn(move || {
            for stream in listener.incoming().flatten() {
                let state = answering.clone();
                std::thread::spawn(move || drop(state.answer(stream)));
            }
        });
        Self { endpoint: format!("http://127.0.0.1:{port}"), state }
    }

    pub fn hub(&self, cache: &Path) -> Hub {
        Hub { offline: false, endpoint: self.endpoint.clone(), ..offline(cache) }
    }

    /// Requests since the last call.
    pub fn requests(&self) -> Vec<Seen> {
        std::mem::take(&mut self.state.seen.lock().unwrap())
    }

    /// Listings, and files of which bytes were asked for in their order, since the last call.
    pub fn asked(&self) -> (usize, Vec<String>) {
        let requests = self.requests();
        let listings = requests.iter().filter(|r| r.path.starts_with("/api/models/")).count();
        let cdn = format!("/cdn/{}/", self.state.commit);
        let cache = format!("/cache/{}/", self.state.commit);
        let bytes = requests.iter().filter(|r| r.method == "GET");
        let names = bytes.filter_map(|r| r.path.strip_prefix(&cdn).or(r.path.strip_prefix(&cache)));
        (listings, names.map(String::from).collect())
    }

    pub fn behave(&self, change: impl FnOnce(&mut Behaviour)) {
        change(&mut self.state.behaviour.lock().unwrap());
    }
}

impl State {
    fn answer(&self, mut stream: TcpStream) -> std::io::Result<()> {
        let mut lines = BufReader::new(stream.try_clone()?).lines();
        let first = lines.next().transpose()?.unwrap_or_default();
        let mut words = first.split(' ').map(String::from);
        let (method, path) = (words.next().unwrap_or_default(), words.next().unwrap_or_default());
        let headers: Vec<String> = lines.map_while(Result::ok).take_while(|line| !line.is_empty()).collect();
        let header = |name: &str| {
            let pair = headers.iter().filter_map(|line| line.split_once(": "));
            pair.filter(|(n, _)| n.eq_ignore_ascii_case(name)).map(|(_, v)| v.to_string()).next()
        };
        let seen = Seen { method, path, token: header("authorization"), range: header("range") };
        self.seen.lock().unwrap().push(seen.clone());
        let (head, body) = self.reply(&seen);
        let length = if head.contains("Content-Length") {
            String::new()
        } else {
            format!("Content-Length: {}\r\n", body.len())
        };
        stream.write_all(format!("HTTP/1.1 {head}{length}Connection: close\r\n\r\n").as_bytes())?;
        stream.write_all(if seen.method == "HEAD" { &[] } else { &body })
    }

    /// Status and headers, and the body.
    fn reply(&self, seen: &Seen) -> (String, Vec<u8>) {
        let not_found = || ("404 Not Found\r\nX-Error-Message: no such thing\r\n".to_string(), Vec::new());
        let commit = &self.commit;
        for revision in ["main", commit] {
            if seen.path == format!("/api/models/{REPOSITORY}/revision/{revision}?blobs=true") {
                return ("200 OK\r\n".into(), self.listing());
            }
        }
        let resolve = format!("/{REPOSITORY}/resolve/{commit}/");
        let (cdn, cache) = (format!("/cdn/{commit}/"), format!("/cache/{commit}/"));
        let resolved = seen.path.strip_prefix(&resolve);
        let elsewhere = seen.path.strip_prefix(&cdn).or(seen.path.strip_prefix(&cache));
        let Some(name) = resolved.or(elsewhere).map(String::from) else { return not_found() };
        let Some(bytes) = self.files.get(&name) else { return not_found() };
        let told = format!("X-Repo-Commit: {commit}\r\n");
        let (size, etag) = (bytes.len(), etag(&name, bytes));
        if resolved.is_some() && is_large(&name) {
            // Another host, as the parts of a name go.
            let to = format!("Location: http://localhost:{}{cdn}{name}\r\n", self.port);
            let linked = format!("X-Linked-Etag: \"{etag}\"\r\nX-Linked-Size: {size}\r\nETag: \"other\"\r\n");
            return (format!("302 Found\r\n{to}{told}{linked}"), b"elsewhere".to_vec());
        }
        if resolved.is_some() {
            return (format!("307 Temporary Redirect\r\nLocation: {cache}{name}\r\n"), Vec::new());
        }
        let told = format!("{told}ETag: \"{etag}\"\r\n");
        if seen.method == "HEAD" {
            return (format!("200 OK\r\n{told}Content-Length: {size}\r\n"), Vec::new());
        }
        self.bytes(&name, bytes, seen, &told)
    }

    fn bytes(&self, name: &str, bytes: &[u8], seen: &Seen, told: &str) -> (String, Vec<u8>) {
        let mut behaviour = self.behaviour.lock().unwrap();
        match &mut behaviour.patience {
            Some(0) => return ("403 Forbidden\r\nX-Error-Message: enough\r\n".into(), Vec::new()),
            Some(left) => *left -= 1,
            None => {}
        }
        let range = seen.range.as_deref().filter(|_| !behaviour.without_parts);
        let from: Option<usize> =
            range.map(|r| r.trim_start_matches("bytes=").trim_end_matches('-').parse().unwrap());
        let size = bytes.len();
        let mut sent = bytes[from.unwrap_or(0)..].to_vec();
        if behaviour.damaged.iter().any(|n| n == name) {
            sent.iter_mut().for_each(|b| *b ^= 1);
        }
        let length = sent.len();
        if behaviour.breaks.iter().any(|n| n == name) {
            behaviour.breaks.retain(|n| n != name);
            sent.truncate(length / 2);
        }
        let status = match from {
            Some(from) => {
                format!("206 Partial Content\r\nContent-Range: bytes {from}-{}/{size}\r\n", size - 1)
            }
            None => "200 OK\r\n".into(),
        };
        (format!("{status}{told}Content-Length: {length}\r\n"), sent)
    }

    fn listing(&self) -> Vec<u8> {
        let sizes = !self.behaviour.lock().unwrap().without_sizes;
        let file = |(name, bytes): (&String, &Vec<u8>)| match sizes {
            true => json!({"rfilename": name, "size": bytes.len()}),
            false => json!({"rfilename": name}),
        };
        let siblings: Vec<Value> = self.files.iter().map(file).collect();
        json!({"sha": self.commit, "siblings": siblings, "private": false}).to_string().into_bytes()
    }
}
