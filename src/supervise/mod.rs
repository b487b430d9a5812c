//! Textual supervision (Sec. 3.4): training with the answer's tokens as labels. Feature `train`.

pub mod batch;
pub mod evaluate;
pub mod init;
pub mod loss;
pub mod optimiser;
pub mod records;
pub mod shape;
pub mod shard;
pub mod store;
pub mod trainer;

pub use batch::{BatchConfig, LabelSource};
pub use evaluate::{HeldOut, evaluate};
pub use trainer::{TrainConfig, Trainer};
