//! What holds for the shape of the code, whoever changes it:
//!
//! - **No circle of files in `src`.** A file uses another if one of its imports or paths leads to an item of it. Imports are
//!   followed through re-exports to the file that holds the item, so that a folder's `mod.rs` is a door and not a file that its
//!   inmates depend on; what a file re-exports from its own folder is no use either. `mod` declarations, comments and whatever
//!   is compiled for tests alone (`#[cfg(test)]`) do not count, nor does what a `macro_rules!` body names, which is used where
//!   the macro is. Items that macros make count as the file's in whose module they are found, and a glob import as a use of the
//!   module's file. Method calls are not seen.
//! - **Arrows between rooms go one way**: what each room may use stands in the table of `ARCHITECTURE.md`, "Rooms".
//! - **`unsafe` has one room**, `kernels`, but for the files of [`UNSAFE_OUTSIDE`].
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

/// What every room may use.
const EVERYWHERE: &[&str] = &["src/error.rs", "src/files.rs"];
/// What the rooms above `kernels` may use, too.
const ABOVE_KERNELS: &str = "src/system.rs";

/// Files outside of `src/kernels` that hold the word `unsafe` as code.
const UNSAFE_OUTSIDE: &[&str] = &["src/vlm/checkpoint/stored.rs"];
/// Files that allow what `src/lib.rs` forbids everywhere: itself, for `kernels`, and those.
const ALLOW_UNSAFE: &[&str] = &["src/lib.rs", "src/vlm/checkpoint/stored.rs"];

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

/// A row of the table of rooms.
struct Room {
    /// Folders, with a slash at their end, and files.
    places: Vec<String>,
    /// Rooms or parts of rooms, as `depth` or `vlm/layers`; `None` for all.
    may_use: Option<Vec<String>>,
}

/// What stands in code type in a text.
fn names(text: &str) -> Vec<String> {
    text.split('`').skip(1).step_by(2).map(String::from).collect()
}

/// The table under "Rooms" of a text as `ARCHITECTURE.md`.
fn rooms(text: &str) -> Vec<Room> {
    let section = text.split("\n## ").find(|section| section.starts_with("Rooms\n")).unwrap();
    let rows = section.lines().filter(|line| line.starts_with("| `src/"));
    let room = |line: &str| {
        let cells: Vec<&str> = line.split('|').collect();
        assert_eq!(cells.len(), 5, "three columns in {line}");
        let may_use = (cells[3].trim() != "everything").then(|| names(cells[3]));
        Room { places: names(cells[1]), may_use }
    };
    rows.map(room).collect()
}

/// Whether a place of the table holds a file.
fn holds(place: &str, file: &str) -> bool {
    file == place || place.ends_with('/') && file.starts_with(place)
}

/// The uses that the table does not allow.
fn crossings(graph: &Graph, rooms: &[Room]) -> BTreeSet<(String, String)> {
    let room = |file: &str| rooms.iter().find(|room| room.places.iter().any(|place| holds(place, file)));
    let allowed = |file: &str, used: &str| {
        let Some(own) = room(file) else { return false };
        let Some(may_use) = &own.may_use else { return true };
        let named = |name: &String| {
            let stem = format!("src/{name}");
            used.strip_prefix(&stem).is_some_and(|rest| rest == ".rs" || rest.starts_with('/'))
        };
        own.places.iter().any(|place| holds(place, used))
            || EVERYWHERE.contains(&used)
            || used == ABOVE_KERNELS && !file.starts_with("src/kernels/")
            || may_use.iter().any(named)
    };
    let pairs =
        graph.iter().flat_map(|(file, uses)| uses.iter().map(move |used| (file.clone(), used.clone())));
    pairs.filter(|(file, used)| !allowed(file, used)).collect()
}

#[test]
fn arrows_between_rooms_go_one_way() {
    let text = std::fs::read_to_string(package().join("ARCHITECTURE.md")).unwrap();
    let (graph, rooms) = (graph_of_src(), rooms(&text));
    for place in rooms.iter().flat_map(|room| &room.places) {
        assert!(graph.keys().any(|file| holds(place, file)), "no file of src in {place}");
    }
    let known = CROSSINGS_OF_TODAY.iter().map(|(file, used)| (file.to_string(), used.to_string())).collect();
    compare(
        "uses that the table of rooms in ARCHITECTURE.md does not allow",
        crossings(&graph, &rooms),
        known,
    );
}

#[test]
fn unsafe_has_one_room() {
    let (mut found, mut allow) = (BTreeSet::new(), BTreeSet::new());
    let mut files = Vec::new();
    collect(&package().join("src"), &mut files);
    for path in files {
        let name = name_of(&path);
        let tokens = source::tokens(&std::fs::read_to_string(&path).unwrap());
        if !name.starts_with("src/kernels/") && tokens.iter().any(|token| token.text == "unsafe") {
            found.insert(name.clone());
        }
        let attribute = |word: &[source::Token]| {
            matches!(&word[0].text[..], "allow" | "expect") && word[2].text == "unsafe_code"
        };
        if tokens.windows(3).any(attribute) {
            allow.insert(name);
        }
    }
    let set = |names: &[&str]| names.iter().map(|name| name.to_string()).collect();
    compare("files outside of kernels with `unsafe`", found, set(UNSAFE_OUTSIDE));
    compare("files that allow unsafe code", allow, set(ALLOW_UNSAFE));
}

#[test]
fn nothing_is_too_long() {
    let mut found = BTreeSet::new();
    let mut files = Vec::new();
    for folder in ["src", "examples", "benches", "tests"] {
        collect(&package().join(folder), &mut files);
    }
    for path in files {
        let name = name_of(&path);
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

/// A file as `src/depth/map.rs`.
fn name_of(path: &Path) -> String {
    path.strip_prefix(package()).unwrap().display().to_string().replace('\\', "/")
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
    #[test]
    fn the_table_of_rooms_is_read() {
        let text = "# A\n\n## Rooms\n\n| room | what | may use |\n|---|---|---|\n| `src/lib.rs` | all | everything |\n\
                    | `src/a/`, `src/b.rs` | `Thing` | `c`, `d/low` |\n| `src/c/` | | |\n\n## Next\n\n| `src/no/` | | |\n";
        let rooms = rooms(text);
        assert_eq!(rooms.len(), 3);
        let used = |file: &str, used: &str| {
            let graph = Graph::from([(file.to_string(), BTreeSet::from([used.to_string()]))]);
            crossings(&graph, &rooms).is_empty()
        };
        let good = [
            ("a/x", "b"),
            ("a/x", "c/y"),
            ("b", "c"),
            ("b", "d/low/z"),
            ("lib", "e"),
            ("c/y", "error"),
            ("c/y", "system"),
        ];
        for (file, other) in good {
            assert!(used(&format!("src/{file}.rs"), &format!("src/{other}.rs")), "{file} {other}");
        }
        // What is only named like a room, a part that is not named, what has no row.
        for (file, other) in [
            ("a/x", "cc"),
            ("a/x", "d/high"),
            ("c/y", "a/x"),
            ("e", "c/y"),
            ("no/n", "c/y"),
            ("kernels/k", "system"),
        ] {
            assert!(!used(&format!("src/{file}.rs"), &format!("src/{other}.rs")), "{file} {other}");
        }
    }
}
