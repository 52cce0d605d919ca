//! Metrics for Prometheus, collected when they are asked for.
//!
//! Names and help texts follow Prometheus' conventions: base units, counters end in `_total`. Labels have
//! few values: names of the configuration, links, and states.

mod bridge;
mod commands;
mod fleet;
mod plcs;
mod tags;

use std::fmt;

use axum::extract::State;
use axum::http::{HeaderMap, StatusCode, header};
use axum::response::{IntoResponse as _, Response};
use prometheus_client::collector::Collector;
use prometheus_client::encoding::{DescriptorEncoder, EncodeCounterValue, EncodeGaugeValue, prometheus_text, text};
use prometheus_client::metrics::MetricType;
use prometheus_client::registry::{Registry, Unit};

use super::Shared;

const OPEN_METRICS: &str = "application/openmetrics-text; version=1.0.0; charset=utf-8";
const PROMETHEUS: &str = "text/plain; version=0.0.4; charset=utf-8";

/// All metrics, as OpenMetrics if the client takes that, else as the text format of Prometheus.
pub(super) async fn answer(State(shared): State<Shared>, headers: HeaderMap) -> Response {
    let takes_open_metrics = headers
        .get_all(header::ACCEPT)
        .iter()
        .any(|accept| accept.to_str().is_ok_and(|accept| accept.contains("application/openmetrics-text")));
    let mut registry = Registry::with_prefix("fatek");
    registry.register_collector(Box::new(Metrics { shared }));
    let mut metrics = String::new();
    let (encoded, media_type) = if takes_open_metrics {
        (text::encode(&mut metrics, &registry), OPEN_METRICS)
    } else {
        (prometheus_text::encode(&mut metrics, &registry), PROMETHEUS)
    };
    match encoded {
        Ok(()) => ([(header::CONTENT_TYPE, media_type)], metrics).into_response(),
        // Writing to a text does not fail.
        Err(fmt::Error) => StatusCode::INTERNAL_SERVER_ERROR.into_response(),
    }
}

/// All metrics of a bridge.
#[derive(Debug)]
struct Metrics {
    shared: Shared,
}

impl Collector for Metrics {
    fn encode(&self, encoder: DescriptorEncoder<'_>) -> fmt::Result {
        let mut writer = Writer { encoder };
        bridge::write(&mut writer, &self.shared)?;
        commands::write(&mut writer, &self.shared)?;
        fleet::write(&mut writer, &self.shared)?;
        plcs::write(&mut writer, &self.shared)?;
        tags::write(&mut writer, &self.shared)
    }
}

/// Writes metrics with their samples.
struct Writer<'e> {
    encoder: DescriptorEncoder<'e>,
}

fn as_u64(count: usize) -> u64 {
    u64::try_from(count).unwrap_or(u64::MAX)
}

/// Labels with their values.
type Labels<'l> = Vec<(&'static str, &'l str)>;

impl Writer<'_> {
    /// Writes a counter; `_total` is appended to its name.
    fn counter<'l, V: EncodeCounterValue>(
        &mut self,
        name: &str,
        unit: Option<Unit>,
        help: &str,
        samples: impl IntoIterator<Item = (Labels<'l>, V)>,
    ) -> fmt::Result {
        let mut metric = self.encoder.encode_descriptor(name, help, unit.as_ref(), MetricType::Counter)?;
        for (labels, value) in samples {
            metric.encode_family(&labels)?.encode_counter::<Labels<'l>, V, u64>(&value, None)?;
        }
        Ok(())
    }

    /// Writes a gauge.
    fn gauge<'l, V: EncodeGaugeValue>(
        &mut self,
        name: &str,
        unit: Option<Unit>,
        help: &str,
        samples: impl IntoIterator<Item = (Labels<'l>, V)>,
    ) -> fmt::Result {
        let mut metric = self.encoder.encode_descriptor(name, help, unit.as_ref(), MetricType::Gauge)?;
        for (labels, value) in samples {
            metric.encode_family(&labels)?.encode_gauge(&value)?;
        }
        Ok(())
    }

    /// Writes texts as the labels of a metric whose value is 1.
    fn info<'l>(&mut self, name: &str, help: &str, samples: impl IntoIterator<Item = Labels<'l>>) -> fmt::Result {
        let mut metric = self.encoder.encode_descriptor(name, help, None, MetricType::Info)?;
        samples.into_iter().try_for_each(|labels| metric.encode_info(&labels))
    }
}
