//! Members of a fleet with a real nats-server. PLCs are counters here: the protocol and its driver are under test.
//!
//! `FATEK_FLEET_KILLS` sets how often a member is killed (100 in a campaign, 3 otherwise), and `FATEK_FLEET_LINKS` the
//! number of links (200 otherwise).

mod common;

use std::collections::BTreeMap;
use std::path::Path;
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use async_nats::jetstream;
use fatek_bridge::config::{Config, Name, NatsSection};
use fatek_bridge::fleet::{
    self, Event, Events, Fleet, FleetError, FleetSettings, FleetStatus, Initialized, LinkSpec, LinkToken, Member,
    MemberState, Ownership, Reach, StoreFault,
};
use tokio::task::JoinHandle;

use common::nats::{NatsServer, PATIENCE};

/// The lease of these tests.
const LEASE: Duration = Duration::from_millis(1500);

/// A member and a link.
type MemberLink = (Arc<str>, Arc<str>);

/// The owners of links, as the members tell them.
#[derive(Debug, Default)]
struct Board {
    owned: Mutex<BTreeMap<MemberLink, Ownership>>,
    tokens: Mutex<BTreeMap<Arc<str>, LinkToken>>,
}

impl Board {
    /// The links of a member whose gates are open.
    fn open(&self, member: &str) -> usize {
        let owned = self.owned.lock().unwrap();
        owned.iter().filter(|((of, _), ownership)| **of == *member && ownership.gate.is_open()).count()
    }

    /// No link has two open gates.
    fn check(&self) {
        let owned = self.owned.lock().unwrap();
        let mut open = BTreeMap::new();
        for ((member, link), _) in owned.iter().filter(|(_, ownership)| ownership.gate.is_open()) {
            if let Some(other) = open.insert(link.clone(), member.clone()) {
                panic!("{link} has two masters: {member} and {other}");
            }
        }
    }
}

/// A member.
struct Node {
    id: Arc<str>,
    fleet: Fleet,
    task: JoinHandle<Result<(), FleetError>>,
    events: JoinHandle<()>,
}

impl Node {
    fn start(nats: &NatsSection, board: &Arc<Board>, id: &str, links: Vec<LinkSpec>) -> Self {
        let member = Member { id: id.into(), version: "test".to_owned(), config: "c".to_owned(), weight: 1 };
        let bucket = Name::parse("leases").unwrap();
        let settings = FleetSettings { nats: nats.clone(), bucket, lease: LEASE, member, links };
        let (fleet, events, task) = Fleet::start(settings).unwrap();
        let events = tokio::spawn(follow(board.clone(), id.into(), events));
        Self { id: id.into(), fleet, task, events }
    }

    /// Ends it as SIGKILL would.
    async fn kill(self, board: &Board) {
        self.task.abort();
        let _ = self.task.await;
        self.events.abort();
        let _ = self.events.await;
        board.owned.lock().unwrap().retain(|(member, _), _| *member != self.id);
    }

    async fn leave(self) {
        self.fleet.leave();
        tokio::time::timeout(PATIENCE, self.task).await.unwrap().unwrap().unwrap();
    }
}

/// Keeps the board up to date, as a bridge that polls would do.
async fn follow(board: Arc<Board>, member: Arc<str>, mut events: Events) {
    while let Some(event) = events.recv().await {
        match event {
            Event::Owned(ownership) => {
                let before = board.tokens.lock().unwrap().insert(ownership.link.clone(), ownership.token);
                assert!(before.is_none_or(|before| before < ownership.token), "tokens rise");
                board.owned.lock().unwrap().insert((member.clone(), ownership.link.clone()), ownership);
            }
            Event::Close(closing) => {
                let ownership = board.owned.lock().unwrap().remove(&(member.clone(), closing.link.clone()));
                assert!(!ownership.unwrap().gate.is_open(), "closed before it is told");
                closing.closed();
            }
        }
    }
}

fn section(folder: &Path, port: u16) -> NatsSection {
    let text =
        format!("[nats]\nurl = 'nats://127.0.0.1:{port}'\n[plc.mixer]\nlink = 'tcp://127.0.0.1:9'\nstation = 1\n");
    let path = folder.join("plant.toml");
    std::fs::write(&path, text).unwrap();
    Config::load(&path).unwrap().nats.unwrap()
}

fn links(count: usize) -> Vec<LinkSpec> {
    (0..count).map(|n| LinkSpec { id: format!("plc{n}").into(), reach: Reach::All }).collect()
}

async fn until(what: &str, board: &Board, is_true: impl Fn() -> bool) -> Duration {
    let begin = Instant::now();
    while !is_true() {
        board.check();
        assert!(begin.elapsed() < PATIENCE, "{what}: {:?}", board.owned.lock().unwrap().keys());
        tokio::time::sleep(Duration::from_millis(5)).await;
    }
    begin.elapsed()
}

async fn init(nats: &NatsSection) -> Initialized {
    let bucket = Name::parse("leases").unwrap();
    fleet::init(nats, &Name::parse("test").unwrap(), &bucket).await.unwrap()
}

fn state(node: &Node) -> MemberState {
    let status: Arc<FleetStatus> = node.fleet.status();
    status.state.clone()
}

#[tokio::test(flavor = "multi_thread")]
async fn a_member_refuses_to_start_without_a_store() {
    let folder = tempfile::tempdir().unwrap();
    let Some(server) = NatsServer::start(folder.path()) else { return };
    let nats = section(folder.path(), server.port());
    let node = Node::start(&nats, &Arc::default(), "hall-1", links(1));
    let error = tokio::time::timeout(PATIENCE, node.task).await.unwrap().unwrap().unwrap_err();
    assert_eq!(error.to_string(), "the store leases does not exist: fatek-bridge fleet init makes it");
    assert_eq!(init(&nats).await, Initialized::Made(1));
    assert_eq!(init(&nats).await, Initialized::Exists);
}

/// Seen without the cure: the next attempt came after 5.2 s.
#[tokio::test(flavor = "multi_thread")]
async fn an_attempt_without_an_answer_is_given_up_soon() {
    let folder = tempfile::tempdir().unwrap();
    // It accepts, and then is silent, like a server that was stopped or cut off.
    let silent = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
    let nats = section(folder.path(), silent.local_addr().unwrap().port());
    let node = Node::start(&nats, &Arc::default(), "hall-1", links(1));
    let accept = || tokio::time::timeout(PATIENCE, silent.accept());
    let _first = accept().await.unwrap().unwrap();
    let begin = Instant::now();
    let _second = accept().await.unwrap().unwrap();
    let time = begin.elapsed();
    assert!(time < Duration::from_millis(4800), "{time:?}");
    node.task.abort();
}

#[tokio::test(flavor = "multi_thread")]
async fn links_are_shared_taken_over_and_handed_over() {
    let number = |name: &str| std::env::var(name).ok().map(|number| number.parse::<usize>().unwrap());
    let kills = number("FATEK_FLEET_KILLS").unwrap_or(3);
    let count = number("FATEK_FLEET_LINKS").unwrap_or(200);
    let folder = tempfile::tempdir().unwrap();
    let Some(server) = NatsServer::start(folder.path()) else { return };
    let nats = section(folder.path(), server.port());
    init(&nats).await;
    let board = Arc::new(Board::default());
    let begin = Instant::now();
    let ids = ["hall-1", "hall-2", "hall-3"];
    let mut nodes: Vec<Node> = ids.iter().map(|id| Node::start(&nats, &board, id, links(count))).collect();
    let all = || ids.iter().map(|id| board.open(id)).sum::<usize>() == count;
    until("all are owned", &board, all).await;
    println!("{count} links first owned within {:?}", begin.elapsed());
    let fair = || ids.iter().all(|id| board.open(id) > count / 5);
    until("all have a share", &board, || all() && fair()).await;

    let mut longest = Duration::ZERO;
    for kill in 0..kills {
        let node = nodes.remove(0);
        let id = node.id.clone();
        node.kill(&board).await;
        let time = until("all are taken over", &board, all).await;
        longest = longest.max(time);
        nodes.push(Node::start(&nats, &board, &id, links(count)));
        let time = until("the new member has its share", &board, || all() && board.open(&id) > count / 5).await;
        println!("kill {kill}: a new member has its share after {time:?}");
    }
    println!("last link taken over within {longest:?}, {:.2} leases", longest.as_secs_f64() / LEASE.as_secs_f64());

    // It is renewed twice a second.
    until("the status has all members", &board, || nodes[0].fleet.status().members.len() == 3).await;
    assert_eq!(nodes[0].fleet.status().links.len(), count);
    assert_eq!(state(&nodes[0]), MemberState::Active);

    let node = nodes.remove(0);
    let left = node.id.clone();
    let begin = Instant::now();
    node.leave().await;
    until("a member that leaves gives all away", &board, || all() && board.open(&left) == 0).await;
    println!("all links of a member that leaves are taken after {:?}", begin.elapsed());
}

#[tokio::test(flavor = "multi_thread")]
async fn owners_stop_without_the_server_and_go_on_with_it() {
    let folder = tempfile::tempdir().unwrap();
    let Some(mut server) = NatsServer::start(folder.path()) else { return };
    let nats = section(folder.path(), server.port());
    init(&nats).await;
    let board = Arc::new(Board::default());
    let nodes: Vec<Node> = ["hall-1", "hall-2"].map(|id| Node::start(&nats, &board, id, links(20))).into();
    let open = || board.open("hall-1") + board.open("hall-2");
    until("all are owned", &board, || open() == 20).await;
    let tokens = board.tokens.lock().unwrap().clone();
    server.kill();
    let time = until("all gates are closed", &board, || open() == 0).await;
    assert!(time < LEASE * 2, "{time:?}");
    server.run();
    let time = until("all go on", &board, || open() == 20).await;
    println!("all links go on {time:?} after the server");
    let is_new = |(link, token): (&Arc<str>, &LinkToken)| tokens[link] < *token;
    assert!(board.tokens.lock().unwrap().iter().all(is_new), "with new tokens, since there is a gap");

    // A short loss closes no gate for long, if any.
    server.kill();
    server.run();
    let begin = Instant::now();
    while begin.elapsed() < LEASE * 2 {
        board.check();
        tokio::time::sleep(Duration::from_millis(20)).await;
    }
    until("all are owned", &board, || open() == 20).await;
    drop(nodes);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_store_that_was_deleted_stops_all_members() {
    let folder = tempfile::tempdir().unwrap();
    let Some(server) = NatsServer::start(folder.path()) else { return };
    let nats = section(folder.path(), server.port());
    init(&nats).await;
    let board = Arc::new(Board::default());
    let nodes: Vec<Node> = ["hall-1", "hall-2"].map(|id| Node::start(&nats, &board, id, links(20))).into();
    let open = || board.open("hall-1") + board.open("hall-2");
    until("all are owned", &board, || open() == 20).await;
    let context = jetstream::new(server.client().await);
    context.delete_stream("KV_leases").await.unwrap();
    until("all gates are closed", &board, || open() == 0).await;
    let is_missing = |node: &Node| state(node) == MemberState::Connecting;
    until("the store is missed", &board, || nodes.iter().all(is_missing)).await;
    let missing = context.get_stream("KV_leases").await;
    assert!(missing.is_err(), "no member makes it again");
    assert_eq!(init(&nats).await, Initialized::Made(1));
    for node in nodes {
        let error = tokio::time::timeout(PATIENCE, node.task).await.unwrap().unwrap().unwrap_err();
        assert!(
            matches!(error, FleetError::Store(StoreFault::Recreated { .. } | StoreFault::SetBack { .. })),
            "{error}"
        );
    }
    assert_eq!(open(), 0);
}

#[tokio::test(flavor = "multi_thread")]
async fn an_operator_drains_members_and_moves_links() {
    let folder = tempfile::tempdir().unwrap();
    let Some(server) = NatsServer::start(folder.path()) else { return };
    let nats = section(folder.path(), server.port());
    init(&nats).await;
    let board = Arc::new(Board::default());
    let name = |text: &str| Name::parse(text).unwrap();
    let nodes: Vec<Node> = ["hall-1", "hall-2"].map(|id| Node::start(&nats, &board, id, links(20))).into();
    let shares = || (board.open("hall-1"), board.open("hall-2"));
    until("both have a share", &board, || shares().0 + shares().1 == 20 && shares().0 > 2 && shares().1 > 2).await;
    let before = shares();

    let (admin, bucket, hall_1, plc7) = (name("admin"), name("leases"), name("hall-1"), name("plc7"));
    fleet::drain(&nats, &admin, &bucket, &hall_1, true).await.unwrap();
    until("hall-1 has given all away", &board, || shares() == (0, 20)).await;
    until("it says so", &board, || state(&nodes[0]) == MemberState::Draining).await;
    fleet::drain(&nats, &admin, &bucket, &hall_1, false).await.unwrap();
    until("it has its share again", &board, || shares() == before).await;

    let owner = |link: &str| {
        let owned = board.owned.lock().unwrap();
        owned.keys().find(|(_, owned)| **owned == *link).map(|(member, _)| member.to_string())
    };
    for member in ["hall-1", "hall-2"] {
        fleet::move_link(&nats, &admin, &bucket, plc7.as_str(), Some(&name(member))).await.unwrap();
        until("the link is moved", &board, || owner("plc7").as_deref() == Some(member)).await;
    }
    let seen = fleet::observe(&nats, &admin, &bucket, "c", links(20)).await.unwrap();
    let members: Vec<&str> = seen.members.iter().map(|member| &*member.id).collect();
    assert_eq!(members, ["hall-1", "hall-2"], "the observer is none");
    let find = |seen: &fleet::Observation, id: &str| seen.links.iter().find(|link| *link.link == *id).unwrap().clone();
    let (first, plc0) = (find(&seen, "plc7"), find(&seen, "plc0"));
    assert_eq!((first.owner.as_deref(), first.target.as_deref()), (Some("hall-2"), Some("hall-2")));
    assert_eq!(seen.moved, BTreeMap::from([("plc7".to_owned(), "hall-2".to_owned())]));
    // Times are those of the server: that of a link goes on, that of a session is short.
    tokio::time::sleep(LEASE).await;
    let seen = fleet::observe(&nats, &admin, &bucket, "c", links(20)).await.unwrap();
    let longer = |before: &fleet::LinkStatus| find(&seen, &before.link).owned_for - before.owned_for;
    assert!(longer(&first) >= LEASE && longer(&plc0) >= LEASE, "{first:?} {plc0:?} {seen:?}");
    assert!(seen.members.iter().all(|member| member.silent_for < LEASE && member.lease == LEASE), "{seen:?}");
    drop(nodes);
}
