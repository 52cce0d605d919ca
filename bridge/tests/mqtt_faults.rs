//! Delivery of the MQTT output to a broker that fails at exact moments.

mod common;

use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant, SystemTime};

use common::deliveries::Deliveries;
use common::mqtt_broker::{Action, Broker, Received};
use common::mqtt_output::{Output, PolledPlant, batch};
use fatek_bridge::batch::milliseconds;
use serde_json::{Value, json};
use tokio::time::sleep;

fn is_batch(received: &Received) -> bool {
    received.topic.ends_with("/data")
}

/// Answers batches as the closure says, by their number from 1, and acknowledges all other messages.
fn on_batch(mut answer: impl FnMut(u64) -> Action + Send + 'static) -> impl FnMut(&Received) -> Action + Send {
    let mut number = 0;
    move |received| {
        if !is_batch(received) {
            return Action::Ack;
        }
        number += 1;
        answer(number)
    }
}

/// The number of the batch of `mixer` that a message is; `None`: it is another message.
fn mixer(received: &Received) -> Option<u64> {
    batch(received).filter(|(plc, _)| plc == "mixer").and_then(|(_, batch)| batch["seq"].as_u64())
}

#[tokio::test]
async fn batches_are_delivered_with_qos_1_and_in_order() {
    let broker = Broker::start().await;
    let mut output = Output::start(&broker.url(), json!({}));
    output.push(1000);
    output.wait_until_delivered().await;
    let result = output.check(&broker);
    assert_eq!(result, Deliveries { batches: 1000, ..Deliveries::default() });
    let received = broker.received();
    let batches: Vec<_> = received.iter().filter(|received| is_batch(received)).collect();
    assert!(batches.iter().all(|one| one.qos as u8 == 1 && !one.retain));
    let (plc, first) = batch(batches[0]).unwrap();
    assert_eq!((plc.as_str(), &first["seq"], &first["d"]), ("mixer", &json!(0), &json!({ "n": "x" })));
    assert!(first.get("hist").is_none() && first["ts"].as_u64() > Some(1_700_000_000_000), "{first}");
    assert_eq!(output.health.delivered(), (1000, 1000));
    output.stop().await;
}

#[tokio::test]
async fn birth_and_will_are_sent_at_each_connection() {
    let broker = Broker::start().await;
    broker.behave(on_batch(|number| if number % 4 == 0 { Action::Cut } else { Action::Ack }));
    let mut output = Output::start(&broker.url(), json!({ "user": "me" }));
    for connections in 1..=3 {
        broker.wait_for("connection", |broker| broker.connected().len() >= connections).await;
        output.push(4);
        broker.wait_for("loss", |broker| broker.connected()[connections - 1].is_closed).await;
    }
    let connected = broker.connected();
    for one in &connected {
        assert!(one.connect.clean_start && one.connect.client_id == "fatek-hall-2", "{:?}", one.connect);
        assert!((10..=30).contains(&one.connect.keep_alive), "{:?}", one.connect);
        assert_eq!(one.connect.properties.as_ref().unwrap().session_expiry_interval, Some(0));
        let will = one.will.as_ref().unwrap();
        assert_eq!((&will.topic[..], &will.message[..]), (&b"fatek/hall-2/state"[..], &b"{\"online\":false}"[..]));
        assert!(will.retain && will.qos as u8 == 1);
    }
    let births: Vec<_> = broker.received().into_iter().filter(|one| one.topic == "fatek/hall-2/state").collect();
    let of: Vec<usize> = births.iter().map(|birth| birth.connection).collect();
    assert!((1..=3).all(|connection| of.contains(&connection)), "{of:?}");
    for birth in births {
        let state: Value = serde_json::from_slice(&birth.payload).unwrap();
        assert_eq!((&state["online"], &state["version"]), (&json!(true), &json!(env!("CARGO_PKG_VERSION"))));
        assert!(birth.retain);
    }
    output.stop().await;
}

/// With an acknowledgement in the buffer as soon as a message is sent, 2515 of 3000 batches were lost.
#[tokio::test]
async fn a_connection_that_is_cut_at_any_message_loses_nothing() {
    let broker = Broker::start().await;
    let (mut random, mut cuts) = (fastrand::Rng::with_seed(17), 12);
    broker.behave(on_batch(move |_| {
        if cuts == 0 || random.u32(..60) > 0 {
            return Action::Ack;
        }
        cuts -= 1;
        if random.bool() { Action::Cut } else { Action::Lose }
    }));
    let mut output = Output::start(&broker.url(), json!({}));
    output.push(3000);
    output.wait_until_delivered().await;
    let result = output.check(&broker);
    println!("12 cuts: {result:?}");
    assert_eq!((result.batches, result.lost, result.out_of_order, result.unmarked), (3000, 0, 0, 0));
    assert_eq!(output.health.reconnects(), 12);
    output.stop().await;
}

/// With the highest acknowledged position in place of a prefix, the batch without an acknowledgement was lost.
#[tokio::test]
async fn a_lost_acknowledgement_among_others_in_any_order_loses_nothing() {
    let broker = Broker::start().await;
    broker.limit(|limits| limits.server_keep_alive = Some(2));
    broker.behave(on_batch(|number| match number {
        41 => Action::LoseAndStay,
        ..=200 => Action::HoldAndReverse(4),
        _ => Action::Ack,
    }));
    let mut output = Output::start(&broker.url(), json!({}));
    output.push(600);
    output.wait_for("loss", |output| output.health.failure().is_some()).await;
    assert_eq!(output.health.failure().unwrap(), "the broker has not acknowledged a message for 6s");
    output.wait_until_delivered().await;
    let result = output.check(&broker);
    println!("a lost acknowledgement: {result:?}");
    assert_eq!((result.batches, result.lost, result.out_of_order, result.unmarked), (600, 0, 1, 0));
    assert!(output.health.reconnects() >= 1);
    output.stop().await;
}

/// The event loop of `rumqttc` ends the connection at the second acknowledgement.
#[tokio::test]
async fn a_second_acknowledgement_has_no_effect() {
    let broker = Broker::start().await;
    broker.behave(|_| Action::AckTwice);
    let mut output = Output::start(&broker.url(), json!({}));
    output.push(300);
    output.wait_until_delivered().await;
    assert_eq!(output.check(&broker), Deliveries { batches: 300, ..Deliveries::default() });
    assert_eq!((broker.connected().len(), output.health.delivered()), (1, (300, 300)));
    output.stop().await;
}

#[tokio::test]
async fn no_more_messages_are_in_flight_than_the_broker_takes() {
    for limit in [1, 7] {
        let broker = Broker::start().await;
        broker.limit(|limits| limits.receive_max = Some(limit));
        broker.behave(move |_| Action::HoldAndReverse(usize::from(limit)));
        let mut output = Output::start(&broker.url(), json!({}));
        output.push(500);
        // The last ones are held: there are not enough of them.
        output.wait_for("delivered", |output| output.lag() < limit.into()).await;
        let most = broker.connected()[0].most_in_flight;
        assert_eq!(most, usize::from(limit));
        output.stop().await;
    }
}

/// The other output takes all batches while this broker reads nothing. With one task for both, or a buffer that
/// waits for its slowest output, its batches were as old as the stall.
#[tokio::test(flavor = "multi_thread")]
async fn a_broker_that_stops_reading_holds_up_no_other_output() {
    let broker = Broker::start().await;
    broker.limit(|limits| limits.server_keep_alive = Some(2));
    let mut stalls = 2;
    broker.behave(on_batch(move |number| {
        if stalls > 0 && number % 20 == 0 {
            stalls -= 1;
            return Action::StopReading;
        }
        Action::Ack
    }));
    let mut output = Output::start(&broker.url(), json!({}));
    let oldest = Arc::new(Mutex::new((0, 0)));
    let (mut other, seen) = (output.buffer.cursor(1), oldest.clone());
    let other = tokio::spawn(async move {
        loop {
            for entry in other.next(1000).await {
                let age = milliseconds(SystemTime::now()) - entry.batch.ts;
                let mut seen = seen.lock().unwrap();
                *seen = (seen.0.max(age), seen.1 + 1);
                drop(seen);
                other.acknowledge(entry.position);
            }
        }
    });
    // Much more than sockets take, in the time in which the stalls are noticed.
    let begin = Instant::now();
    while begin.elapsed() < Duration::from_secs(8) {
        output.push_sized(40, 2000);
        sleep(Duration::from_millis(20)).await;
    }
    let (age, taken) = *oldest.lock().unwrap();
    println!("two stalls in 8 s: the other output has {taken} batches, of {age} ms at most");
    assert_eq!(taken, output.pushed);
    assert!(age < 2000, "{age} ms");
    output.wait_until_delivered().await;
    let result = output.check(&broker);
    println!("the stalled one: {result:?}, {} connections", broker.connected().len());
    assert_eq!((result.lost, result.out_of_order, result.unmarked), (0, 0, 0));
    assert!(broker.connected().len() >= 3, "{:?}", output.health.failure());
    other.abort();
    output.stop().await;
}

#[tokio::test]
async fn batches_without_a_subscriber_are_counted_or_kept() {
    let broker = Broker::start().await;
    broker.behave(on_batch(|_| Action::AckWith(0x10)));
    let mut output = Output::start(&broker.url(), json!({}));
    output.push(90);
    output.wait_until_delivered().await;
    assert_eq!((output.health.no_subscribers(), output.health.failure()), (90, None));
    output.stop().await;

    let broker = Broker::start().await;
    broker.behave(on_batch(|_| Action::AckWith(0x10)));
    let plant = PolledPlant::of_batches().await;
    let mut output =
        Output::start_with(&broker.url(), json!({ "require_subscribers": true }), plant.registry.clone(), None);
    output.push(90);
    output.wait_for("failure", |output| output.health.failure().is_some()).await;
    assert!(output.health.failure().unwrap().contains("no subscriber"));
    assert!(output.health.is_connected());
    assert_eq!(output.lag(), 90);
    broker.behave(|_| Action::Ack);
    output.wait_until_delivered().await;
    assert_eq!((output.check(&broker).lost, output.health.failure()), (0, None));
    output.stop().await;
}

/// Without the growing delays, there were 4350 attempts.
#[tokio::test]
async fn refused_batches_are_kept_and_are_no_hot_loop() {
    let broker = Broker::start().await;
    broker.behave(on_batch(|_| Action::AckWith(0x87)));
    let plant = PolledPlant::of_batches().await;
    let mut output = Output::start_with(&broker.url(), json!({}), plant.registry.clone(), None);
    output.push(50);
    sleep(Duration::from_secs(4)).await;
    let attempts = broker.batches().len() - 50;
    println!("{attempts} attempts in 4 s; {:?}", output.health.failure());
    // Each of the three PLCs has its own.
    assert!((3..=24).contains(&attempts), "{attempts}");
    assert!(output.health.failure().unwrap().contains("not authorized (0x87)"));
    assert_eq!((output.lag(), output.health.delivered()), (50, (0, 0)));
    assert_eq!(usize::try_from(output.health.refused()).unwrap(), attempts + 50);
    broker.behave(|_| Action::Ack);
    output.wait_until_delivered().await;
    assert_eq!((output.check(&broker).lost, output.health.failure()), (0, None));
    assert_eq!(output.health.reconnects(), 0);
    output.stop().await;
}

/// With one refusal for all, the second 200 batches of `boiler` and `pump-1` were not delivered.
#[tokio::test]
async fn a_refused_plc_holds_up_no_other() {
    let broker = Broker::start().await;
    let is_mixer = |received: &Received| received.topic == "fatek/hall-2/mixer/data";
    broker.behave(move |received| if is_mixer(received) { Action::AckWith(0x87) } else { Action::Ack });
    let plant = PolledPlant::of_batches().await;
    let mut output = Output::start_with(&broker.url(), json!({}), plant.registry.clone(), None);
    output.push(300);
    output.wait_for("the others", |output| output.health.delivered().0 == 200).await;
    let failure = output.health.failure().unwrap();
    assert!(failure.starts_with("batches of mixer: ") && failure.ends_with("not authorized (0x87)"), "{failure}");
    let refused = output.health.refused_plcs();
    assert!(refused["mixer"].is_refused && refused.len() == 1, "{refused:?}");
    // News of the others go on, and those of the mixer wait behind its first batch.
    let sent = |broker: &Broker| broker.received().iter().filter(|received| is_mixer(received)).count();
    let before = sent(&broker);
    output.push(300);
    output.wait_for("the others", |output| output.health.delivered().0 == 400).await;
    sleep(Duration::from_secs(1)).await;
    let attempts = sent(&broker) - before;
    println!("{attempts} attempts meanwhile");
    assert!(attempts <= 20, "{attempts}");
    broker.behave(|_| Action::Ack);
    output.wait_until_delivered().await;
    assert_eq!((output.health.failure(), output.health.skipped()), (None, 0));
    assert!(!output.health.refused_plcs()["mixer"].is_refused);
    let result = output.check(&broker);
    println!("a refused PLC: {result:?}");
    assert_eq!((result.batches, result.lost, result.unmarked), (600, 0, 0));
    assert_eq!(output.health.reconnects(), 0);
    output.stop().await;
}

/// Without the check of the size, the broker ended the connection at the large batch, again and again.
#[tokio::test]
async fn a_batch_that_is_too_large_is_given_up_alone() {
    let broker = Broker::start().await;
    broker.limit(|limits| limits.max_packet_size = Some(2000));
    let mut output = Output::start(&broker.url(), json!({}));
    output.push(10);
    output.push_sized(1, 3000);
    output.push(10);
    output.wait_until_delivered().await;
    let result = output.check(&broker);
    assert_eq!((result.batches, result.lost, result.duplicates), (20, 1, 0));
    assert_eq!((output.health.skipped(), output.health.delivered().0), (1, 20));
    output.stop().await;
}

/// mosquitto answers 0x95, which is no reason of a PUBACK, and which the decoder of `rumqttc` refuses.
#[tokio::test]
async fn a_batch_that_the_broker_finds_too_large_is_given_up_alone() {
    let broker = Broker::start().await;
    broker.behave(|received| if mixer(received) == Some(3) { Action::AckWith(0x95) } else { Action::Ack });
    let mut output = Output::start(&broker.url(), json!({}));
    output.push(30);
    output.wait_until_delivered().await;
    assert_eq!((output.health.skipped(), output.health.refused(), output.health.delivered().0), (1, 1, 29));
    assert_eq!(output.health.reconnects(), 0);
    output.stop().await;
}

/// Without the search for the guilty batch, no batch was delivered within 30 s and 8 connections.
#[tokio::test]
async fn a_batch_that_ends_the_connection_is_given_up_alone() {
    let broker = Broker::start().await;
    broker.behave(|received| if mixer(received) == Some(5) { Action::Disconnect(0x95) } else { Action::Ack });
    let mut output = Output::start(&broker.url(), json!({}));
    output.push(30);
    output.wait_until_delivered().await;
    let result = output.check(&broker);
    println!("a batch that ends the connection: {result:?}, {} connections", broker.connected().len());
    assert_eq!((result.batches, result.lost, result.out_of_order), (29, 1, 0));
    assert_eq!((output.health.skipped(), output.health.delivered().0), (1, 29));
    output.stop().await;
}

#[tokio::test]
async fn a_client_with_the_same_id_is_not_fought() {
    let broker = Broker::start().await;
    broker.behave(on_batch(|_| Action::Disconnect(0x8E)));
    let mut output = Output::start(&broker.url(), json!({}));
    output.push(1);
    output.wait_for("failure", |output| output.health.failure().is_some()).await;
    assert!(output.health.failure().unwrap().contains("another client with the same id"));
    sleep(Duration::from_secs(3)).await;
    assert_eq!((broker.connected().len(), output.lag()), (1, 1));
    output.stop().await;
}

#[tokio::test]
async fn a_stopped_output_leaves_the_state_offline() {
    let broker = Broker::start().await;
    let output = Output::start(&broker.url(), json!({}));
    broker.wait_for("birth", |broker| broker.retained_json("fatek/hall-2/state").is_some()).await;
    assert_eq!(broker.retained_json("fatek/hall-2/state").unwrap()["online"], true);
    output.stop().await;
    broker.wait_for("end", |broker| broker.connected()[0].is_closed).await;
    assert!(broker.connected()[0].said_goodbye);
    assert_eq!(broker.retained_json("fatek/hall-2/state"), Some(json!({ "online": false })));
}

/// A DISCONNECT would keep the broker from publishing the will.
#[tokio::test]
async fn without_an_answer_the_will_says_that_the_output_has_stopped() {
    let broker = Broker::start().await;
    let mut output = Output::start(&broker.url(), json!({}));
    broker.wait_for("birth", |broker| broker.retained_json("fatek/hall-2/state").is_some()).await;
    broker.behave(|_| Action::Silence);
    output.push(10);
    let took = output.stop().await;
    assert!(took < Duration::from_secs(5), "{took:?}");
    broker.wait_for("end", |broker| broker.connected()[0].is_closed).await;
    assert!(!broker.connected()[0].said_goodbye);
}

#[tokio::test]
async fn an_output_without_a_broker_says_why_and_stops_at_once() {
    let port = common::mosquitto::free_port();
    let output = Output::start(&format!("mqtt://127.0.0.1:{port}"), json!({}));
    output.wait_for("failure", |output| output.health.failure().is_some()).await;
    let failure = output.health.failure().unwrap();
    assert!(failure.contains("cannot connect") && failure.contains("refused"), "{failure}");
    assert!(output.stop().await < Duration::from_secs(2));
}
