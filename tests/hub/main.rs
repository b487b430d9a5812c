//! The hub's cache as its Python library leaves it, and a hub of our own that notes what is asked of it.
//!
//! `cargo test --release --features hub --test hub`; nothing here leaves the machine.
#![cfg(feature = "hub")]

#[path = "../common/mod.rs"]
mod common;

mod cache;
mod fetching;
mod healing;
mod server;

use candle_core::Device;
use sdim::Error;
use sdim::hub::Hub;
use sdim::settings::Settings;
use serde_json::{Value, json};
use server::etag;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

const REPOSITORY: &str = "somebody/some-model";
const COMMIT: &str = "0123456789abcdef0123456789abcdef01234567";
/// What a state of the repository has at most, besides its required files.
const OPTIONAL: [&str; 4] =
    ["processor_config.json", "generation_config.json", "sdim.json", "sdim.safetensors"];

type Files = BTreeMap<String, Vec<u8>>;

/// A small checkpoint by file name.
fn files() -> Files {
    let dir = tempfile::tempdir().unwrap();
    let mut settings = Settings::tiny();
    settings.number = sdim::settings::NumberFormat::Bins { bins: 40, range: 1.25 };
    settings.wide_glimpse = None;
    let files = common::tiny::small_files(&settings);
    common::tiny::write(dir.path(), &files, &common::tiny::tensors(&files, 3));
    let names =
        ["config.json", "model.safetensors", "preprocessor_config.json", "sdim.json", "tokenizer.json"];
    names.map(|name| (name.to_string(), std::fs::read(dir.path().join(name)).unwrap())).into()
}

/// Tensors of the files' weights that `part` names, and the others.
fn divided(files: &mut Files, part: impl Fn(&str) -> bool) -> [BTreeMap<String, candle_core::Tensor>; 2] {
    let whole = files.remove("model.safetensors").unwrap();
    let tensors = candle_core::safetensors::load_buffer(&whole, &Device::Cpu).unwrap();
    let (one, other) = tensors.into_iter().partition(|(name, _)| part(name));
    [one, other]
}

fn stored(tensors: BTreeMap<String, candle_core::Tensor>) -> Vec<u8> {
    safetensors::serialize(tensors, None).unwrap()
}

/// [`files`] with the tensors in two shards.
fn sharded() -> Files {
    let mut files = files();
    let parts = divided(&mut files, |name| name.starts_with("visual."));
    let mut map = serde_json::Map::new();
    for (file, part) in ["model-1.safetensors", "model-2.safetensors"].into_iter().zip(parts) {
        map.extend(part.keys().map(|name| (name.clone(), Value::from(file))));
        files.insert(file.into(), stored(part));
    }
    let index = json!({"weight_map": map}).to_string();
    files.insert("model.safetensors.index.json".into(), index.into_bytes());
    files
}

/// [`files`] with what is not plain Qwen2.5-VL in a file of its own.
fn adapted() -> Files {
    let mut files = files();
    let [ours, plain] = divided(&mut files, |name| name.starts_with("sdim."));
    files.insert("model.safetensors".into(), stored(plain));
    files.insert("sdim.safetensors".into(), stored(ours));
    files
}

/// A plain Qwen2.5-VL.
fn plain() -> Files {
    let mut files = adapted();
    files.retain(|name, _| !name.starts_with("sdim."));
    files
}

fn without(mut files: Files, name: &str) -> Files {
    files.remove(name).unwrap();
    files
}

fn offline(cache: &Path) -> Hub {
    let endpoint = "http://127.0.0.1:9".into();
    Hub { cache: cache.into(), endpoint, token: None, offline: true, progress: None }
}

fn repository(cache: &Path) -> PathBuf {
    cache.join("models--somebody--some-model")
}

/// Writes files into a cache: blobs, a snapshot of links to them, and the branch. Returns the snapshot.
fn cached(cache: &Path, files: &Files) -> PathBuf {
    let repository = repository(cache);
    let (blobs, snapshot) = (repository.join("blobs"), repository.join("snapshots").join(COMMIT));
    for dir in [&blobs, &snapshot, &repository.join("refs")] {
        std::fs::create_dir_all(dir).unwrap();
    }
    std::fs::write(repository.join("refs/main"), COMMIT).unwrap();
    for (name, bytes) in files {
        let blob = etag(name, bytes);
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

/// The snapshot holds just these bytes.
fn assert_holds(snapshot: &Path, files: &Files) {
    for (name, bytes) in files {
        assert!(std::fs::read(snapshot.join(name)).unwrap() == *bytes, "{name}");
    }
    let left =
        |dir: &Path| std::fs::read_dir(dir).unwrap().map(|f| f.unwrap().file_name().into_string().unwrap());
    let mut names: Vec<String> = left(snapshot).collect();
    names.sort();
    assert_eq!(names, files.keys().cloned().collect::<Vec<_>>());
    let blobs = snapshot.ancestors().nth(2).unwrap().join("blobs");
    assert_eq!(left(&blobs).find(|name| name.contains("incomplete")), None);
}
