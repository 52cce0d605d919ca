use std::fmt;

use super::{InvalidSettings, UrlOptions};
use crate::printable::excerpt;
use crate::wire::Framing;

/// Settings of a serial port: baud rate, data bits, parity and stop bits, and the lines DTR and RTS.
/// No flow control.
///
/// ```
/// use fatek::endpoint::{DataBits, Parity, SerialSettings};
/// use fatek::wire::Framing;
///
/// let settings = SerialSettings::new(Framing::Ascii); // factory settings of the PLCs
/// assert_eq!(settings.to_string(), "9600 baud 7E1");
///
/// let settings = settings.with_baud(19_200)?.with_data_bits(DataBits::Eight).with_parity(Parity::None);
/// assert_eq!(settings.to_string(), "19200 baud 8N1");
/// # Ok::<(), fatek::endpoint::InvalidSettings>(())
/// ```
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct SerialSettings {
    baud: u32,
    data_bits: DataBits,
    parity: Parity,
    stop_bits: StopBits,
    dtr: Option<bool>,
    rts: Rts,
}

/// Minimum baud rate.
pub const MIN_BAUD: u32 = 300;

/// Maximum baud rate.
pub const MAX_BAUD: u32 = 921_600;

impl SerialSettings {
    /// The default settings of a framing: 9600 baud, and 7E1 for ASCII or 8N1 for binary.
    #[must_use]
    pub const fn new(framing: Framing) -> Self {
        let (data_bits, parity) = match framing {
            Framing::Ascii => (DataBits::Seven, Parity::Even),
            Framing::Binary => (DataBits::Eight, Parity::None),
        };
        Self { baud: 9600, data_bits, parity, stop_bits: StopBits::One, dtr: None, rts: Rts::Unchanged }
    }

    /// Sets the baud rate, in bits per second.
    ///
    /// # Errors
    /// [`InvalidSettings::Baud`] unless it is [`MIN_BAUD`] to [`MAX_BAUD`].
    pub const fn with_baud(mut self, baud: u32) -> Result<Self, InvalidSettings> {
        if baud < MIN_BAUD || baud > MAX_BAUD {
            return Err(InvalidSettings::Baud { baud });
        }
        self.baud = baud;
        Ok(self)
    }

    /// Sets the number of data bits.
    #[must_use]
    pub const fn with_data_bits(mut self, data_bits: DataBits) -> Self {
        self.data_bits = data_bits;
        self
    }

    /// Sets the parity.
    #[must_use]
    pub const fn with_parity(mut self, parity: Parity) -> Self {
        self.parity = parity;
        self
    }

    /// Sets the number of stop bits.
    #[must_use]
    pub const fn with_stop_bits(mut self, stop_bits: StopBits) -> Self {
        self.stop_bits = stop_bits;
        self
    }

    /// Sets the line DTR when the port is opened, to on or off. Default: as the operating system
    /// leaves it, which is on with most drivers.
    #[must_use]
    pub const fn with_dtr(mut self, on: bool) -> Self {
        self.dtr = Some(on);
        self
    }

    /// Sets the use of the line RTS: a constant level, or the direction of an RS-485 driver.
    ///
    /// ```
    /// use fatek::Endpoint;
    /// use fatek::endpoint::{Rts, SerialSettings};
    /// use fatek::wire::Framing;
    ///
    /// let settings = SerialSettings::new(Framing::Ascii).with_rts(Rts::OnWhileSending);
    /// let endpoint = Endpoint::serial("/dev/ttyS1").with_serial(settings)?;
    /// assert_eq!(endpoint.to_string(), "serial:/dev/ttyS1?rs485=rts");
    /// # Ok::<(), fatek::endpoint::InvalidSettings>(())
    /// ```
    #[must_use]
    pub const fn with_rts(mut self, rts: Rts) -> Self {
        self.rts = rts;
        self
    }

    /// The baud rate, in bits per second.
    #[must_use]
    pub const fn baud(&self) -> u32 {
        self.baud
    }

    /// The number of data bits.
    #[must_use]
    pub const fn data_bits(&self) -> DataBits {
        self.data_bits
    }

    /// The parity.
    #[must_use]
    pub const fn parity(&self) -> Parity {
        self.parity
    }

    /// The number of stop bits.
    #[must_use]
    pub const fn stop_bits(&self) -> StopBits {
        self.stop_bits
    }

    /// The level that the line DTR is set to; `None`: it is left as it is.
    #[must_use]
    pub const fn dtr(&self) -> Option<bool> {
        self.dtr
    }

    /// The use of the line RTS.
    #[must_use]
    pub const fn rts(&self) -> Rts {
        self.rts
    }

    /// Returns these settings, or 8N1 at the same baud rate if the framing needs more data bits.
    pub(crate) fn for_framing(self, framing: Framing) -> Self {
        match self.check(framing) {
            Ok(settings) => settings,
            Err(_) => self.with_data_bits(DataBits::Eight).with_parity(Parity::None).with_stop_bits(StopBits::One),
        }
    }

    /// Reads the options of [`URL_OPTIONS`]. The error is the rule that one of them breaks.
    pub(crate) fn from_url(options: &UrlOptions<'_>, framing: Framing) -> Result<Self, String> {
        let mut settings = Self::new(framing);
        if let Some(text) = options.get("baud") {
            let baud = text.parse().ok().filter(|_| text.bytes().all(|b| b.is_ascii_digit()));
            settings = baud.and_then(|baud| settings.with_baud(baud).ok()).ok_or_else(|| {
                format!("the baud rate `{}` must be a number from {MIN_BAUD} to {MAX_BAUD}", excerpt(text))
            })?;
        }
        if let Some(text) = options.get("frame") {
            settings = settings.with_character(text).ok_or_else(|| {
                format!(
                    "the frame `{}` must be data bits (7, 8), parity (N, E, O) and stop bits (1, 2), as in `7E1`",
                    excerpt(text)
                )
            })?;
        }
        if let Some(text) = options.get("dtr") {
            settings = settings.with_dtr(level("dtr", text)?);
        }
        if let Some(text) = options.get("rts") {
            settings = settings.with_rts(if level("rts", text)? { Rts::On } else { Rts::Off });
        }
        if let Some(text) = options.get("rs485") {
            if options.get("rts").is_some() {
                return Err("`rs485` and `rts` exclude each other: RS-485 needs the line RTS".to_owned());
            }
            settings = settings.with_rts(match text {
                "rts" => Rts::OnWhileSending,
                "rts-inverted" => Rts::OffWhileSending,
                _ => {
                    return Err(format!(
                        "the RS-485 mode `{}` must be `rts` (RTS is on while sending) or `rts-inverted` (off)",
                        excerpt(text)
                    ));
                }
            });
        }
        Ok(settings)
    }

    /// The options for a URL: those that differ from the defaults of the framing.
    pub(crate) fn url_options(self, framing: Framing) -> impl Iterator<Item = String> {
        let usual = Self::new(framing).option_texts();
        let options = self.option_texts().into_iter().zip(usual).filter(|(own, usual)| own != usual);
        options.filter_map(|((name, text), _)| Some(format!("{name}={}", text?)))
    }

    /// The names of [`URL_OPTIONS`] with their texts; `None` for a line that is left as it is.
    pub(crate) fn option_texts(self) -> [(&'static str, Option<String>); 5] {
        let (rts, rs485) = match self.rts {
            Rts::Unchanged => (None, None),
            Rts::On => (Some(level_name(true)), None),
            Rts::Off => (Some(level_name(false)), None),
            Rts::OnWhileSending => (None, Some("rts")),
            Rts::OffWhileSending => (None, Some("rts-inverted")),
        };
        [
            ("baud", Some(self.baud.to_string())),
            ("frame", Some(self.character())),
            ("dtr", self.dtr.map(|on| level_name(on).to_owned())),
            ("rts", rts.map(str::to_owned)),
            ("rs485", rs485.map(str::to_owned)),
        ]
    }

    /// Data bits, parity and stop bits, as in `7E1`.
    fn character(&self) -> String {
        format!("{}{}{}", self.data_bits, self.parity, self.stop_bits)
    }

    /// Sets data bits, parity and stop bits from a text such as `7E1`; `None` if it is malformed.
    fn with_character(self, text: &str) -> Option<Self> {
        let mut letters = text.chars();
        let data_bits = match letters.next()? {
            '7' => DataBits::Seven,
            '8' => DataBits::Eight,
            _ => return None,
        };
        let parity = match letters.next()?.to_ascii_uppercase() {
            'N' => Parity::None,
            'E' => Parity::Even,
            'O' => Parity::Odd,
            _ => return None,
        };
        let stop_bits = match letters.next()? {
            '1' => StopBits::One,
            '2' => StopBits::Two,
            _ => return None,
        };
        let settings = self.with_data_bits(data_bits).with_parity(parity).with_stop_bits(stop_bits);
        letters.next().is_none().then_some(settings)
    }

    /// Checks that there are enough data bits: the binary framing uses all values of a byte.
    pub(crate) fn check(self, framing: Framing) -> Result<Self, InvalidSettings> {
        match (framing, self.data_bits) {
            (Framing::Binary, DataBits::Seven) => Err(InvalidSettings::DataBits { settings: self }),
            (Framing::Binary, DataBits::Eight) | (Framing::Ascii, _) => Ok(self),
        }
    }
}

/// The options of a URL for a serial port.
pub(crate) const URL_OPTIONS: &[&str] = &["baud", "frame", "dtr", "rts", "rs485"];

fn level(name: &str, text: &str) -> Result<bool, String> {
    match text {
        "on" => Ok(true),
        "off" => Ok(false),
        _ => Err(format!("the level `{}` of `{name}` must be `on` or `off`", excerpt(text))),
    }
}

fn level_name(on: bool) -> &'static str {
    if on { "on" } else { "off" }
}

impl fmt::Display for SerialSettings {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} baud {}", self.baud, self.character())
    }
}

/// Number of data bits per character. The ASCII framing needs seven, the binary framing eight.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
#[non_exhaustive]
pub enum DataBits {
    /// 7.
    Seven,
    /// 8.
    Eight,
}

impl fmt::Display for DataBits {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(match self {
            Self::Seven => "7",
            Self::Eight => "8",
        })
    }
}

/// Parity bit of a character.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
#[non_exhaustive]
pub enum Parity {
    /// N: no parity bit.
    None,
    /// E: an even number of ones, parity bit included.
    Even,
    /// O: an odd number of ones, parity bit included.
    Odd,
}

impl fmt::Display for Parity {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(match self {
            Self::None => "N",
            Self::Even => "E",
            Self::Odd => "O",
        })
    }
}

/// Number of stop bits per character.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
#[non_exhaustive]
pub enum StopBits {
    /// 1.
    One,
    /// 2.
    Two,
}

impl fmt::Display for StopBits {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(match self {
            Self::One => "1",
            Self::Two => "2",
        })
    }
}

/// The line RTS of a serial port.
///
/// RS-485 drivers that RTS switches must receive again before the PLC answers. Where the driver of
/// the operating system has a mode for this, it is used (Linux, `TIOCSRS485`). Elsewhere the port
/// switches RTS: by the transmission time of what was written, and not before the operating
/// system has passed it all on. The second way is exact to about a tenth of a millisecond; setting
/// RTS holds the thread of the runtime for as long as the adapter takes, about a millisecond on USB.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
#[non_exhaustive]
pub enum Rts {
    /// As the operating system leaves it, which is on with most drivers.
    #[default]
    Unchanged,
    /// On.
    On,
    /// Off.
    Off,
    /// RS-485: on while sending.
    OnWhileSending,
    /// RS-485: off while sending.
    OffWhileSending,
}
