//! Sessions by name: who is in them, the person's newest pose, and what everybody is told.

use std::{
    collections::{HashMap, hash_map::Entry},
    sync::{Arc, Mutex, MutexGuard, PoisonError},
    time::Instant,
};

use emp_motion::KeyNodeFrame;
use emp_proto::v1::{FrameHeader, TeleoperatedFrame, TeleoperationPresence};
use tokio::sync::broadcast;

use super::Role;
use crate::{
    catalog::RetargetModel,
    control::EmpMode,
    error::{FieldError, ServiceError},
    metrics::metrics,
};

/// Every open session that has a name.
pub(crate) struct Sessions {
    open: Mutex<HashMap<String, Open>>,
    /// Messages that wait for a slow listener before it misses some.
    buffer: usize,
}

struct Open {
    hub: Arc<Hub>,
    members: usize,
}

/// What the members of a session share.
pub(super) struct Hub {
    name: String,
    robot: String,
    shared: Mutex<Shared>,
    told: broadcast::Sender<Told>,
}

struct Shared {
    presence: TeleoperationPresence,
    emp_mode: EmpMode,
    pose: Option<Arc<NewestPose>>,
    /// Operators so far.
    operators: u64,
}

/// What everybody in a session is told.
#[derive(Debug, Clone)]
pub(super) enum Told {
    Result(Arc<TeleoperatedFrame>),
    Presence(TeleoperationPresence),
}

/// A pose of the session's person.
pub(super) struct NewestPose {
    /// The operator that it comes from, counted from 1.
    pub(super) operator: u64,
    pub(super) header: Option<FrameHeader>,
    pub(super) frame: KeyNodeFrame,
    pub(super) arrived: Instant,
    pub(super) deadline: Option<Instant>,
    pub(super) retargeting: Arc<Retargeting>,
}

/// How an operator's poses become goals.
pub(super) struct Retargeting {
    pub(super) model: Arc<RetargetModel>,
    pub(super) refine: bool,
    pub(super) smoothing: bool,
}

/// A place in a session, given back when dropped.
pub(super) struct Member {
    /// None for a session without a name.
    sessions: Option<Arc<Sessions>>,
    hub: Arc<Hub>,
    role: Role,
    /// This member's number as an operator.
    operator: u64,
}

impl Sessions {
    pub(crate) fn new(buffer: usize) -> Self {
        Self {
            open: Mutex::new(HashMap::new()),
            buffer,
        }
    }

    /// Joins a session, which is opened if there is none; `emp_mode` is what a new one has.
    pub(super) fn join(
        self: &Arc<Self>,
        name: &str,
        role: Role,
        robot: &str,
        emp_mode: EmpMode,
    ) -> Result<Member, ServiceError> {
        if name.is_empty() {
            let hub = Arc::new(Hub::new(name, robot, emp_mode, self.buffer));
            return hub.take_seat(role, None);
        }
        let mut open = lock(&self.open);
        match open.entry(name.to_owned()) {
            Entry::Occupied(mut entry) => {
                let member = entry.get().hub.join(role, robot, Some(Arc::clone(self)))?;
                entry.get_mut().members += 1;
                Ok(member)
            }
            Entry::Vacant(entry) => {
                let hub = Arc::new(Hub::new(name, robot, emp_mode, self.buffer));
                let member = hub.take_seat(role, Some(Arc::clone(self)))?;
                metrics().session_opened();
                entry.insert(Open { hub, members: 1 });
                Ok(member)
            }
        }
    }
}

impl Hub {
    fn new(name: &str, robot: &str, emp_mode: EmpMode, buffer: usize) -> Self {
        Self {
            name: name.to_owned(),
            robot: robot.to_owned(),
            shared: Mutex::new(Shared {
                presence: TeleoperationPresence::default(),
                emp_mode,
                pose: None,
                operators: 0,
            }),
            told: broadcast::Sender::new(buffer),
        }
    }

    fn join(
        self: &Arc<Self>,
        role: Role,
        robot: &str,
        sessions: Option<Arc<Sessions>>,
    ) -> Result<Member, ServiceError> {
        if robot != self.robot {
            let (name, own) = (&self.name, &self.robot);
            let description = format!("{robot:?}; session {name:?} is about robot {own:?}");
            return Err(FieldError::new("config.robot", description).into());
        }
        self.take_seat(role, sessions)
    }

    fn take_seat(
        self: &Arc<Self>,
        role: Role,
        sessions: Option<Arc<Sessions>>,
    ) -> Result<Member, ServiceError> {
        let mut shared = lock(&self.shared);
        let presence = shared.presence;
        let taken = |seat| ServiceError::SeatTaken {
            session: self.name.clone(),
            seat,
        };
        if role.has_robot() && presence.robot {
            return Err(taken("robot"));
        }
        if role.has_person() && presence.operator {
            return Err(taken("operator"));
        }
        if role.has_person() {
            shared.operators += 1;
        }
        let operator = shared.operators;
        self.change_presence(&mut shared, role, true);
        drop(shared);
        Ok(Member {
            sessions,
            hub: Arc::clone(self),
            role,
            operator,
        })
    }

    fn change_presence(&self, shared: &mut Shared, role: Role, is_there: bool) {
        if is_there {
            metrics().member_joined(role.name());
        } else {
            metrics().member_left(role.name());
        }
        let presence = &mut shared.presence;
        if role.has_robot() {
            presence.robot = is_there;
        }
        if role.has_person() {
            presence.operator = is_there;
        }
        if role == Role::Observer {
            presence.observers = if is_there {
                presence.observers.saturating_add(1)
            } else {
                presence.observers.saturating_sub(1)
            };
        }
        self.tell(Told::Presence(shared.presence));
    }

    fn tell(&self, told: Told) {
        // Nobody may be listening.
        let _ = self.told.send(told);
    }
}

impl Member {
    pub(super) fn session(&self) -> &str {
        &self.hub.name
    }

    pub(super) fn role(&self) -> Role {
        self.role
    }

    pub(super) fn presence(&self) -> TeleoperationPresence {
        lock(&self.hub.shared).presence
    }

    pub(super) fn emp_mode(&self) -> EmpMode {
        lock(&self.hub.shared).emp_mode
    }

    pub(super) fn set_emp_mode(&self, mode: EmpMode) {
        lock(&self.hub.shared).emp_mode = mode;
    }

    pub(super) fn newest_pose(&self) -> Option<Arc<NewestPose>> {
        lock(&self.hub.shared).pose.clone()
    }

    /// Puts a pose in the place of the newest one.
    pub(super) fn set_pose(
        &self,
        header: Option<FrameHeader>,
        frame: KeyNodeFrame,
        arrived: Instant,
        deadline: Option<Instant>,
        retargeting: &Arc<Retargeting>,
    ) {
        lock(&self.hub.shared).pose = Some(Arc::new(NewestPose {
            operator: self.operator,
            header,
            frame,
            arrived,
            deadline,
            retargeting: Arc::clone(retargeting),
        }));
    }

    /// Everything that is told from now on.
    pub(super) fn listen(&self) -> broadcast::Receiver<Told> {
        self.hub.told.subscribe()
    }

    /// Tells the others what the robot executes.
    pub(super) fn tell(&self, result: &TeleoperatedFrame) {
        if self.hub.told.receiver_count() > 0 {
            self.hub.tell(Told::Result(Arc::new(result.clone())));
        }
    }
}

impl Drop for Member {
    fn drop(&mut self) {
        // The map's lock first, as when joining: nobody joins a session that is being closed.
        let mut open = self.sessions.as_ref().map(|sessions| lock(&sessions.open));
        let mut shared = lock(&self.hub.shared);
        self.hub.change_presence(&mut shared, self.role, false);
        drop(shared);
        if let Some(open) = &mut open
            && let Entry::Occupied(mut entry) = open.entry(self.hub.name.clone())
        {
            entry.get_mut().members -= 1;
            if entry.get().members == 0 {
                entry.remove();
                metrics().session_closed();
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

    fn join(
        sessions: &Arc<Sessions>,
        name: &str,
        role: Role,
        robot: &str,
    ) -> Result<Member, ServiceError> {
        sessions.join(name, role, robot, EmpMode::Off)
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
    fn listeners_are_told_who_comes_and_goes() {
        let sessions = sessions();
        let observer = join(&sessions, "a", Role::Observer, "emp27").expect("room");
        let mut told = observer.listen();
        let robot = join(&sessions, "a", Role::Robot, "emp27").expect("a free seat");
        drop(robot);
        let mut presence = || match told.try_recv() {
            Ok(Told::Presence(presence)) => presence,
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
