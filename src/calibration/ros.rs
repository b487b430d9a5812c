//! ROS's `CameraInfo` as YAML: the files of `camera_calibration` and `camera_info_manager`, or the printed message.

use std::path::Path;

use super::numbers::{fixed, text};
use super::types::{Calibration, CalibrationOptions};
use super::yaml::{Value, Yaml};
use crate::depth::{Camera, Distortion, Intrinsics};
use crate::error::{Error, Result};

/// Keys of one value: in files, in ROS 2's messages, in ROS 1's.
type Keys = [&'static str; 3];

const WIDTH: Keys = ["image_width", "width", "width"];
const HEIGHT: Keys = ["image_height", "height", "height"];
const MODEL: Keys = ["distortion_model"; 3];
const MATRIX: Keys = ["camera_matrix.data", "k", "K"];
const COEFFICIENTS: Keys = ["distortion_coefficients.data", "d", "D"];
const PROJECTION: Keys = ["projection_matrix.data", "p", "P"];

pub(super) fn read(path: &Path, options: &CalibrationOptions) -> Result<Calibration> {
    let text = text(path)?;
    let yaml = Yaml::parse(&text);
    let yaml = yaml.map_err(|found| Error::format(path, found, "a camera calibration of ROS as YAML"))?;
    let info = Info { file: path.display().to_string(), yaml };
    let (width, height) = options.size;
    for (keys, expected) in [(WIDTH, width), (HEIGHT, height)] {
        info.check_size(keys, expected)?;
    }
    let (intrinsics, distortion) = match options.rectified {
        true => (info.pinhole(PROJECTION, info.numbers::<12>(PROJECTION)?.as_slice())?, Distortion::None),
        false => (info.pinhole(MATRIX, info.numbers::<9>(MATRIX)?.as_slice())?, info.distortion()?),
    };
    let camera = Camera::new(width, height, intrinsics, distortion)
        .map_err(|e| Error::format(path, e.to_string(), "a camera calibration of ROS"))?;
    Ok(Calibration { camera, lidar_to_camera: None })
}

struct Info {
    file: String,
    yaml: Yaml,
}

impl Info {
    fn value(&self, keys: Keys) -> Option<(&'static str, &Value)> {
        keys.into_iter().find_map(|key| Some((key, self.yaml.get(key)?)))
    }

    /// The value of a key, under any of its names, or an error that names the first.
    fn need(&self, keys: Keys, expected: &str) -> Result<(&'static str, &Value)> {
        self.value(keys).ok_or_else(|| Error::config(&self.file, keys[0], "missing", expected))
    }

    fn check_size(&self, keys: Keys, pixels: usize) -> Result<()> {
        let expected = format!("{pixels}, as the picture has");
        let (key, value) = self.need(keys, &expected)?;
        match value {
            Value::Word(word) if word.parse() == Ok(pixels) => Ok(()),
            other => Err(Error::config(&self.file, key, shown(other), expected)),
        }
    }

    fn numbers<const N: usize>(&self, keys: Keys) -> Result<[f64; N]> {
        let expected = format!("a list of {N} finite numbers");
        let (key, value) = self.need(keys, &expected)?;
        let found = match value {
            Value::List(items) => fixed(items.iter().map(String::as_str)),
            other => Err(shown(other)),
        };
        found.map_err(|found| Error::config(&self.file, key, found, expected))
    }

    /// Focal lengths and principal point of a matrix with three rows.
    fn pinhole(&self, keys: Keys, matrix: &[f64]) -> Result<Intrinsics> {
        let columns = matrix.len() / 3;
        let at = |row: usize, column: usize| matrix[row * columns + column];
        let zeros = [at(0, 1), at(1, 0), at(2, 0), at(2, 1)];
        let (fx, fy, cx, cy) = (at(0, 0), at(1, 1), at(0, 2), at(1, 2));
        if zeros != [0.0; 4] || at(2, 2) != 1.0 || fx <= 0.0 || fy <= 0.0 {
            let key = self.value(keys).map_or(keys[0], |(key, _)| key);
            let expected = "[fx 0 cx; 0 fy cy; 0 0 1] with focal lengths above 0: a calibrated camera";
            return Err(Error::config(&self.file, key, format!("{matrix:?}"), expected));
        }
        Ok(Intrinsics { fx: fx as f32, fy: fy as f32, cx: cx as f32, cy: cy as f32 })
    }

    fn distortion(&self) -> Result<Distortion> {
        let (_, value) = self.need(COEFFICIENTS, "a list of numbers, empty for no distortion")?;
        let items = match value {
            Value::List(items) => {
                items.iter().map(|item| item.parse::<f64>().map_err(|_| item.clone())).collect()
            }
            other => Err(shown(other)),
        };
        let items: Vec<f64> =
            items.map_err(|found| Error::config(&self.file, COEFFICIENTS[0], found, "a list of numbers"))?;
        let model = match self.value(MODEL) {
            Some((_, Value::Word(word))) => word.as_str(),
            _ if items.is_empty() => "",
            _ => return Err(Error::config(&self.file, MODEL[0], "missing", "the name of the lens model")),
        };
        let wrong = |e: Error| {
            Error::config(&self.file, MODEL[0], e.to_string(), "a lens model and its coefficients")
        };
        Distortion::from_ros(model, &items).map_err(wrong)
    }
}

fn shown(value: &Value) -> String {
    match value {
        Value::Word(word) => format!("{word:.40?}"),
        Value::List(items) => format!("a list of {}", items.len()),
    }
}
