//! TLS of the outputs: trusted certificates from a file or from the system, and the certificate of the client.
//!
//! All files are PEM. They are read when an output starts, and when a configuration is checked: both find
//! the same faults, before anything is sent. Cryptography is `ring`.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use rustls::pki_types::pem::{Error as PemError, PemObject};
use rustls::pki_types::{CertificateDer, PrivateKeyDer};
use rustls::{ClientConfig, RootCertStore};

use crate::secret::located;

/// The files of a section with TLS.
#[derive(Clone, Copy, Debug, Default)]
pub struct TlsFiles<'a> {
    /// `ca_file`: certificates to trust; without it those of the system.
    pub ca: Option<&'a Path>,
    /// `cert_file`: the certificate of the client, and those between it and a trusted one.
    pub cert: Option<&'a Path>,
    /// `key_file`: the key of that certificate, without a passphrase.
    pub key: Option<&'a Path>,
}

/// Files that cannot be used for TLS. It names the file and the rule, and never the content.
#[derive(Debug, thiserror::Error)]
pub enum TlsError {
    /// A file that cannot be used.
    #[error("{}: {rule}", path.display())]
    File {
        /// The file.
        path: PathBuf,
        /// The rule that it breaks, or the error of the system.
        rule: String,
    },
    /// Certificate and key do not make a pair.
    #[error("{} is not the key of the certificate in {}: {reason}", key.display(), cert.display())]
    Pair {
        /// The file of the certificate.
        cert: PathBuf,
        /// The file of the key.
        key: PathBuf,
        /// The reason.
        reason: String,
    },
    /// A certificate without its key, or a key without its certificate.
    #[error("{0}")]
    Incomplete(&'static str),
    /// The system has no trusted certificates.
    #[error("the system has no trusted certificates ({0}): install them (package ca-certificates) or set ca_file")]
    NoSystemRoots(String),
    /// The cryptography has none of the versions of TLS.
    #[error("no version of TLS: {0}")]
    Version(rustls::Error),
}

impl TlsFiles<'_> {
    /// Reads the files and makes the configuration of a client. Blocks until the disk has read them.
    ///
    /// # Errors
    /// [`TlsError`] for a file that cannot be read, or that does not contain what its setting says.
    pub fn load(&self) -> Result<ClientConfig, TlsError> {
        let roots = match self.ca {
            Some(path) => roots_of_file(&resolved(path))?,
            None => roots_of_system()?,
        };
        let provider = Arc::new(rustls::crypto::ring::default_provider());
        let builder = ClientConfig::builder_with_provider(provider)
            .with_safe_default_protocol_versions()
            .map_err(TlsError::Version)?
            .with_root_certificates(roots);
        match (self.cert.map(resolved), self.key.map(resolved)) {
            (None, None) => Ok(builder.with_no_client_auth()),
            (Some(cert), Some(key)) => builder
                .with_client_auth_cert(certificates(&cert)?, private_key(&key)?)
                .map_err(|error| TlsError::Pair { cert, key, reason: error.to_string() }),
            (Some(_), None) => Err(TlsError::Incomplete("cert_file needs key_file")),
            (None, Some(_)) => Err(TlsError::Incomplete("key_file needs cert_file")),
        }
    }
}

/// A relative path is in `$CREDENTIALS_DIRECTORY` if the file is there: keys are credentials, certificates
/// need not be.
fn resolved(path: &Path) -> PathBuf {
    let credential = located(path);
    if credential.exists() { credential } else { path.to_owned() }
}

fn roots_of_file(path: &Path) -> Result<RootCertStore, TlsError> {
    let mut roots = RootCertStore::empty();
    for (number, certificate) in certificates(path)?.into_iter().enumerate() {
        let number = number.saturating_add(1);
        roots.add(certificate).map_err(|error| fault(path, format!("certificate {number}: {error}")))?;
    }
    Ok(roots)
}

/// The certificates that the system trusts. Those that cannot be read are left out.
fn roots_of_system() -> Result<RootCertStore, TlsError> {
    let found = rustls_native_certs::load_native_certs();
    let mut roots = RootCertStore::empty();
    let (added, _) = roots.add_parsable_certificates(found.certs);
    if added > 0 {
        return Ok(roots);
    }
    let reason = found.errors.first().map_or_else(|| "none found".to_owned(), ToString::to_string);
    Err(TlsError::NoSystemRoots(reason))
}

fn certificates(path: &Path) -> Result<Vec<CertificateDer<'static>>, TlsError> {
    let text = read(path)?;
    let certificates: Result<Vec<_>, PemError> = CertificateDer::pem_slice_iter(&text).collect();
    let certificates = certificates.map_err(|error| fault(path, pem_rule(&error)))?;
    if certificates.is_empty() {
        return Err(fault(path, "there is no certificate in the file (BEGIN CERTIFICATE)"));
    }
    Ok(certificates)
}

fn private_key(path: &Path) -> Result<PrivateKeyDer<'static>, TlsError> {
    const ENCRYPTED: &[u8] = b"BEGIN ENCRYPTED PRIVATE KEY";
    let text = read(path)?;
    PrivateKeyDer::from_pem_slice(&text).map_err(|error| {
        if !matches!(error, PemError::NoItemsFound) {
            fault(path, pem_rule(&error))
        } else if text.windows(ENCRYPTED.len()).any(|part| part == ENCRYPTED) {
            fault(path, "the key has a passphrase: use one without, readable by the bridge alone")
        } else {
            fault(path, "there is no private key in the file (BEGIN PRIVATE KEY)")
        }
    })
}

fn read(path: &Path) -> Result<Vec<u8>, TlsError> {
    std::fs::read(path).map_err(|error| fault(path, error.to_string()))
}

/// The rule of PEM that a file breaks. The text of the library would repeat the file, which may be a key.
fn pem_rule(error: &PemError) -> &'static str {
    match error {
        PemError::MissingSectionEnd { .. } => "a section of PEM has no END line",
        PemError::IllegalSectionStart { .. } => "a BEGIN line of PEM is malformed",
        PemError::Base64Decode(_) => "a section of PEM is not base64",
        PemError::SectionTooLarge => "a section of PEM is too large",
        // A slice has no errors of files, and the caller handles an empty one.
        PemError::Io(_) | PemError::NoItemsFound | _ => "the file is not PEM",
    }
}

fn fault(path: &Path, rule: impl Into<String>) -> TlsError {
    TlsError::File { path: path.to_owned(), rule: rule.into() }
}

#[cfg(test)]
mod tests {
    use rcgen::{CertificateParams, KeyPair};

    use super::*;

    struct Files {
        folder: tempfile::TempDir,
    }

    impl Files {
        fn new() -> Self {
            let folder = tempfile::tempdir().unwrap();
            let files = Self { folder };
            for name in ["a", "b"] {
                let key = KeyPair::generate().unwrap();
                let certificate = CertificateParams::new(vec![name.into()]).unwrap().self_signed(&key).unwrap();
                files.write(&format!("{name}.pem"), &certificate.pem());
                files.write(&format!("{name}.key"), &key.serialize_pem());
            }
            files
        }

        fn write(&self, name: &str, text: &str) {
            std::fs::write(self.path(name), text).unwrap();
        }

        fn path(&self, name: &str) -> PathBuf {
            self.folder.path().join(name)
        }

        fn load(&self, ca: &str, cert: Option<&str>, key: Option<&str>) -> Result<ClientConfig, String> {
            let (ca, cert, key) = (self.path(ca), cert.map(|name| self.path(name)), key.map(|name| self.path(name)));
            let files = TlsFiles { ca: Some(&ca), cert: cert.as_deref(), key: key.as_deref() };
            files.load().map_err(|error| error.to_string())
        }
    }

    #[test]
    fn a_ca_and_a_client_certificate_make_a_configuration() {
        let files = Files::new();
        assert!(!files.load("a.pem", None, None).unwrap().client_auth_cert_resolver.has_certs());
        assert!(files.load("a.pem", Some("b.pem"), Some("b.key")).unwrap().client_auth_cert_resolver.has_certs());
    }

    #[test]
    fn a_fault_names_the_file_and_the_rule() {
        let files = Files::new();
        files.write(
            "encrypted.key",
            "-----BEGIN ENCRYPTED PRIVATE KEY-----\nAAAA\n-----END ENCRYPTED PRIVATE KEY-----\n",
        );
        files.write("cut.pem", "-----BEGIN CERTIFICATE-----\nAAAA\n");
        files.write("text.pem", "-----BEGIN CERTIFICATE-----\n%%%%\n-----END CERTIFICATE-----\n");
        files.write("der.pem", "-----BEGIN CERTIFICATE-----\nAAAA\n-----END CERTIFICATE-----\n");
        for (ca, cert, key, expected) in [
            ("none.pem", None, None, "none.pem: No such file"),
            ("a.key", None, None, "a.key: there is no certificate"),
            ("cut.pem", None, None, "cut.pem: a section of PEM has no END line"),
            ("text.pem", None, None, "text.pem: a section of PEM is not base64"),
            ("der.pem", None, None, "der.pem: certificate 1: "),
            ("a.pem", Some("b.key"), Some("b.key"), "b.key: there is no certificate"),
            ("a.pem", Some("b.pem"), Some("b.pem"), "b.pem: there is no private key"),
            ("a.pem", Some("b.pem"), Some("encrypted.key"), "encrypted.key: the key has a passphrase"),
            ("a.pem", Some("a.pem"), Some("b.key"), "b.key is not the key of the certificate in "),
            ("a.pem", Some("b.pem"), None, "cert_file needs key_file"),
            ("a.pem", None, Some("b.key"), "key_file needs cert_file"),
        ] {
            let error = files.load(ca, cert, key).unwrap_err();
            assert!(error.contains(expected), "{error} is not {expected}");
        }
    }

    #[test]
    fn a_fault_of_a_key_does_not_repeat_it() {
        let files = Files::new();
        let key = std::fs::read_to_string(files.path("a.key")).unwrap();
        for malformed in [key.replacen("-----END", "----END", 1), key.replacen('\n', "\n%", 1)] {
            files.write("malformed.key", &malformed);
            let error = files.load("a.pem", Some("a.pem"), Some("malformed.key")).unwrap_err();
            assert!(key.lines().all(|line| line.len() < 30 || !error.contains(line)), "{error}");
        }
    }
}
