//! Six random models of unlike shapes over seven unlike images, in f32 and with bf16 weights.
//!
//! `tests/reference/make_family.py` says what the files hold and why these shapes.

use super::common::{Allowed, Golden, device, random, root};
use super::json;
use super::stages::Case;
use candle_core::{DType, Tensor};
use sdim::WeightFormat;
use sdim::internals::vlm::checkpoint::weights::Weights;
use sdim::internals::vlm::qwen2_5::QwenVl;
use sdim::internals::vlm::qwen2_5::config::VlmConfig;
use sdim::internals::vlm::qwen2_5::grid::Grid;
use sdim::internals::vlm::qwen2_5::preprocess::PreprocessorConfig;
use sdim::settings::RopeLayout;
use std::collections::HashMap;
use std::path::PathBuf;

pub const NAMES: [&str; 6] = ["like_3b", "like_7b", "merge_3", "merge_1", "window_1", "window_7"];

pub struct Family {
    dir: PathBuf,
    name: &'static str,
    meta: serde_json::Value,
    pub config: VlmConfig,
    preprocessor: PreprocessorConfig,
}

impl Family {
    pub fn new(name: &'static str) -> Self {
        let dir = root().join("tests/fixtures/family");
        let meta = json(&dir.join(format!("{name}.json")));
        let config = VlmConfig::from_json("config", &meta["config"]).unwrap();
        let preprocessor =
            PreprocessorConfig::from_json("preprocessor_config", &meta["preprocessor_config"]).unwrap();
        Self { dir, name, meta, config, preprocessor }
    }

    /// A checkpoint of this family's weights in a file of some type, kept in some form.
    fn model(&self, stored: DType, format: WeightFormat) -> QwenVl {
        let tensors = random::weights(&self.config);
        let checksum = random::checksum(tensors.values());
        assert_eq!(self.meta["weights_crc32"], checksum, "the weights are not those of the generator");
        let tensors: HashMap<_, _> =
            tensors.into_iter().map(|(name, t)| (name, t.to_dtype(stored).unwrap())).collect();
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("model.safetensors");
        candle_core::safetensors::save(&tensors, &path).unwrap();
        let weights = Weights::from_file(&path, &device()).unwrap().with_format(format);
        let model = QwenVl::new(self.config.clone(), &weights, RopeLayout::Contiguous).unwrap();
        weights.finish().unwrap();
        model
    }

    /// The rows and the grid of an image file.
    fn image(&self, letter: char) -> (Tensor, Grid) {
        let file = self.meta["images"][letter.to_string()].as_str().unwrap();
        let rgb = sdim::read_rgb(self.dir.join("images").join(file)).unwrap();
        let pixels = self.preprocessor.resize(&rgb).unwrap();
        (self.preprocessor.patches(&pixels, &device()).unwrap(), pixels.grid)
    }

    pub fn golden(&self, allowed: Allowed) -> Golden {
        Golden::file(&self.dir.join(format!("{}.safetensors", self.name)), allowed)
    }

    /// Prompts, named by the letters of their images; `-` is text alone.
    pub fn cases(&self) -> impl Iterator<Item = &str> {
        self.meta["cases"].as_array().unwrap().iter().map(|case| case.as_str().unwrap())
    }

    /// The rows and the grids of a prompt's images.
    pub fn images(&self, case: &str) -> (Option<Tensor>, Vec<Grid>) {
        let letters = case.chars().filter(|&letter| letter != '-');
        let (rows, grids): (Vec<_>, Vec<_>) = letters.map(|letter| self.image(letter)).unzip();
        ((!rows.is_empty()).then(|| Tensor::cat(&rows, 0).unwrap()), grids)
    }

    fn check(&self, model: &QwenVl, allowed: Allowed) {
        let golden = self.golden(allowed);
        for name in self.cases() {
            let (rows, grids) = self.images(name);
            let checksum = rows.iter().map(|rows| i64::from(random::checksum([rows])));
            golden.exact(&format!("{name}.pixel_values_crc32"), checksum);
            Case { golden: &golden, model, name, grids }.check(rows.as_ref());
        }
        match golden.finish() {
            Ok(line) => println!("{line}"),
            Err(differences) => panic!("{}, {allowed:?}:\n{}", self.name, differences.join("\n")),
        }
    }
}

fn check(name: &'static str) {
    let family = Family::new(name);
    family.check(&family.model(DType::F32, WeightFormat::F32), Allowed::Rounding);
    family.check(&family.model(DType::BF16, WeightFormat::Bf16), Allowed::Bf16Gap);
}

#[test]
fn like_3b_agrees() {
    check("like_3b");
}

#[test]
fn like_7b_agrees() {
    check("like_7b");
}

#[test]
fn nine_patches_per_token_agree() {
    check("merge_3");
}

#[test]
fn one_patch_per_token_agrees() {
    check("merge_1");
}

#[test]
fn windows_of_one_token_agree() {
    check("window_1");
}

#[test]
fn windows_larger_than_images_agree() {
    check("window_7");
}
