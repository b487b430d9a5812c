//! OpenEXR files with a channel of depth (the crate `exr`).

use std::io::{Cursor, ErrorKind};
use std::path::Path;

use exr::error::Error as ExrError;
use exr::image::FlatSamples;
use exr::meta::MetaData;
use exr::prelude::{ReadChannels, ReadLayers, read};

use super::raster::{Raster, Values};
use crate::depth::pixels::{check_length, pixel_count};
use crate::error::{Error, Result};
use crate::files::read_within;

const EXPECTED: &str = "an OpenEXR file with one channel, or one whose name ends in Z or Depth";
/// Bytes of the largest file that is read.
const LARGEST: u64 = 1 << 30;
/// How often smaller a layer may be stored. Deflate shrinks 1032-fold, PIZ and DWA may do more with one flat colour.
const SHRINKS: usize = 4096;

/// Reads the depth channel of the first layer, in its data window.
///
/// # Errors
/// [`Error::Io`]; [`Error::Format`] for a damaged file, a deep image, and where the channel is not clear (its names are listed);
/// [`Error::ImageSize`].
pub fn read_exr(path: &Path) -> Result<Raster> {
    decode(&read_within(path, LARGEST)?, path)
}

fn decode(bytes: &[u8], path: &Path) -> Result<Raster> {
    let wrong = |error: ExrError| match error {
        ExrError::Io(e) if e.kind() != ErrorKind::UnexpectedEof => Error::io(path)(e),
        other => Error::format(path, other.to_string(), EXPECTED),
    };
    check_claims(bytes, path, wrong)?;
    let reader =
        read().no_deep_data().largest_resolution_level().all_channels().first_valid_layer().all_attributes();
    let image = reader.non_parallel().from_buffered(Cursor::new(bytes)).map_err(wrong)?;
    let layer = image.layer_data;
    let (width, height) = (layer.size.x(), layer.size.y());
    let pixels = pixel_count(width, height)?;
    let names: Vec<String> = layer.channel_data.list.iter().map(|channel| channel.name.to_string()).collect();
    let chosen = choose(&names).ok_or_else(|| {
        let shown = names[..names.len().min(8)].join(", ");
        Error::format(path, format!("{} channels ({shown})", names.len()), EXPECTED)
    })?;
    let channel = layer.channel_data.list.into_iter().nth(chosen);
    let values = match channel.map(|channel| channel.sample_data) {
        Some(FlatSamples::F16(v)) => Values::Floats(v.into_iter().map(f32::from).collect()),
        Some(FlatSamples::F32(v)) => Values::Floats(v),
        Some(FlatSamples::U32(v)) => Values::Integers(v.into_iter().map(i64::from).collect()),
        None => return Err(Error::format(path, "no channel", EXPECTED)),
    };
    // Fewer where the channel is subsampled.
    check_length("OpenEXR channel", values.len(), pixels)?;
    Ok(Raster { width, height, values })
}

/// Refuses layers that are larger than the file can hold, before anything is set aside for them.
fn check_claims(bytes: &[u8], path: &Path, wrong: impl Fn(ExrError) -> Error) -> Result<()> {
    let meta = MetaData::read_from_buffered(Cursor::new(bytes), false).map_err(wrong)?;
    for header in &meta.headers {
        let size = header.layer_size;
        let pixels = pixel_count(size.x(), size.y())?;
        let claimed = pixels.saturating_mul(header.channels.bytes_per_pixel);
        if claimed / SHRINKS > bytes.len() {
            let (w, h, channels) = (size.x(), size.y(), header.channels.list.len());
            let found =
                format!("{w}x{h} pixels of {channels} channels announced in a file of {} bytes", bytes.len());
            return Err(Error::format(path, found, EXPECTED));
        }
    }
    Ok(())
}

/// The only channel, or the only one whose last part is Z or Depth.
fn choose(names: &[String]) -> Option<usize> {
    let last = |name: &String| name.rsplit('.').next().unwrap_or("").to_ascii_lowercase();
    let mut depth =
        (0..names.len()).filter(|&i| names.len() == 1 || matches!(last(&names[i]).as_str(), "z" | "depth"));
    depth.next().filter(|_| depth.next().is_none())
}

#[cfg(test)]
mod tests {
    use super::*;
    use exr::prelude::{
        AnyChannel, AnyChannels, Encoding, Image, Layer, LayerAttributes, Text, WritableImage, f16,
    };

    fn written(channels: Vec<(&str, FlatSamples)>, encoding: Encoding) -> Vec<u8> {
        let list = channels.into_iter().map(|(name, data)| AnyChannel::new(Text::new_or_panic(name), data));
        let layer =
            Layer::new((3, 2), LayerAttributes::default(), encoding, AnyChannels::sort(list.collect()));
        let mut bytes = Cursor::new(Vec::new());
        Image::from_layer(layer).write().non_parallel().to_buffered(&mut bytes).unwrap();
        bytes.into_inner()
    }

    fn values() -> FlatSamples {
        FlatSamples::F32(vec![0.5, 1.5, f32::INFINITY, 3.0, 4.0, 0.0])
    }

    fn found(bytes: &[u8]) -> Result<Raster> {
        decode(bytes, Path::new("test.exr"))
    }

    #[test]
    fn the_depth_channel_of_every_type() {
        for encoding in [Encoding::UNCOMPRESSED, Encoding::FAST_LOSSLESS, Encoding::SMALL_LOSSLESS] {
            let only = found(&written(vec![("Y", values())], encoding)).unwrap();
            let expected = Values::Floats(vec![0.5, 1.5, f32::INFINITY, 3.0, 4.0, 0.0]);
            assert_eq!(only, Raster { width: 3, height: 2, values: expected });
            let half = FlatSamples::F16([1.5; 6].map(f16::from_f32).to_vec());
            let named = vec![("R", values()), ("Z", half.clone()), ("Zback", values())];
            assert_eq!(found(&written(named, encoding)).unwrap().values, Values::Floats(vec![1.5; 6]));
            let blender = vec![("ViewLayer.Combined.R", values()), ("ViewLayer.Depth.Z", half)];
            assert_eq!(found(&written(blender, encoding)).unwrap().values, Values::Floats(vec![1.5; 6]));
            let whole = vec![("Y", FlatSamples::U32(vec![7, 0, 1, 2, 3, u32::MAX]))];
            let whole = found(&written(whole, encoding)).unwrap().values;
            assert_eq!(whole, Values::Integers(vec![7, 0, 1, 2, 3, i64::from(u32::MAX)]));
        }
        let unclear = found(&written(vec![("R", values()), ("G", values())], Encoding::UNCOMPRESSED));
        let unclear = unclear.unwrap_err().to_string();
        assert!(unclear.contains("2 channels (G, R)"), "{unclear}");
    }

    #[test]
    fn damage_ends_in_an_answer() {
        for encoding in [Encoding::UNCOMPRESSED, Encoding::FAST_LOSSLESS, Encoding::SMALL_LOSSLESS] {
            let whole = written(vec![("Z", values())], encoding);
            for length in 0..whole.len() {
                assert!(matches!(found(&whole[..length]), Err(Error::Format { .. })), "{length}");
            }
            for at in 0..whole.len() {
                for flip in [1, 0x80, 0xff] {
                    let mut bytes = whole.clone();
                    bytes[at] ^= flip;
                    let _ = found(&bytes);
                }
            }
        }
    }
}
