//! Each operation against a loop over its values, on the device that `SDIM_TEST_DEVICE` names.

use super::fused::*;
use super::rounded::{Heads, OwnKeys};
use crate::kernels::testing::{close, on_device, random, values};
use candle_core::{DType, Device, Tensor};

/// Rounding to bf16 keeps eight bits.
const ROUNDED: f32 = 5e-3;

/// Random numbers that bf16 holds.
fn bf16(dims: &[usize], seed: u64) -> Tensor {
    random(dims, seed).to_dtype(DType::BF16).unwrap()
}

fn wide(t: &Tensor) -> Tensor {
    t.to_device(&Device::Cpu).unwrap().to_dtype(DType::F32).unwrap()
}

/// A tensor of what `value` gives at each row and column.
fn made(rows: usize, columns: usize, value: impl Fn(usize, usize) -> f32) -> Tensor {
    let all: Vec<f32> = (0..rows * columns).map(|at| value(at / columns, at % columns)).collect();
    Tensor::from_vec(all, (rows, columns), &Device::Cpu).unwrap()
}

#[test]
fn a_product_is_widened_with_its_bias_and_residual() {
    for (n, m) in [(1, 1), (5, 70), (300, 513)] {
        let (y, bias, residual) = (bf16(&[n, m + 9], 1), random(&[m], 2), random(&[n, m], 3));
        let part = wide(&y).narrow(1, 4, m).unwrap();
        let both = part.broadcast_add(&bias).unwrap();
        let [y, there_bias, there_residual] = on_device([&y, &bias, &residual]);
        let y = y.narrow(1, 4, m).unwrap();
        close(&wide(&widen(&y, None, None).unwrap()), &part, 0.0);
        close(&wide(&widen(&y, Some(&there_bias), None).unwrap()), &both, 0.0);
        let all = widen(&y, Some(&there_bias), Some(&there_residual)).unwrap();
        close(&wide(&all), &(&residual + both).unwrap(), 0.0);
        assert!(widen(&y, Some(&there_residual), None).is_err());
        assert!(widen(&y, None, Some(&there_bias)).is_err());
    }
}

#[test]
fn norms_and_gates_are_rounded_once() {
    for (n, m) in [(1, 1), (3, 40), (200, 700)] {
        let (x, weight) = (random(&[n, m], 1), random(&[m], 2));
        let expected = super::rms_norm(&x, &weight, 1e-6).unwrap();
        let [there, there_weight] = on_device([&x, &weight]);
        let found = rms_norm_rounded(&there, &there_weight, 1e-6, DType::BF16).unwrap();
        assert_eq!(found.dtype(), DType::BF16);
        close(&wide(&found), &expected, ROUNDED);

        let (gate, up) = (bf16(&[n, m], 3), bf16(&[n, m], 4));
        let (a, b) = (random(&[m], 5), random(&[m], 6));
        let with = |t: &Tensor, bias: &Tensor| wide(t).broadcast_add(bias).unwrap();
        let [there_gate, there_up, there_a, there_b] = on_device([&gate, &up, &a, &b]);
        let found = swiglu_rounded([&there_gate, &there_up], [None, None]).unwrap();
        // Composed, each step is rounded.
        close(&wide(&found), &super::swiglu(&wide(&gate), &wide(&up)).unwrap(), 4.0 * ROUNDED);
        let found = swiglu_rounded([&there_gate, &there_up], [Some(&there_a), Some(&there_b)]).unwrap();
        close(&wide(&found), &super::swiglu(&with(&gate, &a), &with(&up, &b)).unwrap(), 4.0 * ROUNDED);
        assert!(rms_norm_rounded(&there, &there, 1e-6, DType::BF16).is_err());
        assert!(swiglu_rounded([&there_gate, &there_up], [Some(&there), None]).is_err());
    }
}

const SHAPES: [Heads; 3] = [
    Heads { items: 1, key_heads: 1, group: 1, period: 1, head_dim: 2 },
    Heads { items: 4, key_heads: 2, group: 3, period: 5, head_dim: 48 },
    Heads { items: 70, key_heads: 2, group: 8, period: 1, head_dim: 128 },
];

/// Row and column, of all heads, of an element of rows of attention.
fn place(h: Heads, row: usize, column: usize) -> (usize, usize) {
    let (i, rest) = (row % h.period, row / h.period);
    let (g, item, head) = (rest % h.group, rest / h.group % h.items, rest / h.group / h.items);
    (item * h.period + i, (head * h.group + g) * h.head_dim + column)
}

#[test]
fn heads_go_first_and_come_back() {
    for h in SHAPES {
        let width = h.width();
        let x = random(&[h.items * h.period, width], 1);
        let rows = values(&x);
        let at = |row, column| rows[row * width + column];
        let [there] = on_device([&x]);
        let padded = h.period + 3;
        let found = heads_first(&there, h, 0.5, padded).unwrap();
        assert_eq!(found.dims(), [h.key_heads, h.items, h.group, padded, h.head_dim]);
        let expected = made(h.rows() / h.period * padded, h.head_dim, |row, column| {
            if row % padded >= h.period {
                return 0.0;
            }
            let (r, c) = place(h, row / padded * h.period + row % padded, column);
            at(r, c) * 0.5
        });
        close(&wide(&found).reshape(expected.dims()).unwrap(), &expected, ROUNDED);

        let turned = made(h.rows(), h.head_dim, |row, column| {
            let (r, c) = place(h, row, column);
            at(r, c)
        });
        let [turned] = on_device([&turned]);
        close(&wide(&heads_last(&turned, None, h).unwrap()), &x, 0.0);
    }
}

/// Softmax of scores.
fn softmax(scores: &[f32]) -> Vec<f32> {
    let most = scores.iter().copied().fold(f32::NEG_INFINITY, f32::max);
    let weights: Vec<f32> = scores.iter().map(|s| (s - most).exp()).collect();
    let total: f32 = weights.iter().sum();
    weights.iter().map(|w| w / total).collect()
}

#[test]
fn probabilities_are_of_what_a_row_sees() {
    for (rows, stride, columns, period) in [(6, 8, 5, 3), (30, 104, 97, 10), (4, 8, 1, 1)] {
        let scores = (random(&[rows, stride], 1) * 6.0).unwrap();
        let all = values(&scores);
        let [there] = on_device([&scores]);
        for causal in [false, true] {
            let expected: Vec<Vec<f32>> = (0..rows)
                .map(|row| {
                    let seen = if causal { columns - (period - 1 - row % period) } else { columns };
                    let mut p = softmax(&all[row * stride..][..seen]);
                    p.resize(stride, 0.0);
                    p
                })
                .collect();
            let found = probabilities(&there, columns, period, causal).unwrap();
            close(&wide(&found), &Tensor::new(expected, &Device::Cpu).unwrap(), ROUNDED);
        }
    }
}

#[test]
fn own_keys_stand_beside_shared_ones() {
    for (h, own, causal) in
        [(SHAPES[1], 6, true), (SHAPES[1], 7, false), (SHAPES[2], 1, true), (SHAPES[2], 32, true)]
    {
        let keys = OwnKeys { shared: 45, own, causal };
        let stride = (keys.shared + own).next_multiple_of(8);
        let (rows, width) = (h.rows(), h.key_heads * h.head_dim);
        let (scores, q) = (random(&[rows, stride], 1), bf16(&[rows, h.head_dim], 2));
        let (k, v, x) = (
            random(&[h.items * own, width], 3),
            random(&[h.items * own, width], 4),
            random(&[rows, h.head_dim], 5),
        );
        let (q_values, k_values) = (values(&wide(&q)), values(&k));
        let head_of = |row: usize| (row / h.period / h.group % h.items, row / h.period / h.group / h.items);
        // An element of an own key or value.
        let at = |all: &[f32], row: usize, c: usize, d: usize| {
            let (item, head) = head_of(row);
            all[(item * own + c) * width + head * h.head_dim + d]
        };
        let all = values(&scores);
        let expected: Vec<Vec<f32>> = (0..rows)
            .map(|row| {
                let seen = if causal { own - (h.period - 1 - row % h.period) } else { own };
                let dot = |c| {
                    (0..h.head_dim).map(|d| q_values[row * h.head_dim + d] * at(&k_values, row, c, d)).sum()
                };
                let shared = all[row * stride..][..keys.shared].iter().copied();
                let mut p = softmax(&shared.chain((0..seen).map(dot)).collect::<Vec<f32>>());
                p.resize(stride, 0.0);
                p
            })
            .collect();
        let expected = Tensor::new(expected, &Device::Cpu).unwrap();
        let [scores, q, there_k, there_v, there_x] = on_device([&scores, &q, &k, &v, &x]);
        let found = shared_probabilities(&scores, [&q, &there_k], keys, h).unwrap();
        close(&wide(&found), &expected, ROUNDED);

        let (p, v, x) = (values(&wide(&found)), values(&v), values(&x));
        let value = |row: usize, d: usize| {
            let added = (0..own).map(|c| p[row * stride + keys.shared + c] * at(&v, row, c, d)).sum::<f32>();
            x[row * h.head_dim + d] + added
        };
        let mut turned = vec![0f32; rows * h.head_dim];
        for row in 0..rows {
            for d in 0..h.head_dim {
                let (r, c) = place(h, row, d);
                turned[r * h.width() + c] = value(row, d);
            }
        }
        let expected = Tensor::from_vec(turned, (h.items * h.period, h.width()), &Device::Cpu).unwrap();
        let found = heads_last(&there_x, Some((&found, &there_v, keys)), h).unwrap();
        close(&wide(&found), &expected, 1e-5);
    }
}

#[test]
fn products_of_bf16_are_f32() {
    for (n, m, k, o) in [(1, 1, 1, 1), (3, 5, 16, 7), (2, 40, 130, 24)] {
        let (a, b) = (bf16(&[n, m, k], 1), bf16(&[n, k, o], 2));
        let expected = wide(&a).matmul(&wide(&b)).unwrap();
        let [there_a, there_b] = on_device([&a, &b]);
        close(&wide(&product(&there_a, &there_b, false).unwrap()), &expected, 1e-5);
        let turned = b.transpose(1, 2).unwrap().contiguous().unwrap();
        let [turned] = on_device([&turned]);
        let found = product(&there_a, &turned, true).unwrap();
        assert_eq!(found.dtype(), DType::F32);
        close(&wide(&found), &expected, 1e-5);
    }
}

#[test]
fn attention_is_rounded_where_our_kernels_are() {
    let device = crate::kernels::testing::test_device();
    assert_eq!(rounds_attention(&device), device.is_cuda());
}
