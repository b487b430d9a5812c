//! What is in the cache already: told, used, or named as damaged.

use super::*;
use sdim::LoadOptions;
use sdim::internals::model::SdimModel;
use std::process::Command;

#[test]
fn a_complete_snapshot_needs_no_network() {
    for files in [files(), sharded(), adapted()] {
        let dir = tempfile::tempdir().unwrap();
        let snapshot = cached(dir.path(), &files);
        let mut hub = offline(dir.path());
        for online in [false, true] {
            // Online, the endpoint refuses the connection.
            hub.offline = !online;
            assert_eq!(hub.checkpoint(REPOSITORY, None).unwrap(), snapshot);
            assert_eq!(hub.checkpoint(REPOSITORY, Some(COMMIT)).unwrap(), snapshot);
            let found = hub.snapshot(REPOSITORY, None).unwrap();
            assert_eq!((found.dir, found.commit.as_str()), (snapshot.clone(), COMMIT));
            let absent = OPTIONAL.map(String::from).into_iter().filter(|name| !files.contains_key(name));
            assert_eq!(found.unknown, absent.collect::<Vec<_>>(), "nobody could be asked for these");
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

/// Settings say which tensors there must be, tensors that there must be settings.
#[test]
fn offline_what_files_tell_of_each_other_is_told() {
    let cases = [
        (without(files(), "sdim.json"), "sdim.json"),
        (without(sharded(), "sdim.json"), "sdim.json"),
        (without(adapted(), "sdim.json"), "sdim.json"),
        (without(adapted(), "sdim.safetensors"), "sdim.safetensors"),
    ];
    for (files, expected) in cases {
        let dir = tempfile::tempdir().unwrap();
        cached(dir.path(), &files);
        assert_eq!(
            missing(offline(dir.path()).checkpoint(REPOSITORY, None)),
            [expected],
            "{:?}",
            files.keys()
        );
    }
    // Nothing tells of a file that goes with a plain checkpoint: it is used, and said to be uncertain.
    let dir = tempfile::tempdir().unwrap();
    let snapshot = cached(dir.path(), &plain());
    let found = offline(dir.path()).snapshot(REPOSITORY, None).unwrap();
    assert_eq!((found.dir, found.unknown), (snapshot, OPTIONAL.map(String::from).to_vec()));
    // Once the hub has been asked, by the Python library perhaps, it is certain.
    let notes = repository(dir.path()).join(".no_exist").join(COMMIT);
    std::fs::create_dir_all(&notes).unwrap();
    OPTIONAL.iter().for_each(|name| std::fs::write(notes.join(name), "").unwrap());
    assert!(offline(dir.path()).snapshot(REPOSITORY, None).unwrap().unknown.is_empty());
}

#[test]
fn a_processor_without_the_preprocessors_keys_does_not_stand_for_it() {
    let mut files = files();
    let part: Value = serde_json::from_slice(&files.remove("preprocessor_config.json").unwrap()).unwrap();
    for (json, complete) in
        [(json!({"image_processor": part}), true), (json!({"processor_class": "x"}), false)]
    {
        files.insert("processor_config.json".into(), json.to_string().into_bytes());
        let dir = tempfile::tempdir().unwrap();
        let snapshot = cached(dir.path(), &files);
        let found = offline(dir.path()).checkpoint(REPOSITORY, None);
        match complete {
            true => assert_eq!(found.unwrap(), snapshot),
            false => assert_eq!(missing(found), ["preprocessor_config.json"]),
        }
    }
}

#[test]
fn a_damaged_cache_is_named() {
    let dir = tempfile::tempdir().unwrap();
    let snapshot = cached(dir.path(), &sharded());
    let (hub, refs) = (offline(dir.path()), repository(dir.path()).join("refs/main"));
    for text in ["", "../../../../etc", "a b"] {
        std::fs::write(&refs, text).unwrap();
        let error = hub.checkpoint(REPOSITORY, None).unwrap_err();
        assert!(matches!(&error, Error::Format { path, .. } if *path == refs), "{text:?}: {error}");
    }
    std::fs::write(&refs, format!("{COMMIT}\n")).unwrap();
    // Weights that are cut short are not taken as whole.
    let shard = snapshot.join("model-1.safetensors");
    let bytes = std::fs::read(&shard).unwrap();
    for length in [0, 5, bytes.len() / 2, bytes.len() - 1] {
        std::fs::write(&shard, &bytes[..length]).unwrap();
        assert_eq!(missing(hub.checkpoint(REPOSITORY, None)), ["model-1.safetensors"], "{length}");
    }
    let index = snapshot.join("model.safetensors.index.json");
    std::fs::remove_file(&index).unwrap();
    std::fs::write(&index, r#"{"weight_map": {"a": "../../../x.safetensors"}}"#).unwrap();
    let error = hub.checkpoint(REPOSITORY, None).unwrap_err();
    assert!(matches!(&error, Error::Format { path, .. } if *path == index), "{error}");
}

/// The variables reach the example, whose `--model` may be a repository.
#[test]
fn the_environment_is_honoured() {
    let dir = tempfile::tempdir().unwrap();
    let fixture = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures/qwen_small");
    let tokenizer = files().remove("tokenizer.json").unwrap();
    let mut plain: Files = ["config.json", "preprocessor_config.json", "model.safetensors"]
        .map(|name| (name.to_string(), std::fs::read(fixture.join(name)).unwrap()))
        .into();
    plain.insert("tokenizer.json".into(), tokenizer);
    let snapshot = cached(&dir.path().join("hub"), &plain);
    let ask = |home: &Path| {
        let mut command = Command::new(common::program::program("ask"));
        for name in ["HF_HUB_CACHE", "HUGGINGFACE_HUB_CACHE", "HF_TOKEN", "HF_ENDPOINT"] {
            command.env_remove(name);
        }
        let image = fixture.join("image_b.png");
        command.env("HF_HOME", home).env("HF_HUB_OFFLINE", "1");
        command.args(["--model", REPOSITORY, "--prompt", "x"]);
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
