//! Floating-point operations of each stage: two per multiplication of a matrix product, nothing else counted.

use sdim::internals::vlm::qwen2_5::config::VlmConfig;
use sdim::internals::vlm::qwen2_5::grid::Grid;

pub struct Cost<'a> {
    config: &'a VlmConfig,
    grid: Grid,
}

impl<'a> Cost<'a> {
    pub fn new(config: &'a VlmConfig, grid: Grid) -> Self {
        Self { config, grid }
    }

    pub fn vision(&self) -> f64 {
        let v = &self.config.vision;
        let (patches, width) = (self.grid.patches() as f64, v.hidden_size as f64);
        let inner = v.intermediate_size as f64;
        let full = v.fullatt_block_indexes.iter().filter(|&&i| i < v.depth).count() as f64;
        let window = ((v.window_tokens() * v.merge_size).pow(2) as f64).min(patches);
        let linear = v.depth as f64 * (4.0 * width * width + 3.0 * width * inner);
        let attention = 2.0 * width * (full * patches + (v.depth as f64 - full) * window);
        let merged = width * (v.merge_size * v.merge_size) as f64;
        let merger = merged * (merged + v.out_hidden_size as f64) / (v.merge_size * v.merge_size) as f64;
        2.0 * patches * (v.patch_len() as f64 * width + linear + attention + merger)
    }

    /// Multiplications of one token in the linear layers of one decoder layer.
    fn layer(&self) -> f64 {
        let t = &self.config.text;
        let (width, kv) = (t.hidden_size as f64, (t.kv_heads * t.head_dim()) as f64);
        2.0 * width * width + 2.0 * width * kv + 3.0 * width * t.intermediate_size as f64
    }

    /// The last layer only makes keys and values.
    pub fn prefill(&self, tokens: usize) -> f64 {
        let t = &self.config.text;
        let (width, kv, n) = (t.hidden_size as f64, (t.kv_heads * t.head_dim()) as f64, tokens as f64);
        let seen = (n + 1.0) / 2.0;
        let whole = (t.layers as f64 - 1.0) * (self.layer() + 2.0 * width * seen);
        2.0 * n * (whole + 2.0 * width * kv)
    }

    /// One query against a prefix, answered in so many passes that each multiply so many rows of the head; of the last layer only the token
    /// that is read is counted in full.
    pub fn query(&self, prefix: usize, suffix: usize, passes: usize, head: usize) -> f64 {
        let t = &self.config.text;
        let (width, kv) = (t.hidden_size as f64, (t.kv_heads * t.head_dim()) as f64);
        let mut total = 0.0;
        for pass in 0..passes {
            let (rows, before) = if pass == 0 { (suffix, 0) } else { (1, suffix + pass - 1) };
            let seen = prefix as f64 + before as f64 + (rows as f64 + 1.0) / 2.0;
            let one = self.layer() + 2.0 * width * seen;
            let rows = rows as f64;
            total += (t.layers as f64 - 1.0) * rows * one + one + (rows - 1.0) * 2.0 * width * kv;
            total += head as f64 * width;
        }
        2.0 * total
    }
}
