//! Frames whose depth is known from elsewhere: of a data set, or of a robot's own sensor.

use super::batch::{Asking, Example, asked_about, example_again, mix, written};
use super::prompts::{PROMPTS_VERSION, PromptAbout, PromptShard};
use super::recipe::BatchConfig;
use super::records::{RecordConfig, RecordSet};
use crate::depth::{Intrinsics, SparseDepth, SparsePattern};
use crate::error::{Error, Result};
use crate::image::resize::bicubic;
use crate::model::scatter;
use crate::query::mode::AnswerMode;
use crate::query::settings::PixelReference;
use crate::scenes::RgbdFrame;
use image::RgbImage;
use rand::Rng;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use rayon::prelude::*;
use std::ops::Range;

/// Horizontal field of view of cameras of which it is not known, radians. It decides where rings of a made-up LiDAR fall, nothing else.
const FIELD_OF_VIEW: f32 = 1.2;

/// A frame that questions are made about.
#[derive(Debug, Clone)]
pub struct KnownFrame {
    /// For lists and people.
    pub name: String,
    /// The picture and its true depth, NaN where unknown.
    pub frame: RgbdFrame,
    /// What a sensor measured; `None`: measurements are drawn from the true depth.
    pub measured: Option<SparseDepth>,
}

impl KnownFrame {
    /// A frame of a data set in the size in which it is trained on: the picture bicubic as the encoder resizes it, the true depth (metres,
    /// row-major, NaN where unknown) of the nearest pixel, measurements each moved to its pixel.
    ///
    /// # Errors
    /// [`Error::BufferLength`] if the depth has not one value per pixel; as [`SparseDepth::new`].
    pub fn resized(
        name: String,
        rgb: &RgbImage,
        depth: &[f32],
        measured: Option<&SparseDepth>,
        (width, height): (usize, usize),
    ) -> Result<Self> {
        let (w, h) = (rgb.width() as usize, rgb.height() as usize);
        if depth.len() != w * h {
            return Err(Error::BufferLength { what: "depth", expected: w * h, found: depth.len() });
        }
        let nearest = |to: usize, from: usize, size: usize| ((2 * to + 1) * from / (2 * size)).min(from - 1);
        let rows = (0..height).map(|y| nearest(y, h, height) * w);
        let depth = rows.flat_map(|row| (0..width).map(move |x| depth[row + nearest(x, w, width)])).collect();
        let measured = measured.map(|sparse| {
            let mut moved = scatter(sparse, width, height, |metres| metres);
            moved.iter_mut().filter(|d| **d == 0.0).for_each(|d| *d = f32::NAN);
            SparseDepth::new(width, height, moved)
        });
        let intrinsics = Intrinsics::from_fov(width, height, FIELD_OF_VIEW);
        let frame = RgbdFrame { rgb: bicubic(rgb, width, height), depth, intrinsics, glass: None };
        Ok(Self { name, frame, measured: measured.transpose()? })
    }

    /// The frame as in a mirror.
    ///
    /// # Errors
    /// As [`SparseDepth::from_points`].
    pub fn mirrored(mut self) -> Result<Self> {
        let width = self.frame.width();
        self.frame.mirror();
        if let Some(sparse) = &self.measured {
            let points: Vec<_> = sparse.points().map(|(x, y, d)| (width - 1 - x, y, d)).collect();
            self.measured = Some(SparseDepth::from_points(width, sparse.height(), &points)?);
        }
        Ok(self)
    }
}

impl RecordConfig {
    /// Checks that whole prompts can hold the checkpoint's way of asking.
    ///
    /// # Errors
    /// [`Error::Config`] for a mark in the image, which would be another picture per question, and for free answers.
    pub fn check_prompts(&self, asking: Asking) -> Result<()> {
        self.check_sizes(asking)?;
        if let RecordSet::HeldOut { grid: Some(step), .. } = self.set {
            return Err(Error::argument("grid", step, "none: pictures are drawn from records"));
        }
        let s = asking.prompts.settings();
        for (key, fits, expected) in [
            (
                "pixel_reference",
                !matches!(s.pixel_reference, PixelReference::Marker(_)),
                "a pointer, or coordinates",
            ),
            ("wide_glimpse", s.wide_glimpse.is_none(), "none: wide crops are trained with records"),
            (
                "answer_mode",
                s.answer_mode == AnswerMode::Digits,
                "digits: the sentence is forced, its number is trained",
            ),
        ] {
            if !fits {
                return Err(Error::config("sdim.json", key, "another way of asking", expected));
            }
        }
        Ok(())
    }

    /// Makes a file of prompts about frames by their numbers, on all cores. Frames without a measurement, or with nothing to ask, are left
    /// out.
    ///
    /// # Errors
    /// As [`RecordConfig::check_prompts`]; errors of `source`; [`Error::NoMeasurement`] if no frame is left.
    pub fn prompts(
        &self,
        asking: Asking,
        source: impl Fn(u64) -> Result<KnownFrame> + Sync,
        index: u64,
        numbers: Range<u64>,
    ) -> Result<PromptShard> {
        self.check_prompts(asking)?;
        let made: Vec<Option<(String, Vec<Example>)>> = numbers
            .into_par_iter()
            .map(|number| match source(number).and_then(|known| self.variants_of(asking, known, number)) {
                Ok(made) => Ok(Some(made)),
                Err(Error::NoMeasurement { .. }) => Ok(None),
                Err(other) => Err(other),
            })
            .collect::<Result<_>>()?;
        let made: Vec<_> = made.into_iter().flatten().collect();
        let (width, height) = self.batch.sizes.first().copied().unwrap_or_default();
        let Some(questions) = made.first().and_then(|(_, v)| v.first()).map(|e| e.items.len()) else {
            return Err(Error::NoMeasurement { width, height });
        };
        let about = PromptAbout {
            version: PROMPTS_VERSION,
            sdim: env!("CARGO_PKG_VERSION").into(),
            index,
            config: serde_json::to_value(self)
                .map_err(|e| Error::format("prompts", e.to_string(), "a configuration that JSON can hold"))?,
            settings: asking.prompts.settings().of_the_shape(),
            frames: Vec::new(),
            numbers: asking.prompts.numbers().ids.clone(),
            image: asking.config.ids.image,
        };
        let mut shard = PromptShard::new(about, self.variants, questions, (width, height));
        for (name, variants) in made {
            shard.push(name, &variants)?;
        }
        Ok(shard)
    }

    fn variants_of(&self, asking: Asking, known: KnownFrame, number: u64) -> Result<(String, Vec<Example>)> {
        let dice = |v| ChaCha8Rng::seed_from_u64(mix(mix(self.seed ^ 0xF2A3, number), v));
        let known = match self.set {
            RecordSet::Train if dice(0).random_bool(0.5) => known.mirrored()?,
            _ => known,
        };
        let mut made: Vec<Example> = Vec::with_capacity(self.variants);
        for v in 1..=self.variants as u64 {
            // A file holds one picture of a frame: the first variant's.
            let picture = made.first().map(|e| e.pixels.resized.clone());
            made.push(self.known_variant(asking, &known, picture.as_ref(), &mut dice(v))?);
        }
        Ok((known.name, made))
    }

    fn known_variant(
        &self,
        asking: Asking,
        known: &KnownFrame,
        picture: Option<&RgbImage>,
        rng: &mut ChaCha8Rng,
    ) -> Result<Example> {
        let (frame, points) = (&known.frame, self.batch.prompt_points);
        let (measured, config) = match (&known.measured, self.set) {
            (None, RecordSet::Train) => return example_again(asking, &self.batch, frame, picture, rng),
            (Some(measured), RecordSet::Train) => (measured.clone(), self.batch.clone()),
            (measured, RecordSet::HeldOut { points, .. }) => {
                let drawn = || {
                    let (w, h) = (frame.width(), frame.height());
                    SparsePattern::Uniform.sample(&frame.rgb, frame.sensed(), w, h, points, rng)
                };
                let measured = measured.clone().map_or_else(drawn, Ok)?;
                (measured, BatchConfig { errors: 0.0, edges: 0.0, ..self.batch.clone() })
            }
        };
        let (told, asked) = asked_about(frame, measured, &config, rng)?;
        written(asking, &frame.rgb, &told, points, &asked, rng.random())
    }
}
