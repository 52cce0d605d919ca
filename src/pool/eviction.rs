//! The order in which the endpoints of a pool are evicted: the least recently requested one first,
//! of those without handles.
//!
//! A request does not touch this order. The place of an endpoint is corrected when it comes to the
//! front, so an eviction costs O(log n) on average, and a request nothing.
//!
//! Invariants:
//! - Each endpoint has one place, which is not behind its last request.
//! - An endpoint that has handles when it is at the front goes to the back, as if it were requested
//!   then. If no endpoint can be evicted, the order stays the same.

use std::collections::BTreeMap;

/// Endpoints by the time of their last request, by the pool's logical clock, or of an earlier one.
#[derive(Debug)]
pub(super) struct EvictionOrder<K> {
    places: BTreeMap<u64, K>,
}

impl<K> Default for EvictionOrder<K> {
    fn default() -> Self {
        Self { places: BTreeMap::new() }
    }
}

/// An endpoint as the pool has it.
#[derive(Clone, Copy, Debug)]
pub(super) struct Use {
    /// The time of its last request.
    pub(super) requested_at: u64,
    pub(super) has_handles: bool,
}

impl<K> EvictionOrder<K> {
    /// Adds an endpoint that is requested at this time.
    pub(super) fn insert(&mut self, requested_at: u64, endpoint: K) {
        let before = self.places.insert(requested_at, endpoint);
        debug_assert!(before.is_none(), "each request has its own time");
    }

    /// Removes the endpoint to be evicted; `None` if all have handles.
    ///
    /// `requested` notes that an endpoint counts as requested now, and returns the time.
    pub(super) fn evict(&mut self, in_use: impl Fn(&K) -> Use, mut requested: impl FnMut(&K) -> u64) -> Option<K> {
        loop {
            let (mut outdated, mut kept, mut evicted) = (Vec::new(), Vec::new(), None);
            for (&place, endpoint) in &self.places {
                let Use { requested_at, has_handles } = in_use(endpoint);
                if requested_at != place {
                    outdated.push((place, requested_at));
                } else if has_handles {
                    kept.push(place);
                } else {
                    evicted = Some(place);
                    break;
                }
            }
            if !outdated.is_empty() {
                // One of them may have to be evicted: all are looked at again in their places.
                for (place, requested_at) in outdated {
                    if let Some(endpoint) = self.places.remove(&place) {
                        self.insert(requested_at, endpoint);
                    }
                }
                continue;
            }
            let evicted = self.places.remove(&evicted?);
            for place in kept {
                if let Some(endpoint) = self.places.remove(&place) {
                    self.insert(requested(&endpoint), endpoint);
                }
            }
            return evicted;
        }
    }
}

#[cfg(test)]
mod tests {
    use std::cell::RefCell;

    use proptest::prelude::*;

    use super::*;

    #[derive(Clone, Copy, Debug)]
    enum Step {
        Request(usize),
        Handles(usize, bool),
        Evict,
    }

    fn steps() -> impl Strategy<Value = Vec<Step>> {
        let step = prop_oneof![
            4 => (0..8_usize).prop_map(Step::Request),
            2 => (0..8_usize, any::<bool>()).prop_map(|(n, has)| Step::Handles(n, has)),
            3 => Just(Step::Evict),
        ];
        prop::collection::vec(step, 0..60)
    }

    proptest! {
        /// Beside the simple way: the least of all without handles, by the time of the request.
        #[test]
        fn the_least_recently_requested_endpoint_without_handles_is_evicted(steps in steps()) {
            let mut order = EvictionOrder::default();
            let uses: RefCell<Vec<Option<Use>>> = RefCell::new(vec![None; 8]);
            let mut clock = 0;
            for step in steps {
                match step {
                    Step::Request(n) => {
                        clock += 1;
                        let mut uses = uses.borrow_mut();
                        match &mut uses[n] {
                            Some(known) => known.requested_at = clock,
                            unknown @ None => {
                                *unknown = Some(Use { requested_at: clock, has_handles: false });
                                order.insert(clock, n);
                            }
                        }
                    }
                    Step::Handles(n, has_handles) => {
                        if let Some(known) = &mut uses.borrow_mut()[n] {
                            known.has_handles = has_handles;
                        }
                    }
                    Step::Evict => {
                        let expected = {
                            let uses = uses.borrow();
                            let unused = (0..8).filter(|&n| uses[n].is_some_and(|known| !known.has_handles));
                            unused.min_by_key(|&n| uses[n].map(|known| known.requested_at))
                        };
                        let before = uses.borrow().clone();
                        let evicted = order.evict(|&n| uses.borrow()[n].unwrap(), |&n| {
                            clock += 1;
                            uses.borrow_mut()[n].as_mut().unwrap().requested_at = clock;
                            clock
                        });
                        prop_assert_eq!(evicted, expected);
                        if let Some(n) = evicted {
                            let at = before[n].unwrap().requested_at;
                            uses.borrow_mut()[n] = None;
                            // Only those with handles, and older requests, have moved.
                            for (now, before) in uses.borrow().iter().zip(&before) {
                                if let (Some(now), Some(before)) = (now, before) {
                                    let moved = now.requested_at != before.requested_at;
                                    prop_assert_eq!(moved, before.has_handles && before.requested_at < at);
                                }
                            }
                        }
                    }
                }
                prop_assert_eq!(order.places.len(), uses.borrow().iter().flatten().count());
            }
        }
    }

    /// An eviction looked at each of 20,000 endpoints before.
    #[test]
    fn an_eviction_looks_at_few_endpoints() {
        let mut order = EvictionOrder::default();
        let all = 20_000_usize;
        // Half of them, the oldest, have handles.
        let uses: RefCell<Vec<Use>> =
            RefCell::new((0..all).map(|n| Use { requested_at: n as u64, has_handles: n < all / 2 }).collect());
        (0..all).for_each(|n| order.insert(n as u64, n));
        let (mut clock, looked_at) = (all as u64, RefCell::new(0_usize));
        for round in 0..1000 {
            let evicted = order.evict(
                |&n| {
                    *looked_at.borrow_mut() += 1;
                    uses.borrow()[n]
                },
                |&n| {
                    clock += 1;
                    uses.borrow_mut()[n].requested_at = clock;
                    clock
                },
            );
            assert_eq!(evicted, Some(all / 2 + round));
        }
        // The first eviction passes those with handles, the others none.
        assert!(*looked_at.borrow() <= all / 2 + 1000, "{}", looked_at.borrow());
    }
}
