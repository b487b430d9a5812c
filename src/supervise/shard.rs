//! Training records on disk: questions about rendered frames with their answers, as a trainer reads them.
//!
//! A shard is a safetensors file of `n` frames of one size with `v` variants each: a variant is one set of measurements
//! with the questions about it. Numbers are in number units ([`crate::query::number::DepthUnit`]) unless metres are named;
//! integers and floats are little endian, as the format has it.
//!
//! | tensor | type, shape | |
//! |---|---|---|
//! | `rgb` | u8 `[n, h, w, 3]` | the frame as the encoder reads it |
//! | `seed` | u64 `[n]` | seed of the scene |
//! | `unit` | f32 `[n, v]` | metres per number unit |
//! | `scale` | f32 `[n, v]` | what errors are counted in |
//! | `measured_start` | u32 `[n v + 1]` | where a variant's entries of the next two begin, and the last one's end |
//! | `measured_pixel` | u32 `[m]` | `y w + x` of each measurement that the fusion block sees |
//! | `measured_value` | f32 `[m]` | what the fusion block sees of it |
//! | `told_count` | u16 `[n, v]` | measurements in the prompt |
//! | `told_id`, `told_x`, `told_y` | u16 `[n, v, p]` | their token and pixel, in the order of the prompt; 0 after the last one |
//! | `interpolated` | f32 `[n, v, h / 4, w / 4]` | what interpolation gives at the middle of each 4x4 pixels |
//! | `asked_id`, `asked_x`, `asked_y` | u16 `[n, v, q]` | a question's token (its hint as a number) and pixel |
//! | `asked_hint` | f32 `[n, v, q]` | the hint |
//! | `asked_value` | f32 `[n, v, q]` | the true answer; NaN where it is not known |
//!
//! A token is told by its id, or by its row where number tokens are rows of their own ([`NumberTokens::Rows`] in the settings).
//! The file's metadata holds [`About`] as JSON under `sdim_records`.

use super::batch::{Asking, Example, Item};
use super::tensor_file::{Reader, bytes, write};
use crate::depth::SparseDepth;
use crate::error::{Error, Result};
use crate::model::CELL;
use crate::query::prompt::{FrameSpace, MEASURED_TIME, QUERY_TIME, Tokens};
use crate::query::{NumberTokens, Settings};
use crate::vlm::qwen2_5::grid::Grid;
use crate::vlm::qwen2_5::preprocess::Pixels;
use crate::vlm::qwen2_5::token_table::FIRST_ADDED;
use image::RgbImage;
use safetensors::tensor::Dtype;
use std::path::Path;

/// The version of the format that this crate writes and reads.
pub const VERSION: u32 = 3;
/// The metadata's key.
const KEY: &str = "sdim_records";

/// What a shard's metadata say.
#[derive(Debug, Clone, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct About {
    /// [`VERSION`].
    pub version: u32,
    /// Version of the crate that drew the scenes.
    pub sdim: String,
    /// Which shard of its set.
    pub index: u64,
    /// How the set was drawn: a [`super::records::RecordConfig`] of the crate that wrote it, which no reader needs.
    pub config: serde_json::Value,
    /// `sdim.json` of the checkpoints that can read it.
    pub settings: Settings,
}

/// Sizes of a shard's tensors.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Dims {
    /// Frames (`n`).
    pub frames: usize,
    /// Variants per frame (`v`).
    pub variants: usize,
    /// Width of the frames, pixels (`w`).
    pub width: usize,
    /// Height of the frames, pixels (`h`).
    pub height: usize,
    /// Room for measurements in a prompt (`p`).
    pub told: usize,
    /// Questions per variant (`q`).
    pub asked: usize,
}

/// A shard in memory; the tensors are those of the module's table.
#[derive(Debug, Clone, PartialEq)]
#[allow(missing_docs)]
pub struct Shard {
    pub about: About,
    pub dims: Dims,
    pub rgb: Vec<u8>,
    pub seed: Vec<u64>,
    pub unit: Vec<f32>,
    pub scale: Vec<f32>,
    pub measured_start: Vec<u32>,
    pub measured_pixel: Vec<u32>,
    pub measured_value: Vec<f32>,
    pub told_count: Vec<u16>,
    pub told_id: Vec<u16>,
    pub told_x: Vec<u16>,
    pub told_y: Vec<u16>,
    pub interpolated: Vec<f32>,
    pub asked_id: Vec<u16>,
    pub asked_x: Vec<u16>,
    pub asked_y: Vec<u16>,
    pub asked_hint: Vec<f32>,
    pub asked_value: Vec<f32>,
}

impl Shard {
    /// An empty shard of these sizes.
    pub(super) fn new(about: About, dims: Dims) -> Self {
        let (f32s, u16s) = (Vec::<f32>::new, Vec::<u16>::new);
        Self {
            about,
            dims: Dims { frames: 0, ..dims },
            rgb: Vec::with_capacity(dims.frames * dims.height * dims.width * 3),
            seed: Vec::new(),
            unit: f32s(),
            scale: f32s(),
            measured_start: vec![0],
            measured_pixel: Vec::new(),
            measured_value: f32s(),
            told_count: u16s(),
            told_id: u16s(),
            told_x: u16s(),
            told_y: u16s(),
            interpolated: f32s(),
            asked_id: u16s(),
            asked_x: u16s(),
            asked_y: u16s(),
            asked_hint: f32s(),
            asked_value: f32s(),
        }
    }

    /// Puts one frame with its variants to the shard.
    ///
    /// # Errors
    /// [`Error::Argument`] if it has other sizes, or questions of more than one token.
    pub(super) fn push(&mut self, seed: u64, variants: &[Example]) -> Result<()> {
        let d = self.dims;
        let pixels = (d.width as u32, d.height as u32);
        let fits = |e: &Example| e.pixels.resized.dimensions() == pixels && e.items.len() == d.asked;
        let Some(first) =
            variants.first().filter(|_| variants.len() == d.variants && variants.iter().all(fits))
        else {
            return Err(Error::argument("examples", variants.len(), format!("those of {d:?}")));
        };
        self.seed.push(seed);
        self.rgb.extend_from_slice(first.pixels.resized.as_raw());
        for example in variants {
            self.push_variant(example)?;
        }
        self.dims.frames += 1;
        Ok(())
    }

    fn push_variant(&mut self, example: &Example) -> Result<()> {
        self.unit.push(example.unit);
        self.scale.push(example.scale());
        for (pixel, value) in example.measured() {
            self.measured_pixel.push(pixel);
            self.measured_value.push(value);
        }
        self.measured_start.push(self.measured_pixel.len() as u32);
        let told = &example.prefix.glimpses;
        if told.len() > self.dims.told {
            return Err(Error::argument(
                "measurements told",
                told.len(),
                format!("at most {}", self.dims.told),
            ));
        }
        self.told_count.push(told.len() as u16);
        for i in 0..self.dims.told {
            let (id, x, y) = told.get(i).map_or((0, 0.0, 0.0), |g| (example.prefix.ids[g.token], g.x, g.y));
            self.told_id.push((id % FIRST_ADDED) as u16);
            self.told_x.push(x.round() as u16);
            self.told_y.push(y.round() as u16);
        }
        self.interpolated.extend(&example.interpolated);
        for item in &example.items {
            let ([id], [at], 1) = (&item.tokens.ids[..], &item.tokens.glimpses[..], item.supervised) else {
                let found = format!("{} tokens, {} in the answer", item.tokens.len(), item.supervised);
                return Err(Error::argument("question", found, "one token at a pixel, one in the answer"));
            };
            self.asked_id.push((*id % FIRST_ADDED) as u16);
            self.asked_x.push(at.x.round() as u16);
            self.asked_y.push(at.y.round() as u16);
            self.asked_hint.push(item.hint);
            self.asked_value.push(item.value);
        }
        Ok(())
    }

    /// Writes the shard whole or not at all.
    ///
    /// # Errors
    /// [`Error::Io`].
    pub fn write(&self, path: &Path) -> Result<()> {
        let d = self.dims;
        let (variants, told) = (vec![d.frames, d.variants], vec![d.frames, d.variants, d.told]);
        let (asked, measured) = (vec![d.frames, d.variants, d.asked], vec![self.measured_pixel.len()]);
        let cells = [d.frames, d.variants, d.height / CELL, d.width / CELL];
        let (f32s, u16s) = (|v: &[f32]| bytes(v, f32::to_le_bytes), |v: &[u16]| bytes(v, u16::to_le_bytes));
        let u32s = |v: &[u32]| bytes(v, u32::to_le_bytes);
        let parts: [(&str, Dtype, &[usize], Vec<u8>); 17] = [
            ("rgb", Dtype::U8, &[d.frames, d.height, d.width, 3], self.rgb.clone()),
            ("seed", Dtype::U64, &[d.frames], bytes(&self.seed, u64::to_le_bytes)),
            ("unit", Dtype::F32, &variants, f32s(&self.unit)),
            ("scale", Dtype::F32, &variants, f32s(&self.scale)),
            ("measured_start", Dtype::U32, &[self.measured_start.len()], u32s(&self.measured_start)),
            ("measured_pixel", Dtype::U32, &measured, u32s(&self.measured_pixel)),
            ("measured_value", Dtype::F32, &measured, f32s(&self.measured_value)),
            ("told_count", Dtype::U16, &variants, u16s(&self.told_count)),
            ("told_id", Dtype::U16, &told, u16s(&self.told_id)),
            ("told_x", Dtype::U16, &told, u16s(&self.told_x)),
            ("told_y", Dtype::U16, &told, u16s(&self.told_y)),
            ("interpolated", Dtype::F32, &cells, f32s(&self.interpolated)),
            ("asked_id", Dtype::U16, &asked, u16s(&self.asked_id)),
            ("asked_x", Dtype::U16, &asked, u16s(&self.asked_x)),
            ("asked_y", Dtype::U16, &asked, u16s(&self.asked_y)),
            ("asked_hint", Dtype::F32, &asked, f32s(&self.asked_hint)),
            ("asked_value", Dtype::F32, &asked, f32s(&self.asked_value)),
        ];
        write(path, KEY, &self.about, &parts)
    }

    /// Reads a shard.
    ///
    /// # Errors
    /// [`Error::Io`]; [`Error::Format`] if it is no shard of this version; [`Error::Tensor`] if a tensor is missing or
    /// has another type or shape, or an entry is out of range.
    pub fn read(path: &Path) -> Result<Self> {
        let file = std::fs::read(path).map_err(Error::io(path))?;
        let (about, reader) = Reader::open(path, &file, KEY, "records", VERSION)?;
        let [n, height, width, _] = reader.shape("rgb")?;
        let [_, variants, told] = reader.shape("told_id")?;
        let [_, _, asked] = reader.shape("asked_id")?;
        let [measured] = reader.shape("measured_pixel")?;
        let dims = Dims { frames: n, variants, width, height, told, asked };
        let (nv, nvp, nvq) = ([n, variants], [n, variants, told], [n, variants, asked]);
        let f32s = |name: &str, shape: &[usize]| reader.take(name, Dtype::F32, shape, f32::from_le_bytes);
        let u16s = |name: &str, shape: &[usize]| reader.take(name, Dtype::U16, shape, u16::from_le_bytes);
        let u32s = |name: &str, length: usize| reader.take(name, Dtype::U32, &[length], u32::from_le_bytes);
        let shard = Self {
            about,
            dims,
            rgb: reader.take("rgb", Dtype::U8, &[n, height, width, 3], u8::from_le_bytes)?,
            seed: reader.take("seed", Dtype::U64, &[n], u64::from_le_bytes)?,
            unit: f32s("unit", &nv)?,
            scale: f32s("scale", &nv)?,
            measured_start: u32s("measured_start", n.saturating_mul(variants).saturating_add(1))?,
            measured_pixel: u32s("measured_pixel", measured)?,
            measured_value: f32s("measured_value", &[measured])?,
            told_count: u16s("told_count", &nv)?,
            told_id: u16s("told_id", &nvp)?,
            told_x: u16s("told_x", &nvp)?,
            told_y: u16s("told_y", &nvp)?,
            interpolated: f32s("interpolated", &[n, variants, height / CELL, width / CELL])?,
            asked_id: u16s("asked_id", &nvq)?,
            asked_x: u16s("asked_x", &nvq)?,
            asked_y: u16s("asked_y", &nvq)?,
            asked_hint: f32s("asked_hint", &nvq)?,
            asked_value: f32s("asked_value", &nvq)?,
        };
        shard.check_entries(&reader)?;
        Ok(shard)
    }

    /// What types and shapes do not say: every index lies inside of what it points into.
    fn check_entries(&self, reader: &Reader) -> Result<()> {
        let d = self.dims;
        let check = |ok: bool, name: &str, expected: &str| {
            if ok { Ok(()) } else { Err(reader.wrong(name, "an entry out of range", expected)) }
        };
        reader.check_starts("measured_start", &self.measured_start, self.measured_pixel.len())?;
        let pixels = d.width * d.height;
        let inside = self.measured_pixel.iter().all(|&p| (p as usize) < pixels);
        check(inside, "measured_pixel", "pixels of the frame")?;
        let fewer = self.told_count.iter().all(|&c| usize::from(c) <= d.told);
        check(fewer, "told_count", "at most the room for measurements")?;
        for (name, list, end) in [
            ("told_x", &self.told_x, d.width),
            ("told_y", &self.told_y, d.height),
            ("asked_x", &self.asked_x, d.width),
            ("asked_y", &self.asked_y, d.height),
        ] {
            check(list.iter().all(|&c| usize::from(c) < end), name, "pixels of the frame")?;
        }
        Ok(())
    }

    /// One frame's variant, as the crate's own trainer reads it.
    ///
    /// # Errors
    /// [`Error::Argument`] if there is none of it, or the checkpoint that asks writes its numbers otherwise.
    pub fn example(&self, asking: Asking, frame: usize, variant: usize) -> Result<Example> {
        let d = self.dims;
        if frame >= d.frames || variant >= d.variants {
            let found = format!("{frame}, variant {variant}");
            return Err(Error::argument(
                "frame",
                found,
                format!("{} frames, {} variants", d.frames, d.variants),
            ));
        }
        if asking.prompts.settings().of_the_shape() != self.about.settings {
            return Err(Error::argument("sdim.json", "another one", "that of the records"));
        }
        let at = frame * d.variants + variant;
        let area = d.width * d.height;
        let mut scattered = vec![0f32; area];
        for i in self.measured_start[at] as usize..self.measured_start[at + 1] as usize {
            scattered[self.measured_pixel[i] as usize] = self.measured_value[i];
        }
        let vision = &asking.config.vision;
        let grid = Grid { height: d.height / vision.patch_size, width: d.width / vision.patch_size };
        // A frame whose one measurement is a unit, and is not told: what stands before the measurements.
        let (size, unit) = ((d.width, d.height), self.unit[at]);
        let one = SparseDepth::from_points(d.width, d.height, &[(0, 0, unit)])?;
        let (mut prefix, space) = asking.prompts.prefix_of(&one, 0, grid, size, asking.config, 0)?;
        let place = |x: &[u16], y: &[u16], i: usize| (usize::from(x[i]), usize::from(y[i]));
        for i in (0..usize::from(self.told_count[at])).map(|i| at * d.told + i) {
            let pixel = place(&self.told_x, &self.told_y, i);
            let id = self.token(self.told_id[i]);
            prefix.push_at(&[id], asking.prompts.numbers(), pixel, MEASURED_TIME, &space);
        }
        let items = (at * d.asked..(at + 1) * d.asked).map(|i| self.item(asking, &space, at, i)).collect();
        let rgb = self.rgb[frame * area * 3..][..area * 3].to_vec();
        let resized = RgbImage::from_raw(d.width as u32, d.height as u32, rgb)
            .ok_or_else(|| Error::argument("frame", format!("{}x{}", d.width, d.height), "a picture"))?;
        let cells = (d.width / CELL) * (d.height / CELL);
        let interpolated = self.interpolated[at * cells..][..cells].to_vec();
        Ok(Example { pixels: Pixels { resized, grid }, scattered, interpolated, unit, prefix, items })
    }

    /// The id of a token that the records tell.
    fn token(&self, told: u16) -> u32 {
        match self.about.settings.number_tokens {
            NumberTokens::Vocabulary => told.into(),
            NumberTokens::Rows => FIRST_ADDED + u32::from(told),
        }
    }

    fn item(&self, asking: Asking, space: &FrameSpace, at: usize, i: usize) -> Item {
        let mut tokens = Tokens::default();
        let pixel = (usize::from(self.asked_x[i]), usize::from(self.asked_y[i]));
        let id = self.token(self.asked_id[i]);
        tokens.push_at(&[id], asking.prompts.numbers(), pixel, QUERY_TIME, space);
        let value = self.asked_value[i];
        let answer = asking.prompts.numbers().write(value);
        let (hint, scale) = (self.asked_hint[i], self.scale[at]);
        Item { tokens, supervised: 1, answer, value, hint, scale }
    }
}
