//! From the pixels that were answered to a map with a value at every pixel.

mod fill;
mod median;
mod surfaces;

pub use fill::{Answered, Fill, FillInput, Filled};
pub use median::MedianFilter;
pub use surfaces::EdgeAwareFill;

use rayon::prelude::*;

use crate::depth::pixels::{faces_a_hole, is_valid, pixel_count};
use crate::error::{Error, Result};
use surfaces::Surfaces;

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
mod median_tests;
#[cfg(test)]
mod tests;
