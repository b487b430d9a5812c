//! A mark drawn into the image at the pixel that is asked for.
//!
//! Source: DepthLM (arXiv 2509.25413), section on visual prompting, and its published code
//! (github.com/facebookresearch/DepthLM_Official, `utils/datasets.py` at 13cebf4): a pure red arrow `-->` of five pixels
//! whose tip is the pixel to the left of the one that is meant, one pixel wide, drawn before the image processor resizes.

use crate::error::{Error, Result};
use image::{Rgb, RgbImage};

/// What a mark looks like.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum MarkerShape {
    /// DepthLM's: points at the pixel from the left, and does not cover it.
    #[default]
    Arrow,
    /// Four strokes towards the pixel, which stays free.
    Cross,
    /// A filled disc over the pixel.
    Disc,
}

/// The mark that a query draws. The default is DepthLM's.
#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(default)]
pub struct Marker {
    /// Its form.
    pub shape: MarkerShape,
    /// Length of the arrow or of a stroke, or radius of the disc, in pixels of the frame (not of the resized image).
    pub size: usize,
    /// Red, green and blue.
    pub colour: [u8; 3],
}

impl Default for Marker {
    fn default() -> Self {
        Self { shape: MarkerShape::Arrow, size: 5, colour: [255, 0, 0] }
    }
}

/// Largest size of a mark, pixels.
const MAX_SIZE: usize = 256;

impl Marker {
    /// Checks what can be checked without an image.
    ///
    /// # Errors
    /// [`Error::Config`] names the field of `sdim.json`.
    #[doc(hidden)]
    pub fn validate(&self, file: &str) -> Result<()> {
        if (1..=MAX_SIZE).contains(&self.size) {
            return Ok(());
        }
        let expected = format!("1 to {MAX_SIZE} pixels");
        Err(Error::config(file, "pixel_reference.size", self.size.to_string(), expected))
    }

    /// Checks that the mark fits into a frame wherever it points.
    ///
    /// # Errors
    /// [`Error::Config`] if the frame is smaller than twice the mark and one pixel.
    #[doc(hidden)]
    pub fn fits(&self, file: &str, width: usize, height: usize) -> Result<()> {
        if width.min(height) > 2 * self.size {
            return Ok(());
        }
        let expected = format!("a mark that fits twice into each side of the {width}x{height} frame");
        Err(Error::config(file, "pixel_reference.size", self.size.to_string(), expected))
    }

    /// Draws the mark for the pixel (`x`, `y`).
    ///
    /// What would fall outside the image is left out. DepthLM never asks pixels at the left border, where its arrow has no
    /// room; here the arrow then comes from the right.
    #[doc(hidden)]
    pub fn draw(&self, image: &mut RgbImage, x: usize, y: usize) {
        let size = self.size as i64;
        let mut put = |dx: i64, dy: i64| {
            let (px, py) = (x as i64 + dx, y as i64 + dy);
            let inside =
                px >= 0 && py >= 0 && px < i64::from(image.width()) && py < i64::from(image.height());
            if inside {
                image.put_pixel(px as u32, py as u32, Rgb(self.colour));
            }
        };
        match self.shape {
            MarkerShape::Arrow => {
                let side = if x < self.size { 1 } else { -1 };
                (1..=size).for_each(|d| put(side * d, 0));
                for d in 1..=size / 2 {
                    put(side * (d + 1), d);
                    put(side * (d + 1), -d);
                }
            }
            MarkerShape::Cross => {
                for d in 1..=size {
                    [(d, 0), (-d, 0), (0, d), (0, -d)].into_iter().for_each(|(dx, dy)| put(dx, dy));
                }
            }
            MarkerShape::Disc => {
                for dy in -size..=size {
                    let inside = |dx: &i64| dx * dx + dy * dy <= size * size;
                    (-size..=size).filter(inside).for_each(|dx| put(dx, dy));
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn drawn(marker: Marker, x: usize, y: usize) -> Vec<String> {
        let mut image = RgbImage::from_pixel(13, 9, Rgb([9, 9, 9]));
        marker.draw(&mut image, x, y);
        let rows = (0..9).map(|y| {
            let cell = |x| if image.get_pixel(x, y).0 == marker.colour { '#' } else { '.' };
            (0..13).map(cell).collect::<String>()
        });
        rows.collect()
    }

    #[test]
    fn the_arrow_is_depthlms() {
        // Shaft at x - 1 to x - 5, head at (x - 2, y +- 1) and (x - 3, y +- 2).
        let want = [
            ".............",
            ".............",
            ".....#.......",
            "......#......",
            "...#####.....",
            "......#......",
            ".....#.......",
            ".............",
            ".............",
        ];
        assert_eq!(drawn(Marker::default(), 8, 4), want);
    }

    #[test]
    fn an_arrow_without_room_comes_from_the_right() {
        let rows = drawn(Marker::default(), 2, 0);
        assert_eq!(rows[0], "...#####.....");
        assert_eq!((rows[1].as_str(), rows[2].as_str()), ("....#........", ".....#......."));
    }

    #[test]
    fn crosses_and_discs_are_centred_and_cut_at_the_border() {
        let cross = drawn(Marker { shape: MarkerShape::Cross, size: 2, ..Marker::default() }, 12, 4);
        assert_eq!(cross[4], "..........##.");
        assert_eq!(cross.concat().matches('#').count(), 6);
        let disc = drawn(Marker { shape: MarkerShape::Disc, size: 2, colour: [0, 255, 0] }, 6, 4);
        assert_eq!((disc[2].as_str(), disc[4].as_str()), ("......#......", "....#####...."));
        assert_eq!(disc.concat().matches('#').count(), 13);
    }

    #[test]
    fn a_mark_has_a_size_and_fits_into_the_frame() {
        let of = |size| Marker { size, ..Marker::default() };
        for bad in [0, 257] {
            let error = of(bad).validate("f").unwrap_err().to_string();
            assert!(error.contains("pixel_reference.size"), "{error}");
        }
        assert!(of(5).fits("f", 11, 40).is_ok() && of(6).fits("f", 40, 12).is_err());
    }
}
