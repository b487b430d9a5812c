//! The windowed vision encoder (`visual.*` of a checkpoint).
//!
//! Source: `Qwen2_5_VisionTransformerPretrainedModel` of the reference's `modeling_qwen2_5_vl.py`.

use super::config::VisionConfig;
use super::grid::{Grid, WindowOrder};
use super::linear::{GatedMlp, Linear, RmsNorm};
use super::patch_embed::PatchEmbed;
use super::rope::{self, RopeTable};
use super::weights::Weights;
use crate::error::Result;
use crate::kernels::{self, AttentionLayout, Block};
use candle_core::Tensor;
use std::ops::Range;

/// The reference hard-codes this value; the config's `rms_norm_eps` is the decoder's.
const EPS: f64 = 1e-6;

struct VisionBlock {
    norm1: RmsNorm,
    qkv: Linear,
    proj: Linear,
    norm2: RmsNorm,
    mlp: GatedMlp,
}

impl VisionBlock {
    fn new(c: &VisionConfig, weights: &Weights, index: usize) -> Result<Self> {
        let (d, name) = (c.hidden_size, format!("visual.blocks.{index}"));
        Ok(Self {
            norm1: RmsNorm::new(weights, &format!("{name}.norm1"), d, EPS)?,
            qkv: Linear::new(weights, &format!("{name}.attn.qkv"), d, 3 * d, true)?,
            proj: Linear::new(weights, &format!("{name}.attn.proj"), d, d, true)?,
            norm2: RmsNorm::new(weights, &format!("{name}.norm2"), d, EPS)?,
            mlp: GatedMlp::new(weights, &format!("{name}.mlp"), d, c.intermediate_size, true)?,
        })
    }

    /// `[patches, hidden]` to the same.
    fn forward(&self, x: &Tensor, table: &RopeTable, layout: &AttentionLayout) -> Result<Tensor> {
        let width = x.dim(1)?;
        let qkv = self.qkv.forward(&self.norm1.forward(x)?)?; // [n, 3 * hidden]
        let part = |i: usize| qkv.narrow(1, i * width, width)?.contiguous();
        let q = kernels::rope(&part(0)?, &table.cos, &table.sin, layout.heads)?;
        let k = kernels::rope(&part(1)?, &table.cos, &table.sin, layout.heads)?;
        let mixed = kernels::attention(&q, &k, &part(2)?, None, layout)?;
        let x = kernels::add(x, &self.proj.forward(&mixed)?)?;
        kernels::add(&x, &self.mlp.forward(&self.norm2.forward(&x)?)?)
    }
}

/// Patches to image tokens of the decoder's width.
pub struct VisionTower {
    config: VisionConfig,
    /// The RGB patch embedding (F_e1 of Eq. 3a).
    pub patch_embed: PatchEmbed,
    blocks: Vec<VisionBlock>,
    ln_q: RmsNorm,
    mlp0: Linear,
    mlp2: Linear,
}

/// What the encoder computed at the places that golden tensors know.
#[derive(Debug, Default)]
pub struct VisionTrace {
    /// Output of each block, `[patches, hidden]`, window order.
    pub blocks: Vec<Tensor>,
    /// Output of the merger, `[tokens, out_hidden]`, window order.
    pub merger: Option<Tensor>,
}

impl VisionTower {
    /// Reads `visual.*`.
    ///
    /// # Errors
    /// As [`Weights::get`].
    pub fn new(config: &VisionConfig, weights: &Weights) -> Result<Self> {
        let merged = config.hidden_size * config.merge_size * config.merge_size;
        Ok(Self {
            patch_embed: PatchEmbed::new(config, weights, "visual.patch_embed.proj")?,
            blocks: (0..config.depth).map(|i| VisionBlock::new(config, weights, i)).collect::<Result<_>>()?,
            ln_q: RmsNorm::new(weights, "visual.merger.ln_q", config.hidden_size, EPS)?,
            mlp0: Linear::new(weights, "visual.merger.mlp.0", merged, merged, true)?,
            mlp2: Linear::new(weights, "visual.merger.mlp.2", merged, config.out_hidden_size, true)?,
            config: config.clone(),
        })
    }

    fn layout(&self, segments: &[Range<usize>]) -> AttentionLayout {
        let blocks = segments
            .iter()
            .map(|s| Block {
                queries: s.clone(),
                shared: 0..0,
                own_start: s.start,
                q_period: s.len(),
                k_period: s.len(),
                causal: false,
            })
            .collect();
        let heads = self.config.heads;
        AttentionLayout { heads, kv_heads: heads, head_dim: self.config.head_dim(), blocks }
    }

    /// Encodes embedded patches `[patches, hidden]` of one or more images (V = F_theta(E), Eq. 3b) to
    /// `[tokens, out_hidden]`, row-major per image.
    ///
    /// # Errors
    /// [`crate::Error::Tensors`] if the rows are not those of the grids.
    pub fn encode(&self, embedded: &Tensor, grids: &[Grid]) -> Result<Tensor> {
        self.run(embedded, grids, None)
    }

    /// Like [`VisionTower::encode`], keeping the intermediate results (for tests).
    ///
    /// # Errors
    /// As [`VisionTower::encode`].
    pub fn encode_traced(&self, embedded: &Tensor, grids: &[Grid]) -> Result<(Tensor, VisionTrace)> {
        let mut trace = VisionTrace::default();
        let out = self.run(embedded, grids, Some(&mut trace))?;
        Ok((out, trace))
    }

    fn run(&self, embedded: &Tensor, grids: &[Grid], mut trace: Option<&mut VisionTrace>) -> Result<Tensor> {
        let (c, device) = (&self.config, embedded.device());
        let unit = c.merge_size * c.merge_size;
        let order = WindowOrder::new(grids, c.merge_size, c.window_tokens());
        let patch_index = order.patch_index(unit);
        let all: Vec<(usize, usize)> = grids.iter().flat_map(|g| g.patch_positions(c.merge_size)).collect();
        let positions: Vec<_> = patch_index.iter().map(|&i| all[i as usize]).collect();
        let table = rope::vision_table(&positions, c.head_dim(), device)?;
        let (windowed, full) = (self.layout(&order.windows), self.layout(&order.images));

        let rows = patch_index.len();
        let mut x = embedded.index_select(&Tensor::from_vec(patch_index, rows, device)?, 0)?;
        for (i, block) in self.blocks.iter().enumerate() {
            let layout = if c.fullatt_block_indexes.contains(&i) { &full } else { &windowed };
            x = block.forward(&x, &table, layout)?;
            if let Some(t) = trace.as_deref_mut() {
                t.blocks.push(x.clone());
            }
        }
        let x = self.ln_q.forward(&x)?.reshape((rows / unit, unit * c.hidden_size))?;
        let x = self.mlp2.forward(&kernels::gelu_erf(&self.mlp0.forward(&x)?)?)?;
        if let Some(t) = trace {
            t.merger = Some(x.clone());
        }
        Ok(x.index_select(&Tensor::from_vec(order.inverse(), rows / unit, device)?, 0)?)
    }
}
