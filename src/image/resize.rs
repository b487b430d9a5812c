//! The u8 bicubic resize that the published image processors use, exact to the bit.
//!
//! The algorithm is Pillow's (versions before 13): antialiased bicubic, a = -0.5, weights in 22-bit fixed point, the
//! horizontal pass first and rounded to u8 before the vertical one.

use image::RgbImage;
use rayon::prelude::*;

const BITS: u32 = 22;

/// Source pixels and fixed-point weights of one output pixel.
struct Tap {
    first: usize,
    weights: Vec<i32>,
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

fn taps(input: usize, output: usize) -> Vec<Tap> {
    let scale = input as f64 / output as f64;
    let widen = scale.max(1.0);
    let support = 2.0 * widen;
    (0..output)
        .map(|i| {
            let centre = (i as f64 + 0.5) * scale;
            let first = (centre - support + 0.5).max(0.0) as usize;
            let end = ((centre + support + 0.5) as usize).min(input);
            let inverse = 1.0 / widen;
            let raw: Vec<f64> = (first..end).map(|j| cubic((j as f64 - centre + 0.5) * inverse)).collect();
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

/// Resizes to `width` x `height`; an axis that keeps its size is left alone.
pub fn bicubic(image: &RgbImage, width: usize, height: usize) -> RgbImage {
    let (w0, h0) = (image.width() as usize, image.height() as usize);
    let mut data = image.as_raw().clone();
    if width != w0 {
        let taps = taps(w0, width);
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
        let taps = taps(h0, height);
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
