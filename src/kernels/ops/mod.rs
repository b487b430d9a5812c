//! What the layers call, each a function on candle tensors (the optimiser's step: on slices).

mod activation;
mod adamw;
mod add;
mod bin_rows;
mod bins;
mod conv;
mod linear;
mod mlp;
mod norm;
mod rope;
mod scale_shift;

pub use activation::{gelu_erf, swiglu};
pub use adamw::{AdamWStep, adamw_step};
pub use add::add;
pub use bin_rows::bin_stats_of_rows;
pub use bins::{BinStats, Middle, bin_stats};
pub use conv::conv3x3;
pub use linear::linear;
pub use mlp::packed_mlp;
pub use norm::rms_norm;
pub use rope::rope;
pub use scale_shift::{affine_act, batch_norm_act};
