//! The unit of integer depth files.

use std::str::FromStr;

use crate::error::{Error, Result};

/// How many integer steps of a depth file make one metre. Never guessed: the caller states it.
///
/// Parses from `"mm"`, `"kitti"`, `"tum"` or a positive number of units per metre.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DepthScale {
    units_per_metre: f32,
}

impl DepthScale {
    /// KITTI depth files: 256 units per metre.
    pub const fn kitti() -> Self {
        Self { units_per_metre: 256.0 }
    }

    /// Millimetres: 1000 units per metre (RealSense, Azure Kinect, ScanNet).
    pub const fn millimetres() -> Self {
        Self { units_per_metre: 1000.0 }
    }

    /// TUM RGB-D: 5000 units per metre.
    pub const fn tum() -> Self {
        Self { units_per_metre: 5000.0 }
    }

    /// Any other scale, in units per metre.
    ///
    /// # Errors
    /// [`Error::Argument`] unless `units` is finite and above 0.
    pub fn units_per_metre(units: f32) -> Result<Self> {
        // A subnormal scale would turn every stored integer into infinity.
        if units.is_normal() && units > 0.0 {
            Ok(Self { units_per_metre: units })
        } else {
            Err(Error::argument("units per metre", units, "a finite number above 0"))
        }
    }

    /// Units per metre of this scale.
    pub fn units(self) -> f32 {
        self.units_per_metre
    }

    /// Metres for one stored integer; 0 is missing and gives NaN.
    pub fn metres(self, stored: u16) -> f32 {
        if stored == 0 { f32::NAN } else { f32::from(stored) / self.units_per_metre }
    }

    /// As [`DepthScale::metres`], for an integer of any size; 0 and below are missing.
    pub(crate) fn metres_of(self, stored: i64) -> f32 {
        // For integers of 16 bits this gives the bits of the division in f32: its operands and its result have less than half
        // of the digits of f64, so that rounding twice is rounding once.
        if stored <= 0 { f32::NAN } else { (stored as f64 / f64::from(self.units_per_metre)) as f32 }
    }

    /// Nearest storable integer for a depth in metres, and whether the depth was too large to be stored.
    ///
    /// Missing depth (NaN, 0, infinite, negative) gives 0. A valid depth never becomes 0, which would mean missing.
    pub fn stored(self, metres: f32) -> (u16, bool) {
        if !crate::depth::pixels::is_valid(metres) {
            return (0, false);
        }
        // f64 holds the product exactly, so that a value read from a file is written back as the same integer.
        let units = (f64::from(metres) * f64::from(self.units_per_metre)).round();
        let largest = f64::from(u16::MAX);
        (units.clamp(1.0, largest) as u16, units > largest)
    }
}

impl FromStr for DepthScale {
    type Err = Error;

    fn from_str(text: &str) -> Result<Self> {
        match text.trim().to_ascii_lowercase().as_str() {
            "mm" | "millimetres" | "millimeters" => Ok(Self::millimetres()),
            "kitti" => Ok(Self::kitti()),
            "tum" => Ok(Self::tum()),
            other => {
                other.parse::<f32>().ok().and_then(|units| Self::units_per_metre(units).ok()).ok_or_else(
                    || {
                        Error::argument(
                            "depth scale",
                            text,
                            "mm, kitti, tum or a positive number of units per metre",
                        )
                    },
                )
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parses_names_and_numbers() {
        assert_eq!("mm".parse::<DepthScale>().unwrap(), DepthScale::millimetres());
        assert_eq!(" KITTI ".parse::<DepthScale>().unwrap(), DepthScale::kitti());
        assert_eq!("tum".parse::<DepthScale>().unwrap(), DepthScale::tum());
        assert_eq!("100".parse::<DepthScale>().unwrap().units(), 100.0);
        for bad in ["", "metres", "0", "-5", "nan", "inf", "1e-42", "1e60"] {
            assert!(matches!(bad.parse::<DepthScale>(), Err(Error::Argument { .. })), "{bad:?} was accepted");
        }
    }

    #[test]
    fn every_stored_integer_survives_a_round_trip() {
        for scale in [DepthScale::kitti(), DepthScale::millimetres(), DepthScale::tum()] {
            for stored in 1..=u16::MAX {
                assert_eq!(scale.stored(scale.metres(stored)), (stored, false));
                assert_eq!(scale.metres_of(stored.into()).to_bits(), scale.metres(stored).to_bits());
            }
            assert!(scale.metres(0).is_nan() && scale.metres_of(0).is_nan() && scale.metres_of(-1).is_nan());
        }
    }

    #[test]
    fn missing_saturated_and_tiny_depths() {
        let mm = DepthScale::millimetres();
        for missing in [f32::NAN, 0.0, -0.0, -1.0, f32::INFINITY] {
            assert_eq!(mm.stored(missing), (0, false));
        }
        assert_eq!(mm.stored(65.535), (65535, false));
        assert_eq!(mm.stored(65.6), (65535, true));
        assert_eq!(mm.stored(0.0001), (1, false));
    }
}
