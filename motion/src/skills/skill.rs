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
    /// Throwing one hand or both overhead.
    RaiseHands,
    /// Good-bye, with one hand or both.
    GoodBye,
    /// Boxing: combinations of punches.
    Box,
    /// Throwing a ball.
    Throw,
    /// Drumming.
    Drum,
    /// Conducting an orchestra.
    Conduct,
    /// Chopping wood.
    Chop,
    /// The arms of a swimmer.
    Swim,
    /// The arms of a dancer.
    Dance,
    /// The arms of jumping jacks.
    JumpingJack,
    /// Showing the way and pointing.
    Guide,
    /// Arms folded in front of the chest.
    CrossArms,
    /// Hands on the hips.
    HandsOnHips,
}

impl Skill {
    /// The skills of a medley: an everyday tour, in this order.
    pub const MEDLEY: [Self; 17] = [
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

    /// All skills.
    pub const ALL: [Self; 30] = [
        Self::Idle,
        Self::Wave,
        Self::ReachFront,
        Self::Hammer,
        Self::RaiseHands,
        Self::Drink,
        Self::Box,
        Self::ReachOverhead,
        Self::ScrewLightBulb,
        Self::Throw,
        Self::Clap,
        Self::Drum,
        Self::Punch,
        Self::GoodBye,
        Self::ReachSide,
        Self::Conduct,
        Self::WipeWindow,
        Self::Dance,
        Self::LiftBox,
        Self::Swim,
        Self::CombHair,
        Self::JumpingJack,
        Self::DirectTraffic,
        Self::Guide,
        Self::ReachLow,
        Self::Chop,
        Self::ArmCircles,
        Self::CrossArms,
        Self::RandomReaches,
        Self::HandsOnHips,
    ];

    /// The skills of lively people: half of a library.
    pub const LIVELY: [Self; 15] = [
        Self::Wave,
        Self::Box,
        Self::RaiseHands,
        Self::Throw,
        Self::Dance,
        Self::Drum,
        Self::JumpingJack,
        Self::GoodBye,
        Self::Chop,
        Self::Conduct,
        Self::Swim,
        Self::Clap,
        Self::Guide,
        Self::CrossArms,
        Self::HandsOnHips,
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
            Self::RaiseHands => "raise-hands",
            Self::GoodBye => "good-bye",
            Self::Box => "box",
            Self::Throw => "throw",
            Self::Drum => "drum",
            Self::Conduct => "conduct",
            Self::Chop => "chop",
            Self::Swim => "swim",
            Self::Dance => "dance",
            Self::JumpingJack => "jumping-jack",
            Self::Guide => "guide",
            Self::CrossArms => "cross-arms",
            Self::HandsOnHips => "hands-on-hips",
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
                | Self::RaiseHands
                | Self::GoodBye
                | Self::HandsOnHips
        )
    }
}
