//! Token ids with image placeholders, and their M-RoPE positions.
//!
//! Two numbers with two names: the *number of tokens* read so far (a cache's length) and the *next position*, which after
//! an image advances by `max(rows, columns)` of its merged grid and not by its number of tokens.

use super::config::VlmConfig;
use super::grid::Grid;
use super::rope::Position;
use crate::error::{Error, Result};

/// Positions of a prompt.
#[derive(Debug, Clone, PartialEq)]
pub struct PromptPositions {
    /// One per token.
    pub positions: Vec<Position>,
    /// Position of the token that follows.
    pub next: f32,
    /// Position of the first row and column of each image.
    pub image_starts: Vec<f32>,
}

/// Walks the ids: text advances by one, an image by the larger side of its merged grid (times `scale`, 1 as published).
///
/// # Errors
/// [`Error::Argument`] if the placeholders are not exactly the tokens of the grids.
pub fn positions(ids: &[u32], grids: &[Grid], config: &VlmConfig, scale: f32) -> Result<PromptPositions> {
    let merge = config.vision.merge_size;
    let wanted: usize = grids.iter().map(|g| g.patches() / (merge * merge)).sum();
    let found = ids.iter().filter(|&&id| id == config.ids.image).count();
    if wanted != found {
        return Err(Error::argument(
            "image placeholders",
            found,
            format!("{wanted}, the merged patches of {} images", grids.len()),
        ));
    }
    let mut out =
        PromptPositions { positions: Vec::with_capacity(ids.len()), next: 0.0, image_starts: vec![] };
    let mut grids = grids.iter();
    let mut i = 0;
    while i < ids.len() {
        if ids[i] != config.ids.image {
            out.positions.push(Position::text(out.next));
            out.next += 1.0;
            i += 1;
            continue;
        }
        let run = ids[i..].iter().take_while(|&&id| id == config.ids.image).count();
        let (rows, cols) = match grids.next().map(|g| g.merged(merge)) {
            Some((rows, cols)) if run >= rows * cols => (rows, cols),
            _ => return Err(Error::argument("image placeholders", run, "one unbroken run per image")),
        };
        let start = out.next;
        for y in 0..rows {
            for x in 0..cols {
                let (h, w) = (start + y as f32 * scale, start + x as f32 * scale);
                out.positions.push(Position { t: start, h, w });
            }
        }
        out.image_starts.push(start);
        out.next += rows.max(cols) as f32 * scale;
        i += rows * cols;
    }
    Ok(out)
}
