//! Sessions by name: who is in them, what its robot is to do, the newest goal, and what everybody is told.

use std::{
    collections::{BTreeMap, btree_map::Entry},
    sync::{Arc, Mutex, MutexGuard, PoisonError},
    time::{Duration, Instant},
};

use emp_models::guard::Wish;
use emp_proto::v1::{
    ControlCommand, ControlRequest, ControlResponse, DroppedFrame, FrameHeader, Session,
    SessionPresence, SessionState, TeleoperatedFrame, Timing,
};
use rand::RngExt as _;
use tokio::sync::broadcast;
use tokio_util::sync::CancellationToken;

use crate::{
    decode::fields,
    encode,
    error::{FieldError, ServiceError},
    inference::controllers::EmpMode,
};

/// Which end of a session a stream holds.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Role {
    Both,
    Operator,
    Robot,
    Observer,
}

impl Role {
    pub(super) fn has_robot(self) -> bool {
        matches!(self, Self::Both | Self::Robot)
    }

    pub(super) fn has_person(self) -> bool {
        matches!(self, Self::Both | Self::Operator)
    }
}

/// A robot that sends nothing for this long is silent: another may take its seat.
pub(super) const ROBOT_SILENCE: Duration = Duration::from_millis(500);
/// The same for an operator.
const OPERATOR_SILENCE: Duration = Duration::from_secs(2);
/// How long a controller's lease stands without another call.
const LEASE: Duration = Duration::from_secs(10);
/// Share of the joints' speed that the greatest caution leaves.
const CAUTIOUS_SPEED: f32 = 0.25;

/// Every open session that has a name.
pub(crate) struct Sessions {
    open: Mutex<BTreeMap<String, Open>>,
    /// Messages that wait for a slow listener before it misses some.
    buffer: usize,
}

struct Open {
    hub: Arc<SessionHub>,
    members: usize,
}

/// What a new session starts with.
#[derive(Debug, Clone, Copy)]
pub(super) struct Start {
    pub(super) emp_mode: EmpMode,
    pub(super) stopped: bool,
}

/// What the members of a session share.
pub(super) struct SessionHub {
    name: String,
    robot: String,
    since: Instant,
    shared: Mutex<Shared>,
    told: broadcast::Sender<SessionEvent>,
    /// Cancelled when the session is ended.
    ended: CancellationToken,
}

struct Shared {
    robot: Option<Seat>,
    operator: Option<Seat>,
    observers: u32,
    robot_silent: bool,
    state: SessionState,
    /// The operator has let go.
    clutch: bool,
    emp_mode: EmpMode,
    caution: f32,
    goal: Option<Arc<Goal>>,
    /// Why the operator's last pose did not become a goal, until the robot has heard of it.
    no_goal: Option<DroppedFrame>,
    /// Members so far, to tell seats apart, and operators so far.
    members: u64,
    operators: u64,
    /// Control periods so far, and lost frames.
    periods: u64,
    robot_lost: u64,
    operator_lost: u64,
    lease: Option<Lease>,
}

/// The robot's or the operator's place.
struct Seat {
    member: u64,
    operator: u64,
    token: String,
    /// When its holder was heard last.
    heard: Instant,
    /// Cancelled when another takes it over.
    evicted: CancellationToken,
}

struct Lease {
    token: String,
    until: Instant,
}

/// What everybody in a session is told.
#[derive(Debug, Clone)]
pub(super) enum SessionEvent {
    Result(Arc<TeleoperatedFrame>),
    Presence(SessionPresence),
}

/// A pose that was retargeted.
#[derive(Debug)]
pub(super) struct Goal {
    /// The operator that it comes from, counted from 1.
    pub(super) operator: u64,
    pub(super) header: Option<FrameHeader>,
    /// When the pose arrived; of poses that are the same, the first.
    pub(super) arrived: Instant,
    /// Angles of the goal joints, rad.
    pub(super) angles: Vec<f32>,
    pub(super) direction_error: f32,
    pub(super) timing: Timing,
    /// Whether it is to be smoothed over control periods.
    pub(super) smoothing: bool,
}

/// What a robot is told at the start of a control period.
pub(super) struct Orders {
    pub(super) wish: Wish,
    pub(super) state: SessionState,
    pub(super) emp_mode: EmpMode,
    /// Share of the joints' speed that may be used.
    pub(super) speed: f32,
    pub(super) goal: Option<Arc<Goal>>,
    pub(super) no_goal: Option<DroppedFrame>,
}

/// A place in a session, given back when dropped.
pub(super) struct Member {
    /// None for a session without a name.
    sessions: Option<Arc<Sessions>>,
    hub: Arc<SessionHub>,
    role: Role,
    number: u64,
    /// This member's number as an operator.
    operator: u64,
    token: String,
    evicted: CancellationToken,
}

/// A secret that nobody guesses.
fn token() -> String {
    let bytes: [u8; 16] = rand::rng().random();
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}

impl Sessions {
    pub(crate) fn new(buffer: usize) -> Self {
        Self {
            open: Mutex::new(BTreeMap::new()),
            buffer,
        }
    }

    /// Joins a session, which is opened with `start` if there is none. `resume` is the token of a seat to take over.
    pub(super) fn join(
        self: &Arc<Self>,
        name: &str,
        role: Role,
        robot: &str,
        resume: &str,
        start: Start,
    ) -> Result<Member, ServiceError> {
        if name.is_empty() {
            let hub = Arc::new(SessionHub::new(name, robot, start, self.buffer));
            return hub.take_seat(role, resume, None);
        }
        let mut open = lock(&self.open);
        let sessions = Some(Arc::clone(self));
        match open.entry(name.to_owned()) {
            Entry::Occupied(mut entry) => {
                let hub = &entry.get().hub;
                if robot != hub.robot {
                    let own = &hub.robot;
                    let description = format!("{robot:?}; session {name:?} is about robot {own:?}");
                    return Err(FieldError::new("config.robot", description).into());
                }
                let member = Arc::clone(hub).take_seat(role, resume, sessions)?;
                entry.get_mut().members += 1;
                Ok(member)
            }
            Entry::Vacant(entry) => {
                let hub = Arc::new(SessionHub::new(name, robot, start, self.buffer));
                let member = Arc::clone(&hub).take_seat(role, resume, sessions)?;
                entry.insert(Open { hub, members: 1 });
                Ok(member)
            }
        }
    }

    /// The robot of an open session.
    pub(crate) fn robot_of(&self, name: &str) -> Option<String> {
        let open = lock(&self.open);
        open.get(name).map(|open| open.hub.robot.clone())
    }

    /// The open sessions of a robot, or all.
    pub(crate) fn list(&self, robot: &str) -> Vec<Session> {
        let open = lock(&self.open);
        let hubs = open.values().map(|open| &open.hub);
        hubs.filter(|hub| robot.is_empty() || hub.robot == robot)
            .map(|hub| hub.describe())
            .collect()
    }

    pub(crate) fn get(&self, name: &str) -> Result<Session, ServiceError> {
        Ok(self.hub(name)?.describe())
    }

    /// Ends a session: everybody's stream ends.
    pub(crate) fn end(&self, name: &str) -> Result<(), ServiceError> {
        self.hub(name)?.ended.cancel();
        Ok(())
    }

    /// Does what a controller commands.
    pub(crate) fn control(
        &self,
        request: &ControlRequest,
        emp_mode: impl FnOnce(&str) -> Result<Option<EmpMode>, ServiceError>,
    ) -> Result<ControlResponse, ServiceError> {
        let hub = self.hub(&request.session)?;
        let emp_mode = emp_mode(&hub.robot)?;
        hub.control(request, emp_mode)
    }

    fn hub(&self, name: &str) -> Result<Arc<SessionHub>, ServiceError> {
        let open = lock(&self.open);
        let found = open.get(name).map(|open| Arc::clone(&open.hub));
        found.ok_or_else(|| ServiceError::NotFound {
            what: "session",
            name: crate::error::shortened(name.to_owned()),
            // Who may not see them is not told of them.
            served: format!("{} sessions", open.len()),
        })
    }
}

impl SessionHub {
    fn new(name: &str, robot: &str, start: Start, buffer: usize) -> Self {
        let state = if start.stopped {
            SessionState::Stopped
        } else {
            SessionState::Active
        };
        Self {
            name: name.to_owned(),
            robot: robot.to_owned(),
            since: Instant::now(),
            shared: Mutex::new(Shared {
                robot: None,
                operator: None,
                observers: 0,
                robot_silent: false,
                state,
                clutch: false,
                emp_mode: start.emp_mode,
                caution: 0.0,
                goal: None,
                no_goal: None,
                members: 0,
                operators: 0,
                periods: 0,
                robot_lost: 0,
                operator_lost: 0,
                lease: None,
            }),
            told: broadcast::Sender::new(buffer),
            ended: CancellationToken::new(),
        }
    }

    fn take_seat(
        self: Arc<Self>,
        role: Role,
        resume: &str,
        sessions: Option<Arc<Sessions>>,
    ) -> Result<Member, ServiceError> {
        let mut shared = lock(&self.shared);
        let now = Instant::now();
        let shared_ref = &mut *shared;
        let seats = [
            ("robot", role.has_robot(), &shared_ref.robot, ROBOT_SILENCE),
            (
                "operator",
                role.has_person(),
                &shared_ref.operator,
                OPERATOR_SILENCE,
            ),
        ];
        let mut resumed = None;
        for (name, is_wanted, seat, silence) in seats {
            let Some(seat) = seat.as_ref().filter(|_| is_wanted) else {
                continue;
            };
            if !resume.is_empty() && seat.token == resume {
                resumed = Some(seat.operator);
            } else if now.saturating_duration_since(seat.heard) < silence {
                return Err(ServiceError::SeatTaken {
                    session: self.name.clone(),
                    seat: name,
                });
            }
        }
        let token = match role {
            Role::Observer => String::new(),
            _ => token(),
        };
        shared_ref.members += 1;
        // Whoever resumes is the same person.
        let operator = match resumed {
            Some(operator) if operator > 0 => operator,
            _ => {
                shared_ref.operators += u64::from(role.has_person());
                shared_ref.operators
            }
        };
        let evicted = CancellationToken::new();
        let seat = || Seat {
            member: shared_ref.members,
            operator: if role.has_person() { operator } else { 0 },
            token: token.clone(),
            heard: now,
            evicted: evicted.clone(),
        };
        let (robot, person) = (role.has_robot().then(seat), role.has_person().then(seat));
        if let Some(before) = robot.and_then(|seat| shared_ref.robot.replace(seat)) {
            before.evicted.cancel();
        }
        if let Some(before) = person.and_then(|seat| shared_ref.operator.replace(seat)) {
            before.evicted.cancel();
        }
        match role {
            Role::Observer => shared_ref.observers += 1,
            Role::Operator | Role::Both => shared_ref.clutch = false,
            Role::Robot => {}
        }
        if role.has_robot() {
            shared_ref.robot_silent = false;
        }
        let number = shared_ref.members;
        self.tell_presence(shared_ref);
        drop(shared);
        Ok(Member {
            sessions,
            hub: self,
            role,
            number,
            operator,
            token,
            evicted,
        })
    }

    fn control(
        &self,
        request: &ControlRequest,
        emp_mode: Option<EmpMode>,
    ) -> Result<ControlResponse, ServiceError> {
        let command = ControlCommand::try_from(request.command)
            .map_err(|_| FieldError::not_in("ControlCommand", "command", request.command))?;
        let caution = request.caution;
        if let Some(caution) = caution {
            fields::within("caution", caution, 0.0..=1.0)?;
        }
        let mut shared = lock(&self.shared);
        let now = Instant::now();
        let standing = shared.lease.take().filter(|lease| lease.until > now);
        let lease = match standing {
            Some(lease) if lease.token == request.lease => Ok(lease.token),
            Some(lease) => {
                let left = lease.until - now;
                shared.lease = Some(lease);
                Err(left)
            }
            None => Ok(token()),
        };
        // Anyone may stop a robot.
        if command == ControlCommand::Stop {
            shared.state = SessionState::Stopped;
        }
        let mut response = ControlResponse::default();
        match lease {
            Ok(token) => {
                shared.command(command, emp_mode, caution);
                if !request.release {
                    response.lease.clone_from(&token);
                    response.lease_time = Some(encode::duration(LEASE));
                    let until = now + LEASE;
                    shared.lease = Some(Lease { token, until });
                }
            }
            Err(_) if command == ControlCommand::Stop => {}
            Err(left) => {
                let session = self.name.clone();
                return Err(ServiceError::LeaseTaken { session, left });
            }
        }
        self.tell_presence(&shared);
        drop(shared);
        response.session = Some(self.describe());
        Ok(response)
    }

    fn describe(&self) -> Session {
        let shared = lock(&self.shared);
        let now = Instant::now();
        Session {
            name: self.name.clone(),
            robot: self.robot.clone(),
            presence: Some(shared.presence()),
            emp_mode: encode::emp_mode(shared.emp_mode).into(),
            caution: shared.caution,
            controlled: shared.lease.as_ref().is_some_and(|lease| lease.until > now),
            periods: shared.periods,
            open_time: Some(encode::duration(self.since.elapsed())),
        }
    }

    fn tell_presence(&self, shared: &Shared) {
        self.tell(SessionEvent::Presence(shared.presence()));
    }

    fn tell(&self, event: SessionEvent) {
        // Nobody may be listening.
        let _ = self.told.send(event);
    }
}

impl Shared {
    fn presence(&self) -> SessionPresence {
        SessionPresence {
            robot: self.robot.is_some(),
            operator: self.operator.is_some(),
            observers: self.observers,
            robot_silent: self.robot_silent,
            state: self.state.into(),
        }
    }

    fn command(
        &mut self,
        command: ControlCommand,
        emp_mode: Option<EmpMode>,
        caution: Option<f32>,
    ) {
        use SessionState::{Active, Paused, Stopped};
        self.state = match (command, self.state) {
            (ControlCommand::Arm, Stopped) | (ControlCommand::Resume, Paused) => Active,
            (ControlCommand::Pause, Active) => Paused,
            (ControlCommand::Stop, _) => Stopped,
            (_, state) => state,
        };
        self.emp_mode = emp_mode.unwrap_or(self.emp_mode);
        self.caution = caution.unwrap_or(self.caution);
    }
}

impl Member {
    pub(super) fn session(&self) -> &str {
        &self.hub.name
    }

    pub(super) fn role(&self) -> Role {
        self.role
    }

    /// With it a later stream takes this one's seat over.
    pub(super) fn resume_token(&self) -> &str {
        match self.sessions {
            Some(_) => &self.token,
            None => "",
        }
    }

    pub(super) fn presence(&self) -> SessionPresence {
        lock(&self.hub.shared).presence()
    }

    pub(super) fn emp_mode(&self) -> EmpMode {
        lock(&self.hub.shared).emp_mode
    }

    pub(super) fn set_emp_mode(&self, mode: EmpMode) {
        lock(&self.hub.shared).emp_mode = mode;
    }

    /// Control periods so far.
    pub(super) fn periods(&self) -> u64 {
        lock(&self.hub.shared).periods
    }

    /// Resolves when the member has to leave, with the reason.
    pub(super) async fn dismissed(&self) -> ServiceError {
        tokio::select! {
            () = self.evicted.cancelled() => {
                ServiceError::Replaced("another stream took this one's seat over")
            }
            () = self.hub.ended.cancelled() => ServiceError::Replaced("the session was ended"),
        }
    }

    /// A frame of this member came; `lost` frames before it did not.
    pub(super) fn heard(&self, lost: u64) {
        let mut shared = lock(&self.hub.shared);
        let shared = &mut *shared;
        let now = Instant::now();
        let seats = [
            (&mut shared.robot, &mut shared.robot_lost),
            (&mut shared.operator, &mut shared.operator_lost),
        ];
        for (seat, all_lost) in seats {
            if let Some(seat) = seat.as_mut().filter(|seat| seat.member == self.number) {
                seat.heard = now;
                *all_lost += lost;
            }
        }
        if self.role.has_robot() && std::mem::take(&mut shared.robot_silent) {
            self.hub.tell_presence(shared);
        }
    }

    /// The robot has sent nothing for a while.
    pub(super) fn is_silent(&self) {
        let mut shared = lock(&self.hub.shared);
        let is_mine = |seat: &Seat| seat.member == self.number;
        if shared.robot.as_ref().is_some_and(is_mine) && !shared.robot_silent {
            shared.robot_silent = true;
            self.hub.tell_presence(&shared);
        }
    }

    /// The operator has let go, or takes hold again.
    pub(super) fn set_clutch(&self, clutch: bool) {
        lock(&self.hub.shared).clutch = clutch;
    }

    /// The operator stops the session.
    pub(super) fn stop(&self) {
        let mut shared = lock(&self.hub.shared);
        if shared.state != SessionState::Stopped {
            shared.state = SessionState::Stopped;
            self.hub.tell_presence(&shared);
        }
    }

    pub(super) fn operator(&self) -> u64 {
        self.operator
    }

    /// Puts a goal in the place of the newest one, unless its operator has been replaced.
    pub(super) fn set_goal(&self, goal: Goal) {
        let mut shared = lock(&self.hub.shared);
        let is_mine = |seat: &Seat| seat.member == self.number;
        if shared.operator.as_ref().is_some_and(is_mine) {
            shared.goal = Some(Arc::new(goal));
        }
    }

    /// Says why a pose did not become a goal.
    pub(super) fn set_no_goal(&self, notice: DroppedFrame) {
        lock(&self.hub.shared).no_goal = Some(notice);
    }

    /// What the robot is to do in the control period that begins.
    pub(super) fn orders(&self) -> Orders {
        let mut shared = lock(&self.hub.shared);
        Orders {
            wish: match shared.state {
                SessionState::Stopped => Wish::Rest,
                SessionState::Active if !shared.clutch => Wish::Follow,
                _ => Wish::Hold,
            },
            state: shared.state,
            emp_mode: shared.emp_mode,
            speed: 1.0 - (1.0 - CAUTIOUS_SPEED) * shared.caution,
            goal: shared.goal.clone(),
            no_goal: shared.no_goal.take(),
        }
    }

    /// Everything that is told from now on.
    pub(super) fn listen(&self) -> broadcast::Receiver<SessionEvent> {
        self.hub.told.subscribe()
    }

    /// Numbers what the robot executes, and tells the others.
    pub(super) fn tell(&self, result: &mut TeleoperatedFrame) {
        let mut shared = lock(&self.hub.shared);
        result.number = shared.periods;
        result.robot_frames_lost = shared.robot_lost;
        result.operator_frames_lost = shared.operator_lost;
        shared.periods += 1;
        if self.hub.told.receiver_count() > 0 {
            self.hub
                .tell(SessionEvent::Result(Arc::new(result.clone())));
        }
    }
}

impl Drop for Member {
    fn drop(&mut self) {
        // The map's lock first, as when joining: nobody joins a session that is being closed.
        let mut open = self.sessions.as_ref().map(|sessions| lock(&sessions.open));
        let mut shared = lock(&self.hub.shared);
        let shared = &mut *shared;
        // A seat that was taken over is another's.
        for seat in [&mut shared.robot, &mut shared.operator] {
            seat.take_if(|seat| seat.member == self.number);
        }
        if self.role == Role::Observer {
            shared.observers = shared.observers.saturating_sub(1);
        }
        shared.robot_silent &= shared.robot.is_some();
        self.hub.tell_presence(shared);
        if let Some(open) = &mut open
            && let Entry::Occupied(mut entry) = open.entry(self.hub.name.clone())
            && Arc::ptr_eq(&entry.get().hub, &self.hub)
        {
            entry.get_mut().members -= 1;
            if entry.get().members == 0 {
                entry.remove();
            }
        }
    }
}

/// No code that can panic runs under these locks, so a poisoned one still holds sound data.
fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

#[cfg(test)]
mod tests {
    use super::*;

    const START: Start = Start {
        emp_mode: EmpMode::Off,
        stopped: false,
    };

    fn join(
        sessions: &Arc<Sessions>,
        name: &str,
        role: Role,
        robot: &str,
    ) -> Result<Member, ServiceError> {
        sessions.join(name, role, robot, "", START)
    }

    fn sessions() -> Arc<Sessions> {
        Arc::new(Sessions::new(4))
    }

    fn taken(outcome: Result<Member, ServiceError>) -> &'static str {
        match outcome {
            Err(ServiceError::SeatTaken { seat, .. }) => seat,
            Err(error) => panic!("{error}"),
            Ok(_) => panic!("joined"),
        }
    }

    #[test]
    fn a_session_has_one_robot_and_one_operator() {
        let sessions = sessions();
        let robot = join(&sessions, "a", Role::Robot, "emp27").expect("a free seat");
        let operator = join(&sessions, "a", Role::Operator, "emp27").expect("a free seat");
        assert_eq!(taken(join(&sessions, "a", Role::Robot, "emp27")), "robot");
        assert_eq!(
            taken(join(&sessions, "a", Role::Operator, "emp27")),
            "operator"
        );
        drop(operator);
        assert_eq!(taken(join(&sessions, "a", Role::Both, "emp27")), "robot");
        let _again = join(&sessions, "a", Role::Operator, "emp27").expect("the seat is free again");
        let _other = join(&sessions, "b", Role::Both, "emp27").expect("another session");
        let presence = robot.presence();
        assert!(presence.robot && presence.operator);
    }

    #[tokio::test]
    async fn a_seat_is_taken_over_with_its_token_and_by_anyone_once_its_holder_is_silent() {
        let sessions = sessions();
        let robot = join(&sessions, "a", Role::Robot, "emp27").expect("a free seat");
        let guessed = sessions.join("a", Role::Robot, "emp27", "guessed", START);
        assert_eq!(taken(guessed), "robot");
        let token = robot.resume_token().to_owned();
        let resumed = sessions.join("a", Role::Robot, "emp27", &token, START);
        let resumed = resumed.expect("its own seat");
        let error = robot.dismissed().await;
        assert!(matches!(error, ServiceError::Replaced(_)), "{error}");
        drop(robot);
        assert!(resumed.presence().robot, "the seat is not given back");
        assert_eq!(taken(join(&sessions, "a", Role::Robot, "emp27")), "robot");
        tokio::time::sleep(ROBOT_SILENCE).await;
        let _another = join(&sessions, "a", Role::Robot, "emp27").expect("a silent robot's seat");
        resumed.dismissed().await;
    }

    #[test]
    fn everyone_names_the_same_robot() {
        let sessions = sessions();
        let _robot = join(&sessions, "a", Role::Robot, "emp27").expect("a free seat");
        let error = join(&sessions, "a", Role::Observer, "g1").err();
        assert!(
            matches!(&error, Some(ServiceError::InvalidField(error)) if error.field == "config.robot"),
            "{error:?}"
        );
    }

    #[test]
    fn sessions_without_a_name_are_not_shared() {
        let sessions = sessions();
        let _one = join(&sessions, "", Role::Both, "emp27").expect("a session");
        let _other = join(&sessions, "", Role::Both, "emp27").expect("another session");
        assert!(lock(&sessions.open).is_empty());
    }

    #[test]
    fn a_session_ends_with_its_last_member() {
        let sessions = sessions();
        let robot = join(&sessions, "a", Role::Robot, "emp27").expect("a free seat");
        robot.set_emp_mode(EmpMode::On);
        let observer = join(&sessions, "a", Role::Observer, "emp27").expect("room");
        drop(robot);
        assert_eq!(observer.emp_mode(), EmpMode::On);
        drop(observer);
        assert!(lock(&sessions.open).is_empty());
        let new = join(&sessions, "a", Role::Operator, "emp27").expect("a free seat");
        assert_eq!(new.emp_mode(), EmpMode::Off);
    }

    #[test]
    fn one_controller_commands_a_session_and_anyone_may_stop_it() {
        let sessions = sessions();
        let robot = join(&sessions, "a", Role::Robot, "emp27").expect("a free seat");
        let command = |lease: &str, command: ControlCommand| {
            let request = ControlRequest {
                session: "a".to_owned(),
                lease: lease.to_owned(),
                command: command.into(),
                ..ControlRequest::default()
            };
            sessions.control(&request, |_| Ok(None))
        };
        let state = || robot.orders().state;
        let lease = command("", ControlCommand::Pause).expect("a lease").lease;
        assert_eq!(state(), SessionState::Paused);
        assert_eq!(robot.orders().wish, Wish::Hold);
        let refused = command("", ControlCommand::Resume);
        assert!(matches!(refused, Err(ServiceError::LeaseTaken { .. })));
        assert_eq!(state(), SessionState::Paused);
        let stopped = command("", ControlCommand::Stop).expect("anyone may");
        assert_eq!(
            (stopped.lease.as_str(), state()),
            ("", SessionState::Stopped)
        );
        command(&lease, ControlCommand::Resume).expect("its lease");
        assert_eq!(state(), SessionState::Stopped, "only arming starts again");
        command(&lease, ControlCommand::Arm).expect("its lease");
        assert_eq!(state(), SessionState::Active);
        let release = ControlRequest {
            session: "a".to_owned(),
            lease,
            caution: Some(1.0),
            release: true,
            ..ControlRequest::default()
        };
        sessions.control(&release, |_| Ok(None)).expect("its lease");
        assert_eq!(robot.orders().speed, CAUTIOUS_SPEED);
        command("", ControlCommand::Pause).expect("the lease is free");
    }

    #[test]
    fn listeners_are_told_who_comes_and_goes() {
        let sessions = sessions();
        let observer = join(&sessions, "a", Role::Observer, "emp27").expect("room");
        let mut told = observer.listen();
        let robot = join(&sessions, "a", Role::Robot, "emp27").expect("a free seat");
        drop(robot);
        let mut presence = || match told.try_recv() {
            Ok(SessionEvent::Presence(presence)) => presence,
            other => panic!("{other:?}"),
        };
        assert!(presence().robot);
        let last = presence();
        assert_eq!(
            (last.robot, last.operator, last.observers),
            (false, false, 1)
        );
    }
}
