//! A checkpoint that is spoken with: tokenizer, chat template, answers in words.

pub mod generate;
mod model;
pub mod template;
pub mod tokenizer;

pub use generate::Sampling;
pub use model::{Answer, AnswerOptions, ChatModel};
