//! Values that training starts from.

use crate::error::Result;
use crate::query::NumberTokens;
use crate::vlm::qwen2_5::token_table::FIRST_ADDED;
use candle_core::{Device, Tensor};
use rand::Rng;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use std::collections::BTreeMap;

pub(super) fn normal(rng: &mut ChaCha8Rng) -> f32 {
    let (u, v): (f32, f32) = (rng.random::<f32>().max(1e-9), rng.random());
    (-2.0 * u.ln()).sqrt() * (std::f32::consts::TAU * v).cos()
}

/// Initial values of all tensors of a layout (see [`crate::vlm::checkpoint::weights::Weights::wanted`]).
///
/// Norms are 1, biases 0, projections normal with variance 1 / inputs (those into the residual stream smaller), fusion
/// convolutions He; the depth branch's and the last fusion convolution are 0 as the paper asks (Eq. 1b, 2b), and so is the
/// second factor of each LoRA. Number tokens
/// start as sinusoids of their value.
///
/// # Errors
/// [`crate::Error::Tensors`] if a tensor cannot be made.
pub fn initial(
    layout: &BTreeMap<String, Vec<usize>>,
    number_ids: &[u32],
    layers: usize,
    seed: u64,
) -> Result<BTreeMap<String, Tensor>> {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let added = number_ids.first().is_some_and(|&id| id >= FIRST_ADDED);
    let own = format!("{}.embedding", NumberTokens::NAME);
    let number_rows: Vec<usize> = number_ids.iter().map(|&id| (id % FIRST_ADDED) as usize).collect();
    let mut out = BTreeMap::new();
    for (name, shape) in layout {
        let count: usize = shape.iter().product();
        let fan_in = (count / shape[0]) as f32;
        let residual = 0.5 / (2.0 * layers as f32).sqrt();
        let std = if name.ends_with("bias")
            || name.ends_with("running_mean")
            || name.starts_with("sdim.fusion.depth.conv")
            || name.starts_with("sdim.fusion.out")
            || name.starts_with("sdim.glimpse")
            || name.starts_with("sdim.wide_glimpse.down")
            || name.contains(".lora_B.")
        {
            0.0
        } else if name.starts_with("sdim.fusion") && shape.len() == 4 {
            (2.0 / fan_in).sqrt()
        } else if name.ends_with("embed_tokens.weight") {
            0.1
        } else if name.contains("o_proj") || name.contains("down_proj") || name.contains("attn.proj") {
            residual / fan_in.sqrt()
        } else {
            1.0 / fan_in.sqrt()
        };
        let mut values: Vec<f32> = if shape.len() == 1 && std != 0.0 {
            vec![1.0; count]
        } else if std == 0.0 {
            vec![0.0; count]
        } else {
            (0..count).map(|_| normal(&mut rng) * std).collect()
        };
        let numbers = if added { *name == own } else { name.ends_with("embed_tokens.weight") };
        if numbers && number_rows.len() > 11 {
            write_sinusoids(&mut values, shape[1], &number_rows);
        }
        out.insert(name.clone(), Tensor::from_vec(values, shape.as_slice(), &Device::Cpu)?);
    }
    Ok(out)
}

/// Rows of the number tokens: pairs of cosine and sine of the value at frequencies from half a turn over the whole
/// range up to one turn over five bins.
fn write_sinusoids(table: &mut [f32], width: usize, rows: &[usize]) {
    const AMPLITUDE: f32 = 0.28;
    let pairs = width / 2;
    let top = rows.len() as f32 * 0.4;
    for (k, &row) in rows.iter().enumerate() {
        let value = (k as f32 + 0.5) / rows.len() as f32;
        let row = &mut table[row * width..][..width];
        for j in 0..pairs {
            let turn = std::f32::consts::PI * top.powf(j as f32 / (pairs - 1).max(1) as f32) * value;
            row[2 * j] = turn.cos() * AMPLITUDE;
            row[2 * j + 1] = turn.sin() * AMPLITUDE;
        }
    }
}
