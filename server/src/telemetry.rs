//! Calls as spans for an OpenTelemetry collector, below the caller's own span. Only with the feature `otel`.

use anyhow::Context as _;
use http::{HeaderMap, HeaderName};
use opentelemetry::{
    propagation::{Extractor, TextMapPropagator as _},
    trace::TracerProvider as _,
};
use opentelemetry_otlp::SpanExporter;
use opentelemetry_sdk::{
    Resource,
    propagation::TraceContextPropagator,
    trace::{SdkTracer, SdkTracerProvider},
};
use tracing::{Span, Subscriber};
use tracing_opentelemetry::{OpenTelemetryLayer, OpenTelemetrySpanExt as _};
use tracing_subscriber::registry::LookupSpan;

const SERVICE: &str = "emp-server";

/// The running export of spans. Dropping it sends what still waits.
#[derive(Debug)]
pub(crate) struct Telemetry(SdkTracerProvider);

impl Telemetry {
    /// Starts the export to the collector that the usual variables name (`OTEL_EXPORTER_OTLP_ENDPOINT`). Whether one is there
    /// is not asked: spans that cannot be sent are lost. Has to be called inside a tokio runtime.
    pub(crate) fn start() -> anyhow::Result<Self> {
        let exporter = SpanExporter::builder()
            .with_tonic()
            .build()
            .context("OpenTelemetry")?;
        let provider = SdkTracerProvider::builder()
            .with_batch_exporter(exporter)
            .with_resource(Resource::builder().with_service_name(SERVICE).build())
            .build();
        Ok(Self(provider))
    }

    pub(crate) fn layer<S>(&self) -> OpenTelemetryLayer<S, SdkTracer>
    where
        S: Subscriber + for<'span> LookupSpan<'span>,
    {
        tracing_opentelemetry::layer().with_tracer(self.0.tracer(SERVICE))
    }
}

impl Drop for Telemetry {
    fn drop(&mut self) {
        // Nobody is left to hear of a failure.
        let _ = self.0.shutdown();
    }
}

struct Headers<'a>(&'a HeaderMap);

impl Extractor for Headers<'_> {
    fn get(&self, key: &str) -> Option<&str> {
        self.0.get(key).and_then(|value| value.to_str().ok())
    }

    fn keys(&self) -> Vec<&str> {
        self.0.keys().map(HeaderName::as_str).collect()
    }
}

/// Puts a call's span below the one that its `traceparent` names.
pub(crate) fn continue_trace(span: &Span, headers: &HeaderMap) {
    let parent = TraceContextPropagator::new().extract(&Headers(headers));
    // Without a layer for it (in tests) there is nothing to continue.
    let _ = span.set_parent(parent);
}
