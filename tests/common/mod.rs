//! What several integration tests share: golden tensors of the reference implementation and their comparison with ours,
//! the examples' programs.
#![allow(dead_code)]

pub mod tiny;

use candle_core::{DType, Device, Tensor};
use std::cell::RefCell;
use std::collections::{BTreeSet, HashMap};
use std::path::{Path, PathBuf};
use std::process::Command;

/// Largest accepted difference, relative to the largest magnitude of the golden tensor. Rounding noise of f32 stays
/// under 3e-5; each of the mistakes that one can make in this architecture shows at 8e-4 or more.
pub const TOLERANCE: f64 = 2e-4;

/// The golden tensors of one directory, and what was compared with them so far.
pub struct Golden {
    pub dir: PathBuf,
    tensors: HashMap<String, Tensor>,
    seen: RefCell<BTreeSet<String>>,
    differences: RefCell<Vec<(f64, String)>>,
    failures: RefCell<Vec<String>>,
}

impl Golden {
    pub fn open(dir: &Path) -> Self {
        let path = dir.join("golden.safetensors");
        let tensors = candle_core::safetensors::load(&path, &Device::Cpu).expect("golden.safetensors");
        let (seen, differences, failures) = Default::default();
        Self { dir: dir.to_path_buf(), tensors, seen, differences, failures }
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

    /// Floats must agree to [`TOLERANCE`]. A key that the directory lacks is passed over.
    pub fn close(&self, key: &str, ours: &Tensor) {
        let Some(wanted) = self.take(key) else { return };
        if ours.dims() != wanted.dims() {
            return self.fail(format!("{key}: shape {:?} instead of {:?}", ours.dims(), wanted.dims()));
        }
        let difference = relative_difference(ours, wanted);
        if difference <= TOLERANCE {
            self.differences.borrow_mut().push((difference, key.to_string()));
        } else {
            self.fail(format!("{key}: differs by {difference:.2e} of the largest value"));
        }
    }

    /// A line with the worst differences; or, in the order of comparison, so that the first names the cause, what did
    /// not agree or was never compared.
    pub fn finish(&self) -> Result<String, Vec<String>> {
        let seen = self.seen.borrow();
        let mut failures = self.failures.borrow().clone();
        let unread = self.tensors.keys().filter(|k| !seen.contains(*k) && !k.ends_with("_torchvision"));
        failures.extend(unread.map(|k| format!("{k}: never compared")));
        if !failures.is_empty() {
            return Err(failures);
        }
        let mut differences = self.differences.borrow().clone();
        differences.sort_by(|a, b| b.0.total_cmp(&a.0));
        let worst: Vec<String> = differences.iter().take(4).map(|(d, k)| format!("{k} {d:.1e}")).collect();
        Ok(format!("{}: {} tensors agree; worst: {}", self.dir.display(), seen.len(), worst.join(", ")))
    }
}

/// Largest absolute difference over the largest magnitude of `wanted`; infinite where a value is no number.
pub fn relative_difference(ours: &Tensor, wanted: &Tensor) -> f64 {
    let values = |t: &Tensor| -> Vec<f32> {
        t.to_dtype(DType::F32).unwrap().flatten_all().unwrap().to_vec1().unwrap()
    };
    let (ours, wanted) = (values(ours), values(wanted));
    assert_eq!(ours.len(), wanted.len(), "number of values");
    if ours.iter().any(|v| !v.is_finite()) {
        return f64::INFINITY;
    }
    let largest = wanted.iter().fold(0f32, |m, v| m.max(v.abs()));
    let difference = ours.iter().zip(&wanted).fold(0f32, |m, (a, b)| m.max((a - b).abs()));
    if difference == 0.0 { 0.0 } else { f64::from(difference) / f64::from(largest) }
}

/// The example's program, built if `cargo test` was asked for this test alone.
pub fn program(name: &str) -> PathBuf {
    let test = std::env::current_exe().unwrap();
    let profile = test.parent().unwrap().parent().unwrap();
    let path = profile.join("examples").join(format!("{name}{}", std::env::consts::EXE_SUFFIX));
    if !path.exists() {
        let mut cargo = Command::new(env!("CARGO"));
        cargo.args(["build", "--example", name]).current_dir(env!("CARGO_MANIFEST_DIR"));
        if profile.ends_with("release") {
            cargo.arg("--release");
        }
        assert!(cargo.status().unwrap().success());
    }
    path
}
