//! Placement: the member that is to own a link, by rendezvous hashing with weights.
//!
//! Each member has a cost for each link, and the member with the lowest one is the target. All members compute the
//! same, without talking. When a member comes, it takes its share from all others; when it goes, its links spread
//! over all others; no other link moves.
//!
//! The cost is `-log2(h / 2^64) / weight`, so that a member's share is in proportion to its weight. `h` is the hash
//! of the ids of link and member: FNV-1a of 64 bits over the link, a zero byte and the member, mixed by the finalizer
//! of MurmurHash3. The logarithm has 32 binary places and is computed with integers, so that it is the same on all
//! machines. **All versions must agree on this**, or links would move to and fro: the test has vectors.

use std::cmp::Ordering;

/// A member that can own a link.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Candidate<'a> {
    pub(super) member: &'a str,
    pub(super) weight: u32,
    pub(super) session: &'a str,
}

/// The candidate that is to own a link. Of two sessions of one member it is the one with the greater name: such a
/// member has just started again, and its old session ends within a lease.
pub(super) fn target<'a>(link: &str, candidates: impl IntoIterator<Item = Candidate<'a>>) -> Option<Candidate<'a>> {
    let weighed = candidates.into_iter().filter(|candidate| candidate.weight > 0);
    let priced = weighed.map(|candidate| (logarithm(hash(link, candidate.member)), candidate));
    priced.min_by(|a, b| compare(*a, *b)).map(|(_, candidate)| candidate)
}

fn compare((log_a, a): (u64, Candidate<'_>), (log_b, b): (u64, Candidate<'_>)) -> Ordering {
    // A logarithm is below 2^39 and a weight below 2^32.
    let (cost_a, cost_b) = (u128::from(log_a) * u128::from(b.weight), u128::from(log_b) * u128::from(a.weight));
    cost_a.cmp(&cost_b).then_with(|| a.member.cmp(b.member)).then_with(|| b.session.cmp(a.session))
}

/// The hash of a link and a member.
fn hash(link: &str, member: &str) -> u64 {
    let bytes = link.bytes().chain([0]).chain(member.bytes());
    let fnv =
        bytes.fold(0xcbf2_9ce4_8422_2325_u64, |hash, byte| (hash ^ u64::from(byte)).wrapping_mul(0x0100_0000_01b3));
    let mixed = (fnv ^ (fnv >> 33)).wrapping_mul(0xff51_afd7_ed55_8ccd);
    let mixed = (mixed ^ (mixed >> 33)).wrapping_mul(0xc4ce_b9fe_1a85_ec53);
    mixed ^ (mixed >> 33)
}

/// `-log2(hash / 2^64)` with 32 binary places. Never 0.
fn logarithm(hash: u64) -> u64 {
    let hash = hash | 1;
    let zeros = hash.leading_zeros();
    // From 1 to 2, with 63 binary places.
    let mut mantissa = hash << zeros;
    let mut fraction = 0_u64;
    for _ in 0..32 {
        let square = (u128::from(mantissa) * u128::from(mantissa)) >> 63;
        fraction <<= 1;
        mantissa = u64::try_from(square).unwrap_or_else(|_| {
            fraction |= 1;
            u64::try_from(square >> 1).unwrap_or(u64::MAX)
        });
    }
    ((1 + u64::from(zeros)) << 32) - fraction
}

#[cfg(test)]
mod tests {
    use std::collections::HashMap;

    use super::*;

    fn members(weights: &[(&'static str, u32)]) -> Vec<Candidate<'static>> {
        weights.iter().map(|&(member, weight)| Candidate { member, weight, session: member }).collect()
    }

    fn place(links: u32, members: &[Candidate<'static>]) -> Vec<&'static str> {
        (0..links).map(|n| target(&format!("plc{n}"), members.iter().copied()).unwrap().member).collect()
    }

    fn count(owners: &[&'static str]) -> HashMap<&'static str, i32> {
        let mut counts = HashMap::new();
        owners.iter().for_each(|owner| *counts.entry(*owner).or_default() += 1);
        counts
    }

    /// A version that gives other values must not run beside this one.
    #[test]
    fn all_versions_place_links_alike() {
        for (link, member, hashed, log) in [
            ("", "", 0xb903_4ad3_7056_f5fb, 2_012_270_571),
            ("mixer", "hall-1", 0x565c_c67b_316a_8a9b, 6_733_084_978),
            ("mixer", "hall-2", 0xc6d3_e9ee_7332_f0dc, 1_566_049_906),
            ("line1", "hall-1", 0x6d66_28ab_fd0d_a157, 5_267_964_191),
            ("boiler", "hall-3", 0xc234_36c5_ba85_4c1a, 1_711_850_208),
        ] {
            assert_eq!((hash(link, member), logarithm(hashed)), (hashed, log), "{link} {member}");
        }
        assert_eq!((logarithm(0), logarithm(u64::MAX)), (274_877_906_944, 1));
        let fleet = members(&[("hall-1", 1), ("hall-2", 1), ("hall-3", 3)]);
        for (link, expected) in [
            ("mixer", "hall-2"),
            ("boiler", "hall-3"),
            ("line1", "hall-3"),
            ("plc0", "hall-3"),
            ("plc1", "hall-2"),
            ("plc2", "hall-2"),
            ("plc3", "hall-1"),
            ("plc4", "hall-3"),
        ] {
            assert_eq!(target(link, fleet.iter().copied()).unwrap().member, expected, "{link}");
        }
    }

    #[test]
    fn shares_are_in_proportion_to_the_weights() {
        let owners = place(10_000, &members(&[("a", 1), ("b", 1), ("c", 2), ("d", 4)]));
        let counts = count(&owners);
        for (member, share) in [("a", 1250), ("b", 1250), ("c", 2500), ("d", 5000)] {
            // Four standard deviations are at most 200.
            assert!((counts[member] - share).abs() < 200, "{member} of {counts:?}");
        }
    }

    #[test]
    fn only_the_share_of_a_new_member_moves() {
        let before = place(10_000, &members(&[("a", 1), ("b", 1), ("c", 1)]));
        let after = place(10_000, &members(&[("a", 1), ("b", 1), ("c", 1), ("d", 1)]));
        let moved: Vec<_> = before.iter().zip(&after).filter(|(before, after)| before != after).collect();
        assert!(moved.iter().all(|(_, after)| **after == "d"));
        assert!((2300..2700).contains(&moved.len()), "{}", moved.len());
    }

    #[test]
    fn a_member_without_weight_gets_nothing() {
        let candidates = members(&[("a", 0), ("b", 1)]);
        assert_eq!(place(100, &candidates), vec!["b"; 100]);
        assert_eq!(target("plc", members(&[("a", 0)])), None);
        assert_eq!(target("plc", []), None);
    }

    #[test]
    fn of_two_sessions_of_a_member_one_is_chosen() {
        let candidate = |session| Candidate { member: "a", weight: 1, session };
        assert_eq!(target("plc", [candidate("x"), candidate("y")]), Some(candidate("y")));
        assert_eq!(target("plc", [candidate("y"), candidate("x")]), Some(candidate("y")));
    }
}
