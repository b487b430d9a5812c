//! The words of the prompt and of the answer.

use super::unit::split_unit;
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

/// DepthLM's question. Source: arXiv 2509.25413 and its published code (github.com/facebookresearch/DepthLM_Official,
/// `utils/datasets.py` at 13cebf4), which says that the method does not hang on these words.
pub const DEPTHLM_QUESTION: &str = "Given this image, how far is the point pointed by the red arrow from the camera? Output the \
thinking process in <think> </think> and final answer (the meter number only, without the unit) in <answer> </answer> tags.";
/// What DepthLM is trained to think before it repeats the number as `<answer> {y} </answer>`; same source.
pub const DEPTHLM_THOUGHT: &str = "<think> The point is around {y} meters away from the camera. </think>";

/// Qwen2.5-VL's chat frame before the image, with its default system turn.
const CHAT_BEFORE: &str =
    "<|im_start|>system\nYou are a helpful assistant.<|im_end|>\n<|im_start|>user\n<|vision_start|>";
/// The same between the question and the answer.
const CHAT_AFTER: &str = "<|im_end|>\n<|im_start|>assistant\n";

/// The prompt's text, a property of the checkpoint.
///
/// Everything up to and including `after_image` is shared by all pixels and read once; `query` is read per pixel.
/// In `query`, `{pixel}` stands for the pixel reference (unless that is a mark in the image), `{mask}` for the mask sentence
/// where measurements are given per query. In `answer`, `{y}` stands for the number. `sdim.json` may give a preset's name
/// instead of the texts.
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
    /// `{mask}` of a measured pixel, perhaps with `{x}`.
    pub mask_measured: String,
    /// The pixel in words, with `{col}` and `{row}` (pixels of the resized image), for `PixelReference::Coordinates`.
    pub coordinates: String,
    /// The answer sentence, with `{y}`; what stands before the number is forced, what follows it is not asked for.
    pub answer: String,
}

impl PromptTemplate {
    /// Names of the presets.
    pub const PRESETS: [&str; 4] = ["paper", "paper_marked", "depthlm", "tiny"];

    /// A preset by its name; `None` if there is none of it.
    pub fn preset(name: &str) -> Option<Self> {
        match name {
            "paper" => Some(Self::paper()),
            "paper_marked" => Some(Self::paper_marked()),
            "depthlm" => Some(Self::depthlm()),
            "tiny" => Some(Self::tiny()),
            _ => None,
        }
    }

    /// The paper's sentences in Qwen's chat frame, the pixel in words: first the text made of the measurement (T of Eq. 4),
    /// then the question Q.
    pub fn paper() -> Self {
        Self { query: format!("{{mask}} {QUESTION} {{pixel}}{CHAT_AFTER}"), ..Self::paper_marked() }
    }

    /// The paper's sentences for a pixel that is marked in the image. The paper points at its reference pixel "\[5\]", that
    /// is as DepthLM does.
    pub fn paper_marked() -> Self {
        Self {
            before_image: CHAT_BEFORE.into(),
            after_image: "<|vision_end|>".into(),
            query: format!("{{mask}} {QUESTION}{CHAT_AFTER}"),
            mask_missing: MASK_MISSING.into(),
            mask_measured: MASK_MEASURED.into(),
            coordinates: "The current pixel is at ({col}, {row}).".into(),
            answer: ANSWER.into(),
        }
    }

    /// DepthLM's question and thought in Qwen's chat frame. It is not told measurements.
    pub fn depthlm() -> Self {
        Self {
            query: format!("{DEPTHLM_QUESTION}{CHAT_AFTER}"),
            mask_missing: String::new(),
            mask_measured: String::new(),
            answer: DEPTHLM_THOUGHT.into(),
            ..Self::paper_marked()
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
    #[doc(hidden)]
    pub fn validate(&self, file: &str) -> Result<()> {
        let need = |key: &str, text: &str, part: &str, times: std::ops::RangeInclusive<usize>| {
            if times.contains(&text.matches(part).count()) {
                return Ok(());
            }
            let expected = format!("`{part}` {} to {} times", times.start(), times.end());
            Err(Error::config(file, key, format!("{text:?}"), expected))
        };
        need("template.query", &self.query, "{pixel}", 0..=1)?;
        need("template.query", &self.query, "{mask}", 0..=1)?;
        need("template.answer", &self.answer, "{y}", 1..=1)?;
        for part in ["{col}", "{row}"] {
            need("template.coordinates", &self.coordinates, part, 1..=1)?;
        }
        if self.query.contains("{mask}") {
            need("template.mask_measured", &self.mask_measured, "{x}", 0..=1)?;
        }
        Ok(())
    }

    /// Metres of the unit that follows the number in the answer; `None` if no unit of length does.
    #[doc(hidden)]
    pub fn answer_unit(&self) -> Option<f64> {
        let (_, after) = self.answer.split_once("{y}")?;
        split_unit(after).map(|(metres, _)| metres)
    }

    /// The answer's words before the number.
    #[doc(hidden)]
    pub fn forced(&self) -> &str {
        self.answer.split("{y}").next().unwrap_or_default()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::vlm::chat::template::{ChatPrompt, IMAGE_PLACEHOLDER, Part};

    #[test]
    fn the_papers_sentences_are_verbatim() {
        let t = PromptTemplate::paper();
        assert_eq!(t.forced(), "The current pixel is ");
        assert_eq!(
            t.mask_measured.replace("{x}", "4.230"),
            "The mask value is 1, and the distance to the camera is 4.230 meters, preserve the given value."
        );
        assert!(t.query.contains("What is the distance from the current pixel to the camera?"));
        assert_eq!(
            t.query.replace("{mask}", &t.mask_missing).split_once("<|im_end|>").map(|p| p.0),
            Some(
                "The mask value is 0; predict the distance to the camera. \
                 What is the distance from the current pixel to the camera? {pixel}"
            )
        );
        assert_eq!(
            t.answer.replace("{y}", "4.230"),
            "The current pixel is 4.230 meters away from the camera."
        );
        assert_eq!(SUPERVISION.replace("{y}", "1"), "The pixel is 1 meters away from the camera.");
    }

    #[test]
    fn presets_are_found_by_name_and_hold_what_a_template_needs() {
        for name in PromptTemplate::PRESETS {
            PromptTemplate::preset(name).unwrap().validate("t").unwrap();
        }
        assert_eq!(PromptTemplate::preset("Paper"), None);
        assert_eq!(PromptTemplate::preset("depthlm"), Some(PromptTemplate::depthlm()));
    }

    #[test]
    fn questions_are_framed_as_conversations_are() {
        for t in [PromptTemplate::paper_marked(), PromptTemplate::depthlm()] {
            let (question, _) = t.query.split_once(CHAT_AFTER).unwrap();
            let chat = ChatPrompt::new().user([Part::Image, question.into()]).text();
            let ours = [&t.before_image, IMAGE_PLACEHOLDER, &t.after_image, &t.query].concat();
            assert_eq!(ours, chat);
        }
    }

    #[test]
    fn the_unit_of_an_answer_is_the_word_after_its_number() {
        let unit =
            |answer: &str| PromptTemplate { answer: answer.into(), ..PromptTemplate::tiny() }.answer_unit();
        assert_eq!(PromptTemplate::paper().answer_unit(), Some(1.0));
        assert_eq!(PromptTemplate::depthlm().answer_unit(), Some(1.0));
        assert_eq!(unit("it is {y}mm away"), Some(0.001));
        assert_eq!((unit("{y}"), unit("{y} miles"), unit("<answer> {y} </answer>")), (None, None, None));
    }

    #[test]
    fn a_template_without_its_placeholders_is_refused() {
        let mut t = PromptTemplate::paper();
        t.answer = "far".into();
        assert!(matches!(t.validate("t"), Err(Error::Config { key, .. }) if key == "template.answer"));
    }
}
