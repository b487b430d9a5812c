//! What is compared.

use sdim::internals::supervise::LabelSource;
use sdim::settings::{
    FusionConfig, Hint, Marker, MeasurementPrompt, NumberFormat, PixelReference, PromptTemplate, Settings,
};

/// How sparse depth enters the encoder at first.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Start {
    /// Beside the colours, into the patch embedding: no block.
    Concatenated,
    /// By the block, first and last convolution as He et al. start them.
    He,
    /// By the block, first and last convolution at zero.
    Zero,
}

/// A row of a table.
pub struct Cell {
    pub name: &'static str,
    pub what: &'static str,
    pub settings: Settings,
    pub start: Start,
    pub labels: LabelSource,
}

/// Names of the rows of the paper's table.
pub const PAPER: [&str; 6] = ["a", "b", "c", "d", "e", "f"];

/// The way of asking of the model that knows pictures alone.
pub fn pictures_alone() -> Settings {
    Settings { fusion: None, ..base() }
}

/// Sparse depth by the encoder alone; the pixel that is meant is pointed at.
fn base() -> Settings {
    Settings {
        measurements: MeasurementPrompt::None,
        hint: Hint::None,
        glimpse: None,
        wide_glimpse: None,
        number: NumberFormat::LogBins { bins: 512, lowest: 0.0625, highest: 16.0 },
        fusion: Some(FusionConfig { branch: 8, high: 16, low: 8 }),
        ..Settings::tiny()
    }
}

/// The paper's mask sentence in as few letters as say the same.
fn masked(measured: &str) -> Settings {
    let template = PromptTemplate {
        query: "{mask}{pixel}".into(),
        mask_missing: "0".into(),
        mask_measured: measured.into(),
        ..PromptTemplate::tiny()
    };
    Settings { template, measurements: MeasurementPrompt::PerQuery, ..base() }
}

/// All cells: the paper's, then the ways of asking.
pub fn all() -> Vec<Cell> {
    use LabelSource::{Dense, Sparse};
    let cell = |name, what, settings, start, labels| Cell { name, what, settings, start, labels };
    let told = || Settings { measurements: MeasurementPrompt::Prefix { max: 256 }, ..base() };
    let worded = |pixel_reference, query: &str| Settings {
        pixel_reference,
        template: PromptTemplate { query: query.into(), ..PromptTemplate::tiny() },
        ..told()
    };
    let hinted = || Settings { hint: Hint::Linear, ..told() };
    let glimpse = Some(8);
    vec![
        cell("a", "concatenation", base(), Start::Concatenated, Sparse),
        cell("b", "fusion block, He", base(), Start::He, Sparse),
        cell("c", "fusion block, zero", base(), Start::Zero, Sparse),
        cell("d", "(c) + mask", masked("1"), Start::Zero, Sparse),
        cell("e", "(d) + value", masked("1 {x} "), Start::Zero, Sparse),
        cell("f", "(e), GT labels", masked("1 {x} "), Start::Zero, Dense),
        cell("pointer", "pointer", told(), Start::Zero, Dense),
        cell(
            "coordinates",
            "coordinates",
            worded(PixelReference::Coordinates, "{pixel}"),
            Start::Zero,
            Dense,
        ),
        cell("marker", "marker", worded(PixelReference::Marker(Marker::default()), "?"), Start::Zero, Dense),
        cell("glimpse", "pointer, glimpse", Settings { glimpse, ..told() }, Start::Zero, Dense),
        cell("hint", "pointer, hint", hinted(), Start::Zero, Dense),
        cell("both", "pointer, hint, glimpse", Settings { glimpse, ..hinted() }, Start::Zero, Dense),
        cell("both-sd", "the same, SD labels", Settings { glimpse, ..hinted() }, Start::Zero, Sparse),
    ]
}
