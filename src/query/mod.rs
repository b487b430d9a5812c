//! Asking: prompt templates, pixel references, query plans, numbers as tokens, batches against one shared prefix.

pub mod ask;
pub mod number;
pub mod plan;
pub mod prompt;
pub mod settings;
pub mod template;

pub use ask::{Prefix, ask};
pub use number::{DepthUnit, NumberFormat, Reading};
pub use plan::QueryPlan;
pub use prompt::{FrameSpace, PromptWriter, Query};
pub use settings::{Hint, MeasurementPrompt, PixelReference, Settings};
pub use template::PromptTemplate;
