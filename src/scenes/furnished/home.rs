//! Living rooms and bedrooms.

use std::f32::consts::{FRAC_PI_2, PI};

use super::role::Role;
use super::room::{Hold, Piece, Room};

impl Room<'_> {
    pub fn living(&mut self) {
        self.sofa_group();
        if self.dice.chance(0.6) {
            self.dining();
        }
        if self.dice.chance(0.25) {
            self.place_along(Role::Leisure, 1);
        }
        let cases = self.dice.int(0, 3);
        self.cases(cases, &[Role::Ornament, Role::SmallPlant, Role::DeskThing, Role::Toy]);
        for _ in 0..self.dice.int(0, 3) {
            self.chest(&[Role::Ornament, Role::SmallPlant, Role::TableLamp, Role::DeskThing]);
        }
        let toys = self.dice.pick(&[0, 0, 0, 2, 5]);
        self.litter(&[Role::Toy, Role::Clothes], toys);
        let seats = self.dice.int(0, 2);
        for _ in 0..seats {
            let role = self.dice.pick(&[Role::Armchair, Role::Bench, Role::Stool]);
            self.place_along(role, 1);
        }
    }

    /// A sofa at a wall or in the room, a table before it, a television opposite, seats at its sides.
    fn sofa_group(&mut self) {
        let Some(sofa) = self.choose(Role::Sofa) else { return };
        let [w, _, l] = self.plan.size;
        let placed =
            if self.dice.chance(0.75) { self.along(&sofa, None, 12) } else { self.anywhere(&sofa, true, 12) };
        let Some(at) = placed else { return };
        let depth = sofa.half()[1];
        let gap = self.dice.real(0.3, 0.5);
        if let Some(rug) =
            self.choose_where(Role::Rug, |m| m.half()[0] > 0.5).filter(|_| self.dice.chance(0.6))
        {
            let p = self.pieces[at].point([0.0, 0.0, depth + gap + 0.4]);
            let yaw = self.pieces[at].yaw;
            self.spread(&rug, p, yaw);
        }
        if let Some(table) = self.choose(Role::CoffeeTable) {
            let local = [self.dice.real(-0.2, 0.2), depth + gap + table.half()[1]];
            let turn = self.dice.real(-0.08, 0.08);
            if let Some(table) = self.beside(&table, at, local, turn) {
                let n = self.dice.int(1, 6);
                self.dress(
                    table,
                    &[
                        Role::DeskThing,
                        Role::SmallPlant,
                        Role::KitchenThing,
                        Role::Ornament,
                        Role::KitchenThing,
                    ],
                    n,
                );
            }
        }
        for side in [-1.0, 1.0] {
            let role = self.dice.pick(&[
                Role::Armchair,
                Role::Armchair,
                Role::FloorLamp,
                Role::FloorPlant,
                Role::Bedside,
            ]);
            let Some(model) = self.choose(role) else { continue };
            let chair = role == Role::Armchair;
            let x = side
                * (sofa.half()[0] + model.half()[0] + self.dice.real(0.08, if chair { 0.5 } else { 0.2 }));
            let z = if chair { depth + self.dice.real(0.3, 0.9) } else { 0.0 };
            let turn = if chair { -side * self.dice.real(0.4, 1.5) } else { 0.0 };
            if let Some(piece) = self.beside(&model, at, [x, z], turn)
                && role == Role::Bedside
            {
                self.dress(piece, &[Role::TableLamp, Role::SmallPlant, Role::DeskThing], 2);
            }
        }
        let yaw = self.pieces[at].yaw;
        self.television(yaw, w.max(l));
    }

    /// A television towards a heading, on a chest at the opposite wall or on the wall.
    fn television(&mut self, yaw: f32, _reach: f32) {
        // The wall whose heading is against the sofa's.
        let opposite = (0..4).find(|&k| ((self.plan.wall(k).yaw - yaw).cos() + 1.0).abs() < 0.1);
        let Some(k) = opposite else { return };
        let wall = self.plan.wall(k);
        if self.dice.chance(0.35)
            && let Some(tv) = self.choose(Role::WallTv)
        {
            let along = self.dice.real(-0.4, 0.4) * wall.half;
            self.at_wall(&tv, &wall, along, 1.05);
            return;
        }
        let Some(stand) = self.choose_where(Role::Chest, |m| m.size()[1] < 0.9) else { return };
        if let Some(stand) = self.along(&stand, Some(k), 10) {
            if let Some(tv) = self.choose(Role::Tv) {
                self.set_on(&tv, stand, true, 20);
            }
            let n = self.dice.int(0, 4);
            self.dress(stand, &[Role::Ornament, Role::SmallPlant, Role::DeskThing], n);
        }
    }

    /// A table with chairs around it and things on it.
    pub fn dining(&mut self) {
        let Some(table) = self.choose(Role::DiningTable) else { return };
        let Some(at) = self.anywhere(&table, true, 16) else { return };
        let low = |m: &super::model::Model| m.size()[1] < 1.2;
        let role = if table.size()[1] > 0.92 { Role::Stool } else { Role::Chair };
        let Some(seat) = self.choose_where(role, low) else { return };
        for side in 0..4 {
            let half = table.half();
            let (long, own) =
                if side % 2 == 0 { (half[0], seat.half()[0]) } else { (half[1], seat.half()[0]) };
            let count = ((long / (own + 0.06)) as usize).min(if side % 2 == 0 { 4 } else { 1 });
            for i in 0..count {
                if self.dice.chance(0.82) {
                    let shift =
                        ((2 * i + 1) as f32 / count as f32 - 1.0) * long + self.dice.real(-0.04, 0.04);
                    let depth = self.dice.real(-0.25, 0.32);
                    self.tuck(&seat, at, side, shift, depth);
                }
            }
        }
        let n = self.dice.int(2, 14);
        self.dress(at, &[Role::KitchenThing, Role::KitchenThing, Role::SmallPlant, Role::DeskThing], n);
    }

    pub fn bedroom(&mut self) {
        let beds = if self.dice.chance(0.2) { 2 } else { 1 };
        for _ in 0..beds {
            self.bed();
        }
        let wardrobes = self.dice.int(1, 2);
        self.place_along(Role::Wardrobe, wardrobes);
        for _ in 0..self.dice.int(0, 2) {
            self.chest(&[Role::Ornament, Role::SmallPlant, Role::TableLamp, Role::Toy, Role::Clothes]);
        }
        if self.dice.chance(0.5) {
            self.work_place(None);
        }
        if self.dice.chance(0.4) {
            self.cases(1, &[Role::Toy, Role::Ornament, Role::Clothes]);
        }
        if self.dice.chance(0.3) {
            self.place_along(Role::Leisure, 1);
        }
        if self.dice.chance(0.5) {
            self.place_along(Role::Armchair, 1);
        }
        let things = self.dice.int(0, 9);
        self.litter(&[Role::Clothes, Role::Clothes, Role::Toy], things);
    }

    fn bed(&mut self) {
        let Some(bed) = self.choose(Role::Bed) else { return };
        let Some(at) = self.along(&bed, None, 16) else { return };
        let table = self.choose(Role::Bedside);
        for side in [-1.0, 1.0] {
            if let Some(table) = table.as_ref().filter(|_| self.dice.chance(0.8)) {
                let x = side * (bed.half()[0] + table.half()[0] + self.dice.real(0.03, 0.15));
                let z = table.half()[1] - bed.half()[1];
                if let Some(table) = self.beside(table, at, [x, z], 0.0) {
                    self.dress(table, &[Role::TableLamp, Role::TableLamp, Role::DeskThing, Role::Toy], 3);
                }
            }
        }
        let n = self.dice.int(0, 2);
        self.dress(at, &[Role::Clothes, Role::Toy, Role::DeskThing], n);
        if let Some(rug) = self.choose(Role::Rug).filter(|_| self.dice.chance(0.5)) {
            let side = self.dice.pick(&[-1.0, 1.0]);
            let x = side * (bed.half()[0] + 0.2 + rug.half()[1]);
            let p = self.pieces[at].point([x, 0.0, self.dice.real(-0.3, 0.6)]);
            let yaw = self.pieces[at].yaw + FRAC_PI_2;
            self.spread(&rug, p, yaw);
        }
    }

    /// Lays a rug where it is inside the room, whatever stands there later.
    pub fn spread(&mut self, rug: &std::sync::Arc<super::model::Model>, at: [f32; 3], yaw: f32) {
        let piece = Piece { model: rug.clone(), at: [at[0], 0.001, at[2]], yaw, hold: Hold::Under };
        let spot = piece.spot();
        let apart = |p: &Piece| p.hold != Hold::Under || !p.spot().meets(&spot, 0.0);
        if self.plan.inside(&spot) && self.pieces.iter().all(apart) {
            self.pieces.push(piece);
        }
    }

    /// A desk with a chair and what is needed to work, at a wall or anywhere.
    pub fn work_place(&mut self, at: Option<usize>) {
        let place = match at {
            Some(at) => Some(at),
            None => self.choose(Role::Desk).and_then(|desk| self.along(&desk, None, 10)),
        };
        let Some(at) = place else { return };
        if let Some(computer) = self.choose(Role::Computer).filter(|_| self.dice.chance(0.8)) {
            self.set_on(&computer, at, true, 30);
        }
        let role = if self.dice.chance(0.75) { Role::OfficeChair } else { Role::Chair };
        if let Some(chair) = self.choose(role) {
            let (shift, depth) = (self.dice.real(-0.2, 0.2), self.dice.real(-0.4, 0.3));
            self.tuck(&chair, at, 0, shift, depth);
        }
        let n = self.dice.int(1, 9);
        self.dress(
            at,
            &[
                Role::DeskThing,
                Role::DeskThing,
                Role::DeskThing,
                Role::TableLamp,
                Role::SmallPlant,
                Role::KitchenThing,
            ],
            n,
        );
    }

    /// Up to `count` pieces of a role at walls.
    pub fn place_along(&mut self, role: Role, count: usize) {
        for _ in 0..count {
            if let Some(model) = self.choose(role) {
                self.along(&model, None, 8);
            }
        }
    }

    /// Bookcases with what stands in them.
    pub fn cases(&mut self, count: usize, things: &[Role]) {
        for _ in 0..count {
            let Some(model) = self.choose(Role::Bookcase) else { return };
            if let Some(at) = self.along(&model, None, 10) {
                self.stock(at, things);
            }
        }
    }

    /// A low cabinet with things on it.
    pub fn chest(&mut self, things: &[Role]) {
        let Some(model) = self.choose(Role::Chest) else { return };
        if let Some(at) = self.along(&model, None, 8) {
            let n = self.dice.int(1, 9);
            self.dress(at, things, n);
        }
    }

    /// Things on the floor.
    pub fn litter(&mut self, roles: &[Role], count: usize) {
        for _ in 0..count {
            let role = self.dice.pick(roles);
            if let Some(model) = self.choose(role) {
                self.anywhere(&model, false, 4);
            }
        }
    }

    /// What any room may have: plants, lamps, radiators, people, things on walls.
    pub fn finish(&mut self) {
        let greens = self.dice.int(0, 3);
        for _ in 0..greens {
            if let Some(plant) = self.choose(Role::FloorPlant) {
                self.along(&plant, None, 4);
            }
        }
        if self.dice.chance(0.35) {
            self.place_along(Role::FloorLamp, 1);
        }
        self.heat();
        let pictures =
            if matches!(self.kind, super::style::Kind::Bathroom) { 0 } else { self.dice.int(0, 9) };
        self.pictures(pictures);
        let hung = self.dice.int(0, 3);
        for _ in 0..hung {
            let role = self.dice.pick(&[Role::WallThing, Role::WallThing, Role::WallLamp]);
            let bath = self.kind == super::style::Kind::Bathroom;
            let right =
                |m: &super::model::Model| role == Role::WallLamp || (m.entry.category == "Bathroom") == bath;
            if let Some(model) = self.choose_where(role, right) {
                let up = model.entry.elevation.max(if model.entry.elevation > 0.0 { 0.0 } else { 1.1 });
                self.hang(&model, up);
            }
        }
        for (role, chance) in [(Role::Person, 0.14), (Role::Animal, 0.08)] {
            let count = if self.dice.chance(chance) { self.dice.int(1, 2) } else { 0 };
            for _ in 0..count {
                if let Some(model) = self.choose(role) {
                    self.anywhere(&model, false, 6);
                }
            }
        }
    }

    /// Radiators below windows, curtains at their sides.
    fn heat(&mut self) {
        for hole in self.holes.clone().into_iter().filter(|h| h.window) {
            let (o, wall) = (hole.opening, self.plan.wall(hole.wall));
            if let Some(model) =
                self.choose_where(Role::Radiator, |m| m.entry.elevation + m.size()[1] < o.low - 0.02)
                && self.dice.chance(0.5)
            {
                let up = model.entry.elevation;
                self.at_wall(&model, &wall, o.along, up.max(0.01));
            }
            if let Some(model) = self.choose(Role::Curtain).filter(|_| self.dice.chance(0.3)) {
                let side = self.dice.pick(&[-1.0, 1.0]);
                let along = o.along + side * (o.half + 0.35 * model.half()[0]);
                let at = wall.point(along, 0.04, model.half()[1] + 0.1);
                let piece =
                    Piece { model, at, yaw: wall.yaw + if side > 0.0 { 0.0 } else { PI }, hold: Hold::Wall };
                self.put(piece);
            }
        }
    }
}
