//! A fresh small checkpoint: its files and its initial weights.

use super::shape::Shape;
use super::vocabulary::byte_tokenizer;
use crate::error::{Error, Result};
use crate::files::{read_text, write_tensors, write_whole};
use crate::model::{CheckpointFiles, SETTINGS, SdimModel, initial};
use crate::query::number::Numbers;
use crate::query::{NumberTokens, Settings};
use crate::vlm::checkpoint::shards::SINGLE;
use crate::vlm::checkpoint::weights::Weights;
use crate::vlm::files::{CONFIG, PREPROCESSOR, TOKENIZER};
use candle_core::{Device, Tensor};
use serde_json::Value;
use std::collections::BTreeMap;
use std::path::Path;

/// The JSON files of a checkpoint, as text.
#[derive(Debug, Clone, PartialEq)]
pub struct FreshFiles {
    /// `config.json`
    pub config: String,
    /// `preprocessor_config.json`
    pub preprocessor: String,
    /// `sdim.json`
    pub settings: String,
    /// `tokenizer.json`
    pub tokenizer: String,
}

impl FreshFiles {
    /// The tiny model.
    ///
    /// # Errors
    /// As [`FreshFiles::of`].
    pub fn tiny(settings: &Settings) -> Result<Self> {
        Self::of(&Shape::tiny(), settings)
    }

    /// Those of the checkpoint inside the crate.
    #[cfg(feature = "tiny")]
    pub(super) fn embedded() -> Self {
        let [config, preprocessor, settings, tokenizer] = crate::model::TINY.map(String::from);
        Self { config, preprocessor, settings, tokenizer }
    }

    /// A model of any shape.
    ///
    /// # Errors
    /// [`Error::Config`] names the key whose size does not fit; [`Error::Format`] if a part cannot be written as JSON.
    pub fn of(shape: &Shape, settings: &Settings) -> Result<Self> {
        let bins = settings.number.bins().filter(|_| settings.number_tokens == NumberTokens::Vocabulary);
        let numbers = bins.map_or(0, |bins| bins.count);
        let text = |what: &str, value: &Value| {
            serde_json::to_string_pretty(value).map_err(|e| Error::format(what, e.to_string(), "JSON"))
        };
        let files = Self {
            config: text(CONFIG, &shape.config(numbers))?,
            preprocessor: text(PREPROCESSOR, &shape.preprocessor())?,
            settings: settings.to_json()?,
            tokenizer: byte_tokenizer(numbers).to_string(),
        };
        files.parse()?;
        Ok(files)
    }

    /// Writes the four files into a checkpoint directory.
    ///
    /// # Errors
    /// [`Error::Io`].
    pub fn write(&self, dir: &Path) -> Result<()> {
        std::fs::create_dir_all(dir).map_err(Error::io(dir))?;
        for (name, text) in self.named() {
            write_whole(&dir.join(name), text.as_bytes())?;
        }
        Ok(())
    }

    /// Initial values of all tensors of a model of these files, by [`initial`].
    ///
    /// # Errors
    /// As [`FreshFiles::parse`] and [`initial`]; [`Error::Config`] if the patches of the two files differ.
    pub fn initial(&self, seed: u64) -> Result<BTreeMap<String, Tensor>> {
        let parsed = self.parse()?;
        let layers = parsed.config.text.layers;
        let (format, tokens) = (parsed.settings.number, parsed.settings.number_tokens);
        let number_ids = Numbers::new(format, tokens, &parsed.tokenizer)?.ids;
        let empty = Weights::from_tensors("fresh", Default::default());
        // Building on nothing fails, but not before each tensor was asked for.
        match SdimModel::new(parsed, &empty, &Device::Cpu) {
            Err(Error::TensorSet { .. }) => initial(&empty.wanted(), &number_ids, layers, seed),
            Err(other) => Err(other),
            Ok(_) => Err(Error::argument("layout", "no tensors", "a model with weights")),
        }
    }

    /// Writes a checkpoint directory with the initial values, in f32: where training starts.
    ///
    /// # Errors
    /// As [`FreshFiles::initial`]; [`Error::Io`].
    pub fn write_initial(&self, dir: &Path, seed: u64) -> Result<()> {
        self.write(dir)?;
        write_tensors(&dir.join(SINGLE), &self.initial(seed)?)
    }

    /// As [`FreshFiles::write_initial`], with the tensors of a checkpoint directory: where the training of a model goes on that has grown a
    /// part. Returns how many tensors the directory did not have.
    ///
    /// # Errors
    /// As [`FreshFiles::write_initial`]; [`Error::Io`] or [`Error::Format`] if the directory's files cannot be read; [`Error::Argument`] names
    /// a tensor that it has in another shape or that these files do not ask for, or says that it is asked in another way.
    pub fn write_grown(&self, dir: &Path, seed: u64, from: &Path) -> Result<usize> {
        let found = Settings::from_file(&from.join(SETTINGS))?.of_the_shape();
        let wanted = self.parse()?.settings.of_the_shape();
        if (Settings { wide_glimpse: wanted.wide_glimpse, ..found }) != wanted {
            let found = from.join(SETTINGS).display().to_string();
            return Err(Error::argument(
                "sdim.json",
                found,
                "the way of asking of the shape, but for wide crops",
            ));
        }
        let path = from.join(SINGLE);
        let bytes = std::fs::read(&path).map_err(Error::io(&path))?;
        let old = candle_core::safetensors::load_buffer(&bytes, &Device::Cpu)
            .map_err(|e| Error::format(&path, e.to_string(), "tensors in safetensors"))?;
        let mut tensors = self.initial(seed)?;
        let fresh = tensors.keys().filter(|name| !old.contains_key(*name)).count();
        for (name, tensor) in old {
            match tensors.get_mut(&name) {
                Some(own) if own.dims() == tensor.dims() => {
                    *own = tensor.to_dtype(candle_core::DType::F32)?
                }
                own => {
                    let expected = own.map_or("none".to_string(), |own| format!("{:?}", own.dims()));
                    let found = format!("{:?} in {}", tensor.dims(), path.display());
                    return Err(Error::argument("tensor", format!("{name}: {found}"), expected));
                }
            }
        }
        self.write(dir)?;
        write_tensors(&dir.join(SINGLE), &tensors)?;
        Ok(fresh)
    }

    /// Reads them from a checkpoint directory.
    ///
    /// # Errors
    /// [`Error::Io`]; [`Error::Format`] if one is no text.
    pub fn load(dir: &Path) -> Result<Self> {
        let read = |name: &str| {
            let path = dir.join(name);
            let bytes = read_text(&path)?;
            String::from_utf8(bytes).map_err(|e| Error::format(&path, e.to_string(), "text in UTF-8"))
        };
        Ok(Self {
            config: read(CONFIG)?,
            preprocessor: read(PREPROCESSOR)?,
            settings: read(SETTINGS)?,
            tokenizer: read(TOKENIZER)?,
        })
    }

    /// Their names in a checkpoint directory, and their texts.
    fn named(&self) -> [(&'static str, &str); 4] {
        [
            (CONFIG, &self.config),
            (PREPROCESSOR, &self.preprocessor),
            (SETTINGS, &self.settings),
            (TOKENIZER, &self.tokenizer),
        ]
    }

    /// Parses them as a loader would.
    ///
    /// # Errors
    /// As [`CheckpointFiles::from_bytes`].
    pub fn parse(&self) -> Result<CheckpointFiles> {
        self.parse_of(Path::new("fresh"))
    }

    /// As [`FreshFiles::parse`]; `dir` is for messages.
    pub(super) fn parse_of(&self, dir: &Path) -> Result<CheckpointFiles> {
        let [c, p, s, t] = self.named().map(|(_, text)| text.as_bytes());
        CheckpointFiles::from_bytes(&dir.display().to_string(), c, p, s, t)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_fresh_files_parse_and_any_text_survives_the_tokenizer() {
        let files = FreshFiles::tiny(&Settings::tiny()).unwrap().parse().unwrap();
        let text = "The distance is 4.230 m — größer\n\u{0}";
        let ids = files.tokenizer.encode(text).unwrap();
        assert_eq!(ids.len(), text.len(), "one token per byte");
        assert_eq!(files.tokenizer.decode(&ids).unwrap(), text);
        let marked = files.tokenizer.encode("<|vision_start|><|image_pad|>").unwrap();
        assert_eq!(marked, [files.config.ids.vision_start, files.config.ids.image]);
        assert!(files.tokenizer.vocab_size() <= files.config.text.vocab_size);
    }

    #[test]
    fn number_tokens_of_their_own_start_as_those_of_a_vocabulary() {
        let of = |number_tokens| {
            let files = FreshFiles::tiny(&Settings { number_tokens, ..Settings::tiny() }).unwrap();
            (files.parse().unwrap(), files.initial(1).unwrap())
        };
        let ((files, named), (_, rows)) = (of(NumberTokens::Vocabulary), of(NumberTokens::Rows));
        let first = files.tokenizer.id("<|d0|>").unwrap() as usize;
        let table = "model.embed_tokens.weight";
        let values = |t: &Tensor| t.flatten_all().unwrap().to_vec1::<f32>().unwrap();
        let own = &rows["sdim.number_tokens.embedding"];
        assert_eq!(values(own), values(&named[table].narrow(0, first, 1000).unwrap()));
        assert!(rows[table].dims()[0] < 300, "words alone: {:?}", rows[table].dims());
    }

    #[test]
    fn a_grown_model_keeps_what_it_had_and_starts_with_a_part_that_adds_nothing() {
        let dir = tempfile::tempdir().unwrap();
        let [old, grown] = ["old", "grown"].map(|name| dir.path().join(name));
        let before = Settings { wide_glimpse: None, ..Settings::tiny() };
        FreshFiles::tiny(&before).unwrap().write_initial(&old, 1).unwrap();
        let files = FreshFiles::tiny(&Settings::tiny()).unwrap();
        assert_eq!(files.write_grown(&grown, 2, &old).unwrap(), 3);
        let read = |dir: &Path| candle_core::safetensors::load(dir.join(SINGLE), &Device::Cpu).unwrap();
        let (known, found) = (read(&old), read(&grown));
        let values = |t: &Tensor| t.flatten_all().unwrap().to_vec1::<f32>().unwrap();
        for (name, tensor) in &found {
            match known.get(name) {
                Some(known) => assert_eq!(values(tensor), values(known), "{name}"),
                None => assert!(name.starts_with("sdim.wide_glimpse."), "{name}"),
            }
        }
        assert_eq!(found.len(), known.len() + 3);
        assert!(values(&found["sdim.wide_glimpse.down.weight"]).iter().all(|v| *v == 0.0));
        assert_eq!(FreshFiles::load(&grown).unwrap(), files);
        assert!(matches!(files.write_grown(&grown, 2, &dir.path().join("none")), Err(Error::Io { .. })));
        std::fs::write(old.join(SINGLE), "no tensors").unwrap();
        assert!(matches!(files.write_grown(&grown, 2, &old), Err(Error::Format { .. })));
        // One tensor too many, one of another shape, another way of asking.
        for name in ["lm_head.bias", "sdim.glimpse.weight"] {
            let other = [(name.to_string(), known["model.norm.weight"].clone())];
            write_tensors(&old.join(SINGLE), other.iter().map(|(n, t)| (n, t))).unwrap();
            let refused = files.write_grown(&grown, 2, &old);
            assert!(
                matches!(&refused, Err(Error::Argument { found, .. }) if found.contains(name)),
                "{refused:?}"
            );
        }
        let metres = Settings { unit: crate::query::DepthUnit::Metres, ..before };
        FreshFiles::tiny(&metres).unwrap().write_initial(&old, 1).unwrap();
        assert!(matches!(files.write_grown(&grown, 2, &old), Err(Error::Argument { .. })), "other units");
    }
}
