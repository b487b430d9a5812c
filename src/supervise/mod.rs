//! Textual supervision (Sec. 3.4): training with the answer's tokens as labels. Feature `train`.

mod adaptation;
mod asked;
mod base;
pub(crate) mod batch;
mod config;
mod evaluate;
pub(crate) mod init;
pub(crate) mod known;
pub(crate) mod loss;
mod measure;
pub(crate) mod mix;
mod optimiser;
mod own;
mod pass;
pub(crate) mod prompts;
pub(crate) mod recipe;
pub(crate) mod records;
pub(crate) mod shape;
pub(crate) mod shard;
mod store;
mod tensor_file;
mod trainer;
mod vocabulary;

pub use adaptation::{Adaptation, hold_back};
pub use base::Base;
pub use config::TrainConfig;
pub use evaluate::{HeldOut, evaluate};
pub use optimiser::AdamW;
pub use own::{OwnFrame, OwnFrames};
pub use trainer::{StepReport, Trainer};
