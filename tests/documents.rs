//! The documents name files, folders and headings that exist, and examples with options that they have.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

/// Folders that documents name files in.
const FOLDERS: [&str; 10] = [
    "src/",
    "docs/",
    "examples/",
    "benches/",
    "tests/",
    "assets/",
    "scripts/",
    ".ci/",
    "training/",
    "checkpoints/",
];

fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

/// Files of an ending in a folder, and in those below it that are not hidden.
fn collect(dir: &Path, ending: &str, deep: bool, into: &mut Vec<PathBuf>) {
    for entry in std::fs::read_dir(dir).unwrap() {
        let entry = entry.unwrap();
        let path = entry.path();
        if path.is_dir() {
            if deep && !entry.file_name().to_string_lossy().starts_with('.') {
                collect(&path, ending, true, into);
            }
        } else if path.extension().is_some_and(|e| e == ending) {
            into.push(path);
        }
    }
}

fn documents() -> Vec<PathBuf> {
    let mut found = Vec::new();
    collect(root(), "md", false, &mut found);
    for folder in ["docs", "benches", "assets", "training", "checkpoints"] {
        collect(&root().join(folder), "md", true, &mut found);
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

/// The options that clap takes from a source text: the fields under `#[arg(long, ..)]`, and their other names.
fn options(source: &str) -> BTreeSet<String> {
    let mut found = BTreeSet::from(["help".to_string()]);
    for attribute in source.split("#[arg(").skip(1) {
        let (inside, after) = attribute.split_once(")]").unwrap_or((attribute, ""));
        let named = |key: &str| between(inside, key, '"').map(String::from).collect::<Vec<_>>();
        let mut words = inside.split(|c: char| !c.is_alphanumeric() && c != '_');
        if !words.any(|word| word == "long") {
            continue;
        }
        found.extend(named("alias = \""));
        let field =
            after.lines().map(str::trim).find(|line| !line.is_empty() && !line.starts_with(['#', '/']));
        let field = field.and_then(|line| line.split_once(':')).map(|(name, _)| name);
        let field = field.map(|name| name.trim_start_matches("pub ").replace('_', "-"));
        match named("long = \"") {
            own if own.is_empty() => found.extend(field),
            own => found.extend(own),
        }
    }
    found
}

/// The examples and their options.
fn examples() -> BTreeMap<String, BTreeSet<String>> {
    let mut found = BTreeMap::new();
    for entry in std::fs::read_dir(root().join("examples")).unwrap() {
        let path = entry.unwrap().path();
        let mut files = Vec::new();
        if path.join("main.rs").exists() {
            collect(&path, "rs", true, &mut files);
        } else if path.extension().is_some_and(|e| e == "rs") {
            files.push(path.clone());
        }
        // Files of its own that lie elsewhere.
        for file in files.clone() {
            let source = std::fs::read_to_string(&file).unwrap();
            let beside = file.parent().unwrap();
            files.extend(between(&source, "#[path = \"", '"').map(|other| beside.join(other)));
        }
        if !files.is_empty() {
            let sources = files.iter().map(|file| std::fs::read_to_string(file).unwrap());
            let name = path.file_stem().unwrap().to_string_lossy().into_owned();
            found.insert(name, sources.flat_map(|source| options(&source)).collect());
        }
    }
    found
}

/// What is wrong with the commands of a document: examples that are not there, and options that an example has not.
fn wrong_commands(text: &str, examples: &BTreeMap<String, BTreeSet<String>>) -> Vec<String> {
    let text = text.replace("\\\n", " ");
    let is_name = |c: char| c.is_alphanumeric() || matches!(c, '_' | '-');
    let split = |rest: &str| {
        let (name, rest) = rest.split_at(rest.find(|c| !is_name(c)).unwrap_or(rest.len()));
        let end = rest.find(['\n', '`', '#', '|', ';', '&', '"']).unwrap_or(rest.len());
        (name.to_string(), rest[..end].to_string())
    };
    let after = |mark: &str| {
        text.match_indices(mark).map(|(at, _)| split(&text[at + mark.len()..])).collect::<Vec<_>>()
    };
    let mut calls = after("target/release/examples/");
    // What cargo is told, and after two dashes the program.
    calls.extend(after("--example ").into_iter().map(|(name, rest)| match rest.strip_prefix(" -- ") {
        Some(told) => (name, told.to_string()),
        None => (name, String::new()),
    }));
    // `complete --json` in a sentence.
    let spans = prose(&text);
    let spans = spans.split('`').skip(1).step_by(2).map(split);
    calls.extend(spans.filter(|(name, rest)| examples.contains_key(name) && rest.starts_with(" --")));
    let mut wrong = Vec::new();
    for (name, told) in calls {
        let Some(options) = examples.get(&name) else {
            // A place for a name.
            if !name.is_empty() && name != "NAME" {
                wrong.push(format!("no example {name}"));
            }
            continue;
        };
        let flags = told.split_whitespace().filter_map(|word| word.strip_prefix("--"));
        let flags = flags.map(|flag| flag.split(['=', ')', ',', '.', ']']).next().unwrap_or_default());
        wrong.extend(
            flags.filter(|flag| !options.contains(*flag)).map(|flag| format!("{name} has no --{flag}")),
        );
    }
    wrong
}

#[test]
fn commands_name_examples_and_options_that_exist() {
    let examples = examples();
    let mut wrong = Vec::new();
    for path in documents() {
        let name = path.strip_prefix(root()).unwrap().display().to_string();
        let found = wrong_commands(&std::fs::read_to_string(&path).unwrap(), &examples);
        wrong.extend(found.iter().map(|fault| format!("{name}: {fault}")));
    }
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}

#[test]
fn wrong_commands_are_noticed() {
    let source = "struct Args {\n    /// A text.\n    #[arg(long, value_parser = pair)]\n    /// More.\n    pub max_memory: u8,\n\
                  #[arg(long = \"other\", visible_alias = \"old\")]\n    named: u8,\n    #[arg(short)]\n    short: u8,\n}";
    let found = options(source);
    assert_eq!(found.iter().collect::<Vec<_>>(), ["help", "max-memory", "old", "other"]);
    let examples = BTreeMap::from([("complete".to_string(), found)]);
    let text = "```sh\ncargo run --features cuda --example complete -- --other 1 \\\n    --old 2 --new 3  # --dtype\n\
                cargo build --example compleet\ntarget/release/examples/complete --named\n```\n\
                `complete --max-memory MB` and `complete --none`, `--nothing`, `incomplete --x`";
    let wrong =
        ["complete has no --named", "complete has no --new", "no example compleet", "complete has no --none"];
    assert_eq!(wrong_commands(text, &examples), wrong);
}
