//! The contact sheet: what the person did above what the robot did, at moments that differ.

mod canvas;
mod figure;
mod moments;
mod sheet;

pub(crate) use moments::differing;
pub(crate) use sheet::{Moment, Sheet};
