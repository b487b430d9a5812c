//! Frames that follow each other: what the last map says need not be asked again.

mod latest;
mod picture;
mod warp;

pub use latest::{Latest, LatestFrames};

use crate::complete::{CancelToken, CompleteOptions, Completion, DepthCompleter, Prior};
use crate::depth::{Camera, DepthMap, SparseDepth, Transform};
use crate::error::{Error, Result};
use image::RgbImage;
use picture::Blocks;
use warp::Ageing;

/// How a stream of frames is completed.
#[derive(Debug, Clone)]
#[non_exhaustive]
pub struct StreamOptions {
    /// How each frame is completed.
    pub complete: CompleteOptions,
    /// The camera of the pictures, which poses need; `None` for a stream without poses.
    pub camera: Option<Camera>,
    /// After so many frames an answer that nothing has confirmed has half of its confidence and twice its expected error left. What is
    /// unsure is asked again, so that nothing lives for ever.
    pub half_life: f32,
    /// So many frames in a row may be made of the last map and their measurements alone, without encoding, prefill and questions, where the last
    /// map covers them and no measurement contradicts it; 0 to ask about each frame.
    pub rest: usize,
}

impl Default for StreamOptions {
    fn default() -> Self {
        Self { complete: CompleteOptions::default(), camera: None, half_life: 12.0, rest: 1 }
    }
}

impl StreamOptions {
    /// With frames completed this way.
    pub fn with_complete(mut self, complete: CompleteOptions) -> Self {
        self.complete = complete;
        self
    }

    /// With poses of this camera.
    pub fn with_camera(mut self, camera: Camera) -> Self {
        self.camera = Some(camera);
        self
    }

    /// With answers that count half after so many frames.
    pub fn with_half_life(mut self, frames: f32) -> Self {
        self.half_life = frames;
        self
    }

    /// With so many frames in a row that may do without the model.
    pub fn with_rest(mut self, frames: usize) -> Self {
        self.rest = frames;
        self
    }
}

/// Completes frames that follow each other: the map of one frame, moved as the camera has moved, is what the next one is expected to be.
///
/// Pixels are asked where nothing is expected (what comes into view), where a measurement, the picture or an answer contradicts, at depth edges,
/// where the expectation is unsure or old, and on a coarse lattice everywhere, another one in each frame, as a check. Elsewhere what is expected
/// stands for answers, beside the new ones, before alignment, filter and filling. The first frame is completed alone.
///
/// Encoding and prefill are those of a single frame, and no question saves them. A frame may do without them where the last map covers it and
/// its measurements agree with that ([`StreamOptions::rest`]): it is the moved map, aligned to its measurements, and what is filled in it is
/// asked about next.
///
/// A stream holds one map and one small picture, whatever it has seen. The same frames give the same maps, deadlines excepted. It belongs to one
/// thread at a time; streams on several threads share one model by clones of its [`DepthCompleter`].
///
/// ```
/// use sdim::{DepthCompleter, RgbImage, SparseDepth, Stream, StreamOptions};
/// # #[cfg(feature = "tiny")] {
/// let mut stream = Stream::new(DepthCompleter::tiny()?, StreamOptions::default())?;
/// let rgb = RgbImage::new(64, 48);
/// let sparse = SparseDepth::from_points(64, 48, &[(5, 5, 2.0), (60, 8, 2.5), (30, 40, 1.2)])?;
/// let first = stream.push(&rgb, &sparse, None)?;
/// let second = stream.push(&rgb, &sparse, None)?; // the same picture: little is asked
/// assert!(second.asked < first.asked);
/// # }
/// # Ok::<(), sdim::Error>(())
/// ```
pub struct Stream {
    completer: DepthCompleter,
    options: StreamOptions,
    last: Option<Last>,
    /// Frames that were asked about since the last one that was completed alone.
    turn: usize,
    /// Frames since the last one that was asked about.
    rested: usize,
}

/// What is kept of a frame.
struct Last {
    map: DepthMap,
    blocks: Blocks,
    pose: Option<Transform>,
}

impl Stream {
    /// A stream without frames.
    ///
    /// # Errors
    /// [`Error::Argument`] for a half-life that is not a finite number above 0.
    pub fn new(completer: DepthCompleter, options: StreamOptions) -> Result<Self> {
        if !(options.half_life.is_finite() && options.half_life > 0.0) {
            return Err(Error::argument("half_life", options.half_life, "a finite number of frames above 0"));
        }
        Ok(Self { completer, options, last: None, turn: 0, rested: 0 })
    }

    /// Completes the next frame. `pose` is the camera's place and attitude in a fixed frame, metres: "camera to world", which takes points in the
    /// camera's axes (x right, y down, z forward) to those of the world. Any world will do as long as it stays the same.
    ///
    /// Without a pose, here or in the frame before, the last map counts where the picture is as it was. A frame of another size begins anew.
    /// A frame that fails changes nothing: the next one follows the last that did not. Nor does one whose deadline left no time for any question:
    /// it is the interpolation of its measurements.
    ///
    /// # Errors
    /// [`Error::Argument`] for a pose where the options hold no camera, and for a camera of another size than the frame's; as
    /// [`DepthCompleter::complete`].
    pub fn push(
        &mut self,
        rgb: &RgbImage,
        sparse: &SparseDepth,
        pose: Option<&Transform>,
    ) -> Result<Completion> {
        let size = (rgb.width() as usize, rgb.height() as usize);
        match (pose, &self.options.camera) {
            (Some(_), None) => {
                let expected = "none, or a camera in the stream's options";
                return Err(Error::argument("pose", "a pose", expected));
            }
            (Some(_), Some(camera)) => camera.require_size("camera", "the frame's size", size)?,
            (None, _) => {}
        }
        let blocks = Blocks::new(rgb);
        let prior = self.expected(&blocks, size, pose);
        if let Some(prior) = prior.as_ref().filter(|_| self.rested < self.options.rest)
            && let Some(done) = self.completer.carry(rgb, sparse, &self.options.complete, prior)?
        {
            self.rested += 1;
            self.last = Some(Last { map: done.map.clone(), blocks, pose: pose.copied() });
            return Ok(done);
        }
        let done = self.completer.complete_after(rgb, sparse, &self.options.complete, prior.as_ref())?;
        // What is only interpolated is no map to go on from.
        if done.interpolated {
            return Ok(done);
        }
        self.rested = 0;
        self.turn = if prior.is_some() { self.turn.wrapping_add(1) } else { 0 };
        self.last = Some(Last { map: done.map.clone(), blocks, pose: pose.copied() });
        Ok(done)
    }

    /// Forgets all frames: the next one is completed alone.
    pub fn reset(&mut self) {
        self.last = None;
        (self.turn, self.rested) = (0, 0);
    }

    /// Has the frames that follow stopped by this token; `None` for by nothing.
    pub fn set_cancel(&mut self, cancel: Option<CancelToken>) {
        self.options.complete.cancel = cancel;
    }

    /// What the next frame is expected to be.
    fn expected(&self, blocks: &Blocks, size: (usize, usize), pose: Option<&Transform>) -> Option<Prior> {
        let last = self.last.as_ref().filter(|last| (last.map.width(), last.map.height()) == size)?;
        let ageing = Ageing::half_life(self.options.half_life);
        let motion = match (&last.pose, pose, &self.options.camera) {
            (Some(before), Some(now), Some(camera)) if before != now => {
                Some((camera, before.then(&now.inverse())))
            }
            _ => None,
        };
        Some(match motion {
            Some((camera, motion)) => {
                warp::moved(&last.map, (&last.blocks, blocks), (camera, &motion), ageing, self.turn)
            }
            None => warp::stay(&last.map, &last.blocks, blocks, ageing, self.turn),
        })
    }
}

#[cfg(all(test, feature = "tiny"))]
mod tests {
    use super::*;
    use crate::query::QueryPlan;

    #[test]
    fn what_is_held_does_not_grow() {
        let complete = CompleteOptions::default().with_plan(QueryPlan::Stride(8));
        let options = StreamOptions::default().with_complete(complete);
        let mut stream = Stream::new(DepthCompleter::tiny().unwrap(), options).unwrap();
        for i in 0..6u8 {
            let rgb = RgbImage::from_pixel(64, 48, image::Rgb([40 + i; 3]));
            let sparse = SparseDepth::from_points(64, 48, &[(5 + usize::from(i), 5, 2.0)]).unwrap();
            stream.push(&rgb, &sparse, None).unwrap();
            let last = stream.last.as_ref().unwrap();
            assert_eq!((last.map.depth().len(), last.blocks.len()), (64 * 48, 16 * 12));
        }
        stream.reset();
        assert!(stream.last.is_none());
    }
}
