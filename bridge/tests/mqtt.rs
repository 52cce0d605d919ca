//! The MQTT output with a real mosquitto.
//!
//! Long campaigns: `FATEK_BRIDGE_RESTARTS=20 FATEK_BRIDGE_AWAY=600 cargo test --test mqtt -- --nocapture`.

mod common;

use std::time::{Duration, Instant, SystemTime};

use common::bridge::{Bridge, write_config};
use common::deliveries::Deliveries;
use common::mosquitto::Mosquitto;
use common::mqtt_output::{Output, PolledPlant};
use common::mqtt_proxy::Proxy;
use common::mqtt_subscriber::Subscriber;
use fatek::sim::{Bus, Plc, Server};
use fatek::wire::Framing;
use fatek::{element, register};
use fatek_bridge::batch::milliseconds;
use rcgen::{BasicConstraints, CertificateParams, ExtendedKeyUsagePurpose, IsCa, Issuer, KeyPair};
use serde_json::{Value, json};
use tempfile::TempDir;
use tokio::time::sleep;

/// A number that a variable of the environment scales up.
fn scale(variable: &str, short: u64) -> u64 {
    std::env::var(variable).map_or(short, |text| text.parse().unwrap())
}

#[tokio::test(flavor = "multi_thread")]
async fn values_states_and_the_will_arrive_from_a_simulated_plc() {
    let Some(mut mosquitto) = Mosquitto::start() else { return };
    let plc = Plc::new();
    plc.write(register!("R5"), 1234_u16).unwrap();
    let bus = Bus::new().with_station(1, plc.clone()).unwrap();
    let server = Server::bind("127.0.0.1:0", bus, Framing::Ascii).await.unwrap();
    let folder = TempDir::new().unwrap();
    let text = format!(
        "[bridge]\nid = 'test'\nhttp = '127.0.0.1:0'\n[mqtt]\nurl = '{}'\n[class]\nfast = {{ every = '100ms', stale_after = '1s' }}\n\
         [plc.mixer]\nlink = 'tcp://{}'\nstation = 1\ntag.level = {{ at = 'R5:i16*0.1-40', class = 'fast' }}\n",
        mosquitto.url(),
        server.local_addr(),
    );
    let config = write_config(folder.path(), &text);
    let mut subscriber = Subscriber::start(&mosquitto, "fatek/#").await;
    let bridge = Bridge::start(&config, folder.path());
    let is_state =
        |topic: &str, content: &Value, online: bool| topic == "fatek/test/state" && content["online"] == online;
    let is_data = |topic: &str, content: &Value| topic == "fatek/test/mixer/data" && !content["d"]["level"].is_null();

    subscriber.wait_for("birth", |topic, content| is_state(topic, content, true)).await;
    let (_, batch, _) =
        subscriber.wait_for("value", |topic, content| is_data(topic, content) && content["d"]["level"].is_f64()).await;
    assert_eq!(batch["d"], json!({ "level": 83.4 }));
    let age = milliseconds(SystemTime::now()).saturating_sub(batch["ts"].as_u64().unwrap());
    assert!(age < 5000, "{age} ms");

    // A PLC that does not answer: never a value for a bad tag.
    drop(server);
    let is_bad = |topic: &str, content: &Value| is_data(topic, content) && content["d"]["level"].is_object();
    let (_, batch, _) = subscriber.wait_for("bad", is_bad).await;
    let level = batch["d"]["level"].as_object().unwrap();
    assert!(level["why"].is_string() && ["stale", "bad"].contains(&level["q"].as_str().unwrap()), "{batch}");
    assert!(level.keys().all(|key| ["q", "why", "ts"].contains(&key.as_str())), "{batch}");
    let is_offline = |topic: &str, content: &Value| topic == "fatek/test/mixer/state" && content["online"] == false;
    let mut state = Subscriber::start(&mosquitto, "fatek/test/mixer/state").await;
    state.wait_for("offline", is_offline).await;
    drop(state);

    // The broker forgets everything when it is restarted.
    mosquitto.kill();
    mosquitto.launch();
    subscriber.wait_for("birth after a restart", |topic, content| is_state(topic, content, true)).await;
    let mut state = Subscriber::start(&mosquitto, "fatek/test/mixer/state").await;
    state.wait_for("state after a restart", is_offline).await;
    drop(state);

    bridge.signal("KILL");
    subscriber.wait_for("will", |topic, content| is_state(topic, content, false)).await;
    // A client that comes later sees it, too.
    let mut late = Subscriber::start(&mosquitto, "fatek/test/state").await;
    let (_, state, retained) = late.wait_for("retained", |topic, _| topic == "fatek/test/state").await;
    assert_eq!((state, retained), (json!({ "online": false }), true));

    let mut bridge = Bridge::start(&config, folder.path());
    late.wait_for("birth", |topic, content| is_state(topic, content, true)).await;
    bridge.signal("TERM");
    late.wait_for("offline", |topic, content| is_state(topic, content, false)).await;
    assert!(bridge.wait().success(), "{}", bridge.log());
}

/// Compares the batches that the broker has acknowledged with those that were pushed.
fn check(output: &Output, proxy: &Proxy) -> Deliveries {
    let taken = proxy.taken();
    Deliveries::check(taken.iter().map(|(plc, batch)| (plc.as_str(), batch)), &output.expected())
}

/// With an acknowledgement in the buffer as soon as a message is sent, 108 of 2342 batches were lost.
#[tokio::test(flavor = "multi_thread")]
async fn a_broker_that_is_killed_again_and_again_loses_nothing() {
    let Some(mut mosquitto) = Mosquitto::start() else { return };
    let restarts = scale("FATEK_BRIDGE_RESTARTS", 5);
    let proxy = Proxy::start(mosquitto.port()).await;
    let mut output = Output::start(&proxy.url(), json!({}));
    let mut random = fastrand::Rng::with_seed(3);
    output.wait_until_connected().await;
    for _ in 0..restarts {
        // It is killed in the middle of a burst, and comes back after up to 300 ms.
        for _ in 0..random.u64(5..30) {
            output.push_sized(20, 1000);
            sleep(Duration::from_millis(2)).await;
        }
        mosquitto.kill();
        output.push_sized(random.u64(0..200), 1000);
        sleep(Duration::from_millis(random.u64(..300))).await;
        mosquitto.launch();
        output.wait_until_connected().await;
    }
    output.wait_until_delivered().await;
    let result = check(&output, &proxy);
    println!("{restarts} restarts, {} batches: {result:?}", output.pushed);
    assert_eq!((result.lost, result.out_of_order, result.unmarked), (0, 0, 0));
    assert_eq!(u64::try_from(result.batches).unwrap(), output.pushed);
    output.stop().await;
}

/// 10,000 samples/s, as batches of 64.
#[tokio::test(flavor = "multi_thread")]
async fn a_broker_that_was_away_gets_the_backlog_soon() {
    const SAMPLES: u64 = 64;
    let Some(mut mosquitto) = Mosquitto::start() else { return };
    let away = Duration::from_secs(scale("FATEK_BRIDGE_AWAY", 10));
    let proxy = Proxy::start(mosquitto.port()).await;
    let mut output = Output::start(&proxy.url(), json!({}));
    output.wait_until_connected().await;
    mosquitto.kill();
    let begin = Instant::now();
    while begin.elapsed() < away {
        let due = u64::try_from(begin.elapsed().as_millis()).unwrap() * 10 / SAMPLES;
        output.push_sized(due.saturating_sub(output.pushed), 1200);
        sleep(Duration::from_millis(10)).await;
    }
    let backlog = output.lag();
    mosquitto.launch();
    let begin = Instant::now();
    let limit = Duration::from_secs(30) + away / 4;
    while output.lag() > 0 {
        assert!(begin.elapsed() < limit, "{} of {backlog} left after {limit:?}", output.lag());
        sleep(Duration::from_millis(10)).await;
    }
    let result = check(&output, &proxy);
    println!(
        "away for {away:?}: {backlog} batches, {} samples; gone in {:?}: {result:?}",
        backlog * SAMPLES,
        begin.elapsed()
    );
    assert_eq!((result.lost, result.out_of_order, result.unmarked), (0, 0, 0));
    // All that was pushed more than 5 s before the broker came back is late, and a second is left for this test.
    let early = output.pushed / 3 * away.as_secs().saturating_sub(6) / away.as_secs();
    let taken = proxy.taken();
    let mut late = taken.iter().filter(|(_, batch)| batch["seq"].as_u64().is_some_and(|seq| seq < early));
    assert!(late.all(|(_, batch)| batch["hist"] == true), "seen without its cure: not one had the mark");
    output.stop().await;
}

/// A certificate authority, and certificates of a server and of a client.
struct Certificates {
    folder: TempDir,
}

impl Certificates {
    fn new() -> Self {
        let folder = TempDir::new().unwrap();
        let write = |name: &str, text: String| std::fs::write(folder.path().join(name), text).unwrap();
        for name in ["ca", "other"] {
            let key = KeyPair::generate().unwrap();
            let mut params = CertificateParams::new(Vec::new()).unwrap();
            params.is_ca = IsCa::Ca(BasicConstraints::Unconstrained);
            params.distinguished_name.push(rcgen::DnType::CommonName, name);
            write(&format!("{name}.pem"), params.self_signed(&key).unwrap().pem());
            let issuer = Issuer::new(params, key);
            for (part, usage) in
                [("server", ExtendedKeyUsagePurpose::ServerAuth), ("client", ExtendedKeyUsagePurpose::ClientAuth)]
            {
                let key = KeyPair::generate().unwrap();
                let mut params = CertificateParams::new(vec!["localhost".to_owned()]).unwrap();
                params.extended_key_usages.push(usage);
                write(&format!("{name}-{part}.pem"), params.signed_by(&key, &issuer).unwrap().pem());
                write(&format!("{name}-{part}.key"), key.serialize_pem());
            }
        }
        Self { folder }
    }

    fn path(&self, name: &str) -> String {
        self.folder.path().join(name).to_str().unwrap().to_owned()
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn tls_with_a_client_certificate_and_its_faults() {
    let certificates = Certificates::new();
    let lines = format!(
        "allow_anonymous true\ncafile {}\ncertfile {}\nkeyfile {}\nrequire_certificate true\n",
        certificates.path("ca.pem"),
        certificates.path("ca-server.pem"),
        certificates.path("ca-server.key"),
    );
    let Some(mosquitto) = Mosquitto::start_with(&lines) else { return };
    let tls = format!("mqtts://localhost:{}", mosquitto.port());
    let files = |ca: &str, client: &str| {
        json!({
            "ca_file": certificates.path(ca),
            "cert_file": certificates.path(&format!("{client}.pem")),
            "key_file": certificates.path(&format!("{client}.key")),
        })
    };
    let mut output = Output::start(&tls, files("ca.pem", "ca-client"));
    output.push_sized(500, 2000);
    output.wait_until_delivered().await;
    output.stop().await;
    let address = format!("mqtts://127.0.0.1:{}", mosquitto.port());
    for (url, files, expected) in [
        (&tls, files("other.pem", "ca-client"), "authority"),
        (&tls, files("ca.pem", "other-client"), "does not trust the certificate of the client"),
        (&tls, json!({ "ca_file": certificates.path("ca.pem") }), "set cert_file and key_file"),
        (&address, files("ca.pem", "ca-client"), "another name"),
        (&tls, files("none.pem", "ca-client"), "none.pem: No such file"),
        (&mosquitto.url(), json!({}), "lost before the broker has accepted it"),
    ] {
        assert_fails(url, files, expected).await;
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn user_and_password_and_their_faults() {
    let folder = TempDir::new().unwrap();
    let write = |name: &str, text: &str| {
        std::fs::write(folder.path().join(name), text).unwrap();
        folder.path().join(name).to_str().unwrap().to_owned()
    };
    let passwords = write("passwords", "hall2:correct horse\n");
    let status = std::process::Command::new("mosquitto_passwd").args(["-U", &passwords]).status();
    let Some(mosquitto) = Mosquitto::start_with(&format!("allow_anonymous false\npassword_file {passwords}\n")) else {
        return;
    };
    assert!(status.is_ok_and(|status| status.success()), "mosquitto_passwd");
    let (good, bad) = (write("good", "correct horse\n"), write("bad", "wrong battery\n"));
    let mut output = Output::start(&mosquitto.url(), json!({ "user": "hall2", "password_file": good }));
    output.push(10);
    output.wait_until_delivered().await;
    output.stop().await;
    let wrong =
        assert_fails(&mosquitto.url(), json!({ "user": "hall2", "password_file": bad }), "password is wrong").await;
    assert!(!wrong.contains("battery"), "{wrong}");
    assert_fails(&mosquitto.url(), json!({}), "password is wrong").await;
    assert_fails(&mosquitto.url(), json!({ "user": "hall2", "password_file": "/none" }), "/none: No such file").await;
    let tls = format!("mqtts://127.0.0.1:{}", mosquitto.port());
    let ca = Certificates::new();
    assert_fails(&tls, json!({ "ca_file": ca.path("ca.pem") }), "TLS").await;
}

/// A rule of the broker that is corrected later: nothing is lost.
#[tokio::test(flavor = "multi_thread")]
async fn batches_that_the_broker_does_not_authorize_are_kept() {
    let folder = TempDir::new().unwrap();
    let rules = folder.path().join("acl");
    std::fs::write(&rules, "topic write fatek/+/+/state\ntopic write fatek/+/state\n").unwrap();
    let lines = format!("allow_anonymous true\nacl_file {}\n", rules.display());
    let Some(mut mosquitto) = Mosquitto::start_with(&lines) else { return };
    let plant = PolledPlant::of_batches().await;
    let mut output = Output::start_with(&mosquitto.url(), json!({}), plant.registry.clone(), None);
    output.push(20);
    output.wait_for("refusal", |output| output.health.refused() > 0).await;
    assert!(output.health.failure().unwrap().contains("not authorized"), "{:?}\n{}", output.health, mosquitto.log());
    assert_eq!(output.lag(), 20);
    std::fs::write(&rules, "topic readwrite #\n").unwrap();
    mosquitto.kill();
    mosquitto.launch();
    output.wait_until_delivered().await;
    assert_eq!(output.health.delivered(), (20, 20));
    output.stop().await;
}

/// mosquitto 2.0 answers a PUBLISH of an MQTT 5 client that its rules refuse with the reason 0x87 (not authorized), and
/// goes on. Older clients are told that it was taken.
///
/// With present values that wait for the refused PLC, the present alarm of the boiler did not come within 30 s.
#[tokio::test(flavor = "multi_thread")]
async fn rules_that_refuse_one_plc_hold_up_no_other() {
    rules_that_refuse_one_plc("max_queued_messages 1000\n").await;
}

/// mosquitto 2.0.11 ends the connection then, after its answer. With an attempt on each connection, there were four
/// connections a second, and fewer than 20 batches of the boiler came as news: the next one did not within 30 s.
#[tokio::test(flavor = "multi_thread")]
async fn refusals_that_end_the_connection_hold_up_no_other() {
    rules_that_refuse_one_plc("max_queued_messages 0\n").await;
}

/// The rules of a broker refuse the mixer, over an outage, until they are corrected.
async fn rules_that_refuse_one_plc(limit: &str) {
    let rules_folder = TempDir::new().unwrap();
    let rules = rules_folder.path().join("acl");
    let (states, data) = ("topic readwrite fatek/+/+/state\ntopic readwrite fatek/+/state\n", "topic read #\n");
    std::fs::write(&rules, format!("{states}{data}topic write fatek/+/boiler/data\n")).unwrap();
    let lines = format!("allow_anonymous true\nacl_file {}\n{limit}", rules.display());
    let Some(mut mosquitto) = Mosquitto::start_with(&lines) else { return };
    let plant = [Plc::new(), Plc::new()];
    let bus = Bus::new().with_station(1, plant[0].clone()).unwrap().with_station(2, plant[1].clone()).unwrap();
    let server = Server::bind("127.0.0.1:0", bus, Framing::Ascii).await.unwrap();
    let folder = TempDir::new().unwrap();
    let text = format!(
        "[bridge]\nid = 'hall-2'\nhttp = '127.0.0.1:0'\n[mqtt]\nurl = '{}'\n\
         [class]\nfast = {{ every = '200ms' }}\n[template.tank]\n\
         level = {{ at = 'R5', class = 'fast' }}\nalarm = {{ at = 'M7', class = 'fast', on_change = true }}\n\
         [bus.line]\nlink = 'tcp://{}'\nuse = ['tank']\nstations = {{ mixer = 1, boiler = 2 }}\n",
        mosquitto.url(),
        server.local_addr()
    );
    let mut subscriber = Subscriber::start(&mosquitto, "fatek/+/+/data").await;
    let mut bridge = Bridge::start(&write_config(folder.path(), &text), folder.path());
    bridge.wait_for_log("the batches of this PLC are kept");
    assert!(bridge.log().contains("plc=\"mixer\"") && bridge.log().contains("(0x87)"), "{}", bridge.log());
    assert!(mosquitto.log().contains("Denied PUBLISH"), "{}", mosquitto.log());
    let is_of = |topic: &str, plc: &str| topic == format!("fatek/hall-2/{plc}/data");
    let is_news = |topic: &str, batch: &Value| is_of(topic, "boiler") && batch["hist"].is_null();
    for _ in 0..20 {
        subscriber.wait_for("news of the boiler", is_news).await;
    }
    // An outage in which the alarm of the boiler changes: its batch is late when it is sent.
    mosquitto.kill();
    plant[1].write(element!("M7"), true).unwrap();
    sleep(Duration::from_secs(6)).await;
    mosquitto.launch();
    let is_present = |topic: &str, batch: &Value, plc: &str| {
        is_of(topic, plc) && batch["hist"].is_null() && batch["d"]["alarm"].is_boolean()
    };
    let (_, batch, _) =
        subscriber.wait_for("the present alarm", |topic, batch| is_present(topic, batch, "boiler")).await;
    assert_eq!(batch["d"]["alarm"], true, "{batch}");
    // The rules are corrected, and mosquitto reads them: nothing was lost.
    std::fs::write(&rules, format!("{states}{data}topic write fatek/+/+/data\n")).unwrap();
    mosquitto.signal("HUP");
    let (_, first, _) = subscriber.wait_for("the mixer", |topic, _| is_of(topic, "mixer")).await;
    assert!(first["hist"] == true && first["d"]["alarm"] == false, "the first batch of all: {first}");
    let mut seq = first["seq"].as_u64().unwrap();
    loop {
        let (_, batch, _) = subscriber.wait_for("the mixer", |topic, _| is_of(topic, "mixer")).await;
        seq += 1;
        assert_eq!(batch["seq"], seq, "each once, in order");
        if batch["hist"].is_null() {
            break;
        }
    }
    bridge.wait_for_log("the broker takes the batches of this PLC again");
    println!("{} connections", bridge.log().matches("mqtt: connected").count());
    bridge.signal("TERM");
    assert!(bridge.wait().success(), "{}", bridge.log());
}

/// Waits until the output says this, and that it is not connected.
async fn assert_fails(url: &str, more: Value, expected: &str) -> String {
    let output = Output::start(url, more);
    output.wait_for("failure", |output| output.health.failure().is_some()).await;
    let failure = output.health.failure().unwrap();
    println!("{failure}");
    assert!(failure.contains(expected), "{failure} does not say {expected}");
    assert!(!output.health.is_connected());
    output.stop().await;
    failure
}
