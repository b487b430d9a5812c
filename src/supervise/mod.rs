//! Textual supervision (Sec. 3.4): training with the answer's tokens as labels. Feature `train`.

pub(crate) mod batch;
pub(crate) mod evaluate;
pub(crate) mod init;
pub(crate) mod loss;
pub(crate) mod optimiser;
pub(crate) mod store;
pub(crate) mod trainer;

pub use batch::{BatchConfig, LabelSource};
pub use evaluate::{HeldOut, evaluate};
pub use optimiser::AdamW;
pub use trainer::{StepReport, TrainConfig, Trainer};
