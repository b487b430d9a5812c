//! How long a frame took.

/// Seconds spent in each stage.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct StageSeconds {
    /// Checking the measurements, with what is asked about them.
    pub check: f64,
    /// Preprocessing, fusion and vision encoder.
    pub encode: f64,
    /// Reading the shared prefix.
    pub prefill: f64,
    /// Asking.
    pub queries: f64,
    /// Alignment and filling.
    pub refine: f64,
    /// All of it.
    pub total: f64,
}
