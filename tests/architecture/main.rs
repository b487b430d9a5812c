//! What holds for the shape of the code, whoever changes it:
//!
//! - **No circle of files in `src`.** A file uses another if one of its imports or paths leads to an item of it. Imports are
//!   followed through re-exports to the file that holds the item, so that a folder's `mod.rs` is a door and not a file that its
//!   inmates depend on; what a file re-exports from its own folder is no use either. `mod` declarations, comments and whatever
//!   is compiled for tests alone (`#[cfg(test)]`) do not count, nor does what a `macro_rules!` body names, which is used where
//!   the macro is. Items that macros make count as the file's in whose module they are found, and a glob import as a use of the
//!   module's file. Method calls are not seen.
//! - **Arrows between rooms go one way**: what each folder may not use stands in [`APART`].
//! - **Nothing is too long**: files have at most 400 lines, functions 80, in `src`, `examples`, `benches` and `tests`.
//!
//! What breaks a rule today stands in the lists below. They only ever get shorter: an entry that is no longer needed fails.

mod graph;
mod source;

use graph::{Graph, Tree, circles, way};
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

/// Uses that close a circle of files: `(file, used)`.
const CIRCLES_OF_TODAY: &[(&str, &str)] = &[];

/// Uses against the direction of rooms: `(file, used)`.
const CROSSINGS_OF_TODAY: &[(&str, &str)] = &[];

/// Files and functions (`file`, `file: function`) that are too long.
const TOO_LONG_TODAY: &[&str] = &[];

/// Rooms, and what they may not use.
const APART: &[(&str, &[&str])] = &[
    (
        "depth",
        &[
            "vlm",
            "kernels",
            "fusion",
            "query",
            "model",
            "complete",
            "refine",
            "classical",
            "metrics",
            "draw",
            "scenes",
            "benchmarks",
        ],
    ),
    ("image", &["vlm", "kernels", "fusion", "query", "model", "complete", "refine"]),
    ("vlm", &["depth", "fusion", "query", "model", "complete", "refine"]),
    ("fusion", &["depth", "query", "model", "complete", "refine"]),
    ("refine", &["vlm", "kernels", "fusion", "query", "model", "complete"]),
    ("query", &["model", "complete", "refine"]),
    ("model", &["complete", "refine", "supervise", "hub"]),
    ("complete", &["supervise", "hub", "benchmarks", "scenes"]),
    ("scenes", &["vlm", "kernels", "fusion", "query", "model", "complete", "refine", "benchmarks"]),
    ("benchmarks", &["vlm", "kernels", "fusion", "query", "model", "complete", "refine"]),
];
/// All that `kernels` may use.
const BELOW_KERNELS: &[&str] = &["kernels", "error"];

const LONGEST_FILE: usize = 400;
const LONGEST_FUNCTION: usize = 80;

fn package() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

fn graph_of_src() -> Graph {
    Tree::read(package()).graph()
}

/// Fails with the entries of `found` that `known` lacks, and with those of `known` that are not found.
#[track_caller]
fn compare<T: Ord + std::fmt::Debug>(rule: &str, found: BTreeSet<T>, known: BTreeSet<T>) {
    let new: Vec<&T> = found.difference(&known).collect();
    assert!(new.is_empty(), "{rule}: {new:#?}");
    let gone: Vec<&T> = known.difference(&found).collect();
    assert!(gone.is_empty(), "no longer needed in the list of what breaks this rule ({rule}): {gone:#?}");
}

#[test]
fn no_circle_of_files() {
    let full = graph_of_src();
    let mut graph = full.clone();
    for (file, used) in CIRCLES_OF_TODAY {
        let uses = full.get(*file).is_some_and(|uses| uses.contains(*used));
        let needed = uses && way(&full, used, file).is_some();
        assert!(needed, "no longer needed in CIRCLES_OF_TODAY: {file} uses {used}");
        graph.get_mut(*file).unwrap().remove(*used);
    }
    let found = circles(&graph);
    let shown: Vec<String> = found.iter().map(|circle| circle.join("\n    uses ")).collect();
    assert!(found.is_empty(), "circles of files:\n{}", shown.join("\n\n"));
}

/// The room of a file: its folder, or its own name where it has none.
fn room(file: &str) -> &str {
    let inner = file.trim_start_matches("src/");
    inner.split('/').next().unwrap_or(inner).trim_end_matches(".rs")
}

#[test]
fn arrows_between_rooms_go_one_way() {
    let mut found = BTreeSet::new();
    for (file, uses) in &graph_of_src() {
        for used in uses {
            let (from, to) = (room(file), room(used));
            let apart = APART.iter().any(|(room, others)| *room == from && others.contains(&to));
            if apart || from == "kernels" && !BELOW_KERNELS.contains(&to) {
                found.insert((file.clone(), used.clone()));
            }
        }
    }
    let known = CROSSINGS_OF_TODAY.iter().map(|(file, used)| (file.to_string(), used.to_string())).collect();
    compare("uses against the direction of rooms", found, known);
}

#[test]
fn nothing_is_too_long() {
    let mut found = BTreeSet::new();
    let mut files = Vec::new();
    for folder in ["src", "examples", "benches", "tests"] {
        collect(&package().join(folder), &mut files);
    }
    for path in files {
        let name = path.strip_prefix(package()).unwrap().display().to_string().replace('\\', "/");
        let text = std::fs::read_to_string(&path).unwrap();
        if text.lines().count() > LONGEST_FILE {
            found.insert(name.clone());
        }
        for function in source::functions(&source::tokens(&text)) {
            if function.last - function.first >= LONGEST_FUNCTION {
                found.insert(format!("{name}: {}", function.name));
            }
        }
    }
    let known = TOO_LONG_TODAY.iter().map(|name| name.to_string()).collect();
    compare("more than 400 lines in a file or 80 in a function", found, known);
}

/// All Rust files of a folder.
fn collect(folder: &Path, files: &mut Vec<PathBuf>) {
    for entry in std::fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            collect(&path, files);
        } else if path.extension().is_some_and(|e| e == "rs") {
            files.push(path);
        }
    }
}

/// The rules against a small crate of their own: what they must see and what they must not.
mod rules {
    use super::*;
    use source::{functions, tokens};

    /// The uses in a crate of these files, as `from > to`, without folder and ending.
    fn uses(files: &[(&str, &str)]) -> Vec<String> {
        let package = tempfile::tempdir().unwrap();
        for (name, text) in files {
            let path = package.path().join("src").join(name);
            std::fs::create_dir_all(path.parent().unwrap()).unwrap();
            std::fs::write(path, text).unwrap();
        }
        let graph = Tree::read(package.path()).graph();
        let short = |name: &str| name.trim_start_matches("src/").trim_end_matches(".rs").to_string();
        let pairs = graph
            .iter()
            .flat_map(|(f, uses)| uses.iter().map(move |u| format!("{} > {}", short(f), short(u))));
        pairs.collect()
    }

    #[test]
    fn imports_lead_through_doors_to_the_file_that_holds_the_item() {
        let found = uses(&[
            ("lib.rs", "mod a;\nmod b;\npub use a::Deep as Shown;"),
            (
                "a/mod.rs",
                "mod deep;\nmod other;\npub use deep::{Deep, /* { */ work};\npub use self::other::*;",
            ),
            ("a/deep.rs", "use super::Other; pub struct Deep; pub fn work() { let _ = '{'; }"),
            ("a/other.rs", "pub struct Other; const TEXT: &str = r#\"use crate::b::B; \" {\"#;"),
            (
                "b.rs",
                "use crate::{Shown, a::{self}}; fn f<'a>(_: &'a Shown) { a::work(); a::Other; std::mem::drop(1) }",
            ),
        ]);
        assert_eq!(found, ["a/deep > a/other", "b > a/deep", "b > a/other"]);
    }

    #[test]
    fn tests_and_comments_do_not_count() {
        let found = uses(&[
            ("lib.rs", "mod a;\nmod b;\n#[cfg(test)]\nmod tests;"),
            (
                "a.rs",
                "pub struct A;\n#[cfg(test)]\nmod tests { use crate::b::B; fn f() { crate::b::g(); } }\nmod x { use super::*; }",
            ),
            (
                "b.rs",
                "//! [`crate::a::A`]\n#[cfg(test)]\nuse crate::a::{A};\npub struct B; // crate::a::A::new()\n",
            ),
        ]);
        assert_eq!(found, [""; 0]);
    }

    #[test]
    fn circles_are_found_once_each() {
        let text = |used: &str| format!("use crate::{used}; pub fn f() {{}}");
        let files = [("a", "b::f"), ("b", "c::f"), ("c", "a::f"), ("d", "a::f")];
        let graph: Graph = files
            .iter()
            .map(|(file, used)| {
                (file.to_string(), BTreeSet::from([used.trim_end_matches("::f").to_string()]))
            })
            .collect();
        assert_eq!(circles(&graph), [["a", "b", "c", "a"]]);
        let modules = "mod a; mod b; mod c; mod d;".to_string();
        let sources: Vec<(String, String)> = std::iter::once(("lib.rs".to_string(), modules))
            .chain(files.iter().map(|(file, used)| (format!("{file}.rs"), text(used))))
            .collect();
        let sources: Vec<(&str, &str)> = sources.iter().map(|(a, b)| (&a[..], &b[..])).collect();
        assert_eq!(uses(&sources), ["a > b", "b > c", "c > a", "d > a"]);
    }

    #[test]
    fn functions_are_measured_from_their_name_to_their_last_brace() {
        let text = "trait T {\n fn none(&self);\n}\nfn one() -> [u8; 2] { \"}\"; [b'}', '\\''] }\nfn two<F: Fn(u8)>() {\n {}\n}";
        let found: Vec<_> =
            functions(&tokens(text)).into_iter().map(|f| (f.name, f.last - f.first + 1)).collect();
        assert_eq!(found, [("one".to_string(), 1), ("two".to_string(), 3)]);
    }
}
