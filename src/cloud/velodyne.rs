//! KITTI's `.bin` files: x, y, z and reflectance of each point as little-endian f32, without a header (Geiger et al., "Vision
//! meets Robotics: The KITTI Dataset", 2013).

use std::path::Path;

use super::points::PointCloud;
use crate::error::{Error, Result};

const RECORD: usize = 16;

pub(super) fn decode(bytes: &[u8], path: &Path) -> Result<PointCloud> {
    let (records, rest) = bytes.as_chunks::<RECORD>();
    if !rest.is_empty() {
        let expected = format!("a multiple of {RECORD}: x, y, z and reflectance as f32");
        return Err(Error::format(path, format!("{} bytes", bytes.len()), expected));
    }
    let number = |record: &[u8; RECORD], at: usize| {
        f32::from_le_bytes([record[at], record[at + 1], record[at + 2], record[at + 3]])
    };
    let points = records.iter().map(|record| [0, 4, 8].map(|at| number(record, at))).collect();
    Ok(PointCloud { points, ..PointCloud::default() })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn points_without_their_reflectance() {
        let bytes: Vec<u8> =
            [1.0f32, -2.0, 3.5, 0.4, 5.0, 6.0, 7.0, 0.0].iter().flat_map(|v| v.to_le_bytes()).collect();
        let path = Path::new("000000.bin");
        let cloud = decode(&bytes, path).unwrap();
        assert_eq!(cloud.points, [[1.0, -2.0, 3.5], [5.0, 6.0, 7.0]]);
        assert!(cloud.colours.is_none() && decode(&[], path).unwrap().is_empty());
        for length in (1..bytes.len()).filter(|n| n % 16 != 0) {
            let message = decode(&bytes[..length], path).unwrap_err().to_string();
            assert!(message.contains("000000.bin") && message.contains("multiple of 16"), "{message}");
        }
    }
}
