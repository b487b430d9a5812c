//! Pictures of depth: colour maps, previews of one result, figures that compare methods.

pub mod colour;
pub mod figure;
mod label;
pub mod preview;
