//! Where the rest of a budget goes: between the pixels of which least is known together.

use super::questions::{Answers, Questions};
use crate::depth::interpolate::mesh::Mesh;
use crate::depth::pixels::{colours_apart, is_valid, local_colour};
use crate::error::Result;
use crate::query::plan::coarse_to_fine;
use rayon::prelude::*;

/// Between two rounds of questions it is looked anew at what is known.
pub(super) const ROUNDS: usize = 5;
/// What a difference of colour inside of a triangle counts, as a difference of depth does: black and white as so much.
const COLOUR: f32 = 0.3;
/// What the expected error counts beside a difference of depth.
const UNSURE: f32 = 0.3;
/// How much more a larger triangle counts: its area to this power.
const GROWTH: f32 = 0.8;

/// A pixel of which the depth is known.
struct Site {
    at: (usize, usize),
    depth: f32,
    /// Expected, relative to the depth.
    error: f32,
    colour: [f32; 3],
}

impl Questions<'_> {
    /// Up to so many pixels where an answer says the most: inside of triangles between measurements and answers, the worst first. A triangle is
    /// bad where its corners disagree or are unsure and where the picture in it is another one than at its corners, and the worse the larger it
    /// is: where no measurement is near, triangles are large.
    pub(super) fn worst(&self, answers: &Answers, count: usize) -> Result<Vec<(usize, usize)>> {
        let (width, height) = self.size();
        let sites = self.sites(answers)?;
        let points: Vec<(f32, f32)> = sites.iter().map(|s| (s.at.0 as f32, s.at.1 as f32)).collect();
        if points.is_empty() || count == 0 {
            return Ok(Vec::new());
        }
        let mesh = Mesh::joined(&points, width, height)?;
        let site = |s: u32| &sites[mesh.origin[s as usize]];
        let triangles = mesh.triangles.par_iter().map(|t| self.doubt(t.map(site)));
        let mut found: Vec<(f32, (usize, usize))> = triangles.filter(|(doubt, _)| *doubt > 0.0).collect();
        found.sort_unstable_by(|a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
        let mut asked = self.asked_pixels(answers);
        let fresh = |&(x, y): &(usize, usize)| {
            self.wanted((x, y)) && !std::mem::replace(&mut asked[y * width + x], true)
        };
        Ok(found.into_iter().map(|(_, pixel)| pixel).filter(fresh).take(count).collect())
    }

    /// Pixels that want an answer and have none, those of any part of them spread over the region.
    pub(super) fn unasked(&self, answers: &Answers, count: usize) -> Vec<(usize, usize)> {
        let (width, asked) = (self.size().0, self.asked_pixels(answers));
        let pixels = self.region().lattice(coarse_to_fine, 1).into_iter();
        pixels.filter(|&(x, y)| self.wanted((x, y)) && !asked[y * width + x]).take(count).collect()
    }

    fn asked_pixels(&self, answers: &Answers) -> Vec<bool> {
        let (width, height) = self.size();
        let mut asked = vec![false; width * height];
        answers.readings.iter().for_each(|((x, y), _)| asked[y * width + x] = true);
        asked
    }

    /// Measurements and readable answers, aligned.
    fn sites(&self, answers: &Answers) -> Result<Vec<Site>> {
        let site = |at: (usize, usize), depth: f32, error: f32| Site {
            at,
            depth,
            error: error / depth,
            colour: local_colour(self.rgb, at.0, at.1),
        };
        let measured = self.sparse.points().map(|(x, y, depth)| site((x, y), depth, 0.0));
        let known = self.aligned(answers)?;
        let said = known.iter().filter(|a| is_valid(a.depth));
        Ok(measured.chain(said.map(|a| site((a.x, a.y), a.depth, a.expected_error))).collect())
    }

    /// How much an answer inside of a triangle would say, and its pixel.
    fn doubt(&self, corners: [&Site; 3]) -> (f32, (usize, usize)) {
        let place = |of: fn(&Site) -> usize| corners.iter().map(|s| of(s)).sum::<usize>() / 3;
        let middle = (place(|s| s.at.0), place(|s| s.at.1));
        let [a, b, c] = corners.map(|s| (s.at.0 as f32, s.at.1 as f32));
        let area = 0.5 * ((b.0 - a.0) * (c.1 - a.1) - (b.1 - a.1) * (c.0 - a.0)).abs();
        // In a triangle of three neighbours there is no other pixel.
        if area <= 0.5 {
            return (0.0, middle);
        }
        let (mut near, mut far, mut unsure, mut other) = (f32::INFINITY, 0f32, 0f32, 0f32);
        let colour = local_colour(self.rgb, middle.0, middle.1);
        for corner in corners {
            (near, far) = (near.min(corner.depth), far.max(corner.depth));
            unsure = unsure.max(corner.error);
            other = other.max(colours_apart(colour, corner.colour).sqrt() / 255.0);
        }
        let apart = (far - near) / far;
        ((apart + UNSURE * unsure + COLOUR * other) * area.powf(GROWTH), middle)
    }
}
