//! Scalar functions written so that the compiler can vectorise loops over them: no branches, no
//! library calls. The token says what they are compiled for, and so whether multiply-add is fused.

use crate::kernels::isa::Isa;

/// `a * b + c`, fused where that is one instruction; elsewhere it would be a library call.
#[inline(always)]
pub(in crate::kernels) fn madd<S: Isa>(_: S, a: f32, b: f32, c: f32) -> f32 {
    if S::FUSED_MADD { a.mul_add(b, c) } else { a * b + c }
}

/// `e^x` to about 2 units in the last place; below -87.3 it gives about 1.2e-38, not a denormal.
///
/// x = n ln 2 + r with |r| <= ln 2 / 2; e^r by its Taylor series; 2^n by the exponent bits.
#[inline(always)]
pub(in crate::kernels) fn exp<S: Isa>(isa: S, x: f32) -> f32 {
    // Adding 1.5 * 2^23 leaves round(x / ln 2) in the low bits of the sum.
    const ROUND: f32 = 12_582_912.0;
    let x = x.clamp(-87.3, 88.3);
    let shifted = madd(isa, x, std::f32::consts::LOG2_E, ROUND);
    let n = shifted - ROUND;
    // ln 2 in two parts, the first exact in few bits, so that n * ln 2 loses nothing.
    let r = madd(isa, n, -0.693_359_4, x);
    let r = madd(isa, n, 2.121_944_4e-4, r);
    let mut p = 1.0 / 5040.0;
    for c in [1.0 / 720.0, 1.0 / 120.0, 1.0 / 24.0, 1.0 / 6.0, 0.5, 1.0, 1.0] {
        p = madd(isa, p, r, c);
    }
    let exponent = shifted.to_bits().wrapping_add(127) << 23;
    p * f32::from_bits(exponent)
}

/// `1 / (1 + e^-x)`.
#[inline(always)]
pub(in crate::kernels) fn sigmoid<S: Isa>(isa: S, x: f32) -> f32 {
    1.0 / (1.0 + exp(isa, -x))
}

/// The error function to 2e-7 absolute: Abramowitz and Stegun, formula 7.1.26. Also gives e^(-x^2).
#[inline(always)]
pub(in crate::kernels) fn erf<S: Isa>(isa: S, x: f32) -> (f32, f32) {
    let a = x.abs();
    let t = 1.0 / madd(isa, 0.327_591_1, a, 1.0);
    let mut p = 1.061_405_4;
    for c in [-1.453_152_1, 1.421_413_8, -0.284_496_72, 0.254_829_6] {
        p = madd(isa, p, t, c);
    }
    let gauss = exp(isa, -a * a);
    ((1.0 - p * t * gauss).copysign(x), gauss)
}

/// `a . b`, summed in four groups of 16 lanes: enough to keep a core's multipliers busy.
#[inline(always)]
pub(in crate::kernels) fn dot<S: Isa>(isa: S, a: &[f32], b: &[f32]) -> f32 {
    let mut sums = [[0f32; 16]; 4];
    let (a64, a_rest) = a.as_chunks::<64>();
    let (b64, b_rest) = b.as_chunks::<64>();
    for (a, b) in a64.iter().zip(b64) {
        for (g, sums) in sums.iter_mut().enumerate() {
            for (l, sum) in sums.iter_mut().enumerate() {
                *sum = madd(isa, a[g * 16 + l], b[g * 16 + l], *sum);
            }
        }
    }
    let [mut lanes, second, third, fourth] = sums;
    for l in 0..16 {
        lanes[l] += second[l] + (third[l] + fourth[l]);
    }
    for (a, b) in a_rest.chunks(16).zip(b_rest.chunks(16)) {
        for ((sum, &a), &b) in lanes.iter_mut().zip(a).zip(b) {
            *sum = madd(isa, a, b, *sum);
        }
    }
    lanes.iter().sum()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::kernels::isa::Portable;

    /// An instruction set with fused multiply-add, as plain code.
    #[derive(Clone, Copy)]
    struct Fused;

    impl Isa for Fused {
        const FUSED_MADD: bool = true;
    }

    #[test]
    fn exp_matches_the_standard_library() {
        for i in -8700..8800 {
            let x = i as f32 * 0.01;
            let exact = (x as f64).exp();
            for value in [exp(Fused, x), exp(Portable, x)] {
                let relative = (value as f64 - exact).abs() / exact;
                assert!(relative < 3e-7, "exp({x}) = {value}, expected {exact}");
            }
        }
        assert!(exp(Fused, f32::NEG_INFINITY) < 1.3e-38);
        assert_eq!(exp(Portable, 0.0), 1.0);
    }

    #[test]
    fn dot_sums_every_element_once() {
        for n in [0usize, 1, 15, 16, 17, 63, 64, 150] {
            let a: Vec<f32> = (0..n).map(|i| i as f32).collect();
            let b = vec![2f32; n];
            let expected = (n * n.saturating_sub(1)) as f32;
            assert_eq!((dot(Fused, &a, &b), dot(Portable, &a, &b)), (expected, expected));
        }
    }

    #[test]
    fn erf_matches_its_integral() {
        // Simpson's rule in f64.
        for i in 0..=40 {
            let x = i as f64 * 0.1;
            let n = 400;
            let h = x / n as f64;
            let f = |t: f64| (-t * t).exp();
            let mut sum = f(0.0) + f(x);
            for k in 1..n {
                sum += f(k as f64 * h) * if k % 2 == 1 { 4.0 } else { 2.0 };
            }
            let exact = sum * h / 3.0 * std::f64::consts::FRAC_2_SQRT_PI;
            let (value, gauss) = erf(Portable, x as f32);
            assert!((value as f64 - exact).abs() < 4e-7, "erf({x}) = {value}, expected {exact}");
            assert_eq!(erf(Portable, -x as f32).0.abs(), value);
            assert!((gauss as f64 - f(x)).abs() < 4e-7);
        }
    }
}
