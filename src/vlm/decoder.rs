//! The language decoder (`model.*` and `lm_head` of a checkpoint).
//!
//! Source: `Qwen2_5_VLTextModel` of the reference's `modeling_qwen2_5_vl.py`.

use super::cache::KvCache;
use super::config::TextConfig;
use super::linear::{GatedMlp, Linear, RmsNorm};
use super::matrix::Matrix;
use super::rope::{MRope, RopeLayout, RopeTable};
use super::weights::Weights;
use crate::error::{Error, Result};
use crate::kernels::{self, AttentionLayout, Block};
use candle_core::Tensor;

struct DecoderLayer {
    input_layernorm: RmsNorm,
    q_proj: Linear,
    k_proj: Linear,
    v_proj: Linear,
    o_proj: Linear,
    post_attention_layernorm: RmsNorm,
    mlp: GatedMlp,
}

/// Which tokens a pass sees beside its own.
pub enum Context<'a> {
    /// Tokens packed from many sequences, with an explicit layout and no cache (training).
    Packed(&'a AttentionLayout),
    /// `own.items()` sequences of equal length, each continuing its own cache and seeing all of `shared`.
    Cached {
        /// One sequence that every item sees, if any.
        shared: Option<&'a KvCache>,
        /// What each item has read itself; grows by this pass.
        own: &'a mut KvCache,
    },
}

impl DecoderLayer {
    fn new(c: &TextConfig, weights: &Weights, index: usize) -> Result<Self> {
        let (d, kv) = (c.hidden_size, c.kv_heads * c.head_dim());
        let name = format!("model.layers.{index}");
        let attn = |part: &str, outputs, bias| {
            Linear::new(weights, &format!("{name}.self_attn.{part}"), d, outputs, bias)
        };
        let norm = |part: &str| RmsNorm::new(weights, &format!("{name}.{part}"), d, c.rms_norm_eps);
        Ok(Self {
            input_layernorm: norm("input_layernorm")?,
            q_proj: attn("q_proj", d, true)?,
            k_proj: attn("k_proj", kv, true)?,
            v_proj: attn("v_proj", kv, true)?,
            o_proj: attn("o_proj", d, false)?,
            post_attention_layernorm: norm("post_attention_layernorm")?,
            mlp: GatedMlp::new(weights, &format!("{name}.mlp"), d, c.intermediate_size, false)?,
        })
    }

    /// `[tokens, hidden]` to the same.
    fn forward(
        &self,
        x: &Tensor,
        table: &RopeTable,
        layout: &AttentionLayout,
        index: usize,
        context: &mut Context,
    ) -> Result<Tensor> {
        let normed = self.input_layernorm.forward(x)?;
        let q = kernels::rope(&self.q_proj.forward(&normed)?, &table.cos, &table.sin, layout.heads)?;
        let k = kernels::rope(&self.k_proj.forward(&normed)?, &table.cos, &table.sin, layout.kv_heads)?;
        let v = self.v_proj.forward(&normed)?;
        let mixed = match context {
            Context::Packed(_) => kernels::attention(&q, &k, &v, None, layout)?,
            Context::Cached { shared, own } => {
                let (k, v) = own.append(index, &k, &v)?;
                let shared = shared.and_then(|s| s.layer(index));
                kernels::attention(&q, &k, &v, shared, layout)?
            }
        };
        let x = (x + self.o_proj.forward(&mixed)?)?;
        Ok((&x + self.mlp.forward(&self.post_attention_layernorm.forward(&x)?)?)?)
    }
}

/// The decoder with its embedding and output head.
pub struct Decoder {
    config: TextConfig,
    embed_tokens: Matrix,
    layers: Vec<DecoderLayer>,
    norm: RmsNorm,
    /// `[vocab, hidden]`: `lm_head`, or the embedding itself where the config ties them.
    head: Matrix,
    rope: MRope,
}

impl Decoder {
    /// Reads `model.*` and, unless tied, `lm_head.weight`.
    ///
    /// # Errors
    /// As [`Weights::get`].
    pub fn new(config: &TextConfig, weights: &Weights, layout: RopeLayout) -> Result<Self> {
        let table = [config.vocab_size, config.hidden_size];
        let embed_tokens = weights.matrix("model.embed_tokens.weight", table, None)?;
        let head = if config.tie_word_embeddings {
            // Merged or re-saved tied checkpoints can carry a redundant copy.
            weights.ignore("lm_head.weight");
            embed_tokens.clone()
        } else {
            weights.matrix("lm_head.weight", table, None)?
        };
        Ok(Self {
            embed_tokens,
            layers: (0..config.layers)
                .map(|i| DecoderLayer::new(config, weights, i))
                .collect::<Result<_>>()?,
            norm: RmsNorm::new(weights, "model.norm", config.hidden_size, config.rms_norm_eps)?,
            head,
            rope: MRope::new(config, layout),
            config: config.clone(),
        })
    }

    /// The decoder's configuration.
    pub fn config(&self) -> &TextConfig {
        &self.config
    }

    /// Rotary positions of this decoder.
    pub fn rope(&self) -> &MRope {
        &self.rope
    }

    /// An empty cache of this decoder's depth.
    pub fn cache(&self, items: usize) -> KvCache {
        KvCache::new(self.layers.len(), items)
    }

    /// Token embeddings `[ids, hidden]`.
    ///
    /// # Errors
    /// [`Error::Argument`] on an id outside the vocabulary.
    pub fn embed(&self, ids: &[u32]) -> Result<Tensor> {
        self.embed_tokens.rows(ids)
    }

    /// The layout of heads with these blocks.
    pub fn layout(&self, blocks: Vec<Block>) -> AttentionLayout {
        let c = &self.config;
        AttentionLayout { heads: c.heads, kv_heads: c.kv_heads, head_dim: c.head_dim(), blocks }
    }

    /// All layers without the final norm: `[tokens, hidden]` to the same. `trace` receives each layer's output.
    ///
    /// # Errors
    /// [`Error::Argument`] if the rows do not divide into the cache's items; [`Error::Tensors`] on other shapes.
    pub fn forward(
        &self,
        embedded: &Tensor,
        table: &RopeTable,
        mut context: Context,
        mut trace: Option<&mut Vec<Tensor>>,
    ) -> Result<Tensor> {
        let rows = embedded.dim(0)?;
        let layout = match &context {
            Context::Packed(layout) => (*layout).clone(),
            Context::Cached { shared, own } => {
                let items = own.items();
                if items == 0 || rows % items != 0 {
                    return Err(Error::argument("rows", rows, format!("a multiple of {items} cache items")));
                }
                let q_period = rows / items;
                self.layout(vec![Block {
                    queries: 0..rows,
                    shared: 0..shared.map_or(0, KvCache::len),
                    own_start: 0,
                    q_period,
                    k_period: own.len() + q_period,
                    causal: true,
                }])
            }
        };
        let mut x = embedded.clone();
        for (i, layer) in self.layers.iter().enumerate() {
            x = layer.forward(&x, table, &layout, i, &mut context)?;
            if let Some(t) = trace.as_deref_mut() {
                t.push(x.clone());
            }
        }
        if let Context::Cached { own, .. } = context {
            let items = own.items();
            own.advance(rows / items);
        }
        Ok(x)
    }

    /// The final norm.
    ///
    /// # Errors
    /// [`Error::Tensors`] on another width.
    pub fn final_norm(&self, x: &Tensor) -> Result<Tensor> {
        self.norm.forward(x)
    }

    /// Rows of the output head for these tokens only, `[ids, hidden]`.
    ///
    /// # Errors
    /// [`Error::Argument`] on an id outside the vocabulary.
    pub fn head_rows(&self, ids: &[u32]) -> Result<Tensor> {
        self.head.rows(ids)
    }

    /// Logits over the entire vocabulary of normed hidden states, `[rows, vocab]`.
    ///
    /// # Errors
    /// [`Error::Tensors`] on another width.
    pub fn logits(&self, normed: &Tensor) -> Result<Tensor> {
        self.head.linear(normed, None)
    }
}
