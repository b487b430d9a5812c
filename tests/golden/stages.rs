//! One prompt through the model, compared with the golden tensors at every stage.

use super::common::{Allowed, Golden, device};
use candle_core::{DType, Tensor};
use sdim::internals::vlm::chat::generate::GenerateOptions;
use sdim::internals::vlm::qwen2_5::QwenVl;
use sdim::internals::vlm::qwen2_5::decoder::{Context, Keep};
use sdim::internals::vlm::qwen2_5::grid::{Grid, WindowOrder};
use sdim::internals::vlm::qwen2_5::positions::{PromptPositions, positions};
use sdim::internals::vlm::qwen2_5::rope::{Position, RopeTable, vision_table};

/// One prompt with its images.
pub struct Case<'a> {
    pub golden: &'a Golden,
    pub model: &'a QwenVl,
    pub name: &'a str,
    pub grids: Vec<Grid>,
}

impl Case<'_> {
    fn key(&self, name: &str) -> String {
        format!("{}.{name}", self.name)
    }

    fn close(&self, name: &str, ours: &Tensor) {
        self.golden.close(&self.key(name), ours);
    }

    fn exact<T: TryInto<i64>>(&self, name: &str, ours: impl IntoIterator<Item = T>) {
        let ours = ours.into_iter().map(|v| v.try_into().ok().expect("fits i64"));
        self.golden.exact(&self.key(name), ours);
    }

    /// The reference keeps each angle twice; ours are kept once.
    fn table(&self, prefix: &str, table: &RopeTable) {
        self.close(&format!("{prefix}_cos"), &Tensor::cat(&[&table.cos, &table.cos], 1).unwrap());
        self.close(&format!("{prefix}_sin"), &Tensor::cat(&[&table.sin, &table.sin], 1).unwrap());
    }

    /// Compares everything from the rows of the preprocessor on (none for text alone) with the golden tensors.
    pub fn check(&self, patches: Option<&Tensor>) {
        let ids: Vec<u32> =
            self.golden.integers(&self.key("input_ids")).into_iter().map(|id| id as u32).collect();
        let walked = self.indices(&ids);
        let merged = match patches {
            Some(patches) => self.vision(patches),
            None => Tensor::zeros((0, self.model.config.text.hidden_size), DType::F32, &device()).unwrap(),
        };
        let embedded = self.model.embed_prompt(&ids, &merged).unwrap();
        self.close("inputs_embeds", &embedded);
        self.text(&embedded, &walked);
        self.steps(&embedded, &walked);
        self.generation(&ids, &embedded, &walked);
    }

    fn indices(&self, ids: &[u32]) -> PromptPositions {
        let v = &self.model.config.vision;
        self.exact("grid_thw", self.grids.iter().flat_map(|g| [1, g.height, g.width]));
        let walked = positions(ids, &self.grids, &self.model.config, 1.0).unwrap();
        let axes: [fn(&Position) -> f32; 3] = [|p| p.t, |p| p.h, |p| p.w];
        let axes = axes.into_iter().flat_map(|axis| walked.positions.iter().map(move |p| axis(p) as i64));
        self.exact("position_ids", axes);
        self.exact("rope_delta", [walked.next as i64 - ids.len() as i64]);
        let order = WindowOrder::new(&self.grids, v.merge_size, v.window_tokens());
        self.exact("window_index", order.index.iter().copied());
        self.exact("cu_window_seqlens", std::iter::once(0).chain(order.windows.iter().map(|w| w.end)));
        self.exact("cu_seqlens", std::iter::once(0).chain(order.images.iter().map(|w| w.end)));
        let at: Vec<_> = self.grids.iter().flat_map(|g| g.patch_positions(v.merge_size)).collect();
        self.exact("vision_pos_hw", at.iter().flat_map(|&(row, col)| [row, col]));
        self.table("vision", &vision_table(&at, v.head_dim(), &device()).unwrap());
        self.table("text", &self.model.decoder.rope().table(&walked.positions, &device()).unwrap());
        walked
    }

    fn vision(&self, patches: &Tensor) -> Tensor {
        let tower = &self.model.vision;
        let embedded = tower.patch_embed.forward(patches).unwrap();
        self.close("patch_embed", &embedded);
        let (merged, trace) = tower.encode_traced(&embedded, &self.grids).unwrap();
        for (i, block) in trace.blocks.iter().enumerate() {
            self.close(&format!("vision_block_{i}"), block);
        }
        self.close("merger_window_order", &trace.merger.unwrap());
        self.close("merged", &merged);
        merged
    }

    fn text(&self, embedded: &Tensor, walked: &PromptPositions) {
        let decoder = &self.model.decoder;
        let table = decoder.rope().table(&walked.positions, &device()).unwrap();
        let (mut own, mut layers) = (decoder.cache(1), Vec::new());
        let context = Context::Cached { shared: None, own: &mut own };
        let hidden = decoder.forward(embedded, &table, context, Some(&mut layers)).unwrap();
        for (i, layer) in layers.iter().enumerate() {
            self.close(&format!("text_layer_{i}"), layer);
        }
        let normed = decoder.final_norm(&hidden).unwrap();
        self.close("text_final_norm", &normed);
        let last = normed.narrow(0, normed.dim(0).unwrap() - 1, 1).unwrap();
        self.close("last_logits", &decoder.logits(&last).unwrap().squeeze(0).unwrap());
    }

    /// The logits of each step of greedy generation, with the golden ids put in.
    fn steps(&self, embedded: &Tensor, walked: &PromptPositions) {
        let (model, decoder) = (self.model, &self.model.decoder);
        let mut cache = decoder.cache(1);
        let mut hidden = model.prefill(embedded, &walked.positions, &mut cache, Keep::All).unwrap();
        let mut rows = Vec::new();
        for (step, id) in self.golden.integers(&self.key("generated_ids")).into_iter().enumerate() {
            let last = hidden.narrow(0, hidden.dim(0).unwrap() - 1, 1).unwrap();
            rows.push(decoder.logits(&decoder.final_norm(&last).unwrap()).unwrap());
            let position = Position::text(walked.next + step as f32);
            let embedded = decoder.embed(&[id as u32]).unwrap();
            hidden = model.prefill(&embedded, &[position], &mut cache, Keep::All).unwrap();
        }
        self.close("step_logits", &Tensor::cat(&rows, 0).unwrap());
    }

    fn generation(&self, ids: &[u32], embedded: &Tensor, walked: &PromptPositions) {
        for (penalty, name) in [(1.0, "generated_ids"), (1.05, "generated_ids_rp105")] {
            let options = GenerateOptions {
                max_new_tokens: self.golden.integers(&self.key(name)).len(),
                repetition_penalty: penalty,
                sampling: None,
                stop_ids: Vec::new(),
                usable_vocab: self.model.config.text.vocab_size,
            };
            let ours = self.model.generate(ids, embedded, &walked.positions, walked.next, &options).unwrap();
            if self.golden.allowed == Allowed::Rounding {
                self.exact(name, ours);
            }
        }
    }
}
