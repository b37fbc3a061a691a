//! What lively people do: gestures, sport and dance, as fast as people move (hands to 6 m/s).
//!
//! Hand places are in arm lengths from the shoulder, (forward, outward, up); see [`super::scripts`].

use std::f64::consts::{FRAC_PI_2, PI, TAU};

use nalgebra::Vector3;
use rand::RngExt;
use rand_chacha::ChaCha8Rng;

use super::body::{ArmPose, Pose};
use super::performance::Performance;
use super::timeline::Timeline;
use crate::Side;

/// Arms fly up overhead and come down, fast.
pub(super) fn raise_hands(time: &mut Timeline, how: &Performance, rng: &mut ChaCha8Rng) {
    let up = ArmPose::at(
        rng.random_range(0.1..0.3),
        rng.random_range(0.15..0.45),
        rng.random_range(0.85..0.93),
    )
    .turned(rng.random_range(-0.3..1.0), 0.0, 0.0);
    for _ in 0..how.repeats(rng, 5) {
        time.move_to(
            Pose::rest().with_arms(&how.sides, up),
            rng.random_range(2.5..5.5) * how.tempo,
        );
        time.hold(how.pause(rng, 0.1..0.6));
        time.move_to(Pose::rest(), rng.random_range(2.0..5.0) * how.tempo);
        time.hold(how.pause(rng, 0.0..0.4));
    }
}

/// Good-bye: a hand goes up beside the head and the open palm swings about the elbow, a few times, each time a little
/// higher.
pub(super) fn good_bye(time: &mut Timeline, how: &Performance, rng: &mut ChaCha8Rng) {
    let mut height = rng.random_range(0.15..0.3);
    for _ in 0..how.repeats(rng, 4) {
        let raised = ArmPose::at(0.36, 0.42, height)
            .swivel(rng.random_range(0.0..0.3))
            .turned(0.6, -0.2, 0.0);
        time.move_to(
            Pose::rest().with_arms(&how.sides, raised),
            rng.random_range(2.0..3.2) * how.tempo,
        );
        let swing = rng.random_range(0.1..0.2);
        let hertz = rng.random_range(1.3..2.5);
        let (seconds, rate) = how.cycles(rng, 2.0, 2.0..5.0, hertz);
        time.cycle(seconds, |t, strength, pose| {
            let wave = strength * (TAU * rate * t).sin();
            for side in &how.sides {
                let arm = &mut pose.arms[*side as usize];
                arm.hand += Vector3::new(0.0, swing * wave, -0.5 * swing * wave);
                arm.deviation -= 0.5 * wave;
            }
        });
        height = (height + 0.15_f64).min(0.6);
    }
}

/// Boxing: from the guard, combinations of straight punches, hooks and uppercuts, the trunk behind them.
pub(super) fn box_combination(time: &mut Timeline, how: &Performance, rng: &mut ChaCha8Rng) {
    let inward = how.body.half_breadth();
    let guard = ArmPose::at(0.42, 0.14 - inward, 0.12)
        .swivel(-0.1)
        .turned(0.1, 0.0, 0.0);
    let guarding = Pose::rest().with_arms(&Side::BOTH, guard);
    time.move_to(guarding, 2.0 * how.tempo);
    let mut side = how.side();
    for _ in 0..how.repeats(rng, 5) {
        let punches = if how.brief { 2 } else { rng.random_range(2..5) };
        for _ in 0..punches {
            let peak = rng.random_range(4.5..6.0);
            let follow = rng.random_range(0.3..0.6) * if side == Side::Left { -1.0 } else { 1.0 };
            match rng.random_range(0..4) {
                0 => {
                    // A hook swings in from outside.
                    let outside = ArmPose::at(0.5, 0.45, 0.05)
                        .swivel(0.8)
                        .turned(0.9, 0.0, 0.0);
                    let across = ArmPose::at(0.62, -0.5 * inward, 0.1).swivel(1.0);
                    time.move_to(
                        guarding.with_arm(side, outside).with_yaw(-0.4 * follow),
                        peak,
                    );
                    time.strike(
                        guarding
                            .with_arm(side, across.turned(1.0, 0.0, 0.0))
                            .with_yaw(follow),
                        peak,
                    );
                }
                1 => {
                    // An uppercut dips, then rises in front of the chin.
                    let low = ArmPose::at(0.42, 0.1, -0.5);
                    let high = ArmPose::at(0.66, 0.1 - inward, 0.22).turned(-1.2, 0.2, 0.0);
                    time.move_to(
                        guarding.with_arm(side, low).with_yaw(-0.3 * follow),
                        0.7 * peak,
                    );
                    time.strike(guarding.with_arm(side, high).with_yaw(follow), peak);
                }
                _ => {
                    let straight =
                        ArmPose::at(0.94, 0.06 - inward, rng.random_range(-0.1..0.15)).swivel(0.4);
                    time.strike(
                        guarding
                            .with_arm(side, straight.turned(1.3, 0.0, 0.0))
                            .with_yaw(follow),
                        peak,
                    );
                }
            }
            time.strike(guarding, 0.8 * peak);
            side = opposite(side);
        }
        time.hold(how.pause(rng, 0.0..0.4));
    }
}

/// Throwing: the hand goes back beside the head while the trunk turns away, whips over to the front and swings through.
pub(super) fn throw(time: &mut Timeline, how: &Performance, rng: &mut ChaCha8Rng) {
    let side = how.side();
    let turn = how.turn();
    let aim = ArmPose::at(0.85, 0.0, rng.random_range(0.0..0.3));
    let through = ArmPose::at(0.68, -0.2, -0.5).swivel(0.4);
    for _ in 0..how.repeats(rng, 4) {
        let back = ArmPose::at(-0.15, 0.6, rng.random_range(0.3..0.5)).swivel(0.5);
        let pointing = ArmPose::at(0.8, 0.1, 0.1);
        let wound = Pose::rest()
            .with_arm(side, back.turned(0.8, -0.4, 0.0))
            .with_arm(opposite(side), pointing)
            .with_yaw(-0.5 * turn);
        time.move_to(wound, rng.random_range(1.8..3.0) * how.tempo);
        time.hold(how.pause(rng, 0.0..0.3));
        let peak = rng.random_range(4.5..6.0);
        let tucked = ArmPose::at(0.3, 0.1, -0.6);
        let released = Pose::rest()
            .with_arm(side, aim.turned(0.9, 0.3, 0.0))
            .with_arm(opposite(side), tucked)
            .with_yaw(0.45 * turn);
        time.strike(released, peak);
        time.move_to(
            released.with_arm(side, through.turned(0.6, 0.2, 0.0)),
            rng.random_range(2.5..3.5),
        );
        time.move_to(Pose::rest(), rng.random_range(1.2..2.0));
        time.hold(how.pause(rng, 0.0..0.6));
    }
}

/// Drumming: the hands strike in turn, with accents and changes of beat.
pub(super) fn drum(time: &mut Timeline, how: &Performance, rng: &mut ChaCha8Rng) {
    let over = ArmPose::at(0.5, 0.0, rng.random_range(-0.45..-0.25)).turned(1.0, 0.0, 0.0);
    time.move_to(Pose::rest().with_arms(&Side::BOTH, over), 2.0 * how.tempo);
    for _ in 0..how.repeats(rng, 5) {
        let lift = rng.random_range(0.15..0.45);
        let apart = rng.random_range(0.0..0.25);
        let hertz = rng.random_range(1.4..3.0);
        let together = rng.random_bool(0.2);
        let (seconds, rate) = how.cycles(rng, 3.0, 4.0..8.0, hertz);
        time.cycle(seconds, |t, strength, pose| {
            for side in Side::BOTH {
                let late = if side == Side::Left && !together {
                    PI
                } else {
                    0.0
                };
                let phase = TAU * rate * t + late;
                // Every fourth stroke is an accent, from higher up and farther out.
                let accent = 1.0 + 0.6 * (0.25 * phase).cos().powi(8);
                let up = strength * accent * (0.5 - 0.5 * phase.cos());
                let arm = &mut pose.arms[side as usize];
                arm.hand += Vector3::new(-0.15 * lift * up, apart * up, lift * up);
                arm.deviation += 0.5 * up;
            }
            pose.yaw += 0.06 * strength * (0.5 * TAU * rate * t).sin();
        });
    }
}

/// Conducting: one hand beats the bar, three or four beats; the other mirrors it, or shows the players something.
pub(super) fn conduct(time: &mut Timeline, how: &Performance, rng: &mut ChaCha8Rng) {
    let side = how.side();
    let ready = ArmPose::at(0.55, 0.15, 0.0)
        .swivel(0.3)
        .turned(0.8, 0.0, 0.0);
    time.move_to(Pose::rest().with_arms(&Side::BOTH, ready), 1.8 * how.tempo);
    for _ in 0..how.repeats(rng, 4) {
        let beats = if rng.random_bool(0.5) { 3.0 } else { 4.0 };
        let size = rng.random_range(0.15..0.45);
        let mirrored = rng.random_bool(0.5);
        let hertz = rng.random_range(1.2..2.2);
        let (seconds, rate) = how.cycles(rng, 4.0, 6.0..12.0, hertz);
        time.cycle(seconds, |t, strength, pose| {
            let beat = TAU * rate * t;
            // Down on the beat and up between; in and out over the bar; the first beat the largest.
            let first = 1.0 + 0.4 * (beat / beats).cos();
            let dip = strength * size * first * (0.5 - 0.5 * beat.cos());
            let aside = strength * size * (beat / beats * (beats - 2.0)).sin();
            let own = &mut pose.arms[side as usize].hand;
            *own += Vector3::new(0.1 * dip, aside, dip);
            let other = &mut pose.arms[opposite(side) as usize];
            if mirrored {
                other.hand += Vector3::new(0.1 * dip, aside, dip);
            } else {
                let swell = strength * (0.5 - 0.5 * (beat / (2.0 * beats)).cos());
                other.hand += Vector3::new(0.1, 0.1, 0.4) * swell;
                other.pronation -= 1.2 * swell;
            }
        });
    }
}

/// Chopping wood: both hands swing an axe overhead and down.
pub(super) fn chop(time: &mut Timeline, how: &Performance, rng: &mut ChaCha8Rng) {
    let grip = 0.12 - how.body.half_breadth();
    let overhead = ArmPose::at(0.3, grip, rng.random_range(0.72..0.85)).swivel(0.3);
    let block = ArmPose::at(0.72, grip, rng.random_range(-0.5..-0.3));
    let raised = Pose::rest().with_arms(&Side::BOTH, overhead.turned(0.1, 0.0, 0.3));
    let struck = Pose {
        lean: rng.random_range(0.1..0.2),
        ..Pose::rest().with_arms(&Side::BOTH, block.turned(0.1, 0.0, -0.2))
    };
    for _ in 0..how.repeats(rng, 6) {
        time.move_to(raised, rng.random_range(2.2..3.6) * how.tempo);
        time.hold(how.pause(rng, 0.0..0.2));
        time.strike(struck, rng.random_range(4.5..6.0));
        time.hold(how.pause(rng, 0.05..0.25));
    }
}

/// Swimming on dry land: the crawl's arms in turn, or the breaststroke's together.
pub(super) fn swim(time: &mut Timeline, how: &Performance, rng: &mut ChaCha8Rng) {
    let crawl = rng.random_bool(0.5);
    let start = if crawl {
        ArmPose::at(0.65, 0.2, 0.0).turned(0.9, 0.0, 0.0)
    } else {
        ArmPose::at(0.6, 0.15, 0.0).turned(0.9, 0.0, 0.0)
    };
    time.move_to(Pose::rest().with_arms(&Side::BOTH, start), 2.0 * how.tempo);
    let hertz = rng.random_range(0.7..1.5);
    let (seconds, rate) = how.cycles(rng, 2.0, 4.0..8.0, hertz);
    let size = rng.random_range(0.75..1.0);
    time.cycle(seconds, |t, strength, pose| {
        for side in Side::BOTH {
            let late = if side == Side::Left && crawl { PI } else { 0.0 };
            let (sin, cos) = (TAU * rate * t + late).sin_cos();
            let hand = &mut pose.arms[side as usize].hand;
            *hand += strength
                * size
                * if crawl {
                    // Forward overhead, down in front, back along the side.
                    Vector3::new(0.32 * cos - 0.25, 0.12 * (1.0 - cos), 0.75 * sin)
                } else {
                    // Forward together, out to the sides, in below the chest.
                    Vector3::new(0.22 * cos - 0.05, 0.3 * (1.0 - cos), 0.25 * sin)
                };
        }
        if crawl {
            pose.yaw += 0.25 * strength * (TAU * rate * t).sin();
        }
    });
}

/// Dancing: from figure to figure, each arm with its own direction and its own multiple of a beat that changes.
pub(super) fn dance(time: &mut Timeline, how: &Performance, rng: &mut ChaCha8Rng) {
    const PLACES: [[f64; 3]; 6] = [
        [0.3, 0.4, 0.7],
        [0.1, 0.85, 0.1],
        [0.55, 0.1, 0.0],
        [0.4, 0.3, -0.4],
        [0.2, 0.6, -0.3],
        [0.35, 0.2, 0.45],
    ];
    const MULTIPLES: [f64; 3] = [0.5, 1.0, 2.0];
    let figures = if how.brief { 2 } else { rng.random_range(3..7) };
    let place = |rng: &mut ChaCha8Rng| {
        let [forward, outward, up] = PLACES[rng.random_range(0..PLACES.len())];
        ArmPose::at(forward, outward, up)
            .swivel(rng.random_range(0.0..0.8))
            .turned(rng.random_range(-0.6..1.2), 0.0, 0.0)
    };
    for _ in 0..figures {
        let alike = rng.random_bool(0.5);
        let left = place(rng);
        let right = if alike { left } else { place(rng) };
        let pose = Pose::rest()
            .with_arm(Side::Left, left)
            .with_arm(Side::Right, right)
            .with_yaw(rng.random_range(-0.3..0.3));
        time.move_to(pose, rng.random_range(2.0..4.0) * how.tempo);
        let hertz = rng.random_range(1.0..2.4);
        let (seconds, rate) = how.cycles(rng, 2.0, 3.0..8.0, hertz);
        let swing = |rng: &mut ChaCha8Rng| {
            let direction = Vector3::from_fn(|_, _| rng.random_range(-1.0..1.0_f64));
            let multiple = MULTIPLES[rng.random_range(0..MULTIPLES.len())];
            let size = rng.random_range(0.2..0.5) / multiple.max(1.0);
            let phase = rng.random_range(0..4) as f64 * FRAC_PI_2;
            (direction.normalize() * size, multiple, phase)
        };
        let own = [swing(rng), swing(rng)];
        let turn = rng.random_range(0.05..0.25);
        time.cycle(seconds, |t, strength, pose| {
            let beat = TAU * rate * t;
            for (index, arm) in pose.arms.iter_mut().enumerate() {
                let (direction, multiple, phase) = if alike { own[0] } else { own[index] };
                let moved = strength * (multiple * beat + phase).sin();
                arm.hand += direction * moved;
                arm.pronation += 0.6 * strength * (beat + phase).sin();
                arm.swivel += 0.3 * strength * (0.5 * beat).sin();
            }
            pose.yaw += turn * strength * (0.5 * beat).sin();
        });
    }
}

/// The arms of jumping jacks: from the thighs out over the sides to overhead and back, together.
pub(super) fn jumping_jack(time: &mut Timeline, how: &Performance, rng: &mut ChaCha8Rng) {
    let low = ArmPose::at(0.12, 0.3, -0.9).turned(0.3, 0.0, 0.0);
    time.move_to(Pose::rest().with_arms(&Side::BOTH, low), 2.0 * how.tempo);
    let hertz = rng.random_range(0.7..1.2);
    let (seconds, rate) = how.cycles(rng, 2.0, 4.0..9.0, hertz);
    let lowest = low.hand.z.atan2(low.hand.y);
    let highest = rng.random_range(1.15..1.35);
    time.cycle(seconds, |t, strength, pose| {
        let up = strength * (0.5 - 0.5 * (TAU * rate * t).cos());
        let (sin, cos) = (lowest + (highest - lowest) * up).sin_cos();
        for arm in &mut pose.arms {
            let length = arm.hand.yz().norm();
            arm.hand.y = length * cos;
            arm.hand.z = length * sin;
            arm.pronation -= 0.8 * up;
        }
    });
}

/// Guiding and pointing: "this way, please", palm up, and an arm that points at one thing after another.
pub(super) fn guide(time: &mut Timeline, how: &Performance, rng: &mut ChaCha8Rng) {
    let side = how.side();
    let chest = ArmPose::at(0.5, 0.05, -0.1).turned(-0.6, 0.0, 0.0);
    for _ in 0..how.repeats(rng, 5) {
        let azimuth: f64 = rng.random_range(0.0..1.5);
        let elevation: f64 = rng.random_range(-0.4..0.5);
        let pointing = rng.random_bool(0.5);
        let reach = if pointing { 0.96 } else { 0.85 };
        let target = ArmPose::at(
            reach * elevation.cos() * azimuth.cos(),
            reach * elevation.cos() * azimuth.sin(),
            reach * elevation.sin(),
        )
        .turned(if pointing { 0.6 } else { -1.0 }, 0.0, 0.0);
        let yaw = -0.4 * azimuth / 1.5 * how.turn();
        time.move_to(Pose::rest().with_arm(side, chest), 2.0 * how.tempo);
        time.move_to(
            Pose::rest().with_arm(side, target).with_yaw(yaw),
            rng.random_range(2.0..4.0) * how.tempo,
        );
        time.hold(how.pause(rng, 0.1..0.8));
    }
}

/// Arms folded in front of the chest.
pub(super) fn cross_arms(time: &mut Timeline, how: &Performance, rng: &mut ChaCha8Rng) {
    let inward = how.body.half_breadth();
    let before = ArmPose::at(0.6, 0.1, -0.4).turned(0.4, 0.1, 0.0);
    let over = ArmPose::at(0.5, -0.1 - inward, -0.3)
        .swivel(0.5)
        .turned(0.8, 0.2, 0.0);
    let under = ArmPose::at(0.42, -0.06 - inward, -0.5)
        .swivel(0.5)
        .turned(0.2, 0.2, 0.0);
    let side = how.side();
    let opened = Pose::rest().with_arms(&Side::BOTH, before);
    // The under arm first, or the wrists meet.
    let half = opened.with_arm(opposite(side), under);
    let folded = half.with_arm(side, over);
    for _ in 0..how.repeats(rng, 3) {
        let speed = rng.random_range(1.2..2.5) * how.tempo;
        for pose in [opened, half, folded] {
            time.move_to(pose, speed);
        }
        time.hold(how.pause(rng, 0.6..2.0));
        for pose in [half, opened, Pose::rest()] {
            time.move_to(pose, speed);
        }
    }
}

/// Hands on the hips, elbows out.
pub(super) fn hands_on_hips(time: &mut Timeline, how: &Performance, rng: &mut ChaCha8Rng) {
    let hip = ArmPose::at(0.16, 0.02, rng.random_range(-0.72..-0.64))
        .swivel(rng.random_range(0.9..1.2))
        .turned(0.6, 0.3, 0.0);
    let standing = Pose::rest().with_arms(&how.sides, hip);
    for _ in 0..how.repeats(rng, 3) {
        time.move_to(standing, rng.random_range(1.2..2.5) * how.tempo);
        time.hold(how.pause(rng, 0.4..1.5));
        time.move_to(standing.with_yaw(rng.random_range(-0.4..0.4)), 0.8);
        time.hold(how.pause(rng, 0.2..1.0));
        time.move_to(Pose::rest(), rng.random_range(1.2..2.5) * how.tempo);
        time.hold(how.pause(rng, 0.0..0.6));
    }
}

fn opposite(side: Side) -> Side {
    match side {
        Side::Left => Side::Right,
        Side::Right => Side::Left,
    }
}
