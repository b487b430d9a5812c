//! A Delaunay mesh over scattered points, with the mesh element that owns each pixel.

use delaunator::{EMPTY, Point, triangulate};
use rayon::prelude::*;

use crate::depth::pixels::pixel_count;
use crate::error::{Error, Result};

/// Where a pixel lies: inside a triangle, or outside the hull and nearest to a site.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Owner {
    Triangle(usize),
    Site(usize),
}

/// Distinct points ("sites"), their triangulation, and the owner of each pixel of a frame.
#[derive(Debug)]
pub(crate) struct Mesh {
    pub(crate) width: usize,
    pub(crate) height: usize,
    /// Positions of the distinct points, pixels.
    pub(crate) sites: Vec<[f64; 2]>,
    /// For each site the index of the (first) point at this position in the caller's list.
    pub(crate) origin: Vec<usize>,
    /// Three sites each.
    pub(crate) triangles: Vec<[u32; 3]>,
    /// `across[t][k]`: the triangle behind the edge from corner k to corner k + 1, or `NONE`.
    pub(crate) across: Vec<[u32; 3]>,
    /// Neighbours of site s: `links[first[s]..first[s + 1]]`.
    first: Vec<u32>,
    links: Vec<u32>,
    /// Per pixel, row-major: a triangle, or a site with the top bit set.
    owner: Vec<u32>,
}

/// No triangle: the edge is on the hull.
pub(crate) const NONE: u32 = u32::MAX;
const SITE_BIT: u32 = 1 << 31;
const UNSET: u32 = u32::MAX;
const BANDS: usize = 16;

impl Mesh {
    pub(crate) fn new(points: &[(f32, f32)], width: usize, height: usize) -> Result<Self> {
        let mut mesh = Self::joined(points, width, height)?;
        mesh.owner = mesh.owners(pixel_count(width, height)?);
        Ok(mesh)
    }

    /// The sites and how they are joined, without the owners of pixels: for [`Mesh::neighbours`] alone.
    pub(crate) fn joined(points: &[(f32, f32)], width: usize, height: usize) -> Result<Self> {
        pixel_count(width, height)?;
        if points.is_empty() {
            return Err(Error::NoMeasurement { width, height });
        }
        if let Some(&(x, y)) = points.iter().find(|(x, y)| !(x.is_finite() && y.is_finite())) {
            return Err(Error::argument("point", format!("({x}, {y})"), "finite coordinates"));
        }
        let (sites, origin) = distinct(points);
        let (triangles, across) = delaunay(&sites);
        let (first, links) =
            if triangles.is_empty() { chain(&sites) } else { neighbours(sites.len(), &triangles, &across) };
        Ok(Self { width, height, sites, origin, triangles, across, first, links, owner: Vec::new() })
    }

    pub(crate) fn owner(&self, x: usize, y: usize) -> Owner {
        decode(self.owner[y * self.width + x])
    }

    /// Owners of one row of pixels.
    pub(crate) fn owner_row(&self, y: usize) -> impl Iterator<Item = Owner> + '_ {
        self.owner[y * self.width..(y + 1) * self.width].iter().map(|&code| decode(code))
    }

    /// Sites joined to a site by an edge of the mesh.
    pub(crate) fn neighbours(&self, site: usize) -> &[u32] {
        &self.links[self.first[site] as usize..self.first[site + 1] as usize]
    }

    pub(crate) fn corners(&self, triangle: usize) -> [[f64; 2]; 3] {
        self.triangles[triangle].map(|s| self.sites[s as usize])
    }

    /// Sites that lie exactly on a pixel of the frame, as (pixel index, site).
    pub(crate) fn pixel_sites(&self) -> impl Iterator<Item = (usize, usize)> + '_ {
        let (w, h) = (self.width as f64, self.height as f64);
        let inside = move |p: &[f64; 2]| p[0] >= 0.0 && p[1] >= 0.0 && p[0] < w && p[1] < h;
        let exact = move |p: &[f64; 2]| inside(p) && p[0].fract() == 0.0 && p[1].fract() == 0.0;
        let found = self.sites.iter().enumerate().filter(move |(_, p)| exact(p));
        found.map(|(site, p)| (p[1] as usize * self.width + p[0] as usize, site))
    }

    /// Owner of any position in the plane, found by walking from the nearest pixel's owner.
    #[cfg(any(feature = "train", test))]
    pub(crate) fn locate(&self, position: [f64; 2]) -> Owner {
        let x = position[0].round().clamp(0.0, (self.width - 1) as f64) as usize;
        let y = position[1].round().clamp(0.0, (self.height - 1) as f64) as usize;
        let (start, site) = match self.owner(x, y) {
            Owner::Triangle(t) => (t, self.triangles[t][0] as usize),
            Owner::Site(s) => (self.triangle_at(s), s),
        };
        match self.walk(position, start) {
            Some(triangle) => Owner::Triangle(triangle),
            None => Owner::Site(self.nearest(position, site)),
        }
    }

    /// The site nearest to a position, by descent over the mesh.
    ///
    /// A site that is not the nearest one always has a Delaunay neighbour that is nearer, so the descent cannot get stuck;
    /// for sites on one line the chain of consecutive sites has the same property.
    pub(crate) fn nearest(&self, position: [f64; 2], start: usize) -> usize {
        let distance = |s: usize| {
            let [x, y] = self.sites[s];
            (x - position[0]).powi(2) + (y - position[1]).powi(2)
        };
        let (mut best, mut best_distance) = (start, distance(start));
        loop {
            let here = best;
            for &next in self.neighbours(here) {
                let d = distance(next as usize);
                if d < best_distance {
                    (best, best_distance) = (next as usize, d);
                }
            }
            if best == here {
                return best;
            }
        }
    }

    /// Some triangle with this site as a corner, or the first one (0 also when there is none).
    #[cfg(any(feature = "train", test))]
    fn triangle_at(&self, site: usize) -> usize {
        // Only positions within half a pixel of the hull come here, so a search is cheaper than a table.
        self.triangles.iter().position(|t| t.contains(&(site as u32))).unwrap_or(0)
    }

    /// Walks towards a position through the edges it lies behind; `None` when it is outside the hull.
    #[cfg(any(feature = "train", test))]
    fn walk(&self, position: [f64; 2], start: usize) -> Option<usize> {
        let mut triangle = start;
        // On a Delaunay mesh the walk visits no triangle twice; rounding could break that, so it is counted.
        'walk: for _ in 0..self.triangles.len() {
            let corners = self.corners(triangle);
            let turn = cross(corners[0], corners[1], corners[2]);
            for k in 0..3 {
                if cross(corners[k], corners[(k + 1) % 3], position) * turn < 0.0 {
                    match self.across[triangle][k] {
                        NONE => return None,
                        next => triangle = next as usize,
                    }
                    continue 'walk;
                }
            }
            return Some(triangle);
        }
        None
    }

    fn owners(&self, pixels: usize) -> Vec<u32> {
        let mut owner = vec![UNSET; pixels];
        let spans: Vec<(u32, u32)> = (0..self.triangles.len()).map(|t| self.row_span(t)).collect();
        // A site without links was swallowed by the triangulation (closer to another than its tolerance).
        let start = (0..self.sites.len()).find(|&s| !self.neighbours(s).is_empty()).unwrap_or(0);
        let rows = self.height.div_ceil(BANDS);
        owner.par_chunks_mut(rows * self.width).enumerate().for_each(|(band, chunk)| {
            self.paint_triangles(chunk, band * rows, &spans);
            self.paint_nearest(chunk, band * rows, start);
        });
        owner
    }

    /// First and last pixel row that a triangle can touch; first > last when there is none.
    fn row_span(&self, triangle: usize) -> (u32, u32) {
        let c = self.corners(triangle);
        let low = c[0][1].min(c[1][1]).min(c[2][1]).ceil().max(0.0);
        let high = c[0][1].max(c[1][1]).max(c[2][1]).floor().min((self.height - 1) as f64);
        if high < low || cross(c[0], c[1], c[2]) == 0.0 { (1, 0) } else { (low as u32, high as u32) }
    }

    fn paint_triangles(&self, chunk: &mut [u32], top: usize, spans: &[(u32, u32)]) {
        let bottom = top + chunk.len() / self.width;
        for (t, &(low, high)) in spans.iter().enumerate() {
            let rows = (low as usize).max(top)..(high as usize + 1).min(bottom);
            if low > high || rows.is_empty() {
                continue;
            }
            let corners = self.corners(t);
            for y in rows {
                let (left, right) = crossing(&corners, y as f64);
                let (left, right) = (left.ceil().max(0.0), right.floor().min((self.width - 1) as f64));
                if left <= right {
                    let row = (y - top) * self.width;
                    chunk[row + left as usize..=row + right as usize].fill(t as u32);
                }
            }
        }
    }

    fn paint_nearest(&self, chunk: &mut [u32], top: usize, start: usize) {
        let mut row_start = start;
        for (dy, row) in chunk.chunks_exact_mut(self.width).enumerate() {
            let mut last = None;
            for (x, code) in row.iter_mut().enumerate() {
                if *code == UNSET {
                    // Pixels are visited in order, so the last answer is at most a few steps away.
                    let site = self.nearest([x as f64, (top + dy) as f64], last.unwrap_or(row_start));
                    *code = site as u32 | SITE_BIT;
                    row_start = if last.is_none() { site } else { row_start };
                    last = Some(site);
                }
            }
        }
    }
}

fn decode(code: u32) -> Owner {
    if code & SITE_BIT == 0 {
        Owner::Triangle(code as usize)
    } else {
        Owner::Site((code & !SITE_BIT) as usize)
    }
}

/// Twice the signed area of a triangle.
pub(crate) fn cross(a: [f64; 2], b: [f64; 2], c: [f64; 2]) -> f64 {
    (b[0] - a[0]) * (c[1] - a[1]) - (c[0] - a[0]) * (b[1] - a[1])
}

/// The part of the line at height y that a triangle covers.
///
/// Both triangles of an edge compute its crossing from the same two ends in the same order, so no pixel falls between.
fn crossing(corners: &[[f64; 2]; 3], y: f64) -> (f64, f64) {
    let (mut left, mut right) = (f64::INFINITY, f64::NEG_INFINITY);
    for k in 0..3 {
        let (mut a, mut b) = (corners[k], corners[(k + 1) % 3]);
        if (a[1], a[0]) > (b[1], b[0]) {
            std::mem::swap(&mut a, &mut b);
        }
        if y < a[1] || y > b[1] {
            continue;
        }
        let (from, to) = if a[1] == b[1] {
            (a[0], b[0])
        } else {
            let x = if y == b[1] { b[0] } else { a[0] + (y - a[1]) * (b[0] - a[0]) / (b[1] - a[1]) };
            (x, x)
        };
        left = left.min(from.min(to));
        right = right.max(from.max(to));
    }
    (left, right)
}

/// Drops points at a position that came before, keeping the order of the rest.
fn distinct(points: &[(f32, f32)]) -> (Vec<[f64; 2]>, Vec<usize>) {
    // Adding 0 turns -0 into 0, so that equal positions have equal bits.
    let bits = |v: f32| u64::from((v + 0.0).to_bits());
    let key = |&(x, y): &(f32, f32)| bits(y) << 32 | bits(x);
    let mut order: Vec<(u64, usize)> = points.iter().map(key).zip(0..).collect();
    order.sort_unstable();
    order.dedup_by_key(|(key, _)| *key);
    let mut origin: Vec<usize> = order.into_iter().map(|(_, index)| index).collect();
    origin.sort_unstable();
    let sites = origin.iter().map(|&i| [f64::from(points[i].0), f64::from(points[i].1)]).collect();
    (sites, origin)
}

type Corners = Vec<[u32; 3]>;

fn delaunay(sites: &[[f64; 2]]) -> (Corners, Corners) {
    let points: Vec<Point> = sites.iter().map(|&[x, y]| Point { x, y }).collect();
    let mesh = triangulate(&points);
    let corners = mesh.triangles.chunks_exact(3).map(|t| [t[0] as u32, t[1] as u32, t[2] as u32]).collect();
    let behind = |edge: usize| if edge == EMPTY { NONE } else { (edge / 3) as u32 };
    let across = mesh.halfedges.chunks_exact(3).map(|e| [behind(e[0]), behind(e[1]), behind(e[2])]).collect();
    (corners, across)
}

/// Each directed edge once; an inner edge appears once per direction in its two triangles, a hull edge only in one.
fn neighbours(sites: usize, triangles: &[[u32; 3]], across: &[[u32; 3]]) -> (Vec<u32>, Vec<u32>) {
    let mut edges = Vec::with_capacity(triangles.len() * 3 + sites);
    for (corners, across) in triangles.iter().zip(across) {
        for k in 0..3 {
            let (a, b) = (corners[k], corners[(k + 1) % 3]);
            edges.push((a, b));
            if across[k] == NONE {
                edges.push((b, a));
            }
        }
    }
    compress(sites, &edges)
}

/// Sites on one line: each is joined to the one before and the one behind.
fn chain(sites: &[[f64; 2]]) -> (Vec<u32>, Vec<u32>) {
    let mut order: Vec<u32> = (0..sites.len() as u32).collect();
    order.sort_by(|&a, &b| {
        let (a, b) = (sites[a as usize], sites[b as usize]);
        a[0].total_cmp(&b[0]).then(a[1].total_cmp(&b[1]))
    });
    let edges: Vec<(u32, u32)> = order.windows(2).flat_map(|w| [(w[0], w[1]), (w[1], w[0])]).collect();
    compress(sites.len(), &edges)
}

fn compress(sites: usize, edges: &[(u32, u32)]) -> (Vec<u32>, Vec<u32>) {
    let mut first = vec![0u32; sites + 1];
    for &(from, _) in edges {
        first[from as usize + 1] += 1;
    }
    for s in 0..sites {
        first[s + 1] += first[s];
    }
    let mut next = first.clone();
    let mut links = vec![0u32; edges.len()];
    for &(from, to) in edges {
        links[next[from as usize] as usize] = to;
        next[from as usize] += 1;
    }
    (first, links)
}
