//! The forward pass of a batch: from examples to the logits of their answers.

use super::batch::Example;
use crate::error::Result;
use crate::fusion::Normalise;
use crate::kernels::{self, Block};
use crate::model::SdimModel;
use crate::query::prompt::{Glimpse, Tokens};
use crate::vlm::qwen2_5::decoder::Context;
use crate::vlm::qwen2_5::preprocess::Pixels;
use crate::vlm::qwen2_5::rope::Position;
use candle_core::{Device, Tensor};

/// Logits of the number rows at each supervised token of all examples, `[supervised, numbers]`: the questions of an example
/// one after the other, and all examples packed into one sequence of tokens.
pub(super) fn logits(model: &SdimModel, examples: &[Example], normalise: Normalise) -> Result<Tensor> {
    let image_tokens = encode(model, examples, normalise)?;
    let decoder = &model.vlm.decoder;
    let packed = Packed::new(examples);
    let embedded = model.vlm.embed_prompt(&packed.ids, &image_tokens)?;
    let views = examples.iter().map(|e| e.view(model)).collect::<Result<Vec<_>>>()?;
    let groups: Vec<_> = views.iter().zip(&packed.glimpses).map(|(v, g)| (v, g.as_slice())).collect();
    let embedded = model.add_glimpses(embedded, &groups)?;
    let table = decoder.rope().table(&packed.positions, &Device::Cpu)?;
    let layout = decoder.layout(packed.blocks);
    let hidden = decoder.forward(&embedded, &table, Context::Packed(&layout), None)?;
    let count = packed.supervised.len();
    let rows = hidden.index_select(&Tensor::from_vec(packed.supervised, count, &Device::Cpu)?, 0)?;
    // Not the model's own `number_rows`, which were copied from the head when it was built.
    let head = decoder.head_rows(&model.prompts.numbers().ids)?;
    kernels::linear(&decoder.final_norm(&rows)?, &head, None)
}

/// Image tokens of all examples, which have one size (Eq. 1-3).
pub(super) fn encode(model: &SdimModel, examples: &[Example], normalise: Normalise) -> Result<Tensor> {
    let frames: Vec<&Pixels> = examples.iter().map(|e| &e.pixels).collect();
    let (width, height) = frames.first().map_or((0, 0), |p| p.resized.dimensions());
    let sparse: Vec<f32> = examples.iter().flat_map(|e| e.scattered.iter().copied()).collect();
    let shape = (examples.len(), height as usize, width as usize, 1);
    model.encode_batch(&frames, &Tensor::from_vec(sparse, shape, &Device::Cpu)?, normalise)
}

/// All examples' tokens in one sequence: each prefix, followed by its questions, which see it and themselves.
struct Packed {
    ids: Vec<u32>,
    positions: Vec<Position>,
    blocks: Vec<Block>,
    supervised: Vec<u32>,
    /// Per example.
    glimpses: Vec<Vec<Glimpse>>,
}

impl Packed {
    fn new(examples: &[Example]) -> Self {
        let mut out =
            Self { ids: vec![], positions: vec![], blocks: vec![], supervised: vec![], glimpses: vec![] };
        for e in examples {
            out.glimpses.push(Vec::new());
            let start = out.ids.len();
            out.extend(&e.prefix);
            let end = out.ids.len();
            let p = end - start;
            let block = Block {
                queries: start..end,
                shared: 0..0,
                own_start: start,
                q_period: p,
                k_period: p,
                causal: true,
            };
            out.blocks.push(block);
            for run in e.items.chunk_by(|a, b| a.tokens.len() == b.tokens.len()) {
                let (from, s) = (out.ids.len(), run[0].tokens.len());
                for item in run {
                    out.extend(&item.tokens);
                    let last = out.ids.len();
                    out.supervised.extend((last - item.supervised..last).map(|r| r as u32));
                }
                out.blocks.push(Block {
                    queries: from..out.ids.len(),
                    shared: start..end,
                    own_start: from,
                    q_period: s,
                    k_period: s,
                    causal: true,
                });
            }
        }
        out
    }

    fn extend(&mut self, tokens: &Tokens) {
        let start = self.ids.len();
        if let Some(list) = self.glimpses.last_mut() {
            list.extend(tokens.glimpses.iter().map(|g| Glimpse { token: start + g.token, ..*g }));
        }
        self.ids.extend(&tokens.ids);
        self.positions.extend(&tokens.positions);
    }
}
