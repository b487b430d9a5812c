//! A room under construction: where pieces are put, and that none stands in another.

use std::f32::consts::TAU;
use std::sync::Arc;

use super::library::Library;
use super::light::Light;
use super::model::Model;
use super::plan::{Plan, Spot, Wall};
use super::role::Role;
use super::shell::{Opening, Shell};
use super::style::Kind;
use crate::scenes::space::{V3, add, to_world, turned};
use crate::scenes::stage::Stage;

/// What carries a piece.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Hold {
    Floor,
    /// Flat on the floor, under the others.
    Under,
    /// On the floor, partly under another piece.
    Tucked(usize),
    /// On a board of another piece.
    On(usize),
    Wall,
    Ceiling,
    /// In an opening of a wall.
    Opening,
}

/// A model at its place.
#[derive(Clone)]
pub(super) struct Piece {
    pub model: Arc<Model>,
    pub at: V3,
    pub yaw: f32,
    pub hold: Hold,
}

impl Piece {
    pub fn spot(&self) -> Spot {
        Spot { at: self.at, yaw: self.yaw, half: self.model.half(), height: self.model.size()[1] }
    }

    /// A point of the piece's frame in the room.
    pub fn point(&self, local: V3) -> V3 {
        add(self.at, to_world(&turned(self.yaw, 0.0, 0.0), local))
    }

    /// A place in the room as seen from the piece.
    fn local(&self, p: V3) -> [f32; 2] {
        let (s, c) = self.yaw.sin_cos();
        let (x, z) = (p[0] - self.at[0], p[2] - self.at[2]);
        [c * x - s * z, s * x + c * z]
    }
}

/// A door or window: which wall, where, and whether light comes in.
#[derive(Clone, Copy, Debug)]
pub(super) struct Hole {
    pub wall: usize,
    pub opening: Opening,
    pub window: bool,
}

pub(super) struct Room<'a> {
    pub library: &'a Library,
    pub dice: Stage,
    pub kind: Kind,
    pub plan: Plan,
    pub pieces: Vec<Piece>,
    /// Boxes without a model that stand on pieces: books, parcels. With the number of the piece.
    pub small: Vec<(usize, Spot)>,
    pub shell: Shell,
    pub holes: Vec<Hole>,
    pub lights: Vec<Light>,
    /// Brightness of the sky, and whether lamps burn.
    pub day: f32,
    pub lit: bool,
}

/// Gap that is left between pieces, metres.
const GAP: f32 = 0.01;

impl Room<'_> {
    /// A model of a role, each as likely as the others.
    pub fn choose(&mut self, role: Role) -> Option<Arc<Model>> {
        self.choose_where(role, |_| true)
    }

    /// The same among those that `fits` lets count.
    pub fn choose_where(&mut self, role: Role, fits: impl Fn(&Model) -> bool) -> Option<Arc<Model>> {
        let models = &self.library.models;
        let list: Vec<usize> = self.library.of(role).iter().copied().filter(|&i| fits(&models[i])).collect();
        let last = list.len().checked_sub(1)?;
        Some(models[list[self.dice.int(0, last)]].clone())
    }

    /// Puts a piece on the floor if nothing is in its way. Returns its number.
    pub fn stand(&mut self, model: &Arc<Model>, at: V3, yaw: f32) -> Option<usize> {
        self.put(Piece { model: model.clone(), at, yaw, hold: Hold::Floor })
    }

    /// Puts a piece where it is if nothing is in its way.
    pub fn put(&mut self, piece: Piece) -> Option<usize> {
        let spot = piece.spot();
        (self.plan.fits(&spot, GAP) && self.is_off_things(&spot)).then(|| self.add(piece, spot))
    }

    /// Whether a box meets nothing that stands on a piece.
    fn is_off_things(&self, spot: &Spot) -> bool {
        let on = |p: &&Piece| matches!(p.hold, Hold::On(_));
        !self.pieces.iter().filter(on).any(|p| p.spot().meets(spot, 0.0))
            && !self.small.iter().any(|(_, s)| s.meets(spot, 0.0))
    }

    fn add(&mut self, piece: Piece, spot: Spot) -> usize {
        self.plan.taken.push(spot);
        self.pieces.push(piece);
        self.pieces.len() - 1
    }

    /// Puts a piece somewhere with its back to a wall (any, if none is given).
    pub fn along(&mut self, model: &Arc<Model>, wall: Option<usize>, tries: usize) -> Option<usize> {
        (0..tries).find_map(|_| {
            let k = wall.unwrap_or_else(|| self.dice.int(0, 3));
            let wall = self.plan.wall(k);
            let play = (wall.half - model.half()[0]).max(0.0);
            let along = self.dice.real(-1.0, 1.0) * play;
            self.at_wall(model, &wall, along, 0.0)
        })
    }

    /// Puts a piece with its back to a wall, `along` from the wall's middle, `up` from the floor.
    pub fn at_wall(&mut self, model: &Arc<Model>, wall: &Wall, along: f32, up: f32) -> Option<usize> {
        let out = model.half()[1] + 0.012 + if up == 0.0 { self.dice.real(0.0, 0.03) } else { 0.0 };
        let hold = if up == 0.0 { Hold::Floor } else { Hold::Wall };
        self.put(Piece { model: model.clone(), at: wall.point(along, up, out), yaw: wall.yaw, hold })
    }

    /// Hangs a thing on any wall at the height that its catalogue names.
    pub fn hang(&mut self, model: &Arc<Model>, up: f32) -> Option<usize> {
        let size = self.plan.size;
        let up = up.min(size[1] - model.size()[1] - 0.05).max(0.05);
        (0..6).find_map(|_| {
            let wall = self.plan.wall(self.dice.int(0, 3));
            let along = self.dice.real(-0.95, 0.95) * (wall.half - model.half()[0]).max(0.0);
            let at = wall.point(along, up, model.half()[1] + 0.002);
            self.put(Piece { model: model.clone(), at, yaw: wall.yaw, hold: Hold::Wall })
        })
    }

    /// Puts a piece anywhere on the floor, turned anyhow or along the walls.
    pub fn anywhere(&mut self, model: &Arc<Model>, square: bool, tries: usize) -> Option<usize> {
        let [w, _, l] = self.plan.size;
        (0..tries).find_map(|_| {
            let at = [self.dice.real(-0.95, 0.95) * w, 0.0, self.dice.real(-0.95, 0.95) * l];
            let yaw = if square {
                self.dice.int(0, 3) as f32 * 0.25 * TAU + self.dice.real(-0.03, 0.03)
            } else {
                self.dice.real(0.0, TAU)
            };
            self.stand(model, at, yaw)
        })
    }

    /// Puts a piece at a place of another's frame, turned against it by `turn`.
    pub fn beside(&mut self, model: &Arc<Model>, other: usize, local: [f32; 2], turn: f32) -> Option<usize> {
        let other = &self.pieces[other];
        let at = other.point([local[0], -other.at[1], local[1]]);
        let yaw = other.yaw + turn;
        self.stand(model, at, yaw)
    }

    /// Puts a seat at a side of a table: its front towards the table, `depth` of it under the top as far as nothing touches.
    ///
    /// `side` is the direction from the table's middle (quarter turns), `shift` how far along that side.
    pub fn tuck(
        &mut self,
        seat: &Arc<Model>,
        table: usize,
        side: usize,
        shift: f32,
        depth: f32,
    ) -> Option<usize> {
        let half = self.pieces[table].model.half();
        let reach = if side.is_multiple_of(2) { half[1] } else { half[0] };
        let turn = side as f32 * 0.25 * TAU;
        for part in [1.0, 0.5, 0.0] {
            let out = reach + seat.half()[1] + 0.02 - depth.max(0.0) * part - depth.min(0.0);
            let (s, c) = turn.sin_cos();
            // Along the side, and away from the table.
            let local = [shift * c + out * s, -shift * s + out * c];
            let table_piece = &self.pieces[table];
            let at = table_piece.point([local[0], 0.0, local[1]]);
            let wobble = self.dice.real(-0.15, 0.15);
            let yaw = table_piece.yaw + turn + 0.5 * TAU + wobble;
            let piece = Piece { model: seat.clone(), at, yaw, hold: Hold::Tucked(table) };
            if self.clear_of_all_but(&piece, table) {
                let spot = piece.spot();
                return Some(self.add(piece, spot));
            }
        }
        None
    }

    fn clear_of_all_but(&self, piece: &Piece, other: usize) -> bool {
        let (spot, host) = (piece.spot(), &self.pieces[other]);
        let around = host.spot();
        let others = self.plan.taken.iter().filter(|t| **t != around);
        self.plan.inside(&spot)
            && self.is_off_things(&spot)
            && !others.into_iter().any(|t| t.meets(&spot, GAP))
            && !self.plan.kept.iter().any(|k| k.meets(&spot, 0.0))
            && (!around.meets(&spot, 0.0) || !tangled(piece, host))
    }

    /// Sets a small thing on a piece: anywhere on its boards where it has room. `face` turns it to the front.
    pub fn set_on(&mut self, model: &Arc<Model>, host: usize, face: bool, tries: usize) -> Option<usize> {
        let carrier = self.pieces[host].clone();
        for _ in 0..tries {
            let (cell, pick) = (self.dice.real(0.0, 1.0), self.dice.real(0.0, 1.0));
            let turn = if face { self.dice.real(-0.3, 0.3) } else { self.dice.real(0.0, TAU) };
            let jitter = [self.dice.real(-0.02, 0.02), self.dice.real(-0.02, 0.02)];
            let (middle, boards) = carrier.model.profile().board_cell(cell)?;
            let board = boards[((pick * boards.len() as f32) as usize).min(boards.len() - 1)];
            let local = [middle[0] + jitter[0], middle[1] + jitter[1]];
            let room = model.size()[1] + 0.01;
            if board.height + carrier.at[1] > 2.1
                || !carrier.model.carries(local, model.half(), turn, board.height, room)
            {
                continue;
            }
            let at = carrier.point([local[0], board.height, local[1]]);
            let piece = Piece { model: model.clone(), at, yaw: carrier.yaw + turn, hold: Hold::On(host) };
            if self.is_free_on(host, &piece.spot()) {
                self.pieces.push(piece);
                return Some(self.pieces.len() - 1);
            }
        }
        None
    }

    /// Whether nothing that stands on a piece, or beside it, is in a small box's way.
    pub fn is_free_on(&self, host: usize, spot: &Spot) -> bool {
        let around = self.pieces[host].spot();
        let on = |p: &&Piece| p.hold == Hold::On(host);
        self.plan.inside(spot)
            && !self.pieces.iter().filter(on).any(|p| p.spot().meets(spot, 0.004))
            && !self.small.iter().any(|(h, s)| *h == host && s.meets(spot, 0.002))
            && !self.plan.taken.iter().any(|t| *t != around && t.meets(spot, 0.0))
    }
}

/// Whether two pieces whose boxes overlap touch: a seat may be under a table top.
pub(super) fn tangled(a: &Piece, b: &Piece) -> bool {
    a.model.profile().clashes(b.local(a.at), a.yaw - b.yaw, b.model.profile())
}
