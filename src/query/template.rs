//! The words of the prompt and of the answer.

use crate::error::{Error, Result};

/// The paper's question Q (Sec. 3.3).
pub const QUESTION: &str = "What is the distance from the current pixel to the camera?";
/// The paper's sentence for a pixel without a measurement.
pub const MASK_MISSING: &str = "The mask value is 0; predict the distance to the camera.";
/// The paper's sentence for a measured pixel; `{x}` is the measurement.
pub const MASK_MEASURED: &str =
    "The mask value is 1, and the distance to the camera is {x} meters, preserve the given value.";
/// The paper's answer; `{y}` is the depth.
pub const ANSWER: &str = "The current pixel is {y} meters away from the camera.";
/// The paper's supervision text (Sec. 3.4), which differs from the answer by one word; `{y}` is the depth.
pub const SUPERVISION: &str = "The pixel is {y} meters away from the camera.";

/// The prompt's text, a property of the checkpoint.
///
/// Everything up to and including `after_image` is shared by all pixels and read once; `query` is read per pixel.
/// In `query`, `{pixel}` stands for the pixel reference, `{mask}` for the mask sentence where measurements are given per
/// query. In `answer`, `{y}` stands for the number.
#[derive(Debug, Clone, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
pub struct PromptTemplate {
    /// Before the image tokens.
    pub before_image: String,
    /// Between the image tokens and the measurements or the first query.
    pub after_image: String,
    /// Per pixel.
    pub query: String,
    /// `{mask}` of a pixel without a measurement.
    pub mask_missing: String,
    /// `{mask}` of a measured pixel, with `{x}`.
    pub mask_measured: String,
    /// The pixel in words, with `{col}` and `{row}` (pixels of the resized image), for `PixelReference::Coordinates`.
    pub coordinates: String,
    /// The answer sentence, with `{y}`; what stands before the number is forced, what follows it is not asked for.
    pub answer: String,
}

impl PromptTemplate {
    /// The paper's sentences in Qwen's chat frame.
    pub fn paper() -> Self {
        Self {
            before_image: "<|im_start|>system\nYou are a helpful assistant.<|im_end|>\n<|im_start|>user\n<|vision_start|>".into(),
            after_image: "<|vision_end|>".into(),
            query: format!("{{mask}} {QUESTION} {{pixel}}<|im_end|>\n<|im_start|>assistant\n"),
            mask_missing: MASK_MISSING.into(),
            mask_measured: MASK_MEASURED.into(),
            coordinates: "The current pixel is at ({col}, {row}).".into(),
            answer: ANSWER.into(),
        }
    }

    /// As few tokens as possible: the pixel alone asks, the number alone answers.
    pub fn tiny() -> Self {
        Self {
            before_image: "<|vision_start|>".into(),
            after_image: "<|vision_end|>".into(),
            query: "{pixel}".into(),
            mask_missing: String::new(),
            mask_measured: String::new(),
            coordinates: "({col}, {row})".into(),
            answer: "{y}".into(),
        }
    }

    /// Checks that the placeholders are there.
    ///
    /// # Errors
    /// [`Error::Config`] names the field of `sdim.json`.
    pub fn validate(&self, file: &str) -> Result<()> {
        let need = |key: &str, text: &str, part: &str, times: std::ops::RangeInclusive<usize>| {
            if times.contains(&text.matches(part).count()) {
                return Ok(());
            }
            let expected = format!("`{part}` {} to {} times", times.start(), times.end());
            Err(Error::config(file, key, format!("{text:?}"), expected))
        };
        need("template.query", &self.query, "{pixel}", 1..=1)?;
        need("template.query", &self.query, "{mask}", 0..=1)?;
        need("template.answer", &self.answer, "{y}", 1..=1)?;
        for part in ["{col}", "{row}"] {
            need("template.coordinates", &self.coordinates, part, 1..=1)?;
        }
        if self.query.contains("{mask}") {
            need("template.mask_measured", &self.mask_measured, "{x}", 1..=1)?;
        }
        Ok(())
    }

    /// The answer's words before the number.
    pub fn forced(&self) -> &str {
        self.answer.split("{y}").next().unwrap_or_default()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_papers_sentences_are_verbatim() {
        let t = PromptTemplate::paper();
        assert_eq!(t.forced(), "The current pixel is ");
        assert_eq!(
            t.mask_measured.replace("{x}", "4.230"),
            "The mask value is 1, and the distance to the camera is 4.230 meters, preserve the given value."
        );
        assert!(t.query.contains("What is the distance from the current pixel to the camera?"));
        assert!(t.validate("t").is_ok() && PromptTemplate::tiny().validate("t").is_ok());
    }

    #[test]
    fn a_template_without_its_placeholders_is_refused() {
        let mut t = PromptTemplate::paper();
        t.answer = "far".into();
        assert!(matches!(t.validate("t"), Err(Error::Config { key, .. }) if key == "template.answer"));
    }
}
