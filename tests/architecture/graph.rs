//! Which file of `src` uses which: imports and paths, resolved to the file that holds the item.

use crate::source::{Source, tokens};
use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::path::Path;

/// A path of module names from the crate's root.
type Module = Vec<String>;
/// Files that each file uses.
pub type Graph = BTreeMap<String, BTreeSet<String>>;

struct File {
    /// Relative to the package, as `src/depth/map.rs`.
    name: String,
    module: Module,
    source: Source,
}

/// The files of the library, but for those that only tests have.
pub struct Tree {
    files: Vec<File>,
    /// The file of every module, and how many names of the module's path are inline in it.
    modules: HashMap<Module, (usize, usize)>,
}

/// What a path leads to.
enum Target {
    File(usize),
    Module(Module),
}

/// Imports that lead to imports, at most: more is a circle of names.
const HOPS: usize = 16;

impl Tree {
    /// Reads `src/lib.rs` and every module that it leads to.
    pub fn read(package: &Path) -> Self {
        let mut tree = Tree { files: Vec::new(), modules: HashMap::new() };
        tree.add(package, "src/lib.rs".into(), Vec::new());
        tree
    }

    fn add(&mut self, package: &Path, name: String, module: Module) {
        let text = std::fs::read_to_string(package.join(&name)).unwrap();
        let source = Source::read(&tokens(&text));
        let index = self.files.len();
        self.modules.insert(module.clone(), (index, 0));
        for scope in &source.inline {
            self.modules.insert([&module[..], scope].concat(), (index, scope.len()));
        }
        let children = source.children.clone();
        self.files.push(File { name, module: module.clone(), source });
        for child in children {
            let module = [&module[..], std::slice::from_ref(&child)].concat();
            let stem = format!("src/{}", module.join("/"));
            let names = [format!("{stem}.rs"), format!("{stem}/mod.rs")];
            let name = names.into_iter().find(|name| package.join(name).exists());
            self.add(package, name.unwrap_or_else(|| panic!("no file for {stem}")), module);
        }
    }

    /// All edges. What a file re-exports from its own folder is no edge: it is a door, and who comes through it uses the
    /// file behind it.
    pub fn graph(&self) -> Graph {
        let mut graph: Graph = self.files.iter().map(|f| (f.name.clone(), BTreeSet::new())).collect();
        for (index, file) in self.files.iter().enumerate() {
            let mut found = BTreeSet::new();
            let imports = file.source.imports.iter().map(|i| (&i.scope, &i.path, i.public));
            let paths = file.source.paths.iter().map(|(scope, path)| (scope, path, false));
            for (scope, path, public) in imports.chain(paths) {
                let module = [&file.module[..], scope].concat();
                if let Some(Target::File(target)) = self.resolve(&module, path, HOPS)
                    && target != index
                    && !(public && self.files[target].module.starts_with(&file.module))
                {
                    found.insert(self.files[target].name.clone());
                }
            }
            graph.insert(file.name.clone(), found);
        }
        graph
    }

    /// What a path leads to that is written in `module`; `None` for other crates.
    fn resolve(&self, module: &Module, path: &[String], hops: usize) -> Option<Target> {
        let (first, rest) = path.split_first()?;
        let hops = hops.checked_sub(1)?;
        match &first[..] {
            "crate" => self.walk(&Vec::new(), rest, hops),
            "self" => self.walk(module, rest, hops),
            "super" => {
                let mut parent = module.clone();
                parent.pop();
                match rest.first().is_some_and(|next| next == "super") {
                    true => self.resolve(&parent, rest, hops),
                    false => self.walk(&parent, rest, hops),
                }
            }
            _ => self.lookup(module, first, rest, hops),
        }
    }

    /// Follows the names of a path from `module` on.
    fn walk(&self, module: &Module, path: &[String], hops: usize) -> Option<Target> {
        let (file, _) = *self.modules.get(module)?;
        let Some((first, rest)) = path.split_first() else { return Some(Target::Module(module.clone())) };
        if first == "*" {
            return Some(Target::File(file));
        }
        // What the module does not show was made by a macro in it.
        Some(self.lookup(module, first, rest, hops).unwrap_or(Target::File(file)))
    }

    /// What a name means in `module`: something imported, a module, an item. Where an imported function and a module share a name,
    /// the last name of a path is the function.
    fn lookup(&self, module: &Module, name: &String, rest: &[String], hops: usize) -> Option<Target> {
        let (index, inline) = *self.modules.get(module)?;
        let source = &self.files[index].source;
        let scope = &module[module.len() - inline..];
        let child = [&module[..], std::slice::from_ref(name)].concat();
        let is_module = self.modules.contains_key(&child);
        if is_module && !rest.is_empty() {
            return self.walk(&child, rest, hops);
        }
        let import = source.imports.iter().find(|i| i.scope == scope && i.name == *name);
        // `use name::...;` says where another crate's name comes from, not this one's.
        if let Some(import) = import.filter(|i| i.path[0] != *name || is_module) {
            let full = [&import.path[..], rest].concat();
            return self.resolve(module, &full, hops);
        }
        if source.items.contains(&(scope.to_vec(), name.clone())) {
            return Some(Target::File(index));
        }
        if is_module {
            return Some(Target::Module(child));
        }
        let globs = source.imports.iter().filter(|i| i.scope == scope && i.name == "*");
        globs.into_iter().find_map(|glob| {
            let from = &glob.path[..glob.path.len() - 1];
            match self.resolve(module, from, hops)? {
                Target::Module(other) if other != *module => {
                    self.lookup(&other, name, rest, hops.checked_sub(1)?)
                }
                _ => None,
            }
        })
    }
}

/// A shortest way from one file to another, both included.
pub fn way(graph: &Graph, from: &str, to: &str) -> Option<Vec<String>> {
    let mut before: HashMap<&str, &str> = HashMap::new();
    let mut front = vec![from];
    while !front.is_empty() {
        let mut next = Vec::new();
        for file in front {
            for used in graph.get(file).into_iter().flatten() {
                if used == to {
                    let mut way = vec![to.to_string(), file.to_string()];
                    let mut at = file;
                    while at != from {
                        at = before[at];
                        way.push(at.to_string());
                    }
                    way.reverse();
                    return Some(way);
                }
                if used != from && !before.contains_key(&used[..]) {
                    before.insert(used, file);
                    next.push(&used[..]);
                }
            }
        }
        front = next;
    }
    None
}

/// One circle for each group of files that lie on circles with each other.
pub fn circles(graph: &Graph) -> Vec<Vec<String>> {
    let mut found: Vec<Vec<String>> = Vec::new();
    let mut grouped: BTreeSet<&str> = BTreeSet::new();
    for file in graph.keys().filter(|file| way(graph, file, file).is_some()) {
        if grouped.contains(&file[..]) {
            continue;
        }
        let group = graph
            .keys()
            .filter(|other| way(graph, file, other).is_some() && way(graph, other, file).is_some());
        grouped.extend(group.map(|other| &other[..]));
        found.extend(way(graph, file, file));
    }
    found
}
