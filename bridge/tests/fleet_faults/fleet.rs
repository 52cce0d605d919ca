//! A fleet of real processes with its server, PLCs, recorder and oracle.

use std::path::PathBuf;
use std::time::{Duration, Instant};

use async_nats::jetstream::{self, stream::Config as StoreConfig};
use fatek_bridge::config::{Config, Name, NatsSection};
use fatek_bridge::fleet;
use tokio::sync::{Mutex, broadcast};

use super::common::bridge::write_config;
use super::common::nats::NatsServer;
use super::member::{Member, Start};
use super::oracle::Oracle;
use super::plan::LEASE;
use super::plcs::Plcs;
use super::processes::Processes;
use super::proxy::{Moment, Proxy, Sessions};
use super::recorder::{Recorder, STREAM, make_store};

/// The PLCs, each with a link of its own.
pub(crate) const LINKS: [&str; 10] =
    ["plc10", "plc11", "plc12", "plc13", "plc14", "plc15", "plc16", "plc17", "plc18", "plc19"];
/// The section of the members.
const FLEET: &str = "[fleet]\nid = 'plant'\nbucket = 'leases'\nlease = '500ms'\n";
/// The longest wait for the fleet to be well: much longer than on a loaded machine.
const PATIENCE: Duration = Duration::from_secs(40);

/// The fleet.
pub(crate) struct Fleet {
    folder: tempfile::TempDir,
    pub(crate) server: Mutex<NatsServer>,
    pub(crate) recorder: Mutex<Recorder>,
    pub(crate) plcs: Plcs,
    processes: Processes,
    sessions: Sessions,
    pub(crate) moments: broadcast::Sender<Moment>,
    /// The ids of the links, in the order of [`LINKS`].
    links: Vec<String>,
    /// `None`: no process of the member is started.
    pub(crate) members: Vec<Mutex<Option<Member>>>,
    /// The ways of processes that have ended: messages that they hold may still be delivered.
    former: Mutex<Vec<Proxy>>,
    oracle: Mutex<Oracle>,
    nats: NatsSection,
    /// The configuration of the store.
    store: StoreConfig,
    naive: Option<&'static str>,
    /// Expiry by the server, for the variant that relies on it.
    #[cfg(feature = "naive-fleet")]
    pub(crate) expiry: Option<super::ttl::Expiry>,
}

impl Fleet {
    /// A fleet with its store and without members. `None`: there is no server on this machine.
    pub(crate) async fn new(naive: Option<&'static str>) -> Option<Self> {
        let folder = tempfile::tempdir().unwrap();
        let server = NatsServer::start(folder.path())?;
        let processes = Processes::default();
        let (plcs, links) = well_placed(&processes);
        let port = server.port();
        let url = format!("nats://127.0.0.1:{port}");
        let direct = write_config(folder.path(), &plant(&plcs, &url, ""));
        let nats = Config::load(&direct).unwrap().nats.unwrap();
        let store = make_first_store(&nats, &server).await;
        let recorder = Recorder::start(port).await;
        let sessions = Sessions::default();
        Some(Self {
            #[cfg(feature = "naive-fleet")]
            expiry: naive
                .filter(|naive| *naive == "ttl")
                .map(|_| super::ttl::Expiry::start(port, sessions.clone(), links.clone())),
            folder,
            server: Mutex::new(server),
            recorder: Mutex::new(recorder),
            plcs,
            processes,
            sessions,
            moments: broadcast::channel(1024).0,
            members: (0..5).map(|_| Mutex::new(None)).collect(),
            former: Mutex::default(),
            oracle: Mutex::new(Oracle::new(links.clone())),
            links,
            nats,
            store,
            naive,
        })
    }

    /// Starts a process of a member, whose place must be empty.
    pub(crate) async fn start(&self, member: usize) {
        let mut place = self.members[member].lock().await;
        assert!(place.is_none(), "a member runs once");
        let id = id_of(member);
        let number = self.processes.add();
        let port = self.server.lock().await.port();
        let proxy = Proxy::start(number, port, self.sessions.clone(), self.moments.clone()).await;
        let state = self.folder.path().join(&id);
        std::fs::create_dir_all(&state).unwrap();
        let config = write_config(&state, &plant(&self.plcs, &proxy.url(), FLEET));
        let (processes, naive) = (&self.processes, self.naive);
        *place = Some(Member::start(Start { id: &id, number, config: &config, proxy, processes, naive }));
    }

    /// Empties the place of a member whose process has ended.
    pub(crate) async fn retire(&self, member: usize) {
        if let Some(gone) = self.members[member].lock().await.take() {
            self.former.lock().await.push(gone.proxy);
        }
    }

    /// The process number of the present process of a member.
    pub(crate) async fn number(&self, member: usize) -> Option<usize> {
        self.members[member].lock().await.as_ref().map(|member| member.number)
    }

    /// An operator makes the store again.
    pub(crate) async fn make_store(&self) {
        make_store(self.server.lock().await.client().await, self.store.clone()).await;
    }

    pub(crate) async fn move_link(&self, link: usize, member: Option<usize>) -> Result<(), fleet::OrderError> {
        let (admin, bucket) = (name("admin"), name("leases"));
        let member = member.map(|member| name(&id_of(member)));
        fleet::move_link(&self.nats, &admin, &bucket, &self.links[link], member.as_ref()).await
    }

    pub(crate) async fn drain(&self, member: usize, is_drained: bool) -> Result<(), fleet::OrderError> {
        fleet::drain(&self.nats, &name("admin"), &name("leases"), &name(&id_of(member)), is_drained).await
    }

    /// The folder of the server's data.
    pub(crate) fn data(&self) -> PathBuf {
        self.folder.path().join("jetstream")
    }

    pub(crate) fn folder(&self) -> PathBuf {
        self.folder.path().to_owned()
    }

    /// Heals the ways of all processes, also of those that have ended.
    pub(crate) async fn heal(&self) {
        for member in &self.members {
            if let Some(member) = &mut *member.lock().await {
                member.proxy.heal();
                member.resume();
            }
        }
        self.former.lock().await.iter().for_each(Proxy::heal);
    }

    /// Ends the ways of processes that ended before the last call.
    pub(crate) async fn forget_former(&self, keep: usize) {
        let mut former = self.former.lock().await;
        let old = former.len().saturating_sub(keep);
        former.drain(..old);
    }

    /// Waits until each link is polled after a time, and returns how long that took.
    ///
    /// # Errors
    /// The links that are not.
    pub(crate) async fn polled_after(&self, time: Instant) -> Result<Duration, String> {
        loop {
            let last = self.plcs.last();
            let after: Vec<_> = last.iter().map(|last| last.filter(|last| *last > time)).collect();
            if let Some(all) = after.iter().copied().collect::<Option<Vec<_>>>() {
                // The first request after the time is not known: this is at most a turn later.
                return Ok(all.into_iter().map(|_| time.elapsed()).min().unwrap_or_default());
            }
            if time.elapsed() > PATIENCE {
                let silent = LINKS.iter().zip(after).filter(|(_, after)| after.is_none()).map(|(link, _)| *link);
                return Err(format!("not polled within {PATIENCE:?}: {:?}", silent.collect::<Vec<_>>()));
            }
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
    }

    /// Waits until each of the first members owns links and no other process does.
    ///
    /// # Errors
    /// The owners of the links.
    pub(crate) async fn all_have_a_share(&self, members: usize) -> Result<Duration, String> {
        let begin = Instant::now();
        loop {
            self.record().await;
            let owners = self.oracle.lock().await.owners(&self.sessions.lock().unwrap().clone());
            let mut numbers = Vec::new();
            for member in 0..members {
                numbers.extend(self.number(member).await);
            }
            let is_owned = owners.iter().all(|owner| owner.is_some_and(|owner| numbers.contains(&owner)));
            if is_owned && numbers.iter().all(|number| owners.contains(&Some(*number))) {
                return Ok(begin.elapsed());
            }
            if begin.elapsed() > PATIENCE {
                return Err(format!("not all of {numbers:?} own links, or others do: {owners:?}"));
            }
            tokio::time::sleep(LEASE / 10).await;
        }
    }

    /// Gives the oracle all that is in the store.
    pub(crate) async fn record(&self) {
        let entries = {
            let recorder = self.recorder.lock().await;
            recorder.catch_up().await;
            recorder.take()
        };
        self.oracle.lock().await.add(entries);
    }

    /// Judges all requests so far.
    pub(crate) async fn judge(&self) -> super::oracle::Judged {
        // Taken first: all entries before these requests are read then.
        let record = self.plcs.take();
        self.record().await;
        let sessions = self.sessions.lock().unwrap().clone();
        let mut oracle = self.oracle.lock().await;
        oracle.judge(&record, &sessions, |time| self.processes.ended_at(time));
        oracle.judged.clone()
    }

    /// Takes the longest time without a request to one of the PLCs, until the last request.
    pub(crate) async fn take_gap(&self) -> Duration {
        std::mem::take(&mut self.oracle.lock().await.gap)
    }
}

/// The configuration that all have, but for the way to NATS.
fn plant(plcs: &Plcs, url: &str, fleet: &str) -> String {
    let mut text = format!(
        "[bridge]\nid = 'plant'\nhttp = '127.0.0.1:0'\n[nats]\nurl = '{url}'\n{fleet}\
         [class]\nfast = {{ every = '50ms' }}\n"
    );
    for (link, port) in LINKS.iter().zip(plcs.ports()) {
        text += &format!(
            "[plc.{link}]\nlink = 'tcp://127.0.0.1:{port}'\nstation = 1\ntag.level = {{ at = 'R0', class = 'fast' }}\n"
        );
    }
    text
}

/// Starts PLCs at addresses by which each of the first three, four and five members is to own some of them. Returns the
/// ids of their links, too.
fn well_placed(processes: &Processes) -> (Plcs, Vec<String>) {
    let members: Vec<String> = (0..5).map(id_of).collect();
    loop {
        let plcs = Plcs::start(LINKS.len(), processes.clone());
        let endpoint = |port: &u16| format!("tcp://127.0.0.1:{port}").parse().unwrap();
        let links: Vec<String> = plcs.ports().iter().map(|port| fleet::link_id(&endpoint(port), None)).collect();
        let has_some = |member: &str, count: usize| {
            let first = || members[..count].iter().map(String::as_str);
            links.iter().any(|link| fleet::placed(link, first()) == Some(member))
        };
        if (3..=5).all(|count| members[..count].iter().all(|member| has_some(member, count))) {
            return (plcs, links);
        }
    }
}

/// Makes the store as `fatek-bridge fleet init` does, and makes it anew with republished entries.
async fn make_first_store(nats: &NatsSection, server: &NatsServer) -> StoreConfig {
    fleet::init(nats, &name("admin"), &name("leases")).await.unwrap();
    let context = jetstream::new(server.client().await);
    let config = context.get_stream(STREAM).await.unwrap().cached_info().config.clone();
    context.delete_stream(STREAM).await.unwrap();
    make_store(server.client().await, config).await
}

pub(crate) fn id_of(member: usize) -> String {
    format!("hall-{}", member + 1)
}

fn name(text: &str) -> Name {
    Name::parse(text).unwrap()
}
