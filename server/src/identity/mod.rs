//! Who may do what: every call has an [`Identity`], found by its token or certificate, with roles that are bound to robots and
//! sessions.
//!
//! The layer `layers::call` finds the identity, and refuses what [`methods`] does not allow its roles. What a role allows with
//! which robot and which session is asked by the handlers, which know the names: [`Caller::may`].

mod audit;
mod directory;
mod file;
pub(crate) mod methods;
mod quota;

use std::{collections::BTreeSet, fmt, net::SocketAddr, sync::Arc, time::SystemTime};

use serde::{Deserialize, Serialize};
use tokio_util::sync::CancellationToken;

pub use self::file::{AccessError, AccessFile, NewIdentity};
use self::quota::Quota;
pub(crate) use self::{
    audit::Audit,
    directory::Directory,
    file::write_private,
    quota::{Place, Usage},
};
use crate::error::ServiceError;

/// What somebody may do.
#[derive(
    Debug,
    Clone,
    Copy,
    PartialEq,
    Eq,
    PartialOrd,
    Ord,
    Hash,
    Serialize,
    Deserialize,
    clap::ValueEnum,
)]
#[serde(rename_all = "lowercase")]
pub enum Role {
    /// Sees robots, models and what sessions do. Every other role does, too.
    Observer,
    /// Sends the poses that robots follow, and controls sessions.
    Operator,
    /// Is a robot: sends states, receives joint targets.
    Robot,
    /// Runs evaluations and rollouts.
    Evaluator,
    /// May do everything, and alone reloads models and ends sessions.
    Admin,
}

impl Role {
    /// Its name, as files and messages have it.
    pub fn name(self) -> &'static str {
        match self {
            Self::Observer => "observer",
            Self::Operator => "operator",
            Self::Robot => "robot",
            Self::Evaluator => "evaluator",
            Self::Admin => "admin",
        }
    }

    fn covers(self, needed: Self) -> bool {
        self == needed || self == Self::Admin || needed == Self::Observer
    }
}

impl fmt::Display for Role {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

/// Names, with `*` for any run of characters.
#[derive(Debug, Clone, PartialEq, Eq)]
struct Patterns(Vec<String>);

impl Patterns {
    fn any() -> Self {
        Self(vec!["*".to_owned()])
    }

    fn has(&self, name: &str) -> bool {
        self.0.iter().any(|pattern| matches(pattern, name))
    }
}

/// Whether `name` is what `pattern` describes; takes time in proportion to the product of their lengths at most.
fn matches(pattern: &str, name: &str) -> bool {
    let Some((start, rest)) = pattern.split_once('*') else {
        return pattern == name;
    };
    let Some(mut left) = name.strip_prefix(start) else {
        return false;
    };
    let Some((middle, end)) = rest.rsplit_once('*') else {
        return left.ends_with(rest);
    };
    for part in middle.split('*') {
        let Some(at) = left.find(part) else {
            return false;
        };
        left = &left[at + part.len()..];
    }
    left.ends_with(end)
}

/// Somebody who may do something.
pub(crate) struct Identity {
    name: String,
    roles: BTreeSet<Role>,
    robots: Patterns,
    sessions: Patterns,
    expires: Option<SystemTime>,
    quota: Quota,
    usage: Arc<Usage>,
    /// Cancelled when the identity is gone or changed: what it has open ends.
    revoked: CancellationToken,
}

impl Identity {
    /// Whoever reaches a server that asks for no credentials.
    fn anyone() -> Self {
        Self::new("anyone", BTreeSet::from([Role::Admin]))
    }

    /// Has no role, so may do nothing.
    fn nobody() -> Self {
        Self::new("nobody", BTreeSet::new())
    }

    fn new(name: &str, roles: BTreeSet<Role>) -> Self {
        Self {
            name: name.to_owned(),
            roles,
            robots: Patterns::any(),
            sessions: Patterns::any(),
            expires: None,
            quota: Quota::unlimited(),
            usage: Arc::default(),
            revoked: CancellationToken::new(),
        }
    }

    pub(crate) fn name(&self) -> &str {
        &self.name
    }

    pub(crate) fn has(&self, needed: Role) -> bool {
        self.roles.iter().any(|role| role.covers(needed))
    }

    pub(crate) fn has_expired(&self, now: SystemTime) -> bool {
        self.expires.is_some_and(|expires| expires <= now)
    }

    /// Resolves when what the identity has open must end, with the reason.
    pub(crate) async fn ended(&self) -> ServiceError {
        let expiry = async {
            match self.expires {
                Some(expires) => {
                    let left = expires.duration_since(SystemTime::now());
                    tokio::time::sleep(left.unwrap_or_default()).await;
                }
                None => std::future::pending().await,
            }
        };
        tokio::select! {
            () = self.revoked.cancelled() => ServiceError::Unauthenticated("CREDENTIALS_REVOKED"),
            () = expiry => ServiceError::Unauthenticated("CREDENTIALS_EXPIRED"),
        }
    }

    /// A place among the calls of this kind that the identity may have open.
    pub(crate) fn enter_call(&self, kind: methods::Kind) -> Result<Place, ServiceError> {
        self.usage.enter_call(kind, &self.quota)
    }

    /// How long to wait before more is read, after this many bytes were.
    pub(crate) fn read(&self, bytes: usize) -> std::time::Duration {
        self.usage.read(bytes, &self.quota)
    }
}

/// Who made a call, from where. In the extensions of every request that reaches a handler.
#[derive(Clone)]
pub(crate) struct Caller {
    pub(crate) identity: Arc<Identity>,
    pub(crate) peer: Option<SocketAddr>,
    pub(crate) request: Arc<str>,
    pub(crate) audit: Audit,
}

impl Caller {
    /// The caller of a request. Nobody, who may do nothing, if the layers did not see the request.
    pub(crate) fn of(extensions: &http::Extensions) -> Self {
        extensions.get().cloned().unwrap_or_else(Self::nobody)
    }

    /// May do nothing.
    pub(crate) fn nobody() -> Self {
        Self {
            identity: Arc::new(Identity::nobody()),
            peer: None,
            request: Arc::from(""),
            audit: Audit::off(),
        }
    }

    /// Whether the caller may be `role` for this robot, in this session. An empty name asks about none.
    ///
    /// # Errors
    /// When not.
    pub(crate) fn may(&self, role: Role, robot: &str, session: &str) -> Result<(), ServiceError> {
        let identity = &self.identity;
        let what = if !identity.has(role) {
            format!("be {role}")
        } else if !robot.is_empty() && !identity.robots.has(robot) {
            format!("use robot {robot:?}")
        } else if !session.is_empty() && !identity.sessions.has(session) {
            format!("join session {session:?}")
        } else {
            return Ok(());
        };
        let name = identity.name.clone();
        self.record(
            "refused",
            serde_json::json!({"role": role.name(), "robot": robot, "session": session}),
        );
        Err(ServiceError::PermissionDenied { name, what })
    }

    /// A place among the sessions that the caller may be in.
    ///
    /// # Errors
    /// When it is in as many as it may be.
    pub(crate) fn enter_session(&self) -> Result<Place, ServiceError> {
        self.identity.usage.enter_session(&self.identity.quota)
    }

    /// Writes to the audit log what the caller does.
    pub(crate) fn record(&self, event: &str, facts: serde_json::Value) {
        self.audit.record(self, event, facts);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn patterns_mean_what_they_say() {
        for (pattern, name, expected) in [
            ("lab", "lab", true),
            ("lab", "lab2", false),
            ("*", "", true),
            ("*", "anything", true),
            ("lab-*", "lab-1", true),
            ("lab-*", "my-lab-1", false),
            ("*-arm", "left-arm", true),
            ("g1*x*y", "g1-x-y", true),
            ("g1*x*y", "g1-y-x", false),
            ("a*a", "a", false),
            ("a*a", "aa", true),
            ("*b*b*", "b", false),
            ("", "", true),
            ("", "x", false),
        ] {
            assert_eq!(matches(pattern, name), expected, "{pattern:?} {name:?}");
        }
    }

    fn caller(roles: &[Role], robots: &str, sessions: &str) -> Caller {
        let identity = Identity {
            robots: Patterns(vec![robots.to_owned()]),
            sessions: Patterns(vec![sessions.to_owned()]),
            ..Identity::new("lab", roles.iter().copied().collect())
        };
        Caller {
            identity: Arc::new(identity),
            peer: None,
            request: Arc::from("1"),
            audit: Audit::off(),
        }
    }

    #[test]
    fn a_role_is_bound_to_its_robots_and_sessions() {
        let lab = caller(&[Role::Operator], "g1*", "lab-*");
        assert!(lab.may(Role::Operator, "g1", "lab-1").is_ok());
        assert!(lab.may(Role::Observer, "g1", "lab-1").is_ok());
        assert!(lab.may(Role::Operator, "g1", "").is_ok());
        for (role, robot, session) in [
            (Role::Robot, "g1", "lab-1"),
            (Role::Operator, "emp27", "lab-1"),
            (Role::Operator, "g1", "other"),
            (Role::Admin, "g1", "lab-1"),
        ] {
            let refused = lab.may(role, robot, session).expect_err("refused");
            assert!(matches!(refused, ServiceError::PermissionDenied { .. }));
        }
        let admin = caller(&[Role::Admin], "*", "*");
        assert!(admin.may(Role::Robot, "g1", "lab-1").is_ok());
    }

    #[test]
    fn a_request_that_no_layer_saw_is_nobodys() {
        let nobody = Caller::of(&http::Extensions::new());
        assert!(nobody.may(Role::Observer, "g1", "lab").is_err());
    }
}
