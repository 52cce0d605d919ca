//! Lookups of host names.

use std::io;
use std::net::{IpAddr, SocketAddr, ToSocketAddrs as _};

use tokio::sync::Semaphore;
use tokio::task::spawn_blocking;

/// The lookups of a process. Each blocks a thread until the resolver gives up, even if its link has given up before.
/// A runtime has 512 such threads, and other work needs them, too.
static LOOKUPS: Lookups = Lookups::new(64);

/// Lookups with a limit of those at once.
struct Lookups {
    permits: Semaphore,
}

/// Returns the addresses of a host.
pub(super) async fn lookup(host: &str, port: u16) -> io::Result<Vec<SocketAddr>> {
    if let Ok(address) = host.parse::<IpAddr>() {
        return Ok(vec![SocketAddr::new(address, port)]);
    }
    let host = host.to_owned();
    LOOKUPS.run(move || Ok((host.as_str(), port).to_socket_addrs()?.collect())).await
}

impl Lookups {
    const fn new(at_once: usize) -> Self {
        Self { permits: Semaphore::const_new(at_once) }
    }

    /// Runs a lookup in a thread, when there are few enough of them.
    async fn run<T: Send + 'static>(
        &'static self,
        lookup: impl FnOnce() -> io::Result<T> + Send + 'static,
    ) -> io::Result<T> {
        let permit = self.permits.acquire().await.map_err(io::Error::other)?;
        let found = spawn_blocking(move || {
            // Held until the thread is free, even if nothing waits for the result.
            let _permit = permit;
            lookup()
        });
        found.await.map_err(io::Error::other)?
    }
}

#[cfg(test)]
mod tests {
    use std::sync::mpsc;

    use super::*;

    /// With a dead name server, lookups of links that had given up took all threads of the runtime. Seen with a permit
    /// that the caller keeps: two are free while both threads go on.
    #[tokio::test]
    async fn a_lookup_that_hangs_counts_until_it_ends() {
        static LOOKUPS: Lookups = Lookups::new(2);
        let (mut ends, mut hanging) = (Vec::new(), Vec::new());
        let (begins, mut begun) = tokio::sync::mpsc::unbounded_channel();
        for _ in 0..2 {
            let (end, ended) = mpsc::channel::<()>();
            ends.push(end);
            let begins = begins.clone();
            hanging.push(tokio::spawn(LOOKUPS.run(move || {
                let _ = begins.send(());
                let _ = ended.recv();
                Ok(())
            })));
        }
        for _ in 0..2 {
            begun.recv().await.unwrap();
        }
        // Their callers give up.
        for task in hanging {
            task.abort();
            assert!(task.await.unwrap_err().is_cancelled());
        }
        assert_eq!(LOOKUPS.permits.available_permits(), 0, "their threads go on");
        let third = LOOKUPS.run(|| Ok(3));
        drop(ends.pop());
        assert_eq!(third.await.unwrap(), 3);
    }

    #[tokio::test]
    async fn an_address_needs_no_lookup() {
        assert_eq!(lookup("127.0.0.1", 500).await.unwrap(), [SocketAddr::from(([127, 0, 0, 1], 500))]);
        assert_eq!(lookup("::1", 500).await.unwrap(), ["[::1]:500".parse::<SocketAddr>().unwrap()]);
        assert!(lookup("localhost", 500).await.unwrap().iter().all(|address| address.ip().is_loopback()));
    }
}
