//! The lesson of falls and contacts: what should have been executed, found by running fork points of a rollout again with other goals.
//!
//! A rollout shows where the EMP's own goals led, not where others would have led. So some of its fork points are run again from
//! the very same state, under the same load and pushes. Where the robot fell, or pressed its links on one another: with the goals as
//! they were asked for, and with tamer ones. Where it went well, but the EMP had changed the goals: with the goals as they were asked
//! for, and with half the change. Of what goes well (before a fall: of what stands) the smallest change is what the EMP should have
//! answered.

use anyhow::Result;
use emp_models::emp::EmpNetwork;
use emp_robot::Robot;
use emp_sim::End;
use rand::{SeedableRng as _, seq::SliceRandom as _};
use rand_chacha::ChaCha8Rng;

use super::{
    rollout::{EmpCollector, EmpRollout},
    settings::{HindsightSettings, Remedy},
};

/// What the generator that chooses among fork points has in its seed beside the run's.
const CHOICE: u64 = 0x656d_705f_6873;

/// What is known of the goal of a row of a rollout.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Label {
    /// Nothing: its future lies beyond the rollout, was not tried with other goals, or is a fall with all that were tried.
    Unknown,
    /// It was right as it was asked for.
    Right,
    /// It had to be changed against a fall.
    Falls,
    /// It had to be changed against a contact.
    Touches,
}

/// What hindsight says of a rollout.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Labels {
    /// Of each row.
    pub labels: Vec<Label>,
    /// What should have been executed, rows × joints, rad; meaningful where a label is not [`Label::Unknown`].
    pub targets: Vec<f32>,
    /// What the trials showed.
    pub counts: Counts,
}

/// What came of the fork points that were run again.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Counts {
    /// Fork points before a fall.
    pub falls: usize,
    /// Those of them in which some goals go well.
    pub avoidable: usize,
    /// Fork points of contact without a fall.
    pub contacts: usize,
    /// Those of them in which some goals go well.
    pub relievable: usize,
    /// Fork points that went well with changed goals.
    pub changes: usize,
    /// Those of them that do not without the change.
    pub needed: usize,
}

/// Goals that are tried.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Candidate {
    /// As they are asked for.
    Asked,
    /// Half of what the EMP changes.
    Half,
    /// Tamer ones: the remedy of this index.
    Tamed(usize),
}

/// A fork point whose future is known.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Window {
    environment: usize,
    /// Index of its fork point.
    fork_point: usize,
    /// Control periods that it speaks of: those to the next fork point, or to the episode's end.
    periods: usize,
    fell: bool,
    /// Whether the robot's links pressed on one another too much.
    touched: bool,
    /// Whether the EMP changed the goals.
    changed: bool,
}

/// A window that is run again.
struct Replay {
    window: usize,
    candidate: Candidate,
    /// Last executed goal, which a remedy's speed starts from.
    held: Vec<f32>,
    /// Goals of the window's control periods.
    goals: Vec<f32>,
    /// Sum over all joints of all control periods, rad.
    change: f64,
    /// Sum over the window's control periods, N.
    contact: f64,
    /// Control periods until it was over.
    lived: usize,
    /// How it ended; open until the horizon.
    end: End,
}

/// Runs fork points again.
pub struct Hindsight<'a> {
    settings: &'a HindsightSettings,
    /// Angles of the goal joints in the default pose, rad.
    default_pose: Vec<f32>,
    /// Against falls, then against contacts.
    remedies: Vec<JointRemedy>,
}

/// A remedy for the joints of a robot.
struct JointRemedy {
    /// Whether it is for this goal joint.
    tamed: Vec<bool>,
    amplitude: f32,
    /// Largest change of an angle in a control period, rad.
    step: f32,
}

impl<'a> Hindsight<'a> {
    /// Hindsight about `robot`.
    pub fn new(robot: &Robot, settings: &'a HindsightSettings) -> Self {
        let joints = robot.goal_joints();
        let remedy = |remedy: &Remedy| JointRemedy {
            tamed: joints
                .iter()
                .map(|joint| remedy.joints.iter().any(|word| joint.name.contains(word)))
                .collect(),
            amplitude: remedy.amplitude as f32,
            step: (remedy.speed / robot.control_rate_hz()) as f32,
        };
        let remedies = settings
            .against_falls
            .iter()
            .chain(&settings.against_contacts);
        Self {
            settings,
            default_pose: robot.default_goal(),
            remedies: remedies.map(remedy).collect(),
        }
    }

    /// What hindsight says of `rollout`, which `collector` collected with `network`; `seed` chooses among more fork points than may
    /// be run again.
    ///
    /// # Errors
    /// When the network or the simulation fails.
    pub fn labels(
        &self,
        rollout: &EmpRollout,
        collector: &EmpCollector,
        network: &EmpNetwork,
        seed: u64,
        threads: &rayon::ThreadPool,
    ) -> Result<Labels> {
        let mut labels = Labels {
            labels: vec![Label::Unknown; rollout.rows()],
            targets: rollout.goals.clone(),
            counts: Counts::default(),
        };
        let mut doubts = Vec::new();
        for window in self.windows(rollout) {
            if window.fell || window.touched || window.changed {
                doubts.push(window);
            } else {
                window.label(rollout, Label::Right, &mut labels.labels);
            }
        }
        doubts.shuffle(&mut ChaCha8Rng::seed_from_u64(seed ^ CHOICE));
        doubts.sort_by_key(|window| !window.fell);
        let mut replays = self.replays(rollout, &doubts);
        self.run(&mut replays, &doubts, rollout, collector, network, threads)?;
        for replays in replays.chunk_by(|a, b| a.window == b.window) {
            let window = &doubts[replays[0].window];
            labels.judge(window, replays, rollout, self.contact());
        }
        Ok(labels)
    }

    /// The contact that is too much, N.
    fn contact(&self) -> f64 {
        if self.settings.contact_weight > 0.0 {
            self.settings.contact
        } else {
            f64::INFINITY
        }
    }

    /// The fork points whose future is known as far as the horizon, or to the episode's end.
    fn windows(&self, rollout: &EmpRollout) -> Vec<Window> {
        let mut windows = Vec::new();
        for (index, fork_point) in rollout.fork_points.iter().enumerate() {
            for environment in 0..rollout.environments {
                let lived = rollout.lived(fork_point.period, environment, self.settings.horizon);
                let Some((lived, end)) = lived.filter(|(_, end)| *end != End::Diverged) else {
                    continue;
                };
                let mut window = Window {
                    environment,
                    fork_point: index,
                    periods: lived.min(self.settings.window),
                    fell: end == End::Terminated,
                    touched: false,
                    changed: false,
                };
                window.touched = window.contact(rollout) > self.contact();
                window.changed = window.change(rollout) > self.settings.change;
                windows.push(window);
            }
        }
        windows
    }

    /// What is tried in the first of `windows`, as many as may be.
    fn replays(&self, rollout: &EmpRollout, windows: &[Window]) -> Vec<Replay> {
        let width = self.default_pose.len();
        let mut replays = Vec::new();
        for (index, window) in windows.iter().enumerate() {
            let candidates = self.candidates(window);
            if replays.len() + candidates.len() > self.settings.replays {
                break;
            }
            let before = window.executed_before(rollout, width);
            replays.extend(candidates.into_iter().map(|candidate| Replay {
                window: index,
                candidate,
                held: before.to_vec(),
                goals: Vec::new(),
                change: 0.0,
                contact: 0.0,
                lived: 0,
                end: End::None,
            }));
        }
        replays
    }

    fn candidates(&self, window: &Window) -> Vec<Candidate> {
        let mut candidates = Vec::new();
        if window.fell || window.changed {
            candidates.push(Candidate::Asked);
        }
        let falls = self.settings.against_falls.len();
        if window.fell {
            candidates.extend((0..falls).map(Candidate::Tamed));
        } else if window.touched {
            candidates.extend((falls..self.remedies.len()).map(Candidate::Tamed));
        } else {
            candidates.push(Candidate::Half);
        }
        candidates
    }

    /// Runs every replay to its end, or to the horizon.
    fn run(
        &self,
        replays: &mut [Replay],
        windows: &[Window],
        rollout: &EmpRollout,
        collector: &EmpCollector,
        network: &EmpNetwork,
        threads: &rayon::ThreadPool,
    ) -> Result<()> {
        let origins = replays.iter().map(|replay| {
            let window = &windows[replay.window];
            (&rollout.fork_points[window.fork_point], window.environment)
        });
        let mut fork = collector.fork(origins);
        let width = self.default_pose.len();
        for _ in 0..self.settings.horizon {
            if replays.iter().all(|replay| replay.end != End::None) {
                break;
            }
            let asked = fork.environments().goals().to_vec();
            let answers = fork.answers(network, threads)?;
            let rows = asked.chunks_exact(width).zip(answers.chunks_exact(width));
            let mut goals = Vec::with_capacity(asked.len());
            for (replay, (asked, answer)) in replays.iter_mut().zip(rows) {
                let goal = self.goal(replay, asked, answer);
                replay.execute(&goal, asked, windows[replay.window].periods);
                goals.extend(goal);
            }
            let step = fork.execute(&goals)?;
            let came = step.ends.iter().zip(step.contact);
            for (replay, (end, contact)) in replays.iter_mut().zip(came) {
                replay.come_of(*end, *contact, windows[replay.window].periods);
            }
        }
        Ok(())
    }

    /// The goal of a replay's next control period.
    fn goal(&self, replay: &Replay, asked: &[f32], answer: &[f32]) -> Vec<f32> {
        let joints = asked.iter().zip(answer).enumerate();
        joints
            .map(|(j, (&asked, &answer))| match replay.candidate {
                Candidate::Asked => asked,
                Candidate::Half => asked + (answer - asked) / 2.0,
                Candidate::Tamed(remedy) => {
                    let JointRemedy {
                        tamed,
                        amplitude,
                        step,
                    } = &self.remedies[remedy];
                    if !tamed[j] {
                        return answer;
                    }
                    let default = self.default_pose[j];
                    let tame = default + amplitude * (asked - default);
                    replay.held[j] + (tame - replay.held[j]).clamp(-step, *step)
                }
            })
            .collect()
    }
}

impl Window {
    /// Its rows in the rollout.
    fn rows(self, rollout: &EmpRollout) -> impl Iterator<Item = usize> {
        let start = rollout.fork_points[self.fork_point].period;
        let n = rollout.environments;
        (start..start + self.periods).map(move |period| period * n + self.environment)
    }

    /// Mean absolute change of a goal angle, rad.
    fn change(self, rollout: &EmpRollout) -> f64 {
        let width = rollout.goals.len() / rollout.rows();
        let changes = self.rows(rollout).flat_map(|row| {
            let row = row * width..(row + 1) * width;
            rollout.goals[row.clone()].iter().zip(&rollout.answers[row])
        });
        let sum: f64 = changes.map(|(a, b)| f64::from((a - b).abs())).sum();
        sum / (self.periods * width) as f64
    }

    /// Mean force between the robot's own links, N.
    fn contact(self, rollout: &EmpRollout) -> f64 {
        let forces = self
            .rows(rollout)
            .map(|row| f64::from(rollout.contact[row]));
        forces.sum::<f64>() / self.periods as f64
    }

    /// The goal that was executed before it.
    fn executed_before(self, rollout: &EmpRollout, width: usize) -> &[f32] {
        let row = self.rows(rollout).next().unwrap_or_default();
        let [_, before] = &rollout.answers_before;
        &before[row * width..(row + 1) * width]
    }

    /// Why its goals had to be changed.
    fn wrong(self, replays: &[Replay]) -> Label {
        let falls_as_asked = replays
            .iter()
            .any(|replay| replay.candidate == Candidate::Asked && !replay.stood());
        if self.fell || (!self.touched && falls_as_asked) {
            Label::Falls
        } else {
            Label::Touches
        }
    }

    fn label(self, rollout: &EmpRollout, label: Label, labels: &mut [Label]) {
        for row in self.rows(rollout) {
            labels[row] = label;
        }
    }
}

impl Replay {
    /// Takes down what is executed, while it lives.
    fn execute(&mut self, goal: &[f32], asked: &[f32], periods: usize) {
        self.held.copy_from_slice(goal);
        if self.end != End::None {
            return;
        }
        if self.lived < periods {
            self.goals.extend(goal);
        }
        let changes = goal
            .iter()
            .zip(asked)
            .map(|(a, b)| f64::from((a - b).abs()));
        self.change += changes.sum::<f64>();
    }

    /// Takes down what came of it.
    fn come_of(&mut self, end: End, contact: f32, periods: usize) {
        if self.end != End::None {
            return;
        }
        if self.lived < periods {
            self.contact += f64::from(contact);
        }
        self.lived += 1;
        self.end = end;
    }

    fn stood(&self) -> bool {
        matches!(self.end, End::None | End::TimedOut)
    }

    /// Whether the robot stands, and its links press on one another with no more than `contact` N on average.
    fn goes_well(&self, contact: f64, periods: usize) -> bool {
        self.stood() && self.contact <= contact * periods as f64
    }

    /// Sum over the joints in a control period, rad.
    fn mean_change(&self) -> f64 {
        self.change / self.lived.max(1) as f64
    }
}

impl Labels {
    /// Learns from what was tried in a window; `contact` (N) is too much.
    fn judge(&mut self, window: &Window, replays: &[Replay], rollout: &EmpRollout, contact: f64) {
        let good = replays.iter().filter(|replay| match window.fell {
            true => replay.stood(),
            false => replay.goes_well(contact, window.periods),
        });
        let best = good.min_by(|a, b| a.mean_change().total_cmp(&b.mean_change()));
        let label = match best {
            Some(best) if best.candidate == Candidate::Asked => Label::Right,
            None if window.fell => Label::Unknown,
            None if window.touched => Label::Right,
            _ => window.wrong(replays),
        };
        self.counts.add(window, label, best.is_some());
        window.label(rollout, label, &mut self.labels);
        let width = rollout.goals.len() / rollout.rows();
        for (period, row) in window.rows(rollout).enumerate() {
            let row = row * width..(row + 1) * width;
            // A replay without its window's last goals ended otherwise than the rollout: the rest stays as it was answered.
            let goals = best.and_then(|best| best.goals.chunks_exact(width).nth(period));
            let wiser = match label {
                Label::Falls | Label::Touches => goals.unwrap_or(&rollout.answers[row.clone()]),
                Label::Right | Label::Unknown => &rollout.goals[row.clone()],
            };
            self.targets[row].copy_from_slice(wiser);
        }
    }
}

impl Counts {
    fn add(&mut self, window: &Window, label: Label, has_remedy: bool) {
        let (all, some, counts) = if window.fell {
            (&mut self.falls, &mut self.avoidable, has_remedy)
        } else if window.touched {
            (&mut self.contacts, &mut self.relievable, has_remedy)
        } else {
            (&mut self.changes, &mut self.needed, label != Label::Right)
        };
        *all += 1;
        *some += usize::from(counts);
    }
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::*;
    use crate::emp::{
        rollout::ForkPoint,
        settings::{EmpSettings, Preset},
    };

    /// One environment, two control periods, one joint; asked for 1 and 2 rad, answered 1.5 and 2.5.
    fn rollout() -> EmpRollout {
        EmpRollout {
            environments: 1,
            goals: vec![1.0, 2.0],
            answers: vec![1.5, 2.5],
            ends: vec![End::None; 2],
            fork_points: vec![ForkPoint::default()],
            ..EmpRollout::default()
        }
    }

    const FELL: Window = Window {
        environment: 0,
        fork_point: 0,
        periods: 2,
        fell: true,
        touched: false,
        changed: false,
    };

    const TOUCHED: Window = Window {
        fell: false,
        touched: true,
        ..FELL
    };

    const CHANGED: Window = Window {
        fell: false,
        changed: true,
        ..FELL
    };

    fn replay(candidate: Candidate, end: End, change: f64) -> Replay {
        Replay {
            window: 0,
            candidate,
            held: vec![0.0],
            goals: vec![change as f32; 2],
            change,
            contact: 0.0,
            lived: 1,
            end,
        }
    }

    #[test]
    fn the_smallest_change_that_goes_well_is_learnt() {
        let (fall, stand) = (End::Terminated, End::TimedOut);
        let (asked, half, tame) = (Candidate::Asked, Candidate::Half, Candidate::Tamed(0));
        let touching = |replay| Replay {
            contact: 4.1,
            ..replay
        };
        let cases = [
            (
                FELL,
                vec![replay(asked, stand, 0.0)],
                Label::Right,
                [1.0, 2.0],
            ),
            (
                FELL,
                vec![
                    replay(asked, fall, 0.0),
                    replay(tame, stand, 0.3),
                    replay(tame, End::None, 0.2),
                    replay(tame, fall, 0.1),
                    touching(replay(tame, stand, 0.1)),
                ],
                Label::Falls,
                [0.1, 0.1],
            ),
            (
                FELL,
                vec![replay(tame, fall, 0.1)],
                Label::Unknown,
                [1.0, 2.0],
            ),
            (
                TOUCHED,
                vec![replay(tame, stand, 0.1)],
                Label::Touches,
                [0.1, 0.1],
            ),
            (
                TOUCHED,
                vec![touching(replay(tame, stand, 0.1))],
                Label::Right,
                [1.0, 2.0],
            ),
            (
                CHANGED,
                vec![replay(asked, stand, 0.0), replay(half, stand, 0.1)],
                Label::Right,
                [1.0, 2.0],
            ),
            (
                CHANGED,
                vec![
                    touching(replay(asked, stand, 0.0)),
                    replay(half, stand, 0.1),
                ],
                Label::Touches,
                [0.1, 0.1],
            ),
            (
                CHANGED,
                vec![replay(asked, fall, 0.0), replay(half, End::Diverged, 0.1)],
                Label::Falls,
                [1.5, 2.5],
            ),
        ];
        for (window, replays, label, targets) in cases {
            let mut labels = Labels {
                labels: vec![Label::Unknown; 2],
                targets: vec![0.0; 2],
                counts: Counts::default(),
            };
            labels.judge(&window, &replays, &rollout(), 2.0);
            assert_eq!(
                (&labels.labels[..], &labels.targets[..]),
                (&[label; 2][..], &targets[..])
            );
        }
    }

    #[test]
    fn fork_points_are_counted_by_what_is_wrong_with_them() {
        let mut counts = Counts::default();
        counts.add(&FELL, Label::Right, true);
        counts.add(&FELL, Label::Unknown, false);
        counts.add(&TOUCHED, Label::Touches, true);
        counts.add(&CHANGED, Label::Touches, false);
        counts.add(&CHANGED, Label::Right, true);
        let expected = Counts {
            falls: 2,
            avoidable: 1,
            contacts: 1,
            relievable: 1,
            changes: 2,
            needed: 1,
        };
        assert_eq!(counts, expected);
    }

    #[test]
    fn remedies_are_smaller_and_slower_and_only_for_their_joints() {
        let robot = Robot::load(&Path::new(env!("CARGO_MANIFEST_DIR")).join("../robots/emp27"));
        let robot = robot.unwrap();
        let waist = Remedy {
            joints: vec!["waist".to_owned()],
            amplitude: 0.5,
            speed: 5.0,
        };
        let settings = HindsightSettings {
            against_falls: vec![waist],
            ..EmpSettings::preset(Preset::Default).hindsight
        };
        let hindsight = Hindsight::new(&robot, &settings);
        let default = hindsight.default_pose.clone();
        let asked: Vec<f32> = default.iter().map(|angle| angle + 0.4).collect();
        let answer: Vec<f32> = default.iter().map(|angle| angle + 0.3).collect();
        let mut replay = replay(Candidate::Tamed(0), End::None, 0.0);
        replay.goals.clear();
        replay.lived = 0;
        replay.held = asked.clone();
        // 5 rad/s are 0.1 rad a control period.
        for expected in [0.3, 0.2, 0.2] {
            let goal = hindsight.goal(&replay, &asked, &answer);
            for (j, (goal, default)) in goal.iter().zip(&default).enumerate() {
                let tamed = hindsight.remedies[0].tamed[j];
                let expected = if tamed { expected } else { 0.3 };
                assert!(
                    (goal - default - expected).abs() < 1e-6,
                    "joint {j}: {goal}"
                );
            }
            replay.execute(&goal, &asked, 2);
            replay.come_of(End::None, 1.0, 2);
        }
        assert_eq!(replay.goals.len(), 2 * default.len());
        assert_eq!((replay.contact, replay.lived), (2.0, 3));
        for (candidate, change) in [(Candidate::Asked, 0.4), (Candidate::Half, 0.35)] {
            replay.candidate = candidate;
            let goal = hindsight.goal(&replay, &asked, &answer);
            assert!((goal[3] - default[3] - change).abs() < 1e-6);
        }
    }

    #[test]
    fn windows_are_fork_points_whose_future_is_known() {
        let settings = EmpSettings::preset(Preset::Default);
        let settings = HindsightSettings {
            window: 2,
            horizon: 3,
            change: 0.1,
            ..settings.hindsight
        };
        let hindsight = Hindsight {
            settings: &settings,
            default_pose: vec![0.0],
            remedies: Vec::new(),
        };
        let fork_point = |period| ForkPoint {
            period,
            ..Default::default()
        };
        // Six control periods; the episode ends with a fall in the second.
        let mut rollout = EmpRollout {
            environments: 1,
            goals: vec![1.0; 6],
            answers: vec![1.0, 1.0, 1.3, 1.0, 1.0, 1.0],
            contact: vec![0.0; 6],
            ends: vec![End::None; 6],
            fork_points: [0, 2, 4].map(fork_point).to_vec(),
            ..EmpRollout::default()
        };
        rollout.ends[1] = End::Terminated;
        let found: Vec<_> = hindsight
            .windows(&rollout)
            .iter()
            .map(|window| {
                (
                    window.fork_point,
                    window.periods,
                    window.fell,
                    window.changed,
                )
            })
            .collect();
        // Of the last fork point's three control periods only two are known.
        assert_eq!(found, [(0, 2, true, false), (1, 2, false, true)]);
    }
}
