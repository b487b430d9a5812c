//! Kitchens, bathrooms, offices, and workshops.

use std::f32::consts::PI;
use std::sync::Arc;

use super::model::Model;
use super::role::Role;
use super::room::Room;

impl Room<'_> {
    pub fn kitchen(&mut self) {
        let first = self.dice.int(0, 3);
        self.run(first);
        if self.dice.chance(0.55) {
            let next = if self.dice.chance(0.5) { 1 } else { 2 };
            self.run((first + next) % 4);
        }
        if self.dice.chance(0.7) {
            self.dining();
        }
        if self.dice.chance(0.2) {
            self.cases(1, &[Role::KitchenThing]);
        }
        let bins = |m: &Model| m.entry.category == "Kitchen" || m.entry.name.contains("bin");
        if let Some(model) = self.choose_where(Role::Workshop, bins).filter(|_| self.dice.chance(0.5)) {
            self.along(&model, None, 6);
        }
    }

    /// Cabinets, a sink, a cooker and so on side by side along a wall, with cabinets above and things on them.
    fn run(&mut self, k: usize) {
        let wall = self.plan.wall(k);
        let uniform = self.choose(Role::WallUnit);
        let base = self.choose(Role::BaseUnit);
        let mut x = -wall.half + if self.dice.chance(0.6) { 0.02 } else { self.dice.real(0.1, 0.8) };
        let end = wall.half - self.dice.real(0.02, 0.3 * wall.half);
        let tall_first = self.dice.chance(0.5);
        let mut left = 12;
        while x < end && left > 0 {
            let tall = (left == 12 && tall_first) || (left < 12 && self.dice.chance(0.08));
            left -= 1;
            let model = if tall {
                self.choose(Role::Fridge)
            } else if self.dice.chance(0.45) {
                base.clone()
            } else {
                self.choose(Role::BaseUnit)
            };
            let Some(model) = model else { return };
            let half = model.half()[0];
            if x + 2.0 * half > end.max(wall.half - 0.02) {
                x += 0.3;
                continue;
            }
            match self.at_wall(&model, &wall, x + half, 0.0) {
                Some(at) => {
                    if !tall {
                        let n = self.dice.int(0, 6);
                        self.dress(at, &[Role::KitchenThing, Role::KitchenThing, Role::SmallPlant], n);
                        self.above(&uniform, &wall, x + half);
                    }
                    // Units stand side by side.
                    x += 2.0 * half + 0.012;
                }
                None => x += 0.15,
            }
        }
    }

    /// A cabinet or a hood over a place of a run.
    fn above(&mut self, uniform: &Option<Arc<Model>>, wall: &super::plan::Wall, along: f32) {
        let role = if self.dice.chance(0.2) { Role::Hood } else { Role::WallUnit };
        let model =
            if role == Role::WallUnit && self.dice.chance(0.7) { uniform.clone() } else { self.choose(role) };
        if let Some(model) = model.filter(|_| self.dice.chance(0.7)) {
            let up = model.entry.elevation.max(1.4).min(self.plan.size[1] - model.size()[1] - 0.02);
            if up > 1.35
                && let Some(at) = self.at_wall(&model, wall, along, up)
            {
                let n = self.dice.int(0, 2);
                self.dress(at, &[Role::KitchenThing], n);
            }
        }
    }

    pub fn bathroom(&mut self) {
        for (role, chance) in [
            (Role::Bath, 0.65),
            (Role::Shower, 0.4),
            (Role::Toilet, 0.9),
            (Role::Basin, 0.95),
            (Role::Toilet, 0.25),
            (Role::Basin, 0.2),
        ] {
            if self.dice.chance(chance)
                && let Some(model) = self.choose(role)
            {
                let placed = (0..14).find_map(|_| {
                    let wall = self.plan.wall(self.dice.int(0, 3));
                    let along = self.dice.real(-1.0, 1.0) * (wall.half - model.half()[0]).max(0.0);
                    let up = model.entry.elevation;
                    self.at_wall(&model, &wall, along, up)
                });
                if let Some(at) = placed.filter(|_| role != Role::Toilet) {
                    let n = self.dice.int(0, 5);
                    self.dress(at, &[Role::BathThing], n);
                }
            }
        }
        let washer =
            |m: &Model| m.entry.name.to_lowercase().contains("wash") || m.entry.name.contains("Dryer");
        if let Some(model) = self.choose_where(Role::BaseUnit, washer).filter(|_| self.dice.chance(0.4))
            && let Some(at) = self.along(&model, None, 8)
        {
            self.dress(at, &[Role::BathThing, Role::Clothes], 3);
        }
        if self.dice.chance(0.4) {
            self.chest(&[Role::BathThing, Role::SmallPlant]);
        }
        for role in [Role::Stool, Role::Workshop] {
            let baskets = |m: &Model| role == Role::Stool || m.entry.category == "Bathroom";
            if let Some(model) = self.choose_where(role, baskets).filter(|_| self.dice.chance(0.4)) {
                self.along(&model, None, 6);
            }
        }
        if let Some(mat) =
            self.choose_where(Role::Rug, |m| m.half()[0] < 0.5).filter(|_| self.dice.chance(0.6))
        {
            let [w, _, l] = self.plan.size;
            let p = [self.dice.real(-0.5, 0.5) * w, 0.0, self.dice.real(-0.5, 0.5) * l];
            let yaw = self.dice.pick(&[0.0, 0.5 * PI]);
            self.spread(&mat, p, yaw);
        }
        let hung = self.dice.int(1, 4);
        for _ in 0..hung {
            if let Some(model) = self.choose_where(Role::WallThing, |m| m.entry.category == "Bathroom") {
                let up = if model.entry.elevation > 0.05 { model.entry.elevation } else { 0.9 };
                self.hang(&model, up);
            }
        }
    }

    pub fn office(&mut self) {
        let desk = self.choose(Role::Desk);
        let count = self.dice.int(1, 6);
        let rows = self.dice.chance(0.5);
        for i in 0..count {
            let desk = if self.dice.chance(0.7) { desk.clone() } else { self.choose(Role::Desk) };
            let Some(desk) = desk else { break };
            let at = if rows || i > 2 { self.anywhere(&desk, true, 10) } else { self.along(&desk, None, 10) };
            if at.is_some() {
                self.work_place(at);
            }
        }
        let cases = self.dice.int(0, 3);
        self.cases(cases, &[Role::DeskThing, Role::SmallPlant, Role::Ornament]);
        if self.dice.chance(0.3) {
            self.dining();
        }
        let suits =
            |m: &Model| ["Office"].contains(&m.entry.category.as_str()) || m.entry.name.contains("Recycling");
        for _ in 0..self.dice.int(0, 3) {
            if let Some(model) = self.choose_where(Role::Workshop, suits) {
                self.along(&model, None, 6);
            }
        }
        if self.dice.chance(0.3) {
            self.place_along(Role::Armchair, 2);
        }
        if self.dice.chance(0.4) {
            let n = self.dice.int(1, 4);
            self.parcels(n);
        }
    }

    /// A shop or workshop: shelves in rows, things to mend or to sell.
    pub fn workshop(&mut self) {
        let things = [Role::Tool, Role::Tool, Role::Clothes, Role::Ornament, Role::KitchenThing, Role::Toy];
        let cases = self.dice.int(1, 5);
        self.cases(cases, &things);
        if self.dice.chance(0.6)
            && let Some(case) = self.choose_where(Role::Bookcase, |m| m.size()[1] > 1.0)
        {
            // A free row in the room, shelves back to back.
            for _ in 0..self.dice.int(1, 3) {
                if let Some(at) = self.anywhere(&case, true, 6) {
                    self.stock(at, &things);
                    let back = -2.0 * case.half()[1] - 0.02;
                    if let Some(other) = self.beside(&case, at, [0.0, back], PI) {
                        self.stock(other, &things);
                    }
                }
            }
        }
        for _ in 0..self.dice.int(0, 3) {
            let role = self.dice.pick(&[Role::Desk, Role::DiningTable, Role::Chest]);
            if let Some(model) = self.choose(role)
                && let Some(at) = self.along(&model, None, 8)
            {
                let n = self.dice.int(3, 10);
                self.dress(at, &things, n);
            }
        }
        for _ in 0..self.dice.int(3, 10) {
            let role =
                self.dice.pick(&[Role::Workshop, Role::Workshop, Role::Workshop, Role::Leisure, Role::Stool]);
            if let Some(model) = self.choose(role) {
                if self.dice.chance(0.6) {
                    self.along(&model, None, 6);
                } else {
                    self.anywhere(&model, false, 6);
                }
            }
        }
        let n = self.dice.int(2, 12);
        self.parcels(n);
        let n = self.dice.int(0, 4);
        self.litter(&[Role::Tool, Role::Clothes], n);
    }
}
