//! One picture that shows a whole result: the frame, its measurements, the dense map and how sure or wrong it is.

use std::io::Cursor;
use std::path::Path;

use image::{Rgb, RgbImage};

use super::colour::{ColourMap, confidence_to_rgb, depth_to_rgb, error_to_rgb};
use super::{colour, label};
use crate::depth::pixels::{check_length, is_valid};
use crate::depth::{DepthMap, SparseDepth};
use crate::error::{Error, Result};

pub(super) const GAP: usize = 8;
pub(super) const CAPTION: usize = 24;
pub(super) const TEXT_SCALE: usize = 2;
/// Tiles narrower than this are enlarged by a whole factor, so that captions fit and points can be seen.
const MIN_TILE: usize = 320;
pub(super) const BACKGROUND: Rgb<u8> = Rgb([24, 24, 24]);
pub(super) const TEXT: Rgb<u8> = Rgb([230, 230, 230]);

/// Draws RGB, measurements, depth and confidence in one picture, and with `truth` (row-major metres) also the ground truth
/// and the absolute error. All depth tiles share one range, taken from the truth if given, else from the dense map; the scale
/// stands in the caption. Invalid pixels are black.
///
/// # Errors
/// [`Error::SizeMismatch`] for parts of different size, [`Error::BufferLength`] for a wrong length of `truth`.
pub fn panel(
    rgb: &RgbImage,
    sparse: &SparseDepth,
    dense: &DepthMap,
    truth: Option<&[f32]>,
) -> Result<RgbImage> {
    let (w, h) = (dense.width(), dense.height());
    let frame = (rgb.width() as usize, rgb.height() as usize);
    for depth in [(w, h), (sparse.width(), sparse.height())] {
        if depth != frame {
            return Err(Error::SizeMismatch { rgb: frame, depth });
        }
    }
    let range = truth.and_then(colour::depth_range);
    let range = range
        .or_else(|| colour::depth_range(dense.depth()))
        .or_else(|| colour::depth_range(sparse.as_slice()));
    let range = range.unwrap_or((0.0, 1.0));
    let mut tiles = vec![
        Tile::new("RGB", enlarge(rgb), None),
        Tile::new("SPARSE", draw_points(rgb, sparse, range), Some((ColourMap::Depth, range, " m"))),
        Tile::new("DEPTH", depth_tile(dense.depth(), w, h, range)?, Some((ColourMap::Depth, range, " m"))),
        Tile::new(
            "CONFIDENCE",
            enlarge(&confidence_to_rgb(&known(dense), w, h)?),
            Some((ColourMap::Confidence, (0.0, 1.0), "")),
        ),
    ];
    if let Some(truth) = truth {
        check_length("ground truth", truth.len(), w * h)?;
        let error = absolute_error(dense.depth(), truth);
        let top = colour::depth_range(&error).map_or(1.0, |(_, high)| high);
        let error = enlarge(&error_to_rgb(&error, w, h, top)?);
        tiles.insert(
            3,
            Tile::new("GROUND TRUTH", depth_tile(truth, w, h, range)?, Some((ColourMap::Depth, range, " m"))),
        );
        tiles.push(Tile::new("ERROR", error, Some((ColourMap::Error, (0.0, top), " m"))));
    }
    Ok(arrange(&tiles, if truth.is_some() { 3 } else { 2 }))
}

/// Writes [`panel`] to a PNG file.
///
/// # Errors
/// As [`panel`]; [`Error::Format`] if the encoder fails, [`Error::Io`]; the file is then as it was before.
pub fn write_panel(
    path: impl AsRef<Path>,
    rgb: &RgbImage,
    sparse: &SparseDepth,
    dense: &DepthMap,
    truth: Option<&[f32]>,
) -> Result<()> {
    let path = path.as_ref();
    let mut bytes = Cursor::new(Vec::new());
    let picture = panel(rgb, sparse, dense, truth)?;
    let encoded = picture.write_to(&mut bytes, image::ImageFormat::Png);
    encoded.map_err(|e| Error::format(path, e.to_string(), "a picture that PNG can hold"))?;
    crate::files::write_whole(path, bytes.get_ref())
}

struct Tile {
    title: &'static str,
    image: RgbImage,
    /// Colour map, the values at its ends and their unit.
    legend: Option<(ColourMap, (f32, f32), &'static str)>,
}

impl Tile {
    fn new(
        title: &'static str,
        image: RgbImage,
        legend: Option<(ColourMap, (f32, f32), &'static str)>,
    ) -> Self {
        Self { title, image, legend }
    }

    fn draw(&self, canvas: &mut RgbImage, (x, y): (usize, usize)) {
        let text_y = y + (CAPTION - label::HEIGHT * TEXT_SCALE) / 2;
        label::draw(canvas, (x, text_y), self.title, TEXT_SCALE, TEXT);
        if let Some((map, (low, high), unit)) = self.legend {
            let (low, high) = (number(low), number(high) + unit);
            let right = x + self.image.width() as usize;
            let high_x = right.saturating_sub(label::width(&high, TEXT_SCALE));
            let bar = (self.image.width() as usize / 6).max(24);
            let bar_x = high_x.saturating_sub(bar + GAP);
            let low_x = bar_x.saturating_sub(label::width(&low, TEXT_SCALE) + GAP);
            label::draw(canvas, (low_x, text_y), &low, TEXT_SCALE, TEXT);
            label::draw(canvas, (high_x, text_y), &high, TEXT_SCALE, TEXT);
            for i in 0..bar {
                let colour = map.colour(i as f32 / (bar - 1) as f32);
                label::fill(canvas, (bar_x + i, text_y), (1, label::HEIGHT * TEXT_SCALE), colour);
            }
        }
        image::imageops::replace(canvas, &self.image, x as i64, (y + CAPTION) as i64);
    }
}

/// Three digits are enough to read a scale.
pub(super) fn number(value: f32) -> String {
    if value >= 10.0 {
        format!("{value:.0}")
    } else if value >= 1.0 {
        format!("{value:.1}")
    } else {
        format!("{value:.2}")
    }
}

fn arrange(tiles: &[Tile], columns: usize) -> RgbImage {
    let (w, h) = tiles.first().map_or((0, 0), |t| (t.image.width() as usize, t.image.height() as usize));
    let rows = tiles.len().div_ceil(columns);
    let (step_x, step_y) = (w + GAP, h + CAPTION + GAP);
    let size = ((columns * step_x + GAP) as u32, (rows * step_y + GAP) as u32);
    let mut canvas = RgbImage::from_pixel(size.0, size.1, BACKGROUND);
    for (i, tile) in tiles.iter().enumerate() {
        tile.draw(&mut canvas, (GAP + i % columns * step_x, GAP / 2 + i / columns * step_y));
    }
    canvas
}

fn factor(width: usize) -> usize {
    MIN_TILE.div_ceil(width.max(1))
}

/// Whole-number enlargement without smoothing, so that every pixel of a small frame stays what it is.
fn enlarge(image: &RgbImage) -> RgbImage {
    let k = factor(image.width() as usize) as u32;
    if k == 1 {
        return image.clone();
    }
    RgbImage::from_fn(image.width() * k, image.height() * k, |x, y| *image.get_pixel(x / k, y / k))
}

fn depth_tile(depth: &[f32], width: usize, height: usize, (low, high): (f32, f32)) -> Result<RgbImage> {
    Ok(enlarge(&depth_to_rgb(depth, width, height, low, high)?))
}

/// Each measurement as a disc over the dimmed frame: a single pixel would be lost when the picture is scaled down.
fn draw_points(rgb: &RgbImage, sparse: &SparseDepth, (low, high): (f32, f32)) -> RgbImage {
    let dim = |&Rgb([r, g, b]): &Rgb<u8>| {
        let grey = ((u32::from(r) + 2 * u32::from(g) + u32::from(b)) / 16) as u8;
        Rgb([grey; 3])
    };
    let mut image = enlarge(rgb);
    image.pixels_mut().for_each(|pixel| *pixel = dim(pixel));
    let k = factor(sparse.width());
    let (width, height) = (image.width() as i64, image.height() as i64);
    // Not so large that discs of neighbouring measurements cover each other.
    let spacing = ((width * height) as f64 / sparse.measured().max(1) as f64).sqrt();
    let radius = (spacing * 0.3).min(width as f64 / 200.0).max(k as f64 * 0.5);
    let reach = radius.floor() as i64;
    for (x, y, depth) in sparse.points() {
        let colour = ColourMap::Depth.colour((depth - low) / (high - low));
        let (cx, cy) = ((x * k + k / 2) as i64, (y * k + k / 2) as i64);
        for py in (cy - reach).max(0)..=(cy + reach).min(height - 1) {
            for px in (cx - reach).max(0)..=(cx + reach).min(width - 1) {
                if ((px - cx).pow(2) + (py - cy).pow(2)) as f64 <= radius * radius {
                    image.put_pixel(px as u32, py as u32, colour);
                }
            }
        }
    }
    image
}

/// Confidence with NaN instead of 0 where there is no depth, so that "none" and "not sure" look different.
fn known(dense: &DepthMap) -> Vec<f32> {
    let pairs = dense.confidence().iter().zip(dense.depth());
    pairs.map(|(&confidence, depth)| if depth.is_nan() { f32::NAN } else { confidence }).collect()
}

pub(super) fn absolute_error(depth: &[f32], truth: &[f32]) -> Vec<f32> {
    let error = |(&d, &t): (&f32, &f32)| if is_valid(d) && is_valid(t) { (d - t).abs() } else { f32::NAN };
    depth.iter().zip(truth).map(error).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parts(w: usize, h: usize) -> (RgbImage, SparseDepth, DepthMap, Vec<f32>) {
        let rgb = RgbImage::from_pixel(w as u32, h as u32, Rgb([90, 120, 60]));
        let truth: Vec<f32> = (0..w * h).map(|i| 1.0 + (i % w) as f32 * 0.1).collect();
        let sparse =
            SparseDepth::from_points(w, h, &[(2, 2, 1.2), (w - 3, h - 3, 1.0 + (w - 3) as f32 * 0.1)])
                .unwrap();
        let depth = truth.iter().map(|t| t * 1.1).collect();
        let dense =
            DepthMap::new(w, h, depth, vec![0.8; w * h], vec![0.1; w * h], vec![false; w * h]).unwrap();
        (rgb, sparse, dense, truth)
    }

    #[test]
    fn tiles_have_their_place_and_share_one_range() {
        let (rgb, sparse, dense, truth) = parts(400, 40);
        let four = panel(&rgb, &sparse, &dense, None).unwrap();
        assert_eq!(four.dimensions(), ((2 * 408 + 8) as u32, (2 * 72 + 8) as u32));
        let six = panel(&rgb, &sparse, &dense, Some(&truth)).unwrap();
        assert_eq!(six.width(), (3 * 408 + 8) as u32);
        assert_eq!(six.get_pixel(8 + 100, 4 + 24 + 20), rgb.get_pixel(100, 20));
        let (low, high) = colour::depth_range(&truth).unwrap();
        let shown = depth_to_rgb(dense.depth(), 400, 40, low, high).unwrap();
        assert_eq!(six.get_pixel(8 + 2 * 408 + 200, 4 + 24 + 10), shown.get_pixel(200, 10));
    }

    #[test]
    fn measurements_can_be_seen() {
        let (rgb, sparse, dense, truth) = parts(640, 48);
        let picture = panel(&rgb, &sparse, &dense, Some(&truth)).unwrap();
        let colourful = |x: u32, y: u32| {
            let Rgb([r, g, b]) = *picture.get_pixel(x, y);
            r.abs_diff(g) > 8 || g.abs_diff(b) > 8
        };
        let (left, top) = (8 + 648, 4 + 24);
        let drawn = (top..top + 48)
            .flat_map(|y| (left..left + 640).map(move |x| (x, y)))
            .filter(|&(x, y)| colourful(x, y))
            .count();
        assert!((20..200).contains(&drawn), "{drawn} pixels for two points");
    }

    #[test]
    fn small_and_empty_frames_work() {
        let (rgb, sparse, dense, truth) = parts(6, 5);
        assert!(panel(&rgb, &sparse, &dense, Some(&truth)).unwrap().width() >= 3 * 320);
        let none = SparseDepth::new(6, 5, vec![0.0; 30]).unwrap();
        let invalid =
            DepthMap::new(6, 5, vec![0.0; 30], vec![0.0; 30], vec![0.0; 30], vec![false; 30]).unwrap();
        assert!(panel(&rgb, &none, &invalid, None).is_ok());
        assert!(panel(&rgb, &none, &invalid, Some(&[f32::NAN; 30])).is_ok());
    }

    #[test]
    fn bad_sizes_are_refused_and_nothing_is_written() {
        let (rgb, sparse, dense, truth) = parts(12, 10);
        let other = RgbImage::new(10, 12);
        assert!(matches!(panel(&other, &sparse, &dense, None), Err(Error::SizeMismatch { .. })));
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("p.png");
        assert!(matches!(
            write_panel(&path, &rgb, &sparse, &dense, Some(&truth[1..])),
            Err(Error::BufferLength { .. })
        ));
        assert!(!path.exists());
        write_panel(&path, &rgb, &sparse, &dense, Some(&truth)).unwrap();
        assert_eq!(
            image::open(&path).unwrap().to_rgb8(),
            panel(&rgb, &sparse, &dense, Some(&truth)).unwrap()
        );
    }
}
