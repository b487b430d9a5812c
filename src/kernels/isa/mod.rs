//! Instruction sets: which ones the machine has, and functions compiled for each.

pub(in crate::kernels) mod level;
