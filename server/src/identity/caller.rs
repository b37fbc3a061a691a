//! Who made a call.

use std::{net::SocketAddr, sync::Arc};

use serde_json::{Value, json};

use super::{audit::Audit, principal::Identity, quota::Place, role::Role};
use crate::error::ServiceError;

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
            json!({"role": role.name(), "robot": robot, "session": session}),
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
    pub(crate) fn record(&self, event: &str, facts: Value) {
        let Value::Object(mut facts) = facts else {
            return;
        };
        facts.insert("identity".to_owned(), self.identity.name().into());
        facts.insert("request".to_owned(), self.request.as_ref().into());
        let peer = self.peer.map(|peer| peer.to_string());
        facts.insert("peer".to_owned(), peer.into());
        self.audit.record(event, facts);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::identity::patterns::Patterns;

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
