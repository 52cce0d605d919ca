//! How the bytes get there: whatever the link task reads from and writes to, and how it is opened.

#[cfg_attr(not(feature = "serial"), path = "no_serial.rs")]
mod serial;
mod tcp;
mod udp;

use std::any::Any;
use std::fmt;
use std::future::Future;
use std::io;
use std::time::Duration;

use futures::future::{BoxFuture, FutureExt};
use tokio::io::{AsyncRead, AsyncWrite};

use crate::endpoint::{Endpoint, Transport};

/// A connection.
pub(crate) trait Io: AsyncRead + AsyncWrite + Send + Unpin + Any {}
impl<T: AsyncRead + AsyncWrite + Send + Unpin + Any> Io for T {}

/// Datagrams that came to the ports of earlier requests.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct Late {
    /// Copies of the datagram that was read from that port last.
    pub(crate) copies: u64,
    /// Any others.
    pub(crate) others: u64,
}

impl dyn Io {
    /// Returns the datagrams of earlier requests dropped since the last call; none for anything but UDP.
    ///
    /// A method of the trait would be found on the box, which is a connection itself, before the one within.
    pub(crate) fn take_late(&mut self) -> Late {
        let io: &mut dyn Any = self;
        io.downcast_mut().map(udp::Datagrams::take_late).unwrap_or_default()
    }
}

pub(crate) type BoxIo = Box<dyn Io>;

/// Opens connections.
pub(crate) enum Connector {
    /// To an endpoint, as often as needed.
    Endpoint {
        endpoint: Endpoint,
        /// Whether TCP asks for signs of life.
        keep_alive: bool,
    },
    /// The one connection there is.
    Once(Option<BoxIo>),
    /// As the user says.
    Custom {
        open: Box<dyn FnMut() -> BoxFuture<'static, io::Result<BoxIo>> + Send>,
        /// Whether they are as good as ours; nobody says so of a user's.
        tells: bool,
    },
}

impl Connector {
    pub(crate) fn custom<F, Fut, T>(mut open: F) -> Self
    where
        F: FnMut() -> Fut + Send + 'static,
        Fut: Future<Output = io::Result<T>> + Send + 'static,
        T: AsyncRead + AsyncWrite + Send + Unpin + 'static,
    {
        let open = Box::new(move || {
            let opening = open();
            async move { Ok(Box::new(opening.await?) as BoxIo) }.boxed()
        });
        Self::Custom { open, tells: false }
    }

    /// Whether there can be another connection after this one.
    pub(crate) fn reopens(&self) -> bool {
        !matches!(self, Self::Once(None))
    }

    /// Whether its connections surely wake their reader, whenever something has come: ours do.
    pub(crate) fn tells(&self) -> bool {
        matches!(self, Self::Endpoint { .. } | Self::Custom { tells: true, .. })
    }

    /// Opens a connection, within the time. `None`: there will never be another.
    pub(crate) fn open(&mut self, within: Duration) -> Option<BoxFuture<'static, io::Result<BoxIo>>> {
        let opening = match self {
            Self::Endpoint { endpoint, keep_alive } => open(endpoint.clone(), *keep_alive).boxed(),
            Self::Once(io) => {
                let io = io.take()?;
                async move { Ok(io) }.boxed()
            }
            Self::Custom { open, .. } => open(),
        };
        let limited = async move {
            match tokio::time::timeout(within, opening).await {
                Ok(result) => result,
                Err(_) => Err(io::Error::new(io::ErrorKind::TimedOut, format!("no connection within {within:?}"))),
            }
        };
        Some(limited.boxed())
    }
}

impl fmt::Debug for Connector {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Endpoint { endpoint, .. } => write!(f, "Connector({endpoint})"),
            Self::Once(_) => f.write_str("Connector(once)"),
            Self::Custom { .. } => f.write_str("Connector(custom)"),
        }
    }
}

async fn open(endpoint: Endpoint, keep_alive: bool) -> io::Result<BoxIo> {
    Ok(match endpoint.transport() {
        Transport::Tcp { host, port } => Box::new(tcp::connect(host, *port, keep_alive).await?),
        Transport::Udp { host, port } => Box::new(udp::connect(host, *port, endpoint.framing()).await?),
        Transport::Serial { path, settings } => Box::new(serial::open(path, *settings).await?),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn a_connector_is_shown_by_where_it_leads_and_opens_what_it_can() {
        let endpoint: Endpoint = "tcp://127.0.0.1:500".parse().expect("it is one");
        let shown = format!("Connector({endpoint})");
        assert_eq!(format!("{:?}", Connector::Endpoint { endpoint, keep_alive: true }), shown);

        let mut once = Connector::Once(Some(Box::new(tokio::io::empty())));
        assert_eq!((format!("{once:?}"), once.reopens()), ("Connector(once)".to_owned(), true));
        assert!(once.open(Duration::from_secs(1)).expect("there is one").await.is_ok());
        assert!(!once.reopens() && once.open(Duration::from_secs(1)).is_none(), "there was only one");

        let mut custom = Connector::custom(|| async { Ok(tokio::io::empty()) });
        assert_eq!(format!("{custom:?}"), "Connector(custom)");
        for _ in 0..2 {
            assert!(custom.open(Duration::from_secs(1)).expect("always").await.is_ok() && custom.reopens());
        }
    }

    #[tokio::test(start_paused = true)]
    async fn what_does_not_open_in_its_time_fails_and_says_so() {
        let mut never = Connector::custom(|| async { std::future::pending::<io::Result<tokio::io::Empty>>().await });
        let Err(error) = never.open(Duration::from_secs(3)).expect("it can be tried").await else {
            panic!("it opened")
        };
        assert_eq!((error.kind(), error.to_string().as_str()), (io::ErrorKind::TimedOut, "no connection within 3s"));
    }
}
