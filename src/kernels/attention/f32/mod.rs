//! Attention in f32, with gradients.

mod op;
mod softmax;
mod tile;

pub(super) use op::F32Attention;
