//! What a person does in each skill, as moves and cycles of a [`Timeline`].
//!
//! Hand places are in arm lengths from the shoulder, (forward, outward, up); angles in radians; see [`ArmPose`].

use std::f64::consts::TAU;

use nalgebra::Vector3;
use rand::RngExt;
use rand_chacha::ChaCha8Rng;

use super::body::{ArmPose, Pose};
use super::lively;
use super::performance::Performance;
use super::skill::Skill;
use super::timeline::Timeline;
use crate::Side;

/// Appends a skill to the timeline. It begins at the timeline's current pose and ends in a pose of its own.
pub(super) fn perform(skill: Skill, time: &mut Timeline, how: &Performance, rng: &mut ChaCha8Rng) {
    match skill {
        Skill::Hammer => hammer(time, how, rng),
        Skill::ScrewLightBulb => screw_light_bulb(time, how, rng),
        Skill::Wave => wave(time, how, rng),
        Skill::Drink => drink(time, how, rng),
        Skill::WipeWindow => wipe_window(time, how, rng),
        Skill::Punch => punch(time, how, rng),
        Skill::Clap => clap(time, how, rng),
        Skill::ReachFront => reach(time, how, rng, &Zone::FRONT),
        Skill::ReachSide => reach(time, how, rng, &Zone::SIDE),
        Skill::ReachOverhead => reach(time, how, rng, &Zone::OVERHEAD),
        Skill::ReachLow => reach(time, how, rng, &Zone::LOW),
        Skill::LiftBox => lift_box(time, how, rng),
        Skill::DirectTraffic => direct_traffic(time, how, rng),
        Skill::CombHair => comb_hair(time, how, rng),
        Skill::ArmCircles => arm_circles(time, how, rng),
        Skill::Idle => idle(time, how, rng),
        Skill::RandomReaches => random_reaches(time, how, rng),
        Skill::RaiseHands => lively::raise_hands(time, how, rng),
        Skill::GoodBye => lively::good_bye(time, how, rng),
        Skill::Box => lively::box_combination(time, how, rng),
        Skill::Throw => lively::throw(time, how, rng),
        Skill::Drum => lively::drum(time, how, rng),
        Skill::Conduct => lively::conduct(time, how, rng),
        Skill::Chop => lively::chop(time, how, rng),
        Skill::Swim => lively::swim(time, how, rng),
        Skill::Dance => lively::dance(time, how, rng),
        Skill::JumpingJack => lively::jumping_jack(time, how, rng),
        Skill::Guide => lively::guide(time, how, rng),
        Skill::CrossArms => lively::cross_arms(time, how, rng),
        Skill::HandsOnHips => lively::hands_on_hips(time, how, rng),
    }
}

/// Blows onto something at waist height: slow up, fast down, the wrist cocked on the way.
fn hammer(time: &mut Timeline, how: &Performance, rng: &mut ChaCha8Rng) {
    let side = how.side();
    let anvil = ArmPose::at(
        rng.random_range(0.55..0.65),
        rng.random_range(-0.15..0.1),
        rng.random_range(-0.45..-0.3),
    );
    time.move_to(
        Pose::rest()
            .with_arm(side, anvil.turned(0.1, 0.0, -0.2))
            .with_yaw(0.15 * how.turn()),
        1.2 * how.tempo,
    );
    let lift = rng.random_range(0.45..0.65);
    let (seconds, rate) = how.cycles(rng, 2.0, 4.0..7.0, 1.1);
    time.cycle(seconds, |t, strength, pose| {
        let phase = TAU * rate * t;
        let raised = strength * 0.5 * (1.0 - (phase - 0.45 * phase.sin()).cos());
        let arm = &mut pose.arms[side as usize];
        arm.hand += Vector3::new(-0.22 * raised, 0.12 * raised, lift * raised);
        arm.deviation += 0.5 * raised;
        arm.swivel += 0.2 * raised;
    });
}

/// A hand overhead turns to and fro about the forearm.
fn screw_light_bulb(time: &mut Timeline, how: &Performance, rng: &mut ChaCha8Rng) {
    let side = how.side();
    let bulb = ArmPose::at(
        rng.random_range(0.3..0.5),
        rng.random_range(-0.05..0.2),
        rng.random_range(0.68..0.78),
    );
    time.move_to(
        Pose::rest().with_arm(side, bulb.swivel(0.2)),
        1.3 * how.tempo,
    );
    let (seconds, rate) = how.cycles(rng, 2.0, 4.0..7.0, 1.0);
    time.cycle(seconds, |t, strength, pose| {
        let arm = &mut pose.arms[side as usize];
        arm.pronation += 1.15 * strength * (TAU * rate * t).sin();
        arm.hand += Vector3::new(0.02, 0.02, 0.03) * strength * (TAU * rate * t).cos();
    });
}

/// A raised open hand swings from side to side.
fn wave(time: &mut Timeline, how: &Performance, rng: &mut ChaCha8Rng) {
    let raised = ArmPose::at(
        rng.random_range(0.2..0.35),
        rng.random_range(0.45..0.55),
        rng.random_range(0.35..0.55),
    );
    let raised = raised
        .swivel(rng.random_range(0.2..0.5))
        .turned(0.3, -0.1, 0.0);
    time.move_to(Pose::rest().with_arms(&how.sides, raised), 1.8 * how.tempo);
    // From leisurely and wide to quick, 0.8 to 2.5 times a second.
    let swing = rng.random_range(0.16..0.5);
    let hertz = rng.random_range(0.85..2.3);
    let (seconds, rate) = how.cycles(rng, 2.5, 4.0..8.0, hertz);
    time.cycle(seconds, |t, strength, pose| {
        let wave = strength * (TAU * rate * t).sin();
        for side in &how.sides {
            let arm = &mut pose.arms[*side as usize];
            arm.hand += Vector3::new(0.0, swing * wave, -0.3 * swing * wave);
            arm.deviation -= 0.3 * wave;
        }
    });
}

/// A cup is fetched from a table, brought to the mouth, tilted and put back.
fn drink(time: &mut Timeline, how: &Performance, rng: &mut ChaCha8Rng) {
    let side = how.side();
    let inward = how.body.half_breadth();
    let table = ArmPose::at(
        rng.random_range(0.5..0.7),
        rng.random_range(-0.2..0.1),
        rng.random_range(-0.5..-0.35),
    );
    let mouth = ArmPose::at(
        rng.random_range(0.42..0.48),
        0.12 - inward,
        rng.random_range(0.2..0.26),
    )
    .swivel(0.35);
    for _ in 0..how.repeats(rng, 3) {
        time.move_to(
            Pose::rest().with_arm(side, table.turned(0.1, 0.0, 0.0)),
            0.9 * how.tempo,
        );
        time.move_to(
            Pose::rest().with_arm(side, mouth.turned(0.1, 0.2, 0.0)),
            0.9 * how.tempo,
        );
        // Tilting: the elbow rises, and the cup with it.
        let tilted = mouth.swivel(0.9).turned(0.7, 0.3, 0.25);
        time.move_to(Pose::rest().with_arm(side, tilted), 0.5 * how.tempo);
        time.hold(if how.brief {
            0.2
        } else {
            rng.random_range(0.4..1.2)
        });
        time.move_to(
            Pose::rest().with_arm(side, mouth.turned(0.1, 0.2, 0.0)),
            0.5 * how.tempo,
        );
        time.move_to(
            Pose::rest().with_arm(side, table.turned(0.1, 0.0, 0.0)),
            0.9 * how.tempo,
        );
    }
}

/// A flat hand, palm forward, draws circles or strokes on a pane.
fn wipe_window(time: &mut Timeline, how: &Performance, rng: &mut ChaCha8Rng) {
    let centre = ArmPose::at(
        rng.random_range(0.6..0.7),
        rng.random_range(-0.05..0.15),
        rng.random_range(0.1..0.3),
    );
    let centre = centre.swivel(0.3).turned(1.2, -0.8, 0.0);
    time.move_to(Pose::rest().with_arms(&how.sides, centre), 1.3 * how.tempo);
    let (width, height) = (rng.random_range(0.16..0.28), rng.random_range(0.08..0.24));
    let (seconds, rate) = how.cycles(rng, 1.5, 3.0..6.0, 0.8);
    time.cycle(seconds, |t, strength, pose| {
        let (sin, cos) = (TAU * rate * t).sin_cos();
        for side in &how.sides {
            let outward = if *side == Side::Left { 1.0 } else { -1.0 };
            let arm = &mut pose.arms[*side as usize];
            arm.hand += Vector3::new(0.0, outward * width * sin, height * cos) * strength;
            arm.deviation += 0.2 * outward * strength * sin;
        }
        pose.yaw += 0.08 * strength * sin;
    });
}

/// From a guard in front of the face, fists shoot forward in turn, palms turning down, shoulders following.
fn punch(time: &mut Timeline, how: &Performance, rng: &mut ChaCha8Rng) {
    let inward = how.body.half_breadth();
    let guard = ArmPose::at(0.42, 0.10 - inward, 0.08)
        .swivel(-0.1)
        .turned(0.1, 0.0, 0.0);
    let guarding = Pose::rest().with_arms(&Side::BOTH, guard);
    time.move_to(guarding, 1.6 * how.tempo);
    let peak = rng.random_range(2.8..3.8);
    for _ in 0..how.repeats(rng, 4) {
        for side in Side::BOTH {
            let target = ArmPose::at(0.92, 0.08 - inward, rng.random_range(-0.1..0.15))
                .swivel(0.4)
                .turned(1.3, 0.0, 0.0);
            let follow = if side == Side::Left { -0.35 } else { 0.35 };
            time.move_to(guarding.with_arm(side, target).with_yaw(follow), peak);
            time.move_to(guarding, 0.7 * peak);
        }
        if !how.brief {
            time.hold(rng.random_range(0.0..0.5));
        }
    }
}

/// Palms face each other in front of the chest and meet.
fn clap(time: &mut Timeline, how: &Performance, rng: &mut ChaCha8Rng) {
    let inward = how.body.half_breadth();
    // Wrists stay a hand's thickness from the middle when the palms meet.
    let meeting = ArmPose::at(
        rng.random_range(0.5..0.62),
        0.075 - inward,
        rng.random_range(-0.2..0.0),
    );
    let height = rng.random_range(-0.1..0.1);
    time.move_to(
        Pose::rest().with_arms(&Side::BOTH, meeting.turned(0.1, 0.0, 0.1)),
        1.3 * how.tempo,
    );
    let opening = rng.random_range(0.2..0.32);
    let hertz = rng.random_range(1.4..3.0);
    let (seconds, rate) = how.cycles(rng, 3.0, 5.0..10.0, hertz);
    time.cycle(seconds, |t, strength, pose| {
        let open = 0.5 * strength * (1.0 - (TAU * rate * t).cos());
        for arm in &mut pose.arms {
            arm.hand += Vector3::new(-0.05 * open, opening * open, height * open);
        }
    });
}

/// A part of the reachable space, as ranges of azimuth (outward positive), elevation and distance (arm lengths).
struct Zone {
    azimuth: [f64; 2],
    elevation: [f64; 2],
    distance: [f64; 2],
}

impl Zone {
    const FRONT: Self = Self {
        azimuth: [-0.4, 0.5],
        elevation: [-0.4, 0.4],
        distance: [0.75, 0.97],
    };
    const SIDE: Self = Self {
        azimuth: [0.9, 1.7],
        elevation: [-0.4, 0.5],
        distance: [0.75, 0.97],
    };
    const OVERHEAD: Self = Self {
        azimuth: [-0.2, 1.2],
        elevation: [0.9, 1.4],
        distance: [0.75, 0.97],
    };
    const LOW: Self = Self {
        azimuth: [-0.2, 1.0],
        elevation: [-1.2, -0.75],
        distance: [0.8, 0.97],
    };
    const ACROSS: Self = Self {
        azimuth: [-1.1, -0.5],
        elevation: [-0.5, 0.5],
        distance: [0.6, 0.92],
    };
    const NEAR: Self = Self {
        azimuth: [-0.7, 1.0],
        elevation: [-0.9, 0.8],
        distance: [0.42, 0.75],
    };
    /// Everything that a hand reaches in front of, beside, over and under the shoulder.
    const ALL: [Self; 6] = [
        Self::FRONT,
        Self::SIDE,
        Self::OVERHEAD,
        Self::LOW,
        Self::ACROSS,
        Self::NEAR,
    ];

    fn sample(&self, rng: &mut ChaCha8Rng) -> Vector3<f64> {
        let mut draw = |[low, high]: [f64; 2]| rng.random_range(low..high);
        let (azimuth, elevation, distance) = (
            draw(self.azimuth),
            draw(self.elevation),
            draw(self.distance),
        );
        let (sin, cos) = elevation.sin_cos();
        Vector3::new(cos * azimuth.cos(), cos * azimuth.sin(), sin) * distance
    }
}

/// Reaches into one zone and back, several times.
fn reach(time: &mut Timeline, how: &Performance, rng: &mut ChaCha8Rng, zone: &Zone) {
    for _ in 0..how.repeats(rng, 4) {
        let arm = ArmPose {
            hand: zone.sample(rng),
            ..ArmPose::rest()
        };
        let arm = arm.swivel(rng.random_range(-0.1..0.3)).turned(
            rng.random_range(-0.2..1.0),
            rng.random_range(-0.3..0.3),
            0.0,
        );
        let speed = rng.random_range(0.9..1.8) * how.tempo;
        let yaw = if how.sides.len() == 2 {
            0.0
        } else {
            rng.random_range(0.0..0.35) * how.turn()
        };
        time.move_to(Pose::rest().with_arms(&how.sides, arm).with_yaw(yaw), speed);
        time.hold(if how.brief {
            0.15
        } else {
            rng.random_range(0.1..0.8)
        });
        if !how.brief {
            let back = ArmPose::at(0.5, 0.1, -0.6).turned(0.4, 0.0, 0.0);
            time.move_to(Pose::rest().with_arms(&how.sides, back), speed);
        }
    }
}

/// Both hands take a box from below, raise it to the chest and onto a shelf.
fn lift_box(time: &mut Timeline, how: &Performance, rng: &mut ChaCha8Rng) {
    let outward = rng.random_range(0.16..0.30) - how.body.half_breadth();
    let lean = rng.random_range(0.1..0.3);
    let carrying = |forward: f64, up: f64| {
        let arm = ArmPose::at(forward, outward, up).turned(0.1, -0.2, 0.0);
        Pose::rest().with_arms(&Side::BOTH, arm)
    };
    let low = Pose {
        lean,
        ..carrying(0.5, -0.75)
    };
    let shelf = carrying(0.62, rng.random_range(0.3..0.55));
    let speed = 1.0 * how.tempo;
    for _ in 0..how.repeats(rng, 2) {
        time.move_to(low, 1.2 * speed);
        time.hold(0.2);
        time.move_to(carrying(0.5, -0.2), speed);
        time.move_to(shelf, speed);
        time.hold(if how.brief {
            0.1
        } else {
            rng.random_range(0.2..0.6)
        });
        if !how.brief {
            time.move_to(carrying(0.5, -0.2), speed);
        }
    }
}

/// One palm says stop, the other arm points aside, then beckons the traffic through.
fn direct_traffic(time: &mut Timeline, how: &Performance, rng: &mut ChaCha8Rng) {
    let side = how.side();
    let other = if side == Side::Left {
        Side::Right
    } else {
        Side::Left
    };
    let stop = ArmPose::at(0.92, 0.0, rng.random_range(0.05..0.25))
        .swivel(0.2)
        .turned(1.2, -1.0, 0.0);
    let aside = ArmPose::at(0.15, 0.94, rng.random_range(-0.05..0.1)).turned(0.4, 0.0, 0.0);
    let beckoning = ArmPose::at(0.35, 0.35, 0.25).turned(-0.4, 0.2, 0.0);
    for _ in 0..how.repeats(rng, 3) {
        let stopping = Pose::rest().with_arm(side, stop);
        time.move_to(stopping, 1.8 * how.tempo);
        let pointing = stopping.with_arm(other, aside).with_yaw(-0.2 * how.turn());
        time.move_to(pointing, 1.8 * how.tempo);
        time.hold(if how.brief {
            0.1
        } else {
            rng.random_range(0.3..1.0)
        });
        for _ in 0..if how.brief { 1 } else { 2 } {
            time.move_to(pointing.with_arm(other, beckoning), 2.0 * how.tempo);
            time.move_to(pointing, 2.0 * how.tempo);
        }
    }
}

/// A hand strokes over the head from forehead to nape, elbow raised.
fn comb_hair(time: &mut Timeline, how: &Performance, rng: &mut ChaCha8Rng) {
    let side = how.side();
    let inward = how.body.half_breadth();
    let forehead = ArmPose::at(0.34, 0.12 - inward, rng.random_range(0.52..0.6))
        .swivel(0.9)
        .turned(0.9, 0.2, 0.0);
    let nape = ArmPose::at(-0.08, 0.30 - inward, rng.random_range(0.45..0.52))
        .swivel(0.6)
        .turned(0.6, 0.3, 0.1);
    for _ in 0..how.repeats(rng, 5) {
        time.move_to(Pose::rest().with_arm(side, forehead), 1.3 * how.tempo);
        time.move_to(Pose::rest().with_arm(side, nape), 0.6 * how.tempo);
    }
}

/// Straight arms at shoulder height draw circles.
fn arm_circles(time: &mut Timeline, how: &Performance, rng: &mut ChaCha8Rng) {
    let aside = ArmPose::at(0.2, 0.88, 0.0).turned(0.5, 0.0, 0.0);
    time.move_to(Pose::rest().with_arms(&how.sides, aside), 1.8 * how.tempo);
    let radius = rng.random_range(0.22..0.40);
    let direction = if rng.random_bool(0.5) { 1.0 } else { -1.0 };
    let (seconds, rate) = how.cycles(rng, 2.0, 3.0..6.0, 0.8);
    time.cycle(seconds, |t, strength, pose| {
        let (sin, cos) = (TAU * rate * t * direction).sin_cos();
        for side in &how.sides {
            let hand = &mut pose.arms[*side as usize].hand;
            let length = hand.norm();
            *hand += Vector3::new(sin, 0.0, cos) * radius * strength;
            *hand *= length / hand.norm();
        }
    });
}

/// Standing at ease: small turns of the trunk, hands that wander a little.
fn idle(time: &mut Timeline, how: &Performance, rng: &mut ChaCha8Rng) {
    for _ in 0..if how.brief { 2 } else { rng.random_range(3..7) } {
        let mut pose = Pose::rest().with_yaw(rng.random_range(-0.15..0.15));
        for arm in &mut pose.arms {
            arm.hand += Vector3::new(
                rng.random_range(0.0..0.3),
                rng.random_range(-0.02..0.08),
                rng.random_range(0.0..0.15),
            );
            arm.pronation += rng.random_range(-0.2..0.6);
        }
        time.move_to(pose, rng.random_range(0.25..0.5) * how.tempo);
        time.hold(if how.brief {
            0.1
        } else {
            rng.random_range(0.2..1.2)
        });
    }
}

/// Each arm goes from place to place all over its space, together or in turn, while the trunk turns.
fn random_reaches(time: &mut Timeline, how: &Performance, rng: &mut ChaCha8Rng) {
    let count = if how.brief { 2 } else { rng.random_range(4..9) };
    for _ in 0..count {
        let start = time.poses.len();
        for _ in 0..RANDOM_TRIES {
            random_reach(time, how, rng);
            if time.poses[start..]
                .iter()
                .all(|pose| how.body.is_clear(&how.body.frame(pose)))
            {
                break;
            }
            time.poses.truncate(start);
        }
    }
}

/// Tries at a random reach that clears the body before it is left out.
const RANDOM_TRIES: usize = 30;

fn random_reach(time: &mut Timeline, how: &Performance, rng: &mut ChaCha8Rng) {
    let mut pose = time.current();
    for side in &how.sides {
        if how.sides.len() == 2 && rng.random_bool(0.25) {
            continue;
        }
        let zone = &Zone::ALL[rng.random_range(0..Zone::ALL.len())];
        pose.arms[*side as usize] = ArmPose {
            hand: zone.sample(rng),
            swivel: rng.random_range(-0.3..0.9),
            pronation: rng.random_range(-1.2..1.3),
            flexion: rng.random_range(-0.7..0.7),
            deviation: rng.random_range(-0.3..0.3),
        };
    }
    pose.yaw = if rng.random_bool(0.6) {
        rng.random_range(-0.8..0.8)
    } else {
        0.0
    };
    pose.lean = rng.random_range(-0.05..0.15);
    time.move_to(pose, rng.random_range(0.6..2.6) * how.tempo);
    if rng.random_bool(0.5) {
        time.hold(rng.random_range(0.1..0.6));
    }
}
