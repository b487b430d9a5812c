//! What is compared: checkpoints and baselines.

use crate::common::load_as;
use crate::{Args, settings};
use anyhow::{Context, bail, ensure};
use image::RgbImage;
use sdim::classical::Baseline;
use sdim::{CompleteOptions, DepthCompleter, DepthMap, SparseDepth};
use std::path::Path;

/// One column of the table.
pub struct Method {
    pub name: String,
    /// Tells two checkpoints of one name apart; empty for a baseline.
    pub fingerprint: String,
    kind: Kind,
}

enum Kind {
    Baseline(Baseline),
    Checkpoint(Box<(DepthCompleter, CompleteOptions)>),
}

/// A method's result for a frame.
pub enum Answer {
    /// Depth alone, metres.
    Depth(Vec<f32>),
    /// Depth with confidence.
    Map(Box<DepthMap>),
}

impl Answer {
    pub fn depth(&self) -> &[f32] {
        match self {
            Answer::Depth(depth) => depth,
            Answer::Map(map) => map.depth(),
        }
    }
}

impl Method {
    pub fn complete(&self, rgb: &RgbImage, sparse: &SparseDepth) -> sdim::Result<Answer> {
        Ok(match &self.kind {
            Kind::Baseline(baseline) => Answer::Depth(baseline.complete(rgb, sparse)?),
            Kind::Checkpoint(checkpoint) => {
                let (completer, options) = &**checkpoint;
                Answer::Map(Box::new(completer.complete(rgb, sparse, options)?))
            }
        })
    }
}

/// Loads the checkpoints asked for, in their order, then the baselines; or those of them named by --methods.
pub fn load_all(args: &Args) -> anyhow::Result<Vec<Method>> {
    let tiny = ["tiny".to_string()];
    let checkpoints = if args.checkpoint.is_empty() { &tiny[..] } else { &args.checkpoint };
    ensure!(
        args.adapter.is_none() || args.checkpoint.len() == 1,
        "--adapter goes with exactly one --checkpoint, found {}",
        args.checkpoint.len()
    );
    let names: Vec<String> =
        checkpoints.iter().map(|c| checkpoint_name(c, args.adapter.as_deref())).collect();
    for (i, name) in names.iter().enumerate() {
        let taken = names[..i].contains(name) || name.parse::<Baseline>().is_ok();
        ensure!(
            !taken,
            "--checkpoint {}: its name, {name:?}, is taken; rename the directory",
            checkpoints[i]
        );
    }
    let all = || names.iter().map(String::as_str).chain(Baseline::ALL.map(Baseline::name));
    if let Some(unknown) = args.methods.iter().find(|m| !all().any(|name| name == *m)) {
        bail!("--methods {unknown}: expected some of {}", all().collect::<Vec<_>>().join(", "));
    }
    let wanted = |name: &str| args.methods.is_empty() || args.methods.iter().any(|m| m == name);
    let (mut methods, options) = (Vec::new(), args.options()?);
    for (checkpoint, name) in checkpoints.iter().zip(&names).filter(|(_, name)| wanted(name)) {
        let completer =
            load_as(checkpoint, &options).with_context(|| format!("--checkpoint {checkpoint}"))?;
        let asking = CompleteOptions::default()
            .with_plan(args.plan)
            .with_readout(args.readout)
            .with_outliers(args.outliers);
        methods.push(Method {
            name: name.clone(),
            fingerprint: settings::fingerprint(checkpoint, args.adapter.as_deref())?,
            kind: Kind::Checkpoint(Box::new((completer, asking))),
        });
    }
    for baseline in Baseline::ALL.into_iter().filter(|b| wanted(b.name())) {
        let name = baseline.name().to_string();
        methods.push(Method { name, fingerprint: String::new(), kind: Kind::Baseline(baseline) });
    }
    Ok(methods)
}

/// The last part of a checkpoint's path, with that of the adapter.
fn checkpoint_name(checkpoint: &str, adapter: Option<&Path>) -> String {
    let last =
        |path: &Path| path.file_name().map_or(path.display().to_string(), |n| n.to_string_lossy().into());
    let base = if checkpoint == "tiny" { "sdim-tiny".to_string() } else { last(Path::new(checkpoint)) };
    match adapter {
        Some(adapter) => format!("{base}+{}", last(adapter)),
        None => base,
    }
}
