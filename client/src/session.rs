//! `emp operate` and `emp observe`: a recorded motion as the operator of a session, and an ear to what a session executes.

use std::{collections::BTreeMap, process::ExitCode, time::Duration};

use anyhow::Context as _;
use emp_client::{
    Client, EmpMode, GoalPhase, GuardReport, PoseSender, SessionEvent, SessionEvents,
    SessionPresence, TeleoperatedFrame, TeleoperationConfig,
};
use emp_motion::Clip;
use serde_json::{Value, json};
use tokio::time::{Instant, MissedTickBehavior};

use crate::{
    cli::{Observe, Operate},
    command::{self, INTERRUPTED},
};

/// Sends a motion file as a session's operator, in real time.
pub(crate) async fn operate(
    client: &Client,
    command: &Operate,
    as_json: bool,
) -> anyhow::Result<ExitCode> {
    let (clip, rate) = command::recording(
        client,
        &command.file,
        command.reading.options(),
        &command.robot,
    )
    .await?;
    let config = TeleoperationConfig {
        emp_mode: command.emp_mode.map(EmpMode::from),
        ..TeleoperationConfig::new(&command.robot, &command.session)
    };
    let client = client.clone().with_backoff(command::LIVE);
    let (sender, mut events) = client.operate(config).await?;
    say_who_is_there(&events.started().presence.unwrap_or_default());
    tokio::spawn(send(clip, sender, rate));
    let mut summary = Summary::default();
    let end = listen(&mut events, |result| summary.add(result)).await;
    if as_json {
        println!("{}", summary.json());
    } else {
        summary.print();
    }
    end
}

/// Prints what a session executes, until Ctrl-C.
pub(crate) async fn observe(
    client: &Client,
    command: &Observe,
    as_json: bool,
) -> anyhow::Result<ExitCode> {
    let config = TeleoperationConfig::new(&command.robot, &command.session);
    let mut events = client.observe(config).await?;
    say_who_is_there(&events.started().presence.unwrap_or_default());
    let joints = events.started().goal_joint_names.clone();
    if !as_json {
        println!("{HEADINGS}");
    }
    let listening = listen(&mut events, |result| {
        if as_json {
            println!("{}", json_line(result, &joints));
        } else {
            println!("{}", line(result, &joints));
        }
    });
    match command.seconds {
        None => listening.await,
        Some(seconds) => {
            let time = Duration::try_from_secs_f64(seconds).context("--seconds")?;
            match tokio::time::timeout(time, listening).await {
                Ok(end) => end,
                Err(_) => Ok(ExitCode::SUCCESS),
            }
        }
    }
}

/// Sends every pose at its time. The receiving end says why a stream ended.
async fn send(clip: Clip, mut sender: PoseSender, rate: f64) {
    let mut ticks = tokio::time::interval_at(Instant::now(), Duration::from_secs_f64(1.0 / rate));
    ticks.set_missed_tick_behavior(MissedTickBehavior::Skip);
    for pose in &clip.frames {
        ticks.tick().await;
        if sender.send(pose).await.is_err() {
            return;
        }
    }
}

/// Listens to the stream's end or to Ctrl-C.
async fn listen(
    events: &mut SessionEvents,
    mut executed: impl FnMut(&TeleoperatedFrame),
) -> anyhow::Result<ExitCode> {
    let interrupt = tokio::signal::ctrl_c();
    tokio::pin!(interrupt);
    loop {
        let event = tokio::select! {
            event = events.next() => event,
            _ = &mut interrupt => return Ok(ExitCode::from(INTERRUPTED)),
        };
        match event {
            Ok(Some(SessionEvent::Executed(result))) => executed(&result),
            Ok(Some(event)) => say(&event),
            Ok(None) => return Ok(ExitCode::SUCCESS),
            Err(error) => return Err(error.into()),
        }
    }
}

fn say(event: &SessionEvent) {
    match event {
        SessionEvent::Executed(_) => {}
        SessionEvent::Presence(presence) => say_who_is_there(presence),
        SessionEvent::Dropped(dropped) => eprintln!(
            "emp: pose {} is not used: {} {}",
            dropped.sequence_number, dropped.field, dropped.description
        ),
        SessionEvent::ConnectionLost {
            reason,
            attempt,
            retry_in,
        } => command::say_lost(reason, *attempt, *retry_in),
        SessionEvent::GoingAway { grace } => eprintln!(
            "emp: the server is being stopped; it serves on for {:.1} s",
            grace.as_secs_f64()
        ),
        SessionEvent::Reconnected => eprintln!("emp: reconnected"),
    }
}

fn say_who_is_there(presence: &SessionPresence) {
    let there = |is_there| if is_there { "there" } else { "away" };
    let robot = match presence.robot_silent {
        true => "silent",
        false => there(presence.robot),
    };
    eprintln!(
        "emp: robot {robot}, operator {}, {} observers, {}",
        there(presence.operator),
        presence.observers,
        short(presence.state().as_str_name(), "SESSION_STATE_"),
    );
}

const HEADINGS: &str = "frame     pose_ms  emp          goal                  change_rad  joint                  danger  \
                        com_m    links_m";

/// A name of an enumeration without its prefix, in lower case.
fn short(name: &str, prefix: &str) -> String {
    name.strip_prefix(prefix).unwrap_or(name).to_lowercase()
}

fn phase(result: &TeleoperatedFrame) -> GoalPhase {
    let guard = result.guard.as_ref();
    guard.map_or(GoalPhase::Unspecified, GuardReport::phase)
}

fn phase_name(result: &TeleoperatedFrame) -> String {
    short(phase(result).as_str_name(), "GOAL_PHASE_")
}

fn pose_age_ms(result: &TeleoperatedFrame) -> Option<f64> {
    let age = result.pose.as_ref()?.age?;
    Duration::try_from(age)
        .ok()
        .map(|age| age.as_secs_f64() * 1e3)
}

/// The joint whose goal was changed most, by index, and by how much, rad.
fn largest_change(result: &TeleoperatedFrame) -> Option<(usize, f32)> {
    let change = result.filter.as_ref()?.change.iter().copied().enumerate();
    change.max_by(|(_, a), (_, b)| a.abs().total_cmp(&b.abs()))
}

fn line(result: &TeleoperatedFrame, joints: &[String]) -> String {
    let number = result.header.unwrap_or_default().sequence_number;
    let age = pose_age_ms(result).map_or_else(|| "-".to_owned(), |age| format!("{age:.0}"));
    let mode = short(result.emp_mode().as_str_name(), "EMP_MODE_");
    let guard = result.guard.clone().unwrap_or_default();
    let goal = match guard.progress {
        Some(progress) => format!("{} {:.0} %", phase_name(result), 100.0 * progress),
        None => phase_name(result),
    };
    let filter = result.filter.clone().unwrap_or_default();
    let (index, change) = largest_change(result).unwrap_or_default();
    let joint = joints.get(index).map_or("", String::as_str);
    let danger = if filter.danger { "yes" } else { "no" };
    let links = filter
        .smallest_link_distance
        .map_or_else(|| "-".to_owned(), |distance| format!("{distance:.3}"));
    format!(
        "{number:<8}  {age:>7}  {mode:<11}  {goal:<20}  {change:>10.3}  {joint:<21}  {danger:<6}  {:>7.3}  {links:>7}",
        filter.center_of_mass_margin
    )
}

fn json_line(result: &TeleoperatedFrame, joints: &[String]) -> Value {
    let filter = result.filter.clone().unwrap_or_default();
    let guard = result.guard.clone().unwrap_or_default();
    let reasons = filter
        .reasons()
        .map(|reason| short(reason.as_str_name(), "CHANGE_REASON_"));
    let limited = guard.speed_limited_joints.iter();
    let limited = limited.filter_map(|&joint| joints.get(joint as usize));
    json!({
        "number": result.number,
        "state": short(result.state().as_str_name(), "SESSION_STATE_"),
        "frame": result.header.unwrap_or_default().sequence_number,
        "pose": result.pose.as_ref().map(|pose| pose.header.unwrap_or_default().sequence_number),
        "pose_age_ms": pose_age_ms(result),
        "emp_mode": short(result.emp_mode().as_str_name(), "EMP_MODE_"),
        "phase": phase_name(result),
        "progress": guard.progress,
        "emp_progress": guard.emp_progress,
        "speed_limited_joints": limited.collect::<Vec<_>>(),
        "state_frozen": guard.state_frozen,
        "robot_frames_lost": result.robot_frames_lost,
        "operator_frames_lost": result.operator_frames_lost,
        "goal": result.goal,
        "executable_goal": filter.executable_goal,
        "regloss": filter.regloss,
        "danger": filter.danger,
        "center_of_mass_margin": filter.center_of_mass_margin,
        "smallest_link_distance": filter.smallest_link_distance,
        "reasons": reasons.collect::<Vec<_>>(),
        "leg_targets": result.leg_targets,
        "missed": result.missed,
    })
}

/// What a session executed while its operator was there.
#[derive(Default)]
struct Summary {
    executed: u64,
    missed: u64,
    phases: BTreeMap<String, u64>,
    danger: u64,
    /// Largest change of a joint's goal, rad.
    change: f32,
    /// Smallest margin of the centre of mass, m.
    margin: Option<f32>,
}

impl Summary {
    fn add(&mut self, result: &TeleoperatedFrame) {
        self.executed += 1;
        self.missed += result.missed;
        *self.phases.entry(phase_name(result)).or_default() += 1;
        let (_, change) = largest_change(result).unwrap_or_default();
        self.change = self.change.max(change.abs());
        if let Some(filter) = &result.filter {
            self.danger += u64::from(filter.danger);
            let margin = filter.center_of_mass_margin;
            self.margin = Some(self.margin.map_or(margin, |least| least.min(margin)));
        }
    }

    fn json(&self) -> Value {
        json!({
            "executed": self.executed,
            "missed": self.missed,
            "phases": self.phases,
            "danger": self.danger,
            "largest_change": self.change,
            "smallest_margin": self.margin,
        })
    }

    fn print(&self) {
        println!("{} control periods executed", self.executed);
        for (phase, count) in &self.phases {
            println!("  {phase:<10} {count}");
        }
        println!("  danger     {}", self.danger);
        println!("  largest change of a goal {:.3} rad", self.change);
        if let Some(margin) = self.margin {
            println!("  smallest margin of the centre of mass {margin:.3} m");
        }
    }
}
