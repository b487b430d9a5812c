//! The windowed vision encoder (`visual.*` of a checkpoint).
//!
//! Source: `Qwen2_5_VisionTransformerPretrainedModel` of the reference's `modeling_qwen2_5_vl.py`.

use super::config::VisionConfig;
use super::grid::{Grid, WindowOrder};
use super::interrupt::Interrupt;
use super::patch_embed::PatchEmbed;
use super::rope;
use super::rope::RopeTable;
use crate::error::{Error, Result};
use crate::kernels::{self, AttentionLayout, Block, Precision};
use crate::vlm::checkpoint::weights::Weights;
use crate::vlm::layers::linear::Linear;
use crate::vlm::layers::mlp::GatedMlp;
use crate::vlm::layers::norm::RmsNorm;
use candle_core::{Device, Tensor};
use std::ops::Range;

/// The reference hard-codes this value; the config's `rms_norm_eps` is the decoder's.
const NORM_EPS: f64 = 1e-6;

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
            norm1: RmsNorm::new(weights, &format!("{name}.norm1"), d, NORM_EPS)?,
            qkv: Linear::new(weights, &format!("{name}.attn.qkv"), d, 3 * d, true)?,
            proj: Linear::new(weights, &format!("{name}.attn.proj"), d, d, true)?,
            norm2: RmsNorm::new(weights, &format!("{name}.norm2"), d, NORM_EPS)?,
            mlp: GatedMlp::new(weights, &format!("{name}.mlp"), d, c.intermediate_size, true)?,
        })
    }

    /// `[patches, hidden]` to the same.
    fn forward(&self, x: &Tensor, table: &RopeTable, layout: &AttentionLayout) -> Result<Tensor> {
        let normed = self.norm1.forward_as(x, self.qkv.input_type())?;
        let [q, k, v] = self.qkv.forward_parts(&normed, [x.dim(1)?; 3])?;
        let q = kernels::rope(&q, &table.cos, &table.sin, layout.heads)?;
        let k = kernels::rope(&k, &table.cos, &table.sin, layout.heads)?;
        let x = self.proj.forward_onto(&kernels::attention(&q, &k, &v, None, layout)?, x)?;
        self.mlp.forward_onto(&self.norm2.forward_as(&x, self.mlp.input_type())?, &x)
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
    precision: Precision,
}

/// What the encoder computed at the places that golden tensors know.
#[derive(Debug, Default)]
pub struct VisionTrace {
    /// Output of each block, `[patches, hidden]`, window order.
    pub blocks: Vec<Tensor>,
    /// Output of the merger, `[tokens, out_hidden]`, window order.
    pub merger: Option<Tensor>,
}

/// What is kept of one image's encoding, for images that differ from it in few patches.
#[derive(Debug, Clone)]
pub struct VisionBase {
    grid: Grid,
    /// Embedded patches, in the order of the patch rows.
    embedded: Tensor,
    /// Their states after the blocks before the first full attention, in window order.
    local: Tensor,
}

/// Patches in which an image differs from another one.
#[derive(Debug, Clone, Default)]
pub struct Change {
    /// Patch rows, each at most once.
    pub rows: Vec<usize>,
    /// Embedded patches of these rows, `[rows, hidden]`; `None` if there is none.
    pub embedded: Option<Tensor>,
}

impl Change {
    fn check(&self, patches: usize) -> Result<()> {
        if let Some(row) = self.rows.iter().find(|&&row| row >= patches) {
            return Err(Error::argument("changed patch", row, format!("one of the image's {patches}")));
        }
        let embedded = self.embedded.as_ref().map_or(Ok(0), |e| e.dim(0))?;
        if embedded != self.rows.len() {
            let expected = format!("{}, one per changed patch", self.rows.len());
            return Err(Error::argument("embedded patches", embedded, expected));
        }
        Ok(())
    }
}

/// Order, positions and segments of a run over some images.
struct Pass {
    order: WindowOrder,
    /// Patch rows in window order.
    patches: Vec<u32>,
    table: RopeTable,
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
            ln_q: RmsNorm::new(weights, "visual.merger.ln_q", config.hidden_size, NORM_EPS)?,
            mlp0: Linear::new(weights, "visual.merger.mlp.0", merged, merged, true)?,
            mlp2: Linear::new(weights, "visual.merger.mlp.2", merged, config.out_hidden_size, true)?,
            precision: weights.format().into(),
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
        let precision = self.precision;
        AttentionLayout { heads, kv_heads: heads, head_dim: self.config.head_dim(), blocks, precision }
    }

    /// Encodes embedded patches `[patches, hidden]` of one or more images (V = F_theta(E), Eq. 3b) to
    /// `[tokens, out_hidden]`, row-major per image.
    ///
    /// # Errors
    /// [`crate::Error::Tensors`] if the rows are not those of the grids.
    pub fn encode(&self, embedded: &Tensor, grids: &[Grid]) -> Result<Tensor> {
        self.encode_unless(embedded, grids, Interrupt::NEVER)
    }

    /// Like [`VisionTower::encode`], unless it is interrupted.
    ///
    /// # Errors
    /// As [`VisionTower::encode`]; [`Error::Cancelled`].
    pub fn encode_unless(&self, embedded: &Tensor, grids: &[Grid], interrupt: Interrupt) -> Result<Tensor> {
        self.run(embedded, grids, None, interrupt)
    }

    /// Like [`VisionTower::encode`], keeping the intermediate results (for tests).
    ///
    /// # Errors
    /// As [`VisionTower::encode`].
    pub fn encode_traced(&self, embedded: &Tensor, grids: &[Grid]) -> Result<(Tensor, VisionTrace)> {
        let mut trace = VisionTrace::default();
        let out = self.run(embedded, grids, Some(&mut trace), Interrupt::NEVER)?;
        Ok((out, trace))
    }

    fn pass(&self, grids: &[Grid], device: &Device) -> Result<Pass> {
        let c = &self.config;
        let order = WindowOrder::new(grids, c.merge_size, c.window_tokens());
        let patches = order.patch_index(c.merge_size * c.merge_size);
        let all: Vec<(usize, usize)> = grids.iter().flat_map(|g| g.patch_positions(c.merge_size)).collect();
        let positions: Vec<_> = patches.iter().map(|&i| all[i as usize]).collect();
        let table = rope::vision_table(&positions, c.head_dim(), device)?;
        Ok(Pass { order, patches, table })
    }

    fn run(
        &self,
        embedded: &Tensor,
        grids: &[Grid],
        mut trace: Option<&mut VisionTrace>,
        interrupt: Interrupt,
    ) -> Result<Tensor> {
        let pass = self.pass(grids, embedded.device())?;
        let x = pick(embedded, &pass.patches)?;
        let blocks = trace.as_deref_mut().map(|t| &mut t.blocks);
        let x = self.blocks(x, 0..self.blocks.len(), &pass, blocks, interrupt)?;
        self.merge(&x, &pass.order, trace)
    }

    /// These blocks over states in window order.
    fn blocks(
        &self,
        mut x: Tensor,
        range: Range<usize>,
        pass: &Pass,
        mut trace: Option<&mut Vec<Tensor>>,
        interrupt: Interrupt,
    ) -> Result<Tensor> {
        let (windowed, full) = (self.layout(&pass.order.windows), self.layout(&pass.order.images));
        for i in range {
            interrupt.check()?;
            let layout = if self.config.fullatt_block_indexes.contains(&i) { &full } else { &windowed };
            x = self.blocks[i].forward(&x, &pass.table, layout)?;
            if let Some(t) = trace.as_deref_mut() {
                t.push(x.clone());
            }
        }
        Ok(x)
    }

    /// States in window order to image tokens in their own order.
    fn merge(&self, x: &Tensor, order: &WindowOrder, trace: Option<&mut VisionTrace>) -> Result<Tensor> {
        let unit = self.config.merge_size * self.config.merge_size;
        let x =
            self.ln_q.forward_as(x, self.mlp0.input_type())?.reshape(((), unit * self.config.hidden_size))?;
        let x = self.mlp2.forward(&kernels::gelu_erf(&self.mlp0.forward(&x)?)?)?;
        if let Some(t) = trace {
            t.merger = Some(x.clone());
        }
        pick(&x, &order.inverse())
    }

    /// Blocks before the first one with full attention.
    fn local_blocks(&self) -> Range<usize> {
        let full = |i: &usize| self.config.fullatt_block_indexes.contains(i);
        0..(0..self.blocks.len()).find(full).unwrap_or(self.blocks.len())
    }

    /// Prepares to encode images that differ little from this one, whose embedded patches are `[patches, hidden]`.
    ///
    /// # Errors
    /// [`crate::Error::Tensors`] if the rows are not those of the grid.
    pub fn base(&self, embedded: Tensor, grid: Grid) -> Result<VisionBase> {
        let pass = self.pass(&[grid], embedded.device())?;
        let local =
            self.blocks(pick(&embedded, &pass.patches)?, self.local_blocks(), &pass, None, Interrupt::NEVER)?;
        Ok(VisionBase { grid, embedded, local })
    }

    /// Encodes images that differ from another one in some patches, one image per change: what
    /// [`VisionTower::encode`] gives for them, `[changes * tokens, out_hidden]`. Windows without a change are taken over as far
    /// as attention stays within windows.
    ///
    /// # Errors
    /// [`Error::Argument`] on a patch that the image does not have; [`Error::Tensors`] on other shapes.
    pub fn encode_changed(&self, base: &VisionBase, changes: &[Change]) -> Result<Tensor> {
        let device = base.embedded.device();
        let one = self.pass(&[base.grid], device)?;
        let patches = one.patches.len();
        // Each changed window of each image: which rows it embeds, and where its states belong.
        let (mut inputs, mut places) = (Vec::new(), Vec::new());
        let mut windows: Vec<Range<usize>> = Vec::new();
        let mut states: Vec<u32> = Vec::with_capacity(changes.len() * patches);
        let mut sources = vec![base.embedded.clone()];
        let mut known = patches;
        for change in changes {
            change.check(patches)?;
            let mut row_of: Vec<usize> = (0..patches).collect();
            change.rows.iter().enumerate().for_each(|(i, &row)| row_of[row] = known + i);
            known += change.rows.len();
            sources.extend(change.embedded.clone());
            let first = states.len();
            states.extend(0..patches as u32);
            for window in &one.order.windows {
                let rows = || window.clone().map(|place| row_of[one.patches[place] as usize]);
                if rows().all(|row| row < patches) {
                    continue;
                }
                windows.push(places.len()..places.len() + window.len());
                for (place, row) in window.clone().zip(rows()) {
                    states[first + place] = (patches + places.len()) as u32;
                    inputs.push(row as u32);
                    places.push(place as u32);
                }
            }
        }
        let mut local = base.local.clone();
        if !places.is_empty() {
            let x = pick(&Tensor::cat(&sources, 0)?, &inputs)?;
            let index = Tensor::from_slice(&places, places.len(), device)?;
            let order = WindowOrder { index: Vec::new(), windows, images: Vec::new() };
            let some = Pass { order, patches: Vec::new(), table: one.table.select(&index)? };
            local = Tensor::cat(
                &[&local, &self.blocks(x, self.local_blocks(), &some, None, Interrupt::NEVER)?],
                0,
            )?;
        }
        let all = self.pass(&vec![base.grid; changes.len()], device)?;
        let x = pick(&local, &states)?;
        let rest = self.local_blocks().end..self.blocks.len();
        let x = self.blocks(x, rest, &all, None, Interrupt::NEVER)?;
        self.merge(&x, &all.order, None)
    }
}

/// Rows of a table, in this order.
fn pick(x: &Tensor, rows: &[u32]) -> Result<Tensor> {
    Ok(x.index_select(&Tensor::from_slice(rows, rows.len(), x.device())?, 0)?)
}
