//! Choices that are the same on every platform and with every version of the generator's crate.

use rand::Rng;

/// Bounded integers from the generator's raw words, so that their values do not depend on the version of `rand`.
pub(crate) trait Below {
    fn next_u32_below(&mut self, n: usize) -> usize;
}

impl<R: Rng + ?Sized> Below for R {
    fn next_u32_below(&mut self, n: usize) -> usize {
        ((u64::from(self.next_u32()) * n as u64) >> 32) as usize
    }
}

/// Moves a random choice of `n` elements to the front.
pub(crate) fn shuffle_first(of: &mut [usize], n: usize, rng: &mut impl Rng) {
    for i in 0..n {
        let j = i + rng.next_u32_below(of.len() - i);
        of.swap(i, j);
    }
}

/// Moves the `n` elements of least cost to the front.
pub(crate) fn take_least(of: &mut [usize], n: usize, mut cost: impl FnMut(usize) -> f32) {
    let mut keyed: Vec<(f32, usize)> = of.iter().map(|&i| (cost(i), i)).collect();
    if n < keyed.len() {
        keyed.select_nth_unstable_by(n, |a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
    }
    for (slot, (_, i)) in of.iter_mut().zip(keyed) {
        *slot = i;
    }
}
