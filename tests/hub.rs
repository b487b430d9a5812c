//! The hub's cache as its Python library leaves it, and a hub of our own that counts what is asked of it.
//!
//! `cargo test --release --features hub --test hub`; nothing here leaves the machine.
#![cfg(feature = "hub")]

mod common;

use candle_core::Device;
use sdim::Error;
use sdim::LoadOptions;
use sdim::hub::Hub;
use sdim::internals::model::SdimModel;
use sdim::settings::Settings;
use serde_json::{Value, json};
use std::collections::BTreeMap;
use std::io::{BufRead, BufReader, Write};
use std::net::{TcpListener, TcpStream};
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::{Arc, Mutex};

const REPOSITORY: &str = "somebody/some-model";
const COMMIT: &str = "0123456789abcdef0123456789abcdef01234567";
const FILES: [&str; 5] =
    ["config.json", "model.safetensors", "preprocessor_config.json", "sdim.json", "tokenizer.json"];

/// A small checkpoint by file name.
fn files() -> BTreeMap<String, Vec<u8>> {
    let dir = tempfile::tempdir().unwrap();
    let mut settings = Settings::tiny();
    settings.number = sdim::settings::NumberFormat::Bins { bins: 40, range: 1.25 };
    let files = common::tiny::small_files(&settings);
    common::tiny::write(dir.path(), &files, &common::tiny::tensors(&files, 3));
    FILES.iter().map(|name| (name.to_string(), std::fs::read(dir.path().join(name)).unwrap())).collect()
}

/// The same with its tensors in two shards.
fn sharded() -> BTreeMap<String, Vec<u8>> {
    let mut files = files();
    let whole = files.remove("model.safetensors").unwrap();
    let tensors = candle_core::safetensors::load_buffer(&whole, &Device::Cpu).unwrap();
    let (vision, text): (BTreeMap<_, _>, BTreeMap<_, _>) =
        tensors.into_iter().partition(|(name, _)| name.starts_with("visual."));
    let mut map = serde_json::Map::new();
    for (file, part) in [("model-1.safetensors", vision), ("model-2.safetensors", text)] {
        map.extend(part.keys().map(|name| (name.clone(), Value::from(file))));
        files.insert(file.into(), safetensors::serialize(part, None).unwrap());
    }
    let index = json!({"weight_map": map}).to_string();
    files.insert("model.safetensors.index.json".into(), index.into_bytes());
    files
}

fn offline(cache: &Path) -> Hub {
    let endpoint = "http://127.0.0.1:9".into();
    Hub { cache: cache.into(), endpoint, token: None, offline: true, progress: None }
}

/// Writes files into a cache: blobs, a snapshot of links to them, and the branch. Returns the snapshot.
fn cached(cache: &Path, files: &BTreeMap<String, Vec<u8>>) -> PathBuf {
    let repository = cache.join("models--somebody--some-model");
    let (blobs, snapshot) = (repository.join("blobs"), repository.join("snapshots").join(COMMIT));
    for dir in [&blobs, &snapshot, &repository.join("refs")] {
        std::fs::create_dir_all(dir).unwrap();
    }
    std::fs::write(repository.join("refs/main"), COMMIT).unwrap();
    for (i, (name, bytes)) in files.iter().enumerate() {
        let blob = format!("b10b{i}");
        std::fs::write(blobs.join(&blob), bytes).unwrap();
        #[cfg(unix)]
        std::os::unix::fs::symlink(Path::new("../../blobs").join(&blob), snapshot.join(name)).unwrap();
        #[cfg(not(unix))]
        std::fs::copy(blobs.join(&blob), snapshot.join(name)).unwrap();
    }
    snapshot
}

/// The files that a call did not find.
fn missing(result: Result<PathBuf, Error>) -> Vec<String> {
    match result {
        Err(Error::Hub { repository, missing, reason, .. }) => {
            assert_eq!(repository, REPOSITORY);
            assert!(!reason.is_empty());
            missing
        }
        other => panic!("{other:?}"),
    }
}

#[test]
fn a_complete_snapshot_needs_no_network() {
    for files in [files(), sharded()] {
        let dir = tempfile::tempdir().unwrap();
        let snapshot = cached(dir.path(), &files);
        let mut hub = offline(dir.path());
        for online in [false, true] {
            // Online, the endpoint would refuse the connection.
            hub.offline = !online;
            assert_eq!(hub.checkpoint(REPOSITORY, None).unwrap(), snapshot);
            assert_eq!(hub.checkpoint(REPOSITORY, Some(COMMIT)).unwrap(), snapshot);
        }
        SdimModel::load(&snapshot, &LoadOptions::default()).unwrap();
    }
}

#[test]
fn offline_an_incomplete_snapshot_is_an_error_that_lists_its_files() {
    let dir = tempfile::tempdir().unwrap();
    let hub = offline(dir.path());
    let all = missing(hub.checkpoint(REPOSITORY, None));
    assert_eq!(all[..3], ["config.json", "preprocessor_config.json", "tokenizer.json"]);
    assert!(all[3].starts_with("model.safetensors"), "{all:?}");
    let snapshot = cached(dir.path(), &sharded());
    // Of one file the link is gone, of another its blob.
    std::fs::remove_file(snapshot.join("tokenizer.json")).unwrap();
    let shard = std::fs::canonicalize(snapshot.join("model-2.safetensors")).unwrap();
    std::fs::remove_file(&shard).unwrap();
    let gone = ["tokenizer.json", "model-2.safetensors"];
    if cfg!(unix) {
        assert_eq!(missing(hub.checkpoint(REPOSITORY, None)), gone);
        let said = hub.checkpoint(REPOSITORY, None).unwrap_err().to_string();
        assert!(said.contains(REPOSITORY) && said.contains("offline") && said.contains(gone[1]), "{said}");
    }
    // Another branch, and a commit that is not here.
    assert_eq!(missing(hub.checkpoint(REPOSITORY, Some("v2"))), all);
    assert_eq!(missing(hub.checkpoint(REPOSITORY, Some(&"f".repeat(40)))), all);
    assert_eq!(missing(hub.adapter(REPOSITORY, None)), ["sdim.safetensors"]);
}

#[test]
fn a_damaged_cache_is_named() {
    let dir = tempfile::tempdir().unwrap();
    let snapshot = cached(dir.path(), &sharded());
    let (hub, refs) = (offline(dir.path()), dir.path().join("models--somebody--some-model/refs/main"));
    for text in ["", "../../../../etc", "a b"] {
        std::fs::write(&refs, text).unwrap();
        let error = hub.checkpoint(REPOSITORY, None).unwrap_err();
        assert!(matches!(&error, Error::Format { path, .. } if *path == refs), "{text:?}: {error}");
    }
    std::fs::write(&refs, format!("{COMMIT}\n")).unwrap();
    let index = snapshot.join("model.safetensors.index.json");
    std::fs::remove_file(&index).unwrap();
    std::fs::write(&index, r#"{"weight_map": {"a": "../../../x.safetensors"}}"#).unwrap();
    let error = hub.checkpoint(REPOSITORY, None).unwrap_err();
    assert!(matches!(&error, Error::Format { path, .. } if *path == index), "{error}");
}

/// A hub with one repository, until the test ends.
struct Server {
    endpoint: String,
    state: Arc<State>,
}

struct State {
    files: BTreeMap<String, Vec<u8>>,
    /// Paths that were asked for, with their `Authorization`.
    seen: Mutex<Vec<(String, Option<String>)>>,
    /// Names of which the next whole answer breaks off in the middle.
    breaks: Mutex<Vec<String>>,
}

impl Server {
    fn new(files: BTreeMap<String, Vec<u8>>) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let endpoint = format!("http://{}", listener.local_addr().unwrap());
        let state = Arc::new(State { files, seen: Mutex::default(), breaks: Mutex::default() });
        let answering = state.clone();
        std::thread::spawn(move || listener.incoming().flatten().for_each(|s| drop(answering.answer(s))));
        Self { endpoint, state }
    }

    fn hub(&self, cache: &Path) -> Hub {
        Hub { offline: false, endpoint: self.endpoint.clone(), ..offline(cache) }
    }

    /// Files that were asked for, each once.
    fn asked(&self) -> Vec<String> {
        let prefix = format!("/{REPOSITORY}/resolve/{COMMIT}/");
        let seen = self.state.seen.lock().unwrap();
        let mut names: Vec<String> =
            seen.iter().filter_map(|(path, _)| path.strip_prefix(&prefix).map(String::from)).collect();
        names.sort();
        names.dedup();
        names
    }
}

impl State {
    fn answer(&self, mut stream: TcpStream) -> std::io::Result<()> {
        let mut lines = BufReader::new(stream.try_clone()?).lines();
        let first = lines.next().transpose()?.unwrap_or_default();
        let path = first.split(' ').nth(1).unwrap_or_default().to_string();
        let headers: Vec<String> = lines.map_while(Result::ok).take_while(|line| !line.is_empty()).collect();
        let header = |name: &str| {
            let pair = headers.iter().filter_map(|line| line.split_once(": "));
            pair.filter(|(n, _)| n.eq_ignore_ascii_case(name)).map(|(_, v)| v.to_string()).next()
        };
        self.seen.lock().unwrap().push((path.clone(), header("authorization")));
        let name = path.strip_prefix(&format!("/{REPOSITORY}/resolve/{COMMIT}/"));
        if path == format!("/api/models/{REPOSITORY}/revision/main") {
            let siblings: Vec<Value> = self.files.keys().map(|name| json!({"rfilename": name})).collect();
            let body = json!({"sha": COMMIT, "siblings": siblings, "private": false}).to_string();
            let head =
                format!("HTTP/1.1 200 OK\r\nContent-Length: {}\r\nConnection: close\r\n\r\n", body.len());
            return stream.write_all([head, body].concat().as_bytes());
        }
        let Some((name, bytes)) = name.and_then(|name| Some((name, self.files.get(name)?))) else {
            return stream
                .write_all(b"HTTP/1.1 404 Not Found\r\nContent-Length: 0\r\nConnection: close\r\n\r\n");
        };
        let range = header("range").unwrap_or_default();
        let (from, to) = range.strip_prefix("bytes=").and_then(|r| r.split_once('-')).unwrap_or(("0", ""));
        let from: usize = from.parse().unwrap_or(0);
        let end = to.parse().map_or(bytes.len(), |last: usize| last + 1);
        let head = format!(
            "HTTP/1.1 206 Partial Content\r\nContent-Length: {}\r\nContent-Range: bytes {from}-{}/{}\r\n\
             ETag: \"etag-of-{name}\"\r\nX-Repo-Commit: {COMMIT}\r\nConnection: close\r\n\r\n",
            end - from,
            end - 1,
            bytes.len(),
        );
        stream.write_all(head.as_bytes())?;
        let mut breaks = self.breaks.lock().unwrap();
        if end - from > 1 && breaks.iter().any(|b| b == name) {
            breaks.retain(|b| b != name);
            return stream.write_all(&bytes[from..from + (end - from) / 2]);
        }
        stream.write_all(&bytes[from..end])
    }
}

#[test]
fn only_what_is_needed_is_fetched_and_only_once() {
    let mut files = sharded();
    files.insert("generation_config.json".into(), b"{}".to_vec());
    let needed: Vec<String> = files.keys().cloned().collect();
    files.extend([("README.md".into(), b"words".to_vec()), ("pytorch_model.bin".into(), vec![0; 9])]);
    let server = Server::new(files.clone());
    server.state.breaks.lock().unwrap().push("model-2.safetensors".into());
    let dir = tempfile::tempdir().unwrap();
    let told = Arc::new(Mutex::new(BTreeMap::new()));
    let mut hub = server.hub(dir.path());
    hub.token = Some("hf_x".into());
    let telling = told.clone();
    hub.progress = Some(Arc::new(move |d| {
        telling.lock().unwrap().insert(d.file.clone(), (d.done, d.total));
    }));
    let snapshot = hub.checkpoint(REPOSITORY, None).unwrap();
    assert_eq!(server.asked(), needed);
    for name in &needed {
        assert_eq!(std::fs::read(snapshot.join(name)).unwrap(), files[name], "{name}");
        let size = files[name].len() as u64;
        assert_eq!(told.lock().unwrap()[name], (size, size), "{name}");
    }
    let authorised = |(_, token): &(String, Option<String>)| token.as_deref() == Some("Bearer hf_x");
    assert!(server.state.seen.lock().unwrap().iter().all(authorised));
    SdimModel::load(&snapshot, &LoadOptions::default()).unwrap();

    let requests = server.state.seen.lock().unwrap().len();
    assert_eq!(hub.checkpoint(REPOSITORY, None).unwrap(), snapshot);
    assert_eq!(offline(dir.path()).checkpoint(REPOSITORY, None).unwrap(), snapshot);
    assert_eq!(server.state.seen.lock().unwrap().len(), requests, "a complete snapshot was asked for again");

    std::fs::remove_file(snapshot.join("config.json")).unwrap();
    server.state.seen.lock().unwrap().clear();
    hub.checkpoint(REPOSITORY, None).unwrap();
    assert_eq!(server.asked(), ["config.json"], "the rest was there");
}

/// What `transformers` 5 saves has the preprocessor's keys in another file.
#[test]
fn a_repository_of_newer_versions_is_complete() {
    let mut files = files();
    let part: Value = serde_json::from_slice(&files.remove("preprocessor_config.json").unwrap()).unwrap();
    files.insert("processor_config.json".into(), json!({"image_processor": part}).to_string().into_bytes());
    let server = Server::new(files.clone());
    let dir = tempfile::tempdir().unwrap();
    let snapshot = server.hub(dir.path()).checkpoint(REPOSITORY, None).unwrap();
    assert_eq!(server.asked(), files.keys().cloned().collect::<Vec<_>>());
    SdimModel::load(&snapshot, &LoadOptions::default()).unwrap();
    assert_eq!(offline(dir.path()).checkpoint(REPOSITORY, None).unwrap(), snapshot);
}

#[test]
fn what_the_hub_does_not_have_is_listed() {
    let dir = tempfile::tempdir().unwrap();
    let mut files = sharded();
    files.remove("model-1.safetensors");
    let server = Server::new(files.clone());
    assert_eq!(missing(server.hub(dir.path()).checkpoint(REPOSITORY, None)), ["model-1.safetensors"]);
    assert!(!server.asked().contains(&"model-2.safetensors".to_string()), "fetched in vain");
    files.remove("tokenizer.json");
    let server = Server::new(files);
    let other = tempfile::tempdir().unwrap();
    assert_eq!(missing(server.hub(other.path()).checkpoint(REPOSITORY, None)), ["tokenizer.json"]);
    assert!(server.asked().is_empty());
    // No such branch, no such repository, nobody there.
    assert_eq!(missing(server.hub(other.path()).checkpoint(REPOSITORY, Some("v9"))).len(), 4);
    let mut nobody = offline(other.path());
    nobody.offline = false;
    assert_eq!(missing(nobody.checkpoint(REPOSITORY, None)).len(), 4);
}

/// The variables reach the example, whose `--model` may be a repository.
#[test]
fn the_environment_is_honoured() {
    let dir = tempfile::tempdir().unwrap();
    let fixture = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures/qwen_small");
    let tokenizer = files().remove("tokenizer.json").unwrap();
    let mut plain: BTreeMap<String, Vec<u8>> =
        ["config.json", "preprocessor_config.json", "model.safetensors"]
            .map(|name| (name.to_string(), std::fs::read(fixture.join(name)).unwrap()))
            .into();
    plain.insert("tokenizer.json".into(), tokenizer);
    let snapshot = cached(&dir.path().join("hub"), &plain);
    let ask = |home: &Path| {
        let mut command = Command::new(common::program("ask"));
        for name in ["HF_HUB_CACHE", "HUGGINGFACE_HUB_CACHE", "HF_TOKEN", "HF_ENDPOINT"] {
            command.env_remove(name);
        }
        let image = fixture.join("image_b.png");
        command
            .env("HF_HOME", home)
            .env("HF_HUB_OFFLINE", "1")
            .args(["--model", REPOSITORY, "--prompt", "x"]);
        command.arg("--image").arg(image).output().unwrap()
    };
    // The vocabulary is that of another model, which is told only once the snapshot was found.
    let out = ask(dir.path());
    let said = String::from_utf8_lossy(&out.stderr).into_owned();
    assert!(said.contains(snapshot.join("tokenizer.json").to_str().unwrap()), "{said}");
    let out = ask(&dir.path().join("elsewhere"));
    let said = String::from_utf8_lossy(&out.stderr).into_owned();
    assert!(said.contains(REPOSITORY) && said.contains("offline") && said.contains("config.json"), "{said}");
    assert_eq!((out.status.code(), out.stdout.is_empty()), (Some(1), true));
}
