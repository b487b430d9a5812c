//! What holds panes: partitions, doors, windows, balustrades, screens, with posts, rails, handles and stickers.

use super::super::space::V3;
use super::super::stage::{Paint, Place, Stage};
use super::super::texture::Pattern;
use super::glazing::Cell;

/// Where panes can stand.
#[derive(Clone, Copy, Debug)]
pub(super) struct Room {
    /// Height of the ceiling above the floor, metres.
    pub height: f32,
    /// How far to each side something can be seen of the plane, metres.
    pub reach: f32,
}

/// Panes under construction.
struct Work<'a> {
    stage: &'a mut Stage,
    place: Place,
    cells: Vec<Cell>,
    /// What frames are made of.
    metal: Paint,
    /// Half of their width, metres; 0 for panes that stand edge to edge.
    half: f32,
}

/// Builds panes in a plane whose foot is `place`; gives the cells, and their height.
pub(super) fn build(stage: &mut Stage, place: Place, room: Room) -> (Vec<Cell>, f32) {
    let metal = metal(stage);
    let half = if stage.chance(0.28) { 0.0 } else { stage.log(0.012, 0.05) };
    let mut work = Work { stage, place, cells: Vec::new(), metal, half };
    let height = match work.stage.int(0, 99) {
        0..=44 => work.partition(room),
        45..=64 => work.window(room),
        65..=77 => work.doors(room),
        78..=88 => work.balustrade(room),
        _ => work.screen(room),
    };
    work.stickers(height);
    (work.cells, height)
}

fn metal(stage: &mut Stage) -> Paint {
    let colour = match stage.int(0, 5) {
        0 | 1 => [stage.real(0.02, 0.1); 3],
        2 | 3 => [stage.real(0.4, 0.7); 3],
        4 => [stage.real(0.75, 0.92); 3],
        _ => return stage.wood(),
    };
    stage.plain(colour)
}

impl Work<'_> {
    /// A bar of the frame in the plane.
    fn frame(&mut self, x: [f32; 2], y: [f32; 2], half: f32) {
        let centre = [0.5 * (x[0] + x[1]), 0.5 * (y[0] + y[1]), 0.0];
        let size = [0.5 * (x[1] - x[0]).abs() + half, 0.5 * (y[1] - y[0]).abs() + half, half.max(0.015)];
        self.stage.cuboid(&self.place, centre, size, self.metal);
    }

    /// A wall in the plane.
    fn wall(&mut self, x: [f32; 2], y: [f32; 2], paint: Paint) {
        if x[1] - x[0] > 0.01 && y[1] - y[0] > 0.01 {
            let centre = [0.5 * (x[0] + x[1]), 0.5 * (y[0] + y[1]), 0.0];
            self.stage.cuboid(&self.place, centre, [0.5 * (x[1] - x[0]), 0.5 * (y[1] - y[0]), 0.06], paint);
        }
    }

    /// Panes side by side from one height to another over a stretch, with posts between them, rails below and above, and
    /// perhaps a bar across. A share of them is missing.
    fn row(&mut self, x: [f32; 2], y: [f32; 2], step: f32, open: f32) {
        let count = ((x[1] - x[0]) / step).round().max(1.0) as usize;
        let step = (x[1] - x[0]) / count as f32;
        let across = (y[1] - y[0] > 1.2 && self.half > 0.0 && self.stage.chance(0.35))
            .then(|| y[0] + self.stage.real(0.3, 0.85) * (y[1] - y[0]));
        let half = self.half;
        for k in 0..count {
            let own = [x[0] + k as f32 * step, x[0] + (k + 1) as f32 * step];
            let glass = !self.stage.chance(open);
            let parts = across.map_or(vec![y], |middle| vec![[y[0], middle], [middle, y[1]]]);
            self.cells.extend(parts.into_iter().map(|y| Cell { x: own, y, glass }));
            if half > 0.0 {
                self.frame([own[0]; 2], y, half);
            }
        }
        if half > 0.0 {
            self.frame([x[1]; 2], y, half);
            for at in [Some(y[0]), Some(y[1]), across].into_iter().flatten() {
                self.frame(x, [at; 2], half);
            }
        } else if self.stage.chance(0.5) {
            // Shoes that hold the panes at the floor.
            self.frame(x, [y[0]; 2], 0.03);
        }
    }

    /// Glass from wall to wall, with a door perhaps.
    fn partition(&mut self, room: Room) -> f32 {
        let low = if self.stage.chance(0.2) { self.stage.real(0.3, 1.1) } else { 0.0 };
        let high =
            if self.stage.chance(0.75) { room.height } else { self.stage.real(2.0, 2.6).min(room.height) };
        let paint = self.stage.surface(1.5);
        self.wall([-room.reach, room.reach], [0.0, low], paint);
        let step = self.stage.log(0.6, 2.6);
        if low > 0.0 || self.stage.chance(0.4) {
            self.row([-room.reach, room.reach], [low, high], step, 0.06);
            return high;
        }
        let (at, wide) = (self.stage.real(-0.4, 0.4) * room.reach, self.stage.real(0.4, 0.6));
        self.row([-room.reach, at - wide], [low, high], step, 0.06);
        self.row([at + wide, room.reach], [low, high], step, 0.06);
        self.door([at - wide, at + wide], high);
        high
    }

    /// A door with what is above it.
    fn door(&mut self, x: [f32; 2], high: f32) {
        let top = (0.98 * high).min(2.1);
        let open = self.stage.chance(0.2);
        self.cells.push(Cell { x, y: [0.0, top], glass: !open });
        if high - top > 0.05 {
            self.cells.push(Cell { x, y: [top, high], glass: true });
        }
        let half = self.half.max(if self.stage.chance(0.6) { 0.03 } else { 0.0 });
        if half > 0.0 {
            self.frame([x[0]; 2], [0.0, high], half);
            self.frame([x[1]; 2], [0.0, high], half);
            self.frame(x, [top; 2], half);
            if !open {
                self.frame(x, [0.0; 2], 1.5 * half);
            }
        }
        if open || self.stage.chance(0.15) {
            return;
        }
        let side = self.stage.pick(&[-1.0f32, 1.0]);
        let at = 0.5 * (x[0] + x[1]) + side * (0.5 * (x[1] - x[0]) - half - 0.08);
        let place = self.place;
        if self.stage.chance(0.6) {
            let reach = self.stage.real(0.15, 0.5);
            for z in [-0.05, 0.05] {
                self.stage.bar(&place, [at, 1.05 - reach, z], [at, 1.05 + reach, z], 0.014, self.metal);
            }
        } else {
            self.stage.cuboid(&place, [at, 1.0, 0.0], [0.03, 0.09, 0.02], self.metal);
            for z in [-0.05, 0.05] {
                self.stage.bar(&place, [at, 1.03, z], [at - side * 0.13, 1.03, z], 0.01, self.metal);
            }
        }
    }

    /// A window or a shop front in a wall.
    fn window(&mut self, room: Room) -> f32 {
        let paint = self.stage.surface(2.0);
        let low = if self.stage.chance(0.3) { self.stage.real(0.05, 0.4) } else { self.stage.real(0.5, 1.1) };
        let high = (low + self.stage.real(1.0, 2.4)).min(room.height - 0.05);
        let wide = self.stage.log(0.8, 4.0).min(room.reach);
        let at = self.stage.real(-0.3, 0.3) * wide;
        let x = [at - wide, at + wide];
        self.wall([-room.reach, x[0]], [0.0, room.height], paint);
        self.wall([x[1], room.reach], [0.0, room.height], paint);
        self.wall(x, [0.0, low], paint);
        self.wall(x, [high, room.height], paint);
        if self.stage.chance(0.6) {
            let place = self.place;
            self.stage.cuboid(&place, [at, low, -0.1], [wide, 0.02, 0.12], self.metal);
        }
        let step = self.stage.log(0.6, 3.0);
        self.row(x, [low, high], step, 0.08);
        high
    }

    /// Doors of glass in a wall.
    fn doors(&mut self, room: Room) -> f32 {
        let paint = self.stage.surface(2.0);
        let top = self.stage.real(2.0, 2.4).min(room.height - 0.05);
        let (leaves, wide) = (self.stage.int(1, 3), self.stage.real(0.7, 1.1));
        let from = -0.5 * leaves as f32 * wide + self.stage.real(-0.5, 0.5);
        for k in 0..leaves {
            let left = from + k as f32 * wide;
            self.door([left, left + wide], top);
        }
        let to = from + leaves as f32 * wide;
        self.wall([-room.reach, from], [0.0, room.height], paint);
        self.wall([to, room.reach], [0.0, room.height], paint);
        self.wall([from, to], [top, room.height], paint);
        top
    }

    /// Glass up to the hip, with a rail on it mostly.
    fn balustrade(&mut self, room: Room) -> f32 {
        let (low, high) = (self.stage.real(0.0, 0.12), self.stage.real(0.9, 1.3));
        let step = self.stage.log(0.7, 1.8);
        let reach = room.reach;
        let count = (2.0 * reach / step).ceil().max(1.0) as usize;
        let posts = self.half > 0.0 || self.stage.chance(0.4);
        for k in 0..count {
            let left = -reach + k as f32 * step;
            let gap = if posts { 0.03 } else { 0.008 };
            self.cells.push(Cell { x: [left + gap, left + step - gap], y: [low, high], glass: true });
            if posts {
                self.frame([left; 2], [0.0, high], self.half.max(0.02));
            }
        }
        if self.stage.chance(0.75) {
            let (place, radius) = (self.place, self.stage.real(0.02, 0.035));
            let y = high + self.stage.real(0.0, 0.06);
            self.stage.bar(&place, [-reach, y, 0.0], [reach, y, 0.0], radius, self.metal);
        }
        high
    }

    /// A screen that stands free.
    fn screen(&mut self, room: Room) -> f32 {
        let (wide, low) = (self.stage.real(0.4, 1.4), self.stage.real(0.03, 0.5));
        let high = (low + self.stage.real(0.8, 1.8)).min(room.height);
        let at = self.stage.real(-0.3, 0.3);
        let x = [at - wide, at + wide];
        let step = self.stage.real(0.9, 3.0);
        self.row(x, [low, high], step, 0.0);
        let place = self.place;
        for side in x {
            self.stage.cuboid(&place, [side, 0.02, 0.0], [0.04, 0.02, 0.25], self.metal);
            self.stage.cuboid(&place, [side, 0.5 * low, 0.0], [0.02, 0.5 * low, 0.02], self.metal);
        }
        high
    }

    /// Marks that keep people from walking into a pane, and posters.
    fn stickers(&mut self, height: f32) {
        let place = self.place;
        let glass: Vec<Cell> = self.cells.iter().filter(|c| c.glass && c.x[0].abs() < 4.0).cloned().collect();
        if glass.is_empty() {
            return;
        }
        if self.stage.chance(0.25) {
            let (size, gap) = (self.stage.real(0.015, 0.04), self.stage.real(0.12, 0.35));
            let colour = if self.stage.chance(0.6) { [0.85; 3] } else { self.stage.vivid() };
            let (paint, y) = (self.stage.plain(colour), self.stage.real(0.45, 0.75) * height);
            let round = self.stage.chance(0.5);
            for cell in glass.iter().filter(|c| c.y[0] < y && c.y[1] > y) {
                let mut x = cell.x[0] + 0.5 * gap;
                while x + size < cell.x[1] {
                    self.mark([x, y, 0.0], [size, size], round, paint);
                    x += gap;
                }
            }
        }
        if self.stage.chance(0.3) {
            for _ in 0..self.stage.int(1, 4) {
                let cell = &glass[self.stage.int(0, glass.len() - 1)];
                let (w, h) = (self.stage.log(0.04, 0.25), self.stage.log(0.04, 0.3));
                let room = [0.5 * (cell.x[1] - cell.x[0]) - w, 0.5 * (cell.y[1] - cell.y[0]) - h];
                if room[0] < 0.02 || room[1] < 0.02 {
                    continue;
                }
                let x = 0.5 * (cell.x[0] + cell.x[1]) + self.stage.real(-0.9, 0.9) * room[0];
                let y = 0.5 * (cell.y[0] + cell.y[1]) + self.stage.real(-0.9, 0.9) * room[1];
                let (a, b) = (self.stage.vivid(), self.stage.vivid());
                let paint = self.stage.paint(Pattern::Print, a, b, w);
                self.stage.cuboid(&place, [x, y, 0.0], [w, h, 0.002], paint);
            }
        }
    }

    fn mark(&mut self, at: V3, half: [f32; 2], round: bool, paint: Paint) {
        let place = self.place;
        let half = [half[0], half[1], 0.002];
        if round {
            self.stage.ball(&place, at, half, paint);
        } else {
            self.stage.cuboid(&place, at, half, paint);
        }
    }
}
