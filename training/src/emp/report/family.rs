//! What an EMP has to beat.

use crate::emp::settings::{EmpSettings, HindsightSettings, Preset, Remedy};

/// Filters that need no learning: the name of a family, and its members from mild to strong.
pub struct Family {
    /// Its name.
    pub name: String,
    /// Specifications of [`emp_models::filters`].
    pub members: Vec<String>,
}

impl Family {
    /// Those that every EMP has to beat. `knee` are the parameters of a soft knee but for its slope.
    pub fn usual(knee: &str) -> Vec<Self> {
        let family = |name: &str, members: &[String]| Self {
            name: name.to_owned(),
            members: members.to_vec(),
        };
        let each = |values: &[&str], specification: &str| -> Vec<String> {
            values
                .iter()
                .map(|value| format!("{specification}={value}"))
                .collect()
        };
        vec![
            family(
                "uniform cut",
                &each(
                    &["0.95", "0.9", "0.85", "0.8", "0.7"],
                    "amplitude-cut:factor",
                ),
            ),
            family(
                "low-pass",
                &each(&["3", "2", "1.4", "1", "0.7"], "low-pass:cutoff"),
            ),
            family(
                "velocity limit",
                &each(&["4", "3", "2", "1.5", "1"], "velocity-limit:limit"),
            ),
            family(
                "velocity limit, waist and shoulders",
                &each(
                    &["4", "3", "2", "1.5", "1"],
                    "velocity-limit:joints=waist+shoulder,limit",
                ),
            ),
            family("the EMP's own remedies", &Self::remedies()),
            family(
                "static clamp",
                &each(&["0.03", "0.05", "0.06", "0.07"], "static-clamp:margin"),
            ),
            family(
                "soft knee",
                &each(
                    &["0.8", "0.6", "0.4", "0.2", "0"],
                    &format!("soft-knee:{knee},slope"),
                ),
            ),
        ]
    }

    /// What the default EMP's training tries against falls, as plain filters.
    fn remedies() -> Vec<String> {
        let HindsightSettings { against_falls, .. } =
            EmpSettings::preset(Preset::Default).hindsight;
        against_falls.iter().map(Remedy::filter).collect()
    }
}
