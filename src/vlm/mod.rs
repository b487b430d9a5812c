//! Vision-language models on candle. Nothing here knows of depth.
//!
//! Arrows go down: `chat` (tokenizer, template, answers in words) uses `files` (what a checkpoint directory holds beside
//! tensors), this `qwen2_5` (the architecture), this `layers` (what has weights), this `checkpoint` (named tensors).

pub mod chat;
pub mod checkpoint;
pub(crate) mod files;
pub mod layers;
pub mod qwen2_5;
