//! Textual supervision (Sec. 3.4): training with the answer's tokens as labels. Feature `train`.

#[doc(hidden)]
pub mod batch;
#[doc(hidden)]
pub mod evaluate;
#[doc(hidden)]
pub mod init;
#[doc(hidden)]
pub mod loss;
#[doc(hidden)]
pub mod optimiser;
#[doc(hidden)]
pub mod store;
#[doc(hidden)]
pub mod trainer;

pub use batch::{BatchConfig, LabelSource};
pub use evaluate::{HeldOut, evaluate};
pub use optimiser::AdamW;
pub use trainer::{StepReport, TrainConfig, Trainer};
