use proptest::prelude::*;

use super::*;

const SETTINGS: GuardSettings = GuardSettings {
    ramp: Duration::from_secs(1),
    stale_after: Duration::from_millis(300),
    return_after: Duration::from_secs(2),
};
/// Control periods of a ramp that is not stretched.
const RAMP: usize = 50;
/// Rounding of angles, rad.
const TOLERANCE: f32 = 1e-5;

const FRESH: Duration = Duration::ZERO;
const STALE: Duration = Duration::from_millis(300);
const LONG: Duration = Duration::from_secs(2);

fn robot() -> Robot {
    Robot::load("../robots/emp27".as_ref()).expect("emp27")
}

fn default_pose(robot: &Robot) -> Vec<f32> {
    let joints = robot.goal_joints().iter();
    joints.map(|joint| joint.default as f32).collect()
}

/// The default pose moved by `offset`, inside the ranges, rad.
fn pose(robot: &Robot, offset: f32) -> Vec<f32> {
    let moved: Vec<f32> = default_pose(robot).iter().map(|a| a + offset).collect();
    Limits::new(robot, &SETTINGS).inside(&moved)
}

/// A guard and what it is told.
struct Bench {
    robot: Robot,
    guard: GoalGuard,
    measured: Vec<f32>,
    wish: Wish,
    period: Period,
}

/// A control period of emp27.
const PERIOD: Period = Period {
    elapsed: Duration::from_millis(20),
    speed: 1.0,
};

impl Bench {
    fn new() -> Self {
        let robot = robot();
        Self {
            guard: GoalGuard::new(&robot, &SETTINGS),
            measured: pose(&robot, -0.1),
            wish: Wish::Follow,
            period: PERIOD,
            robot,
        }
    }

    fn step(&mut self, offset: f32, age: Duration) -> (Vec<f32>, GoalPhase) {
        let goal = pose(&self.robot, offset);
        self.step_to(Some(&goal), age)
    }

    fn step_to(&mut self, goal: Option<&[f32]>, age: Duration) -> (Vec<f32>, GoalPhase) {
        let (goal, phase) = self.guard.step(&GoalInput {
            goal,
            age,
            measured: &self.measured,
            wish: self.wish,
            period: self.period,
        });
        (goal.to_vec(), phase)
    }

    /// Steps until the goal is followed.
    fn follow(&mut self, offset: f32) {
        for _ in 0..10 * RAMP {
            if self.step(offset, FRESH).1 == GoalPhase::Following {
                return;
            }
        }
        panic!("never followed");
    }
}

fn ramping(cause: RampCause, progress: f32) -> GoalPhase {
    GoalPhase::Ramping { cause, progress }
}

#[test]
fn the_first_frame_begins_at_the_measured_pose_and_ends_at_the_goal() {
    let mut bench = Bench::new();
    let (goal, phase) = bench.step(0.3, FRESH);
    assert_eq!(goal, bench.measured);
    assert_eq!(phase, ramping(RampCause::FirstFrame, 0.0));
    let mut last = goal;
    for period in 1..RAMP {
        let (goal, phase) = bench.step(0.3, FRESH);
        assert_eq!(
            phase,
            ramping(RampCause::FirstFrame, period as f32 / RAMP as f32)
        );
        let (target, start) = (pose(&bench.robot, 0.3), &bench.measured);
        let weight = minimum_jerk(period as f32 / RAMP as f32);
        for joint in 0..goal.len() {
            let expected = start[joint] + weight * (target[joint] - start[joint]);
            assert!((goal[joint] - expected).abs() < TOLERANCE);
            assert!(goal[joint] >= last[joint]);
        }
        last = goal;
    }
    let (goal, phase) = bench.step(0.3, FRESH);
    assert_eq!(
        (goal, phase),
        (pose(&bench.robot, 0.3), GoalPhase::Following)
    );
}

#[test]
fn a_ramp_leads_to_where_the_goal_has_gone_meanwhile() {
    let mut bench = Bench::new();
    for period in 0..RAMP {
        bench.step(0.01 * period as f32, FRESH);
    }
    let (goal, phase) = bench.step(0.5, FRESH);
    assert_eq!(
        (goal, phase),
        (pose(&bench.robot, 0.5), GoalPhase::Following)
    );
}

#[test]
fn a_long_way_takes_longer() {
    let robot = robot();
    let limits = Limits::new(&robot, &SETTINGS);
    let near = vec![0.0; robot.goal_joints().len()];
    let mut far = near.clone();
    far[1] = 3.0;
    let seconds =
        |from: &[f32], to: &[f32], speed| limits.ramp(from, to, speed).length.as_secs_f64();
    assert_eq!(seconds(&near, &near, 1.0), 1.0);
    let joint = &robot.goal_joints()[1];
    let expected = f64::from(PEAK_SLOPE) * 3.0 / (f64::from(RAMP_SPEED) * joint.velocity_limit);
    assert!(expected > 1.0);
    for (from, to) in [(&near, &far), (&far, &near)] {
        assert!((seconds(from, to, 1.0) - expected).abs() < 1e-4);
        assert!((seconds(from, to, 0.5) - 2.0 * expected).abs() < 1e-4);
    }
}

#[test]
fn a_stale_goal_is_held_then_the_robot_goes_home_and_rests() {
    let mut bench = Bench::new();
    bench.follow(0.3);
    let just_fresh = STALE - Duration::from_millis(1);
    assert_eq!(bench.step(0.3, just_fresh).1, GoalPhase::Following);
    let held = (pose(&bench.robot, 0.3), GoalPhase::Holding);
    assert_eq!(bench.step(0.3, STALE), held);
    assert_eq!(bench.step(0.3, LONG - Duration::from_millis(1)), held);
    let returning = |progress| GoalPhase::Returning { progress };
    assert_eq!(bench.step(0.3, LONG), (held.0, returning(0.0)));
    for period in 1..RAMP {
        let phase = bench.step(0.3, LONG).1;
        assert_eq!(phase, returning(period as f32 / RAMP as f32));
    }
    let resting = (default_pose(&bench.robot), GoalPhase::Resting);
    assert_eq!(bench.step(0.3, LONG), resting);
    assert_eq!(bench.step(0.3, LONG * 10), resting);
}

#[test]
fn a_ramp_stops_where_it_is_when_the_goal_becomes_stale() {
    let mut bench = Bench::new();
    for _ in 0..20 {
        bench.step(0.3, FRESH);
    }
    let (stood, _) = bench.step(0.3, FRESH);
    assert_eq!(bench.step(0.3, STALE), (stood, GoalPhase::Holding));
}

#[test]
fn an_operator_who_is_back_is_ramped_to_from_the_goal_that_stands() {
    for away in [STALE, LONG] {
        let mut bench = Bench::new();
        bench.follow(0.3);
        for _ in 0..RAMP / 2 {
            bench.step(0.3, away);
        }
        let (stood, _) = bench.step(0.3, away);
        bench.measured = pose(&bench.robot, 0.5);
        let (goal, phase) = bench.step(-0.3, FRESH);
        assert_eq!(goal, stood, "not from the measured pose");
        assert_eq!(phase, ramping(RampCause::OperatorReturned, 0.0));
        bench.follow(-0.3);
    }
}

#[test]
fn another_operator_is_ramped_to_even_without_a_gap() {
    let mut bench = Bench::new();
    bench.follow(0.3);
    bench.guard.operator_changed();
    let (goal, phase) = bench.step(-0.3, FRESH);
    assert_eq!(goal, pose(&bench.robot, 0.3));
    assert_eq!(phase, ramping(RampCause::OperatorReturned, 0.0));
}

#[test]
fn the_first_operator_of_a_new_robot_is_its_first_frame() {
    let mut bench = Bench::new();
    bench.guard.operator_changed();
    let phase = bench.step(0.3, FRESH).1;
    assert_eq!(phase, ramping(RampCause::FirstFrame, 0.0));
}

#[test]
fn a_robot_that_resumes_is_ramped_from_its_measured_pose() {
    let mut bench = Bench::new();
    bench.follow(0.3);
    bench.guard.restart(RampCause::RobotResumed);
    bench.measured = pose(&bench.robot, 0.1);
    let (goal, phase) = bench.step(0.3, FRESH);
    assert_eq!(goal, bench.measured);
    assert_eq!(phase, ramping(RampCause::RobotResumed, 0.0));
}

#[test]
fn without_any_goal_the_robot_holds_its_pose_then_goes_home() {
    let mut bench = Bench::new();
    let holding = (bench.measured.clone(), GoalPhase::Holding);
    assert_eq!(bench.step_to(None, FRESH), holding);
    bench.measured = pose(&bench.robot, 0.4);
    assert_eq!(bench.step_to(None, STALE), holding, "where it was at first");
    let (goal, phase) = bench.step_to(None, LONG);
    assert_eq!(
        (goal, phase),
        (holding.0, GoalPhase::Returning { progress: 0.0 })
    );
}

#[test]
fn a_ramp_takes_its_seconds_whatever_the_rate() {
    for millis in [5, 20, 33] {
        let mut bench = Bench::new();
        bench.period.elapsed = Duration::from_millis(millis);
        let mut periods = 0;
        while bench.step(0.3, FRESH).1 != GoalPhase::Following {
            periods += 1;
        }
        assert_eq!(periods, 1_000_u64.div_ceil(millis), "{millis} ms");
    }
}

#[test]
fn a_robot_that_was_silent_does_not_catch_up() {
    let mut bench = Bench::new();
    bench.step(0.3, FRESH);
    bench.period.elapsed = Duration::from_secs(1);
    let phase = bench.step(0.3, FRESH).1;
    assert_eq!(phase, ramping(RampCause::FirstFrame, 0.04));
}

#[test]
fn whoever_is_responsible_can_hold_a_robot_and_send_it_home() {
    let mut bench = Bench::new();
    bench.follow(0.3);
    bench.wish = Wish::Hold;
    let held = (pose(&bench.robot, 0.3), GoalPhase::Holding);
    for age in [FRESH, LONG] {
        assert_eq!(bench.step(-0.3, age), held);
    }
    bench.wish = Wish::Rest;
    let home = GoalPhase::Returning { progress: 0.0 };
    assert_eq!(bench.step(-0.3, FRESH), (held.0, home));
    for _ in 0..2 * RAMP {
        bench.step(-0.3, FRESH);
    }
    let resting = (default_pose(&bench.robot), GoalPhase::Resting);
    assert_eq!(bench.step(-0.3, FRESH), resting);
    bench.wish = Wish::Follow;
    let back = bench.step(-0.3, FRESH).1;
    assert_eq!(back, ramping(RampCause::OperatorReturned, 0.0));
}

#[test]
fn frames_that_queued_let_no_more_time_pass_than_their_arrivals() {
    let mut clock = RobotClock::new(&robot());
    let ms = Duration::from_millis;
    assert_eq!(clock.tick(ms(0), Some(ms(500))), ms(20));
    // Jitter of the connection does not slow the robot down.
    for (arrived, measured) in [(35, 520), (40, 540), (75, 560), (80, 580)] {
        assert_eq!(clock.tick(ms(arrived), Some(ms(measured))), ms(20));
    }
    // A stall of 250 ms, then twelve frames at once.
    let burst: Duration = (1..=12)
        .map(|n| clock.tick(ms(330), Some(ms(580 + 20 * n))))
        .sum();
    assert_eq!(burst, ms(40));
    // The same state again, and a clock that goes back.
    assert_eq!(clock.tick(ms(350), Some(ms(820))), ms(0));
    assert_eq!(clock.tick(ms(370), Some(ms(100))), ms(0));
}

#[test]
fn without_the_robots_clock_the_arrivals_count() {
    let mut clock = RobotClock::new(&robot());
    let ms = Duration::from_millis;
    clock.tick(ms(0), None);
    assert_eq!(clock.tick(ms(5), None), ms(5));
    assert_eq!(clock.tick(ms(255), None), ms(40));
    assert_eq!(clock.tick(ms(255), None), ms(0));
}

#[test]
fn a_correction_that_is_no_number_does_not_move_the_robot() {
    let (robot, mut guard) = execution();
    let start = default_pose(&robot);
    guard.step(&start, &start, &mut start.clone());
    let mut goal = vec![f32::NAN; start.len()];
    guard.step(&start, &start, &mut goal);
    assert!(goal.iter().all(|angle| angle.is_finite()));
}

#[test]
fn a_measured_pose_outside_the_ranges_is_brought_inside() {
    let mut bench = Bench::new();
    let upper = bench.robot.goal_joints()[0].range[1] as f32;
    bench.measured[0] = upper + 0.2;
    assert_eq!(bench.step_to(None, FRESH).0[0], upper);
}

/// What the guard reports when it leaves a goal alone.
fn untouched(goal: &[f32]) -> Execution {
    Execution {
        wanted: goal.to_vec(),
        ..Execution::default()
    }
}

/// A guard of execution, and a robot that is where it is told to be.
fn execution() -> (Robot, ExecutionGuard) {
    let robot = robot();
    let guard = ExecutionGuard::new(&robot, &SETTINGS);
    (robot, guard)
}

#[test]
fn without_a_correction_nothing_is_changed() {
    let (robot, mut guard) = execution();
    let measured = pose(&robot, 0.1);
    for offset in [0.1, 0.15, 0.2] {
        let asked = pose(&robot, offset);
        let mut goal = asked.clone();
        let execution = guard.step(&measured, &asked, &mut goal);
        assert_eq!(execution, untouched(&asked));
        assert_eq!(goal, asked);
    }
}

#[test]
fn a_correction_fades_in_at_the_start_and_out_when_the_filter_goes() {
    let (robot, mut guard) = execution();
    let (asked, corrected) = (pose(&robot, 0.1), pose(&robot, 0.25));
    let run = |guard: &mut ExecutionGuard, answer: &[f32], from: f32, to: f32| {
        for period in 0..RAMP {
            let mut goal = answer.to_vec();
            let execution = guard.step(&asked, &asked, &mut goal);
            let progress = period as f32 / RAMP as f32;
            assert_eq!(execution.fade, Some(progress));
            let offset = from + minimum_jerk(progress) * (to - from);
            let joint = 1;
            assert!((goal[joint] - pose(&robot, offset)[joint]).abs() < TOLERANCE);
        }
        let mut goal = answer.to_vec();
        assert_eq!(guard.step(&asked, &asked, &mut goal), untouched(answer));
        assert_eq!(goal, answer);
    };
    run(&mut guard, &corrected, 0.1, 0.25);
    guard.filter_changed();
    run(&mut guard, &asked, 0.25, 0.1);
    guard.filter_changed();
    run(&mut guard, &corrected, 0.1, 0.25);
}

#[test]
fn a_jump_becomes_a_walk_at_the_joints_largest_speed() {
    let (robot, mut guard) = execution();
    let start = default_pose(&robot);
    let mut asked = start.clone();
    asked[1] -= 1.0;
    asked[2] += 0.1;
    let step = (robot.goal_joints()[1].velocity_limit / robot.control_rate_hz()) as f32;
    let mut goal = asked.clone();
    let execution = guard.step(&start, &asked, &mut goal);
    assert_eq!(execution.limited, [1]);
    assert!((goal[1] - (start[1] - step)).abs() < TOLERANCE);
    assert_eq!(goal[2], asked[2]);
    let mut periods = 1;
    let mut next = || {
        let mut goal = asked.clone();
        guard.step(&start, &asked, &mut goal)
    };
    while next() != untouched(&asked) {
        periods += 1;
    }
    assert_eq!(periods, (1.0 / step) as usize);
    let mut slow = ExecutionGuard::new(&robot, &SETTINGS);
    for (millis, speed) in [(20, 0.25), (5, 1.0)] {
        slow.restart();
        let elapsed = Duration::from_millis(millis);
        slow.set_period(Period { elapsed, speed });
        let mut goal = asked.clone();
        slow.step(&start, &asked, &mut goal);
        assert!((goal[1] - (start[1] - step / 4.0)).abs() < TOLERANCE);
    }
}

#[test]
fn a_goal_outside_a_range_is_brought_inside() {
    let (robot, mut guard) = execution();
    let start = default_pose(&robot);
    let [_, upper] = robot.goal_joints()[0].range;
    for _ in 0..100 {
        let mut goal = start.clone();
        goal[0] = upper as f32 + 0.3;
        guard.step(&start, &goal.clone(), &mut goal);
        assert!(goal[0] <= upper as f32);
    }
}

#[test]
fn a_restart_begins_at_the_measured_pose() {
    let (robot, mut guard) = execution();
    let (before, after) = (pose(&robot, 0.0), pose(&robot, 1.0));
    guard.step(&before, &before, &mut before.clone());
    guard.restart();
    let mut goal = after.clone();
    let execution = guard.step(&after, &after, &mut goal);
    assert_eq!(execution, untouched(&after));
}

/// What happens to a robot's stream in a control period.
#[derive(Clone, Debug)]
enum Happening {
    Pose { offset: f32, age: u64 },
    Operator,
    Resume { offset: f32 },
    Filter { correction: f32 },
}

fn happening() -> impl Strategy<Value = Happening> {
    prop_oneof![
        20 => (-2.0_f32..2.0, 0_u64..3_000).prop_map(|(offset, age)| Happening::Pose { offset, age }),
        1 => Just(Happening::Operator),
        1 => (-1.0_f32..1.0).prop_map(|offset| Happening::Resume { offset }),
        2 => (-0.6_f32..0.6).prop_map(|correction| Happening::Filter { correction }),
    ]
}

proptest! {
    /// Whatever comes, the executed goal stays inside the ranges and within the speed limits, from the measured pose on.
    #[test]
    fn no_joint_is_ever_faster_than_it_may_be(happenings in prop::collection::vec(happening(), 1..60)) {
        let robot = robot();
        let (mut before, mut after) = (GoalGuard::new(&robot, &SETTINGS), ExecutionGuard::new(&robot, &SETTINGS));
        let limits = Limits::new(&robot, &SETTINGS);
        let mut measured = pose(&robot, 0.0);
        let (mut newest, mut age, mut correction) = (measured.clone(), FRESH, 0.0);
        for happening in happenings {
            match happening {
                Happening::Pose { offset, age: ms } => {
                    newest = pose(&robot, offset);
                    age = Duration::from_millis(ms);
                }
                Happening::Operator => before.operator_changed(),
                Happening::Resume { offset } => {
                    measured = pose(&robot, offset);
                    before.restart(RampCause::RobotResumed);
                    after.restart();
                }
                Happening::Filter { correction: new } => {
                    correction = new;
                    after.filter_changed();
                }
            }
            for _ in 0..7 {
                let input = GoalInput { goal: Some(&newest), age, measured: &measured, wish: Wish::Follow, period: PERIOD };
                let asked = before.step(&input).0.to_vec();
                let mut goal: Vec<f32> = asked.iter().map(|angle| angle + correction).collect();
                after.step(&measured, &asked, &mut goal);
                for (joint, angle) in goal.iter().enumerate() {
                    let [lower, upper] = limits.ranges[joint];
                    prop_assert!((lower..=upper).contains(angle));
                    prop_assert!((angle - measured[joint]).abs() <= 0.02 * limits.speeds[joint] + TOLERANCE);
                }
                measured = goal;
            }
        }
    }

    /// Between two poses that rest, a ramp starts at the one, ends at the other, and stays within its share of the speed limits.
    #[test]
    fn ramps_are_continuous_and_slow(from in -2.0_f32..2.0, to in -2.0_f32..2.0) {
        let robot = robot();
        let limits = Limits::new(&robot, &SETTINGS);
        let mut guard = GoalGuard::new(&robot, &SETTINGS);
        let (start, end) = (pose(&robot, from), pose(&robot, to));
        let mut last = start.clone();
        let mut periods = 0;
        loop {
            let input = GoalInput { goal: Some(&end), age: FRESH, measured: &start, wish: Wish::Follow, period: PERIOD };
            let (goal, phase) = guard.step(&input);
            for (joint, angle) in goal.iter().enumerate() {
                let step = (angle - last[joint]).abs();
                prop_assert!(step <= RAMP_SPEED * 0.02 * limits.speeds[joint] + TOLERANCE);
                prop_assert!(periods > 0 || step == 0.0);
            }
            last = goal.to_vec();
            periods += 1;
            if phase == GoalPhase::Following {
                break;
            }
        }
        prop_assert_eq!(last, end);
        prop_assert!(periods > RAMP);
    }
}
