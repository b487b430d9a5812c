//! The int8 format over every kernel that this machine can run.

use super::format::WeightFormat;
use super::tests::{SHAPES, every_kernel, matrix, packed_as};
use super::weight::{MAX_INT8_INPUTS, PackedWeight};
use crate::kernels::testing::{random, same_on_any_thread_count, values};

fn packed(w: &[f32], m: usize, k: usize) -> PackedWeight {
    packed_as(WeightFormat::Int8, w, m, k)
}

/// Plain loops: quantise both sides, sum exactly.
fn expected(x: &[f32], w: &[f32], bias: &[f32], [n, k, m]: [usize; 3]) -> Vec<f32> {
    let quantised = |row: &[f32]| -> (f32, Vec<i64>) {
        let largest = row.iter().fold(0f32, |l, v| l.max(v.abs()));
        let by = if largest == 0.0 { 0.0 } else { 127.0 / largest };
        (largest / 127.0, row.iter().map(|v| (v * by).round_ties_even() as i64).collect())
    };
    let rows = |v: &[f32], count: usize| -> Vec<_> {
        (0..count).map(|i| quantised(&v[i * k..(i + 1) * k])).collect()
    };
    let (x, w) = (rows(x, n), rows(w, m));
    let mut out = Vec::new();
    for (x_scale, x) in &x {
        for ((w_scale, w), bias) in w.iter().zip(bias) {
            let sum: i64 = x.iter().zip(w).map(|(x, w)| x * w).sum();
            out.push(sum as f32 * (x_scale * w_scale) + bias);
        }
    }
    out
}

#[test]
fn products_are_exact_at_every_level() {
    for (n, k, m) in SHAPES {
        let (x, w, bias) = (random(&[n, k], 1), values(&random(&[m, k], 2)), random(&[m], 3));
        let weight = packed(&w, m, k);
        assert_eq!((weight.dims(), weight.format()), ((m, k), WeightFormat::Int8));
        let expected = expected(&values(&x), &w, &values(&bias), [n, k, m]);
        for kernel in every_kernel(WeightFormat::Int8) {
            let found = values(&weight.linear_by(&kernel, &x, Some(&bias)).unwrap());
            assert!(found == expected, "{} {n}x{k}x{m}", kernel.name);
        }
    }
}

#[test]
fn the_largest_sums_do_not_overflow() {
    let k = MAX_INT8_INPUTS;
    let weight = packed(&vec![-1.0; 2 * k], 2, k);
    for kernel in every_kernel(WeightFormat::Int8) {
        let out = weight.linear_by(&kernel, &matrix(vec![1.0; k], 1, k), None).unwrap();
        assert_eq!(values(&out), [-(k as f32); 2], "{}", kernel.name);
    }
}

#[test]
fn what_is_not_finite_spoils_its_row_only() {
    let (n, k, m) = (4, 70, 33);
    let mut x = vec![1f32; n * k];
    x[k] = f32::INFINITY;
    x[3 * k - 1] = f32::NAN;
    let weight = packed(&vec![0.5; m * k], m, k);
    for kernel in every_kernel(WeightFormat::Int8) {
        let out = weight.linear_by(&kernel, &matrix(x.clone(), n, k), None).unwrap();
        for (i, row) in out.to_vec2::<f32>().unwrap().iter().enumerate() {
            assert!(row.iter().all(|v| if i % 3 == 0 { (v - 35.0).abs() < 1e-4 } else { v.is_nan() }));
        }
    }
}

#[test]
fn rows_are_within_half_a_step() {
    let (m, k) = (40, 128);
    let w = values(&random(&[m, k], 1));
    let weight = packed(&w, m, k);
    for (row, id) in weight.rows(&[39, 0, 7]).unwrap().to_vec2::<f32>().unwrap().iter().zip([39, 0, 7]) {
        let original = &w[id * k..(id + 1) * k];
        let largest = original.iter().fold(0f32, |l, v| l.max(v.abs()));
        for (found, expected) in row.iter().zip(original) {
            assert!((found - expected).abs() <= largest / 127.0 * 0.5001);
        }
    }
    assert!(weight.bytes() < m.next_multiple_of(32) * k.next_multiple_of(4) + 8 * m + 64);
}

#[test]
fn threads_do_not_matter() {
    let x = random(&[250, 70], 1);
    let weight = packed(&values(&random(&[600, 70], 2)), 600, 70);
    same_on_any_thread_count(|| vec![weight.linear(&x, None).unwrap()]);
}

/// The figures that [`WeightFormat`] states: a row's scale follows its largest value, and the other channels pay for it.
#[test]
fn one_large_channel_costs_the_others_their_precision() {
    let (m, k) = (256, 2048);
    let (w, small) = (values(&random(&[m, k], 1)), values(&random(&[1, k], 2)));
    let weights = [WeightFormat::Bf16, WeightFormat::Int8].map(|format| packed_as(format, &w, m, k));
    let rms = |v: &[f64]| (v.iter().map(|v| v * v).sum::<f64>() / v.len() as f64).sqrt();
    for (largest, expected) in [(1.0, [0.0020, 0.0061]), (10.0, [0.0022, 0.043]), (100.0, [0.0062, 0.37])] {
        let x = [&[largest], &small[1..]].concat();
        let sum = |w: &[f32]| x.iter().zip(w).map(|(x, w)| f64::from(*x) * f64::from(*w)).sum::<f64>();
        let exact: Vec<f64> = w.chunks(k).map(sum).collect();
        let others: Vec<f64> =
            exact.iter().zip(w.chunks(k)).map(|(e, w)| e - f64::from(largest) * f64::from(w[0])).collect();
        for (weight, expected) in weights.iter().zip(expected) {
            let found = values(&weight.linear(&matrix(x.clone(), 1, k), None).unwrap());
            let errors: Vec<f64> = found.iter().zip(&exact).map(|(f, e)| f64::from(*f) - e).collect();
            // Of what the other channels add up to.
            let error = rms(&errors) / rms(&others);
            assert!(
                (error / expected - 1.0).abs() < 0.1,
                "{}, largest {largest}: {error:.4}",
                weight.format()
            );
        }
    }
}
