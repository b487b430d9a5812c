//! Answer modes: forced words around a constrained number, or free speech that is read afterwards.

use super::number::{DepthUnit, NumberFormat};
use super::template::PromptTemplate;
use crate::error::{Error, Result};

/// How an answer is got.
#[derive(Debug, Clone, PartialEq, Default, serde::Serialize, serde::Deserialize)]
#[serde(tag = "kind", rename_all = "snake_case")]
pub enum AnswerMode {
    /// The answer's words are forced, and its number is chosen among numbers: always readable, and the fewest passes. The number has
    /// the checkpoint's [`NumberFormat`]: one bin, or digits one after the other.
    #[default]
    Digits,
    /// The model speaks freely, and what it says is read by [`super::AnswerGrammar`].
    Generate(Generation),
}

/// How the model speaks freely: greedily, and not without end.
#[derive(Debug, Clone, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(default)]
pub struct Generation {
    /// Tokens of an answer, at most.
    pub max_new_tokens: usize,
    /// Divides the logits of all tokens seen so far (multiplies those below 0); 1 is none. The published generation config of
    /// Qwen2.5-VL has 1.05, which pulls away from the very digits that a prompt states, so it is off here.
    pub repetition_penalty: f32,
    /// Tokens that end an answer; `null` for those of the checkpoint's generation config.
    pub stop: Option<Vec<String>>,
}

impl Default for Generation {
    fn default() -> Self {
        Self { max_new_tokens: 64, repetition_penalty: 1.0, stop: None }
    }
}

/// Tokens of an answer, at most that can be asked for: DepthLM's own evaluation uses as many.
const MAX_NEW_TOKENS: usize = 4096;

impl AnswerMode {
    /// Checks the mode by itself and against the rest of the settings.
    ///
    /// # Errors
    /// [`Error::Config`] names the field.
    pub(crate) fn validate(
        &self,
        file: &str,
        number: NumberFormat,
        unit: DepthUnit,
        template: &PromptTemplate,
    ) -> Result<()> {
        let Self::Generate(g) = self else { return Ok(()) };
        let check = |ok: bool, key: &str, found: String, expected: &str| {
            if ok { Ok(()) } else { Err(Error::config(file, key, found, expected)) }
        };
        check(
            (1..=MAX_NEW_TOKENS).contains(&g.max_new_tokens),
            "answer_mode.max_new_tokens",
            g.max_new_tokens.to_string(),
            "1 to 4096 tokens",
        )?;
        check(
            g.repetition_penalty.is_finite() && g.repetition_penalty > 0.0,
            "answer_mode.repetition_penalty",
            g.repetition_penalty.to_string(),
            "a positive number; 1 for none",
        )?;
        check(
            g.stop.as_ref().is_none_or(|s| !s.is_empty()),
            "answer_mode.stop",
            "[]".into(),
            "at least one token, or null",
        )?;
        check(
            matches!(number, NumberFormat::Digits { .. }),
            "answer_mode.kind",
            "\"generate\", but numbers are bins".into(),
            "number.kind \"digits\", since only digits can be read from words",
        )?;
        let named = template.answer_unit();
        let counted = unit.metres().map(f64::from);
        // A sentence in metres around a number that counts something else would be read as metres.
        let agree = named.is_none_or(|n| counted.is_some_and(|c| (c - n).abs() < 1e-6));
        check(
            agree,
            "unit",
            format!("{:?}, but the answer is {:?}", unit, template.answer),
            "the unit that the answer names",
        )
    }
}
