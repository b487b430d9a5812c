//! Points that are seen through nearer surfaces.
//!
//! A sensor that stands beside the camera sees past what the camera has before it. Where the nearer surface was measured at a few pixels
//! alone, what lies behind it shines through the gaps. Such a point is enclosed, in the picture, by measurements that are clearly nearer. On a
//! plane, however slanted, all that is nearer lies to one side, so that nothing of a plane is dropped; nor is what stands beside an edge.

use super::pixels::median;
use crate::error::{Error, Result};
use rayon::prelude::*;

/// Which points of a cloud count as seen by the camera. The nearest of all on a pixel does, unless nearer ones enclose it.
///
/// A point is dropped when it lies within the convex hull, in the picture, of measurements in its window that are nearer by more than `margin`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Visibility {
    /// How much nearer the surface must be, as a share of the point's depth: 0.05 by default. 1 or more keeps all points.
    pub margin: f32,
    /// Reach of the window in columns and rows, pixels, 128 at most. `None`, the default, takes the spacing of the measurements in the picture
    /// (the median gap across and down) and one more, so that the window holds the next scan line on either side. Where there is
    /// less than one measurement on 400 pixels, all are kept: so few do not tell a surface from a gap.
    pub window: Option<(usize, usize)>,
}

impl Default for Visibility {
    fn default() -> Self {
        Self { margin: 0.05, window: None }
    }
}

/// Pixels for each measurement (the gap across times the gap down) from which on they are too few to tell a surface from a gap. LiDARs of 16
/// lines before a picture of 1920 columns have about 120.
const SPARSE: f32 = 400.0;
/// Largest gap, pixels, and largest reach that is accepted.
const REACH: usize = 64;
const LARGEST_REACH: usize = 128;
/// Measurements of which the gaps are taken, about.
const SAMPLE: usize = 1024;

impl Visibility {
    /// Every point that is the nearest on its pixel.
    pub fn all() -> Self {
        Self { margin: 1.0, window: None }
    }

    /// Fails unless the numbers make sense.
    pub(super) fn check(&self) -> Result<()> {
        if self.margin.is_nan() || self.margin < 0.0 {
            return Err(Error::argument("margin", self.margin, "a share of the depth of at least 0"));
        }
        match self.window {
            Some((x, y)) if x > LARGEST_REACH || y > LARGEST_REACH => {
                let expected = format!("a reach of {LARGEST_REACH} pixels at most");
                Err(Error::argument("window", format!("({x}, {y})"), expected))
            }
            _ => Ok(()),
        }
    }

    /// Takes the points that are hidden out of a map (row-major, NaN where nothing is); says how many.
    pub(super) fn remove_hidden(&self, depth: &mut [f32], width: usize) -> usize {
        if self.margin >= 1.0 || width == 0 {
            return 0;
        }
        let grid = Grid { depth, width, height: depth.len() / width };
        let Some(reach) = self.window.or_else(|| grid.reach()) else { return 0 };
        let nearer = 1.0 - self.margin;
        let hidden: Vec<usize> = (0..grid.height)
            .into_par_iter()
            .flat_map_iter(|y| (0..width).map(move |x| (x, y)))
            .filter(|&(x, y)| grid.is_enclosed(x, y, reach, nearer))
            .map(|(x, y)| y * width + x)
            .collect();
        hidden.iter().for_each(|&pixel| depth[pixel] = f32::NAN);
        hidden.len()
    }
}

struct Grid<'a> {
    depth: &'a [f32],
    width: usize,
    height: usize,
}

impl Grid<'_> {
    /// Whether measurements nearer than a share of the pixel's depth enclose it.
    fn is_enclosed(&self, x: usize, y: usize, reach: (usize, usize), nearer: f32) -> bool {
        let below = self.depth[y * self.width + x] * nearer;
        if below.is_nan() {
            return false;
        }
        let columns = x.saturating_sub(reach.0)..(x + reach.0 + 1).min(self.width);
        let rows = y.saturating_sub(reach.1)..(y + reach.1 + 1).min(self.height);
        let mut cone = Cone::default();
        for row in rows {
            let line = &self.depth[row * self.width..][columns.clone()];
            for (column, &depth) in columns.clone().zip(line) {
                if depth < below && cone.closes((column as i32 - x as i32, row as i32 - y as i32)) {
                    return true;
                }
            }
        }
        false
    }

    /// The window's reach from the spacing of the measurements; `None` where they lie too far apart to tell a gap from a surface.
    fn reach(&self) -> Option<(usize, usize)> {
        let measured = self.depth.iter().filter(|d| !d.is_nan()).count();
        let every = (measured / SAMPLE).max(1);
        let mut gaps = [Vec::new(), Vec::new()];
        let all = self.depth.iter().enumerate().filter(|(_, d)| !d.is_nan());
        for (pixel, _) in all.step_by(every) {
            let (x, y) = (pixel % self.width, pixel / self.width);
            let across = |gap: usize, aside: isize| self.at(x + gap, y.checked_add_signed(aside)?);
            let down = |gap: usize, aside: isize| self.at(x.checked_add_signed(aside)?, y + gap);
            gaps[0].push(first_gap(across));
            gaps[1].push(first_gap(down));
        }
        let [across, down] = gaps.map(|mut gaps| median(&mut gaps).filter(|gap| *gap < REACH as f32));
        let (across, down) = (across?, down?);
        (across * down < SPARSE).then_some((across as usize + 1, down as usize + 1))
    }

    fn at(&self, x: usize, y: usize) -> Option<f32> {
        let inside = x < self.width && y < self.height;
        inside.then(|| self.depth[y * self.width + x]).filter(|d| !d.is_nan())
    }
}

/// Distance to the first measurement in the quarter of the plane around an axis, [`REACH`] where there is none nearer. A quarter, because scan
/// lines do not meet the grid of pixels, and not more, because the neighbours on a scan line say nothing of the next one.
fn first_gap(place: impl Fn(usize, isize) -> Option<f32>) -> f32 {
    let holds = |gap: &usize| (-(*gap as isize)..=*gap as isize).any(|aside| place(*gap, aside).is_some());
    (1..REACH).find(holds).unwrap_or(REACH) as f32
}

/// The directions seen so far, as the two outermost ones: less than half a turn lies between them.
#[derive(Default)]
struct Cone {
    ends: Option<[(i32, i32); 2]>,
}

fn cross(a: (i32, i32), b: (i32, i32)) -> i32 {
    a.0 * b.1 - a.1 * b.0
}

fn dot(a: (i32, i32), b: (i32, i32)) -> i32 {
    a.0 * b.0 + a.1 * b.1
}

impl Cone {
    /// Adds a direction; whether some of those so far now enclose the middle, or have it between them.
    fn closes(&mut self, v: (i32, i32)) -> bool {
        let Some([first, last]) = self.ends else {
            self.ends = Some([v, v]);
            return false;
        };
        let holds = |v| {
            let between = cross(first, v) >= 0 && cross(v, last) >= 0;
            between && (dot(first, v) > 0 || dot(last, v) > 0 || cross(first, last) > 0)
        };
        if holds((-v.0, -v.1)) {
            return true;
        }
        if !holds(v) {
            let clockwise = cross(first, v) < 0;
            self.ends = Some(if clockwise { [v, last] } else { [first, v] });
        }
        false
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Whether directions enclose the middle, by trying every direction of a half-plane.
    fn enclosed(all: &[(i32, i32)]) -> bool {
        !(0..7200).any(|i| {
            let (sin, cos) = (f64::from(i) * std::f64::consts::PI / 3600.0 + 1e-5).sin_cos();
            all.iter().all(|&(x, y)| f64::from(x) * cos + f64::from(y) * sin > 0.0)
        })
    }

    #[test]
    fn a_cone_closes_when_directions_enclose_the_middle() {
        let mut seed = 7u32;
        let mut next = || {
            seed = seed.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            (seed >> 16) as i32 % 7 - 3
        };
        let (mut closed, mut open) = (0, 0);
        for _ in 0..3000 {
            let mut all = Vec::new();
            let mut cone = Cone::default();
            let mut closes = false;
            while all.len() < 5 && !closes {
                let v = (next(), next());
                if v != (0, 0) {
                    all.push(v);
                    closes = cone.closes(v);
                    assert_eq!(closes, enclosed(&all), "{all:?}");
                }
            }
            *(if closes { &mut closed } else { &mut open }) += 1;
        }
        assert!(closed > 500 && open > 100, "{closed}, {open}");
    }

    #[test]
    fn the_window_follows_the_spacing() {
        let grid = |across: usize, down: usize| {
            let at = move |i: usize| i.is_multiple_of(across) && (i / 200).is_multiple_of(down);
            (0..200 * 100).map(|i| if at(i) { 1.0 } else { f32::NAN }).collect::<Vec<_>>()
        };
        let reach = |depth: &[f32]| Grid { depth, width: 200, height: 100 }.reach();
        assert_eq!(reach(&grid(1, 1)), Some((2, 2)));
        assert_eq!(reach(&grid(2, 8)), Some((3, 9)));
        assert_eq!(reach(&grid(2, 40)), Some((3, 41)));
        assert_eq!(reach(&grid(20, 20)), None);
        assert_eq!(reach(&grid(1, 70)), None);
        assert_eq!(reach(&[f32::NAN; 200]), None);
    }

    #[test]
    fn options_are_checked() {
        let check = |margin, window| Visibility { margin, window }.check();
        assert!(check(0.0, Some((128, 0))).is_ok() && Visibility::all().check().is_ok());
        for (margin, window) in
            [(f32::NAN, None), (-0.1, None), (0.1, Some((129, 1))), (0.1, Some((1, 1000)))]
        {
            assert!(matches!(check(margin, window), Err(Error::Argument { .. })));
        }
    }
}
