//! Random weights whose bits follow from the tensors' names, as `tests/reference/make_family.py` computes them.

use candle_core::{Device, Tensor};
use sdim::internals::vlm::checkpoint::weights::Weights;
use sdim::internals::vlm::qwen2_5::QwenVl;
use sdim::internals::vlm::qwen2_5::config::VlmConfig;
use sdim::settings::RopeLayout;
use std::collections::{BTreeMap, HashMap};

/// The finaliser of MurmurHash3.
pub fn mix(mut x: u32) -> u32 {
    x = (x ^ (x >> 16)).wrapping_mul(0x85EB_CA6B);
    x = (x ^ (x >> 13)).wrapping_mul(0xC2B2_AE35);
    x ^ (x >> 16)
}

/// Uniform in -1 to 1.
fn unit(index: u32, seed: u32) -> f32 {
    let x = mix(index.wrapping_mul(0x9E37_79B1).wrapping_add(seed));
    (x >> 8) as f32 * 2f32.powi(-23) - 1.0
}

fn values(name: &str, shape: &[usize]) -> Vec<f32> {
    let seed = crc32fast::hash(name.as_bytes());
    let norm = name.contains("norm") || name.contains("ln_q");
    let gain = if norm || shape.len() == 1 {
        0.35
    } else if name.contains("embed_tokens") {
        0.25
    } else {
        let gains = [("patch_embed", 0.05), ("qkv", 3.0), ("q_proj", 3.0), ("k_proj", 3.0)];
        let gain = gains.iter().find(|(part, _)| name.contains(part)).map_or(1.75, |(_, gain)| *gain);
        gain / (shape[1..].iter().product::<usize>() as f64).sqrt()
    };
    let (offset, gain) = (if norm { 1.0 } else { 0.0 }, gain as f32);
    (0..shape.iter().product::<usize>()).map(|i| offset + gain * unit(i as u32, seed)).collect()
}

/// All tensors of a config under their published names.
pub fn weights(config: &VlmConfig) -> BTreeMap<String, Tensor> {
    let nothing = Weights::from_tensors("nothing", HashMap::new());
    QwenVl::new(config.clone(), &nothing, RopeLayout::Contiguous).unwrap();
    let tensor = |(name, shape): (String, Vec<usize>)| {
        let tensor = Tensor::from_vec(values(&name, &shape), shape, &Device::Cpu).unwrap();
        (name, tensor)
    };
    nothing.wanted().into_iter().map(tensor).collect()
}

/// CRC-32 of the little-endian bytes of f32 tensors, one after the other.
pub fn checksum<'a>(tensors: impl IntoIterator<Item = &'a Tensor>) -> u32 {
    let mut hasher = crc32fast::Hasher::new();
    for tensor in tensors {
        for value in tensor.flatten_all().unwrap().to_vec1::<f32>().unwrap() {
            hasher.update(&value.to_le_bytes());
        }
    }
    hasher.finalize()
}
