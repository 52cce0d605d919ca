use std::io;
use std::time::Duration;

use socket2::{SockRef, TcpKeepalive};
use tokio::net::TcpStream;

use super::{Address, Kind, Transport, authority};

pub(super) static KIND: Kind = Kind { prefix: "tcp://", own_options: None, is_remote: true, is_one_line: false, parse };

fn parse(address: &Address<'_>) -> Result<Transport, String> {
    let (host, port) = authority::parse(address.scheme, address.text, address.framing)?;
    Ok(Transport::Tcp { host, port })
}

/// Connects to the first address of the host that accepts.
pub(super) async fn connect(host: &str, port: u16, keep_alive: bool) -> io::Result<TcpStream> {
    let stream = TcpStream::connect((host, port)).await?;
    // Requests are single small writes followed by a wait: coalescing them only adds delay.
    stream.set_nodelay(true)?;
    if keep_alive {
        SockRef::from(&stream).set_tcp_keepalive(&TcpKeepalive::new().with_time(IDLE).with_interval(INTERVAL))?;
    }
    Ok(stream)
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
