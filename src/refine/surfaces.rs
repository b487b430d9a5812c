//! Answers joined to surfaces, with the edges between them.

use image::RgbImage;
use rayon::prelude::*;

use super::fill::{FillInput, Filled};
use crate::depth::interpolate::Plane;
use crate::depth::interpolate::mesh::{Mesh, NONE, Owner};
use crate::depth::pixels::{colours_apart, local_colour};
use crate::error::Result;

/// Linear within surfaces, and at a depth edge each pixel goes to the side whose colour and place it fits, never between.
///
/// Answers are joined to a Delaunay mesh, so any set works, a lattice or a set that is denser at edges. Inside a triangle
/// whose corners and their neighbours lie on one surface the *inverse* depth is interpolated linearly, which is exact for a plane
/// under a pinhole camera. Other triangles hold an edge: their corners and the corners behind their edges are
/// sorted into surfaces by depth, each surface is weighted by nearness in colour and place, and the pixel takes the mean
/// of the heaviest one. Doubt between the surfaces lowers the confidence and raises the expected error.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct EdgeAwareFill {
    /// Relative difference of depth between neighbouring answers from which they may belong to different surfaces.
    pub edge_ratio: f32,
    /// Difference of colour (Euclidean, 8-bit RGB) that counts as one standard deviation.
    pub colour_sigma: f32,
}

impl Default for EdgeAwareFill {
    fn default() -> Self {
        Self { edge_ratio: 0.15, colour_sigma: 30.0 }
    }
}

#[derive(Debug, Clone, Copy)]
pub(super) struct Value {
    pub(super) depth: f32,
    pub(super) confidence: f32,
    pub(super) error: f32,
}

/// An answer with all that is needed to weigh it.
#[derive(Debug, Clone, Copy)]
struct Site {
    position: [f64; 2],
    colour: [f32; 3],
    value: Value,
}

/// What a triangle holds.
enum Cell {
    Surface { inverse: Plane, confidence: Plane, error: Plane },
    Edge,
}

/// More candidates than this are not looked at for one pixel.
const CANDIDATES: usize = 8;

/// The answers of a frame as pieces of surfaces, ready to say what any pixel is.
pub(super) struct Surfaces<'a> {
    options: EdgeAwareFill,
    rgb: &'a RgbImage,
    pub(super) mesh: Mesh,
    sites: Vec<Site>,
    cells: Vec<Cell>,
}

impl<'a> Surfaces<'a> {
    pub(super) fn new(
        options: &EdgeAwareFill,
        input: &FillInput<'a>,
        filled: &Filled,
        pixels: &[usize],
    ) -> Result<Self> {
        let place = |&pixel: &usize| (pixel % input.width, pixel / input.width);
        let positions: Vec<_> = pixels.iter().map(place).map(|(x, y)| (x as f32, y as f32)).collect();
        let mesh = Mesh::new(&positions, input.width, input.height)?;
        let site = |&pixel: &usize| {
            let (x, y) = place(&pixel);
            let (depth, confidence, error) =
                (filled.depth[pixel], filled.confidence[pixel], filled.expected_error[pixel]);
            let value = Value { depth, confidence, error };
            Site { position: [x as f64, y as f64], colour: local_colour(input.rgb, x, y), value }
        };
        // Pixels are distinct, so the mesh keeps them all and in this order.
        let sites = pixels.par_iter().map(site).collect();
        let mut surfaces = Self { options: *options, rgb: input.rgb, mesh, sites, cells: Vec::new() };
        surfaces.cells =
            (0..surfaces.mesh.triangles.len()).into_par_iter().map(|t| surfaces.cell(t)).collect();
        Ok(surfaces)
    }

    fn cell(&self, triangle: usize) -> Cell {
        let corners = self.mesh.triangles[triangle].map(|s| self.sites[s as usize]);
        let positions = corners.map(|c| c.position);
        let inverse = Plane::through(positions, corners.map(|c| c.value.depth.recip()));
        if self.is_edge(triangle, &corners, &inverse) {
            return Cell::Edge;
        }
        let confidence = Plane::through(positions, corners.map(|c| c.value.confidence));
        let error = Plane::through(positions, corners.map(|c| c.value.error));
        Cell::Surface { inverse, confidence, error }
    }

    /// A steep surface and a step both have corners of different depth; only the surface goes on in the same
    /// plane all around. Every neighbour must agree: one that happens to be close to a corner proves nothing.
    fn is_edge(&self, triangle: usize, corners: &[Site; 3], inverse: &Plane) -> bool {
        let depths = corners.map(|c| c.value.depth);
        let near = depths[0].min(depths[1]).min(depths[2]);
        let far = depths[0].max(depths[1]).max(depths[2]);
        if far <= near * (1.0 + self.options.edge_ratio) {
            return false;
        }
        let (low, high) = (f64::from(far.recip()), f64::from(near.recip()));
        let step = high - low;
        let fits = |&site: &u32| {
            let site = &self.sites[site as usize];
            let expected = inverse.extend(site.position[0], site.position[1]);
            // A neighbour must follow the plane most of the way out of the corners' range; one so close that the plane hardly
            // leaves the range there must be as close to it, up to some noise.
            let beyond = (expected - high).max(low - expected);
            let scale = if beyond > 0.0 { beyond.clamp(0.2 * step, step) } else { step };
            (expected - f64::from(site.value.depth.recip())).abs() <= 0.6 * scale
        };
        let own = self.mesh.triangles[triangle];
        let mut around = own
            .iter()
            .flat_map(|&s| self.mesh.neighbours(s as usize))
            .filter(|s| !own.contains(s))
            .peekable();
        around.peek().is_none() || !around.all(fits)
    }

    /// The far corners of the triangles behind the three edges.
    fn behind(&self, triangle: usize) -> impl Iterator<Item = usize> + '_ {
        let own = self.mesh.triangles[triangle];
        let across = self.mesh.across[triangle].into_iter().filter(|&t| t != NONE);
        across
            .filter_map(move |t| self.mesh.triangles[t as usize].into_iter().find(|s| !own.contains(s)))
            .map(|s| s as usize)
    }

    pub(super) fn at(&self, x: usize, y: usize, owner: Owner) -> Value {
        let mut candidates = [0; CANDIDATES];
        let mut count = 0;
        let mut add = |site: usize| {
            if count < CANDIDATES {
                candidates[count] = site;
                count += 1;
            }
        };
        match owner {
            Owner::Triangle(t) => match &self.cells[t] {
                Cell::Surface { inverse, confidence, error } => {
                    let (px, py) = (x as f64, y as f64);
                    return Value {
                        depth: inverse.at(px, py).recip(),
                        confidence: confidence.at(px, py),
                        error: error.at(px, py),
                    };
                }
                Cell::Edge => {
                    self.mesh.triangles[t].into_iter().for_each(|s| add(s as usize));
                    self.behind(t).for_each(add);
                }
            },
            Owner::Site(s) => {
                add(s);
                self.mesh.neighbours(s).iter().for_each(|&n| add(n as usize));
            }
        }
        self.choose(x, y, &mut candidates[..count])
    }

    /// Sorts candidates into surfaces and takes the mean of the one that fits the pixel best.
    fn choose(&self, x: usize, y: usize, candidates: &mut [usize]) -> Value {
        let depth = |s: usize| self.sites[s].value.depth;
        candidates.sort_unstable_by(|&a, &b| depth(a).total_cmp(&depth(b)));
        let weights = self.weights(x, y, candidates);
        let (mut best, mut best_weight, mut start) = (0..0, -1.0, 0);
        for end in 1..=candidates.len() {
            let gap = end == candidates.len()
                || depth(candidates[end]) > depth(candidates[end - 1]) * (1.0 + self.options.edge_ratio);
            if gap {
                let weight: f32 = weights[start..end].iter().sum();
                if weight > best_weight {
                    (best, best_weight) = (start..end, weight);
                }
                start = end;
            }
        }
        self.blend(candidates, &weights[..candidates.len()], best)
    }

    /// Nearness in colour and in place, scaled so that the best candidate has weight 1.
    fn weights(&self, x: usize, y: usize, candidates: &[usize]) -> [f32; CANDIDATES] {
        let colour = local_colour(self.rgb, x, y);
        let apart = |s: &Site| (s.position[0] - x as f64).powi(2) + (s.position[1] - y as f64).powi(2);
        let mut distances = [f64::INFINITY; CANDIDATES];
        for (distance, &site) in distances.iter_mut().zip(candidates) {
            *distance = apart(&self.sites[site]);
        }
        let mut sorted = distances;
        sorted.sort_unstable_by(f64::total_cmp);
        let reach = sorted[candidates.len() / 2];
        let mut exponents = [f32::INFINITY; CANDIDATES];
        for ((exponent, &site), distance) in exponents.iter_mut().zip(candidates).zip(distances) {
            let squared = colours_apart(colour, self.sites[site].colour);
            *exponent =
                0.5 * squared / self.options.colour_sigma.powi(2) + (distance / reach.max(1.0)) as f32;
        }
        let least = exponents.iter().copied().fold(f32::INFINITY, f32::min);
        exponents.map(|e| (least - e).exp())
    }

    fn blend(&self, candidates: &[usize], weights: &[f32], chosen: std::ops::Range<usize>) -> Value {
        let values = || candidates.iter().map(|&s| self.sites[s].value).zip(weights);
        let within = || values().take(chosen.end).skip(chosen.start);
        let (total, share): (f32, f32) = (weights.iter().sum(), within().map(|(_, w)| w).sum());
        let mean = |of: fn(&Value) -> f32| within().map(|(v, w)| of(&v) * w).sum::<f32>() / share;
        // Candidates are sorted by depth; rounding must not carry the mean out of the surface.
        let ends =
            within().map(|(v, _)| v.depth).fold((f32::INFINITY, 0.0f32), |(l, h), d| (l.min(d), h.max(d)));
        let depth = mean(|v| v.depth.recip()).recip().max(ends.0).min(ends.1);
        let elsewhere: f32 = values().map(|(v, w)| (v.depth - depth).abs() * w).sum::<f32>() / total;
        Value {
            depth,
            confidence: (mean(|v| v.confidence) * share / total).clamp(0.0, 1.0),
            error: mean(|v| v.error) + elsewhere,
        }
    }
}
