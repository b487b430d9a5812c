//! Conversations as the published chat template writes them, and the places of their images.
//!
//! Source: `chat_template.json` of Qwen2.5-VL (3B and 7B carry the same text): each turn is `<|im_start|>`, the role, a
//! line break, the contents with nothing between them, `<|im_end|>` and a line break; an image is one placeholder between
//! its marks; a conversation that does not open with a system turn gets the default one. The template is fixed, so it is
//! written out here instead of interpreted; `tests/tokenizer.rs` holds it to the ids of the reference.

use super::tokenizer::Tokenizer;
use crate::error::{Error, Result};
use crate::vlm::qwen2_5::config::SpecialIds;

/// What the template says for a conversation without a system turn.
pub const DEFAULT_SYSTEM: &str = "You are a helpful assistant.";

/// Text of the token that an image's tokens replace.
pub const IMAGE_PLACEHOLDER: &str = "<|image_pad|>";

/// Who speaks.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Role {
    /// Instructions for the entire conversation.
    System,
    /// The one who asks.
    User,
    /// The model.
    Assistant,
}

impl Role {
    fn name(self) -> &'static str {
        match self {
            Role::System => "system",
            Role::User => "user",
            Role::Assistant => "assistant",
        }
    }
}

/// A piece of a turn.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Part {
    /// The next image of the conversation.
    Image,
    /// Text; special tokens written in it are recognised, as in the reference.
    Text(String),
}

impl From<&str> for Part {
    fn from(text: &str) -> Self {
        Part::Text(text.to_string())
    }
}

/// One turn.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Message {
    /// Who speaks.
    pub role: Role,
    /// What is said and shown, in order.
    pub content: Vec<Part>,
}

/// A conversation that the model is to continue.
///
/// ```
/// use sdim::chat::{ChatPrompt, Part};
/// let prompt = ChatPrompt::new().user([Part::Image, "How far is the door?".into()]);
/// assert!(prompt.text().ends_with("<|vision_end|>How far is the door?<|im_end|>\n<|im_start|>assistant\n"));
/// ```
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct ChatPrompt {
    /// The turns, oldest first.
    pub messages: Vec<Message>,
    /// Writes `Picture 1: ` and so on before the images (`add_vision_id` of the template).
    pub number_images: bool,
}

impl ChatPrompt {
    /// A conversation without turns.
    pub fn new() -> Self {
        Self::default()
    }

    fn with(mut self, role: Role, content: Vec<Part>) -> Self {
        self.messages.push(Message { role, content });
        self
    }

    /// Adds a system turn; the template's default stands only where the first turn is none.
    pub fn system(self, text: impl Into<String>) -> Self {
        self.with(Role::System, vec![Part::Text(text.into())])
    }

    /// Adds a turn of the user.
    pub fn user(self, content: impl IntoIterator<Item = Part>) -> Self {
        self.with(Role::User, content.into_iter().collect())
    }

    /// Adds a turn of the model.
    pub fn assistant(self, text: impl Into<String>) -> Self {
        self.with(Role::Assistant, vec![Part::Text(text.into())])
    }

    /// Number of images.
    #[doc(hidden)]
    pub fn images(&self) -> usize {
        self.messages.iter().flat_map(|m| &m.content).filter(|&part| *part == Part::Image).count()
    }

    /// The text of the template, one placeholder per image, ending where the model is to speak.
    #[doc(hidden)]
    pub fn text(&self) -> String {
        let mut out = String::new();
        if self.messages.first().is_some_and(|m| m.role != Role::System) {
            out.push_str(&format!("<|im_start|>system\n{DEFAULT_SYSTEM}<|im_end|>\n"));
        }
        let mut images = 0;
        for message in &self.messages {
            out.push_str(&format!("<|im_start|>{}\n", message.role.name()));
            for part in &message.content {
                match part {
                    Part::Text(text) => out.push_str(text),
                    Part::Image => {
                        images += 1;
                        if self.number_images {
                            out.push_str(&format!("Picture {images}: "));
                        }
                        out.push_str(&format!("<|vision_start|>{IMAGE_PLACEHOLDER}<|vision_end|>"));
                    }
                }
            }
            out.push_str("<|im_end|>\n");
        }
        out.push_str("<|im_start|>assistant\n");
        out
    }

    /// Token ids of [`ChatPrompt::text`] with the placeholder of each image repeated; `tokens` says how often
    /// (rows x columns of the merged grid), image by image.
    ///
    /// # Errors
    /// [`Error::Tokenizer`] if the tokenizer lacks the placeholder or gives it another id than the config; as
    /// [`expand_image_placeholders`].
    #[doc(hidden)]
    pub fn ids(&self, tokenizer: &Tokenizer, special: &SpecialIds, tokens: &[usize]) -> Result<Vec<u32>> {
        let found = tokenizer.id(IMAGE_PLACEHOLDER)?;
        if found != special.image {
            let reason =
                format!("`{IMAGE_PLACEHOLDER}` is {found}; expected {}, as config.json", special.image);
            return Err(Error::Tokenizer(reason));
        }
        expand_image_placeholders(&tokenizer.encode(&self.text())?, special.image, tokens)
    }
}

/// Repeats the `i`-th placeholder `tokens[i]` times.
///
/// # Errors
/// [`Error::Argument`] if there are not as many placeholders as images, or an image has no token.
pub fn expand_image_placeholders(ids: &[u32], placeholder: u32, tokens: &[usize]) -> Result<Vec<u32>> {
    let found = ids.iter().filter(|&&id| id == placeholder).count();
    if found != tokens.len() {
        return Err(Error::argument("image placeholders", found, format!("{}, one per image", tokens.len())));
    }
    if let Some(empty) = tokens.iter().position(|&n| n == 0) {
        return Err(Error::argument("image tokens", 0, format!("at least one for image {empty}")));
    }
    let mut counts = tokens.iter();
    let repeats = |&id: &u32| if id == placeholder { counts.next().copied().unwrap_or(0) } else { 1 };
    let repeats: Vec<usize> = ids.iter().map(repeats).collect();
    Ok(ids.iter().zip(repeats).flat_map(|(&id, n)| std::iter::repeat_n(id, n)).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_image_and_a_question_read_as_published() {
        let prompt = ChatPrompt::new().user([Part::Image, "QUESTION".into()]);
        assert_eq!(
            prompt.text(),
            "<|im_start|>system\nYou are a helpful assistant.<|im_end|>\n<|im_start|>user\n\
             <|vision_start|><|image_pad|><|vision_end|>QUESTION<|im_end|>\n<|im_start|>assistant\n"
        );
        assert_eq!(prompt.images(), 1);
    }

    #[test]
    fn a_system_turn_replaces_the_default_and_pictures_are_counted_over_all_turns() {
        let mut prompt =
            ChatPrompt::new().system("S").user(["a".into(), Part::Image]).assistant("b").user([Part::Image]);
        prompt.number_images = true;
        assert_eq!(
            prompt.text(),
            "<|im_start|>system\nS<|im_end|>\n<|im_start|>user\naPicture 1: <|vision_start|><|image_pad|>\
             <|vision_end|><|im_end|>\n<|im_start|>assistant\nb<|im_end|>\n<|im_start|>user\nPicture 2: \
             <|vision_start|><|image_pad|><|vision_end|><|im_end|>\n<|im_start|>assistant\n"
        );
    }

    #[test]
    fn each_image_gets_its_own_number_of_tokens() {
        assert_eq!(expand_image_placeholders(&[1, 9, 2, 9], 9, &[3, 1]).unwrap(), [1, 9, 9, 9, 2, 9]);
        assert_eq!(expand_image_placeholders(&[1, 2], 9, &[]).unwrap(), [1, 2]);
        for (tokens, message) in [
            (&[3][..], "image placeholders = 2; expected 1, one per image"),
            (&[3, 1, 1], "image placeholders = 2; expected 3, one per image"),
            (&[3, 0], "image tokens = 0; expected at least one for image 1"),
        ] {
            assert_eq!(expand_image_placeholders(&[1, 9, 2, 9], 9, tokens).unwrap_err().to_string(), message);
        }
    }
}
