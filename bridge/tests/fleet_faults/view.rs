//! The view of a member that connects while the store changes.

use std::time::Duration;

use async_nats::jetstream;
use fatek_bridge::config::{Config, Name};
use fatek_bridge::fleet::{self, Fleet, FleetSettings, Member, MemberState};
use tokio::sync::broadcast;
use tokio::time::{sleep, timeout};

use super::common::bridge::write_config;
use super::common::nats::NatsServer;
use super::proxy::{Proxy, Sessions};

/// nats-server 2.9 counts an entry that is replaced before it is delivered as pending for ever. Seen with a view that
/// was complete when none was pending: the member stayed without a session until the test ended.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_view_becomes_complete_while_entries_change() {
    let folder = tempfile::tempdir().unwrap();
    let Some(server) = NatsServer::start(folder.path()) else { return };
    let proxy = Proxy::start(0, server.port(), Sessions::default(), broadcast::channel(8).0).await;
    let text = format!("[nats]\nurl = '{}'\n[plc.mixer]\nlink = 'tcp://127.0.0.1:9'\nstation = 1\n", proxy.url());
    let nats = Config::load(&write_config(folder.path(), &text)).unwrap().nats.unwrap();
    let bucket = Name::parse("leases").unwrap();
    fleet::init(&nats, &Name::parse("admin").unwrap(), &bucket).await.unwrap();

    let context = jetstream::new(server.client().await);
    let writer = tokio::spawn(async move {
        for n in 0_u64.. {
            let subject = format!("$KV.leases.o.plc{}", n % 3);
            context.publish(subject, "".into()).await.unwrap().await.unwrap();
            sleep(Duration::from_millis(5)).await;
        }
    });
    proxy.change(|way| way.up.delay = Duration::from_millis(200));
    let member = Member { id: "hall-1".into(), version: "test".to_owned(), config: "c".to_owned(), weight: 1 };
    let settings = FleetSettings { nats, bucket, lease: Duration::from_secs(3), member, links: Vec::new() };
    let (fleet, _events, _task) = Fleet::start(settings).unwrap();
    let active = async {
        while fleet.status().state != MemberState::Active {
            sleep(Duration::from_millis(20)).await;
        }
    };
    timeout(Duration::from_secs(20), active).await.expect("it has no session");
    writer.abort();
}
