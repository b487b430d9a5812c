//! How a pixel is asked: settings, templates, pixel references, plans, numbers as tokens, answers in words.
//!
//! Nothing here holds weights: a loaded checkpoint asks in `model`.

pub mod bins;
pub mod confidence;
pub mod grammar;
pub mod marker;
pub mod mode;
pub mod number;
pub mod plan;
pub mod prompt;
pub mod reading;
pub mod settings;
pub mod template;
pub mod told;
mod unit;

pub use confidence::ConfidenceScale;
pub use grammar::{AnswerGrammar, parse_depth};
pub use marker::{Marker, MarkerShape};
pub use mode::{AnswerMode, Generation};
pub use number::{DepthUnit, NumberFormat, NumberTokens};
pub use plan::QueryPlan;
pub use prompt::{FrameSpace, PromptWriter, Query};
pub use reading::{Reading, Readout};
pub use settings::{Hint, MeasurementPrompt, PixelReference, Settings};
pub use template::PromptTemplate;
