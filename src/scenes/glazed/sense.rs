//! What a depth sensor sees of panes.

use super::glazing::{Crossing, Glazing};
use super::look::{dirt, frost};
use crate::depth::sampling::noise::{floor, hash01, noise};

/// What a ray of a sensor gives at a pane.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Sensed {
    /// It goes on.
    Behind,
    /// The pane returns it.
    Pane,
    /// It goes astray.
    Mirrored,
    /// It is lost.
    Nothing,
}

/// Dirt that covers more than this returns.
const DIRTY: f32 = 0.3;

/// What the sensor sees of the pane at this crossing; `pixel` gives each ray a lot of its own.
pub(super) fn sense(glazing: &Glazing, at: &Crossing, (x, y): (usize, usize)) -> Sensed {
    let s = &glazing.sensing;
    if frost(glazing, at) > 0.0 || dirt(glazing, at) > DIRTY || at.cos > s.glint {
        return Sensed::Pane;
    }
    // Mostly patches that keep together, with ragged borders.
    let own = hash01(x as i32, y as i32, s.seed);
    let lot = if hash01(x as i32, y as i32, s.seed ^ 1) < 0.6 {
        let wind = noise(at.u / s.patch, at.v / s.patch, s.seed ^ 2) + 0.3 * own;
        hash01(floor(at.u / s.patch + wind), floor(at.v / s.patch + wind), s.seed ^ 3)
    } else {
        own
    };
    if lot < s.pane {
        Sensed::Pane
    } else if lot < s.pane + s.nothing {
        Sensed::Nothing
    } else if lot < s.pane + s.nothing + s.mirrored {
        Sensed::Mirrored
    } else {
        Sensed::Behind
    }
}
