//! Parts that the integration tests share. Each test program uses some of them.
#![allow(dead_code, unreachable_pub, reason = "each test program uses some of them")]

pub mod bridge;
pub mod deliveries;
pub mod http;
pub mod mosquitto;
pub mod mqtt_broker;
pub mod mqtt_output;
pub mod mqtt_proxy;
pub mod mqtt_subscriber;
pub mod nats;
pub mod openmetrics;
pub mod plc;
