//! Times of what lies between the products of a decoder layer, as it is done on the device.

use anyhow::Context as _;
use candle_core::{DType, Device, Tensor};
use sdim::internals::kernels::{
    self, AttentionLayout, Block, Precision, SharedKeys, rms_norm_rounded, swiglu_rounded, widen,
};
use sdim::internals::vlm::qwen2_5::config::TextConfig;
use std::time::Instant;

/// Calls of which the time is taken, after some that are not.
const CALLS: usize = 20;
const BEFORE: usize = 3;

/// Milliseconds of each operation for so many rows, one token of each of so many items, that see a prefix of so many tokens.
pub fn times(
    c: &TextConfig,
    rows: usize,
    prefix: usize,
    device: &Device,
) -> anyhow::Result<Vec<(&'static str, f64)>> {
    let (d, inner, kv) = (c.hidden_size, c.intermediate_size, c.kv_heads * c.head_dim());
    let some = |rows: usize, columns: usize| Tensor::randn(0f32, 1.0, (rows, columns), device);
    let rounded = |t: Tensor| t.to_dtype(DType::BF16);
    let (x, weight, bias) = (some(rows, d)?, some(1, d)?.flatten_all()?, some(1, d)?.flatten_all()?);
    let (y, gate, up) =
        (rounded(some(rows, d)?)?, rounded(some(rows, inner)?)?, rounded(some(rows, inner)?)?);
    let (q, k, v) = (some(rows, d)?, some(rows, kv)?, some(rows, kv)?);
    let shared = SharedKeys::new(some(prefix, kv)?, some(prefix, kv)?);
    let layout = |block| AttentionLayout {
        heads: c.heads,
        kv_heads: c.kv_heads,
        head_dim: c.head_dim(),
        blocks: vec![block],
        precision: Precision::Bf16,
    };
    let answers = layout(Block {
        queries: 0..rows,
        shared: 0..prefix,
        own_start: 0,
        q_period: 1,
        k_period: 1,
        causal: true,
    });
    let prompt = rows.min(prefix);
    let reading = layout(Block {
        queries: 0..prompt,
        shared: 0..0,
        own_start: 0,
        q_period: prompt,
        k_period: prompt,
        causal: true,
    });
    let operations: [(&str, &dyn Fn() -> sdim::Result<Tensor>); 6] = [
        ("bias, f32", &|| widen(&y, Some(&bias), None)),
        ("residual", &|| widen(&y, None, Some(&x))),
        ("rms norm", &|| rms_norm_rounded(&x, &weight, 1e-6, DType::BF16)),
        ("gate", &|| swiglu_rounded([&gate, &up], [None, None])),
        ("attention", &|| kernels::attention(&q, &k, &v, Some(&shared), &answers)),
        ("prompt", &|| kernels::attention(&q, &k, &v, None, &reading)),
    ];
    let mut out = Vec::new();
    for (name, run) in operations {
        for _ in 0..BEFORE {
            run().context(name)?;
        }
        device.synchronize()?;
        let start = Instant::now();
        for _ in 0..CALLS {
            run()?;
        }
        device.synchronize()?;
        out.push((name, start.elapsed().as_secs_f64() * 1e3 / CALLS as f64));
    }
    Ok(out)
}
