//! Procedural skills: the default motions where no recordings are at hand.
//!
//! Everything follows from the seed: body size and proportions, tempo, arms, places and rhythm. Clips are 50 frames a
//! second, begin and end with hanging arms, and keep elbows and wrists out of the person's own trunk.

mod body;
mod scripts;
mod skill;
mod timeline;

use std::f64::consts::TAU;
use std::ops::Range;

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

pub use skill::Skill;

use crate::{Clip, KeyNodeFrame, Side};
use body::{Body, Pose};
use scripts::Performance;
use timeline::{FPS, Timeline};

/// Share of clips without wrist orientations, as in many recordings.
const SHARE_WITHOUT_WRISTS: f64 = 0.2;
/// Tries at a performance that keeps clear of the body; the last is kept as it is.
const TRIES: usize = 40;
/// Tempos of skills shown at leisure, and of those in a medley.
const USUAL_PACE: Range<f64> = 0.75..1.3;
const BRIEF_PACE: Range<f64> = 1.15..1.45;
/// Peak hand speed of the way back to rest, m/s.
const RETURN_SPEED: f64 = 1.2;

/// One performance of a skill, 3 to 20 s.
#[must_use]
pub fn generate(skill: Skill, seed: u64) -> Clip {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    // One seed gives every skill its own person.
    rng.set_stream(skill as u64);
    let body = Body::random(&mut rng);
    let with_wrists = !rng.random_bool(SHARE_WITHOUT_WRISTS);
    let mut time = Timeline::new(&body);
    time.hold(rng.random_range(0.1..0.5));
    append(&mut time, &body, skill, false, &mut rng);
    time.move_to(Pose::rest(), RETURN_SPEED);
    let mut clip = finish(format!("{}-{seed}", skill.name()), &body, &time, &mut rng);
    if !with_wrists {
        clip.frames
            .iter_mut()
            .for_each(|frame| frame.wrist_rotations = [None; 2]);
    }
    clip
}

/// Every skill once, briefly, by one person, about 30 to 40 s.
#[must_use]
pub fn medley(seed: u64) -> Clip {
    medley_with_starts(seed).0
}

/// The medley, and the frame at which each skill of [`Skill::ALL`] begins.
#[must_use]
pub fn medley_with_starts(seed: u64) -> (Clip, Vec<usize>) {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let body = Body::random(&mut rng);
    let mut time = Timeline::new(&body);
    let starts = Skill::ALL
        .into_iter()
        .map(|skill| {
            let start = time.poses.len();
            append(&mut time, &body, skill, true, &mut rng);
            start
        })
        .collect();
    time.move_to(Pose::rest(), RETURN_SPEED);
    (
        finish(format!("medley-{seed}"), &body, &time, &mut rng),
        starts,
    )
}

/// A varied set of clips: two thirds go through the skills in turn, one third are random reaches.
#[must_use]
pub fn library(seed: u64, clips: usize) -> Vec<Clip> {
    endless(seed).take(clips).collect()
}

/// The clips of a [`library`] of any size, made one by one.
pub fn endless(seed: u64) -> impl Iterator<Item = Clip> {
    let mut seeds = ChaCha8Rng::seed_from_u64(seed);
    let mut skills = Skill::ALL.into_iter().cycle();
    (0_usize..).map(move |index| {
        let skill = if index % 3 == 2 {
            Some(Skill::RandomReaches)
        } else {
            skills.next()
        };
        generate(skill.unwrap_or(Skill::RandomReaches), seeds.random())
    })
}

/// Performs a skill from the timeline's current pose, drawing again until arms and trunk keep clear of each other.
fn append(time: &mut Timeline, body: &Body, skill: Skill, brief: bool, rng: &mut ChaCha8Rng) {
    let start = time.poses.len();
    let pace = if brief { BRIEF_PACE } else { USUAL_PACE };
    for _ in 0..TRIES {
        time.poses.truncate(start);
        let how = Performance {
            body,
            sides: sides(skill, rng),
            tempo: rng.random_range(pace.clone()),
            brief,
        };
        scripts::perform(skill, time, &how, rng);
        let clear = |pose: &Pose| body.is_clear(&body.frame(pose));
        if time.poses[start..].iter().all(clear) {
            return;
        }
    }
}

fn sides(skill: Skill, rng: &mut ChaCha8Rng) -> Vec<Side> {
    if skill.allows_both_arms() && rng.random_bool(0.4) {
        return Side::BOTH.to_vec();
    }
    vec![if rng.random_bool(0.5) {
        Side::Left
    } else {
        Side::Right
    }]
}

/// Adds the sway of a living body and turns poses into frames.
fn finish(name: String, body: &Body, time: &Timeline, rng: &mut ChaCha8Rng) -> Clip {
    let mut sway = |amplitude: f64| {
        let (rate, phase) = (rng.random_range(0.1..0.35), rng.random_range(0.0..TAU));
        move |t: f64| amplitude * (TAU * rate * t + phase).sin()
    };
    let (yaw, lean, left, right) = (sway(0.02), sway(0.008), sway(0.006), sway(0.006));
    let frame = |(index, pose): (usize, &Pose)| -> KeyNodeFrame {
        let t = index as f64 / FPS;
        let mut pose = *pose;
        pose.yaw += yaw(t);
        pose.lean += lean(t);
        pose.arms[0].hand.x += left(t);
        pose.arms[1].hand.x += right(t);
        body.frame(&pose)
    };
    Clip {
        name,
        fps: FPS,
        frames: time.poses.iter().enumerate().map(frame).collect(),
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector3;

    use super::*;

    #[test]
    fn a_medley_shows_every_skill_long_enough_to_see_it() {
        for seed in 0..20 {
            let (clip, starts) = medley_with_starts(seed);
            let ends = starts[1..].iter().copied().chain([clip.frames.len()]);
            for ((skill, start), end) in Skill::ALL.iter().zip(&starts).zip(ends) {
                let shown = &clip.frames[*start..end];
                assert!(
                    shown.len() > 25,
                    "seed {seed}: {} lasts {} frames",
                    skill.name(),
                    shown.len()
                );
                // A light bulb that is screwed in where the hand already is shows in the hand's turn alone.
                let moved = |f: &KeyNodeFrame| {
                    (0..8)
                        .map(|n| (f.positions[n] - shown[0].positions[n]).norm())
                        .fold(0.0, f32::max)
                };
                let thumb = |f: &KeyNodeFrame, side: usize| {
                    f.wrist_rotations[side].map(|r| r * Vector3::z())
                };
                let turned = |f: &KeyNodeFrame| {
                    (0..2).any(|side| {
                        thumb(f, side)
                            .zip(thumb(&shown[0], side))
                            .is_some_and(|(a, b)| a.angle(&b) > 0.5)
                    })
                };
                assert!(
                    shown.iter().any(|f| moved(f) > 0.05 || turned(f)),
                    "seed {seed}: {} stands still",
                    skill.name()
                );
            }
        }
    }

    #[test]
    fn no_performance_needs_the_last_try() {
        for seed in 0..40 {
            for skill in Skill::ALL {
                let mut rng = ChaCha8Rng::seed_from_u64(seed);
                let body = Body::random(&mut rng);
                let mut time = Timeline::new(&body);
                append(&mut time, &body, skill, seed % 2 == 0, &mut rng);
                assert!(
                    time.poses
                        .iter()
                        .all(|pose| body.is_clear(&body.frame(pose))),
                    "{} {seed}",
                    skill.name()
                );
            }
        }
    }
}
