//! How the bytes get there: whatever the link task reads from and writes to, and how it is opened.

#[cfg_attr(not(feature = "serial"), path = "no_serial.rs")]
mod serial;
mod tcp;
mod udp;

use std::fmt;
use std::future::Future;
use std::io;
use std::time::Duration;

use futures::future::{BoxFuture, FutureExt};
use tokio::io::{AsyncRead, AsyncWrite};

use crate::endpoint::{Endpoint, Transport};

/// A connection.
pub(crate) trait Io: AsyncRead + AsyncWrite + Send + Unpin {}
impl<T: AsyncRead + AsyncWrite + Send + Unpin> Io for T {}

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
    Custom(Box<dyn FnMut() -> BoxFuture<'static, io::Result<BoxIo>> + Send>),
}

impl Connector {
    pub(crate) fn custom<F, Fut, T>(mut open: F) -> Self
    where
        F: FnMut() -> Fut + Send + 'static,
        Fut: Future<Output = io::Result<T>> + Send + 'static,
        T: AsyncRead + AsyncWrite + Send + Unpin + 'static,
    {
        Self::Custom(Box::new(move || {
            let opening = open();
            async move { Ok(Box::new(opening.await?) as BoxIo) }.boxed()
        }))
    }

    /// Whether there can be another connection after this one.
    pub(crate) fn reopens(&self) -> bool {
        !matches!(self, Self::Once(None))
    }

    /// Opens a connection, within the time. `None`: there will never be another.
    pub(crate) fn open(&mut self, within: Duration) -> Option<BoxFuture<'static, io::Result<BoxIo>>> {
        let opening = match self {
            Self::Endpoint { endpoint, keep_alive } => open(endpoint.clone(), *keep_alive).boxed(),
            Self::Once(io) => {
                let io = io.take()?;
                async move { Ok(io) }.boxed()
            }
            Self::Custom(open) => open(),
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
            Self::Custom(_) => f.write_str("Connector(custom)"),
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
