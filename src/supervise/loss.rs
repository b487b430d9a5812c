//! The loss of one answer: cross-entropy on its tokens, plus L1 on the depth that they are expected to say.

use crate::error::{Error, Result};
use crate::query::bins::{Bins, Spacing};
use candle_core::{CpuStorage, CustomOp1, DType, Layout, Shape, Tensor};
use rayon::prelude::*;
use std::sync::Mutex;

/// Weights and blur of the loss on number tokens.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BinLoss {
    /// Where the numbers lie.
    pub bins: Bins,
    /// Standard deviation of the blurred target at depth 0, as a share of [`Target::scale`]; of its logarithm where bins are of
    /// equal ratio, whose target is blurred alike near and far, by the sum of both blurs.
    pub blur: f32,
    /// What is added to it per unit of depth.
    pub blur_slope: f32,
    /// Weight of the L1 of the mean, counted in [`Target::scale`], against the cross-entropy.
    pub l1: f32,
}

/// The truth of one row of logits.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Target {
    /// The number, in number units.
    pub value: f32,
    /// What the frame's errors are counted in, in number units, above 0, so that frames of near and of far things weigh alike
    /// whatever the unit.
    pub scale: f32,
}

/// Mean loss over rows and its parts.
#[derive(Debug, Clone)]
pub struct LossParts {
    /// Scalar, differentiable.
    pub total: Tensor,
    /// Mean absolute difference between the expected and the true number, in what the frame's errors are counted in.
    pub l1: f32,
}

struct BinLossOp {
    config: BinLoss,
    /// The number in the middle of each bin.
    centres: Vec<f32>,
    targets: Vec<Target>,
    gradient: Mutex<Vec<f32>>,
    l1: std::sync::Arc<Mutex<f32>>,
}

impl BinLossOp {
    /// Loss of one row, and its absolute error in what the frame's errors are counted in; its gradient goes to `grad`.
    fn row(&self, logits: &[f32], target: Target, grad: &mut [f32]) -> (f64, f64) {
        let (bins, count, centres) = (self.config.bins, logits.len(), &self.centres);
        let Target { value, scale } = target;
        // The target and its blur, counted in bins.
        let place = (bins.position(value) as f32).clamp(0.5, count as f32 - 0.5);
        let target = bins.number(place);
        let blur = match bins.spacing {
            Spacing::Equal { .. } => self.config.blur * scale + self.config.blur_slope * target,
            Spacing::Ratio { .. } => self.config.blur + self.config.blur_slope,
        };
        let sigma = (blur / bins.width() as f32).max(0.5);

        let max = logits.iter().copied().fold(f32::NEG_INFINITY, f32::max);
        let mut total = 0.0;
        for (g, l) in grad.iter_mut().zip(logits) {
            *g = (l - max).exp();
            total += *g;
        }
        let mean: f32 = grad.iter().enumerate().map(|(k, p)| p / total * centres[k]).sum();
        let sign = (mean - target).signum() * self.config.l1 / scale;

        let blurred = |k: usize| (-0.5 * ((k as f32 + 0.5 - place) / sigma).powi(2)).exp();
        let reach = ((5.0 * sigma).ceil() as usize).min(count) + 1;
        let middle = place as usize;
        let (from, to) = (middle.saturating_sub(reach), (middle + reach + 1).min(count));
        let mass: f32 = (from..to).map(blurred).sum();
        let log_total = total.ln() + max;

        let mut loss = 0f64;
        for (k, g) in grad.iter_mut().enumerate() {
            let p = *g / total;
            // d|mean - t|/dlogit = sign * p * (centre - mean)
            *g = p + sign * p * (centres[k] - mean);
        }
        for k in from..to {
            let q = blurred(k) / mass;
            grad[k] -= q;
            loss += f64::from(q) * f64::from(log_total - logits[k]);
        }
        let error = f64::from((mean - target).abs() / scale);
        (loss + f64::from(self.config.l1) * error, error)
    }
}

impl CustomOp1 for BinLossOp {
    fn name(&self) -> &'static str {
        "bin-loss"
    }

    fn cpu_fwd(&self, storage: &CpuStorage, layout: &Layout) -> candle_core::Result<(CpuStorage, Shape)> {
        let (rows, bins) = layout.shape().dims2()?;
        let Some((start, end)) = layout.contiguous_offsets() else {
            candle_core::bail!("bin-loss wants contiguous logits");
        };
        if rows != self.targets.len() {
            candle_core::bail!("bin-loss has {} targets for {rows} rows of logits", self.targets.len());
        }
        let logits = &storage.as_slice::<f32>()?[start..end];
        let mut gradient = vec![0f32; rows * bins];
        let sums: Vec<(f64, f64)> = gradient
            .par_chunks_mut(bins)
            .zip(logits.par_chunks(bins))
            .zip(&self.targets)
            .map(|((grad, row), &target)| self.row(row, target, grad))
            .collect();
        let scale = 1.0 / rows as f32;
        gradient.par_iter_mut().for_each(|g| *g *= scale);
        let (loss, error) = sums.iter().fold((0.0, 0.0), |a, s| (a.0 + s.0, a.1 + s.1));
        if let (Ok(mut stash), Ok(mut l1)) = (self.gradient.lock(), self.l1.lock()) {
            *stash = gradient;
            *l1 = (error / rows as f64) as f32;
        }
        Ok((CpuStorage::F32(vec![(loss / rows as f64) as f32]), Shape::from(())))
    }

    fn bwd(&self, arg: &Tensor, _res: &Tensor, grad: &Tensor) -> candle_core::Result<Option<Tensor>> {
        let stash = self.gradient.lock().map(|mut g| std::mem::take(&mut *g)).unwrap_or_default();
        let local = Tensor::from_vec(stash, arg.shape(), arg.device())?;
        Ok(Some(local.broadcast_mul(grad)?))
    }
}

/// Loss of number-token logits `[rows, bins]` against true numbers, one per row. It does not depend on the unit: numbers,
/// scales and ends of the bins all in another one give the same.
///
/// # Errors
/// [`crate::Error::Tensors`] on mismatched shapes; [`crate::Error::Argument`] if a scale is not above 0 or a row has not
/// one logit per bin.
pub fn bins(logits: &Tensor, targets: Vec<Target>, config: BinLoss) -> Result<LossParts> {
    if let Some(t) = targets.iter().find(|t| !(t.scale > 0.0 && t.scale.is_finite())) {
        return Err(Error::argument("scale of errors", t.scale, "a positive number"));
    }
    let (_, count) = logits.dims2()?;
    if count != config.bins.count {
        return Err(Error::argument("logits of a row", count, config.bins.count.to_string()));
    }
    let l1 = std::sync::Arc::new(Mutex::new(0.0));
    let centres = config.bins.centres();
    let op = BinLossOp { config, centres, targets, gradient: Mutex::default(), l1: l1.clone() };
    let total = logits.contiguous()?.apply_op1(op)?;
    let l1 = l1.lock().map(|v| *v).unwrap_or(f32::NAN);
    Ok(LossParts { total, l1 })
}

/// Loss of digit logits `[rows, 11]`: cross-entropy of each row's digit, plus L1 on the expected number.
///
/// `chosen` is the true index of each row; `place` is the worth of a row's digit in what the frame's errors are counted in
/// (0 for the decimal point), `number` the
/// number that the row belongs to, of `numbers`.
///
/// # Errors
/// [`crate::Error::Tensors`] on mismatched shapes.
pub fn digits(
    logits: &Tensor,
    chosen: &[u32],
    place: &[f32],
    number: &[u32],
    numbers: usize,
    l1_weight: f64,
) -> Result<LossParts> {
    let (rows, _) = logits.dims2()?;
    let device = logits.device();
    let log_p = candle_nn::ops::log_softmax(logits, 1)?;
    let chosen_at = Tensor::from_vec(chosen.to_vec(), (rows, 1), device)?;
    let cross_entropy = log_p.gather(&chosen_at, 1)?.mean_all()?.neg()?;
    let face: Vec<f32> = (0..11).map(|d| if d < 10 { d as f32 } else { 0.0 }).collect();
    let expected = log_p.exp()?.broadcast_mul(&Tensor::from_vec(face, (1, 11), device)?)?.sum(1)?;
    let truth: Vec<f32> = chosen.iter().map(|&c| if c < 10 { c as f32 } else { 0.0 }).collect();
    let off = ((expected - Tensor::from_vec(truth, rows, device)?)?
        * Tensor::from_vec(place.to_vec(), rows, device)?)?;
    let index = Tensor::from_vec(number.to_vec(), rows, device)?;
    let sums = Tensor::zeros(numbers, DType::F32, device)?.index_add(&index, &off, 0)?;
    let l1 = sums.abs()?.mean_all()?;
    let value = l1.to_scalar::<f32>()?;
    Ok(LossParts { total: (cross_entropy + (l1 * l1_weight)?)?, l1: value })
}

#[cfg(test)]
mod tests {
    use super::*;
    use candle_core::{Device, Var};

    fn equal(count: usize, range: f64) -> Bins {
        Bins { count, spacing: Spacing::Equal { range } }
    }

    fn ratio(count: usize) -> Bins {
        Bins { count, spacing: Spacing::Ratio { lowest: 0.125, highest: 8.0 } }
    }

    #[test]
    fn bin_gradient_matches_finite_differences() {
        for bins in [equal(20, 1.0), ratio(20)] {
            the_gradient_of(bins);
        }
    }

    fn the_gradient_of(of: Bins) {
        let values: Vec<f32> = (0..2 * 20).map(|i| ((i * 37 % 11) as f32 - 5.0) * 0.3).collect();
        let config = BinLoss { bins: of, blur: 0.02, blur_slope: 0.05, l1: 2.0 };
        let targets = [0.31, 0.77].map(|value| Target { value, scale: 0.5 }).to_vec();
        let loss = |v: &[f32]| -> f32 {
            let t = Tensor::from_vec(v.to_vec(), (2, 20), &Device::Cpu).unwrap();
            bins(&t, targets.clone(), config).unwrap().total.to_scalar().unwrap()
        };
        let var = Var::from_vec(values.clone(), (2, 20), &Device::Cpu).unwrap();
        let total = bins(&var, targets.clone(), config).unwrap().total;
        let grads = total.backward().unwrap();
        let grad: Vec<f32> = grads.get(&var).unwrap().flatten_all().unwrap().to_vec1().unwrap();
        for i in 0..values.len() {
            let (mut up, mut down) = (values.clone(), values.clone());
            up[i] += 1e-2;
            down[i] -= 1e-2;
            let numeric = (loss(&up) - loss(&down)) / 2e-2;
            assert!((numeric - grad[i]).abs() < 2e-3, "{i}: {numeric} vs {}", grad[i]);
        }
    }

    #[test]
    fn the_unit_of_the_numbers_does_not_count() {
        let logits: Vec<f32> = (0..3 * 20).map(|i| ((i * 37 % 11) as f32 - 5.0) * 0.3).collect();
        // A power of two, so that nothing is rounded.
        let [one, other] = [1.0, 8.0].map(|unit| {
            let config = BinLoss { bins: equal(20, 1.25 * unit), blur: 0.1, blur_slope: 0.05, l1: 4.0 };
            let unit = unit as f32;
            let targets = [(0.31, 1.0), (0.77, 0.9), (0.05, 0.125)]
                .map(|(value, scale)| Target { value: value * unit, scale: scale * unit });
            let var = Var::from_vec(logits.clone(), (3, 20), &Device::Cpu).unwrap();
            let parts = bins(&var, targets.to_vec(), config).unwrap();
            let grads = parts.total.backward().unwrap();
            let grad: Vec<f32> = grads.get(&var).unwrap().flatten_all().unwrap().to_vec1().unwrap();
            (parts.total.to_scalar::<f32>().unwrap(), parts.l1, grad)
        });
        assert_eq!(one, other);
    }

    #[test]
    fn errors_are_counted_in_the_scale() {
        let config = BinLoss { bins: equal(100, 100.0), blur: 0.0, blur_slope: 0.0, l1: 1.0 };
        let l1 = |value: f32, scale: f32| {
            let t = Tensor::zeros((1, 100), DType::F32, &Device::Cpu).unwrap();
            bins(&t, vec![Target { value, scale }], config).unwrap().l1
        };
        // All answers alike: 50 is expected.
        assert!((l1(40.0, 80.0) - 10.0 / 80.0).abs() < 1e-5);
        assert!((l1(2.0, 4.0) - 48.0 / 4.0).abs() < 1e-4);
    }

    #[test]
    fn bins_of_equal_ratio_blur_near_and_far_alike() {
        let config = BinLoss { bins: ratio(240), blur: 0.05, blur_slope: 0.0, l1: 0.0 };
        // A sure answer that is 10 % off costs the same wherever it is.
        let cost = |truth: f32| {
            let mut v = vec![0f32; 240];
            v[config.bins.bin(truth * 1.1)] = 8.0;
            let t = Tensor::from_vec(v, (1, 240), &Device::Cpu).unwrap();
            let value = config.bins.number(config.bins.bin(truth) as f32 + 0.5);
            bins(&t, vec![Target { value, scale: 2.0 }], config).unwrap().total.to_scalar::<f32>().unwrap()
        };
        let (near, far) = (cost(0.5), cost(4.0));
        assert!((near - far).abs() < 1e-3 * near, "{near} {far}");
    }

    #[test]
    fn targets_that_cannot_be_are_refused() {
        let config = BinLoss { bins: equal(10, 1.0), blur: 0.01, blur_slope: 0.0, l1: 2.0 };
        let t = Tensor::zeros((2, 10), DType::F32, &Device::Cpu).unwrap();
        let one = Target { value: 0.5, scale: 1.0 };
        bins(&t, vec![one; 2], config).unwrap();
        assert!(matches!(bins(&t, vec![one], config), Err(Error::Tensors(_))));
        let other = BinLoss { bins: equal(11, 1.0), ..config };
        assert!(matches!(bins(&t, vec![one; 2], other), Err(Error::Argument { .. })));
        for scale in [0.0, -1.0, f32::NAN, f32::INFINITY] {
            let wrong = Target { scale, ..one };
            assert!(matches!(bins(&t, vec![one, wrong], config), Err(Error::Argument { .. })));
        }
    }

    #[test]
    fn a_sure_right_answer_costs_less_than_a_sure_wrong_one() {
        let config = BinLoss { bins: equal(100, 1.0), blur: 0.01, blur_slope: 0.0, l1: 2.0 };
        let at = |k: usize| {
            let mut v = vec![0f32; 100];
            v[k] = 8.0;
            let t = Tensor::from_vec(v, (1, 100), &Device::Cpu).unwrap();
            bins(&t, vec![Target { value: 0.405, scale: 1.0 }], config)
                .unwrap()
                .total
                .to_scalar::<f32>()
                .unwrap()
        };
        assert!(at(40) < at(60) && at(60) < at(90));
    }

    #[test]
    fn digits_are_supervised_by_place() {
        let row = |d: usize| (0..11).map(|i| if i == d { 20f32 } else { 0.0 }).collect::<Vec<_>>();
        let logits: Vec<f32> = [row(4), row(10), row(2)].concat();
        let logits = Tensor::from_vec(logits, (3, 11), &Device::Cpu).unwrap();
        let right = digits(&logits, &[4, 10, 2], &[1.0, 0.0, 0.1], &[0, 0, 0], 1, 1.0).unwrap();
        assert!(right.total.to_scalar::<f32>().unwrap() < 1e-3 && right.l1 < 1e-3);
        let wrong = digits(&logits, &[5, 10, 2], &[1.0, 0.0, 0.1], &[0, 0, 0], 1, 1.0).unwrap();
        assert!((wrong.l1 - 1.0).abs() < 1e-3);
    }
}
