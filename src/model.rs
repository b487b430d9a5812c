//! A checkpoint of the depth completion model: Qwen2.5-VL, the fusion block, and the way it is asked.

use crate::adapter::{self, SETTINGS};
use crate::depth::SparseDepth;
use crate::error::{Error, Result};
use crate::fusion::{Fusion, Normalise};
use crate::kernels::{self, WeightFormat};
use crate::query::prompt::Glimpse;
use crate::query::{Prefix, PromptWriter, Settings};
use crate::system;
use crate::vlm::QwenVl;
use crate::vlm::checkpoint::{CONFIG, PREPROCESSOR, Source, TOKENIZER, check_patches};
use crate::vlm::config::VlmConfig;
use crate::vlm::decoder::Keep;
use crate::vlm::generate::GenerationConfig;
use crate::vlm::grid::Grid;
use crate::vlm::linear::Linear;
use crate::vlm::lora::LoraMode;
use crate::vlm::matrix::Matrix;
use crate::vlm::patch_embed::PatchEmbed;
use crate::vlm::preprocess::{Pixels, PreprocessorConfig};
use crate::vlm::tokenizer::Tokenizer;
use crate::vlm::weights::Weights;
use candle_core::{Device, Tensor};
use image::RgbImage;
use rayon::prelude::*;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// The fusion block with the second patch embedding (F_e2 of Eq. 3a).
pub struct DepthInjection {
    /// I and S to O.
    pub fusion: Fusion,
    /// O to tokens.
    pub patch_embed: PatchEmbed,
}

/// A loaded checkpoint. Immutable: caches are arguments.
pub struct SdimModel {
    /// The vision-language model.
    pub vlm: QwenVl,
    /// What adds sparse depth to the image tokens; `None` for a checkpoint without it.
    pub injection: Option<DepthInjection>,
    /// Crops around pixels to token embeddings, zero-initialised; `None` for a checkpoint without it.
    pub glimpse: Option<Linear>,
    /// How frames are resized and normalised.
    pub preprocessor: PreprocessorConfig,
    /// How it is asked.
    pub prompts: PromptWriter,
    /// Its vocabulary.
    pub tokenizer: Tokenizer,
    /// Ids that end a free answer.
    pub stop_ids: Vec<u32>,
    /// Rows of the output head that can continue a number, `[numbers, hidden]`.
    pub number_rows: Matrix,
    /// Where its tensors are.
    pub device: Device,
}

/// The files of a checkpoint that are not tensors.
pub struct CheckpointFiles {
    /// `config.json`
    pub config: VlmConfig,
    /// `preprocessor_config.json`
    pub preprocessor: PreprocessorConfig,
    /// `sdim.json`
    pub settings: Settings,
    /// `tokenizer.json`
    pub tokenizer: Tokenizer,
    /// Ids that end an answer, of `generation_config.json` or `config.json`.
    pub stop_ids: Vec<u32>,
}

impl CheckpointFiles {
    /// From the bytes of the four files.
    ///
    /// # Errors
    /// Typed errors that name the file and key.
    pub fn from_bytes(
        dir: &str,
        config: &[u8],
        preprocessor: &[u8],
        settings: &[u8],
        tokenizer: &[u8],
    ) -> Result<Self> {
        let files =
            [(CONFIG, config), (PREPROCESSOR, preprocessor), (SETTINGS, settings), (TOKENIZER, tokenizer)];
        Self::read(&Source::memory(Path::new(dir), &files))
    }

    /// From a directory. Without `sdim.json` the checkpoint is plain Qwen2.5-VL, asked in the paper's words.
    ///
    /// # Errors
    /// Typed errors that name the file and key.
    pub fn from_dir(dir: &Path) -> Result<Self> {
        Self::read(&Source::dir(dir))
    }

    fn read(source: &Source) -> Result<Self> {
        Ok(Self {
            config: source.config()?,
            preprocessor: source.preprocessor()?,
            settings: if source.has(SETTINGS) {
                Settings::from_bytes(&source.path(SETTINGS), &source.read(SETTINGS)?)?
            } else {
                Settings::paper()
            },
            tokenizer: source.tokenizer()?,
            stop_ids: GenerationConfig::read(source)?.stop_ids,
        })
    }
}

/// Everything of a model that has weights.
pub(crate) struct Parts {
    pub(crate) vlm: QwenVl,
    pub(crate) injection: Option<DepthInjection>,
    pub(crate) glimpse: Option<Linear>,
}

impl Parts {
    /// Asks for each tensor; what is missing is for [`Weights::finish`] to tell.
    pub(crate) fn new(config: VlmConfig, settings: &Settings, weights: &Weights) -> Result<Self> {
        let injection = match &settings.fusion {
            Some(fusion) => Some(DepthInjection {
                fusion: Fusion::new(fusion, weights)?,
                patch_embed: PatchEmbed::new(&config.vision, weights, "sdim.patch_embed.proj")?,
            }),
            None => None,
        };
        let glimpse = match settings.glimpse {
            Some(side) => {
                Some(Linear::new(weights, "sdim.glimpse", 3 * side * side, config.text.hidden_size, false)?)
            }
            None => None,
        };
        Ok(Self { vlm: QwenVl::new(config, weights, settings.rope_layout)?, injection, glimpse })
    }
}

/// How to load a checkpoint.
#[derive(Debug, Clone)]
pub struct LoadOptions {
    /// Where its tensors shall lie. [`crate::system::device`] opens devices that may be used by several threads; one made with
    /// candle's `Device::new_cuda` may not, and is refused.
    pub device: Device,
    /// In what form its matrices are kept. On the CPU, [`WeightFormat::Bf16`] takes half the memory of
    /// [`WeightFormat::F32`] and is faster; a published checkpoint loses nothing by it, since it is stored in bf16.
    pub weights: WeightFormat,
    /// A directory with `sdim.json` and `sdim.safetensors`, which replace or complete those of the checkpoint.
    pub adapter: Option<PathBuf>,
    /// What becomes of the adapter's LoRA factors.
    pub lora: LoraMode,
}

impl LoadOptions {
    /// A device, the form of weights that suits it ([`WeightFormat::native`]), no adapter.
    pub fn on(device: &Device) -> Self {
        Self {
            device: device.clone(),
            weights: WeightFormat::native(device),
            adapter: None,
            lora: LoraMode::default(),
        }
    }
}

impl Default for LoadOptions {
    /// As [`LoadOptions::on`] the CPU.
    fn default() -> Self {
        Self::on(&Device::Cpu)
    }
}

impl SdimModel {
    /// Builds the model; fails on missing or unread tensors.
    ///
    /// # Errors
    /// [`Error::Config`] if the preprocessor's patches are not the model's; [`Error::Argument`] on a device or a format of weights
    /// as for [`QwenVl::new`]; tensor and tokenizer errors.
    pub fn new(files: CheckpointFiles, weights: &Weights, device: &Device) -> Result<Self> {
        for device in [device, weights.device()] {
            system::check_order(device)?;
        }
        let CheckpointFiles { config, preprocessor, settings, tokenizer, stop_ids } = files;
        check_patches(&preprocessor, &config)?;
        let prompts = PromptWriter::new(&settings, &tokenizer)?;
        let Parts { vlm, injection, glimpse } = Parts::new(config, &settings, weights)?;
        weights.finish()?;
        let number_rows = vlm.decoder.head_rows(&prompts.numbers().ids)?;
        let number_rows = Matrix::from_tensor(&number_rows, weights.format())?;
        Ok(Self {
            vlm,
            injection,
            glimpse,
            preprocessor,
            prompts,
            tokenizer,
            stop_ids,
            number_rows,
            device: device.clone(),
        })
    }

    /// Folds what inference need not keep apart.
    ///
    /// # Errors
    /// [`Error::Tensors`] if a tensor operation fails.
    pub fn fold(mut self) -> Result<Self> {
        if let Some(injection) = &mut self.injection {
            injection.fusion.fold()?;
        }
        Ok(self)
    }

    /// Loads a checkpoint directory in the form that suits the device ([`LoadOptions::on`]): `config.json`, `preprocessor_config.json`, `tokenizer.json`,
    /// `model.safetensors` or its shards with their index, and `sdim.json` and `sdim.safetensors` if it has them.
    ///
    /// # Errors
    /// Typed errors that name the file, key or tensor.
    pub fn load(dir: &Path, device: &Device) -> Result<Self> {
        Self::load_with(dir, &LoadOptions::on(device))
    }

    /// As [`SdimModel::load`], with a form of weights and an adapter.
    ///
    /// # Errors
    /// Typed errors that name the file, key or tensor.
    pub fn load_with(dir: &Path, options: &LoadOptions) -> Result<Self> {
        let files = CheckpointFiles::from_dir(dir)?;
        let mut weights = Weights::from_dir(dir, &options.device)?;
        let beside = dir.join(adapter::TENSORS);
        if options.adapter.is_none() && beside.exists() {
            weights.add_file(&beside)?;
        }
        Self::assemble(files, weights, options)
    }

    fn assemble(mut files: CheckpointFiles, mut weights: Weights, options: &LoadOptions) -> Result<Self> {
        if let Some(adapter) = &options.adapter {
            files.settings = Settings::from_file(&adapter.join(SETTINGS))?;
            weights.add_file(&adapter.join(adapter::TENSORS))?;
        }
        let weights = weights.with_format(options.weights).with_lora(files.settings.lora_set(options.lora));
        Self::new(files, &weights, &options.device)?.fold()
    }

    /// Resizes a frame and scatters its measurements: pixels, and `[1, h, w, 1]` in number units with 0 where nothing
    /// was measured.
    ///
    /// # Errors
    /// [`Error::SizeMismatch`], [`Error::ImageSize`].
    pub fn preprocess(&self, rgb: &RgbImage, sparse: &SparseDepth) -> Result<(Pixels, Tensor)> {
        let size = (rgb.width() as usize, rgb.height() as usize);
        let depth = (sparse.width(), sparse.height());
        if size != depth {
            return Err(Error::SizeMismatch { rgb: size, depth });
        }
        let pixels = self.preprocessor.resize(rgb)?;
        let (w, h) = (pixels.resized.width() as usize, pixels.resized.height() as usize);
        let scattered = scatter(sparse, w, h, self.prompts.unit(sparse));
        Ok((pixels, Tensor::from_vec(scattered, (1, h, w, 1), &self.device)?))
    }

    /// Image tokens of a frame with its measurements (Eq. 1-3).
    ///
    /// # Errors
    /// [`Error::Tensors`] on mismatched shapes.
    pub fn encode(&self, pixels: &Pixels, scattered: &Tensor) -> Result<Tensor> {
        self.encode_batch(&[pixels], scattered, Normalise::Running)
    }

    /// Image tokens of frames of one size, one frame after the other; `scattered` is `[frames, h, w, 1]`.
    ///
    /// # Errors
    /// [`Error::Tensors`] on mismatched shapes.
    pub fn encode_batch(
        &self,
        frames: &[&Pixels],
        scattered: &Tensor,
        normalise: Normalise,
    ) -> Result<Tensor> {
        let grids: Vec<Grid> = frames.iter().map(|p| p.grid).collect();
        self.vlm.vision.encode(&self.embed_patches(frames, scattered, normalise)?, &grids)
    }

    /// E of Eq. 3a: embedded patches of frames of one size, `[frames * patches, hidden]`.
    pub(crate) fn embed_patches(
        &self,
        frames: &[&Pixels],
        scattered: &Tensor,
        normalise: Normalise,
    ) -> Result<Tensor> {
        let patches = frames.iter().map(|p| self.preprocessor.patches(p, &self.device));
        let patches = Tensor::cat(&patches.collect::<Result<Vec<_>>>()?, 0)?;
        let mut embedded = self.vlm.vision.patch_embed.forward(&patches)?; // F_e1(I)
        if let Some(injection) = &self.injection {
            let images = frames.iter().map(|p| self.preprocessor.image(p, &self.device));
            let rgb = Tensor::stack(&images.collect::<Result<Vec<_>>>()?, 0)?;
            let o = injection.fusion.forward(&rgb, scattered, normalise)?;
            let tokens = frames.iter().enumerate();
            let tokens = tokens.map(|(i, p)| injection.patch_embed.forward_image(&o.get(i)?, p.grid));
            embedded = kernels::add(&embedded, &Tensor::cat(&tokens.collect::<Result<Vec<_>>>()?, 0)?)?; // Eq. 3a
        }
        Ok(embedded)
    }

    /// Reads the shared prefix of a frame into a cache, for pixel references that leave the image as it is.
    ///
    /// # Errors
    /// [`Error::Tensors`] on mismatched shapes.
    pub fn read_prefix(
        &self,
        pixels: &Pixels,
        image_tokens: &Tensor,
        sparse: &SparseDepth,
    ) -> Result<Prefix> {
        let resized = (pixels.resized.width() as usize, pixels.resized.height() as usize);
        let (tokens, space) = self.prompts.prefix(sparse, pixels.grid, resized, &self.vlm.config, 0)?;
        let image = Arc::new(pixels.resized.clone());
        let embedded = self.vlm.embed_prompt(&tokens.ids, image_tokens)?;
        let embedded = self.add_glimpses(embedded, &[(&image, &tokens.glimpses)])?;
        let mut cache = self.vlm.decoder.cache(1);
        self.vlm.prefill(&embedded, &tokens.positions, &mut cache, Keep::Nothing)?;
        Ok(Prefix { cache, ids: tokens.ids, space, image, marked: None })
    }
}

impl SdimModel {
    /// Adds the crop around its pixel to each token that stands at one; `groups` pairs images with the tokens that stand
    /// in them, indices counting over all of `embedded`. Without a glimpse layer nothing changes.
    ///
    /// # Errors
    /// [`Error::Tensors`] if an index is out of range.
    pub fn add_glimpses(&self, embedded: Tensor, groups: &[(&RgbImage, &[Glimpse])]) -> Result<Tensor> {
        let (Some(layer), Some(side)) = (&self.glimpse, self.prompts.settings().glimpse) else {
            return Ok(embedded);
        };
        let count: usize = groups.iter().map(|(_, g)| g.len()).sum();
        if count == 0 {
            return Ok(embedded);
        }
        let len = 3 * side * side;
        let mut crops = vec![0f32; count * len];
        let all: Vec<(&RgbImage, Glimpse)> =
            groups.iter().flat_map(|(image, list)| list.iter().map(move |g| (*image, *g))).collect();
        crops.par_chunks_mut(len).zip(&all).for_each(|(crop, (image, g))| {
            self.preprocessor.crop(image, g.x, g.y, side, crop);
        });
        let added = layer.forward(&Tensor::from_vec(crops, (count, len), &self.device)?)?;
        if all.iter().enumerate().all(|(i, (_, g))| g.token == i) && count == embedded.dim(0)? {
            return kernels::add(&embedded, &added);
        }
        let rows: Vec<u32> = all.iter().map(|(_, g)| g.token as u32).collect();
        Ok(embedded.index_add(&Tensor::from_vec(rows, count, &self.device)?, &added, 0)?)
    }
}

/// Moves measurements to the pixels of the resized frame, in units of `unit` metres, 0 elsewhere. Where several fall on
/// one pixel, the one nearest to its centre stays: nothing is averaged or interpolated.
pub fn scatter(sparse: &SparseDepth, width: usize, height: usize, unit: f32) -> Vec<f32> {
    let mut out = vec![0f32; width * height];
    let mut off = vec![f32::MAX; width * height];
    let (sx, sy) = (width as f32 / sparse.width() as f32, height as f32 / sparse.height() as f32);
    for (x, y, depth) in sparse.points() {
        let (fx, fy) = ((x as f32 + 0.5) * sx, (y as f32 + 0.5) * sy);
        let at = (fy as usize).min(height - 1) * width + (fx as usize).min(width - 1);
        let distance = (fx.fract() - 0.5).powi(2) + (fy.fract() - 0.5).powi(2);
        if distance < off[at] {
            off[at] = distance;
            out[at] = depth / unit;
        }
    }
    out
}

/// The checkpoint that ships inside the crate.
///
/// # Errors
/// [`Error::Tensors`] if the device refuses the tensors; what an adapter can have wrong.
#[cfg(feature = "tiny")]
pub fn tiny(options: &LoadOptions) -> Result<SdimModel> {
    let files = CheckpointFiles::from_bytes(
        "sdim-tiny",
        include_bytes!("../assets/sdim-tiny/config.json"),
        include_bytes!("../assets/sdim-tiny/preprocessor_config.json"),
        include_bytes!("../assets/sdim-tiny/sdim.json"),
        include_bytes!("../assets/sdim-tiny/tokenizer.json"),
    )?;
    let bytes = include_bytes!("../assets/sdim-tiny/model.safetensors");
    let weights = Weights::from_bytes("sdim-tiny/model.safetensors", &bytes[..], &options.device)?;
    SdimModel::assemble(files, weights, options)
}
