//! States, discovery messages and commands of the MQTT output, at a broker that records everything.

mod common;

use std::time::{Duration, SystemTime};

use common::mqtt_broker::{Action, Broker, Received};
use common::mqtt_output::{Output, PolledPlant};
use fatek::Value as PlcValue;
use fatek::{element, register};
use fatek_bridge::batch::milliseconds;
use fatek_bridge::registry::Elsewhere;
use rumqttc::v5::mqttbytes::v5::PublishProperties;
use serde_json::{Value, json};
use tokio::time::sleep;

const PLANT: &str = "\
[class]
fast = { every = '100ms' }
[plc.mixer]
link = 'LINK'
station = 1
tag.level = { at = 'R5:i16', class = 'fast', unit = '%' }
tag.alarm = { at = 'M7', class = 'fast' }
tag.setpoint = { at = 'R200', class = 'fast', write = { min = 0, max = 80 } }
tag.start = { at = 'M100', class = 'fast', write = { pulse = '100ms' } }
tag.pump = { at = 'M101', class = 'fast', write = {} }
";
const BOILER: &str = "\
[plc.boiler]
link = 'LINK'
station = 2
tag.level = { at = 'R5:i16', class = 'fast' }
";

const BOILER_ALONE: &str = "\
[class]
fast = { every = '100ms' }
[plc.boiler]
link = 'LINK'
station = 2
tag.level = { at = 'R5:i16', class = 'fast' }
";

/// The messages of a topic.
fn of_topic(broker: &Broker, topic: &str) -> Vec<Received> {
    broker.received().into_iter().filter(|received| received.topic == topic).collect()
}

fn is_online(broker: &Broker, plc: &str) -> Option<bool> {
    broker.retained_json(&format!("fatek/hall-2/{plc}/state"))?["online"].as_bool()
}

#[tokio::test(flavor = "multi_thread")]
async fn the_state_of_a_plc_is_sent_on_change_and_at_each_connection() {
    let broker = Broker::start().await;
    let mut plant = PolledPlant::start(PLANT).await;
    let output = Output::start_with(&broker.url(), json!({}), plant.registry.clone(), None);
    // The round trip may come in a second state. It stays away when the first one does not count as a change.
    let state = |broker: &Broker| broker.retained_json("fatek/hall-2/mixer/state").unwrap_or_default();
    let has_round_trip = |broker: &Broker| state(broker)["rtt_ms"].is_f64();
    broker.wait_for("online", |broker| is_online(broker, "mixer") == Some(true) && has_round_trip(broker)).await;
    assert!(state(&broker).get("why").is_none(), "{}", state(&broker));
    // Round trips change all the time, and are no change.
    let before = of_topic(&broker, "fatek/hall-2/mixer/state").len();
    sleep(Duration::from_secs(3)).await;
    assert_eq!(of_topic(&broker, "fatek/hall-2/mixer/state").len(), before);

    drop(plant.server.take());
    broker.wait_for("offline", |broker| is_online(broker, "mixer") == Some(false)).await;
    let state = broker.retained_json("fatek/hall-2/mixer/state").unwrap();
    assert!(state["why"].is_string(), "{state}");

    // At the next connection all states are sent again: the broker may have lost them.
    broker.behave(|_| Action::Cut);
    output.health.set_failed("the test looks for the next connection");
    plant.apply(&format!("{PLANT}{BOILER}"));
    broker.wait_for("loss", |broker| broker.connected()[0].is_closed).await;
    broker.behave(|_| Action::Ack);
    let sent_again = |broker: &Broker| {
        let topics = ["fatek/hall-2/state", "fatek/hall-2/mixer/state", "fatek/hall-2/boiler/state"];
        let last = broker.connected().len();
        topics.iter().all(|topic| of_topic(broker, topic).iter().any(|one| one.connection == last && one.retain))
    };
    broker.wait_for("states", sent_again).await;
    output.stop().await;
}

/// A member of a fleet that has lost a PLC while the broker was away, too. While all messages were queued after the
/// refresh, that dropped the state again: the broker kept the one before for ever.
#[tokio::test(flavor = "multi_thread")]
async fn a_plc_without_a_member_is_offline_at_a_new_connection() {
    let broker = Broker::start().await;
    broker.retain("fatek/hall-2/mixer/state", r#"{"online":true}"#);
    let plant = PolledPlant::start(PLANT).await;
    plant.registry.give_up([(&"mixer".into(), Elsewhere::Lost)]);
    let output = Output::start_with(&broker.url(), json!({}), plant.registry.clone(), None);
    broker.wait_for("offline", |broker| is_online(broker, "mixer") == Some(false)).await;
    output.stop().await;
}

/// The last member of a fleet stops: it says that no PLC has a member.
///
/// While the output ended as soon as the broker had the state of the bridge, this test gave 2 unanswered states: a
/// broker that cannot write the next answer drops the messages behind it, and those PLCs stayed online for ever.
#[tokio::test(flavor = "multi_thread")]
async fn an_output_that_stops_waits_until_the_broker_has_all_states() {
    let broker = Broker::start().await;
    let plant = PolledPlant::start(&format!("{PLANT}{BOILER}")).await;
    let output = Output::start_with(&broker.url(), json!({}), plant.registry.clone(), None);
    broker
        .wait_for("online", |broker| ["mixer", "boiler"].iter().all(|plc| is_online(broker, plc) == Some(true)))
        .await;
    broker.behave(|received| match received.topic.as_str() {
        "fatek/hall-2/state" => Action::Ack,
        _ => Action::AckAfter(Duration::from_millis(100)),
    });
    plant.registry.give_up([(&"mixer".into(), Elsewhere::Lost), (&"boiler".into(), Elsewhere::Lost)]);
    output.stop().await;
    broker.wait_for("end", |broker| broker.connected()[0].is_closed).await;
    let connected = &broker.connected()[0];
    assert_eq!((connected.said_goodbye, connected.unanswered), (true, 0));
}

/// The broker restarts when the last member of a fleet stops.
///
/// While a stop ended the output at the loss, this test gave one connection, and a PLC that stayed online.
#[tokio::test(flavor = "multi_thread")]
async fn the_last_member_connects_again_for_its_last_states() {
    let broker = Broker::start().await;
    let plant = PolledPlant::start(&format!("{PLANT}{BOILER}")).await;
    let output = Output::start_member(&broker.url(), plant.registry.clone());
    broker
        .wait_for("online", |broker| ["mixer", "boiler"].iter().all(|plc| is_online(broker, plc) == Some(true)))
        .await;
    let mut losses = 1;
    broker.behave(move |received| {
        let is_lost = received.topic == "fatek/hall-2/mixer/state" && std::mem::take(&mut losses) > 0;
        if is_lost { Action::Lose } else { Action::Ack }
    });
    plant.registry.give_up([(&"mixer".into(), Elsewhere::Lost), (&"boiler".into(), Elsewhere::Lost)]);
    output.stop().await;
    broker.wait_for("end", |broker| broker.connected().last().unwrap().is_closed).await;
    let online = ["mixer", "boiler"].map(|plc| is_online(&broker, plc));
    assert_eq!((online, broker.connected().len()), ([Some(false); 2], 2));
    assert!(broker.connected()[1].said_goodbye);
}

/// Other PLCs have another member then, or the state of the bridge says enough.
#[tokio::test(flavor = "multi_thread")]
async fn an_output_without_lost_plcs_does_not_connect_again() {
    for is_member in [true, false] {
        let broker = Broker::start().await;
        let plant = PolledPlant::start(PLANT).await;
        let output = match is_member {
            true => Output::start_member(&broker.url(), plant.registry.clone()),
            false => Output::start_with(&broker.url(), json!({}), plant.registry.clone(), None),
        };
        broker.wait_for("online", |broker| is_online(broker, "mixer") == Some(true)).await;
        broker.behave(|_| Action::Lose);
        output.stop().await;
        assert_eq!(broker.connected().len(), 1, "member: {is_member}");
    }
}

/// A batch that the session sends alone, since it may be the reason of a loss, is no reason to keep states back.
///
/// While it was one, this test gave an end without the state of the bridge: only its will said that it was offline.
#[tokio::test(flavor = "multi_thread")]
async fn the_last_states_do_not_wait_for_a_batch_under_suspicion() {
    let broker = Broker::start().await;
    let mut batches = 0;
    broker.behave(move |received| {
        batches += u64::from(received.topic.ends_with("/data"));
        match (received.topic.ends_with("/data"), batches) {
            (false, _) => Action::Ack,
            (true, ..=2) => Action::Disconnect(0x95),
            (true, _) => Action::Silence,
        }
    });
    let mut output = Output::start(&broker.url(), json!({}));
    output.push(9);
    let is_alone = |broker: &Broker| broker.received().iter().any(|received| received.topic.ends_with("/data"));
    broker.wait_for("a batch alone", is_alone).await;
    output.stop().await;
    broker.wait_for("end", |broker| broker.connected().last().unwrap().is_closed).await;
    assert_eq!(broker.retained_json("fatek/hall-2/state"), Some(json!({ "online": false })));
    assert!(broker.connected().last().unwrap().said_goodbye);
}

/// Each answer comes in time, and all of them take longer than a service has to end.
#[tokio::test(flavor = "multi_thread")]
async fn an_output_that_stops_ends_though_the_broker_is_slow() {
    const PLCS: usize = 40;
    let broker = Broker::start().await;
    broker.limit(|limits| limits.receive_max = Some(1));
    let plc = |n: usize| format!("[plc.p{n}]\nlink = 'LINK'\nstation = {}\n", n + 1);
    let plant = PolledPlant::start(&(0..PLCS).map(plc).collect::<String>()).await;
    let output = Output::start_with(&broker.url(), json!({}), plant.registry.clone(), None);
    let names: Vec<std::sync::Arc<str>> = (0..PLCS).map(|n| format!("p{n}").into()).collect();
    broker.wait_for("states", |broker| names.iter().all(|plc| is_online(broker, plc).is_some())).await;
    broker.behave(|_| Action::AckAfter(Duration::from_millis(500)));
    plant.registry.give_up(names.iter().map(|name| (name, Elsewhere::Lost)));
    let took = output.stop().await;
    // A slow machine sees fewer answers.
    assert!(took >= Duration::from_secs(4), "{took:?}");
    broker.wait_for("end", |broker| broker.connected()[0].is_closed).await;
    assert!(!broker.connected()[0].said_goodbye, "the will says that the bridge is offline");
}

/// A broker that takes few messages at once, far away: each round takes 100 ms, and all of them more than a second.
///
/// While the output ended a second after its stop, this test gave 20 states at the broker.
#[tokio::test(flavor = "multi_thread")]
async fn an_output_that_stops_goes_on_while_the_broker_takes_states() {
    const PLCS: usize = 24;
    let broker = Broker::start().await;
    broker.limit(|limits| limits.receive_max = Some(2));
    let plc = |n: usize| format!("[plc.p{n}]\nlink = 'LINK'\nstation = {}\n", n + 1);
    let plant = PolledPlant::start(&(0..PLCS).map(plc).collect::<String>()).await;
    let output = Output::start_with(&broker.url(), json!({}), plant.registry.clone(), None);
    let names: Vec<String> = (0..PLCS).map(|n| format!("p{n}")).collect();
    broker.wait_for("states", |broker| names.iter().all(|plc| is_online(broker, plc).is_some())).await;
    broker.behave(|_| Action::AckAfter(Duration::from_millis(100)));
    let lost: Vec<std::sync::Arc<str>> = names.iter().map(|name| name.as_str().into()).collect();
    plant.registry.give_up(lost.iter().map(|name| (name, Elsewhere::Lost)));
    output.stop().await;
    broker.wait_for("end", |broker| broker.connected()[0].is_closed).await;
    let why = |plc: &String| broker.retained_json(&format!("fatek/hall-2/{plc}/state")).unwrap()["why"].clone();
    let known = names.iter().filter(|plc| why(plc) == "fleet: no member polls it").count();
    assert_eq!((known, broker.connected()[0].said_goodbye), (PLCS, true));
}

#[tokio::test(flavor = "multi_thread")]
async fn a_reload_publishes_what_is_new_and_clears_what_has_gone() {
    let broker = Broker::start().await;
    // Of an earlier run, and of another bridge.
    broker.retain("fatek/hall-2/gone/state", r#"{"online":true}"#);
    broker.retain("ha/sensor/fatek_-hall-2/gone_-level/config", "{}");
    broker.retain("fatek/hall-20/gone/state", r#"{"online":true}"#);
    broker.retain("ha/sensor/fatek_-hall-20/gone_-level/config", "{}");
    let plant = PolledPlant::start(&format!("{PLANT}{BOILER}")).await;
    let more = json!({ "home_assistant": "ha" });
    let output = Output::start_with(&broker.url(), more, plant.registry.clone(), None);
    let topics = |broker: &Broker| broker.retained().into_keys().collect::<Vec<String>>();
    let all = [
        "fatek/hall-2/boiler/state",
        "fatek/hall-2/mixer/state",
        "fatek/hall-2/state",
        "fatek/hall-20/gone/state",
        "ha/binary_sensor/fatek_-hall-2/mixer_-alarm/config",
        "ha/binary_sensor/fatek_-hall-2/mixer_-pump/config",
        "ha/binary_sensor/fatek_-hall-2/mixer_-start/config",
        "ha/sensor/fatek_-hall-2/boiler_-level/config",
        "ha/sensor/fatek_-hall-2/mixer_-level/config",
        "ha/sensor/fatek_-hall-2/mixer_-setpoint/config",
        "ha/sensor/fatek_-hall-20/gone_-level/config",
    ];
    broker.wait_for("all messages", |broker| topics(broker) == all).await;

    // A PLC and a tag go, and another tag comes.
    plant.apply(&PLANT.replace("tag.alarm = { at = 'M7'", "tag.lamp = { at = 'M7'"));
    let all = [
        "fatek/hall-2/mixer/state",
        "fatek/hall-2/state",
        "fatek/hall-20/gone/state",
        "ha/binary_sensor/fatek_-hall-2/mixer_-lamp/config",
        "ha/binary_sensor/fatek_-hall-2/mixer_-pump/config",
        "ha/binary_sensor/fatek_-hall-2/mixer_-start/config",
        "ha/sensor/fatek_-hall-2/mixer_-level/config",
        "ha/sensor/fatek_-hall-2/mixer_-setpoint/config",
        "ha/sensor/fatek_-hall-20/gone_-level/config",
    ];
    broker.wait_for("the difference", |broker| topics(broker) == all).await;

    // Home Assistant starts anew, and may have forgotten its entities.
    let level = "ha/sensor/fatek_-hall-2/mixer_-level/config";
    let before = of_topic(&broker, level).len();
    broker.send("ha/status", "offline", false, None);
    broker.send("ha/status", "online", true, None);
    sleep(Duration::from_millis(300)).await;
    assert_eq!(of_topic(&broker, level).len(), before);
    broker.send("ha/status", "online", false, None);
    broker.wait_for("discovery", |broker| of_topic(broker, level).len() == before + 1).await;
    output.stop().await;
}

/// Seen without its cure: the states and entities of the old names stayed at the broker.
#[tokio::test(flavor = "multi_thread")]
async fn after_a_reload_nothing_is_kept_under_the_old_names() {
    let broker = Broker::start().await;
    let plant = PolledPlant::start(BOILER_ALONE).await;
    let topics = |broker: &Broker| broker.retained().into_keys().collect::<Vec<String>>();
    let other = "plant/hall-20/state";
    broker.retain(other, "{}");
    let mut former = None;
    for (more, expected) in [
        (
            json!({ "prefix": "plant", "home_assistant": "ha" }),
            vec!["ha/sensor/plant_-hall-2/boiler_-level/config", "plant/hall-2/boiler/state", "plant/hall-2/state"],
        ),
        // Another prefix of the topics, and then of the entities; and then there are no entities.
        (
            json!({ "prefix": "fatek", "home_assistant": "ha" }),
            vec!["fatek/hall-2/boiler/state", "fatek/hall-2/state", "ha/sensor/fatek_-hall-2/boiler_-level/config"],
        ),
        (
            json!({ "home_assistant": "ha2" }),
            vec!["fatek/hall-2/boiler/state", "fatek/hall-2/state", "ha2/sensor/fatek_-hall-2/boiler_-level/config"],
        ),
        (json!({}), vec!["fatek/hall-2/boiler/state", "fatek/hall-2/state"]),
    ] {
        let registry = plant.registry.clone();
        let output = Output::start_after(&broker.url(), more.clone(), former.replace(more), registry, None);
        let mut expected: Vec<&str> = expected.into_iter().chain([other]).collect();
        expected.sort_unstable();
        broker.wait_for("the new names alone", |broker| topics(broker) == expected).await;
        output.stop().await;
    }
}

/// A command for `mixer` with an id of this number.
fn command(tag: &str, value: Value, id: u32) -> String {
    json!({ "id": format!("c{id}"), "tag": tag, "value": value, "ts": milliseconds(SystemTime::now()) }).to_string()
}

fn respond_to(topic: &str, correlation: &'static [u8]) -> Option<PublishProperties> {
    Some(PublishProperties {
        response_topic: Some(topic.to_owned()),
        correlation_data: Some(correlation.into()),
        ..PublishProperties::default()
    })
}

const COMMANDS: &str = "fatek/hall-2/mixer/cmd";
const REPLIES: &str = "fatek/hall-2/mixer/cmd/reply";

/// An output that takes commands.
async fn with_commands(broker: &Broker, plant: &PolledPlant, more: Value) -> Output {
    let commands = plant.commands().await;
    let output = Output::start_with(&broker.url(), more, plant.registry.clone(), Some(commands));
    let is_subscribed = |broker: &Broker| broker.subscriptions().iter().any(|filter| filter == "fatek/hall-2/+/cmd");
    broker.wait_for("subscription", is_subscribed).await;
    broker.wait_for("online", |broker| is_online(broker, "mixer") == Some(true)).await;
    output
}

/// Waits for the reply with an id at a topic, and returns it.
async fn reply(broker: &Broker, topic: &str, id: u32) -> (Value, Received) {
    let find = |broker: &Broker| {
        let all = of_topic(broker, topic).into_iter();
        let mut all = all.map(|one| (serde_json::from_slice::<Value>(&one.payload).unwrap(), one));
        all.find(|(reply, _)| reply["id"] == format!("c{id}"))
    };
    broker.wait_for(&format!("reply {id}"), |broker| find(broker).is_some()).await;
    find(broker).unwrap()
}

#[tokio::test(flavor = "multi_thread")]
async fn a_command_is_executed_and_answered_where_it_says() {
    let broker = Broker::start().await;
    let plant = PolledPlant::start(PLANT).await;
    let output = with_commands(&broker, &plant, json!({ "home_assistant": "ha" })).await;
    assert!(broker.retained().contains_key("ha/number/fatek_-hall-2/mixer_-setpoint/config"));

    broker.send(COMMANDS, &command("setpoint", json!(42), 1), false, respond_to("client/7", b"\x00\xFF"));
    let (answer, received) = reply(&broker, "client/7", 1).await;
    assert_eq!((&answer["result"], &answer["read_back"]), (&json!("ok"), &json!(42)), "{answer}");
    assert_eq!(received.properties.unwrap().correlation_data.as_deref(), Some(&b"\x00\xFF"[..]));
    assert!(!received.retain);
    assert_eq!(plant.plcs[0].read(register!("R200")), PlcValue::Word(42));

    broker.send(COMMANDS, &command("setpoint", json!(99), 2), false, None);
    let (answer, received) = reply(&broker, REPLIES, 2).await;
    assert_eq!(answer["result"], "refused", "{answer}");
    assert!(received.properties.is_none_or(|all| all.correlation_data.is_none()));
    // The broker would keep it, and give it to each client that comes.
    broker.send(COMMANDS, &command("setpoint", json!(7), 3), true, None);
    assert_eq!(reply(&broker, REPLIES, 3).await.0["result"], "refused");
    // A response topic of the bridge itself.
    broker.send(COMMANDS, &command("setpoint", json!(43), 4), false, respond_to("fatek/hall-2/state", b""));
    assert_eq!(reply(&broker, REPLIES, 4).await.0["result"], "ok");
    assert_eq!(plant.plcs[0].read(register!("R200")), PlcValue::Word(43));
    output.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn the_reply_of_a_command_outlives_the_connection() {
    let broker = Broker::start().await;
    let plant = PolledPlant::start(PLANT).await;
    let output = with_commands(&broker, &plant, json!({})).await;
    let mut cuts = 1;
    broker.behave(move |received| match received.topic.as_str() {
        "client/7" if cuts > 0 => {
            cuts -= 1;
            Action::Lose
        }
        _ => Action::Ack,
    });
    broker.send(COMMANDS, &command("pump", json!(true), 1), false, respond_to("client/7", b"x"));
    let (answer, received) = reply(&broker, "client/7", 1).await;
    assert_eq!((&answer["result"], received.connection), (&json!("ok"), 2), "{answer}");
    output.stop().await;
}

/// Topics, payloads and properties of all kinds: each command has a reply, and none changes what it must not.
#[tokio::test(flavor = "multi_thread")]
async fn hostile_commands_change_nothing_and_stop_nothing() {
    let broker = Broker::start().await;
    let plant = PolledPlant::start(PLANT).await;
    let mut output = with_commands(&broker, &plant, json!({ "home_assistant": "ha" })).await;
    plant.plcs[0].write(register!("R5"), 1234_u16).unwrap();
    let mut random = fastrand::Rng::with_seed(5);
    let good = command("setpoint", json!(50), 0);
    let responses =
        ["", "#", "a/+/b", "$SYS/x", "fatek/hall-2/mixer/cmd", "fatek/hall-2/state", "ha/sensor/x/config", "c/r"];
    let commands = 2000;
    for number in 0..commands {
        let plc = *random.choice(["mixer", "none", "state", "..", "mixer%00", "\u{202E}", "$"].iter()).unwrap();
        let mut payload = good.clone().into_bytes();
        for _ in 0..random.usize(1..6) {
            let at = random.usize(..payload.len().max(1));
            if payload.is_empty() {
                break;
            }
            match random.u8(..4) {
                0 => payload[at] = random.u8(b' '..b'~'),
                1 => drop(payload.remove(at)),
                2 => payload.insert(at, random.u8(b' '..b'~')),
                _ => payload.truncate(at.max(1)),
            }
        }
        let payload = String::from_utf8(payload).unwrap();
        let response = *random.choice(responses.iter()).unwrap();
        broker.send(&format!("fatek/hall-2/{plc}/cmd"), &payload, random.bool(), respond_to(response, b"\xFF"));
        if number % 20 == 0 {
            sleep(Duration::from_millis(10)).await;
        }
    }
    let is_reply = |received: &Received| received.topic.ends_with("/cmd/reply") || received.topic == "c/r";
    let replies = |broker: &Broker| broker.received().iter().filter(|received| is_reply(received)).count();
    broker.wait_for("replies", |broker| replies(broker) >= commands).await;
    // Only batches, states, discovery messages and replies were sent.
    let is_own =
        |one: &Received| one.topic.starts_with("fatek/hall-2/") || one.topic.starts_with("ha/") || is_reply(one);
    assert!(broker.received().iter().all(is_own));
    assert!(of_topic(&broker, COMMANDS).is_empty());
    let state = broker.retained_json("fatek/hall-2/state").unwrap();
    assert_eq!(state["online"], true);
    let plc = &plant.plcs[0];
    assert_eq!(plc.read(register!("R5")), PlcValue::Word(1234));
    let PlcValue::Word(setpoint) = plc.read(register!("R200")) else { panic!("not a word") };
    assert!(setpoint <= 80, "{setpoint}");
    assert_eq!(plc.read(element!("M7")), PlcValue::Bit(false));
    // It still works.
    output.push(3);
    output.wait_until_delivered().await;
    assert_eq!(broker.connected().len(), 1, "{:?}", output.health.failure());
    output.stop().await;
}

/// Without the cure it was written, and its reply never came: R200 = 42.
#[tokio::test(flavor = "multi_thread")]
async fn a_command_that_comes_while_the_output_ends_is_not_executed() {
    let broker = Broker::start().await;
    let plant = PolledPlant::start(PLANT).await;
    let output = with_commands(&broker, &plant, json!({})).await;
    // The output waits for the acknowledgement of its last state.
    let is_last = |received: &Received| {
        received.topic == "fatek/hall-2/state" && received.payload.as_ref() == br#"{"online":false}"#
    };
    broker.behave(move |received| if is_last(received) { Action::Silence } else { Action::Ack });
    let late = async {
        broker.wait_for("last state", |broker| broker.received().iter().any(is_last)).await;
        broker.send(COMMANDS, &command("setpoint", json!(42), 1), false, None);
    };
    tokio::join!(output.stop(), late);
    let replies: Vec<Value> =
        of_topic(&broker, REPLIES).iter().map(|one| serde_json::from_slice(&one.payload).unwrap()).collect();
    println!("{replies:?}");
    assert!(replies.iter().all(|reply| reply["result"] == "refused"), "{replies:?}");
    assert_eq!(plant.plcs[0].read(register!("R200")), PlcValue::Word(0));
}
