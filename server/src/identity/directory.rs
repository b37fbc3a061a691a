//! Finds the identity of a call, by its token or by the certificate of its connection, in what was last read from the access
//! file.

use std::{
    collections::BTreeMap,
    path::{Path, PathBuf},
    sync::{Arc, PoisonError, RwLock},
    time::SystemTime,
};

use http::{HeaderMap, header::AUTHORIZATION};
use subtle::ConstantTimeEq as _;
use tokio_util::sync::CancellationToken;

use super::{
    file::{AccessError, AccessFile, Entry, digest},
    patterns::Patterns,
    principal::Identity,
};
use crate::error::ServiceError;

/// Everybody who may use this server.
pub(crate) enum Directory {
    /// Whoever reaches it; only where the server listens for its own machine, or was told `--insecure`.
    Open(Arc<Identity>),
    /// Those in a file.
    Closed {
        path: PathBuf,
        known: RwLock<Vec<Known>>,
        /// Whoever calls what needs no credentials.
        nobody: Arc<Identity>,
    },
}

/// An identity and how it is known.
pub(crate) struct Known {
    entry: Entry,
    digest: Option<[u8; 32]>,
    identity: Arc<Identity>,
}

impl Directory {
    /// Those in the access file; anyone if there is none.
    pub(crate) fn open(path: Option<&Path>) -> Result<Self, AccessError> {
        let Some(path) = path else {
            return Ok(Self::Open(Arc::new(Identity::anyone())));
        };
        let file = AccessFile::load(path)?;
        Ok(Self::Closed {
            path: path.to_owned(),
            known: RwLock::new(known(file, &[])),
            nobody: Arc::new(Identity::nobody()),
        })
    }

    /// Reads the file again. What identities that are gone or changed have open ends; on an error everything stays.
    pub(crate) fn reload(&self) -> Result<(), AccessError> {
        let Self::Closed {
            path, known: old, ..
        } = self
        else {
            return Ok(());
        };
        let file = AccessFile::load(path)?;
        let mut old = old.write().unwrap_or_else(PoisonError::into_inner);
        let new = known(file, &old);
        for known in &*old {
            if !new
                .iter()
                .any(|new| Arc::ptr_eq(&new.identity, &known.identity))
            {
                known.identity.revoked.cancel();
            }
        }
        *old = new;
        Ok(())
    }

    /// Whoever calls a method that needs nothing.
    pub(crate) fn anonymous(&self) -> Arc<Identity> {
        match self {
            Self::Open(identity) => Arc::clone(identity),
            Self::Closed { nobody, .. } => Arc::clone(nobody),
        }
    }

    /// Whose call this is. A token counts before the certificate of the connection.
    ///
    /// # Errors
    /// When it has no credentials, or they are not known or have expired.
    pub(crate) fn find(
        &self,
        headers: &HeaderMap,
        certificate: &[String],
    ) -> Result<Arc<Identity>, ServiceError> {
        let known = match self {
            Self::Open(identity) => return Ok(Arc::clone(identity)),
            Self::Closed { known, .. } => known.read().unwrap_or_else(PoisonError::into_inner),
        };
        let mut tokens = headers.get_all(AUTHORIZATION).into_iter();
        let found = match (tokens.next(), tokens.next()) {
            (None, _) if certificate.is_empty() => {
                return Err(ServiceError::Unauthenticated("CREDENTIALS_MISSING"));
            }
            (None, _) => known.iter().find(|known| {
                let names = &known.entry.certificates;
                names.iter().any(|name| certificate.contains(name))
            }),
            (Some(token), None) => by_token(&known, token.as_bytes()),
            (Some(_), Some(_)) => None,
        };
        let found = found.ok_or(ServiceError::Unauthenticated("CREDENTIALS_UNKNOWN"))?;
        if found.identity.has_expired(SystemTime::now()) {
            return Err(ServiceError::Unauthenticated("CREDENTIALS_EXPIRED"));
        }
        Ok(Arc::clone(&found.identity))
    }
}

/// Every hash is compared, each in constant time, so that the time tells nothing about what is in the file.
fn by_token<'a>(known: &'a [Known], header: &[u8]) -> Option<&'a Known> {
    let header = std::str::from_utf8(header).ok()?;
    let (scheme, token) = header.split_once(' ')?;
    if !scheme.eq_ignore_ascii_case("bearer") {
        return None;
    }
    let presented = digest(token.trim_ascii());
    let mut found = None;
    for known in known {
        let fits = known
            .digest
            .is_some_and(|digest| bool::from(digest.ct_eq(&presented)));
        if fits {
            found = Some(known);
        }
    }
    found
}

/// The identities of a file. One that is as it was stays the same; of one that changed, what it has open still counts.
fn known(file: AccessFile, old: &[Known]) -> Vec<Known> {
    let old: BTreeMap<&str, &Known> = old
        .iter()
        .map(|known| (known.entry.name.as_str(), known))
        .collect();
    file.identity
        .into_iter()
        .map(|entry| {
            let before = old.get(entry.name.as_str());
            let identity = match before {
                Some(before) if before.entry == entry => Arc::clone(&before.identity),
                _ => {
                    let usage = before.map(|known| Arc::clone(&known.identity.usage));
                    Arc::new(Identity {
                        name: entry.name.clone(),
                        roles: entry.roles.clone(),
                        robots: Patterns(entry.robots.clone()),
                        sessions: Patterns(entry.sessions.clone()),
                        // The file was checked.
                        expires: entry.expiry().unwrap_or(Some(SystemTime::UNIX_EPOCH)),
                        quota: entry.quota.clone(),
                        usage: usage.unwrap_or_default(),
                        revoked: CancellationToken::new(),
                    })
                }
            };
            Known {
                digest: entry.digest().unwrap_or_default(),
                identity,
                entry,
            }
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::identity::{NewIdentity, Role};

    fn headers(value: &str) -> HeaderMap {
        let mut headers = HeaderMap::new();
        headers.insert(AUTHORIZATION, value.parse().expect("a header"));
        headers
    }

    fn reason<T>(result: &Result<T, ServiceError>) -> &'static str {
        match result {
            Err(ServiceError::Unauthenticated(reason)) => reason,
            Err(_) => "another error",
            Ok(_) => "found",
        }
    }

    #[test]
    fn credentials_are_found_until_they_are_revoked() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("access.toml");
        let new = |name: &str, certificate: Option<&str>| NewIdentity {
            name: name.to_owned(),
            roles: vec![Role::Robot],
            certificates: certificate.map(str::to_owned).into_iter().collect(),
            ..NewIdentity::default()
        };
        let add =
            |name, certificate| AccessFile::add(&path, new(name, certificate)).expect("added");
        let token = add("one", None).expect("a token");
        let other = add("two", None).expect("a token");
        add("three", Some("robot.lab"));
        let directory = Directory::open(Some(&path)).expect("sound");
        let find = |value: &str| directory.find(&headers(value), &[]);
        let one = find(&format!("Bearer {token}")).expect("known");
        let two = find(&format!("bearer {other}")).expect("known");
        assert_eq!((one.name(), two.name()), ("one", "two"));
        for wrong in [
            format!("Bearer {}", &token[..token.len() - 1]),
            format!("Basic {token}"),
            token.clone(),
            "Bearer".to_owned(),
            String::new(),
        ] {
            assert_eq!(reason(&find(&wrong)), "CREDENTIALS_UNKNOWN", "{wrong}");
        }
        let by_certificate = |name: &str| directory.find(&HeaderMap::new(), &[name.to_owned()]);
        assert_eq!(by_certificate("robot.lab").expect("known").name(), "three");
        assert_eq!(reason(&by_certificate("other.lab")), "CREDENTIALS_UNKNOWN");
        let missing = directory.find(&HeaderMap::new(), &[]);
        assert_eq!(reason(&missing), "CREDENTIALS_MISSING");
        let mut twice = headers(&format!("Bearer {token}"));
        twice.append(AUTHORIZATION, "Bearer x".parse().expect("a header"));
        assert_eq!(reason(&directory.find(&twice, &[])), "CREDENTIALS_UNKNOWN");

        AccessFile::revoke(&path, "one").expect("revoked");
        directory.reload().expect("sound");
        assert!(one.revoked.is_cancelled() && !two.revoked.is_cancelled());
        assert_eq!(
            reason(&find(&format!("Bearer {token}"))),
            "CREDENTIALS_UNKNOWN"
        );
        std::fs::write(&path, "nonsense").expect("written");
        assert!(directory.reload().is_err());
        assert!(find(&format!("Bearer {other}")).is_ok() && !two.revoked.is_cancelled());
    }

    #[test]
    fn expired_credentials_are_told_apart() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("access.toml");
        let new = NewIdentity {
            name: "old".to_owned(),
            roles: vec![Role::Admin],
            days: Some(0),
            ..NewIdentity::default()
        };
        let token = AccessFile::add(&path, new)
            .expect("added")
            .expect("a token");
        let directory = Directory::open(Some(&path)).expect("sound");
        let found = directory.find(&headers(&format!("Bearer {token}")), &[]);
        assert_eq!(reason(&found), "CREDENTIALS_EXPIRED");
    }
}
