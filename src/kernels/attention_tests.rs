//! Attention against its composed form, and its gradients.

use super::attention::{AttentionLayout, Block, attention};
use super::attention_composed::composed;
use super::testing::{
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
    AttentionLayout { heads, kv_heads, head_dim, blocks }
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
    let run = |t: &[Tensor]| attention(&t[0], &t[1], &t[2], Some((&t[3], &t[4])), &l);
    let reference = |t: &[Tensor]| composed(&t[0], &t[1], &t[2], Some((&t[3], &t[4])), &l);
    let expected = gradients(&inputs, reference);
    at_every_level(|| {
        close(&run(&inputs).unwrap(), &reference(&inputs).unwrap(), 1e-5);
        for (g, e) in gradients(&inputs, run).iter().zip(&expected) {
            close(g, e, 1e-4);
        }
        // The pair as constants: the other gradients are the same.
        let constant = |t: &[Tensor]| attention(&t[0], &t[1], &t[2], Some((&inputs[3], &inputs[4])), &l);
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
