//! What was made on a device and is asked for again: all layers of a model ask for the same, and what is kept goes to the device once.

use crate::error::Result;
use candle_core::Device;
use std::sync::{Mutex, PoisonError};

/// The last few values, by what they were made of.
pub(super) struct Kept<K, V> {
    known: Mutex<Vec<(K, Device, V)>>,
    /// How many are kept.
    most: usize,
}

impl<K: PartialEq, V: Clone> Kept<K, V> {
    pub(super) const fn new(most: usize) -> Self {
        Self { known: Mutex::new(Vec::new()), most }
    }

    /// The value of `key` on a device; `make` is called if it is not known.
    pub(super) fn get(&self, key: K, device: &Device, make: impl FnOnce(&K) -> Result<V>) -> Result<V> {
        let known = || self.known.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some((_, _, value)) = known().iter().find(|(k, d, _)| *k == key && d.same_device(device)) {
            return Ok(value.clone());
        }
        let value = make(&key)?;
        let mut known = known();
        if known.len() >= self.most {
            known.remove(0);
        }
        known.push((key, device.clone(), value.clone()));
        Ok(value)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_last_few_are_made_once() {
        let kept = Kept::new(2);
        let mut made = Vec::new();
        for key in [1, 2, 1, 2, 3, 3, 1] {
            let value = kept.get(key, &Device::Cpu, |&key| {
                made.push(key);
                Ok(10 * key)
            });
            assert_eq!(value.unwrap(), 10 * key);
        }
        assert_eq!(made, [1, 2, 3, 1]);
        let refused = kept.get(9, &Device::Cpu, |_| Err(crate::Error::argument("key", 9, "another one")));
        assert!(refused.is_err());
        assert_eq!(kept.get(9, &Device::Cpu, |_| Ok(90)).unwrap(), 90);
    }
}
