//! The settings of a line that are tried, in the order of their likelihood, and the time for them. No
//! I/O.
//!
//! Order: all settings with the first station, then all with the next one. Within that, all speeds with
//! the first frame, then with the next: of FBs PLCs port 0 always has 7E1, and only its speed can be
//! changed (FBs manual, "Communication Related Settings").

use std::str::FromStr;
use std::time::Duration;

use fatek::endpoint::{DataBits, InvalidSettings, MAX_BAUD, MIN_BAUD, Parity, SerialSettings, StopBits};
use fatek::wire::Framing;
use fatek::{Endpoint, ParseEndpointError};

/// Speed in bits per second.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Baud(u32);

/// Data bits, parity and stop bits of a character: the frame of a serial line.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Character {
    data_bits: DataBits,
    parity: Parity,
    stop_bits: StopBits,
}

/// The usual speeds: the factory setting, then those of the documents of HMI makers.
const BAUDS: [Baud; 5] = [Baud(9600), Baud(19_200), Baud(38_400), Baud(115_200), Baud(57_600)];
/// The usual frames: the factory setting of ASCII, that of binary, and those seen in the field.
const CHARACTERS: [Character; 6] = [
    Character::new(DataBits::Seven, Parity::Even),
    Character::new(DataBits::Eight, Parity::None),
    Character::new(DataBits::Eight, Parity::Even),
    Character::new(DataBits::Seven, Parity::None),
    Character::new(DataBits::Seven, Parity::Odd),
    Character::new(DataBits::Eight, Parity::Odd),
];
const FRAMINGS: [Framing; 2] = [Framing::Ascii, Framing::Binary];

/// Time to open a port, and for the line to settle then.
pub(super) const SETTLE: Duration = Duration::from_millis(20);
/// Bytes of the longest status request and reply together, of either framing.
const STATUS_BYTES: u32 = 25;
/// The same of a detailed status.
const DETAIL_BYTES: u32 = 150;
/// Most bits of a character: start, 8 data bits, parity, two stop bits.
const BITS: u32 = 12;

impl Character {
    const fn new(data_bits: DataBits, parity: Parity) -> Self {
        Self { data_bits, parity, stop_bits: StopBits::One }
    }

    fn takes(self, framing: Framing) -> bool {
        framing == Framing::Ascii || self.data_bits == DataBits::Eight
    }
}

impl FromStr for Baud {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        let digits = text.bytes().all(|b| b.is_ascii_digit());
        let baud = text.parse().ok().filter(|baud| digits && (MIN_BAUD..=MAX_BAUD).contains(baud));
        baud.map(Self).ok_or_else(|| format!("expected a number from {MIN_BAUD} to {MAX_BAUD}"))
    }
}

impl FromStr for Character {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        let rule = || "expected data bits (7, 8), parity (N, E, O) and stop bits (1, 2), such as 7E1".to_owned();
        if !text.bytes().all(|b| b.is_ascii_alphanumeric()) {
            return Err(rule());
        }
        // The library parses it as an option of a URL.
        let endpoint: Result<Endpoint, ParseEndpointError> = format!("serial:port?frame={text}").parse();
        let settings = endpoint.ok().and_then(|endpoint| endpoint.transport().serial_settings()).ok_or_else(rule)?;
        Ok(Self { data_bits: settings.data_bits(), parity: settings.parity(), stop_bits: settings.stop_bits() })
    }
}

/// A setting of a line, with the framings that are tried with it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Setting {
    line: Endpoint,
    pub(crate) framings: Vec<Framing>,
}

impl Setting {
    /// The endpoint of this setting.
    pub(crate) fn endpoint(&self, framing: Framing) -> Endpoint {
        self.line.clone().with_framing(framing)
    }

    /// Settings of the serial port, if it is one.
    pub(crate) fn serial(&self) -> Option<SerialSettings> {
        self.line.transport().serial_settings()
    }

    /// Time for a status and its reply: the response timeout and the transmission.
    pub(crate) fn wait(&self, timeout: Duration) -> Duration {
        timeout.saturating_add(self.transmission(STATUS_BYTES))
    }

    /// The same for a detailed status.
    pub(crate) fn wait_for_details(&self, timeout: Duration) -> Duration {
        timeout.saturating_add(self.transmission(DETAIL_BYTES))
    }

    fn transmission(&self, bytes: u32) -> Duration {
        self.serial().map_or(Duration::ZERO, |serial| Duration::from_secs(1) * (bytes * BITS) / serial.baud())
    }
}

/// All trials for a line.
#[derive(Clone, Debug)]
pub(crate) struct Trials {
    pub(crate) settings: Vec<Setting>,
    pub(crate) stations: Vec<u8>,
}

impl Trials {
    /// The trials for a line, with the choices of the command line; an empty list stands for the usual
    /// ones. The error is the rule that they break.
    pub(crate) fn new(
        line: &Endpoint,
        bauds: &[Baud],
        characters: &[Character],
        framing: Option<Framing>,
        stations: Vec<u8>,
    ) -> Result<Self, String> {
        let framings = framing.map_or(FRAMINGS.to_vec(), |framing| vec![framing]);
        let Some(serial) = line.transport().serial_settings() else {
            if !bauds.is_empty() || !characters.is_empty() {
                return Err("speed and frame are settings of the device that the link leads to: no --baud or --frame"
                    .to_owned());
            }
            return Ok(Self { settings: vec![Setting { line: line.clone(), framings }], stations });
        };
        let bauds = if bauds.is_empty() { &BAUDS[..] } else { bauds };
        let characters = if characters.is_empty() { &CHARACTERS[..] } else { characters };
        let mut settings = Vec::new();
        for character in characters {
            let framings: Vec<Framing> = framings.iter().copied().filter(|framing| character.takes(*framing)).collect();
            if framings.is_empty() {
                continue;
            }
            for baud in bauds {
                let line = with(line, serial, *baud, *character).map_err(|invalid| invalid.to_string())?;
                settings.push(Setting { line, framings: framings.clone() });
            }
        }
        if settings.is_empty() {
            return Err("the binary framing needs 8 data bits: choose such a --frame".to_owned());
        }
        Ok(Self { settings, stations })
    }

    /// Number of requests if no station answers.
    pub(crate) fn count(&self) -> usize {
        self.stations.len() * self.settings.iter().map(|setting| setting.framings.len()).sum::<usize>()
    }

    /// Time for all of them, or for those of the first station.
    pub(crate) fn longest(&self, timeout: Duration) -> Duration {
        let of_station: Duration = self.settings.iter().map(|setting| time_of(setting, timeout)).sum();
        of_station.saturating_mul(u32::try_from(self.stations.len()).unwrap_or(u32::MAX))
    }

    /// The trials in their order: a station and a setting, and the time that is left from there on if no
    /// station answers.
    pub(crate) fn iter(&self, timeout: Duration) -> impl Iterator<Item = (u8, &Setting, Duration)> {
        let mut left = self.longest(timeout);
        let pairs = self.stations.iter().flat_map(|&station| self.settings.iter().map(move |one| (station, one)));
        pairs.map(move |(station, setting)| {
            let now = left;
            left = left.saturating_sub(time_of(setting, timeout));
            (station, setting, now)
        })
    }
}

/// Time for a setting without an answer.
fn time_of(setting: &Setting, timeout: Duration) -> Duration {
    // At most two.
    let framings = u32::try_from(setting.framings.len()).unwrap_or(u32::MAX);
    setting.wait(timeout).saturating_mul(framings).saturating_add(SETTLE)
}

/// The line with this speed and frame, and its own DTR and RTS.
fn with(
    line: &Endpoint,
    serial: SerialSettings,
    baud: Baud,
    character: Character,
) -> Result<Endpoint, InvalidSettings> {
    let serial = serial.with_baud(baud.0)?.with_data_bits(character.data_bits);
    line.clone().with_serial(serial.with_parity(character.parity).with_stop_bits(character.stop_bits))
}

#[cfg(test)]
mod tests {
    use super::*;

    const TIMEOUT: Duration = Duration::from_millis(300);

    fn trials(line: &str, framing: Option<Framing>, stations: &[u8]) -> Trials {
        Trials::new(&line.parse().unwrap(), &[], &[], framing, stations.to_vec()).unwrap()
    }

    fn texts(trials: &Trials) -> Vec<String> {
        let each = trials.iter(TIMEOUT).flat_map(|(station, setting, _)| {
            setting.framings.iter().map(move |framing| format!("{station} {}", setting.endpoint(*framing)))
        });
        each.collect()
    }

    #[test]
    fn factory_settings_come_first_and_each_setting_once() {
        let trials = trials("serial:/dev/x", None, &[1, 7]);
        let all = texts(&trials);
        assert_eq!(all[0], "1 serial:/dev/x");
        assert_eq!(all[1], "1 serial:/dev/x?baud=19200");
        assert_eq!(all[4], "1 serial:/dev/x?baud=57600");
        assert_eq!(all[5..7], ["1 serial:/dev/x?frame=8N1", "1 serial:/dev/x?framing=binary"]);
        assert_eq!((all.len(), trials.count()), (90, 90), "5 speeds, 9 frames and framings, 2 stations");
        assert_eq!(all.iter().collect::<std::collections::HashSet<_>>().len(), 90);
        assert!(all[..45].iter().all(|text| text.starts_with("1 ")) && all[45].starts_with("7 "));
        // 7 data bits have no binary framing.
        assert_eq!(all.iter().filter(|text| text.contains("frame=7") && text.contains("binary")).count(), 0);
    }

    #[test]
    fn the_time_is_stated_and_counted_down() {
        let trials = trials("serial:/dev/x", None, &[1, 2]);
        let longest = trials.longest(TIMEOUT);
        assert!((Duration::from_secs(28)..Duration::from_secs(31)).contains(&longest), "{longest:?}");
        let left: Vec<Duration> = trials.iter(TIMEOUT).map(|(_, _, left)| left).collect();
        assert_eq!(left[0], longest);
        assert!(left.is_sorted_by(|one, next| one > next));
        let last = trials.settings.last().unwrap();
        assert_eq!(*left.last().unwrap(), time_of(last, TIMEOUT));
        // 25 characters of 12 bits at 9600 baud.
        assert_eq!(trials.settings[0].wait(TIMEOUT), TIMEOUT + Duration::from_micros(31_250));
    }

    #[test]
    fn choices_narrow_the_trials_and_lines_of_the_port_are_kept() {
        let line: Endpoint = "serial:/dev/x?rs485=rts&dtr=on".parse().unwrap();
        let (baud, frame) = ("230400".parse().unwrap(), "8e2".parse().unwrap());
        let one = Trials::new(&line, &[baud], &[frame], Some(Framing::Binary), vec![9]).unwrap();
        assert_eq!(texts(&one), ["9 serial:/dev/x?baud=230400&frame=8E2&dtr=on&rs485=rts&framing=binary"]);
        assert_eq!(
            texts(&trials("tcp://10.0.0.1:4001", None, &[1])),
            ["1 tcp://10.0.0.1:4001", "1 tcp://10.0.0.1:4001?framing=binary"]
        );
    }

    #[test]
    fn impossible_choices_are_refused() {
        let line: Endpoint = "serial:/dev/x".parse().unwrap();
        let seven = "7E1".parse().unwrap();
        let error = Trials::new(&line, &[], &[seven], Some(Framing::Binary), vec![1]).unwrap_err();
        assert!(error.contains("8 data bits"), "{error}");
        let host: Endpoint = "tcp://10.0.0.1".parse().unwrap();
        assert!(Trials::new(&host, &[], &[seven], None, vec![1]).unwrap_err().contains("no --baud or --frame"));
        for text in ["", "7", "7E", "9E1", "7E3", "7E1&baud=300", "7X1"] {
            assert!(text.parse::<Character>().unwrap_err().contains("such as 7E1"), "{text}");
        }
        for text in ["", "299", "921601", "+9600", "x"] {
            assert!(text.parse::<Baud>().is_err(), "{text}");
        }
    }
}
