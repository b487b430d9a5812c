//! Data sets that show a part of another: ground truth within a range, chosen frames.

use std::collections::HashMap;
use std::path::Path;

use super::dataset::{Dataset, Sample};
use super::files::lines;
use super::listing::entry;
use crate::error::{Error, Result};

/// A data set whose ground truth counts only between two depths.
pub(super) struct Ranged {
    frames: Box<dyn Dataset>,
    near: f32,
    far: f32,
}

impl Ranged {
    /// Fails with [`Error::Argument`] unless the nearer depth, metres, comes first.
    pub(super) fn new(frames: Box<dyn Dataset>, (near, far): (f32, f32)) -> Result<Self> {
        if near < far {
            return Ok(Self { frames, near, far });
        }
        Err(Error::argument("range", format!("{near} to {far} m"), "the nearer depth first"))
    }
}

impl Dataset for Ranged {
    fn len(&self) -> usize {
        self.frames.len()
    }

    fn name(&self, index: usize) -> String {
        self.frames.name(index)
    }

    fn has_measurements(&self, index: usize) -> bool {
        self.frames.has_measurements(index)
    }

    fn load(&self, index: usize) -> Result<Sample> {
        let mut sample = self.frames.load(index)?;
        for depth in &mut sample.gt {
            if !(self.near..=self.far).contains(depth) {
                *depth = f32::NAN;
            }
        }
        Ok(sample)
    }
}

/// Some frames of a data set, in an order of their own.
pub(super) struct Chosen {
    frames: Box<dyn Dataset>,
    indices: Vec<usize>,
}

impl Chosen {
    /// Those that a text file names, one per line, in its order.
    ///
    /// Fails with [`Error::Io`], and with [`Error::Format`] naming the list for a frame that the data set lacks or that is
    /// named twice, and for a list without a name.
    pub(super) fn by_list(frames: Box<dyn Dataset>, list: &Path) -> Result<Self> {
        // `None` where several frames are spelled alike; the very name of a frame goes before another spelling.
        let mut places: HashMap<String, Option<usize>> = HashMap::with_capacity(frames.len());
        for index in 0..frames.len() {
            let place = places.entry(spelling(&frames.name(index)));
            place.and_modify(|several| *several = None).or_insert(Some(index));
        }
        places.extend((0..frames.len()).map(|index| (frames.name(index), Some(index))));
        let (mut indices, mut taken) = (Vec::new(), vec![false; frames.len()]);
        for name in lines(list)? {
            let Some(&Some(index)) = places.get(&name).or_else(|| places.get(&spelling(&name))) else {
                let expected = format!("names of the data set's {} frames", frames.len());
                return Err(Error::format(list, format!("{name:?}, no such frame"), expected));
            };
            if std::mem::replace(&mut taken[index], true) {
                return Err(Error::format(list, format!("{name:?} twice"), "each frame once"));
            }
            indices.push(index);
        }
        if indices.is_empty() {
            return Err(Error::format(list, "no name", "one frame per line"));
        }
        Ok(Self { frames, indices })
    }
}

/// A name as it is compared: published lists write `SCENE/7` for the frame that is called `SCENE-7` here, and exports write its
/// number with zeros before it or without.
fn spelling(name: &str) -> String {
    let name = name.replace('/', "-");
    let (scene, number) = name.rsplit_once('-').unwrap_or(("", &name));
    match number.parse::<u64>() {
        Ok(number) => format!("{scene}-{number}"),
        Err(_) => name,
    }
}

impl Dataset for Chosen {
    fn len(&self) -> usize {
        self.indices.len()
    }

    fn name(&self, index: usize) -> String {
        self.indices.get(index).map(|&i| self.frames.name(i)).unwrap_or_default()
    }

    fn has_measurements(&self, index: usize) -> bool {
        self.indices.get(index).is_some_and(|&i| self.frames.has_measurements(i))
    }

    fn load(&self, index: usize) -> Result<Sample> {
        self.frames.load(*entry(&self.indices, index)?)
    }
}

#[cfg(test)]
mod tests {
    use super::spelling;

    #[test]
    fn lists_and_exports_spell_one_frame_alike() {
        for same in ["scene0707_00/343", "scene0707_00-343", "scene0707_00/0343", "scene0707_00-000343"] {
            assert_eq!(spelling(same), "scene0707_00-343");
        }
        assert_eq!(spelling("0012"), spelling("12"));
        // A time or a drive is no number.
        for other in ["fr1_desk-1305031453.359684", "drive_0047_sync_image_02", "corridor_01", "a-", "-"] {
            assert_eq!(spelling(other), other);
        }
    }
}
