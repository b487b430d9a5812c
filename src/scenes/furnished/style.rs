//! Colours and materials that go together. All colours are linear.

use super::look::{Look, linear};
use super::model::{Cover, Model};
use super::role::Role;
use crate::scenes::space::{V3, mix, mul};
use crate::scenes::stage::Stage;
use crate::scenes::texture::{Material, Pattern};

/// What a room is for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Kind {
    Living,
    Bedroom,
    Kitchen,
    Bathroom,
    Office,
    Workshop,
}

/// Planks: face and grain.
const WOODS: [[V3; 2]; 7] = [
    [[0.50, 0.34, 0.19], [0.40, 0.26, 0.14]],
    [[0.60, 0.46, 0.30], [0.52, 0.38, 0.24]],
    [[0.22, 0.13, 0.08], [0.15, 0.09, 0.055]],
    [[0.40, 0.36, 0.31], [0.32, 0.29, 0.25]],
    [[0.40, 0.21, 0.11], [0.32, 0.15, 0.08]],
    [[0.64, 0.59, 0.51], [0.56, 0.51, 0.44]],
    [[0.33, 0.21, 0.12], [0.26, 0.16, 0.09]],
];

/// Tiles and what is between them.
const TILES: [[V3; 2]; 7] = [
    [[0.70, 0.70, 0.68], [0.48, 0.48, 0.47]],
    [[0.58, 0.51, 0.41], [0.42, 0.38, 0.32]],
    [[0.42, 0.20, 0.12], [0.36, 0.30, 0.25]],
    [[0.12, 0.13, 0.14], [0.22, 0.22, 0.22]],
    [[0.38, 0.38, 0.37], [0.28, 0.28, 0.28]],
    [[0.62, 0.60, 0.55], [0.50, 0.48, 0.45]],
    [[0.30, 0.36, 0.38], [0.45, 0.46, 0.46]],
];

const CARPETS: [V3; 7] = [
    [0.32, 0.31, 0.30],
    [0.48, 0.42, 0.34],
    [0.16, 0.18, 0.22],
    [0.22, 0.21, 0.16],
    [0.24, 0.09, 0.08],
    [0.12, 0.12, 0.13],
    [0.36, 0.30, 0.26],
];

/// Painted walls: most are nearly white.
const WALLS: [V3; 14] = [
    [0.78, 0.77, 0.74],
    [0.80, 0.80, 0.80],
    [0.74, 0.70, 0.62],
    [0.70, 0.67, 0.62],
    [0.62, 0.62, 0.61],
    [0.76, 0.72, 0.66],
    [0.70, 0.64, 0.52],
    [0.55, 0.60, 0.55],
    [0.52, 0.58, 0.63],
    [0.66, 0.56, 0.52],
    [0.46, 0.46, 0.45],
    [0.60, 0.64, 0.60],
    [0.72, 0.66, 0.58],
    [0.57, 0.50, 0.42],
];

/// For one wall beside lighter ones.
const ACCENTS: [V3; 8] = [
    [0.16, 0.20, 0.24],
    [0.12, 0.18, 0.14],
    [0.30, 0.12, 0.09],
    [0.38, 0.28, 0.12],
    [0.20, 0.18, 0.17],
    [0.30, 0.34, 0.36],
    [0.36, 0.22, 0.20],
    [0.08, 0.12, 0.22],
];

/// Cloth of seats and beds.
const CLOTHS: [V3; 14] = [
    [0.42, 0.40, 0.37],
    [0.18, 0.18, 0.19],
    [0.56, 0.50, 0.42],
    [0.10, 0.14, 0.22],
    [0.20, 0.24, 0.18],
    [0.34, 0.12, 0.10],
    [0.48, 0.33, 0.14],
    [0.26, 0.30, 0.34],
    [0.66, 0.63, 0.58],
    [0.06, 0.06, 0.07],
    [0.28, 0.18, 0.12],
    [0.40, 0.28, 0.26],
    [0.12, 0.24, 0.24],
    [0.46, 0.44, 0.46],
];

/// Lacquer of furniture.
const LACQUERS: [V3; 9] = [
    [0.78, 0.78, 0.76],
    [0.70, 0.68, 0.62],
    [0.05, 0.05, 0.055],
    [0.30, 0.30, 0.30],
    [0.42, 0.48, 0.46],
    [0.16, 0.22, 0.28],
    [0.48, 0.14, 0.10],
    [0.55, 0.52, 0.46],
    [0.60, 0.46, 0.20],
];

/// A pattern with its colours; `gloss` is the strength of highlights.
fn material(dice: &mut Stage, pattern: Pattern, colours: [V3; 2], period: f32, gloss: f32) -> Material {
    Material {
        pattern,
        base: colours[0],
        second: colours[1],
        period,
        grain: 0.0,
        grain_period: 1.0,
        gloss,
        glow: 0.0,
        seed: dice.int(0, u32::MAX as usize) as u32,
    }
}

/// One colour with faint clouds.
pub(super) fn plain(dice: &mut Stage, colour: V3) -> Material {
    let mut m = material(dice, Pattern::Plain, [colour; 2], 0.3, 0.0);
    m.grain = dice.real(0.01, 0.05);
    m.grain_period = dice.log(0.05, 0.8);
    m
}

/// Lighter or darker as one batch of paint is from another.
fn shade(dice: &mut Stage, colour: V3) -> V3 {
    mul(colour, dice.real(0.85, 1.08))
}

pub(super) fn wood(dice: &mut Stage, plank: f32) -> Material {
    let [a, b] = dice.pick(&WOODS);
    let s = dice.real(0.85, 1.1);
    let gloss = dice.real(0.0, 0.12);
    material(dice, Pattern::Wood, [mul(a, s), mul(b, s)], 0.5 * plank, gloss)
}

/// What the sides of a room are made of.
pub(super) struct Style {
    pub floor: Material,
    pub walls: [Material; 4],
    pub ceiling: Material,
    pub trim: Material,
}

impl Style {
    pub fn new(dice: &mut Stage, kind: Kind) -> Self {
        let white = dice.real(0.68, 0.82);
        let ceiling = if matches!(kind, Kind::Office | Kind::Workshop) && dice.chance(0.6) {
            let grid = mul([0.75; 3], 0.75);
            material(dice, Pattern::Tile, [[white; 3], grid], 0.6, 0.0)
        } else {
            plain(dice, [white, white, 0.98 * white])
        };
        let trim = if dice.chance(0.7) {
            let v = dice.real(0.6, 0.8);
            plain(dice, [v; 3])
        } else {
            wood(dice, 0.1)
        };
        Self { floor: floor(dice, kind), walls: walls(dice, kind), ceiling, trim }
    }
}

fn floor(dice: &mut Stage, kind: Kind) -> Material {
    let choice = match kind {
        Kind::Living => dice.pick(&[0, 0, 0, 0, 1, 2]),
        Kind::Bedroom => dice.pick(&[0, 0, 0, 2, 2]),
        Kind::Kitchen => dice.pick(&[0, 0, 1, 1, 1, 4]),
        Kind::Bathroom => dice.pick(&[1, 1, 1, 5]),
        Kind::Office => dice.pick(&[0, 2, 2, 2, 3]),
        Kind::Workshop => dice.pick(&[3, 3, 3, 1]),
    };
    match choice {
        0 => {
            let plank = dice.real(0.08, 0.2);
            wood(dice, plank)
        }
        1 | 5 => {
            let tile = dice.pick(&TILES);
            let period = if choice == 5 { dice.real(0.05, 0.12) } else { dice.real(0.2, 0.6) };
            let gloss = dice.real(0.0, 0.25);
            material(dice, Pattern::Tile, tile, period, gloss)
        }
        2 => {
            let base = dice.pick(&CARPETS);
            let base = shade(dice, base);
            let mut m = material(dice, Pattern::Cloud, [base, mul(base, 0.8)], 0.06, 0.0);
            m.grain = 0.12;
            m.grain_period = 0.012;
            m
        }
        3 => {
            let v = dice.real(0.25, 0.5);
            let warm = dice.real(0.9, 1.0);
            let base = [v, v * 0.5 * (1.0 + warm), v * warm];
            let gloss = dice.real(0.0, 0.15);
            material(dice, Pattern::Cloud, [base, mul(base, 0.8)], 1.2, gloss)
        }
        _ => {
            let base = dice.pick(&CARPETS);
            let pale = mix(base, [0.6; 3], 0.5);
            material(dice, Pattern::Speckle, [pale, mul(pale, 0.7)], 0.015, 0.1)
        }
    }
}

fn walls(dice: &mut Stage, kind: Kind) -> [Material; 4] {
    let colour = dice.pick(&WALLS);
    let colour = shade(dice, colour);
    if kind == Kind::Bathroom && dice.chance(0.7) {
        let tile = dice.pick(&[TILES[0], TILES[0], TILES[1], TILES[4], TILES[5], TILES[6]]);
        let period = dice.real(0.1, 0.3);
        let all = material(dice, Pattern::Tile, tile, period, 0.2);
        return [all; 4];
    }
    if kind == Kind::Workshop && dice.chance(0.35) {
        let base = shade(dice, [0.34, 0.16, 0.11]);
        let base = if dice.chance(0.5) { base } else { [0.5, 0.5, 0.48] };
        return [material(dice, Pattern::Brick, [base, mix(base, [0.5; 3], 0.5)], 0.24, 0.0); 4];
    }
    let base = plain(dice, colour);
    let mut all = [base; 4];
    let one = dice.int(0, 3);
    match dice.int(0, 19) {
        0..=4 => {
            let accent = dice.pick(&ACCENTS);
            let accent = shade(dice, accent);
            all[one] = plain(dice, accent);
        }
        5 => {
            let base = shade(dice, [0.34, 0.17, 0.12]);
            all[one] = material(dice, Pattern::Brick, [base, [0.45, 0.43, 0.40]], 0.22, 0.0);
        }
        6 | 7 => {
            let stripe = mul(colour, dice.real(0.8, 0.93));
            let period = dice.real(0.05, 0.15);
            all = [material(dice, Pattern::Stripe, [colour, stripe], period, 0.0); 4];
        }
        8 => {
            let period = dice.real(0.1, 0.18);
            let planks = wood(dice, period);
            all[one] = planks;
        }
        _ => {}
    }
    all
}

/// The looks of a model in one room: its own, with wood, cloth or lacquer where it has no textures.
pub(super) fn looks(dice: &mut Stage, model: &Model) -> Vec<Look> {
    let main = model.main_cover();
    let change = dice.chance(0.55);
    let covers = model.covers.iter().enumerate();
    covers.map(|(i, cover)| cover_look(dice, model.role, cover, change && Some(i) == main)).collect()
}

fn cover_look(dice: &mut Stage, role: Role, cover: &Cover, change: bool) -> Look {
    let look = Look::of(cover);
    if look.is_pictured() || cover.is_clear() || cover.glow > 0.0 {
        return look;
    }
    let soft = matches!(role, Role::Sofa | Role::Armchair | Role::Bed | Role::Curtain | Role::Bench);
    let wooden = matches!(
        role,
        Role::Chair
            | Role::Stool
            | Role::DiningTable
            | Role::CoffeeTable
            | Role::Desk
            | Role::Bedside
            | Role::Wardrobe
            | Role::Bookcase
            | Role::Chest
            | Role::Door
            | Role::BaseUnit
            | Role::WallUnit
    );
    let own = cover.colour.map(|v| linear(v).clamp(0.02, 0.8));
    let brown = own[0] > 1.25 * own[2] && own[0] >= own[1] && own[1] >= own[2] && own[0] > 0.03;
    match () {
        () if soft && change => {
            let cloth = dice.pick(&CLOTHS);
            let cloth = shade(dice, cloth);
            look.with_pattern(fabric(dice, cloth))
        }
        () if soft => look.with_pattern(fabric(dice, own)),
        () if wooden && change && dice.chance(0.6) => {
            let grain = dice.real(0.05, 0.12);
            look.with_pattern(wood(dice, grain))
        }
        () if wooden && change => {
            let lacquer = dice.pick(&LACQUERS);
            look.with_pattern(plain(dice, lacquer))
        }
        () if wooden && brown => {
            let grain = dice.real(0.05, 0.12);
            let mut m = wood(dice, grain);
            (m.base, m.second) = (own, mul(own, 0.75));
            look.with_pattern(m)
        }
        () => look.with_pattern(plain(dice, own)),
    }
}

fn fabric(dice: &mut Stage, colour: V3) -> Material {
    let mut m = material(dice, Pattern::Cloud, [colour, mul(colour, 0.82)], 0.12, 0.0);
    m.grain = 0.1;
    m.grain_period = dice.real(0.008, 0.02);
    m
}
