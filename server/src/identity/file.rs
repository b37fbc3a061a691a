//! The access file: identities with hashes of their tokens, names of their certificates, roles, robots, sessions, quotas.

use std::{
    collections::BTreeSet,
    fs,
    io::{self, Write as _},
    os::unix::fs::{OpenOptionsExt as _, PermissionsExt as _},
    path::{Path, PathBuf},
    time::SystemTime,
};

use rand::{TryRng as _, rngs::SysRng};
use serde::{Deserialize, Serialize};
use sha2::{Digest as _, Sha256};
use time::{OffsetDateTime, format_description::well_known::Rfc3339};

use super::{quota::Quota, role::Role};

/// What a token starts with, so that tools that look for leaked secrets know one.
const PREFIX: &str = "emp_";
/// Random bytes of a token.
const SECRET: usize = 32;
/// What a hash starts with.
const HASH: &str = "sha256:";
/// Longest name, and most bytes of a file.
const LONGEST_NAME: usize = 64;
const LARGEST: u64 = 1 << 20;
const SECONDS_A_DAY: i64 = 86_400;
/// First line of every file.
const HEADER: &str = "# Who may use emp-server. Written by `emp-server token`; docs/security.md says what the fields mean.\n";

/// Why an access file cannot be used.
#[derive(Debug, thiserror::Error)]
#[error("{}: {what}", path.display())]
pub struct AccessError {
    path: PathBuf,
    what: String,
}

/// Everybody who may use a server.
#[derive(Debug, Default, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct AccessFile {
    #[serde(default)]
    pub(super) identity: Vec<Entry>,
}

/// One identity in the file.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Entry {
    pub(super) name: String,
    pub(super) roles: BTreeSet<Role>,
    #[serde(default = "everything")]
    pub(super) robots: Vec<String>,
    #[serde(default = "everything")]
    pub(super) sessions: Vec<String>,
    /// `sha256:` and the hash of the token in hexadecimal digits.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(super) token: Option<String>,
    /// DNS names; a client certificate with one of them is this identity's.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub(super) certificates: Vec<String>,
    /// When it ends, in the form of RFC 3339.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(super) expires: Option<String>,
    #[serde(default, skip_serializing_if = "is_default")]
    pub(super) quota: Quota,
}

fn everything() -> Vec<String> {
    vec!["*".to_owned()]
}

fn is_default(quota: &Quota) -> bool {
    *quota == Quota::default()
}

/// An identity to add.
#[derive(Debug, Clone, Default)]
pub struct NewIdentity {
    /// Its name.
    pub name: String,
    /// What it may do.
    pub roles: Vec<Role>,
    /// The robots that it may do that with, as patterns; empty for all.
    pub robots: Vec<String>,
    /// The sessions that it may do that in, as patterns; empty for all.
    pub sessions: Vec<String>,
    /// DNS names of client certificates that are this identity's. With any, no token is made.
    pub certificates: Vec<String>,
    /// When it ends, days from now.
    pub days: Option<u32>,
}

/// The SHA-256 of a token. A token is 256 random bits, so nothing slower is needed to keep it from being guessed.
pub(super) fn digest(token: &str) -> [u8; 32] {
    Sha256::digest(token.as_bytes()).into()
}

fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}

impl Entry {
    pub(super) fn digest(&self) -> Result<Option<[u8; 32]>, String> {
        let Some(token) = &self.token else {
            return Ok(None);
        };
        let bytes = token
            .strip_prefix(HASH)
            .filter(|hex| hex.len() == 64 && hex.is_ascii())
            .map(|hex| {
                let byte = |i: usize| u8::from_str_radix(&hex[2 * i..2 * i + 2], 16);
                (0..32).map(byte).collect::<Result<Vec<u8>, _>>()
            });
        match bytes {
            Some(Ok(bytes)) => Ok(bytes.try_into().ok()),
            _ => Err(format!(
                "its token is not `{HASH}` and 64 hexadecimal digits"
            )),
        }
    }

    pub(super) fn expiry(&self) -> Result<Option<SystemTime>, String> {
        self.expires
            .as_deref()
            .map(|text| OffsetDateTime::parse(text, &Rfc3339).map(SystemTime::from))
            .transpose()
            .map_err(|_| "expires is not a time such as 2027-01-31T00:00:00Z".to_owned())
    }

    fn check(&self) -> Result<(), String> {
        let fits = |c: char| c.is_ascii_alphanumeric() || "._-".contains(c);
        if self.name.is_empty() || self.name.len() > LONGEST_NAME || !self.name.chars().all(fits) {
            return Err(format!(
                "its name is not 1 to {LONGEST_NAME} letters, digits and . _ -"
            ));
        }
        if self.roles.is_empty() {
            return Err("it has no roles".to_owned());
        }
        if self.token.is_none() && self.certificates.is_empty() {
            return Err("it has neither a token nor certificates".to_owned());
        }
        self.digest()?;
        self.expiry()?;
        Ok(())
    }
}

impl AccessFile {
    /// Reads and checks a file.
    ///
    /// # Errors
    /// When there is none, others than its owner may write it, or something in it is wrong.
    pub fn load(path: &Path) -> Result<Self, AccessError> {
        let error = |what: String| AccessError {
            path: path.to_owned(),
            what,
        };
        let metadata = fs::metadata(path).map_err(|reason| error(reason.to_string()))?;
        if metadata.len() > LARGEST {
            return Err(error(format!("it has more than {LARGEST} bytes")));
        }
        if metadata.permissions().mode() & 0o022 != 0 {
            return Err(error("others than its owner may write it".to_owned()));
        }
        let text = fs::read_to_string(path).map_err(|reason| error(reason.to_string()))?;
        let file: Self = toml::from_str(&text).map_err(|reason| error(reason.to_string()))?;
        let mut names = BTreeSet::new();
        for entry in &file.identity {
            entry
                .check()
                .map_err(|what| error(format!("identity {:?}: {what}", entry.name)))?;
            if !names.insert(&entry.name) {
                return Err(error(format!("identity {:?} is there twice", entry.name)));
            }
        }
        Ok(file)
    }

    /// Adds an identity to a file, which is made if there is none, and gives its token, which is stored nowhere.
    ///
    /// # Errors
    /// When the file cannot be read or written, has that name already, or the identity is incomplete.
    pub fn add(path: &Path, new: NewIdentity) -> Result<Option<String>, AccessError> {
        Self::change(path, |file| {
            if file.identity.iter().any(|entry| entry.name == new.name) {
                return Err(format!("identity {:?} is there already", new.name));
            }
            let token = if new.certificates.is_empty() {
                Some(new_token()?)
            } else {
                None
            };
            let or_all = |names: Vec<String>| {
                if names.is_empty() {
                    everything()
                } else {
                    names
                }
            };
            let entry = Entry {
                name: new.name,
                roles: new.roles.into_iter().collect(),
                robots: or_all(new.robots),
                sessions: or_all(new.sessions),
                token: token
                    .as_deref()
                    .map(|token| format!("{HASH}{}", hex(&digest(token)))),
                certificates: new.certificates,
                expires: new.days.map(days_from_now).transpose()?,
                quota: Quota::default(),
            };
            entry
                .check()
                .map_err(|what| format!("identity {:?}: {what}", entry.name))?;
            file.identity.push(entry);
            Ok(token)
        })
    }

    /// Takes an identity out of a file. A running server ends what it has open.
    ///
    /// # Errors
    /// When the file cannot be read or written, or has no such name.
    pub fn revoke(path: &Path, name: &str) -> Result<(), AccessError> {
        Self::change(path, |file| {
            let before = file.identity.len();
            file.identity.retain(|entry| entry.name != name);
            if file.identity.len() == before {
                return Err(format!("there is no identity {name:?}"));
            }
            Ok(())
        })
    }

    /// A line an identity, without any secret.
    pub fn lines(&self) -> impl Iterator<Item = String> {
        self.identity.iter().map(|entry| {
            let roles: Vec<_> = entry.roles.iter().map(|role| role.name()).collect();
            format!(
                "{}  roles {}  robots {}  sessions {}  by {}  {}",
                entry.name,
                roles.join(","),
                entry.robots.join(","),
                entry.sessions.join(","),
                if entry.token.is_some() {
                    "token"
                } else {
                    "certificate"
                },
                entry
                    .expires
                    .as_deref()
                    .map_or("never expires".to_owned(), |time| format!("expires {time}")),
            )
        })
    }

    /// Reads, changes and replaces a file, while no other process does.
    fn change<T>(
        path: &Path,
        change: impl FnOnce(&mut Self) -> Result<T, String>,
    ) -> Result<T, AccessError> {
        let error = |what: String| AccessError {
            path: path.to_owned(),
            what,
        };
        let changed = || -> io::Result<Result<T, AccessError>> {
            let mut lock = path.as_os_str().to_owned();
            lock.push(".lock");
            let lock = private().truncate(false).open(lock)?;
            lock.lock()?;
            let mut file = if path.exists() {
                match Self::load(path) {
                    Ok(file) => file,
                    Err(error) => return Ok(Err(error)),
                }
            } else {
                Self::default()
            };
            let result = match change(&mut file) {
                Ok(result) => result,
                Err(what) => return Ok(Err(error(what))),
            };
            let text = toml::to_string(&file).map_err(io::Error::other)?;
            write_private(path, format!("{HEADER}\n{text}").as_bytes())?;
            Ok(Ok(result))
        };
        changed().map_err(|reason| error(reason.to_string()))?
    }
}

/// A file that its owner alone may read, and the group when it was so before.
fn private() -> fs::OpenOptions {
    let mut options = fs::OpenOptions::new();
    options.write(true).create(true).mode(0o600);
    options
}

/// Writes a file that its owner alone may read, under a temporary name first. An existing file's owner and mode stay as far as
/// the system allows.
pub(crate) fn write_private(path: &Path, bytes: &[u8]) -> io::Result<()> {
    let mut temporary = path.as_os_str().to_owned();
    temporary.push(format!(".{}.partial", std::process::id()));
    let temporary = PathBuf::from(temporary);
    let write = || -> io::Result<()> {
        let mut file = private().truncate(true).open(&temporary)?;
        file.write_all(bytes)?;
        if let Ok(old) = fs::metadata(path) {
            use std::os::unix::fs::{MetadataExt as _, fchown};
            file.set_permissions(old.permissions())?;
            // Only root may give a file away.
            let _ = fchown(&file, Some(old.uid()), Some(old.gid()));
        }
        file.sync_all()?;
        fs::rename(&temporary, path)
    };
    write().inspect_err(|_| {
        let _ = fs::remove_file(&temporary);
    })
}

fn new_token() -> Result<String, String> {
    let mut secret = [0; SECRET];
    SysRng
        .try_fill_bytes(&mut secret)
        .map_err(|reason| format!("no random numbers: {reason}"))?;
    Ok(format!("{PREFIX}{}", hex(&secret)))
}

fn days_from_now(days: u32) -> Result<String, String> {
    let end = OffsetDateTime::now_utc() + time::Duration::seconds(i64::from(days) * SECONDS_A_DAY);
    end.replace_nanosecond(0)
        .map_err(|error| error.to_string())?
        .format(&Rfc3339)
        .map_err(|error| error.to_string())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn identities_are_added_and_revoked_and_no_token_is_stored() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("access.toml");
        let new = |name: &str| NewIdentity {
            name: name.to_owned(),
            roles: vec![Role::Robot],
            robots: vec!["g1*".to_owned()],
            days: Some(30),
            ..NewIdentity::default()
        };
        let token = AccessFile::add(&path, new("one"))
            .expect("added")
            .expect("a token");
        assert!(AccessFile::add(&path, new("one")).is_err());
        AccessFile::add(&path, new("two")).expect("added");
        let text = fs::read_to_string(&path).expect("text");
        assert!(!text.contains(&token) && !text.contains(&token[4..]));
        assert_eq!(
            fs::metadata(&path).expect("metadata").permissions().mode() & 0o777,
            0o600
        );
        let file = AccessFile::load(&path).expect("sound");
        assert_eq!(file.identity[0].digest(), Ok(Some(digest(&token))));
        assert!(file.identity[0].expiry().expect("a time").expect("set") > SystemTime::now());
        assert_eq!(file.lines().count(), 2);
        AccessFile::revoke(&path, "one").expect("revoked");
        assert!(AccessFile::revoke(&path, "one").is_err());
        assert_eq!(AccessFile::load(&path).expect("sound").identity.len(), 1);
    }

    #[test]
    fn mistakes_are_named() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("access.toml");
        let refused = |text: &str, mode: u32| {
            fs::write(&path, text).expect("written");
            fs::set_permissions(&path, fs::Permissions::from_mode(mode)).expect("mode");
            AccessFile::load(&path).expect_err("refused").to_string()
        };
        let entry = |rest: &str| format!("[[identity]]\nname = \"a\"\n{rest}\n");
        let hash = format!("token = \"sha256:{}\"", "0".repeat(64));
        for (text, expected) in [
            (entry("roles = [\"robot\"]"), "neither a token"),
            (entry(&format!("roles = []\n{hash}")), "no roles"),
            (entry(&format!("roles = [\"king\"]\n{hash}")), "king"),
            (entry("roles = [\"robot\"]\ntoken = \"secret\""), "sha256:"),
            (
                entry(&format!("roles = [\"robot\"]\nexpires = \"soon\"\n{hash}")),
                "expires",
            ),
            (
                entry(&format!("roles = [\"robot\"]\nrobot = \"x\"\n{hash}")),
                "robot",
            ),
            (
                entry(&format!("roles = [\"robot\"]\n{hash}")).repeat(2),
                "twice",
            ),
        ] {
            let message = refused(&text, 0o600);
            assert!(message.contains(expected), "{text}: {message}");
        }
        assert!(refused("", 0o666).contains("others"));
    }
}
