//! Hosts of `--network`: networks, ranges, single addresses and names, and the order in which they
//! are tried.

use std::fmt;
use std::net::{IpAddr, Ipv4Addr, Ipv6Addr, SocketAddr};
use std::str::FromStr;

/// Largest number of hosts without `--large`: those of an IPv4 network /16, or of an IPv6 network
/// /112.
pub(crate) const MAX_HOSTS: u128 = 1 << 16;
/// Largest IPv6 network, by its prefix. Even with `--large`: a larger one has no end.
const MIN_PREFIX_6: u8 = 112;
const ONE_FAMILY: &str = "both ends of a range are of one kind, IPv4 or IPv6";

/// One value of `--network`.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum Hosts {
    Range(Range),
    /// A host by name, or by an address with a zone such as `fe80::1%eth0`.
    Name(String),
}

/// Consecutive addresses, both ends included. The ends are of one family.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Range {
    first: IpAddr,
    last: IpAddr,
}

impl FromStr for Hosts {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        if let Some((address, prefix)) = text.split_once('/') {
            return network(address, prefix).map(Self::Range);
        }
        if let Some(address) = address(text) {
            return single(address).map(Self::Range);
        }
        if let Some((address, _zone)) = text.split_once('%')
            && let Ok(address) = address.trim_start_matches('[').parse::<Ipv6Addr>()
        {
            host(address.into())?;
        }
        if let Some((first, last)) = text.split_once('-')
            && let Some(first) = address(first)
        {
            return range(first, last).map(Self::Range);
        }
        let is_number = |part: &str| !part.is_empty() && part.bytes().all(|b| b.is_ascii_digit());
        // A host name does not end with a number (RFC 1123); this is a mistyped address.
        if text.rsplit('.').next().is_some_and(is_number) {
            return Err("it is no IPv4 address: expected four numbers up to 255".to_owned());
        }
        let valid = |c: char| c.is_alphanumeric() || "-._:%[]".contains(c);
        match text.chars().find(|&c| !valid(c)) {
            Some(c) => Err(format!("the character {c:?} is not valid in a host name")),
            None if text.is_empty() => Err("expected a network such as 192.168.1.0/24, or a host".to_owned()),
            None => Ok(Self::Name(text.to_owned())),
        }
    }
}

/// An address, with or without brackets.
fn address(text: &str) -> Option<IpAddr> {
    let inner = text.strip_prefix('[').and_then(|text| text.strip_suffix(']'));
    match inner {
        Some(inner) => inner.parse::<Ipv6Addr>().ok().map(IpAddr::V6),
        None => text.parse().ok(),
    }
}

/// The hosts of a network: without the address of the network and that of its broadcast.
fn network(text: &str, prefix: &str) -> Result<Range, String> {
    let rule = "expected an address and the length of its prefix, such as 192.168.1.0/24";
    let address = address(text).ok_or(rule)?;
    let bits: u8 = match address {
        IpAddr::V4(_) => 32,
        IpAddr::V6(_) => 128,
    };
    let is_number = prefix.bytes().all(|b| b.is_ascii_digit());
    let prefix: u8 = prefix.parse().ok().filter(|prefix| is_number && *prefix <= bits).ok_or(rule)?;
    let host_bits = bits - prefix;
    match address {
        IpAddr::V4(address) => {
            let mask = u32::MAX.checked_shr(prefix.into()).unwrap_or(0);
            let (first, last) = (u32::from(address) & !mask, u32::from(address) | mask);
            // A network /31 has two hosts, and /32 is one (RFC 3021).
            let inner = u32::from(host_bits >= 2);
            checked(Ipv4Addr::from(first + inner).into(), Ipv4Addr::from(last - inner).into())
        }
        IpAddr::V6(_) if prefix < MIN_PREFIX_6 => Err(format!(
            "an IPv6 network has a prefix of /{MIN_PREFIX_6} or longer: a larger one has too many addresses"
        )),
        IpAddr::V6(address) => {
            let mask = (1_u128 << host_bits) - 1;
            let (first, last) = (u128::from(address) & !mask, u128::from(address) | mask);
            // The first address means any router of the network (RFC 4291).
            let inner = u128::from(host_bits >= 2);
            checked(Ipv6Addr::from(first + inner).into(), Ipv6Addr::from(last).into())
        }
    }
}

/// A range such as `192.168.1.10-20` or `192.168.1.10-192.168.2.5`.
fn range(first: IpAddr, last: &str) -> Result<Range, String> {
    let rule = "the end of a range is an address, or the last number of an IPv4 address: 192.168.1.10-20";
    let last = match (address(last), first) {
        (Some(last), _) => last,
        (None, IpAddr::V4(first)) => {
            let [a, b, c, _] = first.octets();
            let digits = last.bytes().all(|b| b.is_ascii_digit());
            let number = last.parse().ok().filter(|_| digits).ok_or(rule)?;
            Ipv4Addr::new(a, b, c, number).into()
        }
        (None, IpAddr::V6(_)) => return Err(rule.to_owned()),
    };
    if first.is_ipv4() != last.is_ipv4() {
        return Err(ONE_FAMILY.to_owned());
    }
    if last < first {
        return Err("the range is backwards".to_owned());
    }
    let range = checked(first, last)?;
    if first.is_ipv6() && range.count() > MAX_HOSTS {
        return Err(format!("an IPv6 range has at most {MAX_HOSTS} addresses"));
    }
    Ok(range)
}

fn single(address: IpAddr) -> Result<Range, String> {
    checked(address, address)
}

/// Refuses addresses that are of no single host: a datagram to them would reach many. Returns the IPv4
/// address of one in the form `::ffff:10.0.0.1`, which the system takes for the same.
fn host(address: IpAddr) -> Result<IpAddr, String> {
    let address = address.to_canonical();
    let is_broadcast = matches!(address, IpAddr::V4(address) if address.is_broadcast());
    if address.is_multicast() || address.is_unspecified() || is_broadcast {
        return Err(format!("{address} is not the address of a host"));
    }
    Ok(address)
}

/// The range between two addresses, without any that are of no single host.
fn checked(first: IpAddr, last: IpAddr) -> Result<Range, String> {
    let (first, last) = (host(first)?, host(last)?);
    if first.is_ipv4() != last.is_ipv4() {
        return Err(ONE_FAMILY.to_owned());
    }
    let range = Range { first, last };
    let multicast = Range { first: Ipv4Addr::new(224, 0, 0, 0).into(), last: Ipv4Addr::BROADCAST.into() };
    if range.has(multicast.first) {
        return Err("the range has multicast addresses, 224.0.0.0 and above".to_owned());
    }
    Ok(range)
}

impl Range {
    /// Number of addresses.
    pub(crate) fn count(&self) -> u128 {
        match (self.first, self.last) {
            (IpAddr::V4(first), IpAddr::V4(last)) => u128::from(u32::from(last) - u32::from(first)) + 1,
            (IpAddr::V6(first), IpAddr::V6(last)) => (u128::from(last) - u128::from(first)).saturating_add(1),
            // No range has ends of two families.
            (IpAddr::V4(_) | IpAddr::V6(_), _) => 0,
        }
    }

    fn has(&self, address: IpAddr) -> bool {
        self.first.is_ipv4() == address.is_ipv4() && (self.first..=self.last).contains(&address)
    }

    /// The address at this position.
    fn nth(&self, position: u128) -> Option<IpAddr> {
        if position >= self.count() {
            return None;
        }
        Some(match self.first {
            IpAddr::V4(first) => Ipv4Addr::from(u32::from(first) + u32::try_from(position).ok()?).into(),
            IpAddr::V6(first) => Ipv6Addr::from(u128::from(first) + position).into(),
        })
    }
}

impl fmt::Display for Range {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if self.first == self.last { write!(f, "{}", self.first) } else { write!(f, "{} to {}", self.first, self.last) }
    }
}

/// All hosts of a scan, each once, in the order of the command line. Addresses are made when they are
/// needed: a large network takes no memory.
#[derive(Clone, Debug, Default)]
pub(crate) struct HostList {
    ranges: Vec<Range>,
    /// Addresses of names, with their zones.
    named: Vec<SocketAddr>,
}

impl HostList {
    pub(crate) fn add_range(&mut self, range: Range) {
        self.ranges.push(range);
    }

    /// Adds an address that was found for a name; its port is not used. The error is the rule that the
    /// address breaks.
    pub(crate) fn add_address(&mut self, mut address: SocketAddr) -> Result<(), String> {
        // Keeps the zone of an IPv6 address.
        address.set_ip(host(address.ip())?);
        let is_new = |other: &SocketAddr| (other.ip(), zone(other)) != (address.ip(), zone(&address));
        if self.named.iter().all(is_new) {
            self.named.push(address);
        }
        Ok(())
    }

    /// Number of hosts; those of overlapping ranges are counted more than once.
    pub(crate) fn count(&self) -> u128 {
        let of_ranges = self.ranges.iter().fold(0, |sum: u128, range| sum.saturating_add(range.count()));
        of_ranges.saturating_add(self.named.len() as u128)
    }

    /// The hosts, as addresses with port 0.
    pub(crate) fn iter(&self) -> impl Iterator<Item = SocketAddr> + '_ {
        let of_range = |(number, range): (usize, &Range)| {
            let (range, earlier) = (*range, self.ranges.get(..number).unwrap_or_default());
            let addresses = (0..range.count()).map_while(move |position| range.nth(position));
            addresses.filter(move |address| !earlier.iter().any(|range| range.has(*address)))
        };
        let in_ranges = self.ranges.iter().enumerate().flat_map(of_range).map(|ip| SocketAddr::new(ip, 0));
        let is_in_range = |address: &&SocketAddr| self.ranges.iter().any(|range| range.has(address.ip()));
        let named = self.named.iter().filter(move |address| zone(address) != 0 || !is_in_range(address));
        in_ranges.chain(named.copied())
    }
}

/// Zone of an IPv6 address, 0 without.
fn zone(address: &SocketAddr) -> u32 {
    match address {
        SocketAddr::V4(_) => 0,
        SocketAddr::V6(address) => address.scope_id(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn list(texts: &[&str]) -> HostList {
        let mut list = HostList::default();
        for text in texts {
            match text.parse().unwrap() {
                Hosts::Range(range) => list.add_range(range),
                Hosts::Name(name) => panic!("{name}"),
            }
        }
        list
    }

    fn addresses(texts: &[&str]) -> Vec<String> {
        list(texts).iter().map(|address| address.ip().to_string()).collect()
    }

    #[test]
    fn a_network_is_its_hosts_without_network_and_broadcast_address() {
        assert_eq!(addresses(&["192.168.1.0/30"]), ["192.168.1.1", "192.168.1.2"]);
        assert_eq!(addresses(&["192.168.1.7/30"]), ["192.168.1.5", "192.168.1.6"], "an address of the network");
        assert_eq!(addresses(&["10.0.0.8/31"]), ["10.0.0.8", "10.0.0.9"]);
        assert_eq!(addresses(&["10.0.0.8/32"]), ["10.0.0.8"]);
        let all = addresses(&["127.0.1.0/24"]);
        assert_eq!((all.len(), all[0].as_str(), all[253].as_str()), (254, "127.0.1.1", "127.0.1.254"));
        assert_eq!(list(&["10.0.0.0/16"]).count(), 65_534);
        assert_eq!(list(&["10.0.0.0/8"]).count(), (1 << 24) - 2);
        assert_eq!(addresses(&["fd00::/126"]), ["fd00::1", "fd00::2", "fd00::3"]);
        assert_eq!(list(&["fd00::/112"]).count(), 65_535);
        assert_eq!(addresses(&["::1/128"]), ["::1"]);
    }

    #[test]
    fn a_range_has_both_ends() {
        assert_eq!(addresses(&["10.0.0.9-11"]), ["10.0.0.9", "10.0.0.10", "10.0.0.11"]);
        assert_eq!(addresses(&["10.0.0.255-10.0.1.1"]), ["10.0.0.255", "10.0.1.0", "10.0.1.1"]);
        assert_eq!(addresses(&["fd00::1-fd00::3"]), ["fd00::1", "fd00::2", "fd00::3"]);
        assert_eq!(addresses(&["10.0.0.5", "::1", "[::2]"]), ["10.0.0.5", "::1", "::2"]);
    }

    #[test]
    fn each_host_is_tried_once() {
        let found = addresses(&["10.0.0.2-4", "10.0.0.0/29", "10.0.0.3"]);
        assert_eq!(found, ["10.0.0.2", "10.0.0.3", "10.0.0.4", "10.0.0.1", "10.0.0.5", "10.0.0.6"]);
        let mut list = list(&["10.0.0.2-4"]);
        for address in ["10.0.0.3:0", "10.0.0.9:0", "10.0.0.9:0", "[fe80::1%2]:0", "[fe80::1%3]:0"] {
            list.add_address(address.parse().unwrap()).unwrap();
        }
        let found: Vec<String> = list.iter().map(|address| address.to_string()).collect();
        assert_eq!(found[3..], ["10.0.0.9:0", "[fe80::1%2]:0", "[fe80::1%3]:0"]);
    }

    #[test]
    fn an_ipv4_address_in_an_ipv6_address_is_an_ipv4_host() {
        assert_eq!(addresses(&["::ffff:10.0.0.5", "10.0.0.5"]), ["10.0.0.5"]);
        assert_eq!(addresses(&["::ffff:10.0.0.0/127"]), ["10.0.0.0", "10.0.0.1"]);
        let mut list = HostList::default();
        list.add_address("[::ffff:10.0.0.5]:0".parse().unwrap()).unwrap();
        assert_eq!(list.iter().next(), Some("10.0.0.5:0".parse().unwrap()));
    }

    #[test]
    fn names_of_no_single_host_are_refused() {
        let mut list = HostList::default();
        for address in [
            "0.0.0.0:0",
            "224.0.0.1:0",
            "255.255.255.255:0",
            "[::]:0",
            "[ff02::1%2]:0",
            "[::ffff:224.0.0.1]:0",
            "[::ffff:0.0.0.0]:0",
        ] {
            let error = list.add_address(address.parse().unwrap()).unwrap_err();
            assert!(error.contains("not the address of a host"), "{address}: {error}");
        }
        assert_eq!(list.count(), 0);
    }

    #[test]
    fn names_and_zones_are_left_to_the_resolver() {
        for name in ["plc-7.example", "localhost", "fe80::1%eth0", "host-1"] {
            assert_eq!(name.parse(), Ok(Hosts::Name(name.to_owned())));
        }
    }

    #[test]
    fn errors_name_the_rule() {
        for (text, rule) in [
            ("", "expected a network"),
            ("192.168.1.0/33", "length of its prefix"),
            ("192.168.1.0/", "length of its prefix"),
            ("192.168.1.0/+8", "length of its prefix"),
            ("192.168.1/24", "length of its prefix"),
            ("host/24", "length of its prefix"),
            ("192.168.1.256", "four numbers up to 255"),
            ("192.168.1", "four numbers up to 255"),
            ("192.168.1.10-5", "backwards"),
            ("192.168.1.10-256", "the end of a range"),
            ("192.168.1.10-+20", "the end of a range"),
            ("192.168.1.10-", "the end of a range"),
            ("::1-5", "the end of a range"),
            ("10.0.0.1-::1", "of one kind"),
            ("fd00::/111", "/112 or longer"),
            ("::/0", "/112 or longer"),
            ("fd00::1-fe00::1", "at most 65536"),
            ("255.255.255.255", "not the address of a host"),
            ("0.0.0.0", "not the address of a host"),
            ("224.0.0.1", "not the address of a host"),
            ("239.1.0.0/24", "not the address of a host"),
            ("ff02::1", "not the address of a host"),
            ("ff02::1%eth0", "not the address of a host"),
            ("[ff02::1%eth0]", "not the address of a host"),
            ("::ffff:224.0.0.1", "not the address of a host"),
            ("::ffff:0.0.0.0", "not the address of a host"),
            ("::ffff:223.255.255.250-::ffff:240.0.0.1", "multicast"),
            ("::fffe:ffff:fff0-::ffff:0.0.0.5", "of one kind"),
            ("10.0.0.0-230.0.0.0", "not the address of a host"),
            ("10.0.0.0-240.0.0.1", "multicast"),
            ("0.0.0.0/0", "multicast"),
            ("a b", "the character ' '"),
            ("x\u{1b}", "'\\u{1b}'"),
        ] {
            let error = text.parse::<Hosts>().unwrap_err();
            assert!(error.contains(rule), "{text}: {error}");
        }
    }
}
