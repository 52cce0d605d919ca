//! Opens the connections of a link.

use std::fmt;
use std::future::Future;
use std::io;
use std::sync::Arc;
use std::time::Duration;

use futures::future::{BoxFuture, FutureExt};
use tokio::io::{AsyncRead, AsyncWrite};

use crate::endpoint::Endpoint;
use crate::transport::BoxIo;

/// Opens connections.
pub(crate) enum Connector {
    /// To an endpoint, any number of times.
    Endpoint {
        endpoint: Arc<Endpoint>,
        /// TCP keep-alive.
        keep_alive: bool,
    },
    /// A single open connection; `None` once it was taken.
    Once(Option<BoxIo>),
    /// By a function of the user.
    Custom {
        open: Box<dyn FnMut() -> BoxFuture<'static, io::Result<BoxIo>> + Send>,
        /// `true` if the connections always wake their reader; never assumed of a user's.
        wakes_reader: bool,
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
        Self::Custom { open, wakes_reader: false }
    }

    /// Returns whether there is only one connection ever.
    pub(crate) fn is_once(&self) -> bool {
        matches!(self, Self::Once(_))
    }

    /// Returns whether another connection can be opened.
    pub(crate) fn reopens(&self) -> bool {
        !matches!(self, Self::Once(None))
    }

    /// Returns whether connections always wake their reader when data have come.
    pub(crate) fn wakes_reader(&self) -> bool {
        matches!(self, Self::Endpoint { .. } | Self::Custom { wakes_reader: true, .. })
    }

    /// Begins to open a connection, with this timeout, to the address of this number if the host has
    /// several and the transport chooses. `None`: there will never be another.
    pub(crate) fn open(&mut self, within: Duration, address: usize) -> Option<BoxFuture<'static, io::Result<BoxIo>>> {
        let opening = match self {
            Self::Endpoint { endpoint, keep_alive } => {
                let (endpoint, keep_alive) = (endpoint.clone(), *keep_alive);
                async move { endpoint.transport().open(endpoint.framing(), keep_alive, address).await }.boxed()
            }
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

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn connectors_show_their_endpoint_and_open_connections() {
        let endpoint: Endpoint = "tcp://127.0.0.1:500".parse().expect("an endpoint");
        let shown = format!("Connector({endpoint})");
        let endpoint = Connector::Endpoint { endpoint: Arc::new(endpoint), keep_alive: true };
        assert_eq!((format!("{endpoint:?}"), endpoint.wakes_reader()), (shown, true));

        let mut once = Connector::Once(Some(Box::new(tokio::io::empty())));
        assert_eq!((format!("{once:?}"), once.reopens()), ("Connector(once)".to_owned(), true));
        assert!(!once.wakes_reader(), "a user's stream may have data without waking its reader");
        assert!(once.open(Duration::from_secs(1), 0).expect("the connection").await.is_ok());
        assert!(!once.reopens() && once.open(Duration::from_secs(1), 0).is_none(), "it was taken");

        let mut custom = Connector::custom(|| async { Ok(tokio::io::empty()) });
        assert_eq!((format!("{custom:?}").as_str(), custom.wakes_reader()), ("Connector(custom)", false));
        for _ in 0..2 {
            assert!(custom.open(Duration::from_secs(1), 0).expect("always").await.is_ok() && custom.reopens());
        }
    }

    #[tokio::test(start_paused = true)]
    async fn an_attempt_to_connect_fails_at_its_timeout() {
        let mut never = Connector::custom(|| async { std::future::pending::<io::Result<tokio::io::Empty>>().await });
        let Err(error) = never.open(Duration::from_secs(3), 0).expect("an attempt").await else { panic!("connected") };
        assert_eq!((error.kind(), error.to_string().as_str()), (io::ErrorKind::TimedOut, "no connection within 3s"));
    }
}
