//! The examples' programs as this build of the tests makes them.
//!
//! `target/release/examples/NAME` is whatever was built last, perhaps with other features or from older sources. cargo is
//! asked instead, with the features, profile and target of the running test: what `cargo test` has just built is found to be
//! fresh, and what was not asked for is built now.

use serde_json::Value;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::{Mutex, PoisonError};

macro_rules! features {
    ($($name:tt)*) => {
        [$(($name, cfg!(feature = $name))),*]
    };
}

/// All features of the crate, and whether this build has them. A test compares the names with the manifest.
pub const FEATURES: [(&str, bool); 14] = features![
    "default" "tiny" "train" "benchmarks" "meshes" "formats" "tiff" "exr" "hub" "cuda" "cudnn" "metal" "accelerate" "mkl"
];

/// The example's program. cargo is asked once per process and example.
pub fn program(name: &str) -> PathBuf {
    static BUILT: Mutex<BTreeMap<String, PathBuf>> = Mutex::new(BTreeMap::new());
    let mut built = BUILT.lock().unwrap_or_else(PoisonError::into_inner);
    if let Some(path) = built.get(name) {
        return path.clone();
    }
    let path = build(name);
    built.insert(name.into(), path.clone());
    path
}

fn build(name: &str) -> PathBuf {
    let features: Vec<&str> = FEATURES.into_iter().filter_map(|(name, on)| on.then_some(name)).collect();
    let place = Place::of(&std::env::current_exe().unwrap());
    // Whatever is needed was fetched to build this test, so that a network is not.
    let mut cargo = Command::new(std::env::var_os("CARGO").unwrap_or(env!("CARGO").into()));
    cargo.args([
        "build",
        "--frozen",
        "--quiet",
        "--message-format=json-render-diagnostics",
        "--example",
        name,
    ]);
    cargo.args(["--no-default-features", "--features", &features.join(",")]);
    cargo.arg("--profile").arg(&place.profile).arg("--target-dir").arg(&place.root);
    if let Some(triple) = &place.triple {
        cargo.arg("--target").arg(triple);
    }
    // cargo tells a running test about its package. Build scripts that watch such a variable, as ring's does, would run again.
    let of_this_package = |name: &str| name.starts_with("CARGO_PKG_") || name.starts_with("CARGO_MANIFEST_");
    for (name, _) in std::env::vars_os().filter(|(name, _)| name.to_str().is_some_and(of_this_package)) {
        cargo.env_remove(name);
    }
    cargo.current_dir(env!("CARGO_MANIFEST_DIR")).stdin(Stdio::null()).stderr(Stdio::inherit());
    let out = cargo.output().unwrap();
    assert!(out.status.success(), "{cargo:?}: {}", out.status);
    let messages = out.stdout.split(|&b| b == b'\n').filter_map(|l| serde_json::from_slice::<Value>(l).ok());
    let programs = messages.filter(|m| m["target"]["name"] == name && m["target"]["kind"][0] == "example");
    let path = programs.filter_map(|m| m["executable"].as_str().map(PathBuf::from)).next_back();
    path.unwrap_or_else(|| panic!("{cargo:?} names no program"))
}

/// Where cargo has put this test.
#[derive(Debug, PartialEq)]
pub struct Place {
    /// The target directory.
    pub root: PathBuf,
    /// Set if a target was named.
    pub triple: Option<String>,
    /// Name of the profile.
    pub profile: String,
}

impl Place {
    /// From the path of a test's program, `ROOT[/TRIPLE]/PROFILE/deps/NAME`.
    pub fn of(test: &Path) -> Self {
        let name = |dir: &Path| dir.file_name().unwrap().to_str().unwrap().to_string();
        let profile = test.ancestors().nth(2).unwrap();
        let above = profile.parent().unwrap();
        // What cargo leaves in a root; the first not if the folder was there before.
        let is_root = ["CACHEDIR.TAG", ".rustc_info.json"].iter().any(|file| above.join(file).exists());
        let profile = match name(profile) {
            debug if debug == "debug" => "dev".into(),
            other => other,
        };
        match above.parent() {
            Some(root) if !is_root => Self { root: root.into(), triple: Some(name(above)), profile },
            _ => Self { root: above.into(), triple: None, profile },
        }
    }
}
