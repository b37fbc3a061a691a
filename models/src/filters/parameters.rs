//! The parameters in a filter's specification.

use std::{collections::BTreeMap, ops::RangeInclusive};

use emp_robot::Robot;

use super::error::FilterError;

/// A filter's name, and the parameters that nobody has asked for yet.
pub(super) struct Parameters<'a> {
    filter: &'a str,
    given: BTreeMap<&'a str, &'a str>,
}

impl<'a> Parameters<'a> {
    /// Takes a specification apart.
    pub(super) fn parse(specification: &'a str) -> Result<Self, FilterError> {
        let (filter, rest) = specification.split_once(':').unwrap_or((specification, ""));
        let filter = filter.trim();
        let mut given = BTreeMap::new();
        for part in rest.split(',').filter(|_| !rest.trim().is_empty()) {
            let pair = part.split_once('=').map(|(k, v)| (k.trim(), v.trim()));
            let is_new = pair.filter(|(key, _)| !key.is_empty() && !given.contains_key(key));
            let (key, value) = is_new.ok_or_else(|| FilterError::Syntax {
                filter: filter.to_owned(),
                found: part.to_owned(),
            })?;
            given.insert(key, value);
        }
        Ok(Self { filter, given })
    }

    pub(super) fn filter(&self) -> &'a str {
        self.filter
    }

    /// A number, if it is given.
    pub(super) fn number(
        &mut self,
        key: &str,
        range: RangeInclusive<f64>,
        unit: &str,
    ) -> Result<Option<f64>, FilterError> {
        let Some(text) = self.given.remove(key) else {
            return Ok(None);
        };
        let number = text.parse().ok().filter(|number| range.contains(number));
        let (from, to) = range.into_inner();
        number
            .map(Some)
            .ok_or_else(|| self.value(key, format!("a number from {from} to {to}{unit}"), text))
    }

    /// One of a few words, if it is given.
    pub(super) fn word(
        &mut self,
        key: &str,
        words: &[&'static str],
    ) -> Result<Option<&'static str>, FilterError> {
        let Some(text) = self.given.remove(key) else {
            return Ok(None);
        };
        let word = words.iter().find(|word| **word == text);
        word.map(|word| Some(*word))
            .ok_or_else(|| self.value(key, words.join(" or "), text))
    }

    /// Indices of the goal joints that `joints` does not name, as in `joints=waist+shoulder`: words in the names of those that
    /// it is for; none if it is not given.
    pub(super) fn other_joints(&mut self, robot: &Robot) -> Result<Vec<usize>, FilterError> {
        let Some(text) = self.given.remove("joints") else {
            return Ok(Vec::new());
        };
        let joints = robot.goal_joints();
        let words: Vec<&str> = text.split('+').map(str::trim).collect();
        let is_any = |word: &&str| joints.iter().any(|joint| joint.name.contains(*word));
        if let Some(word) = words.iter().find(|word| word.is_empty() || !is_any(word)) {
            let expected = "parts of goal joints' names, joined by +";
            return Err(self.value("joints", expected, *word));
        }
        let is_other = |name: &str| !words.iter().any(|word| name.contains(word));
        let joints = joints.iter().enumerate();
        let others = joints.filter(|(_, joint)| is_other(&joint.name));
        Ok(others.map(|(index, _)| index).collect())
    }

    /// All that is left.
    pub(super) fn rest(&mut self) -> BTreeMap<&'a str, &'a str> {
        std::mem::take(&mut self.given)
    }

    /// Refuses what is left; `expected` says what the filter takes.
    pub(super) fn finish(&self, expected: &str) -> Result<(), FilterError> {
        match self.given.keys().next() {
            Some(key) => Err(self.unknown(key, expected)),
            None => Ok(()),
        }
    }

    pub(super) fn unknown(&self, key: &str, expected: &str) -> FilterError {
        FilterError::Parameter {
            filter: self.filter.to_owned(),
            key: key.to_owned(),
            expected: expected.to_owned(),
        }
    }

    pub(super) fn value(
        &self,
        key: &str,
        expected: impl Into<String>,
        found: impl Into<String>,
    ) -> FilterError {
        FilterError::Value {
            filter: self.filter.to_owned(),
            key: key.to_owned(),
            expected: expected.into(),
            found: found.into(),
        }
    }
}
