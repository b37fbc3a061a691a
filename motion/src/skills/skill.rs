//! The skills by name.

/// Something a person does with the upper body.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Skill {
    /// Blows with a hammer at waist height.
    Hammer,
    /// Screwing in a light bulb overhead.
    ScrewLightBulb,
    /// Waving with a raised hand or both.
    Wave,
    /// Drinking from a cup that stands on a table.
    Drink,
    /// Wiping a window with a flat hand or both.
    WipeWindow,
    /// Punching with both fists in turn.
    Punch,
    /// Clapping in front of the chest.
    Clap,
    /// Reaching forward.
    ReachFront,
    /// Reaching sideways.
    ReachSide,
    /// Reaching up.
    ReachOverhead,
    /// Reaching down in front of the legs.
    ReachLow,
    /// Lifting a box with both hands.
    LiftBox,
    /// Directing traffic: stop, point, beckon.
    DirectTraffic,
    /// Combing the hair.
    CombHair,
    /// Circling with stretched arms.
    ArmCircles,
    /// Standing at ease.
    Idle,
    /// Reaching to random places all over the reachable space.
    RandomReaches,
}

impl Skill {
    /// All skills, in the order of a medley.
    pub const ALL: [Self; 17] = [
        Self::Idle,
        Self::Wave,
        Self::ReachFront,
        Self::Hammer,
        Self::Drink,
        Self::ReachOverhead,
        Self::ScrewLightBulb,
        Self::Clap,
        Self::Punch,
        Self::ReachSide,
        Self::WipeWindow,
        Self::LiftBox,
        Self::CombHair,
        Self::DirectTraffic,
        Self::ReachLow,
        Self::ArmCircles,
        Self::RandomReaches,
    ];

    /// The skill's name in clips and on the command line.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Hammer => "hammer",
            Self::ScrewLightBulb => "screw-light-bulb",
            Self::Wave => "wave",
            Self::Drink => "drink",
            Self::WipeWindow => "wipe-window",
            Self::Punch => "punch",
            Self::Clap => "clap",
            Self::ReachFront => "reach-front",
            Self::ReachSide => "reach-side",
            Self::ReachOverhead => "reach-overhead",
            Self::ReachLow => "reach-low",
            Self::LiftBox => "lift-box",
            Self::DirectTraffic => "direct-traffic",
            Self::CombHair => "comb-hair",
            Self::ArmCircles => "arm-circles",
            Self::Idle => "idle",
            Self::RandomReaches => "random-reaches",
        }
    }

    /// The skills that both arms may do at once in the same way.
    pub(super) fn allows_both_arms(self) -> bool {
        matches!(
            self,
            Self::Wave
                | Self::WipeWindow
                | Self::ReachFront
                | Self::ReachSide
                | Self::ReachOverhead
                | Self::ReachLow
                | Self::ArmCircles
                | Self::RandomReaches
        )
    }
}
