//! The language decoder (`model.*` and `lm_head` of a checkpoint).
//!
//! Source: `Qwen2_5_VLTextModel` of the reference's `modeling_qwen2_5_vl.py`.

use super::cache::KvCache;
use super::config::TextConfig;
use super::interrupt::Interrupt;
use super::rope::{MRope, RopeLayout, RopeTable};
use super::token_table::TokenTable;
use crate::error::{Error, Result};
use crate::kernels::{self, AttentionLayout, Block, Precision, SharedKeys, WeightFormat};
use crate::vlm::checkpoint::weights::Weights;
use crate::vlm::layers::linear::{JoinedLinear, Linear};
use crate::vlm::layers::matrix::Matrix;
use crate::vlm::layers::mlp::GatedMlp;
use crate::vlm::layers::norm::RmsNorm;
use candle_core::Tensor;

struct DecoderLayer {
    input_layernorm: RmsNorm,
    /// `k_proj`, `v_proj` and `q_proj`.
    kvq_proj: JoinedLinear<3>,
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
        let attn = |part: &str| format!("{name}.self_attn.{part}");
        let [k_proj, v_proj, q_proj] = ["k_proj", "v_proj", "q_proj"].map(attn);
        let kvq = [(&*k_proj, kv), (&*v_proj, kv), (&*q_proj, d)];
        let norm = |part: &str| RmsNorm::new(weights, &format!("{name}.{part}"), d, c.rms_norm_eps);
        Ok(Self {
            input_layernorm: norm("input_layernorm")?,
            kvq_proj: JoinedLinear::new(weights, kvq, d, true)?,
            o_proj: Linear::new(weights, &attn("o_proj"), d, d, false)?,
            post_attention_layernorm: norm("post_attention_layernorm")?,
            mlp: GatedMlp::new(weights, &format!("{name}.mlp"), d, c.intermediate_size, false)?,
        })
    }

    /// `[tokens, hidden]` to the same, or to the rows of `kept`.
    fn forward(
        &self,
        x: &Tensor,
        table: &RopeTable,
        layout: &AttentionLayout,
        kept: Option<&Kept>,
        index: usize,
        context: &mut Context,
    ) -> Result<Tensor> {
        let normed = self.input_layernorm.forward_as(x, self.kvq_proj.input_type())?;
        let Some(kept) = kept else {
            let [k, v, q] = self.kvq_proj.forward(&normed)?;
            let keys = Keys::new(k, v, table, layout, index, context)?;
            return self.rest(x, &q, &keys, table, layout);
        };
        let [k, v] = self.kvq_proj.first(&normed)?;
        let keys = Keys::new(k, v, table, layout, index, context)?;
        let Kept::Rows { rows, table, layout } = kept else { return Ok(x.narrow(0, 0, 0)?) };
        // Keys and values come along for few rows.
        let [_, _, q] = self.kvq_proj.forward(&normed.index_select(rows, 0)?)?;
        self.rest(&x.index_select(rows, 0)?, &q, &keys, table, layout)
    }

    /// From the queries on.
    fn rest(
        &self,
        x: &Tensor,
        q: &Tensor,
        keys: &Keys,
        table: &RopeTable,
        layout: &AttentionLayout,
    ) -> Result<Tensor> {
        let q = kernels::rope(q, &table.cos, &table.sin, layout.heads)?;
        let x =
            self.o_proj.forward_onto(&kernels::attention(&q, &keys.k, &keys.v, keys.shared, layout)?, x)?;
        self.mlp.forward_onto(&self.post_attention_layernorm.forward_as(&x, self.mlp.input_type())?, &x)
    }
}

/// Keys and values that the queries of a pass see.
struct Keys<'a> {
    k: Tensor,
    v: Tensor,
    shared: Option<&'a SharedKeys>,
}

impl<'a> Keys<'a> {
    /// Turns the pass's own keys by their positions and puts them to those of its context.
    fn new(
        k: Tensor,
        v: Tensor,
        table: &RopeTable,
        layout: &AttentionLayout,
        index: usize,
        context: &mut Context<'a>,
    ) -> Result<Self> {
        let k = kernels::rope(&k, &table.cos, &table.sin, layout.kv_heads)?;
        Ok(match context {
            Context::Packed(_) => Self { k, v, shared: None },
            Context::Cached { shared, own } => {
                let (k, v) = own.append(index, &k, &v)?;
                Self { k, v, shared: shared.and_then(|s| s.layer(index)) }
            }
        })
    }
}

/// Of which tokens the last layer's output is wanted; keys and values are made of all.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Keep {
    /// Every token.
    All,
    /// The last token of each item of the cache: what the next token is read from.
    Last,
    /// No token: the pass only fills the cache.
    Nothing,
}

/// [`Keep`] in the terms of one pass.
enum Kept {
    None,
    Rows { rows: Tensor, table: RopeTable, layout: AttentionLayout },
}

/// The decoder with its embedding and output head.
pub struct Decoder {
    config: TextConfig,
    embed_tokens: TokenTable,
    layers: Vec<DecoderLayer>,
    norm: RmsNorm,
    /// `lm_head`, or the embedding itself where the config ties them.
    head: TokenTable,
    rope: MRope,
    precision: Precision,
}

impl Decoder {
    /// Reads `model.*` and, unless tied, `lm_head.weight`.
    ///
    /// # Errors
    /// As [`Weights::get`].
    pub fn new(config: &TextConfig, weights: &Weights, layout: RopeLayout) -> Result<Self> {
        let table = [config.vocab_size, config.hidden_size];
        let embed_tokens = TokenTable::read(weights, "model.embed_tokens.weight", table)?;
        let head = if config.tie_word_embeddings {
            // Merged or re-saved tied checkpoints can carry a redundant copy.
            weights.ignore("lm_head.weight");
            embed_tokens.clone()
        } else {
            TokenTable::read(weights, "lm_head.weight", table)?
        };
        Ok(Self {
            embed_tokens,
            layers: (0..config.layers)
                .map(|i| DecoderLayer::new(config, weights, i))
                .collect::<Result<_>>()?,
            norm: RmsNorm::new(weights, "model.norm", config.hidden_size, config.rms_norm_eps)?,
            head,
            rope: MRope::new(config, layout),
            precision: weights.format().into(),
            config: config.clone(),
        })
    }

    /// Puts `count` tokens behind the vocabulary, whose ids are those from [`FIRST_ADDED`](super::token_table::FIRST_ADDED) on: rows of
    /// `{name}.embedding` and, unless the head is tied to the embedding, of `{name}.head`, both `[count, hidden]`.
    ///
    /// # Errors
    /// As [`Weights::get`].
    pub fn add_tokens(&mut self, weights: &Weights, name: &str, count: usize) -> Result<()> {
        let shape = [count, self.config.hidden_size];
        self.embed_tokens.add(weights, &format!("{name}.embedding"), shape)?;
        if self.config.tie_word_embeddings {
            self.head = self.embed_tokens.clone();
            return Ok(());
        }
        self.head.add(weights, &format!("{name}.head"), shape)
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
        AttentionLayout {
            heads: c.heads,
            kv_heads: c.kv_heads,
            head_dim: c.head_dim(),
            blocks,
            precision: self.precision,
        }
    }

    /// All layers without the final norm: `[tokens, hidden]` to the same. `trace` receives each layer's output.
    ///
    /// # Errors
    /// [`Error::Argument`] if there are no rows, they do not divide into the cache's items, or a cache is another decoder's;
    /// [`Error::Tensors`] on other shapes.
    pub fn forward(
        &self,
        embedded: &Tensor,
        table: &RopeTable,
        context: Context,
        trace: Option<&mut Vec<Tensor>>,
    ) -> Result<Tensor> {
        self.run(embedded, table, context, Keep::All, trace, Interrupt::NEVER)
    }

    /// As [`Decoder::forward`] without a trace; gives the rows that `keep` names and saves the others' work in the last
    /// layer.
    ///
    /// # Errors
    /// As [`Decoder::forward`]; [`Error::Argument`] if rows are to be left out without a cache; [`Error::Cancelled`] when interrupted, which
    /// leaves the cache of no use.
    pub fn forward_keeping(
        &self,
        embedded: &Tensor,
        table: &RopeTable,
        context: Context,
        keep: Keep,
        interrupt: Interrupt,
    ) -> Result<Tensor> {
        self.run(embedded, table, context, keep, None, interrupt)
    }

    fn run(
        &self,
        embedded: &Tensor,
        table: &RopeTable,
        mut context: Context,
        keep: Keep,
        mut trace: Option<&mut Vec<Tensor>>,
        interrupt: Interrupt,
    ) -> Result<Tensor> {
        let rows = embedded.dim(0)?;
        let layout = match &context {
            Context::Packed(layout) => (*layout).clone(),
            Context::Cached { shared, own } => self.cached_layout(rows, *shared, own)?,
        };
        let kept = match &context {
            Context::Packed(_) if keep == Keep::All => None,
            Context::Packed(_) => {
                return Err(Error::argument("keep", format!("{keep:?}"), "all rows of packed sequences"));
            }
            Context::Cached { own, .. } => self.kept(keep, table, &layout, own.items(), rows)?,
        };
        let x = kernels::in_pool(embedded.device(), || -> Result<Tensor> {
            let mut x = embedded.clone();
            for (i, layer) in self.layers.iter().enumerate() {
                interrupt.check()?;
                let kept = kept.as_ref().filter(|_| i + 1 == self.layers.len());
                x = layer.forward(&x, table, &layout, kept, i, &mut context)?;
                if let Some(t) = trace.as_deref_mut() {
                    t.push(x.clone());
                }
            }
            Ok(x)
        })?;
        if let Context::Cached { own, .. } = context {
            let items = own.items();
            own.advance(rows / items);
        }
        Ok(x)
    }

    fn cached_layout(&self, rows: usize, shared: Option<&KvCache>, own: &KvCache) -> Result<AttentionLayout> {
        let items = own.items();
        if rows == 0 || items == 0 || !rows.is_multiple_of(items) {
            return Err(Error::argument("rows", rows, format!("a positive multiple of {items} cache items")));
        }
        if let Some(other) =
            [Some(own), shared].into_iter().flatten().find(|c| c.layers() != self.layers.len())
        {
            let expected = format!("{}, those of the decoder", self.layers.len());
            return Err(Error::argument("layers of a cache", other.layers(), expected));
        }
        let q_period = rows / items;
        Ok(self.layout(vec![Block {
            queries: 0..rows,
            shared: 0..shared.map_or(0, KvCache::len),
            own_start: 0,
            q_period,
            k_period: own.len() + q_period,
            causal: true,
        }]))
    }

    fn kept(
        &self,
        keep: Keep,
        table: &RopeTable,
        layout: &AttentionLayout,
        items: usize,
        rows: usize,
    ) -> Result<Option<Kept>> {
        match keep {
            Keep::All => return Ok(None),
            Keep::Last if rows == items => return Ok(None),
            Keep::Last => {}
            Keep::Nothing => return Ok(Some(Kept::None)),
        }
        let length = (rows / items) as u32;
        let last: Vec<u32> = (1..=items as u32).map(|i| i * length - 1).collect();
        let last = Tensor::from_vec(last, items, table.cos.device())?;
        let table = table.select(&last)?;
        let mut layout = layout.clone();
        for block in &mut layout.blocks {
            (block.queries, block.q_period) = (0..items, 1);
        }
        Ok(Some(Kept::Rows { rows: last, table, layout }))
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

    /// As [`Decoder::head_rows`], as a matrix in a format, to multiply by.
    ///
    /// # Errors
    /// As [`Decoder::head_rows`] and [`Matrix::from_tensor`].
    pub fn head_of(&self, ids: &[u32], format: WeightFormat) -> Result<Matrix> {
        self.head.matrix_of(ids, format)
    }

    /// Logits over the entire vocabulary of normed hidden states, `[rows, vocab]`; tokens that were put behind it are not among them.
    ///
    /// # Errors
    /// [`Error::Tensors`] on another width.
    pub fn logits(&self, normed: &Tensor) -> Result<Tensor> {
        self.head.vocabulary().linear(normed, None)
    }
}
