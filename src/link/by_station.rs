//! A map by station number, for the state of each station of a link.
//!
//! Nearly all links have one station, and a service has thousands of links. So the map allocates
//! for its entries only; a B-tree would have room for eleven. The first entry is looked at before
//! all others, in code that the compiler puts into the caller.

#[derive(Debug)]
pub(crate) struct ByStation<T> {
    /// Sorted by station, each once; at most 256.
    entries: Vec<(u8, T)>,
}

impl<T> ByStation<T> {
    pub(crate) fn new() -> Self {
        Self { entries: Vec::new() }
    }

    #[inline]
    pub(crate) fn get(&self, station: u8) -> Option<&T> {
        match self.entries.first() {
            Some((first, value)) if *first == station => Some(value),
            Some(_) | None => self.get_other(station),
        }
    }

    #[inline(never)]
    fn get_other(&self, station: u8) -> Option<&T> {
        let at = self.place(station).ok()?;
        self.entries.get(at).map(|(_, value)| value)
    }

    pub(crate) fn get_mut(&mut self, station: u8) -> Option<&mut T> {
        let at = self.place(station).ok()?;
        self.entries.get_mut(at).map(|(_, value)| value)
    }

    /// Runs `work` with the entry of a station, which `new` makes if there is none.
    #[inline]
    pub(crate) fn with<R>(&mut self, station: u8, new: impl FnOnce() -> T, work: impl FnOnce(&mut T) -> R) -> R {
        match self.entries.first_mut() {
            Some((first, value)) if *first == station => work(value),
            Some(_) | None => self.with_other(station, new, work),
        }
    }

    #[inline(never)]
    fn with_other<R>(&mut self, station: u8, new: impl FnOnce() -> T, work: impl FnOnce(&mut T) -> R) -> R {
        if let Some(value) = self.get_mut(station) {
            return work(value);
        }
        let mut value = new();
        let result = work(&mut value);
        if let Err(at) = self.place(station) {
            self.entries.reserve_exact(1);
            self.entries.insert(at, (station, value));
        }
        result
    }

    pub(crate) fn iter(&self) -> impl Iterator<Item = (u8, &T)> {
        self.entries.iter().map(|(station, value)| (*station, value))
    }

    pub(crate) fn iter_mut(&mut self) -> impl Iterator<Item = (u8, &mut T)> {
        self.entries.iter_mut().map(|(station, value)| (*station, value))
    }

    pub(crate) fn values(&self) -> impl Iterator<Item = &T> {
        self.entries.iter().map(|(_, value)| value)
    }

    pub(crate) fn values_mut(&mut self) -> impl Iterator<Item = &mut T> {
        self.entries.iter_mut().map(|(_, value)| value)
    }

    /// The index of the entry, or where to insert it.
    #[inline]
    fn place(&self, station: u8) -> Result<usize, usize> {
        match self.entries.first() {
            // Nearly all links have one station.
            Some(&(first, _)) if first == station => Ok(0),
            Some(_) | None => self.entries.binary_search_by_key(&station, |&(station, _)| station),
        }
    }
}

impl<T> Default for ByStation<T> {
    fn default() -> Self {
        Self::new()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::Random;
    use std::collections::BTreeMap;

    #[test]
    fn it_equals_a_b_tree_map_and_has_no_spare_capacity() {
        for seed in 0..50 {
            let mut random = Random::new(seed);
            let (mut map, mut expected) = (ByStation::new(), BTreeMap::new());
            for n in 0..random.next() % 600 {
                let station = (random.next() % 256) as u8;
                assert_eq!(map.get(station), expected.get(&station), "seed {seed}");
                assert_eq!(map.get_mut(station), expected.get_mut(&station), "seed {seed}");
                let before = map.with(station, || n, |value| std::mem::replace(value, *value + 1));
                let value = expected.entry(station).or_insert(n);
                assert_eq!(before, std::mem::replace(value, *value + 1), "seed {seed}");
            }
            assert!(map.iter().eq(expected.iter().map(|(&station, value)| (station, value))), "seed {seed}");
            assert!(map.values().eq(expected.values()), "seed {seed}");
            assert!(map.iter_mut().eq(expected.iter_mut().map(|(&station, value)| (station, value))), "seed {seed}");
            assert!(map.values_mut().eq(expected.values_mut()), "seed {seed}");
            assert_eq!(map.entries.capacity(), expected.len(), "seed {seed}");
        }
    }
}
