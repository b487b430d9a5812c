//! Statistics of many distributions over bins, on the device where their logits are.

use super::bins::{BinStats, Middle};
use crate::error::Result;
use crate::kernels::exec::dims2;
use candle_core::{D, DType, Tensor};

/// [`bin_stats`](super::bin_stats) of each row of `[n, bins]`: of the logits, a few numbers per row leave the device. The rest is as
/// there.
///
/// # Errors
/// [`Error::Argument`](crate::Error::Argument) if it has not two dimensions; [`Error::Tensors`](crate::Error::Tensors) of the device.
pub fn bin_stats_of_rows(
    logits: &Tensor,
    middle: Middle,
    tolerance: impl Fn(f32) -> f32,
) -> Result<Vec<Option<BinStats>>> {
    let (n, bins) = dims2("logits", logits)?;
    if n == 0 || bins == 0 {
        return Ok(vec![None; n]);
    }
    let logits = logits.to_dtype(DType::F32)?.contiguous()?;
    let device = logits.device();
    let max = logits.max_keepdim(1)?;
    let weights = logits.broadcast_sub(&max)?.exp()?;
    let total = weights.sum_keepdim(1)?;
    let found = match middle {
        Middle::Median => medians(&weights)?,
        Middle::Mean { values, .. } => {
            let values = Tensor::from_slice(values, (1, bins), device)?;
            (weights.broadcast_mul(&values)?.sum_keepdim(1)? / &total)?
        }
    };
    let mut found: Vec<f32> = Tensor::cat(&[&max, &total, &found], 1)?.flatten_all()?.to_vec1()?;
    if let Middle::Mean { position, .. } = middle {
        found.chunks_exact_mut(3).for_each(|row| row[2] = position(row[2]));
    }
    let middles: Vec<f32> = found.chunks_exact(3).map(|row| row[2]).collect();
    let within: Vec<f32> = middles.iter().map(|&m| if m.is_nan() { 0.0 } else { tolerance(m) }).collect();
    let (middles, within) =
        (Tensor::from_vec(middles, (n, 1), device)?, Tensor::from_vec(within, (n, 1), device)?);
    let centres = (Tensor::arange(0f32, bins as f32, device)? + 0.5)?.reshape((1, bins))?;
    let distances = centres.broadcast_sub(&middles)?.abs()?;
    let off = (&weights * &distances)?.sum(D::Minus1)?.to_vec1::<f32>()?;
    let near = (weights * distances.broadcast_le(&within)?.to_dtype(DType::F32)?)?;
    let near = near.sum(D::Minus1)?.to_vec1::<f32>()?;
    let rows = found.chunks_exact(3).zip(off).zip(near).map(|((row, off), near)| {
        let &[max, total, middle] = row else { return None };
        let readable = max.is_finite() && !total.is_nan();
        let (spread, near) = (off / total, (near / total).clamp(0.0, 1.0));
        readable.then_some(BinStats { middle, spread, near })
    });
    Ok(rows.collect())
}

/// Where the sum of each row's weights reaches half of it, `[n, 1]`, linear within its bin.
fn medians(weights: &Tensor) -> Result<Tensor> {
    let bins = weights.dims2()?.1;
    let sums = weights.cumsum(1)?;
    let half = (sums.narrow(1, bins - 1, 1)?.contiguous()? * 0.5)?;
    // Sums grow: as many are below one half as there are bins before the median's.
    let below = sums.broadcast_lt(&half)?.to_dtype(DType::F32)?;
    let at = below.sum_keepdim(1)?.clamp(0f32, (bins - 1) as f32)?;
    let index = at.to_dtype(DType::U32)?;
    let weight = weights.gather(&index, 1)?;
    let before = (sums.gather(&index, 1)? - &weight)?;
    let inside = ((half - before)? / weight)?.clamp(0f32, 1f32)?;
    Ok((at + inside)?)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::kernels::bin_stats;
    use crate::kernels::testing::on_device;
    use candle_core::Device;

    #[test]
    fn each_row_has_the_statistics_of_the_kernel() {
        for (bins, sharp) in [(1, 1.0), (2, 3.0), (65, 9.0), (1000, 1.0), (1000, 30.0), (1000, 200.0)] {
            let rows: Vec<Vec<f32>> = (0..40)
                .map(|r| (0..bins).map(|i| (((i + 31 * r) * 7919 % 1013) as f32 / 1013.0) * sharp).collect())
                .collect();
            let values: Vec<f32> = (0..bins).map(|k| (k as f32 * 0.003).exp()).collect();
            let mean = Middle::Mean { values: &values, position: &|v: f32| v.ln() / 0.003 + 0.5 };
            for middle in [Middle::Median, mean] {
                compare(&rows, middle, sharp);
            }
        }
    }

    fn compare(rows: &[Vec<f32>], middle: Middle, sharp: f32) {
        let bins = rows[0].len();
        let tolerance = |median: f32| (median * 0.05).max(1.0);
        let [logits] = on_device([&Tensor::new(rows.to_vec(), &Device::Cpu).unwrap()]);
        for (row, found) in rows.iter().zip(bin_stats_of_rows(&logits, middle, tolerance).unwrap()) {
            let (found, wanted) =
                (found.unwrap(), bin_stats(row, &mut Vec::new(), middle, tolerance).unwrap());
            let off = |a: f32, b: f32| (a - b).abs() / b.max(1.0);
            assert!(off(found.middle, wanted.middle) < 1e-4, "{bins}, {sharp}: {found:?}, {wanted:?}");
            assert!(off(found.spread, wanted.spread) < 1e-4, "{bins}, {sharp}: {found:?}, {wanted:?}");
            // A centre on the border of the interval is on one side or the other.
            let near =
                |more: f32| bin_stats(row, &mut Vec::new(), middle, |at| tolerance(at) + more).unwrap().near;
            let most = near(-2e-3) - 1e-4..near(2e-3) + 1e-4;
            assert!(most.contains(&found.near), "{bins}, {sharp}: {found:?}, {wanted:?}");
        }
    }

    #[test]
    fn what_is_no_distribution_has_no_statistics() {
        let mut rows = vec![vec![0.5f32; 40]; 4];
        rows[0][33] = f32::NAN;
        rows[1][33] = f32::INFINITY;
        rows[2] = vec![f32::NEG_INFINITY; 40];
        let [logits] = on_device([&Tensor::new(rows, &Device::Cpu).unwrap()]);
        let found = bin_stats_of_rows(&logits, Middle::Median, |_| 1.0).unwrap();
        assert_eq!(found.iter().map(Option::is_some).collect::<Vec<_>>(), [false, false, false, true]);
        let none = Tensor::zeros((0, 40), DType::F32, &Device::Cpu).unwrap();
        assert!(bin_stats_of_rows(&none, Middle::Median, |_| 1.0).unwrap().is_empty());
    }
}
