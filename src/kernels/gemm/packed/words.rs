//! The 32-bit words of packed values, and bf16, whose 16 bits are the upper half of an f32.

use crate::kernels::isa::{Isa, per_level};

/// `value` rounded to the nearest bf16, ties to even. A NaN stays one; what is too large becomes infinite.
#[inline(always)]
pub(in crate::kernels) fn bf16(value: f32) -> u32 {
    let bits = value.to_bits();
    let rounded = bits.wrapping_add(0x7fff + (bits >> 16 & 1)) >> 16;
    // Setting the quiet bit keeps a NaN whose payload is in the lower half from becoming infinite.
    if value.is_nan() { bits >> 16 | 0x40 } else { rounded }
}

/// The two bf16 of a word.
#[inline(always)]
pub(in crate::kernels) fn halves(word: u32) -> [f32; 2] {
    [f32::from_bits(word << 16), f32::from_bits(word & 0xffff_0000)]
}

/// Words of two values each from little-endian bf16; an odd last value is paired with zero.
pub(in crate::kernels) fn from_bf16_bytes(bytes: &[u8], words: &mut [u32]) {
    let (whole, rest) = bytes.as_chunks::<4>();
    for (word, bytes) in words.iter_mut().zip(whole) {
        *word = u32::from_le_bytes(*bytes);
    }
    if let (Some(last), &[low, high]) = (words.last_mut(), rest) {
        *last = u16::from_le_bytes([low, high]).into();
    }
}

/// Words of two rounded values each; an odd last value is paired with zero.
#[inline(always)]
pub(in crate::kernels) fn from_f32(values: &[f32], words: &mut [u32]) {
    let (pairs, rest) = values.as_chunks::<2>();
    for (word, &[low, high]) in words.iter_mut().zip(pairs) {
        *word = bf16(low) | bf16(high) << 16;
    }
    if let (Some(last), &[low]) = (words.get_mut(pairs.len()), rest) {
        *last = bf16(low);
    }
}

per_level!(
    /// [`from_f32`] at a level.
    fn pair_neighbours(values: &[f32], words: &mut [u32]) = pair_neighbours_body
);

#[inline(always)]
fn pair_neighbours_body<S: Isa>(_: S, values: &[f32], words: &mut [u32]) {
    from_f32(values, words);
}

per_level!(
    /// Words of a value of `low` and one of `high`, rounded.
    fn pair_rows(low: &[f32], high: &[f32], words: &mut [u32]) = pair_rows_body
);

#[inline(always)]
fn pair_rows_body<S: Isa>(_: S, low: &[f32], high: &[f32], words: &mut [u32]) {
    for (word, (low, high)) in words.iter_mut().zip(low.iter().zip(high)) {
        *word = bf16(*low) | bf16(*high) << 16;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rounding_is_that_of_the_half_crate() {
        let mut bits = 0u32;
        for _ in 0..200_000 {
            // A stride that visits every exponent and both halves.
            bits = bits.wrapping_add(0x0001_0f0f).rotate_left(3);
            let value = f32::from_bits(bits);
            assert_eq!(bf16(value), u32::from(half::bf16::from_f32(value).to_bits()), "{bits:#x}");
        }
        for value in [0.0, -0.0, 1.0, f32::MAX, f32::INFINITY, f32::NEG_INFINITY, 1e-40, 1.0 + 1.0 / 256.0] {
            assert_eq!(bf16(value), u32::from(half::bf16::from_f32(value).to_bits()), "{value}");
        }
        assert!(halves(bf16(f32::from_bits(0x7f80_0001)))[0].is_nan());
    }

    #[test]
    fn an_odd_value_is_paired_with_zero() {
        let mut words = [9u32; 2];
        from_f32(&[1.0, 2.0, 3.0], &mut words);
        assert_eq!([halves(words[0]), halves(words[1])], [[1.0, 2.0], [3.0, 0.0]]);
        let bytes: Vec<u8> =
            [1.0f32, 2.0, 3.0].iter().flat_map(|v| half::bf16::from_f32(*v).to_le_bytes()).collect();
        let mut same = [9u32; 2];
        from_bf16_bytes(&bytes, &mut same);
        assert_eq!(words, same);
    }
}
