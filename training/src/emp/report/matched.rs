//! What a family of filters takes where it lets the robot fall as often as an EMP does.

use serde::Serialize;

use super::rows::{Outcome, Row};

/// What is taken from the goals.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Price {
    /// relL2.
    pub(super) relative_change: f64,
    /// Mean absolute change of a goal angle, rad.
    pub(super) change: f64,
    /// Joint tracking.
    pub(super) mjp: f64,
}

/// An EMP beside the member of a family that cuts as many falls, hard conditions together.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Match {
    /// The EMP.
    pub(super) emp: String,
    /// The family.
    pub(super) family: String,
    /// What the EMP takes.
    pub(super) ours: Price,
    /// What the family takes, between the two members on either side; none where it never cuts as many falls.
    pub(super) theirs: Option<Price>,
}

/// Every EMP beside every family; `rows` begin with the policy alone.
pub(super) fn matches(rows: &[Row]) -> Vec<Match> {
    let Some((raw, others)) = rows.split_first() else {
        return Vec::new();
    };
    let families = || others.chunk_by(|a, b| a.family == b.family);
    let mut matches = Vec::new();
    for emp in others.iter().filter(|row| row.learned) {
        for family in families().filter(|family| !family[0].learned) {
            let line: Vec<(f64, Price)> = std::iter::once(raw)
                .chain(family)
                .map(|row| (row.hard.fallen(), Price::of(&row.hard)))
                .collect();
            matches.push(Match {
                emp: emp.name.clone(),
                family: family[0].family.clone(),
                ours: Price::of(&emp.hard),
                theirs: at(&line, emp.hard.fallen()),
            });
        }
    }
    matches
}

impl Price {
    fn of(outcome: &Outcome) -> Self {
        let metrics = &outcome.metrics;
        Self {
            relative_change: metrics.relative_change.mean,
            change: metrics.change.mean,
            mjp: metrics.mjp.mean,
        }
    }
}

/// The price along a line of (share of falls, price) where the falls first come down to `falls`.
fn at(line: &[(f64, Price)], falls: f64) -> Option<Price> {
    let crossing = line
        .windows(2)
        .find(|pair| pair[0].0 >= falls && pair[1].0 <= falls)?;
    let [(above, from), (below, to)] = [crossing[0], crossing[1]];
    let share = if above > below {
        (above - falls) / (above - below)
    } else {
        0.0
    };
    let between = |from: f64, to: f64| from + share * (to - from);
    Some(Price {
        relative_change: between(from.relative_change, to.relative_change),
        change: between(from.change, to.change),
        mjp: between(from.mjp, to.mjp),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn prices_are_read_off_where_the_falls_come_down_to_it() {
        let point = |falls: f64, price: f64| {
            let price = Price {
                relative_change: price,
                change: 0.5 * price,
                mjp: 1.0 - price,
            };
            (falls, price)
        };
        // Milder members may do worse than nothing.
        let line = [
            point(0.10, 0.0),
            point(0.12, 0.1),
            point(0.08, 0.2),
            point(0.02, 0.4),
        ];
        let price = |falls: f64| at(&line, falls).map(|price| price.relative_change);
        assert!((price(0.05).unwrap() - 0.3).abs() < 1e-9);
        assert!((price(0.11).unwrap() - 0.125).abs() < 1e-9);
        assert!((price(0.02).unwrap() - 0.4).abs() < 1e-9);
        assert_eq!(price(0.01), None);
        assert_eq!(price(0.13), None);
        let middle = at(&line, 0.05).unwrap();
        assert!((middle.change - 0.15).abs() < 1e-9 && (middle.mjp - 0.7).abs() < 1e-9);
        assert_eq!(at(&line[..1], 0.05), None);
    }
}
