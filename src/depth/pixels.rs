//! What holds for every buffer of one value per pixel.

use crate::error::{Error, Result};
use image::RgbImage;
use ndarray::ArrayView2;

/// A confidence is the probability that the truth lies within this share of the depth.
pub(crate) const CONFIDENT_WITHIN: f32 = 0.05;

/// `width * height`, refusing empty images and products that overflow.
pub(crate) fn pixel_count(width: usize, height: usize) -> Result<usize> {
    let reason = match width.checked_mul(height) {
        Some(0) => "expected a width and height of at least 1 pixel",
        Some(n) if n <= MAX_PIXELS => return Ok(n),
        _ => "expected at most 2^28 pixels",
    };
    Err(Error::ImageSize { width, height, reason: reason.to_string() })
}

/// Largest image accepted: 1 GiB of f32, far above any camera, far below what an attacker's header may claim.
pub(crate) const MAX_PIXELS: usize = 1 << 28;

/// Whether a pixel or one of the eight around it has no depth.
pub(crate) fn faces_a_hole(depth: &[f32], width: usize, height: usize, x: usize, y: usize) -> bool {
    let columns = x.saturating_sub(1)..(x + 2).min(width);
    let mut rows = y.saturating_sub(1)..(y + 2).min(height);
    rows.any(|row| depth[row * width..][columns.clone()].iter().any(|d| d.is_nan()))
}

/// Fails unless a buffer holds exactly one value per pixel.
pub(crate) fn check_length(what: &'static str, found: usize, expected: usize) -> Result<()> {
    if found == expected { Ok(()) } else { Err(Error::BufferLength { what, expected, found }) }
}

/// The rows of a borrowed buffer: `row` elements each, that begin every `stride` elements. The last one need not be followed by anything.
///
/// # Errors
/// [`Error::Argument`] for a stride below `row`, [`Error::BufferLength`] for a buffer that ends before the last row does.
pub(crate) fn rows<'a, T>(
    what: &'static str,
    values: &'a [T],
    row: usize,
    height: usize,
    stride: usize,
) -> Result<impl Iterator<Item = &'a [T]>> {
    if stride < row || stride == 0 {
        let expected = format!("at least the {row} elements of a row of the {what}");
        return Err(Error::argument("stride", stride, expected));
    }
    let before = height.saturating_sub(1).checked_mul(stride);
    let expected = before.and_then(|before| before.checked_add(row)).unwrap_or(usize::MAX);
    if values.len() < expected {
        return Err(Error::BufferLength { what, expected, found: values.len() });
    }
    Ok(values.chunks(stride).take(height).map(move |line| line.get(..row).unwrap_or(line)))
}

/// Whether a number is a usable depth: finite and above zero.
pub(crate) fn is_valid(depth: f32) -> bool {
    depth.is_finite() && depth > 0.0
}

/// A row-major buffer as (rows, columns); the callers' constructors guarantee the length.
pub(crate) fn view2<T>(data: &[T], width: usize, height: usize) -> ArrayView2<'_, T> {
    ArrayView2::from_shape((height, width), data).unwrap_or_else(|_| ndarray::aview2::<T, 0>(&[]))
}

/// Colour of a pixel, half its own and half that of its four neighbours: less noise, and edges stay in place.
pub(crate) fn local_colour(rgb: &RgbImage, x: usize, y: usize) -> [f32; 3] {
    let (right, bottom) = (rgb.width() as usize - 1, rgb.height() as usize - 1);
    let pixel = |x: usize, y: usize| rgb.get_pixel(x as u32, y as u32).0.map(f32::from);
    let around = [
        pixel(x.saturating_sub(1), y),
        pixel((x + 1).min(right), y),
        pixel(x, y.saturating_sub(1)),
        pixel(x, (y + 1).min(bottom)),
    ];
    let own = pixel(x, y);
    std::array::from_fn(|c| 0.5 * own[c] + 0.125 * around.iter().map(|p| p[c]).sum::<f32>())
}

/// Squared distance of two colours.
pub(crate) fn colours_apart(a: [f32; 3], b: [f32; 3]) -> f32 {
    (0..3).map(|c| (a[c] - b[c]).powi(2)).sum()
}

/// The middle value, the upper one of two; `None` of nothing.
pub(crate) fn median(values: &mut [f32]) -> Option<f32> {
    let middle = values.len() / 2;
    (middle < values.len()).then(|| *values.select_nth_unstable_by(middle, f32::total_cmp).1)
}
