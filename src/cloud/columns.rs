//! Which fields of a file's records make up a point.

use super::points::PointCloud;

/// Places of the fields among the numbers of a record.
pub(super) struct Columns {
    place: [usize; 3],
    normal: Option<[usize; 3]>,
    colour: Option<Colour>,
    confidence: Option<usize>,
}

enum Colour {
    /// Red, green and blue in fields of their own.
    Apart([usize; 3]),
    /// In the lower 24 bits of one number.
    Packed(usize),
}

/// The name by which PCL packs a colour into four bytes.
pub(super) fn is_packed_colour(name: &str) -> bool {
    matches!(name, "rgb" | "rgba")
}

impl Columns {
    /// From the names of a record's fields; says what is missing. `byte` tells whether a field holds 8-bit integers, as those of
    /// a colour must.
    pub(super) fn find(names: &[&str], byte: impl Fn(usize) -> bool) -> Result<Self, String> {
        let named = |name: &str| names.iter().position(|n| n.eq_ignore_ascii_case(name));
        let three = |[a, b, c]: [&str; 3]| Some([named(a)?, named(b)?, named(c)?]);
        let place = three(["x", "y", "z"]).ok_or_else(|| format!("fields {}", names.join(" ")))?;
        let normal = three(["nx", "ny", "nz"]).or_else(|| three(["normal_x", "normal_y", "normal_z"]));
        let apart =
            [["red", "green", "blue"], ["r", "g", "b"], ["diffuse_red", "diffuse_green", "diffuse_blue"]];
        let apart = apart.into_iter().find_map(three).filter(|places| places.iter().all(|&i| byte(i)));
        let packed = names.iter().position(|name| is_packed_colour(name));
        let colour = apart.map(Colour::Apart).or(packed.map(Colour::Packed));
        Ok(Self { place, normal, colour, confidence: named("confidence") })
    }

    /// A cloud with those parts that the records have.
    pub(super) fn cloud(&self) -> PointCloud {
        PointCloud {
            points: Vec::new(),
            colours: self.colour.as_ref().map(|_| Vec::new()),
            normals: self.normal.map(|_| Vec::new()),
            confidence: self.confidence.map(|_| Vec::new()),
        }
    }

    /// Adds the point of a record, which has a number per field.
    pub(super) fn push(&self, record: &[f64], cloud: &mut PointCloud) {
        let at = |i: usize| record.get(i).copied().unwrap_or(f64::NAN);
        let three = |places: [usize; 3]| places.map(|i| at(i) as f32);
        cloud.points.push(three(self.place));
        if let (Some(colours), Some(colour)) = (&mut cloud.colours, &self.colour) {
            colours.push(match colour {
                Colour::Apart(places) => places.map(|i| at(i) as u8),
                Colour::Packed(place) => {
                    let [_, red, green, blue] = (at(*place) as u32).to_be_bytes();
                    [red, green, blue]
                }
            });
        }
        if let (Some(normals), Some(places)) = (&mut cloud.normals, self.normal) {
            normals.push(three(places));
        }
        if let (Some(confidence), Some(place)) = (&mut cloud.confidence, self.confidence) {
            confidence.push(at(place) as f32);
        }
    }
}
