//! A checkpoint of the depth completion model: Qwen2.5-VL, the fusion block, and the way it is asked.
//!
//! A frame goes through `encode` (Eq. 1-3), `prefix` (what all of its queries share) and `ask` (batches of queries).

mod adapter;
mod ask;
mod batch;
mod encode;
mod files;
mod generate;
#[cfg(feature = "train")]
mod initial;
mod load;
mod marked;
#[cfg(feature = "train")]
mod number_rows;
mod parts;
mod peft;
mod prefix;
mod sdim_model;
mod view;
mod wide_glimpse;

pub use adapter::Adapter;
pub use ask::{AskOptions, ask, generate};
pub use encode::scatter;
pub use files::{CheckpointFiles, SETTINGS, TENSORS};
pub use generate::FreeAnswer;
#[cfg(feature = "train")]
pub use initial::initial;
#[cfg(feature = "tiny")]
pub use load::tiny;
#[cfg(all(feature = "tiny", feature = "train"))]
pub(crate) use load::{TINY, tiny_weights};
pub use parts::DepthInjection;
pub use prefix::{Encoded, Prefix};
pub use sdim_model::SdimModel;
pub use view::View;
pub use wide_glimpse::{CELL, WideGlimpse, at_cells};
