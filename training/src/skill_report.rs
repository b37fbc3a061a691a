//! How lively sets of motion are, beside people.

use std::fmt;

use emp_motion::{
    Clip, Side,
    arm_motion::{ArmMotion, quantile},
};
use serde::Serialize;

/// Percentiles over arms that are printed.
const PERCENTILES: [f64; 3] = [0.1, 0.5, 0.9];

/// How a figure is read off an arm.
type Figure = fn(&ArmMotion) -> f64;

/// The figures: their names, and how they are read off an arm.
const FIGURES: [(&str, Figure); 6] = [
    ("hand speed p95, m/s", |arm| arm.hand_speed[0]),
    ("hand speed top, m/s", |arm| arm.hand_speed[1]),
    ("hand acceleration p95, m/s²", |arm| arm.hand_acceleration),
    ("upper arm's turn rate p95, rad/s", |arm| arm.turn_rate[0]),
    ("upper arm's turn rate top, rad/s", |arm| arm.turn_rate[1]),
    ("centre of the spectrum, Hz", |arm| arm.frequency),
];

/// 328 arms of people who wave, raise hands, say good-bye, bow, guide, punch and dance, in recordings that are no part of
/// this project: 10th, 50th and 90th percentile of each figure, as far as they are known.
const PEOPLE: [[Option<f64>; 3]; 6] = [
    [Some(0.16), Some(1.1), Some(3.5)],
    [Some(0.2), Some(1.3), Some(4.3)],
    [Some(1.3), Some(7.7), Some(58.0)],
    [Some(0.2), Some(1.5), Some(6.8)],
    [None, None, Some(8.7)],
    [Some(0.5), Some(0.8), Some(2.0)],
];

/// Percentiles of each figure over the arms of some clips.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct ArmTable {
    /// What the clips are.
    pub name: String,
    /// Number of arms.
    pub arms: usize,
    /// 10th, 50th and 90th percentile of each figure.
    pub figures: [[f64; 3]; 6],
}

impl ArmTable {
    /// Measures both arms of each clip that lasts a second or more.
    pub fn new(name: impl Into<String>, clips: &[Clip]) -> Self {
        let arms: Vec<ArmMotion> = clips
            .iter()
            .flat_map(|clip| Side::BOTH.map(|side| ArmMotion::of(clip, side)))
            .flatten()
            .collect();
        let percentiles = |figure: fn(&ArmMotion) -> f64| {
            let mut values: Vec<f64> = arms.iter().map(figure).collect();
            values.sort_by(f64::total_cmp);
            PERCENTILES.map(|share| quantile(&values, share))
        };
        Self {
            name: name.into(),
            arms: arms.len(),
            figures: FIGURES.map(|(_, figure)| percentiles(figure)),
        }
    }
}

/// Sets of motion side by side. [`Display`](fmt::Display) writes a table in Markdown, people first.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[serde(transparent)]
pub struct Report(pub Vec<ArmTable>);

impl fmt::Display for Report {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(
            f,
            "| per arm, 10th / 50th / 90th percentile | people, 328 arms |"
        )?;
        for table in &self.0 {
            write!(f, " {}, {} arms |", table.name, table.arms)?;
        }
        writeln!(f)?;
        writeln!(f, "|---|---|{}", "---|".repeat(self.0.len()))?;
        for (index, (name, _)) in FIGURES.iter().enumerate() {
            let known = PEOPLE[index].map(|value| match value {
                Some(value) => format!("{value}"),
                None => "–".to_owned(),
            });
            write!(f, "| {name} | {} |", known.join(" / "))?;
            for table in &self.0 {
                let figures = table.figures[index].map(|value| format!("{value:.2}"));
                write!(f, " {} |", figures.join(" / "))?;
            }
            writeln!(f)?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use emp_motion::skills;

    /// How near the library's 90th percentiles have to come to people's: blows are less sudden than theirs.
    const NEAR: [f64; 6] = [0.7, 0.8, 0.45, 0.85, 0.95, 0.8];

    #[test]
    fn the_procedural_library_is_about_as_lively_as_people_are() {
        let table = ArmTable::new("procedural", &skills::library(5, 240));
        assert_eq!(table.arms, 480);
        for (index, (figure, people)) in table.figures.iter().zip(PEOPLE).enumerate() {
            let (name, ninetieth) = (FIGURES[index].0, people[2].unwrap_or(0.0));
            assert!(figure[2] >= NEAR[index] * ninetieth, "{name}: {figure:?}");
            assert!(figure[2] < 2.0 * ninetieth, "{name}: {figure:?}");
        }
        let text = Report(vec![table]).to_string();
        assert!(
            text.contains("procedural, 480 arms") && text.contains("3.5"),
            "{text}"
        );
    }
}
