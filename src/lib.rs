//! Dense metric depth from an RGB frame and sparse depth, by asking a vision-language model how far each pixel is.
//!
//! # The way of a frame
//!
//! 1. The picture is resized as the checkpoint wants it; the measurements are scattered into it, never interpolated.
//! 2. The fusion block turns both into an image that is added to the picture's patches (Eq. 1 to 3a of the paper).
//! 3. The vision encoder makes image tokens of the patches.
//! 4. Text, image tokens and measurements (numbers at their pixels) are read once: the shared prefix.
//! 5. A [`QueryPlan`] says which pixels are asked.
//! 6. Each question is a short suffix that names its pixel; thousands are read in one batch against the prefix.
//! 7. Each answer is a distribution over numbers: a depth, a confidence, an expected error.
//! 8. Answers are aligned, so that the map passes through the measurements.
//! 9. Pixels that were not asked are filled along surfaces, never across a depth edge.
//! 10. Measured pixels keep their measurement bit for bit: a [`DepthMap`].
//!
//! [`DepthCompleter::complete`] does all of it:
//!
//! ```
//! # #[cfg(feature = "tiny")]
//! # fn main() -> sdim::Result<()> {
//! use sdim::{CompleteOptions, DepthCompleter, QueryPlan, SparseDepth};
//!
//! let completer = DepthCompleter::tiny()?; // share it between threads; clones are cheap
//! let rgb = image::RgbImage::from_pixel(64, 48, image::Rgb([90, 120, 60]));
//! let sparse = SparseDepth::from_points(64, 48, &[(5, 5, 2.0), (60, 8, 2.5), (30, 40, 1.2)])?; // x, y, metres
//! let options = CompleteOptions::default().with_plan(QueryPlan::Stride(2));
//! let dense = completer.complete(&rgb, &sparse, &options)?;
//! assert_eq!(dense.get(30, 40), Some(1.2));
//! assert_eq!(dense.valid(), 64 * 48);
//! # Ok(())
//! # }
//! # #[cfg(not(feature = "tiny"))]
//! # fn main() {}
//! ```
//!
//! With files and a checkpoint of one's own; the unit of an integer file must be told:
//!
//! ```no_run
//! use sdim::{CompleteOptions, DepthCompleter, DepthScale, LoadOptions, SparseDepth, read_rgb};
//!
//! let completer = DepthCompleter::load("checkpoint-dir", &LoadOptions::default())?;
//! let rgb = read_rgb("frame.png")?;
//! let sparse = SparseDepth::read("lidar.png", Some(DepthScale::kitti()))?; // 16 bits, 1/256 m
//! let dense = completer.complete(&rgb, &sparse, &CompleteOptions::default())?;
//! dense.write_npy("dense.npy")?; // metres, f32, NaN where there is no depth
//! # Ok::<(), sdim::Error>(())
//! ```
//!
//! # Units
//!
//! Depth is Z-depth (along the optical axis), in metres, `f32`, row-major; x grows to the right, y downwards. Missing on input: 0, NaN,
//! infinite or negative. Missing in memory: NaN. Missing in integer files: 0. A confidence lies between 0 and 1 and is the probability, as
//! the model sees it, that the truth lies within 5 % of the answer; expected errors are absolute, in metres.
//!
//! # Modules
//!
//! | module | what |
//! |---|---|
//! | this one | [`DepthCompleter`]: one frame, start to end; [`Stream`]: frames that follow each other; options, progress, cancelling; [`LoadOptions`], [`Adapter`] |
//! | [`depth`] | sparse and dense maps, cameras, clouds and depth cameras into the picture, sampling patterns, files, interpolation |
//! | [`messages`] | structs shaped like ROS's `Image`, `CameraInfo`, `PointCloud2`, in and out |
//! | [`cloud`], [`calibration`] | point clouds from files, from maps, to files; calibrations of ROS and KITTI |
//! | [`classical`], [`metrics`], [`draw`] | completion without a model; errors and intervals; colours and figures |
//! | [`refine`] | the trait `Fill`: how pixels that were not asked are filled |
//! | [`settings`] | how a checkpoint is asked: `sdim.json` |
//! | [`chat`] | plain Qwen2.5-VL: ask a published checkpoint about a picture ([`chat::ChatModel`]) |
//! | [`system`] | devices by name, memory |
//! | `benchmarks`, `hub` | data sets, the Hugging Face hub; each behind its feature |
//!
//! # Features
//!
//! | feature | default | what |
//! |---|---|---|
//! | `tiny` | yes | the embedded checkpoint: [`DepthCompleter`]`::tiny` |
//! | `train` | no | what `examples/train.rs` and `examples/records.rs` are made of: scenes and the trainer; no public names yet |
//! | `meshes` | no | the same with rooms furnished by OBJ models |
//! | `benchmarks` | no | `benchmarks`: NYUv2, VOID, iBims-1, KITTI, DDAD, TUM, ScanNet, Hypersim, Virtual KITTI 2, folders |
//! | `formats` | no | [`read_rgb`] reads WebP, BMP and TIFF too |
//! | `tiff`, `exr` | no | [`SparseDepth::read`] reads TIFF, OpenEXR too |
//! | `hub` | no | `hub`: checkpoints by name; the one feature that builds C |
//! | `cuda`, `cudnn`, `metal`, `accelerate`, `mkl` | no | candle's back ends |
//!
//! # Promises
//!
//! Bad input is an [`Error`] that says what, where, and what was expected; nothing panics, prints, or guesses a unit. A loaded model is immutable
//! and `Send + Sync`. The same frame gives the same map, whatever the number of threads. CPU kernels are chosen at run time; the variable
//! `SDIM_KERNEL` (`portable`, `avx2`, `avx512`, `amx`, `neon`) forces one, and [`WeightFormat`] says how matrices are held.

#![cfg_attr(docsrs, feature(doc_cfg))]
#![deny(missing_docs)]
#![deny(unsafe_code)]
#![deny(unsafe_op_in_unsafe_fn)]
#![warn(clippy::all)]

#[cfg(feature = "benchmarks")]
pub mod benchmarks;
pub mod calibration;
pub mod classical;
pub mod cloud;
mod complete;
pub mod depth;
pub mod draw;
mod error;
mod files;
mod fusion;
#[cfg(feature = "hub")]
pub mod hub;
mod image;
#[allow(unsafe_code)]
mod kernels;
pub mod messages;
pub mod metrics;
mod model;
mod query;
pub mod refine;
#[cfg(any(feature = "train", feature = "benchmarks", feature = "meshes"))]
mod scenes;
mod stream;
#[cfg(feature = "train")]
mod supervise;
pub mod system;
mod vlm;

pub use self::image::{PixelEncoding, decode_rgb, read_rgb};
pub use ::image::RgbImage;
pub use candle_core::{Device, Tensor};
pub use complete::{
    CancelToken, CompleteOptions, Completion, DepthCompleter, Outliers, Partial, Preserve, PreviewCallback,
    Progress, ProgressCallback, Region, StageSeconds,
};
pub use depth::{Camera, DepthMap, DepthScale, Distortion, Intrinsics, SparseDepth, Transform};
pub use error::{Error, Result};
pub use kernels::WeightFormat;
pub use model::Adapter;
pub use query::{QueryPlan, Readout};
pub use stream::{Latest, LatestFrames, Stream, StreamOptions};
pub use vlm::checkpoint::LoadOptions;

/// What `sdim.json` says: how a checkpoint is asked, and what an adapter adds to it.
pub mod settings {
    pub use crate::fusion::FusionConfig;
    pub use crate::query::{
        AnswerMode, ConfidenceScale, DepthUnit, Generation, Hint, Marker, MarkerShape, MeasurementPrompt,
        NumberFormat, NumberTokens, PixelReference, PromptTemplate, Settings,
    };
    pub use crate::vlm::checkpoint::lora::{LoraConfig, LoraMode};
    pub use crate::vlm::qwen2_5::rope::RopeLayout;
}

/// Plain Qwen2.5-VL: asking a published checkpoint about pictures, in words.
pub mod chat {
    pub use crate::vlm::chat::template::{ChatPrompt, Part};
    pub use crate::vlm::chat::{Answer, AnswerOptions, ChatModel, Sampling};
}

/// For this crate's own tests, benches and measuring examples alone: it changes without notice.
#[doc(hidden)]
pub mod internals {
    pub mod fusion {
        pub use crate::fusion::*;
    }
    pub mod image {
        pub use crate::image::*;
    }
    pub mod kernels {
        pub use crate::kernels::*;
    }
    pub mod model {
        pub use crate::model::*;
    }
    pub mod query {
        pub use crate::query::*;
    }
    #[cfg(feature = "benchmarks")]
    pub mod benchmarks {
        pub use crate::benchmarks::folder::{DepthFile, write_frame};
    }
    #[cfg(any(feature = "train", feature = "benchmarks", feature = "meshes"))]
    pub mod scenes {
        pub use crate::scenes::*;
    }
    #[cfg(feature = "train")]
    pub mod supervise {
        pub use crate::supervise::batch::*;
        pub use crate::supervise::init::*;
        pub use crate::supervise::known::*;
        pub use crate::supervise::loss::*;
        pub use crate::supervise::mix::*;
        pub use crate::supervise::prompts::*;
        pub use crate::supervise::recipe::*;
        pub use crate::supervise::records::*;
        pub use crate::supervise::shape::*;
        pub use crate::supervise::shard::*;
        pub use crate::supervise::*;
    }
    pub mod vlm {
        pub use crate::vlm::*;
    }
}

/// The snippet of README.md is a test.
#[cfg(all(doctest, feature = "tiny"))]
#[doc = include_str!("../README.md")]
struct ReadmeDoctests;
