//! Where a polynomial stops being positive: how far a lens model may be trusted.

/// Halvings of an interval, enough for the last bit of any f64 between 0 and 1e9.
const HALVINGS: usize = 90;

/// Value at `u` of the polynomial with these coefficients, the constant first.
pub(super) fn value(coefficients: &[f64], u: f64) -> f64 {
    coefficients.iter().rev().fold(0.0, |sum, c| sum * u + c)
}

/// Coefficients of the derivative.
pub(super) fn derivative(coefficients: &[f64]) -> Vec<f64> {
    coefficients.iter().enumerate().skip(1).map(|(power, c)| c * power as f64).collect()
}

/// Coefficients of a product.
pub(super) fn product(a: &[f64], b: &[f64]) -> Vec<f64> {
    let mut out = vec![0.0; a.len() + b.len()];
    for (i, x) in a.iter().enumerate() {
        for (j, y) in b.iter().enumerate() {
            out[i + j] += x * y;
        }
    }
    out
}

/// The largest `u` up to `upper` so that the polynomial is positive from 0 up to it; 0 if it is not positive at 0.
///
/// Between two neighbouring zeros of the derivative it rises or falls all the way, so no zero is passed over.
pub(super) fn positive_until(coefficients: &[f64], upper: f64) -> f64 {
    let positive = |u: f64| value(coefficients, u) > 0.0;
    let mut before = 0.0;
    if !positive(before) {
        return 0.0;
    }
    for end in turns(coefficients, upper) {
        if !positive(end) {
            return halve(before, end, positive);
        }
        before = end;
    }
    upper
}

/// Places in ascending order, `upper` the last, between which the polynomial rises or falls all the way.
fn turns(coefficients: &[f64], upper: f64) -> Vec<f64> {
    let slope = derivative(coefficients);
    let mut found = Vec::new();
    if slope.len() > 1 {
        let mut before = 0.0;
        for end in turns(&slope, upper) {
            let rises = value(&slope, before) > 0.0;
            if rises != (value(&slope, end) > 0.0) {
                found.push(halve(before, end, |u| (value(&slope, u) > 0.0) == rises));
            }
            before = end;
        }
    }
    found.push(upper);
    found
}

/// The last place from `low` on where `holds`, given that it holds at `low` and not at `high`.
fn halve(mut low: f64, mut high: f64, holds: impl Fn(f64) -> bool) -> f64 {
    for _ in 0..HALVINGS {
        let middle = 0.5 * (low + high);
        if holds(middle) {
            low = middle;
        } else {
            high = middle;
        }
    }
    low
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_first_zero_is_found() {
        // (1 - u)(2 - u)(3 - u) and its like with a narrow dip: 0.25 below zero around 1.5.
        let cubic = product(&product(&[1.0, -1.0], &[2.0, -1.0]), &[3.0, -1.0]);
        assert!((positive_until(&cubic, 1e6) - 1.0).abs() < 1e-12);
        let dip = product(&[1.0, -1.0], &[2.0, -1.0]);
        assert!((positive_until(&dip, 1e8) - 1.0).abs() < 1e-7);
        assert_eq!(positive_until(&dip, 0.5), 0.5);
        assert_eq!(positive_until(&[1.0, 0.3, 0.0, 2.0], 50.0), 50.0);
        assert_eq!(positive_until(&[-1.0, 5.0], 50.0), 0.0);
        assert_eq!(positive_until(&[1.0], 50.0), 50.0);
    }
}
