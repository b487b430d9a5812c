//! The variables that the hub's Python library reads.

use super::settings::Hub;
use crate::error::{Error, Result};
use std::path::{Path, PathBuf};

const ENDPOINT: &str = "https://huggingface.co";

/// One variable's value; `None` if unset.
type Lookup<'a> = &'a dyn Fn(&str) -> Option<String>;

impl Hub {
    /// The hub and cache that the environment describes, as for the Python library.
    ///
    /// # Errors
    /// [`Error::Argument`] if no variable says where the cache is and there is no home directory.
    pub fn from_env() -> Result<Self> {
        Self::from_vars(&|name| std::env::var(name).ok(), std::env::home_dir())
    }

    fn from_vars(lookup: Lookup, home: Option<PathBuf>) -> Result<Self> {
        let home = home.filter(|dir| !dir.as_os_str().is_empty());
        let var = |name: &str| lookup(name).map(|v| v.trim().to_string()).filter(|v| !v.is_empty());
        let dir = |name: &str| var(name).map(|v| expand(&v, home.as_deref()));
        let cache = dir("XDG_CACHE_HOME").or_else(|| home.as_ref().map(|h| h.join(".cache")));
        let hf_home = dir("HF_HOME").or_else(|| cache.map(|c| c.join("huggingface")));
        let hub = dir("HF_HUB_CACHE")
            .or_else(|| dir("HUGGINGFACE_HUB_CACHE"))
            .or_else(|| hf_home.as_ref().map(|h| h.join("hub")));
        let Some(hub) = hub else {
            return Err(Error::argument("HF_HOME", "unset", "a folder, as there is no home directory"));
        };
        // The client makes links between paths of the cache and needs to know where both are.
        let cache = std::path::absolute(&hub).map_err(Error::io(&hub))?;
        let endpoint = var("HF_ENDPOINT").unwrap_or_else(|| ENDPOINT.to_string());
        Ok(Self {
            cache,
            endpoint: endpoint.trim_end_matches('/').to_string(),
            token: token(&var, dir("HF_TOKEN_PATH").or_else(|| hf_home.map(|h| h.join("token")))),
            offline: is_true(var("HF_HUB_OFFLINE").or_else(|| var("TRANSFORMERS_OFFLINE"))),
            progress: None,
        })
    }
}

fn token(var: Lookup, file: Option<PathBuf>) -> Option<String> {
    if is_true(var("HF_HUB_DISABLE_IMPLICIT_TOKEN")) {
        return None;
    }
    let stored = || std::fs::read_to_string(file?).ok().map(|t| t.trim().to_string());
    var("HF_TOKEN")
        .or_else(|| var("HUGGING_FACE_HUB_TOKEN"))
        .or_else(stored)
        .filter(|token| !token.is_empty())
}

fn is_true(value: Option<String>) -> bool {
    value.is_some_and(|v| ["1", "ON", "YES", "TRUE"].contains(&v.to_ascii_uppercase().as_str()))
}

fn expand(path: &str, home: Option<&Path>) -> PathBuf {
    match (path.strip_prefix('~'), home) {
        (Some(""), Some(home)) => home.to_path_buf(),
        (Some(rest), Some(home)) if rest.starts_with('/') => home.join(rest.trim_start_matches('/')),
        _ => PathBuf::from(path),
    }
}

#[cfg(all(test, unix))]
mod tests {
    use super::*;

    fn hub(vars: &[(&str, &str)]) -> Hub {
        let find = |name: &str| vars.iter().find(|(n, _)| *n == name).map(|(_, v)| v.to_string());
        Hub::from_vars(&find, Some("/home/u".into())).unwrap()
    }

    #[test]
    fn the_cache_is_where_the_most_specific_variable_says() {
        let cases: [(&[(&str, &str)], &str); 8] = [
            (&[], "/home/u/.cache/huggingface/hub"),
            (&[("XDG_CACHE_HOME", "/x")], "/x/huggingface/hub"),
            (&[("XDG_CACHE_HOME", "/x"), ("HF_HOME", "/h")], "/h/hub"),
            (&[("HF_HOME", "~/h")], "/home/u/h/hub"),
            (&[("HF_HOME", "")], "/home/u/.cache/huggingface/hub"),
            (&[("HF_HOME", "/h"), ("HUGGINGFACE_HUB_CACHE", "/old")], "/old"),
            (&[("HUGGINGFACE_HUB_CACHE", "/old"), ("HF_HUB_CACHE", "/new")], "/new"),
            (&[("HF_HUB_CACHE", "~")], "/home/u"),
        ];
        for (vars, wanted) in cases {
            assert_eq!(hub(vars).cache, Path::new(wanted), "{vars:?}");
        }
        assert!(hub(&[("HF_HUB_CACHE", "here")]).cache.is_absolute());
        let homeless = |vars: Option<&str>| Hub::from_vars(&|_| vars.map(String::from), None);
        assert!(matches!(homeless(None), Err(Error::Argument { name: "HF_HOME", .. })));
        assert!(homeless(Some("/c")).is_ok());
    }

    #[test]
    fn offline_endpoint_and_token() {
        let plain = hub(&[("HF_HOME", "/none")]);
        assert_eq!((plain.offline, plain.endpoint.as_str(), &plain.token), (false, ENDPOINT, &None));
        for (name, value, wanted) in [
            ("HF_HUB_OFFLINE", "1", true),
            ("HF_HUB_OFFLINE", "yes", true),
            ("HF_HUB_OFFLINE", "0", false),
            ("TRANSFORMERS_OFFLINE", "True", true),
        ] {
            assert_eq!(hub(&[(name, value)]).offline, wanted, "{name}={value}");
        }
        assert_eq!(hub(&[("HF_ENDPOINT", "http://mirror/")]).endpoint, "http://mirror");
        let dir = tempfile::tempdir().unwrap();
        std::fs::write(dir.path().join("token"), "stored\n").unwrap();
        let home = ("HF_HOME", dir.path().to_str().unwrap());
        assert_eq!(hub(&[home]).token.as_deref(), Some("stored"));
        assert_eq!(hub(&[home, ("HF_TOKEN", "given")]).token.as_deref(), Some("given"));
        let off = ("HF_HUB_DISABLE_IMPLICIT_TOKEN", "1");
        assert_eq!(hub(&[home, off]).token, None);
    }
}
