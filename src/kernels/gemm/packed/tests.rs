//! One suite over every kernel that this machine can run.

use super::format::WeightFormat;
use super::kernel::GemmKernel;
use super::panels::AlignedWords;
use super::product::Product;
use super::row_major::RowMajor;
use super::weight::PackedWeight;
use super::words::{bf16, halves};
use super::{amx, select};
use crate::kernels::isa::Level;
use crate::kernels::testing::{random, same_on_any_thread_count, values};
use candle_core::{DType, Device, Tensor};
use std::mem::MaybeUninit;

pub(in crate::kernels) fn every_kernel(format: WeightFormat) -> Vec<GemmKernel> {
    let levels = Level::available().into_iter().map(|level| select::kernels(level, format));
    levels
        .flat_map(|(plain, extended)| [Some(plain), extended])
        .flatten()
        .chain([amx::emulated_kernel(format)])
        .collect()
}

fn rounded(values: &[f32]) -> Vec<f32> {
    values.iter().map(|v| halves(bf16(*v))[0]).collect()
}

pub(in crate::kernels) fn matrix(values: Vec<f32>, n: usize, k: usize) -> Tensor {
    Tensor::from_vec(values, (n, k), &Device::Cpu).unwrap()
}

pub(in crate::kernels) fn packed_as(format: WeightFormat, w: &[f32], m: usize, k: usize) -> PackedWeight {
    PackedWeight::new(format, &[RowMajor::f32(w, m, k).unwrap()]).unwrap()
}

/// Inner dimensions, outputs and rows about every edge: of a word, a register, a panel, a block of steps.
pub(in crate::kernels) const SHAPES: [(usize, usize, usize); 14] = [
    (1, 1, 1),
    (0, 5, 3),
    (3, 0, 7),
    (3, 4, 0),
    (1, 7, 33),
    (2, 64, 32),
    (3, 65, 31),
    (5, 2, 64),
    (12, 31, 65),
    (13, 128, 96),
    (97, 33, 40),
    (200, 17, 300),
    (7, 2049, 35),
    (14, 4101, 70),
];

#[test]
fn bf16_products_are_those_of_f64() {
    for (n, k, m) in SHAPES {
        let (x, w, bias) = (random(&[n, k], 1), random(&[m, k], 2), random(&[m], 3));
        let (xs, ws, bs) = (rounded(&values(&x)), rounded(&values(&w)), values(&bias));
        let packed = packed_as(WeightFormat::Bf16, &values(&w), m, k);
        assert_eq!((packed.dims(), packed.format()), ((m, k), WeightFormat::Bf16));
        for kernel in every_kernel(WeightFormat::Bf16) {
            let plain = values(&packed.linear_by(&kernel, &x, None).unwrap());
            let found = values(&packed.linear_by(&kernel, &x, Some(&bias)).unwrap());
            assert_eq!(found.len(), n * m);
            for (i, found) in found.iter().enumerate() {
                let (row, column) = (i / m, i % m);
                let terms = (0..k).map(|p| xs[row * k + p] as f64 * ws[column * k + p] as f64);
                let (sum, size) = terms.fold((0.0, 0.0), |(s, a), t| (s + t, a + t.abs()));
                // Rounding of a running sum of k terms, with room: far less than one wrong term.
                let tolerance = 2e-7 * (1.0 + size) * (1.0 + (k as f64).sqrt() / 8.0);
                let expected = sum + bs[column] as f64;
                let name = kernel.name;
                assert!((*found as f64 - expected).abs() < tolerance, "{name} {n}x{k}x{m} at {row},{column}");
                assert!((plain[i] as f64 - sum).abs() < tolerance, "{name} {n}x{k}x{m} at {row},{column}");
            }
        }
    }
}

#[test]
fn a_row_does_not_depend_on_the_others() {
    let (n, k, m) = (29, 2100, 70);
    let x = random(&[n, k], 1);
    let packed = packed_as(WeightFormat::Bf16, &values(&random(&[m, k], 2)), m, k);
    for kernel in every_kernel(WeightFormat::Bf16) {
        let all = packed.linear_by(&kernel, &x, None).unwrap();
        for (from, count) in [(0, 1), (28, 1), (3, 2), (5, 4), (7, 13)] {
            let some = packed.linear_by(&kernel, &x.narrow(0, from, count).unwrap(), None).unwrap();
            assert_eq!(values(&some), values(&all.narrow(0, from, count).unwrap()), "{}", kernel.name);
        }
    }
}

#[test]
fn not_a_number_and_infinities_reach_their_row_only() {
    let (n, k, m) = (5, 9, 34);
    let mut x = vec![1f32; n * k];
    x[k + 8] = f32::NAN;
    x[2 * k] = f32::INFINITY;
    x[3 * k + 1] = f32::NEG_INFINITY;
    let packed = packed_as(WeightFormat::Bf16, &vec![0.5; m * k], m, k);
    for kernel in every_kernel(WeightFormat::Bf16) {
        let out = packed.linear_by(&kernel, &matrix(x.clone(), n, k), None).unwrap();
        let expected = [4.5, f32::NAN, f32::INFINITY, f32::NEG_INFINITY, 4.5];
        for (row, expected) in out.to_vec2::<f32>().unwrap().iter().zip(expected) {
            assert!(row.iter().all(|v| *v == expected || v.is_nan() && expected.is_nan()), "{row:?}");
        }
    }
}

#[test]
fn every_element_is_written() {
    for (n, k, m) in SHAPES {
        let (x, w) = (values(&random(&[n, k], 1)), values(&random(&[m, k], 2)));
        let packed = packed_as(WeightFormat::Bf16, &w, m, k);
        for kernel in every_kernel(WeightFormat::Bf16) {
            let left = kernel.convert(&x, n, k);
            let mut out = vec![MaybeUninit::new(f32::NAN); n * m];
            let product = Product { left: &left, panels: &packed.panels, m, finish: packed.finish(None) };
            kernel.multiply(&product, &mut [&mut out]);
            // SAFETY: every element was initialised above.
            let written = out.iter().all(|v| unsafe { v.assume_init() }.is_finite());
            assert!(written, "{} {n}x{k}x{m}", kernel.name);
        }
    }
}

#[test]
fn parts_and_sums_are_those_of_the_outputs() {
    // The last has more rows than are converted at once.
    for (n, k, m) in SHAPES.into_iter().chain([(400, 33_000, 3)]) {
        let (x, w) = (random(&[n, k], 1), values(&random(&[m, k], 2)));
        let (bias, residual) = (random(&[m], 3), random(&[n, m], 4));
        for format in [WeightFormat::Bf16, WeightFormat::Int8] {
            let packed = packed_as(format, &w, m, k);
            let every = every_kernel(format);
            // The last two are the fastest and the emulated one.
            for kernel in if n > 300 { &every[every.len() - 2..every.len() - 1] } else { &every[..] } {
                assert_eq!(n > 300, n > kernel.form.chunk_rows(k));
                let case = format!("{} {format} {n}x{k}x{m}", kernel.name);
                let all = packed.linear_by(kernel, &x, Some(&bias)).unwrap();
                let sum = packed.multiply(kernel, &x, Some(&bias), Some(&residual), &[m]).unwrap();
                assert_eq!(values(&sum[0]), values(&(&residual + &all).unwrap()), "{case}");
                // One part within a panel, one over its edge, the last left out.
                let widths = [m / 5, m - m / 5 - m / 7];
                let parts = packed.multiply(kernel, &x, Some(&bias), None, &widths).unwrap();
                let first = all.narrow(1, 0, m - m / 7).unwrap();
                assert_eq!(values(&Tensor::cat(&parts, 1).unwrap()), values(&first), "{case}");
            }
        }
    }
}

#[test]
fn what_an_earlier_product_left_is_not_multiplied() {
    for k in [1, 3, 7, 31] {
        let packed = packed_as(WeightFormat::Bf16, &vec![1.0; 2 * k], 2, k);
        for kernel in every_kernel(WeightFormat::Bf16) {
            let mut earlier = AlignedWords::recycled(1 << 14);
            earlier.get_mut().fill(u32::MAX); // NaN
            earlier.recycle();
            let out = packed.linear_by(&kernel, &matrix(vec![1.0; 3 * k], 3, k), None).unwrap();
            assert_eq!(values(&out), vec![k as f32; 6], "{} {k}", kernel.name);
        }
    }
}

#[test]
fn threads_do_not_matter() {
    let x = random(&[250, 70], 1);
    let packed = packed_as(WeightFormat::Bf16, &values(&random(&[600, 70], 2)), 600, 70);
    same_on_any_thread_count(|| vec![packed.linear(&x, None).unwrap()]);
}

#[test]
fn rows_come_back_as_they_went_in() {
    for (m, k) in [(1, 1), (33, 7), (70, 300)] {
        let weight = rounded(&values(&random(&[m, k], 4)));
        let bytes: Vec<u8> = weight.iter().flat_map(|v| half::bf16::from_f32(*v).to_le_bytes()).collect();
        // An odd address, as a memory map may give.
        let moved = [vec![0], bytes].concat();
        let stored = RowMajor::bf16(&moved[1..], m, k).unwrap();
        let packed = PackedWeight::new(WeightFormat::Bf16, &[stored]).unwrap();
        let ids: Vec<u32> = (0..m as u32).rev().chain([0]).collect();
        let rows = packed.rows(&ids).unwrap();
        assert_eq!(rows.dims(), [m + 1, k]);
        for (row, id) in rows.to_vec2::<f32>().unwrap().iter().zip(ids) {
            assert_eq!(row[..], weight[id as usize * k..(id as usize + 1) * k]);
        }
        assert!(packed.bytes() >= 2 * m * k);
        assert!(packed.rows(&[m as u32]).is_err());
    }
    let empty = packed_as(WeightFormat::Bf16, &[], 3, 0);
    assert_eq!(empty.rows(&[2, 1]).unwrap().dims(), [2, 0]);
}

#[test]
fn what_does_not_fit_is_an_error() {
    let packed = packed_as(WeightFormat::Bf16, &[0.0; 6], 2, 3);
    assert!(packed.linear(&random(&[2, 2], 1), None).is_err());
    assert!(packed.linear(&random(&[2, 3, 1], 1), None).is_err());
    assert!(packed.linear_onto(&random(&[2, 3], 1), None, &random(&[2, 3], 1)).is_err());
    assert!(packed.linear_parts(&random(&[2, 3], 1), None, &[1, 2]).is_err());
    assert!(packed.linear_parts(&random(&[2, 3], 1), None, &[usize::MAX, 2]).is_err());
    assert!(packed.linear(&random(&[2, 3], 1), Some(&random(&[3], 1))).is_err());
    assert!(packed.linear(&random(&[2, 3], 1).to_dtype(DType::F64).unwrap(), None).is_err());
}
