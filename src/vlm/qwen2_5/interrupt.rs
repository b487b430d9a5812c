//! Ending a long computation before its end.

use crate::error::{Error, Result};

/// Looked at before each layer: a frame takes many of them, and some models take seconds for one.
#[derive(Clone, Copy, Default)]
pub struct Interrupt<'a>(Option<&'a (dyn Fn() -> bool + Sync)>);

impl<'a> Interrupt<'a> {
    /// Nothing interrupts.
    pub const NEVER: Self = Self(None);

    /// As soon as this is true.
    pub fn when(due: &'a (dyn Fn() -> bool + Sync)) -> Self {
        Self(Some(due))
    }

    /// Fails when it is time to stop.
    ///
    /// # Errors
    /// [`Error::Cancelled`].
    pub fn check(self) -> Result<()> {
        match self.0 {
            Some(due) if due() => Err(Error::Cancelled),
            _ => Ok(()),
        }
    }
}
