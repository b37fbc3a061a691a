//! What the server's guards did around a run, and when.

use serde::Serialize;

/// Something that a guard did, from its first control period to its last.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub(crate) struct Action {
    /// When it began, seconds.
    pub(crate) from: f64,
    /// When it ended, seconds.
    pub(crate) to: f64,
    /// In words.
    pub(crate) what: String,
}

/// Joins what was done in each control period to actions. `done` is a period's, in words; `rate` are periods a second.
pub(crate) fn actions<'a>(done: impl Iterator<Item = &'a [String]>, rate: f64) -> Vec<Action> {
    let mut finished: Vec<Action> = Vec::new();
    let mut running: Vec<(usize, &str)> = Vec::new();
    let mut periods = 0;
    let action = |from: usize, to: usize, what: &str| Action {
        from: from as f64 / rate,
        to: to as f64 / rate,
        what: what.to_owned(),
    };
    for (period, done) in done.enumerate() {
        running.retain(|&(from, what)| {
            let goes_on = done.iter().any(|now| now == what);
            if !goes_on {
                finished.push(action(from, period, what));
            }
            goes_on
        });
        for what in done {
            if running.iter().all(|(_, now)| now != what) {
                running.push((period, what));
            }
        }
        periods = period + 1;
    }
    finished.extend(
        running
            .into_iter()
            .map(|(from, what)| action(from, periods, what)),
    );
    finished.sort_by(|a, b| a.from.total_cmp(&b.from));
    finished
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn periods_of_one_kind_are_one_action() {
        let done = [
            &["ramp"][..],
            &["ramp", "limit"],
            &["limit"],
            &[],
            &["limit"],
        ];
        let done = done.map(|done| done.iter().map(|&what| what.to_owned()).collect::<Vec<_>>());
        let actions = actions(done.iter().map(Vec::as_slice), 2.0);
        let action = |from, to, what: &str| Action {
            from,
            to,
            what: what.to_owned(),
        };
        assert_eq!(
            actions,
            [
                action(0.0, 1.0, "ramp"),
                action(0.5, 1.5, "limit"),
                action(2.0, 2.5, "limit")
            ]
        );
    }
}
