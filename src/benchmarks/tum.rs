//! TUM RGB-D (Sturm et al., IROS 2012) and recordings in its format.

use std::path::{Path, PathBuf};

use super::dataset::Sample;
use super::files::{below, depth, frame_name, lines, picture, recordings};
use super::listing::{Frame, Loader};
use crate::depth::DepthScale;
use crate::error::{Error, Result};

/// Largest difference between the times of a picture and its depth, seconds: the default of the benchmark's `associate.py`.
const LARGEST_GAP: f64 = 0.02;

/// Candidates per picture in the mean, beyond which the times cannot be a camera's: 64 in 0.04 s are 1600 frames per second.
const MOST_CANDIDATES: usize = 64;

#[derive(Clone, Debug)]
pub(super) struct Files {
    rgb: PathBuf,
    gt: PathBuf,
}

/// One recording, or a folder of recordings, each with `rgb.txt` and `depth.txt`.
///
/// A line is `TIME PATH`, `#` starts a comment. Pictures and depth were taken at different times; as in the benchmark's
/// `associate.py`, pairs less than 0.02 s apart are joined, closest first, each file at most once, and what finds no partner
/// is left out. Depth is stored in 16 bits, 5000 units per metre, 0 = none, already aligned to the colour camera. Frames are
/// neither resized nor cropped and have no measurements of their own.
#[derive(Clone, Debug)]
pub struct TumDataset {
    frames: Vec<Frame<Files>>,
}

impl TumDataset {
    /// Reads the lists and joins them by time.
    ///
    /// # Errors
    /// [`Error::Io`]; [`Error::Format`] naming the list with a line that is no time and path, that leads out of the data set,
    /// or that shares no time with the other.
    pub fn open(dir: impl AsRef<Path>) -> Result<Self> {
        let mut frames = Vec::new();
        for (recording, dir) in recordings(dir.as_ref(), ["rgb.txt", "depth.txt"])? {
            let (pictures, depths) = (stamped(&dir, "rgb.txt")?, stamped(&dir, "depth.txt")?);
            let times = |files: &[(f64, PathBuf)]| files.iter().map(|f| f.0).collect::<Vec<_>>();
            let pairs = associate(&times(&pictures), &times(&depths)).ok_or_else(|| {
                let found =
                    format!("more than {MOST_CANDIDATES} times within {LARGEST_GAP} s of each in rgb.txt");
                Error::format(dir.join("depth.txt"), found, "times of single frames, in seconds")
            })?;
            if pairs.is_empty() {
                let expected = format!("a time within {LARGEST_GAP} s of one in rgb.txt");
                return Err(Error::format(dir.join("depth.txt"), "no such time", expected));
            }
            frames.extend(pairs.into_iter().map(|(i, j)| {
                let rgb = pictures[i].1.clone();
                let stem = rgb.file_stem().and_then(|s| s.to_str()).unwrap_or_default();
                Frame { name: frame_name(&recording, stem), files: Files { rgb, gt: depths[j].1.clone() } }
            }));
        }
        Ok(Self { frames })
    }
}

/// A list's times and files, in order of time.
fn stamped(dir: &Path, name: &str) -> Result<Vec<(f64, PathBuf)>> {
    let list = dir.join(name);
    let mut files = Vec::new();
    for line in lines(&list)? {
        let mut words = line.split_whitespace();
        let time = words.next().and_then(|w| w.parse::<f64>().ok()).filter(|t| t.is_finite());
        let (Some(time), Some(path)) = (time, words.next()) else {
            return Err(Error::format(&list, format!("line {line:?}"), "a time in seconds and a path"));
        };
        files.push((time, below(dir, path, &list)?));
    }
    files.sort_by(|a, b| a.0.total_cmp(&b.0));
    Ok(files)
}

/// Pairs of indices into two sorted lists of times: the closest pair first, each index once, in order of the first list.
/// `None` where so many times are equal or nearly so that the candidates would fill the memory.
fn associate(a: &[f64], b: &[f64]) -> Option<Vec<(usize, usize)>> {
    let mut near = Vec::new();
    let mut from = 0;
    for (i, &time) in a.iter().enumerate() {
        while from < b.len() && b[from] <= time - LARGEST_GAP {
            from += 1;
        }
        let within = b[from..].iter().enumerate().take_while(|(_, t)| **t < time + LARGEST_GAP);
        near.extend(within.map(|(j, t)| ((t - time).abs(), i, from + j)));
        if near.len() > MOST_CANDIDATES * (a.len() + b.len()) {
            return None;
        }
    }
    near.sort_by(|x, y| x.0.total_cmp(&y.0).then((x.1, x.2).cmp(&(y.1, y.2))));
    let (mut used_a, mut used_b) = (vec![false; a.len()], vec![false; b.len()]);
    let mut pairs = Vec::new();
    for (_, i, j) in near {
        if !used_a[i] && !used_b[j] {
            (used_a[i], used_b[j]) = (true, true);
            pairs.push((i, j));
        }
    }
    pairs.sort_unstable();
    Some(pairs)
}

impl Loader for TumDataset {
    type Files = Files;

    fn frames(&self) -> &[Frame<Files>] {
        &self.frames
    }

    fn read(&self, frame: &Frame<Files>, _: usize) -> Result<Sample> {
        let Files { rgb, gt } = &frame.files;
        let rgb = picture(rgb)?;
        let gt = depth(gt, Some(DepthScale::tum()), &rgb)?.as_slice().to_vec();
        Ok(Sample { name: frame.name.clone(), rgb, gt, sparse: None, masks: Vec::new() })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_closest_pairs_are_joined_first() {
        // 1.000 would take 1.012, but 1.010 is closer to it; 1.000 then takes 0.985.
        assert_eq!(associate(&[1.0, 1.01], &[0.985, 1.012]).unwrap(), [(0, 0), (1, 1)]);
        assert_eq!(associate(&[1.0, 2.0], &[1.03, 1.97]).unwrap(), []);
        assert_eq!(associate(&[1.0, 1.001], &[1.0]).unwrap(), [(0, 0)]);
        assert_eq!(associate(&[], &[1.0]).unwrap(), []);
    }

    #[test]
    fn equal_times_without_end_are_refused() {
        // 10^10 pairs, were they all listed.
        assert!(associate(&[1.0; 100_000], &[1.0; 100_000]).is_none());
        assert_eq!(associate(&[1.0; 3], &[1.0; 2]).unwrap(), [(0, 0), (1, 1)]);
    }

    #[test]
    fn crowded_times_agree_with_all_pairs() {
        let a: Vec<f64> = (0..60).map(|i| f64::from(i) * 0.013).collect();
        let b: Vec<f64> = (0..50).map(|i| f64::from(i) * 0.0171 + 0.001).collect();
        let mut all = Vec::new();
        for (i, x) in a.iter().enumerate() {
            let gaps = b.iter().enumerate().map(|(j, y)| ((x - y).abs(), i, j));
            all.extend(gaps.filter(|g| g.0 < LARGEST_GAP));
        }
        all.sort_by(|x, y| x.partial_cmp(y).unwrap());
        let mut expected: Vec<(usize, usize)> = Vec::new();
        for (_, i, j) in all {
            if expected.iter().all(|&(p, q)| p != i && q != j) {
                expected.push((i, j));
            }
        }
        expected.sort_unstable();
        assert_eq!(associate(&a, &b).unwrap(), expected);
    }
}
