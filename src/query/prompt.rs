//! From a frame to tokens: the shared prefix, and one suffix per asked pixel.

use super::number::{NumberFormat, Numbers};
use super::settings::{MeasurementPrompt, PixelReference, Settings};
use super::told::told;
use crate::depth::SparseDepth;
use crate::error::{Error, Result};
use crate::vlm::chat::tokenizer::Tokenizer;
use crate::vlm::qwen2_5::config::VlmConfig;
use crate::vlm::qwen2_5::grid::Grid;
use crate::vlm::qwen2_5::positions::positions;
use crate::vlm::qwen2_5::rope::Position;

/// Ids and positions of a run of tokens.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Tokens {
    /// Token ids.
    pub ids: Vec<u32>,
    /// M-RoPE positions.
    pub positions: Vec<Position>,
    /// Tokens that stand at a pixel.
    pub glimpses: Vec<Glimpse>,
}

/// A token at a pixel, to which the crop around that pixel may be added.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Glimpse {
    /// Index of the token.
    pub token: usize,
    /// Column in the resized image, fractional.
    pub x: f32,
    /// Row in the resized image, fractional.
    pub y: f32,
    /// What the token says of the pixel's depth, in number units; NaN if it states no number.
    pub stated: f32,
}

impl Tokens {
    /// Cuts off what stands before the image: the tokens before index `at` and those from it on.
    pub(crate) fn split(mut self, at: usize) -> (Self, Self) {
        let mut rest = Self {
            ids: self.ids.split_off(at),
            positions: self.positions.split_off(at),
            glimpses: self.glimpses.iter().filter(|g| g.token >= at).copied().collect(),
        };
        rest.glimpses.iter_mut().for_each(|g| g.token -= at);
        self.glimpses.retain(|g| g.token < at);
        (self, rest)
    }

    fn push(&mut self, id: u32, position: Position) {
        self.ids.push(id);
        self.positions.push(position);
    }

    /// Tokens that say a number at a pixel; the first one carries the crop.
    pub(crate) fn push_at(
        &mut self,
        ids: &[u32],
        numbers: &Numbers,
        (x, y): (usize, usize),
        time: f32,
        space: &FrameSpace,
    ) {
        self.glimpses.push(Glimpse {
            token: self.len(),
            x: centre(x, space.width, space.resized.0),
            y: centre(y, space.height, space.resized.1),
            stated: ids.first().map_or(f32::NAN, |&id| numbers.stated(id)),
        });
        let position = space.pixel(x, y, time);
        ids.iter().for_each(|&id| self.push(id, position));
    }

    /// Position of a text token that follows this suffix: tokens at pixels do not count, they stand elsewhere.
    pub fn next_text(&self, space: &FrameSpace) -> f32 {
        let mut texts = self.positions.iter().filter(|p| p.t == p.h && p.h == p.w && p.t >= space.next);
        texts.next_back().map_or(space.next, |p| p.t + 1.0)
    }

    /// Number of tokens.
    pub fn len(&self) -> usize {
        self.ids.len()
    }

    /// Whether there is none.
    pub fn is_empty(&self) -> bool {
        self.ids.is_empty()
    }
}

/// Where a frame's pixels lie in the position space, and what its numbers mean.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FrameSpace {
    /// Frame size, pixels.
    pub width: usize,
    /// Frame size, pixels.
    pub height: usize,
    /// Size of the resized image, pixels.
    pub resized: (usize, usize),
    /// Rows and columns of merged tokens.
    pub merged: (usize, usize),
    /// Position of the image's first row and column.
    pub image_start: f32,
    /// Position units per merged token.
    pub position_scale: f32,
    /// Position of the text token that follows the prefix.
    pub next: f32,
    /// Metres of the number 1 in this frame, as [`PromptWriter::unit`] gives them. Depths in metres are divided by it where they become
    /// numbers of a prompt; `model::ask` multiplies answers by it.
    pub unit: f32,
}

/// Time offset of a measurement and of a query from the image's own time, where they stand at a pixel.
pub(crate) const MEASURED_TIME: f32 = 1.0;
pub(crate) const QUERY_TIME: f32 = 2.0;

/// Where a pixel's centre falls on a coarser axis: 0 is the centre of its first cell.
fn centre(p: usize, size: usize, cells: usize) -> f32 {
    (p as f32 + 0.5) / size as f32 * cells as f32 - 0.5
}

impl FrameSpace {
    /// The M-RoPE position of a pixel's centre: fractional, in the units in which the image tokens count.
    fn pixel(&self, x: usize, y: usize, time: f32) -> Position {
        let along = |p: usize, size: usize, cells: usize| {
            self.image_start + centre(p, size, cells) * self.position_scale
        };
        Position {
            t: self.image_start + time,
            h: along(y, self.height, self.merged.0),
            w: along(x, self.width, self.merged.1),
        }
    }
}

/// One pixel to ask for.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Query {
    /// Column.
    pub x: usize,
    /// Row.
    pub y: usize,
    /// The measurement that the prompt may state, metres.
    pub measured: Option<f32>,
    /// The guess that the pointer may state, metres.
    pub hint: f32,
}

/// Writes the prompts of one checkpoint.
pub struct PromptWriter {
    settings: Settings,
    numbers: Numbers,
    before_image: Vec<u32>,
    after_image: Vec<u32>,
    /// The query's text around `{pixel}` (and `{mask}`), as pieces.
    pieces: Vec<Piece>,
    forced: Vec<u32>,
    pointer: Option<u32>,
}

enum Piece {
    Text(Vec<u32>),
    Words(String),
    Pointer,
}

impl PromptWriter {
    /// Looks up every token that the template needs.
    ///
    /// # Errors
    /// [`crate::Error::Tokenizer`] names a token that the vocabulary lacks.
    pub fn new(settings: &Settings, tokenizer: &Tokenizer) -> Result<Self> {
        let t = &settings.template;
        let pointer = match &settings.pixel_reference {
            PixelReference::Pointer { token } => Some(tokenizer.id(token)?),
            PixelReference::Coordinates | PixelReference::Marker(_) => None,
        };
        let mut writer = Self {
            numbers: Numbers::new(settings.number, settings.number_tokens, tokenizer)?,
            before_image: tokenizer.encode(&t.before_image)?,
            after_image: tokenizer.encode(&t.after_image)?,
            pieces: Vec::new(),
            forced: tokenizer.encode(t.forced())?,
            pointer,
            settings: settings.clone(),
        };
        writer.pieces = writer.split(tokenizer)?;
        Ok(writer)
    }

    /// Text that is the same for each query is encoded once; where words depend on the pixel, the text around them is
    /// encoded with them, since a tokenizer may join across the seam.
    fn split(&self, tokenizer: &Tokenizer) -> Result<Vec<Piece>> {
        let query = &self.settings.template.query;
        let words = self.settings.pixel_reference == PixelReference::Coordinates || query.contains("{mask}");
        let piece = |text: &str| -> Result<Piece> {
            Ok(if words { Piece::Words(text.to_string()) } else { Piece::Text(tokenizer.encode(text)?) })
        };
        if self.pointer.is_none() {
            return Ok(vec![piece(query)?]);
        }
        let (left, right) = query.split_once("{pixel}").unwrap_or((query.as_str(), ""));
        Ok(vec![piece(left)?, Piece::Pointer, piece(right)?])
    }

    /// The numbers of this checkpoint.
    pub fn numbers(&self) -> &Numbers {
        &self.numbers
    }

    /// The settings of this checkpoint.
    pub fn settings(&self) -> &Settings {
        &self.settings
    }

    /// Whether the words of a query state its own measurement.
    pub(crate) fn states_measurement(&self, query: &Query) -> bool {
        let t = &self.settings.template;
        self.settings.measurements == MeasurementPrompt::PerQuery
            && query.measured.is_some()
            && t.query.contains("{mask}")
            && t.mask_measured.contains("{x}")
    }

    /// Metres per number unit of a frame.
    pub fn unit(&self, sparse: &SparseDepth) -> f32 {
        self.settings.unit.metres_in(sparse)
    }

    /// What the fusion block sees of a measurement in metres, where the number 1 is `unit` metres.
    pub(crate) fn seen(&self, depth: f32, unit: f32) -> f32 {
        self.numbers.seen(depth / unit)
    }

    /// The shared prefix: text, image placeholders, text, measurements; and the frame's space.
    ///
    /// # Errors
    /// [`crate::Error::Argument`] if the template holds image placeholders of its own, or the grid no merged token.
    pub fn prefix(
        &self,
        sparse: &SparseDepth,
        grid: Grid,
        resized: (usize, usize),
        config: &VlmConfig,
        seed: u64,
    ) -> Result<(Tokens, FrameSpace)> {
        self.prefix_of(sparse, usize::MAX, grid, resized, config, seed)
    }

    /// As [`PromptWriter::prefix`], with at most `points` measurements if that is fewer than the settings allow.
    ///
    /// # Errors
    /// As [`PromptWriter::prefix`].
    pub fn prefix_of(
        &self,
        sparse: &SparseDepth,
        points: usize,
        grid: Grid,
        resized: (usize, usize),
        config: &VlmConfig,
        seed: u64,
    ) -> Result<(Tokens, FrameSpace)> {
        let merged = grid.merged(config.vision.merge_size);
        let mut ids = self.before_image.clone();
        ids.extend(std::iter::repeat_n(config.ids.image, merged.0 * merged.1));
        ids.extend(&self.after_image);
        let scale = self.settings.position_scale;
        let walked = positions(&ids, &[grid], config, scale)?;
        let Some(&image_start) = walked.image_starts.first() else {
            return Err(Error::argument("image tokens", 0, "at least one"));
        };
        let mut tokens = Tokens { ids, positions: walked.positions, glimpses: Vec::new() };
        let space = FrameSpace {
            width: sparse.width(),
            height: sparse.height(),
            resized,
            merged,
            image_start,
            position_scale: scale,
            next: walked.next,
            unit: self.unit(sparse),
        };
        if let MeasurementPrompt::Prefix { max } = self.settings.measurements {
            for (x, y, depth) in told(sparse, self.settings.unit, max.min(points), seed) {
                let ids = self.numbers.write_ids(depth / space.unit);
                tokens.push_at(&ids, &self.numbers, (x, y), MEASURED_TIME, &space);
            }
        }
        Ok((tokens, space))
    }

    /// The suffix of one query, up to and including the forced words of the answer.
    ///
    /// # Errors
    /// [`crate::Error::Tokenizer`] if the text cannot be encoded.
    pub fn suffix(&self, query: &Query, space: &FrameSpace, tokenizer: &Tokenizer) -> Result<Tokens> {
        self.tokens(query, space, tokenizer, true)
    }

    /// The suffix of one query, with or without the forced words of the answer.
    pub(crate) fn tokens(
        &self,
        query: &Query,
        space: &FrameSpace,
        tokenizer: &Tokenizer,
        forced: bool,
    ) -> Result<Tokens> {
        let mut out = Tokens::default();
        let mut p = space.next;
        let mut text = |out: &mut Tokens, ids: &[u32]| {
            for &id in ids {
                out.push(id, Position::text(p));
                p += 1.0;
            }
        };
        for piece in &self.pieces {
            match piece {
                Piece::Text(ids) => text(&mut out, ids),
                Piece::Words(words) => {
                    text(&mut out, &tokenizer.encode(&self.fill_in(words, query, space))?);
                }
                Piece::Pointer => {
                    let ids = match self.settings.hint {
                        super::Hint::Linear => self.numbers.write_ids(query.hint / space.unit),
                        super::Hint::None => self.pointer.into_iter().collect(),
                    };
                    out.push_at(&ids, &self.numbers, (query.x, query.y), QUERY_TIME, space);
                }
            }
        }
        if forced {
            text(&mut out, &self.forced);
        }
        if out.is_empty() {
            return Err(Error::config(
                "sdim.json",
                "template.query",
                "no token",
                "at least one token per query",
            ));
        }
        Ok(out)
    }

    fn fill_in(&self, words: &str, query: &Query, space: &FrameSpace) -> String {
        let t = &self.settings.template;
        let mask = match (self.settings.measurements, query.measured) {
            (MeasurementPrompt::PerQuery, Some(depth)) => {
                // As many decimals as the answer has.
                let decimals = match self.numbers.format {
                    NumberFormat::Digits { decimals, .. } => decimals,
                    NumberFormat::Bins { .. } | NumberFormat::LogBins { .. } => 3,
                };
                t.mask_measured.replace("{x}", &format!("{:.decimals$}", depth / space.unit))
            }
            _ => t.mask_missing.clone(),
        };
        let along = |p: usize, size: usize, resized: usize| {
            ((p as f32 + 0.5) * resized as f32 / size as f32) as usize
        };
        let pixel = t
            .coordinates
            .replace("{col}", &along(query.x, space.width, space.resized.0).to_string())
            .replace("{row}", &along(query.y, space.height, space.resized.1).to_string());
        words.replace("{mask}", &mask).replace("{pixel}", &pixel)
    }
}
