//! Which kinds of scenes training frames show, and the scenes themselves.

use crate::error::{Error, Result};
#[cfg(feature = "meshes")]
use crate::scenes::furnished::{Library, Split, furnished};
use crate::scenes::{RgbdFrame, glazed, procedural, street};
use std::str::FromStr;

/// Shares of the recipes of scenes; only their ratios count.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SceneMix {
    /// Scenes of solids, indoors and outdoors ([`procedural`]).
    #[serde(default)]
    pub procedural: f32,
    /// Rooms of a library's models (`scenes::furnished`, feature `meshes`).
    #[serde(default)]
    pub furnished: f32,
    /// Streets from a car ([`street`]).
    #[serde(default)]
    pub streets: f32,
    /// Rooms, halls and yards behind panes that a sensor sees through ([`glazed`]).
    #[serde(default, skip_serializing_if = "is_zero")]
    pub glazed: f32,
}

/// Of a share: files of mixes without it stay as they were.
fn is_zero(share: &f32) -> bool {
    *share == 0.0
}

impl Default for SceneMix {
    /// Procedural scenes alone.
    fn default() -> Self {
        Self { procedural: 1.0, furnished: 0.0, streets: 0.0, glazed: 0.0 }
    }
}

impl FromStr for SceneMix {
    type Err = Error;

    /// `NAME=SHARE` with commas between: `procedural=0.5,furnished=0.35,streets=0.15`. What is not named has no share.
    fn from_str(text: &str) -> Result<Self> {
        let wrong = || {
            let expected = "NAME=SHARE,...; names: procedural, furnished, streets, glazed, each once";
            Error::argument("mix", text, expected)
        };
        let mut shares: [Option<f32>; 4] = [None; 4];
        for part in text.split(',') {
            let (name, share) = part.split_once('=').ok_or_else(wrong)?;
            let at = match name.trim() {
                "procedural" => 0,
                "furnished" => 1,
                "streets" => 2,
                "glazed" => 3,
                _ => return Err(wrong()),
            };
            let share = share.trim().parse().map_err(|_| wrong())?;
            if shares[at].replace(share).is_some() {
                return Err(wrong());
            }
        }
        let [procedural, furnished, streets, glazed] = shares.map(|s| s.unwrap_or(0.0));
        let mix = Self { procedural, furnished, streets, glazed };
        mix.check()?;
        Ok(mix)
    }
}

impl std::fmt::Display for SceneMix {
    /// As it is read, without those that have no share.
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let some = self.shares().into_iter().filter(|(share, _)| *share > 0.0);
        let text: Vec<String> = some.map(|(share, recipe)| format!("{}={share}", recipe.name())).collect();
        f.write_str(&text.join(","))
    }
}

/// One kind of scene.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Recipe {
    Procedural,
    Furnished,
    Streets,
    Glazed,
}

impl Recipe {
    fn name(self) -> &'static str {
        match self {
            Self::Procedural => "procedural",
            Self::Furnished => "furnished",
            Self::Streets => "streets",
            Self::Glazed => "glazed",
        }
    }
}

impl SceneMix {
    /// Checks the shares.
    ///
    /// # Errors
    /// [`Error::Argument`] for a share below 0 or not finite, and when all are 0.
    pub fn check(&self) -> Result<()> {
        let shares = self.shares().map(|(share, _)| share);
        let sum: f32 = shares.iter().sum();
        if shares.iter().all(|s| *s >= 0.0) && sum > 0.0 && sum.is_finite() {
            return Ok(());
        }
        Err(Error::argument("mix", format!("{self:?}"), "shares of at least 0, one of them above it"))
    }

    /// Each recipe with its share.
    fn shares(&self) -> [(f32, Recipe); 4] {
        [
            (self.procedural, Recipe::Procedural),
            (self.furnished, Recipe::Furnished),
            (self.streets, Recipe::Streets),
            (self.glazed, Recipe::Glazed),
        ]
    }

    /// The recipe at a place between 0 and 1.
    fn pick(&self, at: f32) -> Recipe {
        let shares = self.shares();
        let left = at * shares.iter().map(|(share, _)| share).sum::<f32>();
        let (mut below, mut last) = (0.0, Recipe::Procedural);
        for (share, recipe) in shares.into_iter().filter(|(share, _)| *share > 0.0) {
            below += share;
            last = recipe;
            if left < below {
                break;
            }
        }
        last
    }
}

/// Where frames come from: a mix, and the furniture that it may need.
#[derive(Debug, Clone)]
pub struct Scenes {
    mix: SceneMix,
    #[cfg(feature = "meshes")]
    library: Option<Library>,
}

impl Scenes {
    /// Scenes of a mix without furniture.
    pub fn new(mix: SceneMix) -> Self {
        Self {
            mix,
            #[cfg(feature = "meshes")]
            library: None,
        }
    }

    /// The same with the models of a library: of [`Split::Train`] for training, of [`Split::HeldOut`] for scoring.
    ///
    /// # Errors
    /// [`Error::Argument`] when the library has no model of that part.
    #[cfg(feature = "meshes")]
    pub fn with_library(mut self, library: &Library, held_out: bool) -> Result<Self> {
        let split = if held_out { Split::HeldOut } else { Split::Train };
        self.library = Some(library.part(split)?);
        Ok(self)
    }

    /// The shares of the recipes.
    pub fn mix(&self) -> SceneMix {
        self.mix
    }

    /// Checks that scenes of this mix can be made, for training or for scoring.
    ///
    /// # Errors
    /// [`Error::Argument`] on a share, and for furnished rooms without a library or with the other part's models.
    pub fn check(&self, held_out: bool) -> Result<()> {
        self.mix.check()?;
        if self.mix.furnished == 0.0 {
            return Ok(());
        }
        #[cfg(feature = "meshes")]
        match &self.library {
            None => Err(no_library()),
            Some(library) if (library.split() == Split::HeldOut) != held_out => {
                let expected = if held_out { "models that are held out" } else { "models to train on" };
                Err(Error::argument("library", format!("{:?}", library.split()), expected))
            }
            Some(_) => Ok(()),
        }
        #[cfg(not(feature = "meshes"))]
        {
            let _ = held_out;
            Err(no_library())
        }
    }

    /// The scene of a seed; `place` between 0 and 1 chooses its recipe.
    pub(super) fn render(&self, seed: u64, place: f32, (width, height): (usize, usize)) -> Result<RgbdFrame> {
        match self.mix.pick(place) {
            Recipe::Procedural => procedural(seed, width, height),
            Recipe::Streets => street(seed, width, height),
            Recipe::Glazed => glazed(seed, width, height),
            #[cfg(feature = "meshes")]
            Recipe::Furnished => {
                furnished(self.library.as_ref().ok_or_else(no_library)?, seed, width, height)
            }
            #[cfg(not(feature = "meshes"))]
            Recipe::Furnished => Err(no_library()),
        }
    }
}

fn no_library() -> Error {
    let found =
        if cfg!(feature = "meshes") { "furnished rooms without furniture" } else { "no feature `meshes`" };
    Error::argument("library", found, "a folder of models for the furnished part of the mix")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_and_shares_are_read() {
        let mix: SceneMix = "procedural=0.5,furnished=0.35,streets=0.15".parse().unwrap();
        assert_eq!(mix, SceneMix { procedural: 0.5, furnished: 0.35, streets: 0.15, glazed: 0.0 });
        let counted = |recipe| (0..1000).filter(|&i| mix.pick(i as f32 / 1000.0) == recipe).count();
        assert!((498..=502).contains(&counted(Recipe::Procedural)));
        assert!((348..=352).contains(&counted(Recipe::Furnished)));
        assert_eq!(mix.to_string(), "procedural=0.5,furnished=0.35,streets=0.15");
        assert_eq!("procedural=2".parse::<SceneMix>().unwrap().pick(1.0), Recipe::Procedural);
        let mix: SceneMix = "glazed=0.3,procedural=0.7".parse().unwrap();
        assert_eq!(mix.to_string(), "procedural=0.7,glazed=0.3");
        assert_eq!((mix.pick(0.69), mix.pick(0.71)), (Recipe::Procedural, Recipe::Glazed));
        let frame = Scenes::new(mix).render(1, 0.9, (64, 48)).unwrap();
        assert!(frame.glass.is_some() && Scenes::new(mix).render(1, 0.1, (64, 48)).unwrap().glass.is_none());
        for wrong in [
            "",
            "rooms=1",
            "procedural",
            "procedural=x",
            "streets=1,streets=1",
            "procedural=0",
            "streets=-1",
            "streets=NaN",
            "glazed=-1",
            "glazed=1,glazed=1",
        ] {
            let found = wrong.parse::<SceneMix>();
            assert!(matches!(found, Err(Error::Argument { name: "mix", .. })), "{wrong}: {found:?}");
        }
    }

    #[test]
    fn files_of_mixes_without_glass_are_as_they_were() {
        let text = |mix: SceneMix| serde_json::to_string(&mix).unwrap();
        assert_eq!(text(SceneMix::default()), r#"{"procedural":1.0,"furnished":0.0,"streets":0.0}"#);
        for mix in [SceneMix::default(), SceneMix { glazed: 0.25, ..SceneMix::default() }] {
            assert_eq!(serde_json::from_str::<SceneMix>(&text(mix)).unwrap(), mix);
        }
    }

    #[test]
    fn furnished_rooms_need_furniture() {
        let scenes = Scenes::new("furnished=1".parse().unwrap());
        for found in [scenes.check(false), scenes.render(1, 0.5, (64, 48)).map(|_| ())] {
            assert!(matches!(found, Err(Error::Argument { name: "library", .. })), "{found:?}");
        }
        assert!(Scenes::new(SceneMix::default()).check(false).is_ok());
    }
}
