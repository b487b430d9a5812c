//! A rigid motion in a file of its own.

use std::path::Path;

use super::numbers::{Keyed, beside, rows, text};
use crate::depth::Transform;
use crate::depth::io::{Values, npy};
use crate::error::{Error, Result};

const EXPECTED: &str = "a 4x4 or 3x4 matrix [R | t], row by row, t in metres";

/// Reads where a LiDAR (or another sensor) stands: the transform from its axes to those of the camera.
///
/// A text file with the 16 numbers of a 4x4 matrix or the 12 of its upper rows, between them spaces, commas or line ends, `#` before
/// comments; or with lines `R:` and `T:` of 9 and 3 numbers, as KITTI's `calib_velo_to_cam.txt`; or a `.npy` of shape (4, 4) or (3, 4).
///
/// # Errors
/// [`Error::Io`]; [`Error::Format`] for other numbers and shapes and for a last row other than 0 0 0 1; [`Error::Config`] for `R:`
/// without `T:`; [`Error::Format`] as well for a matrix that is no rigid motion.
pub fn read_extrinsic(path: impl AsRef<Path>) -> Result<Transform> {
    let path = path.as_ref();
    let is_npy = path.extension().is_some_and(|e| e.eq_ignore_ascii_case("npy"));
    let rows = if is_npy { from_npy(path)? } else { from_text(path)? };
    Transform::from_rows(rows).map_err(|e| Error::format(path, e.to_string(), EXPECTED))
}

fn from_npy(path: &Path) -> Result<[[f64; 4]; 3]> {
    let array = npy::read_npy(path)?;
    let numbers: Vec<f64> = match array.values {
        Values::Floats(values) => values.into_iter().map(f64::from).collect(),
        Values::Integers(values) => values.into_iter().map(|v| v as f64).collect(),
    };
    if array.width != 4 {
        let found = format!("shape ({}, {})", array.height, array.width);
        return Err(Error::format(path, found, EXPECTED));
    }
    upper(&numbers).map_err(|found| Error::format(path, found, EXPECTED))
}

fn from_text(path: &Path) -> Result<[[f64; 4]; 3]> {
    let text = text(path)?;
    let keyed = Keyed::parse(path, &text);
    if keyed.has("R") {
        return Ok(beside(keyed.numbers("R")?, keyed.numbers("T")?));
    }
    let lines = text.lines().map(|line| line.split('#').next().unwrap_or(""));
    let words =
        lines.flat_map(|line| line.split([' ', '\t', ',', ';', '\r'])).filter(|word| !word.is_empty());
    let number = |word: &str| word.parse::<f64>().map_err(|_| format!("{word:.20?}"));
    let numbers = words.map(number).collect::<std::result::Result<Vec<f64>, String>>();
    numbers.and_then(|numbers| upper(&numbers)).map_err(|found| Error::format(path, found, EXPECTED))
}

/// The upper rows of a matrix, or what was found instead.
fn upper(numbers: &[f64]) -> std::result::Result<[[f64; 4]; 3], String> {
    match (numbers.first_chunk::<12>(), &numbers[numbers.len().min(12)..]) {
        (Some(&first), [] | [0.0, 0.0, 0.0, 1.0]) => Ok(rows(first)),
        (Some(_), [a, b, c, d]) => Err(format!("{a} {b} {c} {d} as the last row")),
        _ => Err(format!("{} numbers", numbers.len())),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const UPPER: &str = "0 -1 0 0.1\n0 0 -1 -0.2\n1 0 0 0.3\n";

    fn read(name: &str, text: &str) -> Result<Transform> {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join(name);
        std::fs::write(&path, text).unwrap();
        read_extrinsic(path)
    }

    #[test]
    fn matrices_of_every_form() {
        let expected =
            Transform::from_rows([[0.0, -1.0, 0.0, 0.1], [0.0, 0.0, -1.0, -0.2], [1.0, 0.0, 0.0, 0.3]])
                .unwrap();
        let keyed =
            "calib_time: 15-Mar-2012 11:37:16\nR: 0 -1 0 0 0 -1 1 0 0\nT: 0.1 -0.2 0.3\ndelta_f: 0 0\n";
        for text in [
            UPPER.to_string(),
            format!("# LiDAR to camera\n{UPPER}0 0 0 1 # last\n"),
            UPPER.replace(' ', ", ").replace('\n', "\r\n"),
            keyed.to_string(),
        ] {
            assert_eq!(read("e.txt", &text).unwrap(), expected, "{text}");
        }
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("e.npy");
        let values = [0.0, -1.0, 0.0, 0.1, 0.0, 0.0, -1.0, -0.2, 1.0, 0.0, 0.0, 0.3, 0.0, 0.0, 0.0, 1.0];
        crate::depth::io::write_npy(&path, 4, 4, &values).unwrap();
        let found = read_extrinsic(&path).unwrap();
        assert_eq!(found.apply([1.0, 2.0, 3.0]), expected.apply([1.0, 2.0, 3.0]));
        crate::depth::io::write_npy(&path, 3, 4, &values[..12]).unwrap();
        assert!(read_extrinsic(&path).unwrap_err().to_string().contains("shape (4, 3)"));
    }

    #[test]
    fn what_is_no_motion_is_named() {
        for (text, named) in [
            ("", "0 numbers"),
            ("1 2 3", "3 numbers"),
            ("1 0 0 0 0 1 0 0 0 0 one 0", "\"one\""),
            (&format!("{UPPER}0 0 0 2"), "0 0 0 2 as the last row"),
            ("2 0 0 0 0 2 0 0 0 0 2 0", "rotation"),
            ("1 0 0 nan 0 1 0 0 0 0 1 0", "translation"),
            ("R: 1 0 0 0 1 0 0 0 1", "key `T` is missing"),
            ("R: 1 0 0\nT: 0 0 0", "key `R` is 3 numbers"),
        ] {
            let message = read("e.txt", text).unwrap_err().to_string();
            assert!(message.contains(named) && message.contains("e.txt"), "{message}");
        }
        assert!(matches!(read_extrinsic("none.txt"), Err(Error::Io { .. })));
    }
}
