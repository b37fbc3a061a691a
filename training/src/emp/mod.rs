//! The Executable Motion Prior: learning to change goals only as far as balance needs (paper, section V).

pub mod imagination;
pub mod losses;
pub mod objective;
