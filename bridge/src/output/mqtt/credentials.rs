//! The files of a connection: password, trusted certificates, and the certificate of the client.

use rustls::ClientConfig;

use crate::config::MqttSection;
use crate::secret::{Secret, SecretError};
use crate::tls::{TlsError, TlsFiles};

/// The content of the files of `[mqtt]`. They are read anew for each connection, so that a password or a
/// certificate that was renewed needs no restart.
#[derive(Clone, Debug)]
pub struct Credentials {
    pub(super) user: Option<String>,
    pub(super) password: Option<Secret>,
    pub(super) tls: Option<ClientConfig>,
}

/// A file of `[mqtt]` that cannot be used. It names the file and the rule, and never the content.
#[derive(Debug, thiserror::Error)]
pub enum CredentialsError {
    /// The file of the password.
    #[error("password: {0}")]
    Password(#[from] SecretError),
    /// A file of TLS.
    #[error("TLS: {0}")]
    Tls(#[from] TlsError),
}

impl Credentials {
    /// Reads the files of a section, without a connection. Blocks until the disk has read them.
    ///
    /// # Errors
    /// [`CredentialsError`] for a file that cannot be read, or that does not contain what its setting says.
    pub fn load(section: &MqttSection) -> Result<Self, CredentialsError> {
        let files = TlsFiles {
            ca: section.ca_file.as_deref(),
            cert: section.cert_file.as_deref(),
            key: section.key_file.as_deref(),
        };
        Ok(Self {
            user: section.user.clone(),
            password: section.password()?,
            tls: if section.url.is_tls() { Some(files.load()?) } else { None },
        })
    }
}
