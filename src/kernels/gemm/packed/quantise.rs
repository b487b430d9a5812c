//! Rounding rows of f32 to bytes, symmetric: `value = scale * byte`, byte in -127 ..= 127.

#[cfg(target_arch = "x86_64")]
use crate::kernels::isa::Avx512;
use crate::kernels::isa::Isa;

/// Rows whose largest magnitude is below count as zeros, so that no scale is subnormal.
const MIN_MAGNITUDE: f32 = 1e-35;
/// 1.5 * 2^23: a small value added to it is rounded to an integer, ties to even, in the low bits.
const ROUNDING: f32 = 12_582_912.0;
/// The largest byte.
const MAX_BYTE: f32 = 127.0;
/// What stands for zero in an unsigned byte.
pub(super) const ZERO_POINT: i32 = 128;

/// The scale of a row and what to multiply its values by; NaN if a value is not finite, zeros for a row of zeros.
#[inline(always)]
pub(super) fn scale(values: &[f32]) -> (f32, f32) {
    // Magnitudes order as their bits do, with infinity and NaN above all.
    let mut largest = [0u32; 16];
    let (chunks, rest) = values.as_chunks::<16>();
    for chunk in chunks {
        for (l, v) in largest.iter_mut().zip(chunk) {
            *l = (*l).max(v.to_bits() & 0x7fff_ffff);
        }
    }
    let bits = rest.iter().map(|v| v.to_bits() & 0x7fff_ffff).chain(largest).max().unwrap_or(0);
    scale_of(f32::from_bits(bits))
}

/// [`scale`] by the largest magnitude.
#[inline(always)]
fn scale_of(largest: f32) -> (f32, f32) {
    if !largest.is_finite() {
        return (f32::NAN, 0.0);
    }
    if largest < MIN_MAGNITUDE { (0.0, 0.0) } else { (largest / MAX_BYTE, MAX_BYTE / largest) }
}

/// `value * by` to the nearest integer.
#[inline(always)]
fn nearest(value: f32, by: f32) -> i32 {
    // What is not finite gives some integer: its row's scale is NaN.
    (value * by + ROUNDING).to_bits().wrapping_sub(ROUNDING.to_bits()) as i32
}

/// A row of a weight as words of four signed bytes. Returns its scale and the sum of its bytes.
pub(super) fn weight_row(values: &[f32], words: &mut [u32]) -> (f32, i32) {
    let (scale, by) = scale(values);
    if scale.is_nan() {
        words.fill(0);
        return (scale, 0);
    }
    let mut sum = 0;
    for (word, values) in words.iter_mut().zip(values.chunks(4)) {
        let mut bytes = [0u8; 4];
        for (byte, value) in bytes.iter_mut().zip(values) {
            let integer = nearest(*value, by);
            sum += integer;
            *byte = integer as u8;
        }
        *word = u32::from_le_bytes(bytes);
    }
    (scale, sum)
}

/// The four signed bytes of a word.
pub(super) fn bytes(word: u32) -> [f32; 4] {
    word.to_le_bytes().map(|byte| f32::from(byte as i8))
}

/// A row of activations as words of four unsigned bytes, and its scale.
#[cfg(any(test, target_arch = "x86_64"))]
#[inline(always)]
pub(super) fn unsigned_bytes<S: Isa>(_: S, words: &mut [u32], values: &[f32]) -> f32 {
    let (scale, by) = scale(values);
    bytes_by(words, values, |value| unsigned(value, by));
    scale
}

/// The same with signed bytes.
#[cfg(any(test, target_arch = "aarch64"))]
#[inline(always)]
pub(super) fn signed_bytes<S: Isa>(_: S, words: &mut [u32], values: &[f32]) -> f32 {
    let (scale, by) = scale(values);
    bytes_by(words, values, |value| nearest(value, by) as u8);
    scale
}

/// Words of the bytes that `to_byte` gives.
#[inline(always)]
fn bytes_by(words: &mut [u32], values: &[f32], to_byte: impl Fn(f32) -> u8) {
    // By way of arrays of bytes, which the compiler narrows whole registers to.
    for (words, values) in words.chunks_mut(16).zip(values.chunks(64)) {
        let mut bytes = [0u8; 64];
        if let Ok(values) = <&[f32; 64]>::try_from(values) {
            for (byte, value) in bytes.iter_mut().zip(values) {
                *byte = to_byte(*value);
            }
        } else {
            for (byte, value) in bytes.iter_mut().zip(values) {
                *byte = to_byte(*value);
            }
        }
        for (word, bytes) in words.iter_mut().zip(bytes.as_chunks::<4>().0) {
            *word = u32::from_le_bytes(*bytes);
        }
    }
}

/// [`unsigned_bytes`] by AVX-512, the same bytes: its conversion to integers rounds to nearest even too.
#[cfg(target_arch = "x86_64")]
#[inline(always)]
pub(super) fn unsigned_bytes_avx512<S: Into<Avx512>>(_: S, words: &mut [u32], values: &[f32]) -> f32 {
    use std::arch::x86_64::*;
    let (whole, rest) = values.as_chunks::<64>();
    let (first, last) = words.split_at_mut(whole.len() * 16);
    // SAFETY: the token proves that the CPU has the instructions; 64 values become 16 words, and fewer are read under a mask.
    unsafe {
        let magnitude = |from: *const f32, mask: __mmask16| {
            let bits = _mm512_maskz_loadu_epi32(mask, from.cast());
            _mm512_and_si512(bits, _mm512_set1_epi32(0x7fff_ffff))
        };
        let mut largest = [_mm512_setzero_si512(); 4];
        for values in whole {
            for (i, largest) in largest.iter_mut().enumerate() {
                *largest = _mm512_max_epu32(*largest, magnitude(values.as_ptr().add(16 * i), !0));
            }
        }
        for values in rest.chunks(16) {
            let mask = (1u32 << values.len()).wrapping_sub(1) as __mmask16;
            largest[0] = _mm512_max_epu32(largest[0], magnitude(values.as_ptr(), mask));
        }
        let [a, b, c, d] = largest;
        let largest = _mm512_max_epu32(_mm512_max_epu32(a, b), _mm512_max_epu32(c, d));
        let (scale, by) = scale_of(f32::from_bits(_mm512_reduce_max_epu32(largest)));
        let (factor, zero) = (_mm512_set1_ps(by), _mm_set1_epi8(ZERO_POINT as u8 as i8));
        for (words, values) in first.as_chunks_mut::<16>().0.iter_mut().zip(whole) {
            for i in 0..4 {
                let values = _mm512_mul_ps(_mm512_loadu_ps(values.as_ptr().add(16 * i)), factor);
                // 128 more, modulo 256, is the other upper bit.
                let bytes = _mm_xor_si128(_mm512_cvtepi32_epi8(_mm512_cvtps_epi32(values)), zero);
                _mm_storeu_si128(words.as_mut_ptr().add(4 * i).cast(), bytes);
            }
        }
        bytes_by(last, rest, |value| unsigned(value, by));
        scale
    }
}

/// `value * by` to the nearest integer, 128 being zero.
#[inline(always)]
fn unsigned(value: f32, by: f32) -> u8 {
    nearest(value, by).wrapping_add(ZERO_POINT) as u8
}

/// The same as 16-bit pairs, two words to a step: values 0 and 2, then 1 and 3.
#[inline(always)]
pub(super) fn unsigned_pairs<S: Isa>(_: S, words: &mut [u32], values: &[f32]) -> f32 {
    let (scale, by) = scale(values);
    let byte = |value: f32| u32::from(unsigned(value, by));
    let (chunks, rest) = values.as_chunks::<4>();
    let (pairs, _) = words.as_chunks_mut::<2>();
    for (words, v) in pairs.iter_mut().zip(chunks) {
        *words = [byte(v[0]) | byte(v[2]) << 16, byte(v[1]) | byte(v[3]) << 16];
    }
    if let (Some(words), false) = (pairs.get_mut(chunks.len()), rest.is_empty()) {
        let mut v = [0; 4];
        for (v, value) in v.iter_mut().zip(rest) {
            *v = byte(*value);
        }
        *words = [v[0] | v[2] << 16, v[1] | v[3] << 16];
    }
    scale
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::kernels::isa::Portable;

    #[test]
    fn the_largest_becomes_127_and_ties_go_to_even() {
        let mut words = [0u32; 2];
        let (scale, sum) = weight_row(&[127.0, -127.0, 0.5, 1.5, -2.5], &mut words);
        assert_eq!((scale, sum), (1.0, 0));
        assert_eq!(words.map(bytes), [[127.0, -127.0, 0.0, 2.0], [-2.0, 0.0, 0.0, 0.0]]);
    }

    #[test]
    fn all_forms_of_a_row_hold_the_same_values() {
        for n in 1..40usize {
            let values: Vec<f32> = (0..n).map(|i| (i as f32 * 7.7).sin()).collect();
            let steps = n.div_ceil(4);
            let (mut single, mut pairs) = (vec![0u32; steps], vec![0u32; 2 * steps]);
            let mut signed = vec![0u32; steps];
            let scale = unsigned_bytes(Portable, &mut single, &values);
            assert_eq!(scale, unsigned_pairs(Portable, &mut pairs, &values));
            assert_eq!(scale, signed_bytes(Portable, &mut signed, &values));
            for i in 0..4 * steps {
                let byte = single[i / 4] >> (8 * (i % 4)) & 0xff;
                assert_eq!(byte, pairs[i / 4 * 2 + i % 2] >> (8 * (i & 2)) & 0xff);
                let value = if i < n { values[i] } else { continue };
                assert_eq!(signed[i / 4].to_le_bytes()[i % 4] as i8 as i32, byte as i32 - ZERO_POINT);
                assert!(((byte as i32 - ZERO_POINT) as f32 * scale - value).abs() <= 0.5001 * scale);
            }
        }
    }

    #[cfg(target_arch = "x86_64")]
    #[test]
    fn avx512_gives_the_same_bytes() {
        let Some(isa) = Avx512::detect() else { return };
        for (n, times) in (0..70usize).chain([128, 200, 1000]).flat_map(|n| [1.0, 0.0, 1e-38].map(|t| (n, t)))
        {
            // Halves among them: ties.
            let values: Vec<f32> = (0..n).map(|i| times * ((i * 37 % 255) as f32 / 2.0 - 63.5)).collect();
            let (mut plain, mut fast) = (vec![7u32; n.div_ceil(4)], vec![9u32; n.div_ceil(4)]);
            let scale = unsigned_bytes(Portable, &mut plain, &values);
            assert_eq!(scale.to_bits(), unsigned_bytes_avx512(isa, &mut fast, &values).to_bits());
            assert_eq!(plain, fast, "{n}");
        }
        for bad in [f32::NAN, f32::INFINITY] {
            let mut values = vec![1f32; 150];
            for at in [3, 140] {
                values[at] = bad;
                assert!(unsigned_bytes_avx512(isa, &mut [0; 38], &values).is_nan());
                values[at] = 1.0;
            }
        }
    }

    #[test]
    fn what_is_not_finite_has_no_scale() {
        for bad in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY, -f32::NAN] {
            let mut values = vec![1f32; 21];
            for at in [0, 15, 20] {
                values[at] = bad;
                assert!(scale(&values).0.is_nan());
                values[at] = 1.0;
            }
        }
        let mut words = [7u32; 3];
        let (scale_of_row, sum) = weight_row(&[f32::NAN; 12], &mut words);
        assert!(scale_of_row.is_nan() && (sum, words) == (0, [0; 3]));
        assert_eq!(scale(&[0.0, -0.0, 1e-39]), (0.0, 0.0));
        assert_eq!(scale(&[]), (0.0, 0.0));
    }
}
