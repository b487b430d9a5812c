//! What the rules need to know of one source file: its tokens, imports, items and functions.
//!
//! This is no parser of Rust. It reads tokens without comments, strings and characters, and knows how imports, modules and
//! functions are written in this repository.

use std::collections::HashSet;

/// A token and the line it stands in, counted from 1. Strings and characters are tokens without text.
#[derive(Debug)]
pub struct Token {
    pub text: String,
    pub line: usize,
}

/// Splits source text into tokens.
pub fn tokens(text: &str) -> Vec<Token> {
    let chars: Vec<char> = text.chars().collect();
    let at = |i: usize| chars.get(i).copied().unwrap_or('\0');
    let (mut tokens, mut i, mut line) = (Vec::new(), 0, 1);
    while i < chars.len() {
        let start = i;
        let mut text = String::new();
        match chars[i] {
            '/' if at(i + 1) == '/' => i = skip_until(&chars, i, |c| c == '\n'),
            '/' if at(i + 1) == '*' => i = skip_block_comment(&chars, i),
            '"' => i = skip_quoted(&chars, i),
            '\'' if at(i + 1) == '\\' || at(i + 2) == '\'' => i = skip_quoted(&chars, i),
            '\'' => i = skip_until(&chars, i + 1, |c| !is_word(c)),
            c if is_word(c) => {
                i = skip_until(&chars, i, |c| !is_word(c));
                text = chars[start..i].iter().collect();
                if matches!(&text[..], "r" | "b" | "br" | "c" | "cr") && matches!(at(i), '"' | '#' | '\'') {
                    i = skip_prefixed(&chars, i);
                    text.clear();
                }
            }
            ':' if at(i + 1) == ':' => (i, text) = (i + 2, "::".into()),
            c if c.is_whitespace() => i += 1,
            c => (i, text) = (i + 1, c.into()),
        }
        if !text.is_empty() {
            tokens.push(Token { text, line });
        }
        line += chars[start..i.min(chars.len())].iter().filter(|c| **c == '\n').count();
    }
    tokens
}

fn is_word(c: char) -> bool {
    c.is_alphanumeric() || c == '_'
}

fn skip_until(chars: &[char], from: usize, stop: impl Fn(char) -> bool) -> usize {
    chars[from..].iter().position(|c| stop(*c)).map_or(chars.len(), |n| from + n)
}

/// After a `/* comment */`, which may hold others.
fn skip_block_comment(chars: &[char], from: usize) -> usize {
    let (mut i, mut depth) = (from, 0);
    while i + 1 < chars.len() {
        match (chars[i], chars[i + 1]) {
            ('/', '*') => (i, depth) = (i + 2, depth + 1),
            ('*', '/') => (i, depth) = (i + 2, depth - 1),
            _ => i += 1,
        }
        if depth == 0 {
            return i;
        }
    }
    chars.len()
}

/// After a string or character that starts at `from` and may hold escapes.
fn skip_quoted(chars: &[char], from: usize) -> usize {
    let mut i = from + 1;
    while i < chars.len() && chars[i] != chars[from] {
        i += if chars[i] == '\\' { 2 } else { 1 };
    }
    i + 1
}

/// After what follows a prefix such as `r` or `b`: a plain or a raw string, or a byte. (`r#name` is a name, and stays.)
fn skip_prefixed(chars: &[char], from: usize) -> usize {
    let hashes = chars[from..].iter().take_while(|c| **c == '#').count();
    if hashes == 0 {
        return skip_quoted(chars, from);
    }
    if chars.get(from + hashes) != Some(&'"') {
        return from + hashes;
    }
    let end: Vec<char> = std::iter::once('"').chain(std::iter::repeat_n('#', hashes)).collect();
    let body = from + hashes + 1;
    chars[body..].windows(end.len()).position(|w| w == end).map_or(chars.len(), |n| body + n + end.len())
}

/// A function with a body: its name, and its first and last line.
pub struct Function {
    pub name: String,
    pub first: usize,
    pub last: usize,
}

/// All functions of a file, those in tests and in other functions included.
pub fn functions(tokens: &[Token]) -> Vec<Function> {
    let named =
        tokens.windows(2).enumerate().filter(|(_, w)| w[0].text == "fn" && w[1].text.chars().all(is_word));
    let function = |(i, pair): (usize, &[Token])| {
        let end = item_end(tokens, i);
        let body = tokens[end].text == "}";
        body.then(|| Function { name: pair[1].text.clone(), first: pair[0].line, last: tokens[end].line })
    };
    named.filter_map(function).collect()
}

/// The last token of the item that starts at `from`: a `;` before any brace, or the brace that closes the first one.
fn item_end(tokens: &[Token], from: usize) -> usize {
    let import = tokens[from].text == "use";
    let mut depth = 0i32;
    for (i, token) in tokens.iter().enumerate().skip(from) {
        match &token.text[..] {
            "(" | "[" | "{" => depth += 1,
            ")" | "]" | "}" => depth -= 1,
            _ => {}
        }
        let closed = depth == 0 && (token.text == "}" && !import || token.text == ";");
        if closed || depth < 0 {
            return i;
        }
    }
    tokens.len() - 1
}

/// Names of nested inline modules; empty at the top of a file.
pub type Scope = Vec<String>;

/// One name that a `use` brings in.
pub struct Import {
    pub scope: Scope,
    pub path: Vec<String>,
    /// The name it has here; `*` for all names of a module.
    pub name: String,
    /// Whether others may import it from here (`pub use`, of any visibility).
    pub public: bool,
}

/// A file without what is compiled for tests alone.
#[derive(Default)]
pub struct Source {
    pub imports: Vec<Import>,
    /// Paths of two names or more in code, each with where it stands.
    pub paths: Vec<(Scope, Vec<String>)>,
    /// Names that the file defines.
    pub items: HashSet<(Scope, String)>,
    /// Modules in files of their own.
    pub children: Vec<String>,
    pub inline: HashSet<Scope>,
}

impl Source {
    pub fn read(tokens: &[Token]) -> Self {
        let mut source = Source::default();
        let mut scope: Vec<(String, i32)> = Vec::new();
        let (mut i, mut depth) = (0, 0);
        while i < tokens.len() {
            let text = |n: usize| tokens.get(i + n).map_or("", |t| &t.text[..]);
            let here = || scope.iter().map(|(name, _)| name.clone()).collect::<Scope>();
            match text(0) {
                "#" if ["[", "cfg", "(", "test", ")", "]"].iter().zip(1..).all(|(t, n)| text(n) == *t) => {
                    i = item_end(tokens, after_attributes(tokens, i)) + 1;
                    continue;
                }
                // A visibility names no use.
                "pub" if text(1) == "(" => i = end_of_bracket(tokens, i + 1),
                "{" => depth += 1,
                "}" => {
                    depth -= 1;
                    scope.retain(|(_, at)| *at <= depth);
                }
                "mod" if text(2) == ";" => source.children.push(text(1).into()),
                "mod" if text(2) == "{" => {
                    scope.push((text(1).into(), depth + 1));
                    source.inline.insert(scope.iter().map(|(name, _)| name.clone()).collect());
                }
                "use" if text(1) != "<" => {
                    let public = i > 0 && matches!(&tokens[i - 1].text[..], "pub" | ")");
                    let end = item_end(tokens, i);
                    for (path, name) in import_tree(&tokens[i + 1..end]) {
                        source.imports.push(Import { scope: here(), path, name, public });
                    }
                    i = end;
                }
                "fn" | "struct" | "enum" | "trait" | "type" | "const" | "static" | "union" => {
                    source.items.insert((here(), text(1).into()));
                }
                "macro_rules" => {
                    source.items.insert((here(), text(2).into()));
                    i = item_end(tokens, i);
                }
                first if text(1) == "::" && first.chars().all(is_word) => {
                    let path = path_at(tokens, i);
                    i += 2 * (path.len() - 1);
                    source.paths.push((here(), path));
                }
                _ => {}
            }
            i += 1;
        }
        source
    }
}

/// The token after the attributes that start at `from`.
fn after_attributes(tokens: &[Token], from: usize) -> usize {
    let mut i = from;
    while tokens[i].text == "#" {
        i = end_of_bracket(tokens, i + 1) + 1;
    }
    // A visibility is part of the item.
    while matches!(&tokens[i].text[..], "pub") {
        i += 1;
        if tokens[i].text == "(" {
            i = end_of_bracket(tokens, i) + 1;
        }
    }
    i
}

fn end_of_bracket(tokens: &[Token], from: usize) -> usize {
    let mut depth = 0;
    for (i, token) in tokens.iter().enumerate().skip(from) {
        match &token.text[..] {
            "(" | "[" => depth += 1,
            ")" | "]" => depth -= 1,
            _ => {}
        }
        if depth == 0 {
            return i;
        }
    }
    tokens.len() - 1
}

/// The path of names that starts at `from`.
fn path_at(tokens: &[Token], from: usize) -> Vec<String> {
    let mut path = vec![tokens[from].text.clone()];
    let rest = tokens[from + 1..].chunks_exact(2);
    let names = rest.take_while(|pair| pair[0].text == "::" && pair[1].text.chars().all(is_word));
    path.extend(names.map(|pair| pair[1].text.clone()));
    path
}

/// The paths of `a::{b, c as d, e::*}`, each with the name that it has here.
fn import_tree(tokens: &[Token]) -> Vec<(Vec<String>, String)> {
    let mut found = Vec::new();
    // Paths that the open braces stand after, and the path being read.
    let (mut open, mut path) = (Vec::<Vec<String>>::new(), Vec::<String>::new());
    let mut alias = None;
    let mut finish = |path: &mut Vec<String>, alias: &mut Option<String>, open: &[Vec<String>]| {
        let before = open.last().map_or(0, Vec::len);
        if path.len() > before {
            if path.last().is_some_and(|name| name == "self") && path.len() > 1 {
                path.pop();
            }
            let name = alias.take().or(path.last().cloned()).unwrap_or_default();
            found.push((path.clone(), name));
        }
        path.clear();
        path.extend(open.last().cloned().unwrap_or_default());
    };
    let mut i = 0;
    while i < tokens.len() {
        match &tokens[i].text[..] {
            "::" => {}
            "{" => open.push(path.clone()),
            "," => finish(&mut path, &mut alias, &open),
            "}" => {
                finish(&mut path, &mut alias, &open);
                open.pop();
                path.clear();
                path.extend(open.last().cloned().unwrap_or_default());
            }
            "as" => {
                alias = tokens.get(i + 1).map(|t| t.text.clone());
                i += 1;
            }
            name => path.push(name.into()),
        }
        i += 1;
    }
    finish(&mut path, &mut alias, &open);
    found
}
