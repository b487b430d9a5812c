//! Textual supervision (Sec. 3.4): training with the answer's tokens as labels. Feature `train`.

pub(crate) mod batch;
mod config;
mod evaluate;
pub(crate) mod init;
mod loss;
mod optimiser;
mod pass;
mod store;
mod trainer;

pub use batch::{BatchConfig, LabelSource};
pub use config::TrainConfig;
pub use evaluate::{HeldOut, evaluate};
pub use trainer::{StepReport, Trainer};
