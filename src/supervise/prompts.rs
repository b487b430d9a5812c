//! Whole prompts on disk: every token of questions about frames, its place and the answer, for whatever way of asking.
//!
//! Where [`super::shard`] holds `sdim-tiny`'s way of asking in few bytes, this holds any: words, digits, masks, several tokens per
//! number. Who reads it needs neither vocabulary nor template. A file has `n` frames of one size with `v` variants of `q` questions
//! each; numbers are in number units, integers and floats little endian.
//!
//! | tensor | type, shape | |
//! |---|---|---|
//! | `rgb` | u8 `[n, h, w, 3]` | the frame as the encoder reads it |
//! | `unit` | f32 `[n, v]` | metres per number unit |
//! | `scale` | f32 `[n, v]` | what errors are counted in |
//! | `measured_start` | u32 `[n v + 1]` | where a variant's entries of the next two begin, and the last one's end |
//! | `measured_pixel` | u32 `[m]` | `y w + x` of each measurement that the fusion block sees |
//! | `measured_value` | f32 `[m]` | what the fusion block sees of it |
//! | `prefix_start` | u32 `[n v + 1]` | the same for the next two |
//! | `prefix_id` | u32 `[a]` | tokens that all questions share, image tokens among them |
//! | `prefix_place` | f32 `[a, 5]` | time, row and column of M-RoPE; column and row of the pixel that it stands at, or NaN |
//! | `asked_start` | u32 `[n v q + 1]` | where a question's entries of the next two begin, and the last one's end |
//! | `asked_id`, `asked_place` | u32 `[b]`, f32 `[b, 5]` | a question's tokens, then those of its answer but the last one |
//! | `answer_start` | u32 `[n v q + 1]` | where an answer begins |
//! | `answer` | u32 `[c]` | the answer, as indices of the number rows; the last tokens of the question predict it |
//! | `asked_hint` | f32 `[n, v, q]` | what interpolation says |
//! | `asked_value` | f32 `[n, v, q]` | the true answer |
//!
//! The file's metadata holds [`PromptAbout`] as JSON under `sdim_prompts`.

use super::batch::{Asking, Example, Item};
use super::tensor_file::{Reader, bytes, write};
use crate::error::{Error, Result};
use crate::query::Settings;
use crate::query::prompt::{Glimpse, Tokens};
use crate::vlm::qwen2_5::grid::Grid;
use crate::vlm::qwen2_5::preprocess::Pixels;
use crate::vlm::qwen2_5::rope::Position;
use image::RgbImage;
use safetensors::tensor::Dtype;
use std::path::Path;

/// The version of the format that this crate writes and reads.
pub const PROMPTS_VERSION: u32 = 1;
/// The metadata's key.
const KEY: &str = "sdim_prompts";
/// Values of a token's place.
const PLACE: usize = 5;

/// What a file of prompts says of itself.
#[derive(Debug, Clone, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct PromptAbout {
    /// [`PROMPTS_VERSION`].
    pub version: u32,
    /// Version of the crate that wrote it.
    pub sdim: String,
    /// Which file of its set.
    pub index: u64,
    /// How the set was made: a [`super::records::RecordConfig`], which no reader needs.
    pub config: serde_json::Value,
    /// `sdim.json` of the checkpoints that can read it.
    pub settings: Settings,
    /// Names of the frames.
    pub frames: Vec<String>,
    /// Token ids of the number rows.
    pub numbers: Vec<u32>,
    /// Token id that an image token has in the prompt.
    pub image: u32,
}

/// A file of prompts in memory; the tensors are those of the module's table.
#[derive(Debug, Clone, PartialEq)]
#[allow(missing_docs)]
pub struct PromptShard {
    pub about: PromptAbout,
    /// Variants per frame.
    pub variants: usize,
    /// Questions per variant.
    pub questions: usize,
    /// Width and height of the frames, pixels.
    pub size: (usize, usize),
    pub rgb: Vec<u8>,
    pub unit: Vec<f32>,
    pub scale: Vec<f32>,
    pub measured_start: Vec<u32>,
    pub measured_pixel: Vec<u32>,
    pub measured_value: Vec<f32>,
    pub prefix: Runs,
    pub asked: Runs,
    pub answer_start: Vec<u32>,
    pub answer: Vec<u32>,
    pub asked_hint: Vec<f32>,
    pub asked_value: Vec<f32>,
}

/// Runs of tokens one after the other.
#[derive(Debug, Clone, PartialEq)]
#[allow(missing_docs)]
pub struct Runs {
    pub start: Vec<u32>,
    pub id: Vec<u32>,
    pub place: Vec<f32>,
}

impl Runs {
    fn new() -> Self {
        Self { start: vec![0], id: Vec::new(), place: Vec::new() }
    }

    fn push(&mut self, tokens: &Tokens) {
        self.id.extend(&tokens.ids);
        for (i, p) in tokens.positions.iter().enumerate() {
            let at = tokens.glimpses.iter().find(|g| g.token == i).map_or([f32::NAN; 2], |g| [g.x, g.y]);
            self.place.extend([p.t, p.h, p.w, at[0], at[1]]);
        }
        self.start.push(self.id.len() as u32);
    }

    fn tokens(&self, run: usize) -> Tokens {
        let (begin, end) = (self.start[run] as usize, self.start[run + 1] as usize);
        let mut tokens = Tokens { ids: self.id[begin..end].to_vec(), ..Tokens::default() };
        for (token, place) in self.place[begin * PLACE..end * PLACE].chunks_exact(PLACE).enumerate() {
            tokens.positions.push(Position { t: place[0], h: place[1], w: place[2] });
            if place[3].is_finite() {
                tokens.glimpses.push(Glimpse { token, x: place[3], y: place[4], stated: f32::NAN });
            }
        }
        tokens
    }

    fn read(reader: &Reader, name: &str, runs: usize) -> Result<Self> {
        let part = |part: &str| format!("{name}_{part}");
        let [count] = reader.shape(&part("id"))?;
        let own = Self {
            start: reader.take(&part("start"), Dtype::U32, &[runs + 1], u32::from_le_bytes)?,
            id: reader.take(&part("id"), Dtype::U32, &[count], u32::from_le_bytes)?,
            place: reader.take(&part("place"), Dtype::F32, &[count, PLACE], f32::from_le_bytes)?,
        };
        reader.check_starts(&part("start"), &own.start, count)?;
        Ok(own)
    }
}

impl PromptShard {
    /// No frame yet.
    pub(super) fn new(about: PromptAbout, variants: usize, questions: usize, size: (usize, usize)) -> Self {
        Self {
            about,
            variants,
            questions,
            size,
            rgb: Vec::new(),
            unit: Vec::new(),
            scale: Vec::new(),
            measured_start: vec![0],
            measured_pixel: Vec::new(),
            measured_value: Vec::new(),
            prefix: Runs::new(),
            asked: Runs::new(),
            answer_start: vec![0],
            answer: Vec::new(),
            asked_hint: Vec::new(),
            asked_value: Vec::new(),
        }
    }

    /// Puts a frame with its variants to the others.
    ///
    /// # Errors
    /// [`Error::Argument`] if it has another size or other numbers of variants and questions.
    pub(super) fn push(&mut self, name: String, variants: &[Example]) -> Result<()> {
        let (width, height) = (self.size.0 as u32, self.size.1 as u32);
        let fits =
            |e: &Example| e.pixels.resized.dimensions() == (width, height) && e.items.len() == self.questions;
        let Some(first) =
            variants.first().filter(|_| variants.len() == self.variants && variants.iter().all(fits))
        else {
            let expected = format!("{} of {width}x{height} with {} questions", self.variants, self.questions);
            return Err(Error::argument("variants", variants.len(), expected));
        };
        self.about.frames.push(name);
        self.rgb.extend_from_slice(first.pixels.resized.as_raw());
        for example in variants {
            self.unit.push(example.unit);
            self.scale.push(example.scale());
            for (pixel, value) in example.measured() {
                self.measured_pixel.push(pixel);
                self.measured_value.push(value);
            }
            self.measured_start.push(self.measured_pixel.len() as u32);
            self.prefix.push(&example.prefix);
            for item in &example.items {
                self.asked.push(&item.tokens);
                self.answer.extend(item.answer.iter().map(|&row| row as u32));
                self.answer_start.push(self.answer.len() as u32);
                self.asked_hint.push(item.hint);
                self.asked_value.push(item.value);
            }
        }
        Ok(())
    }

    /// Number of frames.
    pub fn frames(&self) -> usize {
        self.about.frames.len()
    }

    /// Writes the file whole or not at all.
    ///
    /// # Errors
    /// [`Error::Io`].
    pub fn write(&self, path: &Path) -> Result<()> {
        let (n, (w, h)) = (self.frames(), self.size);
        let (nv, nvq) = ([n, self.variants], [n, self.variants, self.questions]);
        let (f32s, u32s) = (|v: &[f32]| bytes(v, f32::to_le_bytes), |v: &[u32]| bytes(v, u32::to_le_bytes));
        let (prefix, asked) = (&self.prefix, &self.asked);
        let (prefixes, questions) = (prefix.start.len(), asked.start.len());
        let parts = [
            ("rgb", Dtype::U8, &[n, h, w, 3][..], self.rgb.clone()),
            ("unit", Dtype::F32, &nv, f32s(&self.unit)),
            ("scale", Dtype::F32, &nv, f32s(&self.scale)),
            ("measured_start", Dtype::U32, &[self.measured_start.len()], u32s(&self.measured_start)),
            ("measured_pixel", Dtype::U32, &[self.measured_pixel.len()], u32s(&self.measured_pixel)),
            ("measured_value", Dtype::F32, &[self.measured_value.len()], f32s(&self.measured_value)),
            ("prefix_start", Dtype::U32, &[prefixes], u32s(&prefix.start)),
            ("prefix_id", Dtype::U32, &[prefix.id.len()], u32s(&prefix.id)),
            ("prefix_place", Dtype::F32, &[prefix.id.len(), PLACE], f32s(&prefix.place)),
            ("asked_start", Dtype::U32, &[questions], u32s(&asked.start)),
            ("asked_id", Dtype::U32, &[asked.id.len()], u32s(&asked.id)),
            ("asked_place", Dtype::F32, &[asked.id.len(), PLACE], f32s(&asked.place)),
            ("answer_start", Dtype::U32, &[self.answer_start.len()], u32s(&self.answer_start)),
            ("answer", Dtype::U32, &[self.answer.len()], u32s(&self.answer)),
            ("asked_hint", Dtype::F32, &nvq, f32s(&self.asked_hint)),
            ("asked_value", Dtype::F32, &nvq, f32s(&self.asked_value)),
        ];
        write(path, KEY, &self.about, &parts)
    }

    /// Reads a file.
    ///
    /// # Errors
    /// [`Error::Io`]; [`Error::Format`] if it holds no prompts of this version; [`Error::Tensor`] if a tensor is missing, has another
    /// type or shape, or an entry is out of range.
    pub fn read(path: &Path) -> Result<Self> {
        let file = std::fs::read(path).map_err(Error::io(path))?;
        let (about, reader) = Reader::open::<PromptAbout>(path, &file, KEY, "prompts", PROMPTS_VERSION)?;
        let [n, h, w, _] = reader.shape("rgb")?;
        let [_, v, q] = reader.shape("asked_value")?;
        if about.frames.len() != n {
            return Err(reader.wrong(
                "rgb",
                format!("{n} frames"),
                format!("{} as named", about.frames.len()),
            ));
        }
        let [measured, answers] = [reader.shape::<1>("measured_pixel")?[0], reader.shape::<1>("answer")?[0]];
        let u32s = |name: &str, length: usize| reader.take(name, Dtype::U32, &[length], u32::from_le_bytes);
        let f32s = |name: &str, shape: &[usize]| reader.take(name, Dtype::F32, shape, f32::from_le_bytes);
        let variants = n.saturating_mul(v);
        let questions = variants.saturating_mul(q);
        let shard = Self {
            variants: v,
            questions: q,
            size: (w, h),
            rgb: reader.take("rgb", Dtype::U8, &[n, h, w, 3], u8::from_le_bytes)?,
            unit: f32s("unit", &[n, v])?,
            scale: f32s("scale", &[n, v])?,
            measured_start: u32s("measured_start", variants.saturating_add(1))?,
            measured_pixel: u32s("measured_pixel", measured)?,
            measured_value: f32s("measured_value", &[measured])?,
            prefix: Runs::read(&reader, "prefix", variants)?,
            asked: Runs::read(&reader, "asked", questions)?,
            answer_start: u32s("answer_start", questions.saturating_add(1))?,
            answer: u32s("answer", answers)?,
            asked_hint: f32s("asked_hint", &[n, v, q])?,
            asked_value: f32s("asked_value", &[n, v, q])?,
            about,
        };
        shard.check(&reader)?;
        Ok(shard)
    }

    /// What types and shapes do not say: every index lies inside of what it points into.
    fn check(&self, reader: &Reader) -> Result<()> {
        reader.check_starts("measured_start", &self.measured_start, self.measured_pixel.len())?;
        reader.check_starts("answer_start", &self.answer_start, self.answer.len())?;
        let (pixels, rows) = (self.size.0 * self.size.1, self.about.numbers.len());
        let below = |list: &[u32], end: usize| list.iter().all(|&i| (i as usize) < end);
        for (name, fits) in
            [("measured_pixel", below(&self.measured_pixel, pixels)), ("answer", below(&self.answer, rows))]
        {
            if !fits {
                return Err(reader.wrong(name, "an entry out of range", "pixels of the frame, number rows"));
            }
        }
        let lengths = |start: &[u32]| start.windows(2).map(|w| w[1] - w[0]).collect::<Vec<_>>();
        let (asked, answers) = (lengths(&self.asked.start), lengths(&self.answer_start));
        if asked.iter().zip(&answers).any(|(asked, answer)| *answer == 0 || asked < answer) {
            return Err(reader.wrong("answer_start", "an answer without tokens that predict it", "one each"));
        }
        Ok(())
    }

    /// One frame's variant, as the crate's own trainer reads it.
    ///
    /// # Errors
    /// [`Error::Argument`] if there is none of it, or the checkpoint is asked in another way.
    pub fn example(&self, asking: Asking, frame: usize, variant: usize) -> Result<Example> {
        if frame >= self.frames() || variant >= self.variants {
            let expected = format!("{} frames, {} variants", self.frames(), self.variants);
            return Err(Error::argument("frame", format!("{frame}, variant {variant}"), expected));
        }
        // LoRA changes what is answered, not how it is asked.
        let bare = |s: &Settings| Settings { lora: None, ..s.clone() };
        if bare(asking.prompts.settings()) != bare(&self.about.settings) {
            return Err(Error::argument("sdim.json", "another one", "that of the prompts"));
        }
        let (at, (w, h)) = (frame * self.variants + variant, self.size);
        let mut scattered = vec![0f32; w * h];
        for i in self.measured_start[at] as usize..self.measured_start[at + 1] as usize {
            scattered[self.measured_pixel[i] as usize] = self.measured_value[i];
        }
        let rgb = self.rgb[frame * w * h * 3..][..w * h * 3].to_vec();
        let resized = RgbImage::from_raw(w as u32, h as u32, rgb)
            .ok_or_else(|| Error::argument("frame", format!("{w}x{h}"), "a picture"))?;
        let patch = asking.config.vision.patch_size;
        let pixels = Pixels { resized, grid: Grid { height: h / patch, width: w / patch } };
        let items = (at * self.questions..(at + 1) * self.questions).map(|i| {
            let answer = &self.answer[self.answer_start[i] as usize..self.answer_start[i + 1] as usize];
            let (value, hint, scale) = (self.asked_value[i], self.asked_hint[i], self.scale[at]);
            let answer: Vec<usize> = answer.iter().map(|&row| row as usize).collect();
            Item { tokens: self.asked.tokens(i), supervised: answer.len(), answer, value, hint, scale }
        });
        Ok(Example {
            pixels,
            scattered,
            // Whoever has wide crops is asked by records, not by prompts.
            interpolated: Vec::new(),
            unit: self.unit[at],
            prefix: self.prefix.tokens(at),
            items: items.collect(),
        })
    }
}
