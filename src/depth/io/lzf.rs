//! Unpacking LZF, the fast compression of PCD files, which h5py offers too and `hdf5-reader` does not know.

/// Unpacks a whole buffer (format: Lehmann's LibLZF); `None` for damaged data and beyond `limit` bytes.
///
/// A control byte below 32 announces that many bytes, and one more, as they are. Otherwise its upper three bits are a length, 7
/// meaning that a byte with the rest follows, and its lower five bits with the next byte a distance back into the output.
pub fn unpack(mut data: &[u8], limit: usize) -> Option<Vec<u8>> {
    let mut out = Vec::new();
    while let Some((&control, rest)) = data.split_first() {
        data = rest;
        if control < 32 {
            let (plain, rest) = data.split_at_checked(usize::from(control) + 1)?;
            out.extend_from_slice(plain);
            data = rest;
        } else {
            let mut length = usize::from(control >> 5) + 2;
            if control >> 5 == 7 {
                length += usize::from(next(&mut data)?);
            }
            let back = (usize::from(control & 31) << 8) + usize::from(next(&mut data)?) + 1;
            let start = out.len().checked_sub(back)?;
            // The run may reach into what it writes itself.
            for i in start..start + length {
                out.push(out[i]);
            }
        }
        if out.len() > limit {
            return None;
        }
    }
    Some(out)
}

fn next(data: &mut &[u8]) -> Option<u8> {
    let (&first, rest) = data.split_first()?;
    *data = rest;
    Some(first)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn plain_bytes_and_runs() {
        // "ab", then 3 bytes from 2 back, then 10 from 1 back.
        let packed = [1, b'a', b'b', 0x20, 1, 0xe0, 1, 0];
        assert_eq!(unpack(&packed, 100).unwrap(), b"ababaaaaaaaaaaa");
        assert_eq!(unpack(&[], 0).unwrap(), b"");
    }

    #[test]
    fn damage_is_noticed() {
        for wrong in [&[3, 1, 2][..], &[0x20], &[0xe0, 0], &[0, 9, 0x20, 1], &[0, 9, 0x3f, 0xff]] {
            assert!(unpack(wrong, 100).is_none(), "{wrong:?}");
        }
        assert!(unpack(&[1, b'a', b'b'], 1).is_none());
    }
}
