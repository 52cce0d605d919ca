//! What a station is known by beyond the life of its link, and the transfers that go on with the same one alone.

use super::Station;

impl Station {
    /// What it is known by: number and endpoint.
    fn place(&self) -> String {
        format!("station {} on {}", self.number(), self.link().name())
    }
}

/// The station that a transfer was begun with, which can be run more than once.
#[derive(Debug, Default)]
pub(crate) struct BegunWith(Option<String>);

/// A transfer was to go on with another station than it was begun with: the places of both.
#[derive(Debug, PartialEq, Eq)]
pub(crate) struct OtherStation {
    pub(crate) begun: String,
    pub(crate) station: String,
}

impl BegunWith {
    /// A run begins with this station. While the transfer is `bound`, as earlier runs have left something that belongs to their
    /// station alone, it must be the same by number and endpoint.
    pub(crate) fn go_on(&mut self, station: &Station, bound: bool) -> Result<(), OtherStation> {
        let place = station.place();
        match &self.0 {
            Some(begun) if bound && *begun != place => Err(OtherStation { begun: begun.clone(), station: place }),
            _ => {
                self.0 = Some(place);
                Ok(())
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use tokio::io::duplex;

    use super::*;
    use crate::link::Link;
    use crate::wire::Framing;

    fn station(link: &str, number: u8) -> Station {
        let open = || async { Ok(duplex(1).0) };
        Link::connector_builder(link, Framing::Ascii, open).build().station(number).unwrap()
    }

    #[tokio::test]
    async fn what_is_bound_goes_on_with_the_station_that_it_was_begun_with_and_with_no_other() {
        let mut begun = BegunWith::default();
        // Nothing was begun, whatever is said of it.
        assert_eq!(begun.go_on(&station("here", 1), true), Ok(()));
        for other in [station("here", 2), station("there", 1)] {
            let places = OtherStation { begun: "station 1 on here".to_owned(), station: other.place() };
            assert_eq!(begun.go_on(&other, true), Err(places));
        }
        // By another link, and after the others were refused.
        assert_eq!(begun.go_on(&station("here", 1), true), Ok(()));
        assert_eq!(begun.go_on(&station("here", 2), false), Ok(()));
        assert_eq!(begun.go_on(&station("here", 2), true), Ok(()));
        assert!(begun.go_on(&station("here", 1), true).is_err());
    }
}
