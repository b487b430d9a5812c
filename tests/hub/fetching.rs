//! What is fetched: the files that this crate reads, once, and of the state that is meant.

use super::server::Server;
use super::*;
use sdim::LoadOptions;
use sdim::internals::model::SdimModel;
use std::sync::{Arc, Mutex};

const LATER: &str = "89abcdef0123456789abcdef0123456789abcdef";

#[test]
fn only_what_is_needed_is_fetched_and_only_once() {
    let mut files = sharded();
    files.insert("generation_config.json".into(), b"{}".to_vec());
    let needed = files.clone();
    files.extend([("README.md".into(), b"words".to_vec()), ("pytorch_model.bin".into(), vec![0; 9])]);
    let server = Server::new(COMMIT, &files);
    let dir = tempfile::tempdir().unwrap();
    let told = Arc::new(Mutex::new(BTreeMap::new()));
    let mut hub = server.hub(dir.path());
    hub.token = Some("hf_x".into());
    let telling = told.clone();
    hub.progress = Some(Arc::new(move |d| {
        telling.lock().unwrap().insert(d.file.clone(), (d.done, d.total));
    }));
    let snapshot = hub.checkpoint(REPOSITORY, None).unwrap();
    // The token goes to the hub, and not to where its large files lie.
    for request in server.state.seen.lock().unwrap().iter() {
        let elsewhere = request.path.starts_with("/cdn/");
        assert_eq!(request.token.as_deref() == Some("Bearer hf_x"), !elsewhere, "{request:?}");
    }
    let (listings, mut asked) = server.asked();
    let last_small = asked.iter().rposition(|name| !name.ends_with(".safetensors"));
    assert!(last_small < asked.iter().position(|name| name.ends_with(".safetensors")), "{asked:?}");
    asked.sort();
    assert_eq!((listings, asked), (1, needed.keys().cloned().collect()));
    assert_holds(&snapshot, &needed);
    for (name, bytes) in &needed {
        let size = bytes.len() as u64;
        assert_eq!(told.lock().unwrap()[name], (size, size), "{name}");
    }
    SdimModel::load(&snapshot, &LoadOptions::default()).unwrap();

    let found = hub.snapshot(REPOSITORY, None).unwrap();
    assert_eq!((found.dir, found.unknown.len()), (snapshot.clone(), 0));
    assert_eq!(offline(dir.path()).checkpoint(REPOSITORY, None).unwrap(), snapshot);
    assert!(server.requests().is_empty(), "a complete snapshot was asked for again");

    // Content that is here is linked again.
    std::fs::remove_file(snapshot.join("config.json")).unwrap();
    hub.checkpoint(REPOSITORY, None).unwrap();
    assert_eq!(server.asked(), (1, vec![]));
    assert_holds(&snapshot, &needed);
}

/// What another program has put into the cache is completed before it is taken for the repository.
#[test]
fn a_cache_that_lacks_only_the_settings_gets_them() {
    for without_sizes in [false, true] {
        for whole in [files(), sharded(), adapted()] {
            let dir = tempfile::tempdir().unwrap();
            let mut part = whole.clone();
            part.retain(|name, _| !name.starts_with("sdim."));
            let snapshot = cached(dir.path(), &part);
            let server = Server::new(COMMIT, &whole);
            server.behave(|b| b.without_sizes = without_sizes);
            let hub = server.hub(dir.path());
            assert_eq!(hub.checkpoint(REPOSITORY, None).unwrap(), snapshot);
            let ours = whole.keys().filter(|name| name.starts_with("sdim.")).cloned().collect();
            assert_eq!(server.asked(), (1, ours));
            assert_holds(&snapshot, &whole);
            let model = SdimModel::load(&snapshot, &LoadOptions::default()).unwrap();
            assert!(model.injection.is_some(), "not the plain model");
            hub.checkpoint(REPOSITORY, None).unwrap();
            assert!(server.requests().is_empty());
        }
    }
}

/// A repository may hold its weights in both forms.
#[test]
fn the_form_of_weights_that_is_here_is_enough() {
    let (dir, mut both) = (tempfile::tempdir().unwrap(), sharded());
    both.insert("model.safetensors".into(), files().remove("model.safetensors").unwrap());
    let snapshot = cached(dir.path(), &without(sharded(), "sdim.json"));
    let server = Server::new(COMMIT, &both);
    assert_eq!(server.hub(dir.path()).checkpoint(REPOSITORY, None).unwrap(), snapshot);
    assert_eq!(server.asked(), (1, vec!["sdim.json".to_string()]));
    assert_holds(&snapshot, &sharded());
}

#[test]
fn a_plain_checkpoint_is_asked_about_once() {
    let dir = tempfile::tempdir().unwrap();
    let snapshot = cached(dir.path(), &plain());
    let server = Server::new(COMMIT, &plain());
    for (revision, listings) in [(None, 1), (None, 0), (Some(COMMIT), 0)] {
        let found = server.hub(dir.path()).snapshot(REPOSITORY, revision).unwrap();
        assert_eq!((found.dir, found.unknown.len()), (snapshot.clone(), 0));
        assert_eq!(server.asked(), (listings, vec![]));
    }
    assert!(offline(dir.path()).snapshot(REPOSITORY, None).unwrap().unknown.is_empty());
}

/// A branch that has moved on does not take a state along that is complete; one that is not is fetched as it is now.
#[test]
fn content_that_did_not_change_is_linked() {
    let (dir, before) = (tempfile::tempdir().unwrap(), sharded());
    let snapshot = cached(dir.path(), &before);
    let mut after = before.clone();
    let mut config: Value = serde_json::from_slice(&before["config.json"]).unwrap();
    config["note"] = "changed".into();
    after.insert("config.json".into(), config.to_string().into_bytes());
    let server = Server::new(LATER, &after);
    let hub = server.hub(dir.path());
    assert_eq!(hub.checkpoint(REPOSITORY, None).unwrap(), snapshot, "complete as it is");
    server.requests();
    let later = hub.checkpoint(REPOSITORY, Some(LATER)).unwrap();
    assert_eq!(server.asked(), (1, vec!["config.json".to_string()]));
    assert_holds(&later, &after);
    assert_holds(&snapshot, &before);
    if cfg!(unix) {
        let content = |dir: &Path| std::fs::canonicalize(dir.join("model-1.safetensors")).unwrap();
        assert_eq!(content(&later), content(&snapshot));
    }
    std::fs::remove_file(snapshot.join("tokenizer.json")).unwrap();
    assert_eq!(hub.checkpoint(REPOSITORY, None).unwrap(), later);
    assert_eq!(offline(dir.path()).checkpoint(REPOSITORY, None).unwrap(), later);
}

/// What `transformers` 5 saves has the preprocessor's keys in another file.
#[test]
fn a_repository_of_newer_versions_is_complete() {
    let mut files = files();
    let part: Value = serde_json::from_slice(&files.remove("preprocessor_config.json").unwrap()).unwrap();
    files.insert("processor_config.json".into(), json!({"image_processor": part}).to_string().into_bytes());
    let server = Server::new(COMMIT, &files);
    let dir = tempfile::tempdir().unwrap();
    let snapshot = server.hub(dir.path()).checkpoint(REPOSITORY, None).unwrap();
    assert_holds(&snapshot, &files);
    SdimModel::load(&snapshot, &LoadOptions::default()).unwrap();
    assert_eq!(offline(dir.path()).checkpoint(REPOSITORY, None).unwrap(), snapshot);
}

#[test]
fn an_adapter_is_its_two_files() {
    let server = Server::new(COMMIT, &adapted());
    let dir = tempfile::tempdir().unwrap();
    let snapshot = server.hub(dir.path()).adapter(REPOSITORY, None).unwrap();
    assert_eq!(server.asked(), (1, vec!["sdim.json".into(), "sdim.safetensors".into()]));
    sdim::Adapter::load(&snapshot).unwrap();
    assert_eq!(server.hub(dir.path()).adapter(REPOSITORY, None).unwrap(), snapshot);
    assert!(server.requests().is_empty());
}

#[test]
fn what_the_hub_does_not_have_is_listed() {
    let cases = [
        (without(sharded(), "model-1.safetensors"), "model-1.safetensors"),
        (without(sharded(), "tokenizer.json"), "tokenizer.json"),
        (without(files(), "model.safetensors"), "model.safetensors.index.json"),
    ];
    for (files, expected) in cases {
        let (dir, server) = (tempfile::tempdir().unwrap(), Server::new(COMMIT, &files));
        assert_eq!(missing(server.hub(dir.path()).checkpoint(REPOSITORY, None)), [expected]);
        let (_, asked) = server.asked();
        assert!(!asked.iter().any(|name| name.ends_with(".safetensors")), "{asked:?} were fetched in vain");
    }
    // No such branch, nobody there.
    let (dir, server) = (tempfile::tempdir().unwrap(), Server::new(COMMIT, &files()));
    let error = server.hub(dir.path()).checkpoint(REPOSITORY, Some("v9")).unwrap_err();
    assert!(error.to_string().contains("no such thing"), "the hub's own words: {error}");
    assert_eq!(missing(Err(error)).len(), 4);
    let mut nobody = offline(dir.path());
    nobody.offline = false;
    assert_eq!(missing(nobody.checkpoint(REPOSITORY, None)).len(), 4);
}
