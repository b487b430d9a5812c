//! The documents name files, folders and headings that exist.

use std::path::{Path, PathBuf};

/// Folders that documents name files in.
const FOLDERS: [&str; 7] = ["src/", "docs/", "examples/", "benches/", "tests/", "assets/", ".ci/"];

fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

/// Markdown files of a folder and of those below it.
fn collect(dir: &Path, deep: bool, into: &mut Vec<PathBuf>) {
    for entry in std::fs::read_dir(dir).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() && deep {
            collect(&path, true, into);
        } else if path.extension().is_some_and(|e| e == "md") {
            into.push(path);
        }
    }
}

fn documents() -> Vec<PathBuf> {
    let mut found = Vec::new();
    collect(root(), false, &mut found);
    for folder in ["docs", "benches", "assets"] {
        collect(&root().join(folder), true, &mut found);
    }
    found
}

/// What stands between `open` and `close`, wherever it does.
fn between<'a>(text: &'a str, open: &'a str, close: char) -> impl Iterator<Item = &'a str> {
    text.match_indices(open).filter_map(move |(at, _)| text[at + open.len()..].split(close).next())
}

/// Text without blocks of code.
fn prose(text: &str) -> String {
    text.split("```").step_by(2).collect()
}

/// The names by which headings can be linked to, as GitHub makes them.
fn anchors(text: &str) -> Vec<String> {
    let headings = text.lines().filter(|line| line.starts_with('#'));
    let anchor = |line: &str| {
        let kept = line.trim_start_matches('#').trim().to_lowercase();
        let kept = kept.chars().filter(|c| c.is_alphanumeric() || matches!(c, ' ' | '-' | '_'));
        kept.map(|c| if c == ' ' { '-' } else { c }).collect()
    };
    headings.map(anchor).collect()
}

/// Links of a document that lead to no file or heading.
fn broken_links(path: &Path, text: &str) -> Vec<String> {
    let broken = |target: &&str| {
        if target.contains("://") {
            return false;
        }
        let (file, anchor) = target.split_once('#').unwrap_or((target, ""));
        let file = if file.is_empty() { path.to_path_buf() } else { path.parent().unwrap().join(file) };
        let heading = |text: String| anchors(&prose(&text)).iter().any(|a| a == anchor);
        !file.exists() || (!anchor.is_empty() && !std::fs::read_to_string(file).is_ok_and(heading))
    };
    between(text, "](", ')').filter(broken).map(String::from).collect()
}

/// Names in code type that look like files of this repository and are none.
fn absent_files(text: &str) -> Vec<String> {
    let named = text.split('`').skip(1).step_by(2);
    let paths = named.filter(|name| FOLDERS.iter().any(|folder| name.starts_with(folder)));
    let real = paths.filter(|name| !name.contains([' ', '*', '{']) && !name.contains("NAME"));
    real.filter(|name| !root().join(name).exists()).map(String::from).collect()
}

#[test]
fn links_and_names_of_files_lead_somewhere() {
    let documents = documents();
    assert!(documents.len() > 50, "{} documents", documents.len());
    let mut wrong = Vec::new();
    for path in &documents {
        let text = prose(&std::fs::read_to_string(path).unwrap());
        let name = path.strip_prefix(root()).unwrap().display().to_string();
        wrong.extend(broken_links(path, &text).iter().map(|link| format!("{name}: link to {link}")));
        wrong.extend(absent_files(&text).iter().map(|file| format!("{name}: {file}")));
    }
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}

#[test]
fn what_leads_nowhere_is_noticed() {
    let path = root().join("README.md");
    let text = "[a](ARCHITECTURE.md#rooms) [b](ARCHITECTURE.md#cellar) [c](none.md) [d](https://x.org/none) `src/lib.rs` \
                `src/none.rs` `src/NAME.rs`";
    assert_eq!(broken_links(&path, text), ["ARCHITECTURE.md#cellar", "none.md"]);
    assert_eq!(absent_files(text), ["src/none.rs"]);
}
