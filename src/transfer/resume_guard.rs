//! The station that a transfer must resume with.

use crate::station::Station;

/// Remembers the station of a transfer that can be run more than once.
#[derive(Debug, Default)]
pub(crate) struct ResumeGuard(Option<String>);

/// A transfer was to resume with another station: the names of both.
#[derive(Debug, PartialEq, Eq)]
pub(crate) struct OtherStation {
    pub(crate) begun: String,
    pub(crate) station: String,
}

impl ResumeGuard {
    /// A run begins with this station. It must be the station of the earlier runs, by number and
    /// endpoint, while the transfer is `bound`: earlier runs have left something there.
    ///
    /// # Errors
    /// [`OtherStation`]; the guard still holds the earlier one.
    pub(crate) fn admit(&mut self, station: &Station, bound: bool) -> Result<(), OtherStation> {
        let name = format!("station {} on {}", station.number(), station.link().name());
        match &self.0 {
            Some(begun) if bound && *begun != name => Err(OtherStation { begun: begun.clone(), station: name }),
            Some(_) | None => {
                self.0 = Some(name);
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
    async fn a_bound_transfer_resumes_with_its_station_only() {
        let mut guard = ResumeGuard::default();
        // The first run has no earlier one.
        assert_eq!(guard.admit(&station("here", 1), true), Ok(()));
        for (link, number) in [("here", 2), ("there", 1)] {
            let names =
                OtherStation { begun: "station 1 on here".to_owned(), station: format!("station {number} on {link}") };
            assert_eq!(guard.admit(&station(link, number), true), Err(names));
        }
        // Over another link, and after the others were refused.
        assert_eq!(guard.admit(&station("here", 1), true), Ok(()));
        assert_eq!(guard.admit(&station("here", 2), false), Ok(()));
        assert_eq!(guard.admit(&station("here", 2), true), Ok(()));
        assert!(guard.admit(&station("here", 1), true).is_err());
    }
}
