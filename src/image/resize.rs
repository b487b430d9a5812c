//! Pillow's resizes of u8 pictures, exact to the bit: bicubic as the published image processors use it, Lanczos as preparations of
//! data sets do.
//!
//! The algorithm is that of versions before 13: the filter is widened by the factor of a reduction (antialiasing), weights are
//! 22-bit fixed point, and the horizontal pass comes first and is rounded to u8 before the vertical one.

use image::RgbImage;
use rayon::prelude::*;

const BITS: u32 = 22;

/// Source pixels and fixed-point weights of one output pixel.
struct Tap {
    first: usize,
    weights: Vec<i32>,
}

/// A filter's weight at a distance in pixels, and the distance beyond which it is 0.
#[derive(Clone, Copy)]
struct Filter {
    reach: f64,
    weight: fn(f64) -> f64,
}

const CUBIC: Filter = Filter { reach: 2.0, weight: cubic };
const LANCZOS: Filter = Filter { reach: 3.0, weight: windowed_sinc };

/// sinc(x) under the window sinc(x / 3).
fn windowed_sinc(x: f64) -> f64 {
    if (-LANCZOS.reach..LANCZOS.reach).contains(&x) { sinc(x) * sinc(x / LANCZOS.reach) } else { 0.0 }
}

fn sinc(x: f64) -> f64 {
    let x = x * std::f64::consts::PI;
    if x == 0.0 { 1.0 } else { x.sin() / x }
}

fn cubic(x: f64) -> f64 {
    const A: f64 = -0.5;
    let x = x.abs();
    if x < 1.0 {
        ((A + 2.0) * x - (A + 3.0)) * x * x + 1.0
    } else if x < 2.0 {
        (((x - 5.0) * x + 8.0) * x - 4.0) * A
    } else {
        0.0
    }
}

fn taps(input: usize, output: usize, filter: Filter) -> Vec<Tap> {
    let scale = input as f64 / output as f64;
    let widen = scale.max(1.0);
    let support = filter.reach * widen;
    (0..output)
        .map(|i| {
            let centre = (i as f64 + 0.5) * scale;
            let first = (centre - support + 0.5).max(0.0) as usize;
            let end = ((centre + support + 0.5) as usize).min(input);
            let inverse = 1.0 / widen;
            let weight = |j: usize| (filter.weight)((j as f64 - centre + 0.5) * inverse);
            let raw: Vec<f64> = (first..end).map(weight).collect();
            let sum: f64 = raw.iter().sum();
            let fixed = |w: f64| {
                let scaled = w / sum * f64::from(1u32 << BITS);
                (scaled + 0.5f64.copysign(scaled)) as i32
            };
            Tap { first, weights: raw.into_iter().map(fixed).collect() }
        })
        .collect()
}

fn round(sum: i64) -> u8 {
    ((sum + (1 << (BITS - 1))) >> BITS).clamp(0, 255) as u8
}

/// Resizes to `width` x `height` by cubic convolution, a = -0.5; an axis that keeps its size is left alone.
pub fn bicubic(image: &RgbImage, width: usize, height: usize) -> RgbImage {
    resize(image, width, height, CUBIC)
}

/// Resizes to `width` x `height` by Lanczos' filter, a = 3; an axis that keeps its size is left alone.
pub fn lanczos(image: &RgbImage, width: usize, height: usize) -> RgbImage {
    resize(image, width, height, LANCZOS)
}

fn resize(image: &RgbImage, width: usize, height: usize, filter: Filter) -> RgbImage {
    let (w0, h0) = (image.width() as usize, image.height() as usize);
    let mut data = image.as_raw().clone();
    if width != w0 {
        let taps = taps(w0, width, filter);
        let mut out = vec![0u8; h0 * width * 3];
        out.par_chunks_mut(width * 3).zip(data.par_chunks(w0 * 3)).for_each(|(dst, src)| {
            for (pixel, tap) in dst.chunks_exact_mut(3).zip(&taps) {
                let mut sum = [0i64; 3];
                for (j, &w) in tap.weights.iter().enumerate() {
                    for (c, s) in sum.iter_mut().enumerate() {
                        *s += i64::from(w) * i64::from(src[(tap.first + j) * 3 + c]);
                    }
                }
                pixel.copy_from_slice(&sum.map(round));
            }
        });
        data = out;
    }
    if height != h0 {
        let taps = taps(h0, height, filter);
        let row = width * 3;
        let mut out = vec![0u8; height * row];
        out.par_chunks_mut(row).zip(&taps).for_each(|(dst, tap)| {
            let mut sum = vec![0i64; row];
            for (j, &w) in tap.weights.iter().enumerate() {
                let src = &data[(tap.first + j) * row..][..row];
                for (s, &p) in sum.iter_mut().zip(src) {
                    *s += i64::from(w) * i64::from(p);
                }
            }
            for (d, s) in dst.iter_mut().zip(sum) {
                *d = round(s);
            }
        });
        data = out;
    }
    // The buffer has exactly width * height * 3 bytes by construction.
    RgbImage::from_raw(width as u32, height as u32, data).unwrap_or_default()
}
