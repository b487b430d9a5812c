//! The checkpoint's `tokenizer.json`.

use crate::error::{Error, Result};
use crate::files::read_text;
use std::path::Path;

/// Text to token ids and back.
pub struct Tokenizer {
    inner: tokenizers::Tokenizer,
}

impl Tokenizer {
    /// Reads the bytes of a `tokenizer.json`; `file` is for messages.
    ///
    /// # Errors
    /// [`Error::Format`] if they are none.
    pub fn from_bytes(file: &Path, bytes: &[u8]) -> Result<Self> {
        let inner = tokenizers::Tokenizer::from_bytes(bytes)
            .map_err(|e| Error::format(file, e.to_string(), "a tokenizer.json"))?;
        Ok(Self { inner })
    }

    /// Reads a `tokenizer.json`.
    ///
    /// # Errors
    /// [`Error::Io`], and as [`Tokenizer::from_bytes`], also on more than 64 MiB.
    pub fn from_file(path: &Path) -> Result<Self> {
        Self::from_bytes(path, &read_text(path)?)
    }

    /// The id of one token by its text.
    ///
    /// # Errors
    /// [`Error::Tokenizer`] if there is no such token.
    pub fn id(&self, token: &str) -> Result<u32> {
        self.inner
            .token_to_id(token)
            .ok_or_else(|| Error::Tokenizer(format!("the vocabulary has no token `{token}`")))
    }

    /// Ids of a text; special tokens are recognised where they stand.
    ///
    /// # Errors
    /// [`Error::Tokenizer`] if the text cannot be encoded.
    pub fn encode(&self, text: &str) -> Result<Vec<u32>> {
        if text.is_empty() {
            return Ok(Vec::new());
        }
        let encoding = self.inner.encode(text, false).map_err(|e| Error::Tokenizer(e.to_string()))?;
        Ok(encoding.get_ids().to_vec())
    }

    /// Text of ids; special tokens are left out.
    ///
    /// # Errors
    /// [`Error::Tokenizer`] if the ids cannot be decoded.
    pub fn decode(&self, ids: &[u32]) -> Result<String> {
        self.inner.decode(ids, true).map_err(|e| Error::Tokenizer(e.to_string()))
    }

    /// One more than the highest id that has a token, added tokens included.
    pub fn vocab_size(&self) -> usize {
        self.inner.get_vocab(true).into_values().max().map_or(0, |id| id as usize + 1)
    }
}
