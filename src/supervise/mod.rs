//! Textual supervision (Sec. 3.4): training with the answer's tokens as labels. Feature `train`.

pub mod batch;
pub mod config;
pub mod evaluate;
pub mod init;
pub mod loss;
pub mod optimiser;
mod pass;
pub mod store;
pub mod trainer;

pub use batch::{BatchConfig, LabelSource};
pub use config::TrainConfig;
pub use evaluate::{HeldOut, evaluate};
pub use trainer::{StepReport, Trainer};
