//! JSON files, read key by key with messages that say where.

use crate::error::{Error, Result};
use crate::files::read_text;
use serde_json::Value;
use std::path::Path;

/// One JSON object with its place, for messages that say where.
pub(crate) struct Node<'a> {
    pub(crate) file: &'a str,
    prefix: &'a str,
    pub(crate) value: &'a Value,
}

impl<'a> Node<'a> {
    pub(crate) fn new(file: &'a str, prefix: &'a str, value: &'a Value) -> Self {
        Self { file, prefix, value }
    }

    pub(crate) fn path(&self, key: &str) -> String {
        if self.prefix.is_empty() { key.to_string() } else { format!("{}.{key}", self.prefix) }
    }

    pub(crate) fn wrong<T>(&self, key: &str, expected: &str) -> Result<T> {
        let found = self.value.get(key).map_or("missing".to_string(), Value::to_string);
        Err(Error::config(self.file, &self.path(key), found, expected))
    }

    pub(crate) fn size(&self, key: &str) -> Result<usize> {
        // The bound keeps products of a few sizes far from overflow on hostile files.
        self.size_up_to(key, 1 << 24)
    }

    /// A size with a bound of its own: one that is squared, or that counts parts to be built.
    pub(crate) fn size_up_to(&self, key: &str, most: u64) -> Result<usize> {
        match self.value.get(key).and_then(Value::as_u64) {
            Some(v) if (1..=most).contains(&v) => Ok(v as usize),
            _ => self.wrong(key, &format!("an integer of 1 to {most}")),
        }
    }

    pub(crate) fn size_up_to_or(&self, key: &str, most: u64, default: usize) -> Result<usize> {
        if self.absent(key) { Ok(default) } else { self.size_up_to(key, most) }
    }

    pub(crate) fn size_or(&self, key: &str, default: usize) -> Result<usize> {
        if self.absent(key) { Ok(default) } else { self.size(key) }
    }

    pub(crate) fn absent(&self, key: &str) -> bool {
        matches!(self.value.get(key), None | Some(Value::Null))
    }

    pub(crate) fn id(&self, key: &str) -> Result<u32> {
        match self.value.get(key).and_then(Value::as_u64).map(u32::try_from) {
            Some(Ok(v)) => Ok(v),
            _ => self.wrong(key, "a token id"),
        }
    }

    pub(crate) fn positive_or(&self, key: &str, default: f64) -> Result<f64> {
        if self.absent(key) {
            return Ok(default);
        }
        match self.value.get(key).and_then(Value::as_f64) {
            Some(v) if v.is_finite() && v > 0.0 => Ok(v),
            _ => self.wrong(key, "a positive number"),
        }
    }

    pub(crate) fn sizes(&self, key: &str) -> Result<Vec<usize>> {
        let list = self.value.get(key).and_then(Value::as_array);
        let sizes: Option<Vec<usize>> =
            list.and_then(|l| l.iter().map(|v| v.as_u64().map(|v| v as usize)).collect());
        sizes.map_or_else(|| self.wrong(key, "a list of integers"), Ok)
    }

    pub(crate) fn require(&self, key: &str, wanted: &str) -> Result<()> {
        match self.value.get(key) {
            None | Some(Value::Null) => Ok(()),
            Some(Value::String(s)) if s == wanted => Ok(()),
            _ => self.wrong(key, &format!("\"{wanted}\"")),
        }
    }
}

/// Reads a JSON file.
pub(crate) fn read_json(path: &Path) -> Result<Value> {
    parse_json(path, &read_text(path)?)
}

/// Parses JSON; `path` is for messages.
pub(crate) fn parse_json(path: &Path, bytes: &[u8]) -> Result<Value> {
    serde_json::from_slice(bytes).map_err(|e| Error::format(path, e.to_string(), "valid JSON"))
}
