//! Asking: prompt templates, pixel references, query plans, numbers as tokens, batches against one shared prefix.

pub mod answer;
pub mod ask;
pub mod generate;
pub mod marked;
pub mod marker;
pub mod mode;
pub mod number;
pub mod plan;
pub mod prefix;
pub mod prompt;
pub mod settings;
pub mod template;

pub use answer::{AnswerGrammar, parse_depth};
pub use ask::{ask, ask_as, ask_within, generate};
pub use generate::Spoken;
pub use marker::{Marker, MarkerShape};
pub use mode::{AnswerMode, Generation};
pub use number::{DepthUnit, NumberFormat, Reading};
pub use plan::QueryPlan;
pub use prefix::{Encoded, Prefix};
pub use prompt::{FrameSpace, PromptWriter, Query};
pub use settings::{Hint, MeasurementPrompt, PixelReference, Settings};
pub use template::PromptTemplate;
