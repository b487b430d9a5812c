//! Buffers that are written before they are read, without a pass over memory that zeroes what will be overwritten.

use std::mem::MaybeUninit;

/// Whether memory is filled with [`POISON`] before it is written, and searched for it afterwards. Not under Miri, which knows by
/// itself what has not been written.
const POISONED: bool = cfg!(any(test, debug_assertions)) && !cfg!(miri);
/// The bits of a signalling NaN, which no arithmetic gives.
const POISON: u32 = 0x7fa0_dead;

/// A buffer of `len` elements that `fill` writes.
///
/// # Safety
/// `fill` must write every element.
pub(in crate::kernels) unsafe fn written(len: usize, fill: impl FnOnce(&mut [MaybeUninit<f32>])) -> Vec<f32> {
    let mut data = Vec::new();
    // SAFETY: the caller's `fill` writes every element.
    unsafe { rewrite(&mut data, len, fill) };
    data
}

/// Replaces what `data` holds by `len` elements that `fill` writes; its memory is used again if it suffices.
///
/// # Safety
/// `fill` must write every element.
pub(in crate::kernels) unsafe fn rewrite(
    data: &mut Vec<f32>,
    len: usize,
    fill: impl FnOnce(&mut [MaybeUninit<f32>]),
) {
    fill(room(data, len));
    // SAFETY: `room` reserved `len` elements, all of which the caller's `fill` has written.
    unsafe { finish(data, len) };
}

/// [`written`] of several buffers at once, of these lengths.
///
/// # Safety
/// `fill` must write every element of every buffer.
pub(in crate::kernels) unsafe fn written_parts(
    lens: &[usize],
    fill: impl FnOnce(&mut [&mut [MaybeUninit<f32>]]),
) -> Vec<Vec<f32>> {
    let mut parts: Vec<Vec<f32>> = lens.iter().map(|_| Vec::new()).collect();
    let mut rooms: Vec<_> = parts.iter_mut().zip(lens).map(|(part, &len)| room(part, len)).collect();
    fill(&mut rooms);
    for (part, &len) in parts.iter_mut().zip(lens) {
        // SAFETY: `room` reserved `len` elements, all of which the caller's `fill` has written.
        unsafe { finish(part, len) };
    }
    parts
}

/// Makes room for `len` elements in place of what `data` holds.
fn room(data: &mut Vec<f32>, len: usize) -> &mut [MaybeUninit<f32>] {
    data.clear();
    data.reserve_exact(len);
    let room = &mut data.spare_capacity_mut()[..len];
    if POISONED {
        room.fill(MaybeUninit::new(f32::from_bits(POISON)));
    }
    room
}

/// Makes the elements that were written in [`room`] those of `data`.
///
/// # Safety
/// `data` must have room for `len` elements, and all of them must be written.
unsafe fn finish(data: &mut Vec<f32>, len: usize) {
    // SAFETY: the caller's promise is that of `set_len`.
    unsafe { data.set_len(len) };
    if POISONED {
        let missed = data.iter().position(|x| x.to_bits() == POISON);
        assert!(missed.is_none(), "element {missed:?} of {len} was not written");
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_written_is_what_is_read() {
        let count = |room: &mut [MaybeUninit<f32>]| {
            for (i, x) in room.iter_mut().enumerate() {
                x.write(i as f32);
            }
        };
        // SAFETY: `count` writes every element.
        let mut data = unsafe { written(3, count) };
        assert_eq!(data, [0.0, 1.0, 2.0]);
        let memory = data.as_ptr();
        // SAFETY: as above.
        unsafe { rewrite(&mut data, 2, count) };
        assert_eq!((&data[..], data.as_ptr()), (&[0.0, 1.0][..], memory));
        // SAFETY: as above.
        let parts =
            unsafe { written_parts(&[1, 0, 2], |parts| parts.iter_mut().for_each(|part| count(part))) };
        assert_eq!(parts, [vec![0.0], vec![], vec![0.0, 1.0]]);
    }

    /// The tests of every kernel that uses these buffers rest on this.
    #[test]
    #[should_panic(expected = "element Some(1) of 3 was not written")]
    #[cfg(not(miri))]
    fn an_element_that_is_not_written_is_found() {
        // SAFETY: none: the middle element keeps the poison, which is an initialised value.
        unsafe {
            written(3, |room| {
                room[0].write(1.0);
                room[2].write(f32::NAN);
            })
        };
    }
}
