//! Several methods beside each other, on one common colour scale: the paper's Fig. 1, 4 and 5.

use std::io::Cursor;
use std::path::Path;

use image::imageops::{FilterType, replace, resize};
use image::{Rgb, RgbImage};

use super::colour::{ColourMap, depth_to_rgb, error_to_rgb};
use super::preview::{BACKGROUND, CAPTION, GAP, TEXT, TEXT_SCALE, absolute_error, number};
use super::{colour, label};
use crate::depth::SparseDepth;
use crate::depth::pixels::check_length;
use crate::error::{Error, Result};

/// Values written beside a legend's bar.
const TICKS: usize = 5;

/// One frame with the results of several methods.
///
/// The first row shows the picture, the measurements, the ground truth and a legend; below, each method has its map and, under it,
/// its absolute error. All depth shares one range, from the ground truth; all errors share one, up to the 95th percentile over all
/// methods. Invalid pixels are black.
#[derive(Debug, Clone, Copy)]
pub struct Comparison<'a> {
    /// The picture.
    pub rgb: &'a RgbImage,
    /// What was measured.
    pub sparse: &'a SparseDepth,
    /// Ground truth, metres, row-major; values that are not finite and above 0 are unknown.
    pub truth: &'a [f32],
    /// Names and dense maps (metres, row-major) of the methods.
    pub methods: &'a [(String, Vec<f32>)],
    /// Width of one picture in the figure, pixels; its height follows.
    pub tile_width: usize,
}

impl Comparison<'_> {
    /// Draws the figure.
    ///
    /// # Errors
    /// [`Error::SizeMismatch`] if picture and measurements differ in size, [`Error::BufferLength`] for a map of a wrong length,
    /// [`Error::Argument`] without methods or for a tile of under 64 or over 4096 pixels.
    pub fn draw(&self) -> Result<RgbImage> {
        self.check()?;
        let range = colour::depth_range(self.truth).or_else(|| colour::depth_range(self.sparse.as_slice()));
        let range = range.unwrap_or((0.0, 1.0));
        let errors: Vec<Vec<f32>> =
            self.methods.iter().map(|(_, depth)| absolute_error(depth, self.truth)).collect();
        let top = percentile_95(errors.iter().flatten().copied().filter(|e| !e.is_nan()).collect());
        let (width, height) = self.tile();
        let columns = self.methods.len().max(4);
        let (step_x, step_y) = (width + GAP, height + CAPTION);
        let size = (columns * step_x + GAP, step_y + 2 * (step_y + GAP / 2) + 2 * GAP);
        let mut canvas = RgbImage::from_pixel(size.0 as u32, size.1 as u32, BACKGROUND);
        let depth = |values: &[f32]| depth_to_rgb(&self.shown(values), width, height, range.0, range.1);
        let frame = resize(self.rgb, width as u32, height as u32, FilterType::Triangle);
        let first = [
            ("RGB".to_string(), frame.clone()),
            (format!("{} MEASURED", self.sparse.measured()), self.points(frame, range)),
            ("GROUND TRUTH".to_string(), depth(self.truth)?),
        ];
        for (column, (title, image)) in first.iter().enumerate() {
            tile(&mut canvas, (GAP + column * step_x, 0), title, image);
        }
        let legend_x = GAP + 3 * step_x;
        legend(&mut canvas, (legend_x, CAPTION), (width, height), range, top);
        for (column, ((name, map), error)) in self.methods.iter().zip(&errors).enumerate() {
            let x = GAP + column * step_x;
            tile(&mut canvas, (x, step_y + GAP / 2), &name.to_uppercase(), &depth(map)?);
            let error = error_to_rgb(&self.shown(error), width, height, top)?;
            tile(&mut canvas, (x, 2 * step_y + GAP), "ERROR", &error);
        }
        Ok(canvas)
    }

    /// Writes the figure as PNG.
    ///
    /// # Errors
    /// As [`Comparison::draw`]; [`Error::Format`] if the encoder fails, [`Error::Io`]; the file is then as it was before.
    pub fn write(&self, path: impl AsRef<Path>) -> Result<()> {
        let (path, mut bytes) = (path.as_ref(), Cursor::new(Vec::new()));
        let encoded = self.draw()?.write_to(&mut bytes, image::ImageFormat::Png);
        encoded.map_err(|e| Error::format(path, e.to_string(), "a picture that PNG can hold"))?;
        crate::files::write_whole(path, bytes.get_ref())
    }

    fn check(&self) -> Result<()> {
        let frame = (self.rgb.width() as usize, self.rgb.height() as usize);
        let depth = (self.sparse.width(), self.sparse.height());
        if frame != depth {
            return Err(Error::SizeMismatch { rgb: frame, depth });
        }
        check_length("ground truth", self.truth.len(), frame.0 * frame.1)?;
        for (_, map) in self.methods {
            check_length("map of a method", map.len(), frame.0 * frame.1)?;
        }
        if self.methods.is_empty() {
            return Err(Error::argument("methods", 0, "at least one method to show"));
        }
        if !(64..=4096).contains(&self.tile_width) {
            return Err(Error::argument("tile width", self.tile_width, "64 to 4096 pixels"));
        }
        Ok(())
    }

    /// Width and height of a tile.
    fn tile(&self) -> (usize, usize) {
        let ratio = self.sparse.height() as f64 / self.sparse.width() as f64;
        (self.tile_width, ((self.tile_width as f64 * ratio).round() as usize).clamp(1, 8192))
    }

    /// The values at a tile's pixels, unmixed: a mean over a depth edge would show a depth that no method gave.
    fn shown(&self, values: &[f32]) -> Vec<f32> {
        let (width, height) = self.tile();
        let source = |i: usize| {
            let x = (2 * (i % width) + 1) * self.sparse.width() / (2 * width);
            let y = (2 * (i / width) + 1) * self.sparse.height() / (2 * height);
            values[y * self.sparse.width() + x]
        };
        (0..width * height).map(source).collect()
    }

    /// Each measurement as a square over the dimmed picture: a single pixel would be lost.
    fn points(&self, mut image: RgbImage, (low, high): (f32, f32)) -> RgbImage {
        for Rgb(pixel) in image.pixels_mut() {
            *pixel = [(pixel.iter().map(|&c| u32::from(c)).sum::<u32>() / 12) as u8; 3];
        }
        let (width, height) = self.tile();
        // Not so large that squares of neighbouring measurements cover each other.
        let spacing = ((width * height) as f64 / self.sparse.measured().max(1) as f64).sqrt();
        let side = ((spacing * 0.5) as usize).clamp(1, 1 + width / 120);
        for (x, y, depth) in self.sparse.points() {
            let centre = |i: usize, of: usize, to: usize| (2 * i + 1) * to / (2 * of);
            let left = centre(x, self.sparse.width(), width).saturating_sub(side / 2);
            let top = centre(y, self.sparse.height(), height).saturating_sub(side / 2);
            let colour = ColourMap::Depth.colour((depth - low) / (high - low));
            label::fill(&mut image, (left, top), (side, side), colour);
        }
        image
    }
}

/// A title with a picture below it.
fn tile(canvas: &mut RgbImage, (x, y): (usize, usize), title: &str, image: &RgbImage) {
    // Names of checkpoints may be long; the small letters then.
    let scale = if label::width(title, TEXT_SCALE) <= image.width() as usize { TEXT_SCALE } else { 1 };
    label::draw(canvas, (x, y + (CAPTION - label::HEIGHT * scale) / 2), title, scale, TEXT);
    replace(canvas, image, x as i64, (y + CAPTION) as i64);
}

/// Two bars with their values: depth and error.
fn legend(
    canvas: &mut RgbImage,
    (x, y): (usize, usize),
    (width, height): (usize, usize),
    range: (f32, f32),
    top: f32,
) {
    let bars = [("DEPTH m", ColourMap::Depth, range), ("ERROR m", ColourMap::Error, (0.0, top))];
    let (letter, thickness) = (label::HEIGHT * TEXT_SCALE, (height / 8).max(6));
    for (row, (title, map, (low, high))) in bars.into_iter().enumerate() {
        let y = y + row * height / 2 + GAP;
        label::draw(canvas, (x, y), title, TEXT_SCALE, TEXT);
        let bar_y = y + letter + GAP / 2;
        for i in 0..width {
            let colour = map.colour(i as f32 / (width - 1) as f32);
            label::fill(canvas, (x + i, bar_y), (1, thickness), colour);
        }
        for tick in 0..TICKS {
            let share = tick as f32 / (TICKS - 1) as f32;
            let text = number(low + (high - low) * share);
            let text_width = label::width(&text, 1);
            let centre = (share * (width - 1) as f32) as usize;
            let left = centre.saturating_sub(text_width / 2).min(width.saturating_sub(text_width));
            label::draw(canvas, (x + left, bar_y + thickness + 3), &text, 1, TEXT);
        }
    }
}

fn percentile_95(mut values: Vec<f32>) -> f32 {
    if values.is_empty() {
        return 1.0;
    }
    let place = (values.len() - 1) * 95 / 100;
    let top = *values.select_nth_unstable_by(place, f32::total_cmp).1;
    // A perfect map still needs a range to be painted in.
    if top > 0.0 { top } else { 1e-3 }
}

#[cfg(test)]
mod tests {
    use super::*;

    type Parts = (RgbImage, SparseDepth, Vec<f32>, Vec<(String, Vec<f32>)>);

    fn parts(w: usize, h: usize) -> Parts {
        let rgb = RgbImage::from_pixel(w as u32, h as u32, Rgb([90, 120, 60]));
        let truth: Vec<f32> = (0..w * h).map(|i| 1.0 + (i % w) as f32 * 0.1).collect();
        let sparse = SparseDepth::from_points(w, h, &[(1, 1, 1.1), (w - 2, h - 2, 2.0)]).unwrap();
        let methods =
            (1..=5).map(|k| (format!("method-{k}"), truth.iter().map(|t| t + 0.1 * k as f32).collect()));
        (rgb, sparse, truth.clone(), methods.collect())
    }

    #[test]
    fn tiles_stand_in_their_columns_and_share_scales() {
        let (rgb, sparse, truth, methods) = parts(100, 50);
        let figure =
            Comparison { rgb: &rgb, sparse: &sparse, truth: &truth, methods: &methods, tile_width: 100 };
        let picture = figure.draw().unwrap();
        assert_eq!(picture.width(), 5 * 108 + 8);
        let at = |column: u32, top: u32, x: u32| *picture.get_pixel(8 + column * 108 + x, top + 24 + 20);
        assert_eq!(at(0, 0, 30), Rgb([90, 120, 60]));
        let (low, high) = colour::depth_range(&truth).unwrap();
        let expected = depth_to_rgb(&truth, 100, 50, low, high).unwrap();
        assert_eq!(at(2, 0, 30), *expected.get_pixel(30, 20));
        let map = depth_to_rgb(&methods[3].1, 100, 50, low, high).unwrap();
        assert_eq!(at(3, 74 + 4, 30), *map.get_pixel(30, 20));
        // The largest error of all methods, 0.5 m, is the top of the scale; the first method is a fifth of the way.
        assert_eq!(at(4, 2 * 74 + 8, 30), ColourMap::Error.colour(1.0));
        assert_eq!(at(0, 2 * 74 + 8, 30), ColourMap::Error.colour(0.2));
    }

    #[test]
    fn any_size_is_scaled_to_the_tile() {
        for (w, h) in [(3, 3), (640, 48), (10, 300)] {
            let (rgb, sparse, truth, methods) = parts(w, h);
            let figure = Comparison {
                rgb: &rgb,
                sparse: &sparse,
                truth: &truth,
                methods: &methods[..1],
                tile_width: 80,
            };
            assert_eq!(figure.draw().unwrap().width(), 4 * 88 + 8, "room for the legend beside three tiles");
        }
    }

    #[test]
    fn unknown_truth_and_bad_parts() {
        let (rgb, sparse, truth, methods) = parts(20, 10);
        let good =
            Comparison { rgb: &rgb, sparse: &sparse, truth: &truth, methods: &methods, tile_width: 64 };
        let unknown = vec![f32::NAN; 200];
        assert!(Comparison { truth: &unknown, ..good }.draw().is_ok());
        let refused = |figure: Comparison| figure.draw().unwrap_err();
        let other = RgbImage::new(10, 20);
        assert!(matches!(refused(Comparison { rgb: &other, ..good }), Error::SizeMismatch { .. }));
        assert!(matches!(refused(Comparison { truth: &truth[1..], ..good }), Error::BufferLength { .. }));
        assert!(matches!(refused(Comparison { methods: &[], ..good }), Error::Argument { .. }));
        assert!(matches!(refused(Comparison { tile_width: 0, ..good }), Error::Argument { .. }));
        let short = vec![("a".to_string(), vec![1.0; 3])];
        assert!(matches!(refused(Comparison { methods: &short, ..good }), Error::BufferLength { .. }));
        let dir = tempfile::tempdir().unwrap();
        good.write(dir.path().join("f.png")).unwrap();
        assert_eq!(image::open(dir.path().join("f.png")).unwrap().to_rgb8(), good.draw().unwrap());
    }
}
