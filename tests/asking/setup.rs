//! A model with a frame, and the answers that one run over everything gives.

use crate::common::tiny;
use candle_core::Tensor;
use image::RgbImage;
use sdim::SparseDepth;
use sdim::internals::model::{AskOptions, FreeAnswer, Prefix, SdimModel, ask, generate};
use sdim::internals::query::number::DigitReader;
use sdim::internals::query::{Query, Reading};
use sdim::internals::vlm::qwen2_5::decoder::Keep;
use sdim::internals::vlm::qwen2_5::positions::positions;
use sdim::settings::{
    AnswerMode, Generation, Marker, MarkerShape, NumberFormat, PixelReference, PromptTemplate, Settings,
};

pub const DIGITS: NumberFormat = NumberFormat::Digits { decimals: 2, integers: 2 };
pub const DISC: Marker = Marker { shape: MarkerShape::Disc, size: 6, colour: [255, 0, 0] };

/// Words short enough to run token by token, a pixel in words.
pub fn by_coordinates() -> Settings {
    let template = PromptTemplate {
        before_image: "look:<|vision_start|>".into(),
        query: "{mask} far is {pixel}?".into(),
        mask_missing: "0".into(),
        mask_measured: "1={x}".into(),
        coordinates: "{col},{row}".into(),
        answer: "it is {y} m away.".into(),
        ..PromptTemplate::paper()
    };
    Settings { template, number: DIGITS, fusion: Settings::tiny().fusion, ..Settings::paper() }
}

pub fn by_marker() -> Settings {
    let mut settings = Settings { pixel_reference: PixelReference::Marker(DISC), ..by_coordinates() };
    settings.template.query = "{mask} far?".into();
    settings
}

pub struct Setup {
    pub model: SdimModel,
    pub rgb: RgbImage,
    pub sparse: SparseDepth,
    pub prefix: Prefix,
}

impl Setup {
    pub fn new(settings: &Settings, shape: &tiny::Shape) -> Self {
        let files = tiny::files(settings, shape);
        let mut tensors = tiny::tensors(&files, 23);
        tiny::wake(&mut tensors);
        Self::of(tiny::model(&files, tensors))
    }

    pub fn of(model: SdimModel) -> Self {
        let (rgb, sparse) = tiny::frame(90, 70);
        let prefix = model.prefill_frame(&rgb, &sparse).unwrap();
        Self { model, rgb, sparse, prefix }
    }

    pub fn settings(&self) -> &Settings {
        self.model.prompts.settings()
    }

    /// Queries all over the frame, at its corners and at measured pixels too.
    pub fn queries(&self, count: usize) -> Vec<Query> {
        let (w, h) = (self.sparse.width(), self.sparse.height());
        let pixel =
            |i: usize| [0, w - 1, (h - 1) * w, w * h - 1].get(i).copied().unwrap_or(i * 37 * 11 % (w * h));
        let query = |at: usize| {
            let (x, y) = (at % w, at / w);
            Query { x, y, measured: self.sparse.get(x, y), hint: f32::NAN }
        };
        (0..count).map(|i| query(pixel(i))).collect()
    }

    /// The frame as the query shows it.
    pub fn shown(&self, query: &Query) -> RgbImage {
        let mut rgb = self.rgb.clone();
        if let PixelReference::Marker(marker) = self.settings().pixel_reference {
            marker.draw(&mut rgb, query.x, query.y);
        }
        rgb
    }

    /// Normed hidden state of the last token of one run over everything: image, prompt, answer so far.
    pub fn whole_run(&self, query: &Query, answer: &[u32]) -> Tensor {
        let (model, t) = (&self.model, &self.settings().template);
        let (pixels, scattered) = model.preprocess(&self.shown(query), &self.sparse).unwrap();
        let image = model.encode(&pixels, &scattered).unwrap();
        let mask = match query.measured {
            Some(depth) => t.mask_measured.replace("{x}", &format!("{depth:.2}")),
            None => t.mask_missing.clone(),
        };
        let along =
            |p: usize, of: u32, resized: u32| ((p as f32 + 0.5) * resized as f32 / of as f32) as usize;
        let coordinates = t
            .coordinates
            .replace("{col}", &along(query.x, self.rgb.width(), pixels.resized.width()).to_string())
            .replace("{row}", &along(query.y, self.rgb.height(), pixels.resized.height()).to_string());
        let words = t.query.replace("{mask}", &mask).replace("{pixel}", &coordinates);
        let encode = |text: &str| model.tokenizer.encode(text).unwrap();
        let placeholders = vec![model.vlm.config.ids.image; image.dim(0).unwrap()];
        let ids =
            [&encode(&t.before_image)[..], &placeholders, &encode(&t.after_image), &encode(&words), answer];
        let ids = ids.concat();
        let walked = positions(&ids, &[pixels.grid], &model.vlm.config, 1.0).unwrap();
        let embedded = model.vlm.embed_prompt(&ids, &image).unwrap();
        let decoder = &model.vlm.decoder;
        let hidden =
            model.vlm.prefill(&embedded, &walked.positions, &mut decoder.cache(1), Keep::All).unwrap();
        decoder.final_norm(&hidden.narrow(0, hidden.dim(0).unwrap() - 1, 1).unwrap()).unwrap()
    }

    pub fn logits(&self, hidden: &Tensor) -> Vec<f32> {
        self.model.vlm.decoder.logits(hidden).unwrap().flatten_all().unwrap().to_vec1().unwrap()
    }

    pub fn digits_from_scratch(&self, query: &Query) -> Reading {
        let mut reader = DigitReader::new(2, 2);
        let mut answer = self.model.tokenizer.encode(self.settings().template.forced()).unwrap();
        let ids = &self.model.prompts.numbers().ids;
        while !reader.done() {
            let all = self.logits(&self.whole_run(query, &answer));
            let row: Vec<f32> = ids.iter().map(|&id| all[id as usize]).collect();
            answer.push(ids[reader.push(&row).unwrap()]);
        }
        reader.reading()
    }

    pub fn words_from_scratch(&self, query: &Query, generation: &Generation) -> (Vec<u32>, bool) {
        let stop: Vec<u32> = match &generation.stop {
            Some(stop) => stop.iter().map(|t| self.model.tokenizer.id(t).unwrap()).collect(),
            None => self.model.stop_ids.clone(),
        };
        let mut answer = Vec::new();
        while answer.len() < generation.max_new_tokens {
            let logits = self.logits(&self.whole_run(query, &answer));
            let usable = &logits[..self.model.tokenizer.vocab_size()];
            let best = (0..usable.len()).max_by(|&a, &b| usable[a].total_cmp(&usable[b])).unwrap() as u32;
            if stop.contains(&best) {
                return (answer, true);
            }
            answer.push(best);
        }
        (answer, false)
    }

    pub fn speak(&self, queries: &[Query], generation: &Generation) -> Vec<FreeAnswer> {
        generate(&self.model, &self.prefix, queries, generation, &mut |_| true).unwrap()
    }

    pub fn digits(&self, queries: &[Query]) -> Vec<Reading> {
        ask(
            &self.model,
            &self.prefix,
            queries,
            AskOptions { mode: Some(&AnswerMode::Digits), ..Default::default() },
        )
        .unwrap()
    }
}
