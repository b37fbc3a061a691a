//! The report as a page in Markdown.

use std::fmt;

use emp_models::emp::DangerGate;
use emp_sim::{metrics::Interval, suite::Condition};

use super::{Duel, EmpReport, GateRow, GroupOutcome, Match, Outcome, Row};

impl fmt::Display for EmpReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { robot, basis, .. } = self;
        writeln!(
            f,
            "{robot} on {basis}; 95 % intervals of paired differences over motions.\n"
        )?;
        self.write_hard(f)?;
        self.write_groups(f)?;
        self.write_conditions(f)?;
        self.write_under(f, Condition::Nominal)?;
        self.write_under(f, Condition::Easy)?;
        self.write_matches(f)?;
        self.write_duels(f)?;
        self.write_gates(f)
    }
}

impl EmpReport {
    fn write_hard(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(f, "### Hard conditions together\n")?;
        writeln!(
            f,
            "| controller | falls | falls cut | relL2 | mean change, rad | amplitude lost | frames changed | MJP (difference) | MSC | MBO | MUS |"
        )?;
        writeln!(f, "|---|---|---|---|---|---|---|---|---|---|---|")?;
        for row in &self.rows {
            let Outcome {
                episodes,
                falls,
                metrics,
                difference,
                ..
            } = &row.hard;
            writeln!(
                f,
                "| {} | {falls} of {episodes} | {} | {:.3} | {:.4} | {:.3} | {:.0} % | {:.3} ({:+.3}) | {} | {:.3} ({:+.3}) | {} |",
                named(row),
                cut(&row.hard),
                metrics.relative_change.mean,
                metrics.change.mean,
                metrics.amplitude_loss.mean,
                100.0 * metrics.changed_share.mean,
                metrics.mjp.mean,
                difference.mjp.mean,
                ratio(metrics.msc, difference.msc),
                metrics.mbo.mean,
                difference.mbo.mean,
                ratio(metrics.mus, difference.mus),
            )?;
        }
        writeln!(f)
    }

    fn write_groups(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Some(first) = self.rows.first() else {
            return Ok(());
        };
        writeln!(
            f,
            "### Falls by the kind of motion, hard conditions together\n"
        )?;
        let heads = first.groups.iter().map(|GroupOutcome { name, outcome }| {
            format!("{name}, {} of {}", outcome.episodes, outcome.motions)
        });
        let heads: Vec<String> = heads.collect();
        writeln!(f, "| controller | {} |", heads.join(" | "))?;
        writeln!(f, "|---|{}", "---|".repeat(heads.len()))?;
        for row in &self.rows {
            write!(f, "| {} |", named(row))?;
            for GroupOutcome { outcome, .. } in &row.groups {
                write!(f, " {}: {} |", outcome.falls, cut(outcome))?;
            }
            writeln!(f)?;
        }
        writeln!(f)
    }

    fn write_conditions(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let names = Condition::HARD.map(Condition::name);
        writeln!(f, "### Falls by condition\n")?;
        writeln!(
            f,
            "Falls, with the share of the policy's own falls that is gone.\n"
        )?;
        writeln!(f, "| controller | {} |", names.join(" | "))?;
        writeln!(f, "|---|{}", "---|".repeat(names.len()))?;
        for row in &self.rows {
            write!(f, "| {} |", named(row))?;
            for outcome in Condition::HARD
                .into_iter()
                .filter_map(|condition| row.under(condition))
            {
                write!(f, " {}: {} |", outcome.falls, cut(outcome))?;
            }
            writeln!(f)?;
        }
        writeln!(f)
    }

    fn write_under(&self, f: &mut fmt::Formatter<'_>, condition: Condition) -> fmt::Result {
        writeln!(f, "### The {} condition\n", condition.name())?;
        writeln!(
            f,
            "Each metric with its difference from the policy's own; MSC and MUS as multiples of it.\n"
        )?;
        writeln!(
            f,
            "| controller | SUC | MJP | MSC | MBO | MBV | MBA | MUS | mean change, rad | relL2 |"
        )?;
        writeln!(f, "|---|---|---|---|---|---|---|---|---|---|")?;
        for row in &self.rows {
            let Some(outcome) = row.under(condition) else {
                continue;
            };
            let (metrics, difference) = (&outcome.metrics, &outcome.difference);
            writeln!(
                f,
                "| {} | {} | {} | {} | {} | {} | {} | {} | {:.4} | {:.3} |",
                named(row),
                differing(metrics.suc, difference.suc),
                differing(metrics.mjp, difference.mjp),
                ratio(metrics.msc, difference.msc),
                differing(metrics.mbo, difference.mbo),
                differing(metrics.mbv, difference.mbv),
                differing(metrics.mba, difference.mba),
                ratio(metrics.mus, difference.mus),
                metrics.change.mean,
                metrics.relative_change.mean,
            )?;
        }
        writeln!(f)
    }

    fn write_matches(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if self.matches.is_empty() {
            return Ok(());
        }
        writeln!(
            f,
            "### What each family takes where it cuts as many falls\n"
        )?;
        writeln!(
            f,
            "The EMP's figure / the family's, read off between the family's members, hard conditions together.\n"
        )?;
        writeln!(f, "| EMP | family | relL2 | mean change, rad | MJP |")?;
        writeln!(f, "|---|---|---|---|---|")?;
        for Match {
            emp,
            family,
            ours,
            theirs,
        } in &self.matches
        {
            write!(f, "| **{emp}** | {family} |")?;
            match theirs {
                Some(theirs) => writeln!(
                    f,
                    " {:.3} / {:.3} | {:.4} / {:.4} | {:.3} / {:.3} |",
                    ours.relative_change,
                    theirs.relative_change,
                    ours.change,
                    theirs.change,
                    ours.mjp,
                    theirs.mjp
                )?,
                None => writeln!(f, " never cuts as many | | |")?,
            }
        }
        writeln!(f)
    }

    fn write_duels(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if self.duels.is_empty() {
            return Ok(());
        }
        writeln!(
            f,
            "### Each EMP against each filter, hard conditions together\n"
        )?;
        writeln!(
            f,
            "The EMP's figures minus the filter's on the same episodes; fewer falls, less change and more MJP are better.\n"
        )?;
        writeln!(
            f,
            "| EMP | filter | falls, points | relL2 | mean change, rad | MJP |"
        )?;
        writeln!(f, "|---|---|---|---|---|---|")?;
        for Duel {
            emp,
            filter,
            difference,
        } in &self.duels
        {
            let Interval { mean, low, high } = difference.suc;
            let [mean, low, high] = [-mean, -high, -low].map(|share| 100.0 * share);
            writeln!(
                f,
                "| **{emp}** | {filter} | {mean:+.1} ({low:+.1} to {high:+.1}) | {} | {} | {} |",
                interval(difference.relative_change),
                interval(difference.change),
                interval(difference.mjp),
            )?;
        }
        writeln!(f)
    }

    fn write_gates(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Some(first) = self.gates.first() else {
            return Ok(());
        };
        writeln!(f, "### Danger gates of {}\n", first.emp)?;
        writeln!(
            f,
            "Missed: falls in episodes in which the EMP stands when it is always on. Too late: falls before which the gate opened \
             less than 15 control periods, or not at all.\n"
        )?;
        writeln!(
            f,
            "| gate | threshold | nominal SUC | nominal MJP (difference) | frames acting, nominal | hard: falls | falls cut | MJP (difference) | frames acting | missed | too late |"
        )?;
        writeln!(f, "|---|---|---|---|---|---|---|---|---|---|---|")?;
        for GateRow {
            gate,
            origin,
            nominal,
            hard,
            missed,
            too_late,
            ..
        } in &self.gates
        {
            let late = gate.map_or_else(|| "–".to_owned(), |_| too_late.to_string());
            writeln!(
                f,
                "| {} | {origin} | {:.3} | {:.3} ({:+.4}) | {:.0} % | {} of {} | {} | {:.3} ({:+.4}) | {:.0} % | {missed} | {late} |",
                threshold(*gate),
                nominal.metrics.suc.mean,
                nominal.metrics.mjp.mean,
                nominal.difference.mjp.mean,
                100.0 * nominal.metrics.changed_share.mean,
                hard.falls,
                hard.episodes,
                cut(hard),
                hard.metrics.mjp.mean,
                hard.difference.mjp.mean,
                100.0 * hard.metrics.changed_share.mean,
            )?;
        }
        writeln!(f)
    }
}

fn named(row: &Row) -> String {
    if row.learned {
        format!("**{}**", row.name)
    } else {
        row.name.clone()
    }
}

fn threshold(gate: Option<DangerGate>) -> String {
    match gate {
        None => "none".to_owned(),
        Some(DangerGate::Regloss(limit)) => format!("regloss {limit:.5}"),
        Some(DangerGate::Tilt(limit)) => format!("tilt {limit:.3} rad"),
    }
}

/// The share of falls that is gone, in per cent with its interval.
fn cut(outcome: &Outcome) -> String {
    outcome.falls_cut.map_or_else(
        || "–".to_owned(),
        |Interval { mean, low, high }| {
            let [mean, low, high] = [mean, low, high].map(|share| 100.0 * share);
            format!("{mean:.0} % ({low:.0} to {high:.0})")
        },
    )
}

fn differing(metric: Interval, difference: Interval) -> String {
    let Interval { mean, low, high } = difference;
    format!("{:.3} ({mean:+.4}, {low:+.4} to {high:+.4})", metric.mean)
}

fn interval(Interval { mean, low, high }: Interval) -> String {
    format!("{mean:+.4} ({low:+.4} to {high:+.4})")
}

/// A metric as a multiple of the policy's own.
fn ratio(metric: Interval, difference: Interval) -> String {
    let own = metric.mean - difference.mean;
    if own > 0.0 {
        format!("{:.2} ×", metric.mean / own)
    } else {
        format!("{:.2}", metric.mean)
    }
}
