//! The files of a packed library: a catalogue in JSON, and the tensors that it numbers.

use crate::scenes::space::V3;
use serde::{Deserialize, Serialize};

pub(super) const TENSORS: &str = "furniture.safetensors";
pub(super) const CATALOGUE: &str = "furniture.json";
pub(super) const FORMAT: &str = "sdim furniture 1";

#[derive(Serialize, Deserialize)]
pub(super) struct Catalogue {
    pub format: String,
    pub models: Vec<Packed>,
}

#[derive(Serialize, Deserialize)]
pub(super) struct Packed {
    pub id: String,
    pub name: String,
    pub tags: String,
    pub category: String,
    pub author: String,
    pub licence: String,
    pub size: V3,
    pub elevation: f32,
    pub opening: bool,
    pub behind: f32,
    pub bounds: [V3; 2],
    pub uv: Option<[[f32; 2]; 2]>,
    pub covers: Vec<PackedCover>,
}

#[derive(Serialize, Deserialize)]
pub(super) struct PackedCover {
    pub colour: V3,
    pub texture: Option<usize>,
    pub mask: Option<usize>,
    pub opacity: f32,
    pub gloss: f32,
    pub exponent: f32,
    pub glow: f32,
}
