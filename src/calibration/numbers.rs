//! Lines of `key: numbers`, as KITTI's calibrations have them, and rows of numbers without keys.

use std::path::Path;

use crate::error::{Error, Result};
use crate::files::read_within;

/// Bytes of a calibration, at most.
const LARGEST: u64 = 1 << 20;

/// A small file of text.
pub(super) fn text(path: &Path) -> Result<String> {
    let bytes = read_within(path, LARGEST)?;
    String::from_utf8(bytes).map_err(|_| Error::format(path, "no UTF-8 text", "a calibration as text"))
}

/// Text behind each key, in the order of the file.
pub(super) struct Keyed<'a> {
    file: String,
    lines: Vec<(&'a str, &'a str)>,
}

impl<'a> Keyed<'a> {
    /// Lines without a colon are left out.
    pub(super) fn parse(path: &Path, text: &'a str) -> Self {
        let lines = text.lines().filter_map(|line| line.split_once(':'));
        let lines = lines.map(|(key, rest)| (key.trim(), rest.trim())).collect();
        Self { file: path.display().to_string(), lines }
    }

    pub(super) fn has(&self, key: &str) -> bool {
        self.lines.iter().any(|(k, _)| *k == key)
    }

    /// Names of all keys.
    pub(super) fn keys(&self) -> Vec<&'a str> {
        self.lines.iter().map(|(key, _)| *key).collect()
    }

    /// The `N` numbers behind a key.
    pub(super) fn numbers<const N: usize>(&self, key: &str) -> Result<[f64; N]> {
        let expected = || format!("{N} finite numbers");
        let found = self.lines.iter().find(|(k, _)| *k == key).map(|(_, text)| *text);
        let text = found.ok_or_else(|| Error::config(&self.file, key, "missing", expected()))?;
        fixed(text.split_whitespace()).map_err(|found| Error::config(&self.file, key, found, expected()))
    }
}

/// Exactly `N` finite numbers, or what was found instead.
pub(super) fn fixed<'a, const N: usize>(
    words: impl Iterator<Item = &'a str>,
) -> std::result::Result<[f64; N], String> {
    let number = |word: &str| word.parse().ok().filter(|n: &f64| n.is_finite()).ok_or(format!("{word:.20?}"));
    let numbers = words.map(number).collect::<std::result::Result<Vec<f64>, String>>()?;
    numbers.try_into().map_err(|other: Vec<f64>| format!("{} numbers", other.len()))
}

/// The rows of a 3x4 matrix.
pub(super) fn rows([a, b, c, d, e, f, g, h, i, j, k, l]: [f64; 12]) -> [[f64; 4]; 3] {
    [[a, b, c, d], [e, f, g, h], [i, j, k, l]]
}

/// Rows `[R | t]`.
pub(super) fn beside([a, b, c, d, e, f, g, h, i]: [f64; 9], [x, y, z]: [f64; 3]) -> [[f64; 4]; 3] {
    [[a, b, c, x], [d, e, f, y], [g, h, i, z]]
}
