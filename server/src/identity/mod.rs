//! Who may do what: every call has an [`Identity`], found by its token or certificate, with roles that are bound to robots and
//! sessions.
//!
//! The layer `layers::call` finds the identity, and refuses what [`methods`] does not allow its roles. What a role allows with
//! which robot and which session is asked by the handlers, which know the names: [`Caller::may`].

mod audit;
mod caller;
mod directory;
mod file;
pub(crate) mod methods;
mod patterns;
mod principal;
mod quota;
mod role;

pub(crate) use self::{
    audit::Audit, caller::Caller, directory::Directory, file::write_private, principal::Identity,
    quota::Place,
};
pub use self::{
    file::{AccessError, AccessFile, NewIdentity},
    role::Role,
};
