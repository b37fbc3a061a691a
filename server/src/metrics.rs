//! What the process tells a Prometheus server. Every name is here, and described in docs/operations.md.
//!
//! Metrics describe the process, so there is one set of them, reached by [`metrics`].

use std::{
    fs,
    sync::{LazyLock, atomic::AtomicU64},
    time::{Duration, SystemTime, UNIX_EPOCH},
};

use emp_proto::v1::{DropReason, GoalPhase};
use prometheus_client::{
    encoding::{EncodeLabelSet, EncodeLabelValue, text},
    metrics::{
        counter::Counter,
        family::Family,
        gauge::Gauge,
        histogram::{Histogram, exponential_buckets},
        info::Info,
    },
    registry::Registry,
};

use crate::queue::Priority;

/// The content type of [`Metrics::text`].
pub(crate) const CONTENT_TYPE: &str = "application/openmetrics-text; version=1.0.0; charset=utf-8";

/// Clock ticks a second in /proc on Linux, on every architecture that this runs on.
const TICKS: f64 = 100.0;
/// Bytes a page in /proc/self/statm. ARM kernels with larger pages report too little memory here.
const PAGE: f64 = 4096.0;

/// Reasons of [`Metrics::call_refused`] that there usually are.
const REFUSALS: [&str; 5] = [
    "CREDENTIALS_MISSING",
    "CREDENTIALS_UNKNOWN",
    "CREDENTIALS_EXPIRED",
    "PERMISSION_DENIED",
    "OVERLOADED",
];

type Labelled<L, M> = Family<L, M>;
type Histograms<L> = Family<L, Histogram, fn() -> Histogram>;

/// The process's metrics.
pub(crate) fn metrics() -> &'static Metrics {
    static METRICS: LazyLock<Metrics> = LazyLock::new(Metrics::new);
    &METRICS
}

/// Why a log line was left out.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, EncodeLabelValue)]
pub(crate) enum LeftOut {
    /// Too many lines a second.
    Rate,
    /// Standard error does not take them.
    Full,
}

#[derive(Debug, Clone, PartialEq, Eq, Hash, EncodeLabelSet)]
struct LeftOutLabels {
    reason: LeftOut,
}

/// Something with a reason.
#[derive(Debug, Clone, PartialEq, Eq, Hash, EncodeLabelSet)]
struct Reason {
    reason: &'static str,
}

/// A call's method and how it ended.
#[derive(Debug, Clone, PartialEq, Eq, Hash, EncodeLabelSet)]
struct CallLabels {
    method: &'static str,
    code: &'static str,
}

#[derive(Debug, Clone, PartialEq, Eq, Hash, EncodeLabelSet)]
struct MethodLabel {
    method: &'static str,
}

#[derive(Debug, Clone, PartialEq, Eq, Hash, EncodeLabelSet)]
struct RoleLabel {
    role: &'static str,
}

#[derive(Debug, Clone, PartialEq, Eq, Hash, EncodeLabelSet)]
struct ModelLabel {
    model: String,
}

#[derive(Debug, Clone, PartialEq, Eq, Hash, EncodeLabelSet)]
struct WorkLabels {
    model: String,
    priority: &'static str,
}

#[derive(Debug, Clone, PartialEq, Eq, Hash, EncodeLabelSet)]
struct ReloadLabels {
    what: &'static str,
    result: &'static str,
}

/// Everything that is measured.
pub(crate) struct Metrics {
    registry: Registry,
    calls: Labelled<CallLabels, Counter>,
    call_seconds: Histograms<MethodLabel>,
    open_calls: Labelled<MethodLabel, Gauge>,
    refused: Labelled<Reason, Counter>,
    connections: Gauge,
    refused_connections: Labelled<Reason, Counter>,
    accept_errors: Counter,
    reloads: Labelled<ReloadLabels, Counter>,
    log_lines_left_out: Labelled<LeftOutLabels, Counter>,
    audit_lines_left_out: Counter,
    model_serving: Labelled<ModelLabel, Gauge>,
    queue_length: Labelled<WorkLabels, Gauge>,
    queue_seconds: Histograms<WorkLabels>,
    total_seconds: Histograms<WorkLabels>,
    inference_seconds: Histograms<ModelLabel>,
    batch_size: Histograms<ModelLabel>,
    dropped: Labelled<Reason, Counter>,
    sessions: Gauge,
    members: Labelled<RoleLabel, Gauge>,
    guard_periods: Labelled<PhaseLabel, Counter>,
    falls: Labelled<RobotLabel, Counter>,
    jobs: Gauge,
    job_places: Gauge,
    process: Process,
}

#[derive(Debug, Clone, PartialEq, Eq, Hash, EncodeLabelSet)]
struct PhaseLabel {
    phase: &'static str,
}

#[derive(Debug, Clone, PartialEq, Eq, Hash, EncodeLabelSet)]
struct RobotLabel {
    robot: String,
}

impl Metrics {
    fn new() -> Self {
        let mut registry = Registry::default();
        let r = &mut registry;
        let build = Info::new([("version", env!("CARGO_PKG_VERSION"))]);
        r.register("emp_build", "The server's version", build);
        let metrics = Self {
            calls: family(r, "emp_calls", "Calls that ended, by method and gRPC code"),
            call_seconds: times(r, "emp_call_seconds", "Time of single calls, by method"),
            open_calls: family(
                r,
                "emp_open_calls",
                "Calls and streams that are open, by method",
            ),
            refused: family(
                r,
                "emp_calls_refused",
                "Calls that were refused before they began: no or wrong credentials, no permission, a quota",
            ),
            connections: single(r, "emp_connections", "Connections that are open"),
            refused_connections: family(
                r,
                "emp_connections_refused",
                "Connections that were closed before their first call, by reason",
            ),
            accept_errors: single(
                r,
                "emp_accept_errors",
                "Connections that the system could not give, for example for want of file descriptors",
            ),
            reloads: family(
                r,
                "emp_reloads",
                "Files that were read again: certificates, access",
            ),
            log_lines_left_out: family(
                r,
                "emp_log_lines_left_out",
                "Log lines that were not written, by reason",
            ),
            audit_lines_left_out: single(
                r,
                "emp_audit_lines_left_out",
                "Lines of the audit log that there was no room for",
            ),
            model_serving: family(
                r,
                "emp_model_serving",
                "1 while the model serves, 0 while it is rebuilt",
            ),
            queue_length: family(
                r,
                "emp_queue_length",
                "Frames and calls that wait for the model",
            ),
            queue_seconds: times(
                r,
                "emp_queue_seconds",
                "From arrival in a model's queue to the start of the batch",
            ),
            total_seconds: times(
                r,
                "emp_total_seconds",
                "From arrival in a model's queue to the answer",
            ),
            inference_seconds: times(r, "emp_inference_seconds", "What a batch took the model"),
            batch_size: histograms(r, "emp_batch_size", "Frames and calls in a batch", || {
                Histogram::new(exponential_buckets(1.0, 2.0, 9))
            }),
            dropped: family(
                r,
                "emp_dropped_frames",
                "Frames of streams that were not computed, by reason",
            ),
            sessions: single(r, "emp_sessions", "Teleoperation sessions that are open"),
            members: family(
                r,
                "emp_session_members",
                "Ends of teleoperation sessions that are there, by role",
            ),
            guard_periods: family(
                r,
                "emp_guard_periods",
                "Control periods of teleoperated robots, by what the guard did with the goal",
            ),
            falls: family(
                r,
                "emp_falls",
                "Teleoperated robots that were seen to fall, by robot",
            ),
            jobs: single(r, "emp_jobs", "Jobs that run: evaluations and rollouts"),
            job_places: single(r, "emp_job_places", "Jobs that may run at once"),
            process: Process::new(r),
            registry,
        };
        metrics.begin();
        metrics
    }

    /// Makes the series whose labels are known beforehand: a counter that first appears with its first event hides that event
    /// from `increase`.
    fn begin(&self) {
        for reason in REFUSALS {
            self.refused.get_or_create_owned(&Reason { reason });
        }
        for reason in [LeftOut::Rate, LeftOut::Full] {
            self.log_lines_left_out
                .get_or_create_owned(&LeftOutLabels { reason });
        }
        for what in ["certificates", "access", "audit"] {
            for result in ["ok", "failed"] {
                self.reloads
                    .get_or_create_owned(&ReloadLabels { what, result });
            }
        }
        for reason in (1..).map_while(|number| DropReason::try_from(number).ok()) {
            let reason = reason.as_str_name();
            self.dropped.get_or_create_owned(&Reason { reason });
        }
        for phase in (1..).map_while(|number| GoalPhase::try_from(number).ok()) {
            let phase = phase.as_str_name();
            self.guard_periods
                .get_or_create_owned(&PhaseLabel { phase });
        }
    }

    /// Every metric in the text form of `OpenMetrics`.
    pub(crate) fn text(&self) -> String {
        self.process.update();
        let mut text = String::new();
        // Writing to a string does not fail.
        let _ = text::encode(&mut text, &self.registry);
        text
    }

    pub(crate) fn call_began(&self, method: &'static str) {
        self.open_calls.get_or_create(&MethodLabel { method }).inc();
    }

    /// `seconds` for calls whose time says something about the server: single ones.
    pub(crate) fn call_ended(
        &self,
        method: &'static str,
        code: &'static str,
        time: Option<Duration>,
    ) {
        self.open_calls.get_or_create(&MethodLabel { method }).dec();
        self.calls.get_or_create(&CallLabels { method, code }).inc();
        if let Some(time) = time {
            self.call_seconds
                .get_or_create(&MethodLabel { method })
                .observe(time.as_secs_f64());
        }
    }

    pub(crate) fn call_refused(&self, reason: &'static str) {
        self.refused.get_or_create(&Reason { reason }).inc();
    }

    pub(crate) fn connection_opened(&self) {
        self.connections.inc();
    }

    pub(crate) fn connection_closed(&self) {
        self.connections.dec();
    }

    pub(crate) fn connection_refused(&self, reason: &'static str) {
        self.refused_connections
            .get_or_create(&Reason { reason })
            .inc();
    }

    pub(crate) fn accept_failed(&self) {
        self.accept_errors.inc();
    }

    pub(crate) fn reloaded(&self, what: &'static str, worked: bool) {
        let result = if worked { "ok" } else { "failed" };
        self.reloads
            .get_or_create(&ReloadLabels { what, result })
            .inc();
    }

    pub(crate) fn log_line_left_out(&self, reason: LeftOut) {
        self.log_lines_left_out
            .get_or_create(&LeftOutLabels { reason })
            .inc();
    }

    pub(crate) fn audit_line_left_out(&self) {
        self.audit_lines_left_out.inc();
    }

    /// What the thread of a model measures.
    pub(crate) fn model(&self, model: &str) -> ModelMetrics {
        let label = ModelLabel {
            model: model.to_owned(),
        };
        let work = |priority| WorkLabels {
            model: model.to_owned(),
            priority,
        };
        let times = |family: &Histograms<WorkLabels>| {
            PRIORITIES.map(|p| family.get_or_create_owned(&work(p)))
        };
        let serving = self.model_serving.get_or_create_owned(&label);
        serving.set(1);
        ModelMetrics {
            serving,
            queue_length: PRIORITIES.map(|p| self.queue_length.get_or_create_owned(&work(p))),
            queue_seconds: times(&self.queue_seconds),
            total_seconds: times(&self.total_seconds),
            inference_seconds: self.inference_seconds.get_or_create_owned(&label),
            batch_size: self.batch_size.get_or_create_owned(&label),
        }
    }

    pub(crate) fn frame_dropped(&self, reason: &'static str) {
        self.dropped.get_or_create(&Reason { reason }).inc();
    }

    pub(crate) fn session_opened(&self) {
        self.sessions.inc();
    }

    pub(crate) fn session_closed(&self) {
        self.sessions.dec();
    }

    pub(crate) fn member_joined(&self, role: &'static str) {
        self.members.get_or_create(&RoleLabel { role }).inc();
    }

    pub(crate) fn member_left(&self, role: &'static str) {
        self.members.get_or_create(&RoleLabel { role }).dec();
    }

    pub(crate) fn guard_period(&self, phase: &'static str) {
        self.guard_periods
            .get_or_create(&PhaseLabel { phase })
            .inc();
    }

    /// From now on falls of this robot are counted.
    pub(crate) fn watch_falls(&self, robot: &str) {
        let robot = robot.to_owned();
        self.falls.get_or_create_owned(&RobotLabel { robot });
    }

    pub(crate) fn fell(&self, robot: &str) {
        let robot = robot.to_owned();
        self.falls.get_or_create(&RobotLabel { robot }).inc();
    }

    pub(crate) fn job_places(&self, places: usize) {
        self.job_places
            .set(i64::try_from(places).unwrap_or(i64::MAX));
    }

    pub(crate) fn job_began(&self) {
        self.jobs.inc();
    }

    pub(crate) fn job_ended(&self) {
        self.jobs.dec();
    }
}

/// By [`Priority`].
const PRIORITIES: [&str; 2] = ["stream", "unary"];

fn index(priority: Priority) -> usize {
    match priority {
        Priority::Stream => 0,
        Priority::Unary => 1,
    }
}

/// What the thread of one model measures.
pub(crate) struct ModelMetrics {
    serving: Gauge,
    queue_length: [Gauge; 2],
    queue_seconds: [Histogram; 2],
    total_seconds: [Histogram; 2],
    inference_seconds: Histogram,
    batch_size: Histogram,
}

impl ModelMetrics {
    pub(crate) fn serving(&self, is_serving: bool) {
        self.serving.set(i64::from(is_serving));
    }

    pub(crate) fn waiting(&self, priority: Priority, count: usize) {
        let count = i64::try_from(count).unwrap_or(i64::MAX);
        self.queue_length[index(priority)].set(count);
    }

    pub(crate) fn batch(&self, size: usize, inference: Duration) {
        self.batch_size.observe(size as f64);
        self.inference_seconds.observe(inference.as_secs_f64());
    }

    pub(crate) fn answered(&self, priority: Priority, queue: Duration, total: Duration) {
        self.queue_seconds[index(priority)].observe(queue.as_secs_f64());
        self.total_seconds[index(priority)].observe(total.as_secs_f64());
    }
}

/// What the system knows of the process, under the names that Prometheus' own libraries use.
struct Process {
    memory: Gauge<f64, AtomicU64>,
    descriptors: Gauge,
    most_descriptors: Gauge,
    threads: Gauge,
    cpu: Counter<f64, AtomicU64>,
}

impl Process {
    fn new(r: &mut Registry) -> Self {
        let start: Gauge<f64, AtomicU64> = single(
            r,
            "process_start_time_seconds",
            "When the process started, seconds since 1970",
        );
        let now = SystemTime::now().duration_since(UNIX_EPOCH);
        start.set(now.unwrap_or_default().as_secs_f64());
        Self {
            memory: single(r, "process_resident_memory_bytes", "Resident memory"),
            descriptors: single(r, "process_open_fds", "Open file descriptors"),
            most_descriptors: single(r, "process_max_fds", "Most file descriptors"),
            threads: single(r, "process_threads", "Threads"),
            cpu: single(r, "process_cpu_seconds", "Processor time, user and system"),
        }
    }

    /// Reads /proc; where there is none, the numbers stay 0.
    fn update(&self) {
        let read =
            |file: &str| fs::read_to_string(format!("/proc/self/{file}")).unwrap_or_default();
        let number = |text: Option<&str>| text.and_then(|text| text.parse().ok()).unwrap_or(0.0);
        self.memory
            .set(PAGE * number(read("statm").split(' ').nth(1)));
        let descriptors = fs::read_dir("/proc/self/fd").map_or(0, Iterator::count);
        self.descriptors
            .set(i64::try_from(descriptors).unwrap_or(0));
        let limit = rustix::process::getrlimit(rustix::process::Resource::Nofile).current;
        self.most_descriptors
            .set(limit.and_then(|n| i64::try_from(n).ok()).unwrap_or(0));
        let stat = read("stat");
        // The second field is the name in parentheses, which may hold anything.
        let after_name = stat.rsplit_once(") ").map_or("", |(_, rest)| rest);
        let field = |index: usize| number(after_name.split(' ').nth(index));
        let cpu = (field(11) + field(12)) / TICKS;
        self.cpu.inc_by((cpu - self.cpu.get()).max(0.0));
        self.threads.set(field(17) as i64);
    }
}

fn single<M: Clone + Default + prometheus_client::registry::Metric>(
    registry: &mut Registry,
    name: &str,
    help: &str,
) -> M {
    let metric = M::default();
    registry.register(name, help, metric.clone());
    metric
}

fn family<L, M>(registry: &mut Registry, name: &str, help: &str) -> Family<L, M>
where
    Family<L, M>: Default + Clone + prometheus_client::registry::Metric,
{
    single(registry, name, help)
}

fn histograms<L>(
    registry: &mut Registry,
    name: &str,
    help: &str,
    make: fn() -> Histogram,
) -> Histograms<L>
where
    L: Clone + std::hash::Hash + Eq,
    Histograms<L>: prometheus_client::registry::Metric,
{
    let family = Family::new_with_constructor(make);
    registry.register(name, help, family.clone());
    family
}

/// From a tenth of a millisecond to three seconds.
fn times<L>(registry: &mut Registry, name: &str, help: &str) -> Histograms<L>
where
    L: Clone + std::hash::Hash + Eq,
    Histograms<L>: prometheus_client::registry::Metric,
{
    histograms(registry, name, help, || {
        Histogram::new(exponential_buckets(1e-4, 2.0, 16))
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_text_has_what_was_measured_and_what_the_system_says() {
        metrics()
            .model("test-model")
            .batch(3, Duration::from_millis(2));
        metrics().frame_dropped("TEST");
        let text = metrics().text();
        assert!(
            text.contains("emp_batch_size_sum{model=\"test-model\"} 3"),
            "{text}"
        );
        assert!(
            text.contains("emp_dropped_frames_total{reason=\"TEST\"} 1"),
            "{text}"
        );
        assert!(text.ends_with("# EOF\n"));
        let memory = text
            .lines()
            .find_map(|line| line.strip_prefix("process_resident_memory_bytes "))
            .and_then(|value| value.parse::<f64>().ok());
        if cfg!(target_os = "linux") {
            assert!(memory.is_some_and(|bytes| bytes > 1e5), "{text}");
        }
    }
}
