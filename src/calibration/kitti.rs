//! KITTI's calibrations: of the odometry and object benchmarks and of the raw data (Geiger et al., "Vision meets Robotics: The
//! KITTI Dataset", 2013).
//!
//! A point x of the Velodyne is seen by the rectified camera i at `P_i R Tr x`, with `R` the rectifying rotation (odometry's `Tr`
//! holds it already) and `P_i = K [I | o]`: o is camera i's offset from camera 0.

use std::path::Path;

use super::numbers::{Keyed, beside, rows, text};
use super::types::{Calibration, CalibrationOptions};
use crate::depth::{Camera, Distortion, Intrinsics, Transform};
use crate::error::{Error, Result};

pub(super) fn read(path: &Path, options: &CalibrationOptions) -> Result<Calibration> {
    let text = text(path)?;
    let keyed = Keyed::parse(path, &text);
    let raw = keyed.has("P_rect_00");
    let number = number(path, &keyed, options.camera)?;
    let projection = if raw { format!("P_rect_{number:02}") } else { format!("P{number}") };
    let Projection { intrinsics, offset } = Projection::read(path, &keyed, &projection)?;
    if raw {
        check_size(path, &keyed, number, options.size)?;
    }
    let (width, height) = options.size;
    let camera = Camera::new(width, height, intrinsics, Distortion::None).map_err(|e| {
        Error::config(&path.display().to_string(), &projection, e.to_string(), "a projection matrix")
    })?;
    let to_camera_0 = if raw { raw_lidar(path, &keyed)? } else { lidar(path, &keyed)? };
    Ok(Calibration { camera, lidar_to_camera: to_camera_0.map(|lidar| lidar.then(&offset)) })
}

/// The camera that is asked for; a file holds several, and none is taken by guess.
fn number(path: &Path, keyed: &Keyed, camera: Option<usize>) -> Result<usize> {
    let is_projection =
        |key: &&str| key.starts_with("P_rect_") || matches!(key.as_bytes(), [b'P', b'0'..=b'9']);
    let there: Vec<&str> = keyed.keys().into_iter().filter(is_projection).collect();
    if there.is_empty() {
        return Err(Error::format(path, "neither `P0` nor `P_rect_00`", "a calibration of KITTI"));
    }
    let all = format!("the number of a camera: {} has {}", path.display(), there.join(", "));
    camera.ok_or_else(|| Error::argument("camera", "none", all))
}

struct Projection {
    intrinsics: Intrinsics,
    offset: Transform,
}

impl Projection {
    fn read(path: &Path, keyed: &Keyed, key: &str) -> Result<Self> {
        let [[fx, skew, cx, x], [low, fy, cy, y], [a, b, one, z]] = rows(keyed.numbers(key)?);
        if [skew, low, a, b] != [0.0; 4] || one != 1.0 || fx <= 0.0 || fy <= 0.0 {
            let expected = "fx 0 cx . 0 fy cy . 0 0 1 . with focal lengths above 0";
            return Err(Error::config(&path.display().to_string(), key, "another matrix", expected));
        }
        let offset = [(x - cx * z) / fx, (y - cy * z) / fy, z];
        let identity = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0];
        let intrinsics = Intrinsics { fx: fx as f32, fy: fy as f32, cx: cx as f32, cy: cy as f32 };
        Ok(Self { intrinsics, offset: motion(path, key, beside(identity, offset))? })
    }
}

fn motion(path: &Path, key: &str, rows: [[f64; 4]; 3]) -> Result<Transform> {
    let wrong = |e: Error| Error::config(&path.display().to_string(), key, e.to_string(), "a rigid motion");
    Transform::from_rows(rows).map_err(wrong)
}

/// From the Velodyne to the rectified camera 0, of a benchmark's file; those of the odometry benchmark's grey parts have none.
fn lidar(path: &Path, keyed: &Keyed) -> Result<Option<Transform>> {
    if keyed.has("Tr") {
        return motion(path, "Tr", rows(keyed.numbers("Tr")?)).map(Some);
    }
    if !keyed.has("Tr_velo_to_cam") {
        return Ok(None);
    }
    let velodyne = motion(path, "Tr_velo_to_cam", rows(keyed.numbers("Tr_velo_to_cam")?))?;
    let rectifying = motion(path, "R0_rect", beside(keyed.numbers("R0_rect")?, [0.0; 3]))?;
    Ok(Some(velodyne.then(&rectifying)))
}

/// The same of the raw data, whose Velodyne has a file of its own in the same folder.
fn raw_lidar(path: &Path, keyed: &Keyed) -> Result<Option<Transform>> {
    let beside_it = path.with_file_name("calib_velo_to_cam.txt");
    if !beside_it.exists() {
        return Ok(None);
    }
    let velodyne = super::extrinsic::read_extrinsic(&beside_it)?;
    let rectifying = motion(path, "R_rect_00", beside(keyed.numbers("R_rect_00")?, [0.0; 3]))?;
    Ok(Some(velodyne.then(&rectifying)))
}

fn check_size(path: &Path, keyed: &Keyed, number: usize, (width, height): (usize, usize)) -> Result<()> {
    let key = format!("S_rect_{number:02}");
    let [w, h] = keyed.numbers(&key)?;
    if [w, h] == [width as f64, height as f64] {
        return Ok(());
    }
    let expected = format!("{width} {height}, the size of the picture");
    Err(Error::config(&path.display().to_string(), &key, format!("{w} {h}"), expected))
}
