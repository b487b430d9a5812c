//! Colours for depth, error and confidence, evenly spaced for the eye.
//!
//! The maps are curves in OKLab (Ottosson, "A perceptual color space for image processing", 2020): lightness changes
//! linearly and hue and chroma move at constant speed, so equal steps of the value look equally large, and the maps
//! stay readable in grey. Invalid pixels are black, which no map contains.

use image::{Rgb, RgbImage};

use crate::depth::pixels::{check_length, is_valid, pixel_count};
use crate::error::{Error, Result};

/// Colour of a pixel without a value.
pub const INVALID: Rgb<u8> = Rgb([0, 0, 0]);

/// A colour map over 0..=1.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ColourMap {
    /// Depth: near (0) is bright yellow, far (1) is dark blue, through red and violet.
    Depth,
    /// Absolute error: none (0) is dark grey, large (1) is bright orange.
    Error,
    /// Confidence: none (0) is dark blue, full (1) is bright green.
    Confidence,
}

impl ColourMap {
    /// Colour for a value in 0..=1 (values outside are clamped, NaN gives [`INVALID`]).
    pub fn colour(self, t: f32) -> Rgb<u8> {
        if t.is_nan() {
            return INVALID;
        }
        let linear = linear_rgb(self.oklab(t.clamp(0.0, 1.0)));
        Rgb(linear.map(|c| (encode_srgb(c.clamp(0.0, 1.0)) * 255.0).round() as u8))
    }

    /// OKLab lightness, a and b for t in 0..=1. Each map moves through the space at constant speed.
    fn oklab(self, t: f32) -> [f32; 3] {
        let mix = |from: f32, to: f32| from + (to - from) * t;
        match self {
            // A helix: wide enough in the a-b plane for many hues, off centre to stay within sRGB at both ends.
            ColourMap::Depth => {
                let angle = mix(130.0, -100.0).to_radians();
                [mix(0.92, 0.22), 0.02 + 0.14 * angle.cos(), 0.14 * angle.sin()]
            }
            ColourMap::Error => [mix(0.25, 0.78), mix(0.0, 0.06), mix(0.0, 0.14)],
            ColourMap::Confidence => [mix(0.22, 0.90), mix(0.0, -0.15), mix(-0.08, 0.12)],
        }
    }
}

/// Colours a row-major depth map (metres): `min` and nearer is bright, `max` and farther is dark, invalid is [`INVALID`].
///
/// # Errors
/// [`Error::ImageSize`], [`Error::BufferLength`], [`Error::Argument`] unless `min` and `max` are finite and `min < max`.
pub fn depth_to_rgb(depth: &[f32], width: usize, height: usize, min: f32, max: f32) -> Result<RgbImage> {
    let valid = |d: f32| if is_valid(d) { d } else { f32::NAN };
    paint(ColourMap::Depth, depth, width, height, (min, max), valid)
}

/// Colours absolute errors (metres): 0 is dark, `max` and above bright, NaN [`INVALID`].
///
/// # Errors
/// As [`depth_to_rgb`]; `max` must be above 0.
pub fn error_to_rgb(error: &[f32], width: usize, height: usize, max: f32) -> Result<RgbImage> {
    paint(ColourMap::Error, error, width, height, (0.0, max), f32::abs)
}

/// Colours confidences: 0 is dark, 1 bright, NaN [`INVALID`].
///
/// # Errors
/// [`Error::ImageSize`], [`Error::BufferLength`].
pub fn confidence_to_rgb(confidence: &[f32], width: usize, height: usize) -> Result<RgbImage> {
    paint(ColourMap::Confidence, confidence, width, height, (0.0, 1.0), |c| c)
}

/// Colours unit normals in camera coordinates, as usual: red grows to the right, green upwards, blue towards the camera, each
/// from -1 to 1; NaN is [`INVALID`]. A wall that faces the camera is light blue.
///
/// # Errors
/// [`Error::ImageSize`], [`Error::BufferLength`].
pub fn normals_to_rgb(normals: &[[f32; 3]], width: usize, height: usize) -> Result<RgbImage> {
    check_length("normals", normals.len(), pixel_count(width, height)?)?;
    let colour = |&[right, down, forward]: &[f32; 3]| match right.is_nan() {
        true => INVALID,
        false => {
            Rgb([right, -down, -forward].map(|c| ((c.clamp(-1.0, 1.0) * 0.5 + 0.5) * 255.0).round() as u8))
        }
    };
    let pixels = normals.iter().flat_map(|normal| colour(normal).0).collect();
    // The length was checked.
    Ok(RgbImage::from_raw(width as u32, height as u32, pixels).unwrap_or_default())
}

/// A range that suits a depth map: its 2nd to 98th percentile, so that a few outliers do not flatten the rest. Always
/// non-empty, `None` without a valid pixel.
pub fn depth_range(depth: &[f32]) -> Option<(f32, f32)> {
    let mut valid: Vec<f32> = depth.iter().copied().filter(|&d| is_valid(d)).collect();
    if valid.is_empty() {
        return None;
    }
    let last = valid.len() - 1;
    let mut percentile = |p: usize| *valid.select_nth_unstable_by(last * p / 100, f32::total_cmp).1;
    let (low, high) = (percentile(2), percentile(98));
    // A flat map still needs a range to be painted in.
    Some(if high > low { (low, high) } else { (low * 0.95, low * 1.05) })
}

fn paint(
    map: ColourMap,
    values: &[f32],
    width: usize,
    height: usize,
    (low, high): (f32, f32),
    prepare: impl Fn(f32) -> f32,
) -> Result<RgbImage> {
    check_length("values to colour", values.len(), pixel_count(width, height)?)?;
    if !(low.is_finite() && high.is_finite() && low < high) {
        return Err(Error::argument(
            "colour range",
            format!("{low}..{high}"),
            "finite limits, the first below the second",
        ));
    }
    // 256 steps are all that 8-bit colours can show; a table is far faster than the powers per pixel.
    let table: Vec<Rgb<u8>> = (0..256u16).map(|i| map.colour(f32::from(i) / 255.0)).collect();
    let colour = |&value: &f32| {
        let t = (prepare(value) - low) / (high - low);
        if t.is_nan() { INVALID } else { table[(t.clamp(0.0, 1.0) * 255.0).round() as usize] }
    };
    let mut image = RgbImage::new(width as u32, height as u32);
    image.pixels_mut().zip(values).for_each(|(pixel, value)| *pixel = colour(value));
    Ok(image)
}

/// OKLab to linear sRGB; outside 0..=1 where the screen has no such colour.
fn linear_rgb([lightness, a, b]: [f32; 3]) -> [f32; 3] {
    let l = (lightness + 0.396_337_78 * a + 0.215_803_76 * b).powi(3);
    let m = (lightness - 0.105_561_346 * a - 0.063_854_17 * b).powi(3);
    let s = (lightness - 0.089_484_18 * a - 1.291_485_5 * b).powi(3);
    [
        4.076_741_7 * l - 3.307_711_6 * m + 0.230_969_94 * s,
        -1.268_438 * l + 2.609_757_4 * m - 0.341_319_38 * s,
        -0.004_196_086_3 * l - 0.703_418_6 * m + 1.707_614_7 * s,
    ]
}

/// The sRGB transfer curve (IEC 61966-2-1).
fn encode_srgb(linear: f32) -> f32 {
    if linear <= 0.003_130_8 { 12.92 * linear } else { 1.055 * linear.powf(1.0 / 2.4) - 0.055 }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MAPS: [ColourMap; 3] = [ColourMap::Depth, ColourMap::Error, ColourMap::Confidence];

    /// 8-bit sRGB back to OKLab, to judge what is really shown.
    fn to_oklab(Rgb(rgb): Rgb<u8>) -> [f32; 3] {
        let [r, g, b] = rgb
            .map(|c| f32::from(c) / 255.0)
            .map(|c| if c <= 0.04045 { c / 12.92 } else { ((c + 0.055) / 1.055).powf(2.4) });
        let l = (0.412_221_46 * r + 0.536_332_55 * g + 0.051_445_995 * b).cbrt();
        let m = (0.211_903_5 * r + 0.680_699_5 * g + 0.107_396_96 * b).cbrt();
        let s = (0.088_302_46 * r + 0.281_718_85 * g + 0.629_978_7 * b).cbrt();
        [
            0.210_454_26 * l + 0.793_617_8 * m - 0.004_072_047 * s,
            1.977_998_5 * l - 2.428_592_2 * m + 0.450_593_7 * s,
            0.025_904_037 * l + 0.782_771_77 * m - 0.808_675_77 * s,
        ]
    }

    fn step(a: [f32; 3], b: [f32; 3]) -> f32 {
        (0..3).map(|i| (a[i] - b[i]).powi(2)).sum::<f32>().sqrt()
    }

    #[test]
    fn all_colours_exist_on_a_screen() {
        for map in MAPS {
            for i in 0..=1000 {
                let rgb = linear_rgb(map.oklab(i as f32 / 1000.0));
                assert!(rgb.iter().all(|c| (0.0..=1.0).contains(c)), "{map:?} at {i}: {rgb:?}");
            }
        }
    }

    #[test]
    fn shown_lightness_is_monotone_and_steps_are_even() {
        for map in MAPS {
            let shown: Vec<_> = (0..=16).map(|i| to_oklab(map.colour(i as f32 / 16.0))).collect();
            let slope = (shown[16][0] - shown[0][0]) / 16.0;
            let mean = shown.windows(2).map(|w| step(w[0], w[1])).sum::<f32>() / 16.0;
            for pair in shown.windows(2) {
                let lightness = pair[1][0] - pair[0][0];
                // What 8-bit rounding may do to a step, both for lightness and for the distance.
                assert!(
                    (lightness - slope).abs() < 0.15 * slope.abs(),
                    "{map:?}: {lightness} instead of {slope}"
                );
                assert!(
                    (step(pair[0], pair[1]) - mean).abs() < 0.15 * mean,
                    "{map:?}: {} instead of {mean}",
                    step(pair[0], pair[1])
                );
            }
        }
        assert!(
            to_oklab(ColourMap::Depth.colour(0.0))[0] > 0.9
                && to_oklab(ColourMap::Depth.colour(1.0))[0] < 0.25
        );
    }

    #[test]
    fn values_are_placed_in_the_range() {
        let depth = [1.0, 2.0, 3.0, f32::NAN, 0.0, 99.0];
        let image = depth_to_rgb(&depth, 3, 2, 1.0, 3.0).unwrap();
        let expected = [0.0, 0.5, 1.0, f32::NAN, f32::NAN, 1.0].map(|t| ColourMap::Depth.colour(t));
        assert!(image.pixels().zip(&expected).take(1).all(|(a, b)| a == b));
        assert!(image.pixels().skip(2).zip(&expected[2..]).all(|(a, b)| a == b));
        assert_eq!(*image.get_pixel(0, 1), INVALID);
        assert!(MAPS.iter().all(|map| (0..=255).all(|i| map.colour(i as f32 / 255.0) != INVALID)));
        let confidence = confidence_to_rgb(&[0.0, 1.0], 2, 1).unwrap();
        assert!(to_oklab(*confidence.get_pixel(1, 0))[0] > to_oklab(*confidence.get_pixel(0, 0))[0]);
        assert_eq!(error_to_rgb(&[-5.0], 1, 1, 5.0).unwrap().get_pixel(0, 0), &ColourMap::Error.colour(1.0));
    }

    #[test]
    fn ranges_are_checked_and_found() {
        for (low, high) in [(1.0, 1.0), (2.0, 1.0), (f32::NAN, 1.0), (0.0, f32::INFINITY)] {
            assert!(matches!(depth_to_rgb(&[1.0], 1, 1, low, high), Err(Error::Argument { .. })));
        }
        assert!(matches!(depth_to_rgb(&[1.0], 2, 1, 0.0, 1.0), Err(Error::BufferLength { .. })));
        assert!(matches!(error_to_rgb(&[], 0, 1, 1.0), Err(Error::ImageSize { .. })));
        let many: Vec<f32> = (1..=1001).map(|i| i as f32).collect();
        assert_eq!(depth_range(&many), Some((21.0, 981.0)));
        assert_eq!(depth_range(&[f32::NAN, 0.0]), None);
        assert!(depth_range(&[2.0]).is_some_and(|(low, high)| low < 2.0 && 2.0 < high));
    }

    #[test]
    fn normals_have_the_usual_colours() {
        let normals = [[0.0, 0.0, -1.0], [1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [f32::NAN; 3]];
        let picture = normals_to_rgb(&normals, 2, 2).unwrap();
        let colours: Vec<[u8; 3]> = picture.pixels().map(|p| p.0).collect();
        assert_eq!(colours, [[128, 128, 255], [255, 128, 128], [128, 255, 128], INVALID.0]);
        assert!(matches!(normals_to_rgb(&normals, 3, 2), Err(Error::BufferLength { .. })));
    }
}
