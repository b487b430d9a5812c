//! Attention against its composed form, and its gradients.

use super::bf16::{AttentionKernel, bf16_attention};
use super::composed::composed;
use super::{AttentionLayout, Block, Precision, SharedKeys, attention};
use crate::kernels::testing::{
    at_every_level, check_gradients, close, gradients, random, same_on_any_thread_count, values,
};
use candle_core::Tensor;
use std::ops::Range;

fn block(
    queries: Range<usize>,
    shared: Range<usize>,
    own_start: usize,
    q_period: usize,
    k_period: usize,
    causal: bool,
) -> Block {
    Block { queries, shared, own_start, q_period, k_period, causal }
}

fn layout(heads: usize, kv_heads: usize, head_dim: usize, blocks: Vec<Block>) -> AttentionLayout {
    AttentionLayout { heads, kv_heads, head_dim, blocks, precision: Precision::F32 }
}

/// q, k, v with scores that matter.
fn qkv(nq: usize, nk: usize, l: &AttentionLayout) -> [Tensor; 3] {
    let width = l.kv_heads * l.head_dim;
    let q = random(&[nq, l.heads * l.head_dim], 1).affine(2.0, 0.0).unwrap();
    [q, random(&[nk, width], 2), random(&[nk, width], 3)]
}

/// Number of query rows, of key rows, layout.
fn cases() -> Vec<(usize, usize, AttentionLayout)> {
    vec![
        // One row, one key.
        (1, 1, layout(1, 1, 3, vec![block(0..1, 0..0, 0, 1, 1, true)])),
        // A causal prefill with tails everywhere, grouped heads.
        (53, 53, layout(6, 3, 20, vec![block(0..53, 0..0, 0, 53, 53, true)])),
        // Two full windows.
        (
            77,
            77,
            layout(
                2,
                2,
                32,
                vec![block(0..40, 0..0, 0, 40, 40, false), block(40..77, 0..0, 40, 37, 37, false)],
            ),
        ),
        // Two groups of a prefix and suffixes of 3 rows, out of order, with rows of no block between.
        (
            100,
            100,
            layout(
                4,
                2,
                8,
                vec![
                    block(70..91, 50..70, 70, 3, 3, true),
                    block(0..20, 0..0, 0, 20, 20, true),
                    block(20..41, 0..20, 20, 3, 3, true),
                    block(50..70, 0..0, 50, 20, 20, true),
                ],
            ),
        ),
        // Long suffixes: own keys by matrix product too; more keys than queries in an item.
        (60, 110, layout(2, 1, 16, vec![block(0..60, 0..30, 30, 20, 25, true)])),
        // A decode step over its own keys.
        (1, 90, layout(4, 1, 12, vec![block(0..1, 0..0, 0, 1, 90, true)])),
        // Shared keys only, non-causal.
        (30, 45, layout(2, 1, 40, vec![block(0..30, 0..45, 0, 1, 0, false)])),
    ]
}

#[test]
fn forward_and_gradients_are_the_composed_ones() {
    for (nq, nk, l) in cases() {
        let t = qkv(nq, nk, &l);
        let expected = composed(&t[0], &t[1], &t[2], None, &l).unwrap();
        let expected_grads = gradients(&t, |t| composed(&t[0], &t[1], &t[2], None, &l));
        at_every_level(|| {
            close(&attention(&t[0], &t[1], &t[2], None, &l).unwrap(), &expected, 1e-5);
            let grads = gradients(&t, |t| attention(&t[0], &t[1], &t[2], None, &l));
            for (g, e) in grads.iter().zip(&expected_grads) {
                close(g, e, 1e-4);
            }
        });
    }
}

#[test]
fn gradients_hold() {
    let l = layout(2, 1, 3, vec![block(0..4, 0..0, 0, 4, 4, true), block(4..8, 0..4, 4, 2, 2, true)]);
    at_every_level(|| check_gradients(&qkv(8, 8, &l), |t| attention(&t[0], &t[1], &t[2], None, &l)));
}

#[test]
fn the_definition_by_hand() {
    // Two suffix rows of one item after a shared key; scores 0, so that each is a mean of values.
    let l = layout(1, 1, 1, vec![block(0..2, 0..1, 1, 2, 2, true)]);
    let device = &candle_core::Device::Cpu;
    let q = Tensor::new(&[[0f32], [0.]], device).unwrap();
    let k = Tensor::new(&[[1f32], [2.], [3.]], device).unwrap();
    let v = Tensor::new(&[[2f32], [4.], [9.]], device).unwrap();
    at_every_level(|| assert_eq!(values(&attention(&q, &k, &v, None, &l).unwrap()), [3.0, 5.0]));
    close(&composed(&q, &k, &v, None, &l).unwrap(), &Tensor::new(&[[3f32], [5.]], device).unwrap(), 1e-6);
}

#[test]
fn an_extra_pair_is_seen_and_has_gradients() {
    let l = layout(4, 2, 8, vec![block(0..50, 0..21, 0, 2, 2, true), block(50..90, 5..21, 50, 40, 40, true)]);
    let [q, k, v] = qkv(90, 90, &l);
    let inputs = [q, k, v, random(&[21, 16], 7), random(&[21, 16], 8)];
    let pair = |t: &[Tensor]| SharedKeys::new(t[0].clone(), t[1].clone());
    let run = |t: &[Tensor]| attention(&t[0], &t[1], &t[2], Some(&pair(&t[3..])), &l);
    let reference = |t: &[Tensor]| composed(&t[0], &t[1], &t[2], Some((&t[3], &t[4])), &l);
    let expected = gradients(&inputs, reference);
    at_every_level(|| {
        close(&run(&inputs).unwrap(), &reference(&inputs).unwrap(), 1e-5);
        for (g, e) in gradients(&inputs, run).iter().zip(&expected) {
            close(g, e, 1e-4);
        }
        // The pair as constants: the other gradients are the same.
        let shared = pair(&inputs[3..]);
        let constant = |t: &[Tensor]| attention(&t[0], &t[1], &t[2], Some(&shared), &l);
        for (g, e) in gradients(&inputs[..3], constant).iter().zip(&expected) {
            close(g, e, 1e-4);
        }
    });
}

#[test]
fn large_scores_do_not_overflow() {
    let l = layout(1, 1, 32, vec![block(0..20, 0..0, 0, 20, 20, true)]);
    let [q, k, v] = qkv(20, 20, &l);
    let q = q.affine(1e4, 0.0).unwrap();
    at_every_level(|| {
        let out = attention(&q, &k, &v, None, &l).unwrap();
        assert!(values(&out).iter().all(|x| x.abs() <= 1.0));
    });
}

#[test]
fn threads_do_not_matter() {
    let (nq, nk, l) = cases().swap_remove(3);
    let t = qkv(nq, nk, &l);
    same_on_any_thread_count(|| {
        let mut all = gradients(&t, |t| attention(&t[0], &t[1], &t[2], None, &l));
        all.push(attention(&t[0], &t[1], &t[2], None, &l).unwrap());
        all
    });
}

/// In f64: the weight of every key, one row and head after the other.
fn plainly([q, k, v]: &[Tensor; 3], shared: Option<(&Tensor, &Tensor)>, l: &AttentionLayout) -> Vec<f64> {
    let (heads, hd) = (l.heads, l.head_dim);
    let rows = |t: &Tensor| t.to_vec2::<f32>().unwrap();
    let (q, k, v) = (rows(q), rows(k), rows(v));
    let (sk, sv) = shared.map_or((k.clone(), v.clone()), |(sk, sv)| (rows(sk), rows(sv)));
    let mut out = vec![0f64; q.len() * heads * hd];
    for b in &l.blocks {
        for (i, row) in b.queries.clone().enumerate() {
            let own = b.own_start + i / b.q_period * b.k_period;
            let mut keys: Vec<(&[f32], &[f32])> =
                b.shared.clone().map(|r| (&sk[r][..], &sv[r][..])).collect();
            keys.extend((own..own + b.seen(i % b.q_period)).map(|r| (&k[r][..], &v[r][..])));
            for h in 0..heads {
                let (from, to) = (h / (heads / l.kv_heads) * hd, (row * heads + h) * hd);
                let dot = |key: &[f32]| -> f64 {
                    let pairs = q[row][h * hd..(h + 1) * hd].iter().zip(&key[from..from + hd]);
                    pairs.map(|(a, b)| f64::from(*a) * f64::from(*b)).sum::<f64>() / (hd as f64).sqrt()
                };
                let weights: Vec<f64> = keys.iter().map(|(key, _)| dot(key).exp()).collect();
                let total: f64 = weights.iter().sum();
                for (w, (_, value)) in weights.iter().zip(&keys) {
                    for c in 0..hd {
                        out[to + c] += w / total * f64::from(value[from + c]);
                    }
                }
            }
        }
    }
    out
}

/// Keys in a part that fill panels and that do not, heads that do and do not, shared and own keys in all forms.
fn bf16_cases() -> Vec<(usize, usize, AttentionLayout)> {
    let mut cases = cases();
    cases.extend([
        (300, 1000, layout(4, 2, 48, vec![block(0..300, 0..700, 700, 1, 1, true)])),
        (64, 64, layout(3, 3, 80, vec![block(0..64, 0..0, 0, 64, 64, false)])),
        (70, 166, layout(16, 2, 128, vec![block(0..70, 0..96, 96, 35, 35, true)])),
        (
            40,
            40,
            layout(2, 2, 32, (0..10).map(|i| block(4 * i..4 * i + 4, 0..0, 4 * i, 4, 4, false)).collect()),
        ),
        (33, 97, layout(3, 1, 7, vec![block(0..33, 0..31, 31, 3, 6, true)])),
    ]);
    cases
}

#[test]
fn in_bf16_it_is_the_same_to_three_digits() {
    for (nq, nk, l) in bf16_cases() {
        let t = qkv(nq, nk, &l);
        let exact = plainly(&t, None, &l);
        for kernel in AttentionKernel::every() {
            let found = values(&bf16_attention(&kernel, [&t[0], &t[1], &t[2]], None, &l).unwrap());
            assert_eq!(found.len(), exact.len());
            for (i, (f, e)) in found.iter().zip(&exact).enumerate() {
                // Values below 1, of which each and its weight are rounded to 8 bits, and so are the scores' operands.
                assert!(
                    (f64::from(*f) - e).abs() <= 8e-3,
                    "{nq} rows, {nk} keys, element {i}: {f}, expected {e}"
                );
            }
        }
    }
}

#[test]
fn in_bf16_the_extra_pair_is_seen() {
    let l = layout(4, 2, 8, vec![block(0..50, 0..21, 0, 2, 2, true), block(50..90, 5..21, 50, 40, 40, true)]);
    let t = qkv(90, 90, &l);
    let shared = SharedKeys::new(random(&[21, 16], 7), random(&[21, 16], 8));
    let exact = plainly(&t, Some((shared.keys(), shared.values())), &l);
    // The second layout has other heads of the same width: what is packed for the first must not be taken for it.
    let mut other = l.clone();
    (other.heads, other.kv_heads, other.head_dim) = (8, 4, 4);
    let exact_other = plainly(&t, Some((shared.keys(), shared.values())), &other);
    for kernel in AttentionKernel::every() {
        for (l, exact) in [(&l, &exact), (&other, &exact_other), (&l, &exact)] {
            let found = bf16_attention(&kernel, [&t[0], &t[1], &t[2]], Some(&shared), l).unwrap();
            for (f, e) in values(&found).iter().zip(exact) {
                assert!((f64::from(*f) - e).abs() <= 8e-3, "{f}, expected {e}");
            }
        }
        let mut packed = 0;
        shared.packed(2, || {
            packed += 1;
            Vec::new()
        });
        assert_eq!(packed, 0, "kept from the first call on");
    }
}

#[test]
fn in_bf16_a_row_depends_on_itself_only() {
    // All rows at once, and each batch of some alone: the same bits. So it is on any number of threads.
    let whole = layout(4, 2, 48, vec![block(0..200, 0..70, 70, 1, 1, true)]);
    let [q, k, v] = qkv(200, 270, &whole);
    for kernel in AttentionKernel::every() {
        let run = |t: [&Tensor; 3], l: &AttentionLayout| bf16_attention(&kernel, t, None, l).unwrap();
        let all = run([&q, &k, &v], &whole);
        for (from, n) in [(0, 1), (7, 5), (90, 110)] {
            let mut part = whole.clone();
            part.blocks = vec![block(0..n, 0..70, 70 + from, 1, 1, true)];
            let some = run([&q.narrow(0, from, n).unwrap(), &k, &v], &part);
            assert_eq!(values(&some), values(&all.narrow(0, from, n).unwrap()));
        }
        same_on_any_thread_count(|| vec![run([&q, &k, &v], &whole)]);
    }
}

#[test]
fn in_bf16_not_a_number_is_seen_where_it_counts() {
    let l = layout(2, 1, 20, vec![block(0..30, 0..40, 40, 1, 1, true)]);
    let t = qkv(30, 70, &l);
    let poisoned = |which: usize, row: usize| {
        let mut data = values(&t[which]);
        let width = data.len() / t[which].dim(0).unwrap();
        data[row * width + 3] = f32::NAN;
        let bad = Tensor::from_vec(data, t[which].dims(), &candle_core::Device::Cpu).unwrap();
        let mut t = t.clone();
        t[which] = bad;
        t
    };
    for kernel in AttentionKernel::every() {
        let nan = |t: [Tensor; 3], l: &AttentionLayout| -> Vec<bool> {
            let out = values(&bf16_attention(&kernel, [&t[0], &t[1], &t[2]], None, l).unwrap());
            out.chunks(20).map(|head| head.iter().any(|x| x.is_nan())).collect()
        };
        assert!(nan(t.clone(), &l).iter().all(|nan| !nan));
        // A query's: its own row, in the head where it stands. A shared key's or value's: all rows. An own one's: its row.
        let only = |row: usize| -> Vec<bool> { (0..60).map(|at| at / 2 == row).collect() };
        assert_eq!(nan(poisoned(0, 5), &l), (0..60).map(|at| at == 10).collect::<Vec<_>>());
        assert_eq!([nan(poisoned(1, 39), &l), nan(poisoned(2, 39), &l)], [vec![true; 60], vec![true; 60]]);
        assert_eq!([nan(poisoned(1, 47), &l), nan(poisoned(2, 47), &l)], [only(7), only(7)]);
    }
}

#[test]
fn only_inference_is_rounded() {
    let mut l = layout(4, 2, 48, vec![block(0..30, 0..70, 70, 1, 1, true)]);
    let t = qkv(30, 100, &l);
    let exact = attention(&t[0], &t[1], &t[2], None, &l).unwrap();
    let exact_grads = gradients(&t, |t| attention(&t[0], &t[1], &t[2], None, &l));
    l.precision = Precision::Bf16;
    let rounded = attention(&t[0], &t[1], &t[2], None, &l).unwrap();
    assert_eq!(values(&rounded) == values(&exact), AttentionKernel::current().is_none());
    let grads = gradients(&t, |t| attention(&t[0], &t[1], &t[2], None, &l));
    for (g, e) in grads.iter().zip(&exact_grads) {
        close(g, e, 0.0);
    }
}

#[test]
fn layouts_that_do_not_fit_are_errors() {
    let wrong = |blocks: Vec<Block>| {
        let l = layout(2, 1, 4, blocks);
        let t = qkv(10, 10, &l);
        assert!(attention(&t[0], &t[1], &t[2], None, &l).is_err());
    };
    wrong(vec![block(0..10, 0..0, 1, 10, 10, true)]);
    wrong(vec![block(0..10, 0..11, 0, 10, 10, true)]);
    wrong(vec![block(0..11, 0..1, 0, 11, 0, false)]);
    wrong(vec![block(0..10, 0..0, 0, 3, 3, true)]);
    wrong(vec![block(0..10, 0..0, 0, 10, 5, true)]);
    wrong(vec![block(0..10, 0..0, 0, 1, 0, false)]);
    wrong(vec![block(0..10, 0..0, 0, 0, 1, false)]);
    wrong(vec![block(0..10, 0..0, usize::MAX, 10, 10, true)]);
    wrong(vec![block(0..6, 0..3, 0, 1, 1, true), block(5..10, 0..3, 0, 1, 1, true)]);
    let l = layout(2, 1, 4, vec![]);
    let t = qkv(10, 10, &l);
    assert!(attention(&t[1], &t[1], &t[2], None, &l).is_err());
    assert_eq!(values(&attention(&t[0], &t[1], &t[2], None, &l).unwrap()), vec![0.0; 80]);
}
