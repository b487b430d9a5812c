#![cfg_attr(feature = "tiny", doc = include_str!("../README.md"))]
#![cfg_attr(
    not(feature = "tiny"),
    doc = "Dense metric depth from an RGB frame and sparse depth, by asking a VLM."
)]
#![deny(missing_docs)]
#![deny(unsafe_op_in_unsafe_fn)]
#![warn(clippy::all)]

pub mod adapter;
#[cfg(feature = "benchmarks")]
pub mod benchmarks;
pub mod complete;
pub mod depth;
pub mod error;
mod files;
pub mod frame;
pub mod fusion;
#[cfg(feature = "hub")]
pub mod hub;
pub mod kernels;
pub mod model;
pub mod query;
pub mod refine;
#[cfg(any(feature = "train", feature = "benchmarks", feature = "meshes"))]
pub mod scenes;
#[cfg(feature = "train")]
pub mod supervise;
pub mod system;
pub mod vlm;

pub use complete::{CancelToken, CompleteOptions, Completion, DepthCompleter, Preserve};
pub use depth::{DepthMap, DepthScale, SparseDepth};
pub use error::{Error, Result};
pub use frame::read_rgb;
pub use kernels::WeightFormat;
pub use model::{LoadOptions, SdimModel};
pub use query::{AnswerMode, QueryPlan};
