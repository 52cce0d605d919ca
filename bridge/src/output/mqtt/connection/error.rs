//! Errors of a connection, in words that say what to do.

use std::io;
use std::time::Duration;

use rumqttc::v5::mqttbytes::v5::ConnectReturnCode;
use rustls::{AlertDescription, CertificateError};

/// A connection that cannot be opened.
#[derive(Debug, thiserror::Error)]
pub(in crate::output::mqtt) enum ConnectError {
    /// No connection of TCP.
    #[error("cannot connect: {0}")]
    Connect(io::Error),
    /// The host cannot be in a certificate.
    #[error("TLS: the host of url is not a name that a certificate can have")]
    HostName,
    /// TLS failed.
    #[error("TLS: {0}")]
    Tls(String),
    /// The broker does not take the client.
    #[error("the broker has refused the connection: {}", refusal(*.0))]
    Refused(ConnectReturnCode),
    /// Something else than a CONNACK came.
    #[error("the broker does not speak MQTT 5")]
    NotMqtt5,
    /// Without acknowledgements nothing is known to be delivered.
    #[error("the broker has no acknowledgements (its maximum QoS is 0)")]
    NoAcknowledgements,
    /// It was lost before the CONNACK.
    #[error("the connection was lost before the broker has accepted it: {0}")]
    Lost(String),
    /// It took too long.
    #[error("no answer within {0:?}")]
    Timeout(Duration),
}

/// A connection that was lost.
#[derive(Debug, thiserror::Error)]
pub(in crate::output::mqtt) enum LostError {
    /// An error of the system or of TLS.
    #[error("the connection was lost: {0}")]
    Io(io::Error),
    /// The broker has closed it.
    #[error("the connection was lost: the broker has closed it")]
    Closed,
    /// The broker has said so, with this reason.
    #[error("the broker has ended the connection: {}", disconnect_reason(*.0))]
    Disconnected(u8),
    /// The broker has sent something that is not MQTT 5.
    #[error("the broker has sent a malformed packet: {0}")]
    Malformed(String),
    /// The broker does not answer.
    #[error("the broker has not answered for {0:?}")]
    Silent(Duration),
    /// The broker answers, but does not acknowledge a batch.
    #[error("the broker has not acknowledged a message for {0:?}")]
    Unanswered(Duration),
}

impl LostError {
    /// Returns whether the broker has ended the connection because of a message that it had been sent.
    pub(in crate::output::mqtt) fn blames_a_message(&self) -> bool {
        // Malformed packet, topic name invalid, packet too large, payload format invalid.
        matches!(self, Self::Disconnected(0x81 | 0x90 | 0x95 | 0x99))
    }

    /// Returns whether another client has the same id.
    pub(in crate::output::mqtt) fn is_taken_over(&self) -> bool {
        matches!(self, Self::Disconnected(0x8E))
    }
}

/// The error of a connection that is lost before the CONNACK. With TLS 1.3 this is where a client learns that its
/// certificate was refused.
pub(super) fn lost_at_connect(error: &LostError) -> ConnectError {
    match error {
        LostError::Io(error) if tls_error(error).is_some() => of_tls(error),
        LostError::Io(error) => ConnectError::Lost(error.to_string()),
        LostError::Closed => ConnectError::Lost("the broker has closed it".to_owned()),
        LostError::Disconnected(_) | LostError::Malformed(_) | LostError::Silent(_) | LostError::Unanswered(_) => {
            ConnectError::Lost(error.to_string())
        }
    }
}

/// The error of TLS, with the setting that it depends on.
pub(super) fn of_tls(error: &io::Error) -> ConnectError {
    let hint = match tls_error(error) {
        Some(rustls::Error::InvalidCertificate(CertificateError::UnknownIssuer)) => {
            "the certificate of the broker is signed by an authority that ca_file, or without it the system, does \
             not have"
        }
        Some(rustls::Error::InvalidCertificate(
            CertificateError::NotValidForName | CertificateError::NotValidForNameContext { .. },
        )) => "the certificate of the broker is for another name than the host of url",
        Some(rustls::Error::InvalidCertificate(
            CertificateError::Expired | CertificateError::ExpiredContext { .. },
        )) => "the certificate of the broker has expired",
        Some(rustls::Error::AlertReceived(AlertDescription::CertificateRequired)) => {
            "the broker wants a certificate of the client: set cert_file and key_file"
        }
        Some(rustls::Error::AlertReceived(
            AlertDescription::UnknownCA | AlertDescription::BadCertificate | AlertDescription::CertificateUnknown,
        )) => "the broker does not trust the certificate of the client in cert_file",
        Some(rustls::Error::InvalidMessage(_)) => "the port of the broker is one without TLS",
        _ => return ConnectError::Tls(error.to_string()),
    };
    ConnectError::Tls(format!("{hint} ({error})"))
}

fn tls_error(error: &io::Error) -> Option<&rustls::Error> {
    error.get_ref()?.downcast_ref()
}

fn refusal(code: ConnectReturnCode) -> String {
    use ConnectReturnCode as Code;
    let is_one_of = |codes: &[Code]| codes.contains(&code);
    let hint = if code == Code::BadUserNamePassword {
        "user name or password is wrong"
    } else if code == Code::NotAuthorized {
        "not authorized: user name or password is wrong, or it may not connect"
    } else if is_one_of(&[Code::UnsupportedProtocolVersion, Code::RefusedProtocolVersion]) {
        "it does not speak MQTT 5"
    } else if is_one_of(&[Code::ClientIdentifierNotValid, Code::BadClientId]) {
        "it does not take the client id, which is made of prefix and id"
    } else {
        // The names of the others say enough.
        return format!("{code:?}");
    };
    hint.to_owned()
}

fn disconnect_reason(reason: u8) -> String {
    let name = match reason {
        0x00 => "without a reason",
        0x81 => "malformed packet",
        0x82 => "protocol error",
        0x87 => "not authorized",
        0x89 => "server busy",
        0x8B => "server shutting down",
        0x8D => "keep alive timeout",
        0x8E => "another client with the same id has connected; bridges of one broker need different ids",
        0x90 => "topic name invalid",
        0x93 => "receive maximum exceeded",
        0x95 => "packet too large",
        0x96 => "message rate too high",
        0x97 => "quota exceeded",
        0x98 => "administrative action",
        0x99 => "payload format invalid",
        0x9C | 0x9D => "use another server",
        _ => "for another reason",
    };
    format!("{name} (0x{reason:02X})")
}
