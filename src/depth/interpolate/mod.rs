//! Dense maps from scattered values: nearest neighbour and piecewise linear over a Delaunay mesh.

pub(crate) mod mesh;

use rayon::prelude::*;

use super::SparseDepth;
use super::pixels::faces_a_hole;
use crate::error::Result;
use mesh::{Mesh, Owner, cross};

/// Gives every pixel the depth of the nearest measured pixel (Euclidean, exact). `width * height` metres.
///
/// # Errors
/// [`Error::NoMeasurement`](crate::error::Error::NoMeasurement) for a map without measurements.
pub fn nearest(sparse: &SparseDepth) -> Result<Vec<f32>> {
    let width = sparse.width();
    from_nearest(sparse, |_, (x, y)| sparse.as_slice()[y * width + x])
}

/// The Euclidean distance of every pixel to the nearest measured one, exact, in pixels: 0 at measured pixels.
///
/// # Errors
/// [`Error::NoMeasurement`](crate::error::Error::NoMeasurement) for a map without measurements.
#[doc(hidden)]
pub fn distance(sparse: &SparseDepth) -> Result<Vec<f32>> {
    let squared = |a: usize, b: usize| a.abs_diff(b) as f64 * a.abs_diff(b) as f64;
    from_nearest(sparse, |(x, y), (nx, ny)| (squared(x, nx) + squared(y, ny)).sqrt() as f32)
}

/// A map of values made from each pixel's (x, y) and that of its nearest measurement.
fn from_nearest(
    sparse: &SparseDepth,
    value: impl Fn((usize, usize), (usize, usize)) -> f32 + Sync,
) -> Result<Vec<f32>> {
    sparse.require_points()?;
    let (width, height) = (sparse.width(), sparse.height());
    let rows = nearest_rows(sparse.as_slice(), width, height);
    let mut out = vec![0.0; width * height];
    out.par_chunks_mut(width).enumerate().for_each(|(y, line)| {
        let found = &rows[y * width..(y + 1) * width];
        for ((x, pixel), column) in line.iter_mut().enumerate().zip(nearest_columns(y, found)) {
            *pixel = value((x, y), (column, found[column] as usize));
        }
    });
    Ok(out)
}

/// Piecewise linear interpolation over the Delaunay triangles of the measured pixels; the nearest measurement outside their
/// hull, and everywhere if they all lie on one line. Measured pixels keep their value. `width * height` metres.
///
/// # Errors
/// [`Error::NoMeasurement`](crate::error::Error::NoMeasurement) for a map without measurements.
pub fn linear(sparse: &SparseDepth) -> Result<Vec<f32>> {
    sparse.require_points()?;
    let edge = rim(sparse);
    if edge.is_empty() {
        return Ok(sparse.as_slice().to_vec());
    }
    let positions: Vec<_> = edge.iter().map(|&(x, y, _)| (x as f32, y as f32)).collect();
    let values: Vec<_> = edge.iter().map(|&(_, _, depth)| depth).collect();
    let mut out = Interpolator::new(&positions, sparse.width(), sparse.height())?.raster(&values);
    for (pixel, &depth) in out.iter_mut().zip(sparse.as_slice()) {
        if !depth.is_nan() {
            *pixel = depth;
        }
    }
    Ok(out)
}

/// Measurements with a missing pixel among the eight around them, row by row: none if nothing is missing.
///
/// The triangles at any other are the small ones towards its eight neighbours and hold no missing pixel, so it can be left out of
/// a mesh without changing what that says about missing pixels. In dense maps this saves nearly all of the work.
pub(crate) fn rim(sparse: &SparseDepth) -> Vec<(usize, usize, f32)> {
    let (width, height) = (sparse.width(), sparse.height());
    if sparse.measured() == width * height {
        return Vec::new();
    }
    sparse.points().filter(|&(x, y, _)| faces_a_hole(sparse.as_slice(), width, height, x, y)).collect()
}

/// No measurement in this column.
const EMPTY: u32 = u32::MAX;

/// For each pixel the row of the nearest measurement in its own column, or `EMPTY`.
fn nearest_rows(depth: &[f32], width: usize, height: usize) -> Vec<u32> {
    let mut rows = vec![EMPTY; depth.len()];
    for y in 0..height {
        for x in 0..width {
            let here = y * width + x;
            if !depth[here].is_nan() {
                rows[here] = y as u32;
            } else if y > 0 {
                rows[here] = rows[here - width];
            }
        }
    }
    for y in (0..height.saturating_sub(1)).rev() {
        for x in 0..width {
            let (above, below) = (rows[y * width + x], rows[(y + 1) * width + x]);
            let nearer = below != EMPTY
                && (above == EMPTY || (below as usize).abs_diff(y) < (above as usize).abs_diff(y));
            if nearer {
                rows[y * width + x] = below;
            }
        }
    }
    rows
}

/// For each pixel of row y the column whose candidate (`found`) is nearest.
///
/// Seen along the row, the squared distance to a column's candidate is a parabola; the lower envelope of all parabolas is
/// built left to right (Felzenszwalb and Huttenlocher, "Distance Transforms of Sampled Functions", 2012) and read off.
fn nearest_columns(y: usize, found: &[u32]) -> impl Iterator<Item = usize> {
    let height = |x: usize| (i64::from(found[x]) - y as i64).pow(2);
    // (column of the parabola, first pixel where it is the lowest)
    let mut envelope: Vec<(usize, usize)> = Vec::new();
    for x in (0..found.len()).filter(|&x| found[x] != EMPTY) {
        let mut from = 0;
        while let Some(&(last, last_from)) = envelope.last() {
            let rise = height(x) - height(last) + (x * x) as i64 - (last * last) as i64;
            // The new parabola is strictly lower from here on; in integers, so that the result is exact.
            let meet = rise.div_euclid(2 * (x - last) as i64) + 1;
            if meet <= last_from as i64 {
                envelope.pop();
                continue;
            }
            from = meet as usize;
            break;
        }
        if from < found.len() {
            envelope.push((x, from));
        }
    }
    let mut current = 0;
    (0..found.len()).map(move |x| {
        while envelope.get(current + 1).is_some_and(|&(_, from)| from <= x) {
            current += 1;
        }
        envelope.get(current).map_or(0, |&(column, _)| column)
    })
}

/// Piecewise linear interpolation from one set of positions, for any number of value sets.
///
/// The triangulation, and which triangle holds which pixel, is computed once. Outside the hull of the points, and everywhere
/// if they lie on one line, the value is that of the nearest point. Of several points at one position the first counts.
#[derive(Debug)]
pub(crate) struct Interpolator {
    mesh: Mesh,
}

impl Interpolator {
    /// Triangulates `points` (x, y in pixels, fractions allowed, also outside the frame) for a frame of this size.
    ///
    /// # Errors
    /// [`Error::NoMeasurement`](crate::error::Error::NoMeasurement) without points,
    /// [`Error::Argument`](crate::error::Error::Argument) for a coordinate that is not finite,
    /// [`Error::ImageSize`](crate::error::Error::ImageSize) for an empty or absurdly large frame.
    pub(crate) fn new(points: &[(f32, f32)], width: usize, height: usize) -> Result<Self> {
        Ok(Self { mesh: Mesh::new(points, width, height)? })
    }

    /// The value at any position, in the unit of `values` (one per point, in the order of the points).
    ///
    /// NaN for a position that is not finite, and where the values needed are absent or NaN.
    #[cfg(any(feature = "train", test))]
    pub(crate) fn at(&self, x: f32, y: f32, values: &[f32]) -> f32 {
        if !(x.is_finite() && y.is_finite()) {
            return f32::NAN;
        }
        let position = [f64::from(x), f64::from(y)];
        match self.mesh.locate(position) {
            Owner::Site(site) => self.value(site, values),
            Owner::Triangle(triangle) => {
                let corners = self.mesh.triangles[triangle];
                match corners.iter().find(|&&s| self.mesh.sites[s as usize] == position) {
                    Some(&site) => self.value(site as usize, values),
                    None => self.plane(triangle, values).at(position[0], position[1]),
                }
            }
        }
    }

    /// The values at all pixel centres (integer coordinates) of the frame, row-major, `width * height`.
    ///
    /// A point that lies on a pixel gives that pixel its value bit for bit. NaN where the values needed are absent or NaN.
    pub(crate) fn raster(&self, values: &[f32]) -> Vec<f32> {
        let mut out = vec![0.0; self.mesh.width * self.mesh.height];
        self.paint(values, &mut out);
        out
    }

    /// The points whose values make the value at a pixel of the frame, with their weights, which sum to 1.
    pub(crate) fn weights_at(&self, x: usize, y: usize) -> [(usize, f32); 3] {
        let point = |site: usize| self.mesh.origin[site];
        match self.mesh.owner(x, y) {
            Owner::Site(site) => [(point(site), 1.0), (point(site), 0.0), (point(site), 0.0)],
            Owner::Triangle(triangle) => {
                let (p, corners) = ([x as f64, y as f64], self.mesh.corners(triangle));
                let area = cross(corners[0], corners[1], corners[2]);
                let sites = self.mesh.triangles[triangle];
                std::array::from_fn(|i| {
                    let part = cross(corners[(i + 1) % 3], corners[(i + 2) % 3], p) / area;
                    (point(sites[i] as usize), part.clamp(0.0, 1.0) as f32)
                })
            }
        }
    }

    fn paint(&self, values: &[f32], out: &mut [f32]) {
        let planes: Vec<Plane> = (0..self.mesh.triangles.len()).map(|t| self.plane(t, values)).collect();
        out.par_chunks_mut(self.mesh.width).enumerate().for_each(|(y, row)| {
            for ((x, pixel), owner) in row.iter_mut().enumerate().zip(self.mesh.owner_row(y)) {
                *pixel = match owner {
                    Owner::Triangle(t) => planes[t].at(x as f64, y as f64),
                    Owner::Site(s) => self.value(s, values),
                };
            }
        });
        for (pixel, site) in self.mesh.pixel_sites() {
            out[pixel] = self.value(site, values);
        }
    }

    fn value(&self, site: usize, values: &[f32]) -> f32 {
        values.get(self.mesh.origin[site]).copied().unwrap_or(f32::NAN)
    }

    fn plane(&self, triangle: usize, values: &[f32]) -> Plane {
        let corner_values = self.mesh.triangles[triangle].map(|s| self.value(s as usize, values));
        Plane::through(self.mesh.corners(triangle), corner_values)
    }
}

/// The linear function over one triangle, with the range of its corner values.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Plane {
    base: f64,
    dx: f64,
    dy: f64,
    low: f32,
    high: f32,
}

impl Plane {
    pub(crate) fn through(corners: [[f64; 2]; 3], values: [f32; 3]) -> Self {
        let [a, b, c] = corners;
        let [va, vb, vc] = values.map(f64::from);
        let area = cross(a, b, c);
        let dx = ((vb - va) * (c[1] - a[1]) - (vc - va) * (b[1] - a[1])) / area;
        let dy = ((vc - va) * (b[0] - a[0]) - (vb - va) * (c[0] - a[0])) / area;
        let low = values[0].min(values[1]).min(values[2]);
        let high = values[0].max(values[1]).max(values[2]);
        Self { base: va - dx * a[0] - dy * a[1], dx, dy, low, high }
    }

    /// Value at a position inside the triangle; never outside the range of the corners, NaN if one of them is NaN.
    pub(crate) fn at(&self, x: f64, y: f64) -> f32 {
        let value = (self.base + self.dx * x + self.dy * y) as f32;
        // Not `clamp`, which panics on a NaN bound, nor `max`, which would hide a NaN value.
        if value < self.low {
            self.low
        } else if value > self.high {
            self.high
        } else {
            value
        }
    }

    /// Value at any position, also outside the triangle.
    pub(crate) fn extend(&self, x: f64, y: f64) -> f64 {
        self.base + self.dx * x + self.dy * y
    }
}

#[cfg(test)]
mod tests;
