//! Clouds from and to files, by the ending of their name.

use std::path::Path;

use super::points::PointCloud;
use super::{pcd, ply, velodyne};
use crate::error::Result;
use crate::files::{extension, read_within, unknown_extension, write_whole};

/// Bytes of a file, at most: a hundred million points.
const LARGEST: u64 = 1 << 31;

impl PointCloud {
    /// Reads a file.
    ///
    /// | ending | what is read |
    /// |---|---|
    /// | `.pcd` | Point Cloud Library, version 0.7: ASCII, binary, compressed; organised or not |
    /// | `.ply` | ASCII, binary of either byte order; the element `vertex`, whose lists are skipped |
    /// | `.bin` | KITTI's Velodyne scans: x, y, z, reflectance as f32 |
    ///
    /// Fields may stand in any order; read are x, y, z (metres, any number type, rounded to f32), normals (`nx` or `normal_x`), colours
    /// (`red` or `r` and so on, 8 bits; PCL's packed `rgb`) and `confidence`. Others are skipped, a PCD's viewpoint too: points
    /// stay in the frame in which they are stored.
    ///
    /// # Errors
    /// [`crate::Error::Io`]; [`crate::Error::Format`] for a damaged file, one without x, y, z, one beyond 2 GiB and an unknown ending.
    pub fn read(path: impl AsRef<Path>) -> Result<Self> {
        let path = path.as_ref();
        let decode: fn(&[u8], &Path) -> Result<Self> = match extension(path).as_str() {
            "pcd" => pcd::decode,
            "ply" => ply::decode,
            "bin" => velodyne::decode,
            other => return Err(unknown_extension(path, other, "pcd, ply or bin")),
        };
        decode(&read_within(path, LARGEST)?, path)
    }

    /// Writes `.ply` (binary, little-endian) or `.pcd` (binary), with the parts that there are: points, normals, colours (PCD: packed into
    /// `rgb`, as PCL does) and `confidence`, all numbers as f32.
    ///
    /// # Errors
    /// [`crate::Error::BufferLength`] for a part without an entry per point, [`crate::Error::Format`] for another ending, [`crate::Error::Io`]; the file is
    /// then as it was before.
    pub fn write(&self, path: impl AsRef<Path>) -> Result<()> {
        let path = path.as_ref();
        self.check()?;
        let bytes = match extension(path).as_str() {
            "pcd" => pcd::encode(self),
            "ply" => ply::encode(self),
            other => return Err(unknown_extension(path, other, "pcd or ply")),
        };
        write_whole(path, &bytes)
    }
}
