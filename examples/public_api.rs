//! Lists the public items of the crate, one per line, from rustdoc's JSON: the committed list is `docs/public-api.txt`.
//!
//! ```sh
//! .ci/public-api            # compares; --write writes the list
//! ```
//!
//! What is hidden from the documentation is not in the list, nor are implementations of traits. An item that stands in several
//! places is listed at the outermost of them; the others are `use` lines.

use anyhow::{Context, bail};
use serde_json::Value;
use std::collections::{BTreeMap, BTreeSet, VecDeque};

fn main() -> anyhow::Result<()> {
    let path = std::env::args().nth(1).context("usage: public_api RUSTDOC.json")?;
    let json: Value = serde_json::from_slice(&std::fs::read(&path).with_context(|| path.clone())?)?;
    let mut list =
        List { json: &json, lines: BTreeSet::new(), places: BTreeMap::new(), modules: VecDeque::new() };
    let root = list.item(&json["root"]).context("no root item: is this rustdoc's JSON?")?;
    list.modules.push_back((root, "sdim".to_string()));
    // Breadth first, so that the outermost place of an item comes first.
    while let Some((module, path)) = list.modules.pop_front() {
        list.module(module, &path);
    }
    if list.lines.len() < 10 {
        bail!("{path}: {} items only; rustdoc may write another format now", list.lines.len());
    }
    for line in &list.lines {
        println!("{line}");
    }
    Ok(())
}

struct List<'j> {
    json: &'j Value,
    lines: BTreeSet<String>,
    /// The first place of each item, by its id.
    places: BTreeMap<String, String>,
    modules: VecDeque<(&'j Value, String)>,
}

impl<'j> List<'j> {
    fn item(&self, id: &Value) -> Option<&'j Value> {
        self.json["index"].get(id.to_string().trim_matches('"'))
    }

    fn items(&self, ids: &'j Value) -> impl Iterator<Item = &'j Value> {
        let index = &self.json["index"];
        ids.as_array().into_iter().flatten().filter_map(|id| index.get(id.to_string().trim_matches('"')))
    }

    fn line(&mut self, text: String) {
        self.lines.insert(text);
    }

    fn module(&mut self, module: &'j Value, path: &str) {
        for item in self.items(&module["inner"]["module"]["items"]).collect::<Vec<_>>() {
            if item["visibility"] == "public" || item["inner"].get("use").is_some() {
                self.public(item, path, None);
            }
        }
    }

    /// One item of a module; `renamed` is the name under which it is re-exported.
    fn public(&mut self, item: &'j Value, path: &str, renamed: Option<&str>) {
        let Some((kind, inner)) = item["inner"].as_object().and_then(|o| o.iter().next()) else { return };
        let name = renamed.or(item["name"].as_str()).unwrap_or_default();
        let full = format!("{path}::{name}");
        if kind != "use" {
            let place = self.places.entry(item["id"].to_string()).or_insert_with(|| full.clone());
            if *place != full {
                let line = format!("use {full} = {place}");
                return self.line(line);
            }
        }
        match kind.as_str() {
            "use" => self.reexport(inner, path),
            "module" => {
                self.line(format!("mod {full}"));
                self.modules.push_back((item, full));
            }
            "struct" => {
                self.line(format!("struct {full}{}", generics(&inner["generics"])));
                self.fields(&inner["kind"]["plain"]["fields"], &full);
                self.methods(&inner["impls"], &full);
            }
            "enum" => {
                self.line(format!("enum {full}{}", generics(&inner["generics"])));
                for variant in self.items(&inner["variants"]).collect::<Vec<_>>() {
                    let name = format!("{full}::{}", variant["name"].as_str().unwrap_or_default());
                    self.line(format!("variant {name}"));
                    self.fields(&variant["inner"]["variant"]["kind"]["struct"]["fields"], &name);
                }
                self.methods(&inner["impls"], &full);
            }
            "trait" => {
                self.line(format!("trait {full}{}", generics(&inner["generics"])));
                for item in self.items(&inner["items"]).collect::<Vec<_>>() {
                    self.public(item, &full, None);
                }
            }
            "function" => self.line(format!("fn {full}{}", signature(inner))),
            "constant" => self.line(format!("const {full}: {}", ty(&inner["type"]))),
            "static" => self.line(format!("static {full}: {}", ty(&inner["type"]))),
            "assoc_const" => self.line(format!("const {full}: {}", ty(&inner["type"]))),
            "assoc_type" => self.line(format!("type {full}")),
            "type_alias" => self.line(format!("type {full} = {}", ty(&inner["type"]))),
            other => self.line(format!("{other} {full}")),
        }
    }

    fn reexport(&mut self, inner: &'j Value, path: &str) {
        match self.item(&inner["id"]) {
            Some(item) if inner["is_glob"] == true => self.module(item, path),
            Some(item) => self.public(item, path, inner["name"].as_str()),
            None => {
                let source = inner["source"].as_str().unwrap_or_default();
                self.line(format!("use {path}::{} = {source}", inner["name"].as_str().unwrap_or_default()));
            }
        }
    }

    fn fields(&mut self, ids: &'j Value, path: &str) {
        for field in self.items(ids).collect::<Vec<_>>() {
            let name = field["name"].as_str().unwrap_or_default();
            self.line(format!("field {path}::{name}: {}", ty(&field["inner"]["struct_field"])));
        }
    }

    /// Functions and constants of the type's own `impl` blocks.
    fn methods(&mut self, impls: &'j Value, path: &str) {
        for block in self.items(impls).collect::<Vec<_>>() {
            let block = &block["inner"]["impl"];
            if !block["trait"].is_null() {
                continue;
            }
            for item in self.items(&block["items"]).collect::<Vec<_>>() {
                if item["visibility"] == "public" {
                    self.public(item, path, None);
                }
            }
        }
    }
}

fn joined(list: &Value, of: impl Fn(&Value) -> String, separator: &str) -> String {
    list.as_array().into_iter().flatten().map(of).collect::<Vec<_>>().join(separator)
}

fn generics(generics: &Value) -> String {
    // Synthetic parameters are those of `impl Trait` arguments, which stand in the signature already.
    let own: Vec<String> = generics["params"]
        .as_array()
        .into_iter()
        .flatten()
        .filter(|p| p["kind"]["type"]["is_synthetic"] != true)
        .map(|p| {
            let name = p["name"].as_str().unwrap_or_default();
            match bounds(&p["kind"]["type"]["bounds"]) {
                bounds if bounds.is_empty() => name.to_string(),
                bounds => format!("{name}: {bounds}"),
            }
        })
        .collect();
    if own.is_empty() { String::new() } else { format!("<{}>", own.join(", ")) }
}

fn bounds(list: &Value) -> String {
    joined(list, |b| b["trait_bound"].get("trait").map_or_else(|| "'_".to_string(), path), " + ")
}

fn signature(function: &Value) -> String {
    let sig = &function["sig"];
    let inputs = joined(
        &sig["inputs"],
        |input| match (input[0].as_str().unwrap_or_default(), ty(&input[1])) {
            ("self", t) if t == "Self" => "self".to_string(),
            ("self", t) if t.ends_with("Self") => t.replace("Self", "self"),
            (name, t) => format!("{name}: {t}"),
        },
        ", ",
    );
    let output = if sig["output"].is_null() { String::new() } else { format!(" -> {}", ty(&sig["output"])) };
    format!("{}({inputs}){output}", generics(&function["generics"]))
}

/// A resolved path with its arguments.
fn path(p: &Value) -> String {
    let full = p["path"].as_str().unwrap_or_default();
    let name = full.rsplit("::").next().unwrap_or_default();
    let args = &p["args"];
    if let Some(angled) = args.get("angle_bracketed") {
        let plain = joined(&angled["args"], argument, ", ");
        let bound = joined(
            &angled["constraints"],
            |c| {
                format!(
                    "{} = {}",
                    c["name"].as_str().unwrap_or_default(),
                    ty(&c["binding"]["equality"]["type"])
                )
            },
            ", ",
        );
        let all: Vec<String> = [plain, bound].into_iter().filter(|s| !s.is_empty()).collect();
        return if all.is_empty() { name.to_string() } else { format!("{name}<{}>", all.join(", ")) };
    }
    match args.get("parenthesized") {
        Some(call) => {
            let output =
                if call["output"].is_null() { String::new() } else { format!(" -> {}", ty(&call["output"])) };
            format!("{name}({}){output}", joined(&call["inputs"], ty, ", "))
        }
        None => name.to_string(),
    }
}

fn argument(argument: &Value) -> String {
    match argument.as_object().and_then(|o| o.iter().next()) {
        Some((kind, value)) if kind == "type" => ty(value),
        Some((kind, value)) if kind == "lifetime" => value.as_str().unwrap_or_default().to_string(),
        Some((_, value)) => value["expr"].as_str().unwrap_or("_").to_string(),
        None => "_".to_string(),
    }
}

/// A type as it stands in source, without the paths of names.
fn ty(t: &Value) -> String {
    let Some((kind, inner)) = t.as_object().and_then(|o| o.iter().next()) else { return "_".to_string() };
    match kind.as_str() {
        "primitive" | "generic" => inner.as_str().unwrap_or("_").to_string(),
        "resolved_path" => path(inner),
        "borrowed_ref" => {
            let lifetime = inner["lifetime"].as_str().map(|l| format!("{l} ")).unwrap_or_default();
            let mutable = if inner["is_mutable"] == true { "mut " } else { "" };
            format!("&{lifetime}{mutable}{}", ty(&inner["type"]))
        }
        "tuple" => format!("({})", joined(inner, ty, ", ")),
        "slice" => format!("[{}]", ty(inner)),
        "array" => format!("[{}; {}]", ty(&inner["type"]), inner["len"].as_str().unwrap_or("_")),
        "impl_trait" => {
            format!("impl {}", bounds(&Value::Array(inner.as_array().cloned().unwrap_or_default())))
        }
        "dyn_trait" => format!("dyn {}", joined(&inner["traits"], |t| path(&t["trait"]), " + ")),
        "function_pointer" => signature(inner).replacen('(', "fn(", 1),
        "qualified_path" => {
            format!("{}::{}", ty(&inner["self_type"]), inner["name"].as_str().unwrap_or_default())
        }
        other => other.to_string(),
    }
}
