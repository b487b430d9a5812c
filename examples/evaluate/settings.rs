//! What an evaluation is, so that results of different ones are never mixed.

use crate::methods::Method;
use crate::record::{read_json, write_json};
use crate::{Args, Score, frames as source, record};
use anyhow::{Context, ensure};
use sdim::benchmarks::Dataset;
use serde::{Deserialize, Serialize};
use serde_json::Value;
use std::fs::{self, File};
use std::io::{Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

/// Everything that the scores depend on. Paths are left out: a data set may lie elsewhere on each machine.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Settings {
    pub version: String,
    pub layout: String,
    /// Number of frames, and a number made from their names.
    pub frames: usize,
    pub names: String,
    /// 0: those of the data set.
    pub points: Vec<usize>,
    pub pattern: String,
    /// Whether points are drawn where frames have their own.
    pub resample: bool,
    pub score: Score,
    pub seed: u64,
    pub range: Option<(f32, f32)>,
    /// Units per metre of integer files, if given.
    pub depth_scale: Option<f32>,
    pub plan: String,
    pub readout: String,
    pub outliers: String,
    /// How matrices of checkpoints are held: scores differ in their last digits.
    pub weights: String,
    /// Names of the methods, and numbers made from their files.
    pub methods: Vec<(String, String)>,
}

impl Settings {
    pub fn new(args: &Args, frames: &dyn Dataset, methods: &[Method]) -> anyhow::Result<Self> {
        let count = source::count(args, frames)?;
        let mut names = Fnv::default();
        (0..count).for_each(|i| names.add(frames.name(i).as_bytes()));
        Ok(Self {
            version: env!("CARGO_PKG_VERSION").to_string(),
            layout: match (&args.data, args.furnished) {
                (Some(_), _) => args.layout.name(),
                (None, Some(_)) => "furnished",
                (None, None) => "procedural",
            }
            .to_string(),
            frames: count,
            names: names.text(),
            points: args.points(source::all_own(args, frames)?)?,
            pattern: args.pattern_name().to_string(),
            resample: args.resample,
            score: args.score,
            seed: args.seed,
            range: args.range,
            depth_scale: args.depth_scale.map(|s| s.units()),
            plan: args.plan.to_string(),
            readout: args.readout.to_string(),
            outliers: args.outliers.to_string(),
            weights: args.options()?.weights.to_string(),
            methods: methods.iter().map(|m| (m.name.clone(), m.fingerprint.clone())).collect(),
        })
    }

    pub fn read(dir: &Path) -> anyhow::Result<Self> {
        read_json(&path(dir))?.with_context(|| {
            format!("{}: no such file; expected a folder written by --out", path(dir).display())
        })
    }

    /// Takes up an evaluation in `dir`, or starts one there.
    pub fn enter(&self, dir: &Path) -> anyhow::Result<()> {
        fs::create_dir_all(dir).with_context(|| dir.display().to_string())?;
        match read_json::<Settings>(&path(dir))? {
            None => write_json(&path(dir), self),
            Some(found) => self.expect(&found, &path(dir)),
        }
    }

    /// Fails unless another folder's settings are these, naming the first that is not.
    pub fn expect(&self, found: &Settings, file: &Path) -> anyhow::Result<()> {
        let (here, there) = (serde_json::to_value(self)?, serde_json::to_value(found)?);
        let keys = here.as_object().into_iter().flatten();
        for (key, value) in keys {
            let other = there.get(key).unwrap_or(&Value::Null);
            ensure!(
                other == value,
                "{}: results of another evaluation: `{key}` is {other} there and {value} here; give another --out",
                file.display()
            );
        }
        Ok(())
    }
}

fn path(dir: &Path) -> PathBuf {
    dir.join(record::SETTINGS)
}

/// The hash of Fowler, Noll and Vo, 64 bits (FNV-1a), over pieces.
pub struct Fnv(u64);

impl Default for Fnv {
    fn default() -> Self {
        Self(0xcbf2_9ce4_8422_2325)
    }
}

impl Fnv {
    pub fn text(&self) -> String {
        format!("{:016x}", self.0)
    }

    pub fn add(&mut self, piece: &[u8]) {
        // The end of a piece counts, so that "ab", "c" is not "a", "bc".
        for byte in piece.iter().chain(&[0xff]) {
            self.0 = (self.0 ^ u64::from(*byte)).wrapping_mul(0x0100_0000_01b3);
        }
    }
}

/// Pieces of a file that are looked at, and their length.
const PIECES: u64 = 64;
const PIECE: u64 = 4096;

/// A number made from a checkpoint's files: their names, lengths and 64 pieces of each, so that a checkpoint trained on is noticed
/// and one of many gigabytes need not be read as a whole.
pub fn fingerprint(checkpoint: &str, adapter: Option<&Path>) -> anyhow::Result<String> {
    let embedded = Path::new(env!("CARGO_MANIFEST_DIR")).join("assets/sdim-tiny");
    let base = if checkpoint == "tiny" { embedded } else { PathBuf::from(checkpoint) };
    let mut hash = Fnv::default();
    for dir in [Some(base.as_path()), adapter].into_iter().flatten() {
        // The program may run where its sources are not; the embedded files are then those of its version.
        if dir.is_dir() {
            directory(dir, &mut hash).with_context(|| dir.display().to_string())?;
        }
    }
    Ok(hash.text())
}

fn directory(dir: &Path, hash: &mut Fnv) -> std::io::Result<()> {
    let mut files: Vec<PathBuf> =
        fs::read_dir(dir)?.map(|e| Ok(e?.path())).collect::<std::io::Result<_>>()?;
    files.retain(|f| f.extension().is_some_and(|e| e == "json" || e == "safetensors"));
    files.sort();
    for path in files {
        let mut file = File::open(&path)?;
        let length = file.metadata()?.len();
        hash.add(path.file_name().unwrap_or_default().as_encoded_bytes());
        hash.add(&length.to_le_bytes());
        for piece in 0..PIECES {
            file.seek(SeekFrom::Start(length / PIECES * piece))?;
            let mut bytes = Vec::new();
            // Short files are read once, whole.
            let take = if length < PIECES * PIECE { length } else { PIECE };
            file.by_ref().take(take).read_to_end(&mut bytes)?;
            hash.add(&bytes);
            if length < PIECES * PIECE {
                break;
            }
        }
    }
    Ok(())
}
