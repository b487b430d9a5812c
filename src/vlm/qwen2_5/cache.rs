//! Keys and values of tokens that were already read. A cache is an argument of a forward pass, never a field of a layer.

use crate::error::Result;
use crate::kernels::SharedKeys;
use candle_core::Tensor;

/// Keys and values per layer, of `items` sequences of equal length that do not see each other.
///
/// A prompt is one item; a batch of query suffixes is one item per query. The number of cached tokens is not the next
/// position: see [`crate::vlm::qwen2_5::positions`].
#[derive(Debug, Clone)]
pub struct KvCache {
    items: usize,
    len: usize,
    layers: Vec<Option<SharedKeys>>,
}

impl KvCache {
    /// An empty cache for a decoder of `layers` layers.
    pub fn new(layers: usize, items: usize) -> Self {
        Self { items, len: 0, layers: vec![None; layers] }
    }

    /// Sequences.
    pub fn items(&self) -> usize {
        self.items
    }

    /// Tokens held for each sequence.
    pub fn len(&self) -> usize {
        self.len
    }

    /// Whether no token is held.
    pub fn is_empty(&self) -> bool {
        self.len == 0
    }

    /// Layers.
    pub(crate) fn layers(&self) -> usize {
        self.layers.len()
    }

    /// Keys and values of a layer, each `[items * len, kv_heads * head_dim]`; `None` while empty.
    pub fn layer(&self, layer: usize) -> Option<&SharedKeys> {
        self.layers.get(layer)?.as_ref()
    }

    /// Appends `[items * new, width]` to each sequence of a layer and returns all of its keys and values.
    /// [`KvCache::advance`] makes the new length count, once all layers have appended.
    pub(crate) fn append(&mut self, layer: usize, k: &Tensor, v: &Tensor) -> Result<(Tensor, Tensor)> {
        let (k, v) = match &self.layers[layer] {
            None => (k.clone(), v.clone()),
            Some(old) => (self.join(old.keys(), k)?, self.join(old.values(), v)?),
        };
        self.layers[layer] = Some(SharedKeys::new(k.clone(), v.clone()));
        Ok((k, v))
    }

    fn join(&self, old: &Tensor, new: &Tensor) -> Result<Tensor> {
        let width = old.dim(1)?;
        let old = old.reshape((self.items, (), width))?;
        let new = new.reshape((self.items, (), width))?;
        Ok(Tensor::cat(&[old, new], 1)?.reshape(((), width))?)
    }

    /// The cache of these items only, in this order.
    ///
    /// # Errors
    /// [`crate::Error::Argument`] if an index is out of range.
    pub fn select(&self, items: &[usize]) -> Result<Self> {
        if let Some(item) = items.iter().find(|&&item| item >= self.items) {
            return Err(crate::Error::argument("item of a cache", item, format!("below {}", self.items)));
        }
        let rows = items.iter().flat_map(|&i| (i * self.len..(i + 1) * self.len).map(|r| r as u32));
        let rows: Vec<u32> = rows.collect();
        // The same for all layers: it goes to the device once.
        let mut index: Option<Tensor> = None;
        let mut pick = |t: &Tensor| -> Result<Tensor> {
            let index = match &index {
                Some(index) => index,
                None => index.insert(Tensor::from_slice(&rows, rows.len(), t.device())?),
            };
            Ok(t.index_select(index, 0)?)
        };
        let layers = self.layers.iter().map(|layer| match layer {
            Some(old) => Ok(Some(SharedKeys::new(pick(old.keys())?, pick(old.values())?))),
            None => Ok(None),
        });
        Ok(Self { items: items.len(), len: self.len, layers: layers.collect::<Result<_>>()? })
    }

    pub(crate) fn advance(&mut self, tokens: usize) {
        self.len += tokens;
    }
}
