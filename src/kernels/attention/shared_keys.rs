//! Keys and values that many calls see.

use super::bf16::PackedKeys;
use candle_core::Tensor;
use std::sync::{Arc, OnceLock};

/// Keys and values that come before the own ones of many calls of [`super::attention()`]: those of a prefix. In bf16 they are
/// packed at the first call, and kept so for the others: half as much memory again as the tensors hold in f32. The tensors must not be changed in
/// place (candle's `slice_set`) once they are here.
#[derive(Debug, Clone)]
pub struct SharedKeys {
    keys: Tensor,
    values: Tensor,
    /// All rows, for each key head.
    packed: OnceLock<Arc<[PackedKeys]>>,
}

impl SharedKeys {
    /// Keys and values, both `[n, kv_heads * head_dim]`; other shapes are errors of [`super::attention()`].
    pub fn new(keys: Tensor, values: Tensor) -> Self {
        Self { keys, values, packed: OnceLock::new() }
    }

    /// The keys.
    pub fn keys(&self) -> &Tensor {
        &self.keys
    }

    /// The values.
    pub fn values(&self) -> &Tensor {
        &self.values
    }

    /// All rows packed for so many heads, by `pack` if they are not yet.
    pub(super) fn packed(
        &self,
        kv_heads: usize,
        pack: impl FnOnce() -> Vec<PackedKeys>,
    ) -> Arc<[PackedKeys]> {
        match self.packed.get() {
            Some(packed) if packed.len() == kv_heads => packed.clone(),
            _ => {
                // Not by `get_or_init`: a thread of the pool that waits in it may be the one whose work the packing thread waits for.
                let packed: Arc<[PackedKeys]> = pack().into();
                let _ = self.packed.set(packed.clone());
                packed
            }
        }
    }
}
