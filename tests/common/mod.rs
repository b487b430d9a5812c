//! What several integration tests share: golden tensors of the reference implementation and their comparison with ours,
//! the examples' programs.
#![allow(dead_code)]

pub mod program;
pub mod random;
pub mod tiny;

use candle_core::{DType, Device, Tensor};
use sdim::internals::query::Reading;
use sdim::{LoadOptions, WeightFormat};
use std::cell::RefCell;
use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::path::{Path, PathBuf};
use std::sync::LazyLock;

/// Largest accepted difference, relative to the largest magnitude of the golden tensor. Rounding noise of f32 stays
/// under 3e-5; each of the mistakes that one can make in this architecture shows at 8e-4 or more.
pub const TOLERANCE: f64 = 2e-4;

/// Largest accepted difference of a model in bf16, in those of the reference in bf16, both from the reference in f32. On the CPU
/// activations are rounded before products alone; another device rounds what products give, too, as the reference does.
pub fn allowed_of_gap() -> f64 {
    if device().is_cpu() { 1.0 } else { 1.25 }
}

/// The device that tests run on: the one that `SDIM_TEST_DEVICE` names (`cuda:0`), else the CPU. The same one for all tests of a program.
pub fn device() -> Device {
    static DEVICE: LazyLock<Device> = LazyLock::new(|| {
        let name = std::env::var("SDIM_TEST_DEVICE").unwrap_or_else(|_| "cpu".into());
        sdim::system::device(&name).unwrap()
    });
    DEVICE.clone()
}

/// Loads to [`device`]: on the CPU in its own format, elsewhere in f32, whose answers depend on their batch least.
pub fn load_options() -> LoadOptions {
    let mut options = LoadOptions::on(&device());
    if !device().is_cpu() {
        options.weights = WeightFormat::F32;
    }
    options
}

/// The folder of the crate: where `CARGO_MANIFEST_DIR` says when the test runs, else where it was built.
pub fn root() -> PathBuf {
    std::env::var_os("CARGO_MANIFEST_DIR").map_or_else(|| env!("CARGO_MANIFEST_DIR").into(), PathBuf::from)
}

/// What differences are accepted.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Allowed {
    /// [`TOLERANCE`] everywhere, and the same answers.
    Rounding,
    /// What the reference in bf16 differs from itself in f32, over all cases of a model together: the root mean square
    /// of the differences at each stage, and the largest difference anywhere. Both runs round, and differently, so that
    /// the largest difference of one tensor is chance. Answers may differ.
    Bf16Gap,
}

/// Squared sum, then largest, of differences of one stage over several cases, each over its case's largest magnitude.
#[derive(Default)]
struct Pooled {
    ours: [f64; 2],
    reference: [f64; 2],
}

impl Pooled {
    /// `gap`: the reference's largest difference and root mean square.
    fn add(&mut self, ours: &Tensor, wanted: &Tensor, gap: &[f64]) {
        let (ours, wanted) = (values(ours), values(wanted));
        let scale = f64::from(wanted.iter().fold(0f32, |m, v| m.max(v.abs())));
        for (a, b) in ours.iter().zip(&wanted) {
            let difference = (f64::from(*a) - f64::from(*b)).abs() / scale;
            self.ours[0] += difference * difference;
            // A value that is no number must not pass.
            self.ours[1] = if difference.is_nan() { f64::INFINITY } else { self.ours[1].max(difference) };
        }
        self.reference[0] += gap[1] * gap[1] * ours.len() as f64;
        self.reference[1] = self.reference[1].max(gap[0]);
    }
}

/// The golden tensors of one file, and what was compared with them so far.
pub struct Golden {
    /// Directory of the file.
    pub dir: PathBuf,
    pub allowed: Allowed,
    name: String,
    /// Of each tensor, the reference's difference between bf16 and f32 over its largest magnitude.
    gaps: HashMap<String, Vec<f64>>,
    tensors: HashMap<String, Tensor>,
    seen: RefCell<BTreeSet<String>>,
    pooled: RefCell<BTreeMap<String, Pooled>>,
    differences: RefCell<Vec<(f64, String)>>,
    failures: RefCell<Vec<String>>,
}

impl Golden {
    pub fn open(dir: &Path) -> Self {
        Self::file(&dir.join("golden.safetensors"), Allowed::Rounding)
    }

    /// Floats may be stored as i16, as multiples of `{key}.max / 32767`; `{key}.bf16` is the gap of the key.
    pub fn file(path: &Path, allowed: Allowed) -> Self {
        let mut stored = candle_core::safetensors::load(path, &Device::Cpu).expect("golden tensors");
        let mut extra = |suffix: &str| -> HashMap<String, Vec<f64>> {
            let keys: Vec<String> = stored.keys().filter(|k| k.ends_with(suffix)).cloned().collect();
            let value = |t: Tensor| t.to_dtype(DType::F64).unwrap().to_vec1().unwrap();
            keys.iter()
                .map(|k| (k.trim_end_matches(suffix).to_string(), value(stored.remove(k).unwrap())))
                .collect()
        };
        let (largest, gaps) = (extra(".max"), extra(".bf16"));
        let widened = |key: &str, tensor: Tensor| match largest.get(key) {
            Some(largest) => (tensor.to_dtype(DType::F32).unwrap() * (largest[0] / 32767.0)).unwrap(),
            None => tensor,
        };
        let tensors = stored.into_iter().map(|(key, t)| (key.clone(), widened(&key, t))).collect();
        let name = path.file_stem().unwrap().to_string_lossy().into_owned();
        let (seen, pooled, differences, failures) = Default::default();
        let dir = path.parent().unwrap().to_path_buf();
        Self { dir, allowed, name, gaps, tensors, seen, pooled, differences, failures }
    }

    pub fn has(&self, key: &str) -> bool {
        self.tensors.contains_key(key)
    }

    /// The golden tensor, which counts as compared from now on.
    pub fn take(&self, key: &str) -> Option<&Tensor> {
        let tensor = self.tensors.get(key)?;
        self.seen.borrow_mut().insert(key.to_string());
        Some(tensor)
    }

    pub fn integers(&self, key: &str) -> Vec<i64> {
        let tensor = self.take(key).unwrap_or_else(|| panic!("no golden tensor {key}"));
        tensor.to_dtype(DType::I64).unwrap().flatten_all().unwrap().to_vec1().unwrap()
    }

    fn fail(&self, what: String) {
        self.failures.borrow_mut().push(what);
    }

    /// Integers must be the same. A key that the directory lacks is passed over.
    pub fn exact(&self, key: &str, ours: impl IntoIterator<Item = i64>) {
        if !self.has(key) {
            return;
        }
        let (ours, wanted) = (ours.into_iter().collect::<Vec<_>>(), self.integers(key));
        if ours.len() != wanted.len() {
            self.fail(format!("{key}: {} values instead of {}", ours.len(), wanted.len()));
        } else if let Some(first) = ours.iter().zip(&wanted).position(|(a, b)| a != b) {
            let wrong = ours.iter().zip(&wanted).filter(|(a, b)| a != b).count();
            self.fail(format!("{key}: {wrong} of {} values differ, the first at {first}", ours.len()));
        }
    }

    /// Floats must agree as [`Allowed`] says. A key that the directory lacks is passed over.
    pub fn close(&self, key: &str, ours: &Tensor) {
        let Some(wanted) = self.take(key) else { return };
        if ours.dims() != wanted.dims() {
            return self.fail(format!("{key}: shape {:?} instead of {:?}", ours.dims(), wanted.dims()));
        }
        // Where the reference computes in f32 even in bf16, so do we.
        if self.allowed == Allowed::Bf16Gap && self.gaps[key][0] > TOLERANCE {
            let stage = key.split_once('.').map_or(key, |(_, stage)| stage);
            // One row of logits hangs on one hidden state: too little to be compared alone.
            let stage = if stage.ends_with("logits") { "logits" } else { stage };
            let mut pooled = self.pooled.borrow_mut();
            return pooled.entry(stage.to_string()).or_default().add(ours, wanted, &self.gaps[key]);
        }
        let difference = relative_difference(ours, wanted);
        if difference <= TOLERANCE {
            self.differences.borrow_mut().push((difference / TOLERANCE, format!("{key} {difference:.1e}")));
        } else {
            self.fail(format!("{key}: differs by {difference:.2e} of the largest value"));
        }
    }

    /// Compares the pooled differences with the reference's own.
    fn judge_pooled(&self) {
        let mut largest = [0f64; 2];
        for (stage, pooled) in self.pooled.borrow().iter() {
            let rms = (pooled.ours[0] / pooled.reference[0]).sqrt();
            self.judge_part(rms, &format!("rms of {stage}"));
            largest = [largest[0].max(pooled.ours[1]), largest[1].max(pooled.reference[1])];
        }
        if largest[1] > 0.0 {
            self.judge_part(largest[0] / largest[1], "largest of all stages");
        }
    }

    fn judge_part(&self, part: f64, what: &str) {
        if part <= allowed_of_gap() {
            self.differences.borrow_mut().push((part, what.to_string()));
        } else {
            self.fail(format!("{what}: {part:.2} of the reference's own difference between bf16 and f32"));
        }
    }

    /// A line with the worst differences; or, in the order of comparison, so that the first names the cause, what did
    /// not agree or was never compared.
    pub fn finish(&self) -> Result<String, Vec<String>> {
        self.judge_pooled();
        let seen = self.seen.borrow();
        let mut failures = self.failures.borrow().clone();
        let unread = self.tensors.keys().filter(|k| !seen.contains(*k) && !k.ends_with("_torchvision"));
        failures.extend(unread.map(|k| format!("{k}: never compared")));
        if !failures.is_empty() {
            return Err(failures);
        }
        let mut differences = self.differences.borrow().clone();
        differences.sort_by(|a, b| b.0.total_cmp(&a.0));
        let worst: Vec<String> =
            differences.iter().take(4).map(|(part, k)| format!("{k} ({:.0} %)", part * 100.0)).collect();
        let worst = worst.join(", ");
        Ok(format!("{}: {} tensors agree; nearest to what is allowed: {worst}", self.name, seen.len()))
    }
}

/// Largest absolute difference over the largest magnitude of `wanted`; infinite where a value is no number.
pub fn relative_difference(ours: &Tensor, wanted: &Tensor) -> f64 {
    let (ours, wanted) = (values(ours), values(wanted));
    assert_eq!(ours.len(), wanted.len(), "number of values");
    if ours.iter().any(|v| !v.is_finite()) {
        return f64::INFINITY;
    }
    let largest = wanted.iter().fold(0f32, |m, v| m.max(v.abs()));
    let difference = ours.iter().zip(&wanted).fold(0f32, |m, (a, b)| m.max((a - b).abs()));
    if difference == 0.0 { 0.0 } else { f64::from(difference) / f64::from(largest) }
}

fn values(tensor: &Tensor) -> Vec<f32> {
    tensor.to_dtype(DType::F32).unwrap().flatten_all().unwrap().to_vec1().unwrap()
}

/// Two readings of one query agree to 1e-3: ten times what is allowed of the states that they are read from, since
/// exponentials and quotients lie between.
pub fn close(what: &str, a: &Reading, b: &Reading) {
    for (name, a, b) in [
        ("value", a.value, b.value),
        ("confidence", a.confidence, b.confidence),
        ("expected error", a.expected_error, b.expected_error),
    ] {
        let difference = f64::from((a - b).abs() / a.abs().max(b.abs()).max(1e-3));
        assert!(difference <= 1e-3, "{what}: {name} {a} and {b}");
    }
}

/// A folder that may lie beside the repository, if it holds `file`; says so if not.
pub fn beside(folder: &str, file: &str) -> Option<PathBuf> {
    let dir = root().join("../shared").join(folder);
    if !dir.join(file).exists() {
        println!("skipped: {} is not there", dir.join(file).display());
        return None;
    }
    Some(dir)
}
