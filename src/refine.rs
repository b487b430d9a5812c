//! From the pixels that were answered to a map with a value at every pixel.

mod surfaces;

use image::RgbImage;
use rayon::prelude::*;

use crate::depth::{SparseDepth, faces_a_hole, is_valid, pixel_count};
use crate::error::{Error, Result};
use surfaces::Surfaces;

/// What the model said about one pixel.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Answered {
    /// Column.
    pub x: usize,
    /// Row.
    pub y: usize,
    /// Z-depth, metres. NaN, infinite, 0 or negative: no readable answer, the pixel is filled like one not asked.
    pub depth: f32,
    /// 0..=1, higher is surer.
    pub confidence: f32,
    /// Expected absolute error, metres.
    pub expected_error: f32,
}

/// All that a [`Fill`] may look at.
#[derive(Debug, Clone, Copy)]
pub struct FillInput<'a> {
    /// Width of the frame, pixels.
    pub width: usize,
    /// Height of the frame, pixels.
    pub height: usize,
    /// The frame.
    pub rgb: &'a RgbImage,
    /// The answers, in any order. Of several for one pixel the last counts.
    pub asked: &'a [Answered],
    /// The measurements; they count as answers with confidence 1 and outrank the model's.
    pub sparse: &'a SparseDepth,
}

/// A value per pixel, row-major.
///
/// Every pixel is filled if there is at least one answer or measurement; otherwise depth and expected error are NaN and
/// confidence is 0 everywhere.
#[derive(Debug, Clone)]
pub struct Filled {
    /// Z-depth, metres.
    pub depth: Vec<f32>,
    /// 0..=1, higher is surer.
    pub confidence: Vec<f32>,
    /// Expected absolute error, metres.
    pub expected_error: Vec<f32>,
}

/// A way to fill the pixels that were not asked.
pub trait Fill: Send + Sync {
    /// Fills a frame. Answered and measured pixels keep their values bit for bit.
    ///
    /// # Errors
    /// [`Error::SizeMismatch`], [`Error::ImageSize`] for an empty frame, [`Error::Argument`] for an answer outside the frame or
    /// with a confidence or expected error out of range.
    fn fill(&self, input: &FillInput) -> Result<Filled>;
}

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
        Self { edge_ratio: 0.08, colour_sigma: 20.0 }
    }
}

impl Fill for EdgeAwareFill {
    fn fill(&self, input: &FillInput) -> Result<Filled> {
        self.check()?;
        let mut filled = gather(input)?;
        let sites = rim(&filled.depth, input.width, input.height);
        if sites.is_empty() {
            return Ok(filled);
        }
        let surfaces = Surfaces::new(self, input, &filled, &sites)?;
        let width = input.width;
        let rows = filled.depth.par_chunks_mut(width);
        let rows = rows
            .zip(filled.confidence.par_chunks_mut(width))
            .zip(filled.expected_error.par_chunks_mut(width));
        rows.enumerate().for_each(|(y, ((depth, confidence), error))| {
            for (x, owner) in
                surfaces.mesh.owner_row(y).enumerate().filter(|(x, _)| depth[*x].is_nan()).collect::<Vec<_>>()
            {
                let value = surfaces.at(x, y, owner);
                (depth[x], confidence[x], error[x]) = (value.depth, value.confidence, value.error);
            }
        });
        Ok(filled)
    }
}

impl EdgeAwareFill {
    fn check(&self) -> Result<()> {
        for (name, value) in [("edge_ratio", self.edge_ratio), ("colour_sigma", self.colour_sigma)] {
            if !(value.is_finite() && value > 0.0) {
                return Err(Error::argument(name, value, "a finite number above 0"));
            }
        }
        Ok(())
    }
}

/// Answers and measurements at their pixels, NaN depth elsewhere.
fn gather(input: &FillInput) -> Result<Filled> {
    let (width, height) = (input.width, input.height);
    let pixels = pixel_count(width, height)?;
    let rgb = (input.rgb.width() as usize, input.rgb.height() as usize);
    for depth in [(width, height), (input.sparse.width(), input.sparse.height())] {
        if depth != rgb {
            return Err(Error::SizeMismatch { rgb, depth });
        }
    }
    let mut filled = Filled {
        depth: vec![f32::NAN; pixels],
        confidence: vec![0.0; pixels],
        expected_error: vec![f32::NAN; pixels],
    };
    let measured = input.sparse.points().map(|(x, y, depth)| Answered {
        x,
        y,
        depth,
        confidence: 1.0,
        expected_error: 0.0,
    });
    for answer in input.asked.iter().copied().chain(measured) {
        check_answer(&answer, width, height)?;
        if is_valid(answer.depth) {
            let pixel = answer.y * width + answer.x;
            filled.depth[pixel] = answer.depth;
            filled.confidence[pixel] = answer.confidence;
            filled.expected_error[pixel] = answer.expected_error;
        }
    }
    Ok(filled)
}

fn check_answer(answer: &Answered, width: usize, height: usize) -> Result<()> {
    let &Answered { x, y, depth, confidence, expected_error } = answer;
    if x >= width || y >= height {
        return Err(Error::argument(
            "answer",
            format!("({x}, {y})"),
            format!("x below {width} and y below {height}"),
        ));
    }
    if is_valid(depth)
        && !((0.0..=1.0).contains(&confidence) && expected_error.is_finite() && expected_error >= 0.0)
    {
        let found =
            format!("confidence {confidence} and expected error {expected_error} at pixel ({x}, {y})");
        return Err(Error::argument(
            "answer",
            found,
            "a confidence in 0..=1 and a finite error of at least 0 m",
        ));
    }
    Ok(())
}

/// Answered pixels with an unanswered one among their eight neighbours. Only they can touch a pixel that is to be filled, so a
/// frame that was asked densely costs little.
fn rim(depth: &[f32], width: usize, height: usize) -> Vec<usize> {
    let at_a_hole = |&pixel: &usize| {
        !depth[pixel].is_nan() && faces_a_hole(depth, width, height, pixel % width, pixel / width)
    };
    (0..depth.len()).into_par_iter().filter(at_a_hole).collect()
}

#[cfg(test)]
mod tests;
