//! One tracking environment.

use std::sync::Arc;

use emp_models::observation::ObservationLayout;
use emp_robot::Robot;
use rand::{Rng as _, RngExt as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};

use super::TrackingSettings;
use crate::environment::{
    EndReason, EnvironmentConfig, EpisodeSetup, Kind, Randomization, Subject,
};
use crate::goals::{GoalClip, GoalJoint, Piece};
use crate::pushes::{Kick, Pushes};
use crate::ranges::within;
use crate::{End, SimError, Stage};

/// What all environments share.
#[derive(Debug)]
pub(super) struct Setting {
    pub(super) kind: Kind,
    pub(super) settings: TrackingSettings,
    pub(super) clips: Arc<[GoalClip]>,
    joints: Vec<GoalJoint>,
    /// When a robot has fallen: as in training and evaluation.
    limits: EnvironmentConfig,
    /// What differs between most episodes, and between those under full randomisation.
    loads: Randomization,
    full: Randomization,
}

impl Setting {
    pub(super) fn new(
        robot: Arc<Robot>,
        observation: ObservationLayout,
        settings: TrackingSettings,
        clips: Arc<[GoalClip]>,
    ) -> Result<Self, SimError> {
        Ok(Self {
            joints: GoalJoint::all(&robot)?,
            kind: Kind::new(robot, observation),
            limits: EnvironmentConfig::default(),
            loads: settings.loads(),
            full: Randomization::default(),
            settings,
            clips,
        })
    }
}

/// An episode that ended.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct EndedEpisode {
    /// Row of its environment.
    pub environment: usize,
    /// Index of its clip.
    pub clip: usize,
    /// Factor on the goals' distance from the default pose.
    pub amplitude: f32,
    /// Speed of the motion, as a multiple of its own.
    pub speed: f32,
    /// Whether the motion was mirrored.
    pub mirrored: bool,
    /// Its control periods.
    pub length: u32,
    /// Why it ended; [`EndReason::TimedOut`] where the robot stood to the end.
    pub end: EndReason,
}

/// Where one environment's share of the batch goes.
#[derive(Debug)]
pub(super) struct Slots<'a> {
    pub(super) observation: &'a mut [f32],
    pub(super) start: &'a mut bool,
    pub(super) next: &'a mut [f32],
    pub(super) com: &'a mut [f32],
    pub(super) contact: &'a mut f32,
    pub(super) end: &'a mut End,
    pub(super) ended: &'a mut Option<EndedEpisode>,
}

/// One robot in the middle of an episode.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub(super) struct Environment {
    /// Row in the batch.
    row: usize,
    /// Gives each episode its seed.
    seeds: ChaCha8Rng,
    /// The episode's own.
    rng: ChaCha8Rng,
    subject: Subject,
    piece: Piece,
    /// Control periods since the episode began.
    age: usize,
    /// Control periods that it lasts.
    length: usize,
}

impl Environment {
    /// Environment number `index`, at the start of its first episode, which is of any length so that not all end at once.
    pub(super) fn new(
        setting: &Setting,
        stage: &mut Stage,
        seed: u64,
        index: u64,
        row: usize,
    ) -> Self {
        let mut seeds = ChaCha8Rng::seed_from_u64(seed);
        seeds.set_stream(index);
        let mut rng = ChaCha8Rng::seed_from_u64(seeds.next_u64());
        let share: f64 = rng.random();
        let mut environment = Self {
            row,
            subject: Subject::new(&setting.kind, stage),
            piece: draw_piece(setting, &mut rng),
            seeds,
            rng,
            age: 0,
            length: 0,
        };
        environment.reset(setting, stage);
        environment.length = ((share * environment.length as f64) as usize).max(1);
        environment
    }

    /// The same in another row of a batch.
    pub(super) fn in_row(mut self, row: usize) -> Self {
        self.row = row;
        self
    }

    /// Starts a new episode.
    fn reset(&mut self, setting: &Setting, stage: &mut Stage) {
        self.rng = ChaCha8Rng::seed_from_u64(self.seeds.next_u64());
        self.piece = draw_piece(setting, &mut self.rng);
        (self.age, self.length) = (0, self.piece.frames);
        self.set_goals(setting);
        let setup = draw_setup(setting, &mut self.rng);
        self.subject
            .place(&setting.kind, stage, setup, &mut self.rng);
        self.subject.observe();
    }

    fn set_goals(&mut self, setting: &Setting) {
        let (piece, age) = (&self.piece, self.age);
        let clip = &setting.clips[piece.clip];
        let goal_at = |t: usize, goal: &mut [f32]| piece.goal(clip, &setting.joints, t, goal);
        goal_at(age, &mut self.subject.goal);
        self.subject
            .look_ahead(|ahead, goal| goal_at(age + ahead, goal));
    }

    /// One control period with the goal `executed` (rad) and `action` (policy units). An episode that ends is followed by
    /// the next one's start.
    pub(super) fn step(
        &mut self,
        setting: &Setting,
        stage: &mut Stage,
        [executed, action]: [&[f32]; 2],
        slots: &mut Slots<'_>,
    ) {
        let kind = &setting.kind;
        self.subject.history.set_newest_goal(executed);
        self.subject.goal.copy_from_slice(executed);
        self.subject.execute(kind, stage, action, &mut self.rng);
        self.age += 1;
        let timed_out = (self.age >= self.length).then_some(EndReason::TimedOut);
        let reading = self.subject.body.reading();
        let end = setting
            .limits
            .fall(reading, kind.standing_height)
            .or(timed_out);
        if !matches!(end, Some(EndReason::Diverged(_))) {
            self.subject.remember(action);
            self.set_goals(setting);
            self.subject.observe();
        }
        self.measure(setting, slots);
        *slots.end = End::from(end);
        *slots.ended = end.map(|end| EndedEpisode {
            environment: self.row,
            clip: self.piece.clip,
            amplitude: self.piece.amplitude,
            speed: self.piece.tempo,
            mirrored: self.piece.mirrored,
            length: self.age as u32,
            end,
        });
        if end.is_some() {
            self.reset(setting, stage);
        }
        self.write(slots.observation, slots.start);
    }

    /// Writes what became of the control period.
    fn measure(&self, setting: &Setting, slots: &mut Slots<'_>) {
        let (layout, reading) = (&setting.kind.observation, self.subject.body.reading());
        let newest = self.subject.history.newest();
        let (joints, orientation) = slots.next.split_at_mut(layout.joint_positions().len());
        joints.copy_from_slice(&newest[layout.joint_positions()]);
        orientation.copy_from_slice(&newest[layout.orientation()]);
        let com = reading.center_of_mass_over_feet();
        slots.com.copy_from_slice(&[com.x as f32, com.y as f32]);
        *slots.contact = reading.self_contact.force as f32;
    }

    /// Writes what the learner sees now.
    pub(super) fn write(&self, observation: &mut [f32], start: &mut bool) {
        observation.copy_from_slice(self.subject.history.stack());
        *start = self.age == 0;
    }

    /// Whether it can go on where `other` is.
    pub(super) fn is_like(&self, other: &Self, clips: usize) -> bool {
        self.row == other.row && self.piece.clip < clips && self.subject.is_like(&other.subject)
    }
}

fn draw_piece(setting: &Setting, rng: &mut ChaCha8Rng) -> Piece {
    let settings = &setting.settings;
    let clip = rng.random_range(0..setting.clips.len());
    let frames = setting.clips[clip].len();
    let tempo = within(Some(settings.speed), 1.0, rng) as f32;
    let periods = Piece::periods(frames, tempo, settings.episode_frames);
    let spare = Piece::spare(frames, tempo, periods);
    Piece {
        clip,
        start: rng.random_range(0.0..=spare),
        tempo,
        frames: periods,
        amplitude: within(Some(settings.amplitude), 1.0, rng) as f32,
        mirrored: rng.random_bool(0.5) && settings.mirrored,
        live: None,
    }
}

fn draw_setup<'a>(setting: &'a Setting, rng: &mut ChaCha8Rng) -> EpisodeSetup<'a> {
    let settings = &setting.settings;
    let is_randomized = rng.random::<f64>() < settings.randomized;
    let is_pushed = rng.random::<f64>() < settings.pushed;
    let ranges = if is_randomized {
        &setting.full
    } else {
        &setting.loads
    };
    let kick = Kick {
        speed: within(Some(settings.push_speed), 0.0, rng),
        interval: settings.push_interval,
    };
    EpisodeSetup {
        parameters: setting.kind.draw(ranges, rng),
        ranges,
        pushes: if is_pushed {
            Some(Pushes::Kick(kick))
        } else {
            ranges.push.map(Pushes::Random)
        },
    }
}
