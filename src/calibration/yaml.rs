//! As much of YAML as calibrations are written in.
//!
//! That is: mappings by indentation, plain or quoted words, lists in brackets (over several lines, too) or with dashes, comments, and the
//! header and tags of OpenCV. A whole YAML parser would bring anchors, aliases and types, none of which a calibration has, and the
//! best-known crate is no longer kept up; what is not in this list ends in a value that the reader of the key refuses.

/// Values by their path of keys, such as `camera_matrix.data`.
pub(super) struct Yaml {
    values: Vec<(String, Value)>,
}

#[derive(Debug, Clone, PartialEq)]
pub(super) enum Value {
    Word(String),
    List(Vec<String>),
}

impl Yaml {
    /// The first document of a text; says in which line something else stands.
    pub(super) fn parse(text: &str) -> Result<Self, String> {
        let mut values = Vec::new();
        // Keys that are open, with their indentation.
        let mut open: Vec<(usize, String)> = Vec::new();
        let mut lines = text.lines().enumerate();
        while let Some((number, line)) = lines.next() {
            let line = without_comment(line);
            let body = line.trim();
            if body.is_empty() || body.starts_with('%') {
                continue;
            }
            if matches!(body, "---" | "...") {
                if values.is_empty() && open.is_empty() {
                    continue;
                }
                break;
            }
            let indent = line.len() - line.trim_start().len();
            let wrong = || format!("the line {body:.40?} (line {})", number + 1);
            if let Some(item) = body.strip_prefix('-').filter(|rest| rest.is_empty() || rest.starts_with(' '))
            {
                open.retain(|(at, _)| *at <= indent);
                push(&mut values, path(&open).ok_or_else(wrong)?, unquoted(item.trim()));
                continue;
            }
            open.retain(|(at, _)| *at < indent);
            let (key, value) = body.split_once(':').ok_or_else(wrong)?;
            if !(value.is_empty() || value.starts_with([' ', '\t'])) {
                return Err(wrong());
            }
            open.push((indent, unquoted(key.trim())));
            let value = value.trim();
            let name = path(&open).ok_or_else(wrong)?;
            if value.starts_with('[') {
                let (mut list, mut closed) = (value.to_string(), value.contains(']'));
                while !closed {
                    let (_, more) = lines.next().ok_or_else(|| format!("no `]` behind {name:.40}"))?;
                    list.push(' ');
                    let more = without_comment(more).trim();
                    closed = more.contains(']');
                    list.push_str(more);
                }
                let inner = list.strip_prefix('[').and_then(|l| l.strip_suffix(']')).ok_or_else(wrong)?;
                let items = inner.split(',').map(|item| unquoted(item.trim())).collect::<Vec<_>>();
                let items = if inner.trim().is_empty() { Vec::new() } else { items };
                values.push((name, Value::List(items)));
            } else if !(value.is_empty() || value.starts_with("!!")) {
                values.push((name, Value::Word(unquoted(value))));
            }
        }
        Ok(Self { values })
    }

    /// The value of a path; the first, should there be two.
    pub(super) fn get(&self, path: &str) -> Option<&Value> {
        self.values.iter().find(|(name, _)| name == path).map(|(_, value)| value)
    }
}

fn path(open: &[(usize, String)]) -> Option<String> {
    let keys: Vec<&str> = open.iter().map(|(_, key)| key.as_str()).collect();
    (!keys.is_empty()).then(|| keys.join("."))
}

/// Adds an item to the list that was begun last, or begins one.
fn push(values: &mut Vec<(String, Value)>, name: String, item: String) {
    match values.last_mut() {
        Some((last, Value::List(items))) if *last == name => items.push(item),
        _ => values.push((name, Value::List(vec![item]))),
    }
}

/// A comment begins at a `#` at the line's start or behind a space.
fn without_comment(line: &str) -> &str {
    let starts = |(at, _): &(usize, &str)| *at == 0 || line[..*at].ends_with([' ', '\t']);
    let end = line.match_indices('#').find(starts).map_or(line.len(), |(at, _)| at);
    &line[..end]
}

fn unquoted(text: &str) -> String {
    let inside = |quote: char| text.strip_prefix(quote).and_then(|t| t.strip_suffix(quote));
    inside('"').or_else(|| inside('\'')).unwrap_or(text).to_string()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn list(items: &[&str]) -> Option<Value> {
        Some(Value::List(items.iter().map(|i| i.to_string()).collect()))
    }

    fn word(text: &str) -> Option<Value> {
        Some(Value::Word(text.to_string()))
    }

    #[test]
    fn every_form_that_calibrations_have() {
        let text = "%YAML:1.0\n---\n# made by hand\nimage_width: 640 # pixels\ncamera_name: \"a # b\"\nmatrix: !!opencv-matrix\n  \
                    rows: 3\n  data: [1.0, 2,\n    3e-1]\nempty: []\nd:\n- 0.1\n- -0.2\nk:\n  - 1\n  - 2\nnested:\n  a:\n    \
                    b: x\n  c: 'y'\nlast: z\n---\nlast: other\n";
        let yaml = Yaml::parse(text).unwrap();
        for (path, expected) in [
            ("image_width", word("640")),
            ("matrix.rows", word("3")),
            ("matrix.data", list(&["1.0", "2", "3e-1"])),
            ("empty", list(&[])),
            ("d", list(&["0.1", "-0.2"])),
            ("k", list(&["1", "2"])),
            ("nested.a.b", word("x")),
            ("nested.c", word("y")),
            ("last", word("z")),
            ("matrix", None),
            ("none", None),
        ] {
            assert_eq!(yaml.get(path).cloned(), expected, "{path}");
        }
    }

    #[test]
    fn other_text_is_named_by_its_line() {
        for (text, named) in [
            ("a: 1\nwhat is this\n", "(line 2)"),
            ("- 1\n", "(line 1)"),
            ("a:1\n", "(line 1)"),
            ("a: [1, 2", "no `]` behind a"),
            ("a: [1, 2] 3", "(line 1)"),
        ] {
            let message = Yaml::parse(text).err().unwrap();
            assert!(message.contains(named), "{text:?}: {message}");
        }
    }
}
