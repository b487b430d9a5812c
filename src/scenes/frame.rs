//! A rendered frame: a picture with the depth of its pixels.

use crate::depth::Intrinsics;
use image::RgbImage;

/// An RGB image with the depth of every pixel.
#[derive(Clone, Debug)]
pub struct RgbdFrame {
    /// 8-bit sRGB-like picture.
    pub rgb: RgbImage,
    /// Exact Z-depth, metres, row-major, `width * height` values; NaN where nothing returns (sky). Where [`RgbdFrame::glass`] is
    /// set, a pane's is its own, whatever is seen through it; the glass of furnished rooms has none, what is behind it has.
    pub depth: Vec<f32>,
    /// The camera.
    pub intrinsics: Intrinsics,
    /// What panes of glass make of it; `None` where a sensor sees what [`RgbdFrame::depth`] says.
    pub glass: Option<Glass>,
}

/// What panes of glass make of a frame's depth. All maps are row-major and of the frame's size.
#[derive(Clone, Debug)]
pub struct Glass {
    /// Pixels that show a pane.
    pub pane: Vec<bool>,
    /// Z-depth without panes, metres; NaN where nothing returns. Elsewhere than at panes it is the frame's depth.
    pub behind: Vec<f32>,
    /// Z-depth as a sensor without other faults sees it, metres: at a pane what is behind it, the pane itself, what is mirrored
    /// in it, or nothing (NaN). Elsewhere it is the frame's depth.
    pub sensed: Vec<f32>,
}

/// Depths of cast rays in metres, `scale` times as large as built; those that hit nothing are NaN.
pub(super) fn metres(depths: &[f32], scale: f32) -> Vec<f32> {
    depths.iter().map(|&t| if t.is_finite() { t * scale } else { f32::NAN }).collect()
}

impl RgbdFrame {
    /// Columns.
    pub fn width(&self) -> usize {
        self.rgb.width() as usize
    }

    /// Rows.
    pub fn height(&self) -> usize {
        self.rgb.height() as usize
    }

    /// What a depth sensor without faults of its own sees, metres, row-major; NaN where nothing returns. Measurements are drawn
    /// from here, true answers from [`RgbdFrame::depth`].
    pub fn sensed(&self) -> &[f32] {
        self.glass.as_ref().map_or(&self.depth, |glass| &glass.sensed)
    }

    /// Makes it its mirror image, left for right.
    pub fn mirror(&mut self) {
        let width = self.width();
        image::imageops::flip_horizontal_in_place(&mut self.rgb);
        self.depth.chunks_mut(width).for_each(<[f32]>::reverse);
        if let Some(glass) = &mut self.glass {
            glass.pane.chunks_mut(width).for_each(<[bool]>::reverse);
            glass.behind.chunks_mut(width).for_each(<[f32]>::reverse);
            glass.sensed.chunks_mut(width).for_each(<[f32]>::reverse);
        }
        self.intrinsics.cx = (width - 1) as f32 - self.intrinsics.cx;
    }
}
