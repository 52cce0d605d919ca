use std::io;
use std::mem::MaybeUninit;
use std::net::SocketAddr;
use std::time::Duration;

use futures::stream::{FuturesUnordered, StreamExt as _};
use socket2::{SockRef, TcpKeepalive};
use tokio::net::TcpStream;

use super::lookup::lookup;
use super::{Address, Kind, Transport, authority};

pub(super) static KIND: Kind = Kind { prefix: "tcp://", own_options: None, is_remote: true, is_one_line: false, parse };

fn parse(address: &Address<'_>) -> Result<Transport, String> {
    let (host, port) = authority::parse(address.scheme, address.text, address.framing)?;
    Ok(Transport::Tcp { host, port })
}

/// Connects to an address of the host: each gets its chance, for the first one may be dead.
pub(super) async fn connect(host: &str, port: u16, keep_alive: bool) -> io::Result<TcpStream> {
    let stream = connect_any(lookup(host, port).await?).await?;
    // Requests are single small writes followed by a wait: coalescing them only adds delay.
    stream.set_nodelay(true)?;
    if keep_alive {
        SockRef::from(&stream).set_tcp_keepalive(&TcpKeepalive::new().with_time(IDLE).with_interval(INTERVAL))?;
    }
    Ok(stream)
}

/// Connects to the first of several addresses that accepts. An attempt begins when the one before
/// it has failed, or has lasted for [`ATTEMPT_DELAY`] (RFC 8305, section 5).
async fn connect_any(addresses: Vec<SocketAddr>) -> io::Result<TcpStream> {
    let mut waiting = alternate_families(addresses).into_iter();
    let mut attempts = FuturesUnordered::new();
    let mut failed = None;
    loop {
        match waiting.next() {
            Some(address) => attempts.push(TcpStream::connect(address)),
            None if attempts.is_empty() => {
                let none = || io::Error::new(io::ErrorKind::NotFound, "the host has no address");
                return Err(failed.unwrap_or_else(none));
            }
            None => {}
        }
        let more = waiting.len() > 0;
        tokio::select! {
            Some(result) = attempts.next() => match result {
                Ok(stream) => return Ok(stream),
                Err(error) => failed = Some(error),
            },
            () = tokio::time::sleep(ATTEMPT_DELAY), if more => {}
        }
    }
}

/// The addresses in their order, but those of both families in turn (RFC 8305, section 4).
fn alternate_families(addresses: Vec<SocketAddr>) -> Vec<SocketAddr> {
    let Some(first) = addresses.first().map(SocketAddr::is_ipv6) else { return addresses };
    let (same, other): (Vec<_>, Vec<_>) = addresses.into_iter().partition(|address| address.is_ipv6() == first);
    let (mut same, mut other) = (same.into_iter(), other.into_iter());
    let mut alternate = Vec::with_capacity(same.len().saturating_add(other.len()));
    while same.len() > 0 || other.len() > 0 {
        alternate.extend(same.next());
        alternate.extend(other.next());
    }
    alternate
}

/// Pause between two attempts to connect to addresses of one host.
const ATTEMPT_DELAY: Duration = Duration::from_millis(250);

/// Returns whether the peer has closed the connection, without a look at data before that.
pub(super) fn is_closed_by_peer(stream: &TcpStream) -> bool {
    match SockRef::from(stream).peek(&mut [MaybeUninit::uninit()]) {
        Ok(count) => count == 0,
        Err(error) => error.kind() != io::ErrorKind::WouldBlock,
    }
}

/// Silence before the first keep-alive probe. A module that was switched off sends nothing, and its
/// connection would stay open.
const IDLE: Duration = Duration::from_secs(30);

/// Time between two keep-alive probes.
const INTERVAL: Duration = Duration::from_secs(10);

#[cfg(test)]
mod tests {
    use super::*;
    use tokio::net::TcpListener;

    #[test]
    fn addresses_of_both_families_alternate() {
        let parse = |texts: &[&str]| texts.iter().map(|text| text.parse().unwrap()).collect::<Vec<SocketAddr>>();
        let given = parse(&["[::1]:1", "[::2]:1", "[::3]:1", "10.0.0.1:1"]);
        assert_eq!(alternate_families(given), parse(&["[::1]:1", "10.0.0.1:1", "[::2]:1", "[::3]:1"]));
        let given = parse(&["[::1]:1", "10.0.0.1:1", "10.0.0.2:1", "10.0.0.3:1"]);
        assert_eq!(alternate_families(given.clone()), given);
        assert_eq!(alternate_families(Vec::new()), []);
    }

    /// A listener whose queue is full: further connections get no answer at all. Returns what keeps it
    /// so, too.
    #[cfg(target_os = "linux")]
    async fn dead_address() -> (SocketAddr, socket2::Socket, Vec<TcpStream>) {
        let socket = socket2::Socket::new(socket2::Domain::IPV4, socket2::Type::STREAM, None).unwrap();
        socket.bind(&"127.0.0.1:0".parse::<SocketAddr>().unwrap().into()).unwrap();
        socket.listen(0).unwrap();
        let dead = socket.local_addr().unwrap().as_socket().unwrap();
        let mut queued = Vec::new();
        while let Ok(stream) = tokio::time::timeout(ATTEMPT_DELAY, TcpStream::connect(dead)).await {
            queued.push(stream.unwrap());
        }
        (dead, socket, queued)
    }

    #[cfg(target_os = "linux")]
    #[tokio::test]
    async fn a_refusal_does_not_end_the_attempts_under_way() {
        let (dead, _listener, _queued) = dead_address().await;
        tokio::time::pause();
        let refused = "127.0.0.1:1".parse().unwrap();
        let attempts = tokio::time::timeout(10 * ATTEMPT_DELAY, connect_any(vec![dead, refused])).await;
        assert!(attempts.is_err(), "the first address may still answer");
    }

    /// Before: a name whose first address was dead could not be connected to, ever.
    #[cfg(target_os = "linux")]
    #[tokio::test]
    async fn a_dead_first_address_costs_a_quarter_of_a_second() {
        let (dead, _listener, _queued) = dead_address().await;
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let live = listener.local_addr().unwrap();
        let refused = "127.0.0.1:1".parse().unwrap();
        for addresses in [vec![dead, live], vec![refused, live], vec![dead, refused, dead, live], vec![live, dead]] {
            let stream = tokio::time::timeout(10 * ATTEMPT_DELAY, connect_any(addresses.clone())).await;
            assert_eq!(stream.expect("in time").unwrap().peer_addr().unwrap(), live, "{addresses:?}");
        }
        assert!(connect_any(vec![refused]).await.is_err());
    }

    #[tokio::test]
    async fn a_close_is_seen_before_the_runtime_has_looked() {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let client = connect("127.0.0.1", listener.local_addr().unwrap().port(), true).await.unwrap();
        let (plc, _) = listener.accept().await.unwrap();
        assert!(!is_closed_by_peer(&client));
        plc.try_write(&[1]).unwrap();
        drop(plc);
        assert!(!is_closed_by_peer(&client), "data come first");
        let mut byte = [0];
        tokio::io::AsyncReadExt::read_exact(&mut { client }, &mut byte).await.unwrap();
    }

    #[tokio::test]
    async fn connections_have_nodelay_and_keep_alive() {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let port = listener.local_addr().unwrap().port();
        for keep_alive in [true, false] {
            let stream = connect("127.0.0.1", port, keep_alive).await.unwrap();
            let socket = SockRef::from(&stream);
            assert!(stream.nodelay().unwrap());
            assert_eq!(socket.keepalive().unwrap(), keep_alive);
            #[cfg(target_os = "linux")]
            if keep_alive {
                assert_eq!(socket.tcp_keepalive_time().unwrap(), IDLE);
                assert_eq!(socket.tcp_keepalive_interval().unwrap(), INTERVAL);
            }
        }
    }
}
