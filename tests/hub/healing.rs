//! Downloads that broke off, were done twice, or gave other bytes.

use super::server::Server;
use super::*;

/// Whatever file it ends after: what is there is not taken for a checkpoint, and the next call goes on.
#[test]
fn an_interrupted_fetch_goes_on_where_it_ended() {
    for whole in [sharded(), adapted()] {
        for patience in 0..whole.len() {
            let (dir, server) = (tempfile::tempdir().unwrap(), Server::new(COMMIT, &whole));
            server.behave(|b| b.patience = Some(patience));
            let hub = server.hub(dir.path());
            for revision in [None, Some(COMMIT)] {
                let error = hub.checkpoint(REPOSITORY, revision).unwrap_err();
                assert!(error.to_string().contains("enough"), "{error}");
                let left = missing(offline(dir.path()).checkpoint(REPOSITORY, revision));
                assert!(!left.is_empty(), "after {patience} files");
            }
            let (_, mut asked) = server.asked();
            asked.truncate(patience);
            server.behave(|b| b.patience = None);
            let snapshot = hub.checkpoint(REPOSITORY, None).unwrap();
            assert_holds(&snapshot, &whole);
            asked.extend(server.asked().1);
            asked.sort();
            assert_eq!(asked, whole.keys().cloned().collect::<Vec<_>>(), "each once");
        }
    }
}

#[test]
fn a_broken_download_goes_on_in_the_same_call() {
    for without_parts in [false, true] {
        let (dir, whole) = (tempfile::tempdir().unwrap(), files());
        let server = Server::new(COMMIT, &whole);
        server.behave(|b| {
            b.breaks = vec!["model.safetensors".into(), "config.json".into()];
            b.without_parts = without_parts;
        });
        let snapshot = server.hub(dir.path()).checkpoint(REPOSITORY, None).unwrap();
        assert_holds(&snapshot, &whole);
        let requests = server.requests();
        let weights = requests.iter().filter(|r| r.path.starts_with("/cdn/"));
        let ranges: Vec<Option<String>> = weights.map(|r| r.range.clone()).collect();
        let half = format!("bytes={}-", whole["model.safetensors"].len() / 2);
        assert_eq!(ranges, [None, Some(half)]);
    }
}

/// What an earlier process has left of a file, whoever it was.
#[test]
fn what_is_left_of_a_download_is_resumed_or_replaced_and_never_taken_as_whole() {
    let whole = files();
    let weights = &whole["model.safetensors"];
    let (half, size) = (weights.len() / 2, weights.len());
    let wrong = |length: usize| vec![7u8; length];
    let cases: [(Vec<u8>, Vec<Option<String>>); 7] = [
        (weights[..half].to_vec(), vec![Some(format!("bytes={half}-"))]),
        (weights.clone(), vec![]),
        (vec![], vec![None]),
        (wrong(size), vec![None]),
        (wrong(size + 5), vec![None]),
        (wrong(half), vec![Some(format!("bytes={half}-")), None]),
        ([&weights[..], &[0]].concat(), vec![None]),
    ];
    for (left, expected) in cases {
        let (dir, server) = (tempfile::tempdir().unwrap(), Server::new(COMMIT, &whole));
        let blobs = repository(dir.path()).join("blobs");
        std::fs::create_dir_all(&blobs).unwrap();
        std::fs::write(blobs.join(format!("{}.incomplete", etag("model.safetensors", weights))), &left)
            .unwrap();
        // That of a small file has no name that its bytes can be checked by, and is fetched anew.
        let config = &whole["config.json"];
        std::fs::write(blobs.join(format!("{}.incomplete", etag("config.json", config))), wrong(3)).unwrap();
        assert_eq!(missing(offline(dir.path()).checkpoint(REPOSITORY, None)).len(), 4);
        let snapshot = server.hub(dir.path()).checkpoint(REPOSITORY, None).unwrap();
        assert_holds(&snapshot, &whole);
        let requests = server.requests();
        let ranges = |part: &str| {
            requests.iter().filter(|r| r.path.contains(part)).map(|r| r.range.clone()).collect::<Vec<_>>()
        };
        assert_eq!(ranges("/cdn/"), expected, "{} of {size} bytes", left.len());
    }
}

#[test]
fn other_bytes_than_those_asked_for_are_refused() {
    let (dir, whole) = (tempfile::tempdir().unwrap(), files());
    let server = Server::new(COMMIT, &whole);
    server.behave(|b| b.damaged = vec!["model.safetensors".into()]);
    let hub = server.hub(dir.path());
    assert_eq!(missing(hub.checkpoint(REPOSITORY, None)), ["model.safetensors"]);
    let blob =
        repository(dir.path()).join("blobs").join(etag("model.safetensors", &whole["model.safetensors"]));
    assert!(!blob.exists());
    server.behave(|b| b.damaged.clear());
    assert_holds(&hub.checkpoint(REPOSITORY, None).unwrap(), &whole);
}

/// A blob that was cut short, by a full disk or an older client, is replaced.
#[test]
fn damaged_content_is_fetched_again() {
    for without_sizes in [false, true] {
        for whole in [files(), sharded()] {
            let dir = tempfile::tempdir().unwrap();
            let snapshot = cached(dir.path(), &whole);
            let name = whole.keys().find(|name| name.ends_with(".safetensors")).unwrap();
            std::fs::write(snapshot.join(name), &whole[name][..whole[name].len() - 9]).unwrap();
            let server = Server::new(COMMIT, &whole);
            server.behave(|b| b.without_sizes = without_sizes);
            assert_eq!(server.hub(dir.path()).checkpoint(REPOSITORY, None).unwrap(), snapshot);
            assert_holds(&snapshot, &whole);
            assert_eq!(server.asked().1, std::slice::from_ref(name));
        }
    }
}

#[test]
fn two_that_fetch_at_once_share_the_work() {
    let (dir, whole) = (tempfile::tempdir().unwrap(), sharded());
    let server = Server::new(COMMIT, &whole);
    let fetch = || assert_holds(&server.hub(dir.path()).checkpoint(REPOSITORY, None).unwrap(), &whole);
    std::thread::scope(|scope| {
        let others: Vec<_> = (0..3).map(|_| scope.spawn(fetch)).collect();
        others.into_iter().for_each(|other| other.join().unwrap());
    });
    let (_, mut asked) = server.asked();
    asked.sort();
    assert_eq!(asked, whole.keys().cloned().collect::<Vec<_>>());
}

/// Who waited for the lock finds the file in place, and does not put it there once more before the eyes of its readers.
#[cfg(unix)]
#[test]
fn what_another_put_in_place_is_left_alone() {
    use std::os::unix::fs::MetadataExt;
    let (dir, whole) = (tempfile::tempdir().unwrap(), files());
    let server = Server::new(COMMIT, &whole);
    let locks = dir.path().join(".locks/models--somebody--some-model");
    std::fs::create_dir_all(&locks).unwrap();
    let lock = locks.join(format!("{}.lock", etag("model.safetensors", &whole["model.safetensors"])));
    let lock = std::fs::File::create(lock).unwrap();
    lock.lock().unwrap();
    std::thread::scope(|scope| {
        let waiting = scope.spawn(|| server.hub(dir.path()).checkpoint(REPOSITORY, None).unwrap());
        // It asks for the content's name, and then for the lock.
        let asked = |seen: &server::Seen| seen.method == "HEAD" && seen.path.ends_with("model.safetensors");
        while !server.state.seen.lock().unwrap().iter().any(asked) {
            assert!(!waiting.is_finished(), "it ended without asking");
            std::thread::sleep(std::time::Duration::from_millis(5));
        }
        let mut weights = whole.clone();
        weights.retain(|name, _| name == "model.safetensors");
        let weights = cached(dir.path(), &weights).join("model.safetensors");
        let place = || std::fs::symlink_metadata(&weights).unwrap().ino();
        let before = place();
        drop(lock);
        assert_holds(&waiting.join().unwrap(), &whole);
        assert_eq!(place(), before, "it was replaced");
    });
}
