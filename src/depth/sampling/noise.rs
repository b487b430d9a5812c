//! Random values that are a function of a place.

#[inline(always)]
pub(crate) fn hash(a: i32, b: i32, seed: u32) -> u32 {
    let mut h = (a as u32).wrapping_mul(0x9E37_79B1)
        ^ (b as u32).wrapping_mul(0x85EB_CA77)
        ^ seed.wrapping_mul(0xC2B2_AE3D);
    h = (h ^ (h >> 15)).wrapping_mul(0x2C1B_3C6D);
    h = (h ^ (h >> 12)).wrapping_mul(0x297A_2D39);
    h ^ (h >> 15)
}

#[inline(always)]
pub(crate) fn hash01(a: i32, b: i32, seed: u32) -> f32 {
    (hash(a, b, seed) >> 8) as f32 * (1.0 / 16_777_216.0)
}

/// `floor` as an integer. Without SSE4.1, which the baseline x86-64 lacks, `f32::floor` is a call into libm.
#[inline(always)]
pub(crate) fn floor(x: f32) -> i32 {
    let i = x as i32;
    i.wrapping_sub(i32::from(x < i as f32))
}

/// Value noise in [0, 1] with smooth interpolation on the unit lattice.
#[inline(always)]
pub(crate) fn noise(u: f32, v: f32, seed: u32) -> f32 {
    let (i, j) = (floor(u), floor(v));
    let (a, b) = (u - i as f32, v - j as f32);
    let (a, b) = (a * a * (3.0 - 2.0 * a), b * b * (3.0 - 2.0 * b));
    let low = hash01(i, j, seed) * (1.0 - a) + hash01(i.wrapping_add(1), j, seed) * a;
    let j = j.wrapping_add(1);
    let high = hash01(i, j, seed) * (1.0 - a) + hash01(i.wrapping_add(1), j, seed) * a;
    low + (high - low) * b
}
