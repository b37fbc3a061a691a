//! The report as a page in Markdown.

use std::fmt;

use super::{CutFalls, Directions, FallReport, Falls, LEADS, OperatingPoint, Reaches, Signal};

impl fmt::Display for FallReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { robot, basis, .. } = self;
        writeln!(f, "{robot} on {basis}.\n")?;
        self.write_falls(f)?;
        self.write_reach(f)?;
        self.write_cuts(f)?;
        self.write_signals(f)?;
        self.write_operating_points(f)
    }
}

impl FallReport {
    /// Each condition by name, then all.
    fn rows(&self) -> impl Iterator<Item = (&str, &Falls)> {
        let named = |falls| (falls_name(falls), falls);
        let all = (!self.conditions.is_empty()).then_some(("**all**", &self.all));
        self.conditions.iter().map(named).chain(all)
    }

    fn write_falls(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(
            f,
            "| condition | episodes | falls | forward | backward | left | right | with mirrored goals: left | right | p99 of the tilt where it stands, rad | seconds from there to the fall, median |"
        )?;
        writeln!(f, "|---|---|---|---|---|---|---|---|---|---|---|")?;
        for (name, falls) in self.rows() {
            let mirrored = falls.mirrored;
            let Directions {
                forward,
                backward,
                left,
                right,
            } = falls.directions;
            writeln!(
                f,
                "| {name} | {} | {} ({:.1} %) | {forward} | {backward} | {left} | {right} | {} | {} | {} | {} |",
                falls.episodes,
                falls.falls,
                100.0 * falls.falls as f64 / falls.episodes.max(1) as f64,
                mirrored.left,
                mirrored.right,
                number(falls.tilted),
                number(falls.seconds_from_tilt),
            )?;
        }
        writeln!(f)
    }

    fn write_reach(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (first, last) = (LEADS[0].0, LEADS[LEADS.len() - 1].1);
        writeln!(
            f,
            "Where the goals have the hands: share of the {first} to {last} frames before a fall / of all frames.\n"
        )?;
        writeln!(f, "| condition | {} |", Reaches::<f64>::NAMES.join(" | "))?;
        writeln!(f, "|---|---|---|---|---|---|---|")?;
        for (name, falls) in self.rows() {
            write!(f, "| {name} ")?;
            let pairs = falls
                .reach_before
                .array()
                .into_iter()
                .zip(falls.reach_ever.array());
            for (before, ever) in pairs {
                write!(f, "| {:.0} % / {:.0} % ", 100.0 * before, 100.0 * ever)?;
            }
            writeln!(f, "|")?;
        }
        writeln!(f)
    }

    fn write_cuts(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if self.all.cuts.is_empty() {
            return Ok(());
        }
        let conditions: Vec<&str> = self.conditions.iter().map(falls_name).collect();
        writeln!(
            f,
            "Falls with one thing cut by a fifth about the default pose, on the same seeds.\n"
        )?;
        writeln!(
            f,
            "| cut | {} | all | change of the share of falls (95 %, paired) |",
            conditions.join(" | ")
        )?;
        writeln!(f, "|---|{}---|---|", "---|".repeat(conditions.len()))?;
        write!(f, "| nothing |")?;
        for falls in &self.conditions {
            write!(f, " {} |", falls.falls)?;
        }
        writeln!(f, " {} | |", self.all.falls)?;
        for (
            index,
            CutFalls {
                name,
                falls,
                change,
            },
        ) in self.all.cuts.iter().enumerate()
        {
            write!(f, "| {name} |")?;
            for condition in &self.conditions {
                write!(f, " {} |", condition.cuts[index].falls)?;
            }
            let [mean, low, high] = [change.mean, change.low, change.high].map(|x| 100.0 * x);
            writeln!(
                f,
                " {falls} | {mean:+.1} ({low:+.1} to {high:+.1}) points |"
            )?;
        }
        writeln!(f)
    }

    fn write_signals(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(
            f,
            "How well a number tells frames before a fall from those of episodes without one (AUROC, the conditions' means \
             weighted by frames), by frames before the fall.\n"
        )?;
        let leads = LEADS.map(|(from, to)| format!("{from}–{to}"));
        writeln!(f, "| number | {} |", leads.join(" | "))?;
        writeln!(f, "|---|---|---|---|")?;
        for Signal { name, auroc, .. } in &self.all.signals {
            let areas = auroc.map(number);
            writeln!(f, "| {name} | {} |", areas.join(" | "))?;
        }
        writeln!(f)
    }

    fn write_operating_points(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(
            f,
            "Centre of mass from the feet's middle while the robot stands, cm forward / left (standard deviation).\n"
        )?;
        writeln!(f, "| condition | measured | static, of the goal |")?;
        writeln!(f, "|---|---|---|")?;
        let rows = self.rows().map(|(name, falls)| (name, falls.standing));
        for (name, point) in [("nominal", Some(self.nominal))].into_iter().chain(rows) {
            let Some(point) = point else { continue };
            let OperatingPoint {
                measured,
                measured_deviation,
                quasi_static,
                quasi_static_deviation,
            } = point;
            writeln!(
                f,
                "| {name} | {} | {} |",
                centimetres(measured, measured_deviation),
                centimetres(quasi_static, quasi_static_deviation)
            )?;
        }
        Ok(())
    }
}

fn falls_name(falls: &Falls) -> &str {
    falls.conditions.first().copied().unwrap_or_default()
}

fn number(value: Option<f64>) -> String {
    value.map_or_else(|| "–".to_owned(), |value| format!("{value:.2}"))
}

fn centimetres(mean: [f64; 2], deviation: [f64; 2]) -> String {
    let [x, y, dx, dy] =
        [mean[0], mean[1], deviation[0], deviation[1]].map(|metres| 100.0 * metres);
    format!("{x:+.2} ({dx:.2}) / {y:+.2} ({dy:.2})")
}
