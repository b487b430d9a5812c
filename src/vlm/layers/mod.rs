//! Layers that are read from a checkpoint by name.

pub mod linear;
pub mod lora;
pub mod matrix;
pub mod mlp;
pub mod norm;

#[cfg(test)]
mod tests;
