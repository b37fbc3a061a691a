//! The paper's ablation of the EMP's losses (section VI): the whole loss, and three trainings that do without a part of it.

use std::{
    fmt,
    path::{Path, PathBuf},
    sync::Arc,
};

use anyhow::{Context as _, Result};
use emp_models::emp::Emp;
use emp_motion::atomic;
use emp_robot::Robot;
use emp_sim::{
    evaluation::Evaluation,
    metrics::{LIST, Metric, headings},
    suite::Condition,
};
use serde::Serialize;

use super::{judge::Judge, settings::EmpSettings};

/// What is left out.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Row {
    /// Nothing.
    Full,
    /// `L_smo`.
    WithoutSmoothness,
    /// `L_ori`.
    WithoutOrientation,
    /// `L_cen`.
    WithoutCentroid,
}

impl Row {
    /// The rows of the table.
    pub const ALL: [Self; 4] = [
        Self::Full,
        Self::WithoutSmoothness,
        Self::WithoutOrientation,
        Self::WithoutCentroid,
    ];

    /// The row as a folder is called.
    pub fn name(self) -> &'static str {
        match self {
            Self::Full => "full",
            Self::WithoutSmoothness => "without-smoothness",
            Self::WithoutOrientation => "without-orientation",
            Self::WithoutCentroid => "without-centroid",
        }
    }

    /// The settings of the row's training, which has `full` but for a part.
    pub fn settings(self, full: &EmpSettings) -> EmpSettings {
        let mut settings = full.clone();
        let weights = &mut settings.losses.weights;
        match self {
            Self::Full => {}
            Self::WithoutSmoothness => weights.smoothness = 0.0,
            Self::WithoutOrientation => weights.orientation = 0.0,
            Self::WithoutCentroid => weights.centroid = 0.0,
        }
        settings
    }
}

impl fmt::Display for Row {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Full => "EMP",
            Self::WithoutSmoothness => "w/o smoothness",
            Self::WithoutOrientation => "w/o orientation",
            Self::WithoutCentroid => "w/o centroid",
        })
    }
}

/// The table: the policy alone, then each row, under each condition. [`Display`](fmt::Display) writes Markdown.
#[derive(Clone, Debug, Serialize)]
pub struct Table {
    conditions: Vec<Condition>,
    rows: Vec<Line>,
}

#[derive(Clone, Debug, Serialize)]
struct Line {
    name: String,
    evaluations: Vec<Evaluation>,
}

/// Evaluates the weights of the rows.
///
/// # Errors
/// When weights cannot be loaded or an evaluation fails.
pub fn table(judge: &Judge, robot: &Arc<Robot>, weights: &[(Row, PathBuf)]) -> Result<Table> {
    let mut rows = vec![Line {
        name: "decoupled policy".to_owned(),
        evaluations: judge.evaluations(None)?,
    }];
    for (row, weights) in weights {
        rows.push(Line {
            name: row.to_string(),
            evaluations: judge.evaluations(Some(Emp::load(weights, Arc::clone(robot))?))?,
        });
    }
    Ok(Table {
        conditions: judge.trials().to_vec(),
        rows,
    })
}

impl Table {
    /// Writes ablation.md and ablation.json into a folder.
    ///
    /// # Errors
    /// When a file cannot be written.
    pub fn write(&self, folder: &Path) -> Result<()> {
        let json = serde_json::to_string_pretty(self)?;
        for (name, text) in [("ablation.md", self.to_string()), ("ablation.json", json)] {
            let path = folder.join(name);
            atomic::write(&path, text.as_bytes())
                .with_context(|| format!("writing {}", path.display()))?;
        }
        Ok(())
    }
}

impl fmt::Display for Table {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for (index, condition) in self.conditions.iter().enumerate() {
            writeln!(f, "{} ({} clips)\n", condition.name(), self.episodes(index))?;
            let change = LIST.iter().find(|metric| metric.name == "change");
            let headings = headings().into_iter().chain(change.map(Metric::heading));
            let headings: Vec<String> = headings.collect();
            writeln!(f, "| | {} |", headings.join(" | "))?;
            writeln!(f, "|---|{}", "---|".repeat(headings.len()))?;
            for row in &self.rows {
                let metrics = &row.evaluations[index].all.metrics;
                let (cells, change) = (metrics.cells(), metrics.change.mean);
                writeln!(f, "| {} | {} | {change:.4} |", row.name, cells.join(" | "))?;
            }
            writeln!(f)?;
        }
        Ok(())
    }
}

impl Table {
    fn episodes(&self, condition: usize) -> usize {
        let first = self.rows.first();
        first.map_or(0, |row| row.evaluations[condition].all.episodes)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::emp::settings::Preset;

    #[test]
    fn a_row_leaves_out_one_part() {
        let full = EmpSettings::preset(Preset::Paper);
        assert_eq!(Row::Full.settings(&full), full);
        for row in &Row::ALL[1..] {
            let settings = row.settings(&full);
            let left_out = [
                settings.losses.weights.smoothness,
                settings.losses.weights.orientation,
                settings.losses.weights.centroid,
            ];
            let zeros = left_out.iter().filter(|weight| **weight == 0.0).count();
            assert_eq!(zeros, 1, "{row}");
            assert_eq!(settings.losses.weights.reconstruction, 20.0);
        }
    }
}
