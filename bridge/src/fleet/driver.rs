//! Runs the protocol of a member: the store, the clock, and the rest of the bridge.

use std::collections::HashMap;
use std::pin::Pin;
use std::sync::Arc;
use std::time::Duration;

use futures::StreamExt as _;
use futures::stream::FuturesUnordered;
use tokio::sync::{mpsc, oneshot, watch};
use tokio::task::JoinHandle;
use tokio::time::{Instant, sleep, sleep_until, timeout};

use super::bucket::{self, Bucket, OpenError, Opened, Seen, Watch};
use super::core::{Action, Core, Input, Member, Nanos, Outcome, Settings, StoreFault};
use super::gate::{Deadline, Gate, boot_time};
use super::keys::nanoseconds;
use super::open_limit::OpenLimit;
use super::{Closing, Event, FleetStatus, LinkSpec, LinkToken, Ownership};
use crate::config::{Name, NatsSection};

/// The requests for links that are in flight at once.
const MAX_REQUESTS: usize = 64;
/// The delay before another attempt to connect, at most.
const RECONNECT: Duration = Duration::from_secs(1);
/// The period in which the status is renewed.
const STATUS: Duration = Duration::from_millis(500);

type Boxed<T> = Pin<Box<dyn Future<Output = T> + Send>>;

/// The settings of a member.
#[derive(Clone, Debug)]
pub struct FleetSettings {
    /// The server.
    pub nats: NatsSection,
    /// The bucket of the leases.
    pub bucket: Name,
    /// The lease.
    pub lease: Duration,
    /// The member.
    pub member: Member,
    /// The links of the configuration.
    pub links: Vec<LinkSpec>,
}

/// An error that ends a member.
#[derive(Debug, thiserror::Error)]
pub enum FleetError {
    /// There is no store.
    #[error("{0}")]
    NoStore(String),
    /// The store was deleted or set back.
    #[error(transparent)]
    Store(#[from] StoreFault),
    /// The system gives no random numbers.
    #[error("the system gives no random numbers: {0}")]
    Random(std::io::Error),
    /// The id is not a name.
    #[error("the id of a member is a name of the characters A-Z a-z 0-9 _ -")]
    Id,
}

/// A member of a fleet. Cheap to clone.
#[derive(Clone, Debug)]
pub struct Fleet {
    orders: mpsc::UnboundedSender<Order>,
    status: watch::Receiver<Arc<FleetStatus>>,
}

/// The changes of the links that a member owns, in their order.
pub type Events = mpsc::UnboundedReceiver<Event>;

#[derive(Debug)]
enum Order {
    Configure(Member, Vec<LinkSpec>),
    Leave,
}

/// The task of a member. It ends with an error, or after [`Fleet::leave`].
pub type FleetTask = JoinHandle<Result<(), FleetError>>;

impl Fleet {
    /// Joins a fleet. The task ends after [`leave`](Self::leave), or with an error, and then owns nothing any more
    /// but links that are pinned.
    ///
    /// # Errors
    /// [`FleetError`] if the system gives no random numbers.
    pub fn start(settings: FleetSettings) -> Result<(Self, Events, FleetTask), FleetError> {
        let id = Name::parse(&settings.member.id).ok_or(FleetError::Id)?;
        let (orders, orders_in) = mpsc::unbounded_channel();
        let (events, events_out) = mpsc::unbounded_channel();
        let (status, status_out) = watch::channel(Arc::new(FleetStatus::default()));
        let core_settings =
            Settings { lease: nanoseconds(settings.lease), process: process_name()?, max_requests: MAX_REQUESTS };
        let mut core = Core::new(core_settings, settings.member.clone());
        let links = settings.links.clone();
        core.handle(boot_time(), Input::Configure { member: settings.member.clone(), links });
        let driver = Driver {
            id,
            settings,
            core,
            link: Link::Waiting(Instant::now()),
            requests: FuturesUnordered::new(),
            closings: FuturesUnordered::new(),
            deadlines: HashMap::new(),
            gates: HashMap::new(),
            events,
            status,
            was_connected: false,
            last_failure: None,
            open_limit: OpenLimit::default(),
            failure: None,
            has_left: false,
        };
        let task = tokio::spawn(driver.run(orders_in));
        Ok((Self { orders, status: status_out }, events_out, task))
    }

    /// The state of the fleet, not older than half a second.
    #[must_use]
    pub fn status(&self) -> Arc<FleetStatus> {
        self.status.borrow().clone()
    }

    /// Applies a new configuration.
    pub fn configure(&self, member: Member, links: Vec<LinkSpec>) {
        // A member that has ended has no configuration.
        let _ = self.orders.send(Order::Configure(member, links));
    }

    /// Leaves the fleet: all links are closed, and released to the others.
    pub fn leave(&self) {
        let _ = self.orders.send(Order::Leave);
    }
}

/// A name that no other process has had.
fn process_name() -> Result<String, FleetError> {
    let mut bytes = [0; 12];
    let mut filled = 0;
    while filled < bytes.len() {
        let flags = rustix::rand::GetRandomFlags::empty();
        match rustix::rand::getrandom(&mut bytes[filled..], flags) {
            Ok(count) => filled += count,
            Err(rustix::io::Errno::INTR) => {}
            Err(error) => return Err(FleetError::Random(error.into())),
        }
    }
    Ok(bytes.iter().map(|byte| format!("{byte:02x}")).collect())
}

/// The connection to the store.
enum Link {
    /// The next attempt is due then.
    Waiting(Instant),
    Connecting {
        begin: Instant,
        opening: Boxed<Result<Opened, OpenError>>,
    },
    Open(Box<Open>),
}

struct Open {
    bucket: Bucket,
    watch: Watch,
    /// The time of the last entry: own renewals are among them.
    heard: Instant,
}

struct Driver {
    id: Name,
    settings: FleetSettings,
    core: Core,
    link: Link,
    requests: FuturesUnordered<Boxed<(u64, Outcome)>>,
    /// Links that the rest of the bridge closes.
    closings: FuturesUnordered<Boxed<(Arc<str>, LinkToken)>>,
    deadlines: HashMap<Arc<str>, Deadline>,
    gates: HashMap<Arc<str>, Gate>,
    events: mpsc::UnboundedSender<Event>,
    status: watch::Sender<Arc<FleetStatus>>,
    was_connected: bool,
    /// The last failure to connect, which is logged once.
    last_failure: Option<String>,
    open_limit: OpenLimit,
    failure: Option<StoreFault>,
    has_left: bool,
}

/// An event of a connection.
enum Step {
    Connect,
    Opened { opened: Box<Opened>, after: Duration },
    Refused { error: OpenError, after: Duration },
    Lost(String),
    Seen(Seen),
    Silent,
}

impl Driver {
    async fn run(mut self, mut orders: mpsc::UnboundedReceiver<Order>) -> Result<(), FleetError> {
        let mut status_due = Instant::now();
        loop {
            self.act();
            if Instant::now() >= status_due {
                self.renew_status();
                status_due = Instant::now() + STATUS;
            }
            if self.closings.is_empty() && (self.failure.is_some() || self.has_left) {
                self.renew_status();
                return self.failure.map_or(Ok(()), |fault| Err(fault.into()));
            }
            let wake = self.wake_in();
            let silence = self.silence();
            tokio::select! {
                step = self.link.step(silence) => {
                    if let Some(error) = self.take_step(step) {
                        return Err(error);
                    }
                }
                Some((request, outcome)) = self.requests.next(), if !self.requests.is_empty() => {
                    self.feed(Input::Reply { request, outcome });
                }
                Some((link, token)) = self.closings.next(), if !self.closings.is_empty() => {
                    self.feed(Input::Closed { link, token });
                }
                order = orders.recv() => match order {
                    Some(Order::Configure(member, links)) => self.feed(Input::Configure { member, links }),
                    // Without a handle, nothing uses the links.
                    Some(Order::Leave) => self.feed(Input::Leave),
                    None if !self.has_left => self.feed(Input::Leave),
                    None => sleep(STATUS).await,
                },
                () = sleep(wake) => self.feed(Input::Tick),
                () = sleep_until(status_due) => {}
            }
        }
    }

    fn feed(&mut self, input: Input) {
        self.core.handle(boot_time(), input);
    }

    /// The time until the core is due. Timers stand still in a suspend, so a long one is cut.
    fn wake_in(&self) -> Duration {
        let longest = self.settings.lease / 6;
        let wake = self.core.wake_at().map(|at| Duration::from_nanos(at.saturating_sub(boot_time())));
        wake.unwrap_or(longest).min(longest)
    }

    /// The time without an entry after which a watch is given up: own renewals come three times in a lease.
    fn silence(&self) -> Duration {
        self.settings.lease.max(Duration::from_secs(1))
    }

    /// Handles an event of the connection. Returns an error that ends the member.
    fn take_step(&mut self, step: Step) -> Option<FleetError> {
        match step {
            Step::Connect => {
                let FleetSettings { nats, bucket, .. } = self.settings.clone();
                let (id, limit) = (self.id.clone(), self.open_limit.next());
                let opening = Box::pin(async move { bucket::open(&nats, &id, &bucket, limit).await });
                self.link = Link::Connecting { begin: Instant::now(), opening };
            }
            Step::Opened { opened, after } => {
                self.open_limit.opened(after);
                let Opened { bucket, watch, created, last_revision, .. } = *opened;
                tracing::info!("fleet: connected to {}", self.settings.nats.url);
                (self.was_connected, self.last_failure) = (true, None);
                self.link = Link::Open(Box::new(Open { bucket, watch, heard: Instant::now() }));
                self.feed(Input::Connected { created, last_revision });
            }
            Step::Refused { error, after } => {
                self.open_limit.failed(after);
                let text = error.to_string();
                if self.last_failure.as_ref() != Some(&text) {
                    tracing::warn!("fleet: {}: {text}", self.settings.nats.url);
                    self.last_failure = Some(text.clone());
                }
                self.wait_to_connect();
                match error {
                    OpenError::Missing(_) if !self.was_connected => return Some(FleetError::NoStore(text)),
                    OpenError::Missing(_) => self.feed(Input::StoreMissing),
                    OpenError::NoAnswer | OpenError::Other(_) => {}
                }
            }
            Step::Lost(why) => self.disconnect(&why),
            Step::Silent => self.disconnect("no entries come"),
            Step::Seen(seen) => {
                if let Link::Open(open) = &mut self.link {
                    open.heard = Instant::now();
                }
                self.feed(match seen {
                    Seen::Entry(entry) => Input::Entry { key: entry.key, value: entry.value, revision: entry.revision },
                    Seen::Complete => Input::Complete,
                });
            }
        }
        None
    }

    fn disconnect(&mut self, why: &str) {
        tracing::warn!("fleet: {}: {why}", self.settings.nats.url);
        self.requests.clear();
        self.wait_to_connect();
        self.feed(Input::Disconnected);
    }

    fn wait_to_connect(&mut self) {
        let longest = (self.settings.lease / 8).min(RECONNECT);
        self.link = Link::Waiting(Instant::now() + longest.mul_f64(0.5 + fastrand::f64() / 2.0));
    }

    /// Performs the actions of the core.
    fn act(&mut self) {
        while let Some(action) = self.core.next_action() {
            match action {
                Action::Request { request, operation, timeout: limit } => {
                    let Link::Open(open) = &self.link else { continue };
                    let store = open.bucket.store();
                    #[cfg(feature = "naive-fleet")]
                    let own = self.core.session_name().cloned();
                    let performing = async move {
                        #[cfg(feature = "naive-fleet")]
                        if let Some(outcome) = super::naive::perform(&store, &operation, own.as_deref()).await {
                            return outcome;
                        }
                        store.perform(operation).await
                    };
                    let limit = Duration::from_nanos(limit);
                    self.requests.push(Box::pin(async move {
                        (request, timeout(limit, performing).await.unwrap_or(Outcome::Unknown))
                    }));
                }
                Action::Gate { session, until } => self.set_deadline(session, until),
                Action::Own { link, token, session } => self.own(link, token, session),
                Action::Close { link, token } => self.close(link, token),
                Action::Reconnect => self.disconnect("the session is not in the store"),
                Action::Warn(text) => tracing::warn!("fleet: {text}"),
                Action::Fail(fault) => {
                    tracing::error!("fleet: {fault}");
                    self.failure = Some(fault);
                }
                Action::Left => self.has_left = true,
            }
        }
    }

    fn set_deadline(&mut self, session: Arc<str>, until: Nanos) {
        self.deadlines.entry(session.clone()).or_default().set(until);
        let is_over = self.core.session_name() != Some(&session);
        if until == 0 && is_over {
            self.deadlines.remove(&session);
        }
    }

    fn own(&mut self, link: Arc<str>, token: LinkToken, session: Option<Arc<str>>) {
        let gate = match session {
            Some(session) => self.deadlines.entry(session).or_default().gate(),
            None => Gate::always_open(),
        };
        tracing::debug!(%link, %token, "fleet: owned");
        self.gates.insert(link.clone(), gate.clone());
        // Without a receiver, nothing is written.
        let _ = self.events.send(Event::Owned(Ownership { link, token, gate }));
    }

    fn close(&mut self, link: Arc<str>, token: LinkToken) {
        let gate = self.gates.remove(&link);
        // The gate of a link that is handed over is open until now.
        let is_lost = gate.as_ref().is_none_or(|gate| !gate.is_open());
        if let Some(gate) = gate {
            gate.revoke();
        }
        tracing::debug!(%link, %token, is_lost, "fleet: closing");
        let (done, closed) = oneshot::channel();
        let _ = self.events.send(Event::Close(Closing { link: link.clone(), token, is_lost, done: Some(done) }));
        self.closings.push(Box::pin(async move {
            // Dropped: it is closed, too.
            let _ = closed.await;
            (link, token)
        }));
    }

    fn renew_status(&self) {
        self.status.send_replace(Arc::new(self.core.status(boot_time())));
    }
}

impl Link {
    /// The next event of the connection. Cancel-safe.
    async fn step(&mut self, silence: Duration) -> Step {
        match self {
            Self::Waiting(until) => {
                sleep_until(*until).await;
                Step::Connect
            }
            Self::Connecting { begin, opening } => match opening.await {
                Ok(opened) => Step::Opened { opened: Box::new(opened), after: begin.elapsed() },
                Err(error) => Step::Refused { error, after: begin.elapsed() },
            },
            Self::Open(open) => {
                let Open { bucket, watch, heard } = &mut **open;
                tokio::select! {
                    // An entry that has come is no silence, however late this task runs.
                    biased;
                    why = bucket.lost() => Step::Lost(why),
                    seen = watch.next() => seen.map_or_else(Step::Lost, Step::Seen),
                    () = sleep_until(*heard + silence) => Step::Silent,
                }
            }
        }
    }
}
