//! Points and what is known of each.

use crate::depth::pixels::check_length;
use crate::error::Result;

/// Points in space, metres, in whatever frame their maker says: that of a LiDAR for most files, that of the camera (x right, y
/// down, z forward) for [`PointCloud::from_map`].
///
/// Each of the other parts, if it is there, has one entry per point; that is checked when the cloud is written.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct PointCloud {
    /// x, y, z, metres. Organised files mark a missing point with NaN; such points stay.
    pub points: Vec<[f32; 3]>,
    /// Red, green, blue.
    pub colours: Option<Vec<[u8; 3]>>,
    /// Unit normals, NaN where there is none.
    pub normals: Option<Vec<[f32; 3]>>,
    /// Confidence in 0..=1.
    pub confidence: Option<Vec<f32>>,
}

impl PointCloud {
    /// Number of points.
    pub fn len(&self) -> usize {
        self.points.len()
    }

    /// Whether there is no point.
    pub fn is_empty(&self) -> bool {
        self.points.is_empty()
    }

    /// Fails unless every part has an entry per point.
    pub(crate) fn check(&self) -> Result<()> {
        let length =
            |what, part: Option<usize>| part.map_or(Ok(()), |n| check_length(what, n, self.points.len()));
        length("colours", self.colours.as_ref().map(Vec::len))?;
        length("normals", self.normals.as_ref().map(Vec::len))?;
        length("confidence", self.confidence.as_ref().map(Vec::len))
    }
}
