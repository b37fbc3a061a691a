use std::path::Path;

use emp_robot::RobotError;
use proptest::prelude::*;

use super::*;
use crate::observation::{HISTORY, ObservationLayout};

/// Every robot that is there.
fn robots() -> Vec<Arc<Robot>> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../robots");
    let load = |folder: &std::path::PathBuf| match Robot::load(folder) {
        Ok(robot) => Some(Arc::new(robot)),
        Err(error @ RobotError::NotFetched { .. }) => {
            println!("skipped: {error}");
            None
        }
        Err(error) => panic!("{error}"),
    };
    let folders = emp_robot::robot_folders(&folder).unwrap();
    folders.iter().filter_map(load).collect()
}

fn filter(robot: &Arc<Robot>, specification: &str) -> Arc<dyn GoalFilter> {
    by_name(specification, robot, None).unwrap().unwrap()
}

fn refused(specification: &str) -> String {
    match by_name(specification, &robots()[0], None) {
        Ok(_) => panic!("{specification} was accepted"),
        Err(error) => error.to_string(),
    }
}

fn rest(robot: &Robot) -> Vec<f32> {
    robot.default_goal()
}

/// A pose at a share (0..1, one a joint) of each goal joint's range.
fn pose(robot: &Robot, shares: &[f32]) -> Vec<f32> {
    let joints = robot.goal_joints().iter().zip(shares);
    joints
        .map(|(joint, share)| {
            let [lower, upper] = joint.range.map(|limit| limit as f32);
            (lower + share * (upper - lower)).clamp(lower, upper)
        })
        .collect()
}

/// An observation of the robot in its default pose, tilted.
fn observation(robot: &Robot, roll: f32, pitch: f32) -> Vec<f32> {
    let layout = ObservationLayout::new(robot, HISTORY);
    let mut frame = vec![0.0; layout.frame_width()];
    for (angle, joint) in frame[layout.joint_positions()]
        .iter_mut()
        .zip(robot.joints())
    {
        *angle = joint.default as f32;
    }
    frame[layout.orientation()].copy_from_slice(&[roll, pitch, 0.0]);
    frame.repeat(HISTORY)
}

/// What comes out of a filter when these goals go in, one a control period.
fn run(filter: &dyn GoalFilter, robot: &Robot, goals: &[Vec<f32>]) -> Vec<Vec<f32>> {
    let observation = observation(robot, 0.0, 0.0);
    let mut memory = Vec::new();
    let step = |goal: &Vec<f32>| {
        let mut goal = goal.clone();
        let item = FilterItem {
            observation: &observation,
            goal: &mut goal,
            memory: &mut memory,
            risk: &mut None,
        };
        filter.filter(&mut [item]).unwrap();
        goal
    };
    goals.iter().map(step).collect()
}

/// From the default pose to a pose 0.3 rad (or the range's end) away in every joint, after 5 frames.
fn step(robot: &Robot, frames: usize) -> Vec<Vec<f32>> {
    let rest = rest(robot);
    let far = rest.iter().zip(robot.goal_joints());
    let far: Vec<f32> = far
        .map(|(angle, joint)| (angle + 0.3).min(joint.range[1] as f32))
        .collect();
    let frame = |t: usize| if t < 5 { rest.clone() } else { far.clone() };
    (0..frames).map(frame).collect()
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]

    #[test]
    fn goals_stay_numbers_inside_the_ranges(
        shares in prop::collection::vec(prop::collection::vec(-0.2_f32..1.2, 15), 1..12),
    ) {
        for robot in robots() {
            let goals: Vec<Vec<f32>> = shares.iter().map(|share| {
                // Goals may ask for more than the joints can do.
                robot.goal_joints().iter().zip(share).map(|(joint, share)| {
                    (joint.range[0] + f64::from(*share) * (joint.range[1] - joint.range[0])) as f32
                }).collect()
            }).collect();
            for filter in rules() {
                let answers = run(&*self::filter(&robot, filter.name), &robot, &goals);
                for (angle, joint) in answers.iter().flat_map(|goal| goal.iter().zip(robot.goal_joints())) {
                    let [lower, upper] = joint.range.map(|limit| limit as f32);
                    prop_assert!((lower..=upper).contains(angle), "{}: {angle}", filter.name);
                }
            }
        }
    }

    #[test]
    fn the_centre_of_mass_keeps_its_margin(
        shares in prop::collection::vec(0.0_f32..=1.0, 15),
        margin in 0.0..0.07,
        tilt in prop::array::uniform2(-0.02_f32..0.02),
    ) {
        for robot in robots() {
            let goal = pose(&robot, &shares);
            for legs in ["default", "measured"] {
                let specification = format!("static-clamp:margin={margin},legs={legs}");
                let mut parameters = Parameters::parse(&specification).unwrap();
                let Ok(clamp) = StaticClamp::new(&mut parameters, &robot) else {
                    // The robot's default pose has less.
                    continue;
                };
                let [roll, pitch] = if legs == "measured" { tilt } else { [0.0; 2] };
                let orientation =
                    nalgebra::UnitQuaternion::from_euler_angles(f64::from(roll), f64::from(pitch), 0.0);
                let margin_of = |goal: &[f32]| {
                    let legs = robot.leg_joints().iter().map(|joint| joint.default as f32);
                    let q: Vec<f32> = goal.iter().copied().chain(legs).collect();
                    clamp.margin(&q, &orientation)
                };
                let mut clamped = goal.clone();
                let mut memory = Vec::new();
                clamp.apply(&mut FilterItem {
                    observation: &observation(&robot, tilt[0], tilt[1]),
                    goal: &mut clamped,
                    memory: &mut memory,
 risk: &mut None,
                });
                let rest = rest(&robot);
                if margin_of(&goal) >= margin + 1e-6 {
                    prop_assert_eq!(&clamped, &goal);
                } else if margin_of(&rest) >= margin {
                    prop_assert!(margin_of(&clamped) >= margin - 1e-6, "{}", margin_of(&clamped));
                } else {
                    prop_assert_eq!(&clamped, &rest);
                }
            }
        }
    }
}

/// The filters that need no learning.
fn rules() -> impl Iterator<Item = FilterDescription> {
    let learnt = [DECOUPLED, EMP, EMP_WHEN_DANGER];
    LIST.into_iter()
        .filter(move |filter| !learnt.contains(&filter.name))
}

#[test]
fn what_is_no_rule_is_no_filter_or_needs_weights() {
    let robot = &robots()[0];
    let none = by_name(DECOUPLED, robot, None).unwrap();
    assert!(none.is_none());
    for name in [EMP, EMP_WHEN_DANGER] {
        let message = refused(name);
        assert!(message.contains("has no EMP weights"), "{message}");
    }
}

#[test]
fn every_filter_of_the_list_has_its_defaults() {
    for robot in robots() {
        let goals = step(&robot, 40);
        for FilterDescription {
            name, parameters, ..
        } in rules()
        {
            let by_default = filter(&robot, name);
            assert_eq!(by_default.name(), name);
            // A parameter in angle brackets has no one number.
            let numbers = parameters.split(',').filter(|part| !part.contains('<'));
            let numbers: Vec<&str> = numbers.collect();
            let specification = match numbers.is_empty() {
                true => name.to_owned(),
                false => format!("{name}:{}", numbers.join(",")),
            };
            let spelled_out = filter(&robot, &specification);
            assert_eq!(spelled_out.name(), specification);
            assert_eq!(
                run(&*by_default, &robot, &goals),
                run(&*spelled_out, &robot, &goals)
            );
        }
    }
}

#[test]
fn what_rests_near_the_default_pose_passes_all_but_the_cut() {
    for robot in robots() {
        let goals = vec![rest(&robot); 10];
        for filter in rules() {
            assert_eq!(
                run(&*self::filter(&robot, filter.name), &robot, &goals),
                goals
            );
        }
    }
}

#[test]
fn a_step_becomes_a_ramp_at_the_limit() {
    for robot in robots() {
        let answers = run(
            &*filter(&robot, "velocity-limit:limit=2"),
            &robot,
            &step(&robot, 20),
        );
        let offset = |t: usize| answers[t][1] - rest(&robot)[1];
        for (t, expected) in [
            (4, 0.0),
            (5, 0.04),
            (7, 0.12),
            (11, 0.28),
            (12, 0.3),
            (19, 0.3),
        ] {
            assert!((offset(t) - expected).abs() < 1e-5, "{t}: {}", offset(t));
        }
        // The joints' own limits are above 0.3 rad a frame for g1 alone.
        let own = run(
            &*filter(&robot, "velocity-limit"),
            &robot,
            &step(&robot, 20),
        );
        let largest = robot.goal_joints()[1].velocity_limit / robot.control_rate_hz();
        let first = f64::from(own[5][1] - own[4][1]);
        assert!((first - largest.min(0.3)).abs() < 1e-5, "{first}");
    }
}

#[test]
fn low_passes_follow_a_step_without_overshoot_and_a_ramp_with_their_lag() {
    for robot in robots() {
        for specification in ["low-pass", "low-pass:order=2", "one-euro"] {
            let filter = filter(&robot, specification);
            let answers = run(&*filter, &robot, &step(&robot, 120));
            let way: Vec<f32> = answers.iter().map(|goal| goal[1] - answers[0][1]).collect();
            assert!(way[5] > 0.0 && way[5] < 0.15, "{specification}: {}", way[5]);
            assert!(
                way.windows(2).all(|pair| pair[1] >= pair[0]),
                "{specification}"
            );
            assert!(
                (way[119] - 0.3).abs() < 1e-3,
                "{specification}: {}",
                way[119]
            );
        }
        let ramp: Vec<Vec<f32>> = (0..100)
            .map(|t| {
                rest(&robot)
                    .iter()
                    .map(|angle| angle - 0.004 * t as f32)
                    .collect()
            })
            .collect();
        for (order, lag) in [(1, 0.0796), (2, 0.1024)] {
            let specification = format!("low-pass:cutoff=2,order={order}");
            let answers = run(&*filter(&robot, &specification), &robot, &ramp);
            // Sampling takes half a frame a section off the lag of the continuous filter.
            let found = f64::from(answers[99][1] - ramp[99][1]) / 0.004 / 50.0;
            assert!(
                (found - lag + 0.01 * f64::from(order)).abs() < 2e-3,
                "{order}: {found}"
            );
        }
    }
}

#[test]
fn half_the_power_passes_at_the_cutoff() {
    let robot = &robots()[0];
    for order in [1, 2] {
        let swing: Vec<Vec<f32>> = (0..400)
            .map(|t| {
                let phase = std::f32::consts::TAU * 2.0 * t as f32 / 50.0;
                rest(robot)
                    .iter()
                    .map(|angle| angle + 0.1 * phase.sin())
                    .collect()
            })
            .collect();
        let specification = format!("low-pass:cutoff=2,order={order}");
        let answers = run(&*filter(robot, &specification), robot, &swing);
        let power: f32 = answers[300..]
            .iter()
            .map(|goal| (goal[1] - rest(robot)[1]).powi(2))
            .sum::<f32>()
            / 100.0;
        let share = power / (0.5 * 0.1 * 0.1);
        assert!((share - 0.5).abs() < 0.06, "{order}: {share}");
    }
}

#[test]
fn one_euro_lags_less_at_speed() {
    let robot = &robots()[0];
    let lag = |beta: f32| {
        let ramp: Vec<Vec<f32>> = (0..40)
            .map(|t| {
                rest(robot)
                    .iter()
                    .map(|angle| angle - 0.04 * t as f32)
                    .collect()
            })
            .collect();
        let answers = run(
            &*filter(robot, &format!("one-euro:beta={beta}")),
            robot,
            &ramp,
        );
        (answers[30][1] - ramp[30][1]) / 0.04
    };
    let (fixed, open) = (lag(0.0), lag(2.0));
    assert!(open < 0.6 * fixed, "{open} and {fixed} frames");
}

#[test]
fn a_cut_shrinks_every_offset() {
    for robot in robots() {
        let goal = pose(&robot, &[0.8; 15]);
        let cut = run(
            &*filter(&robot, "amplitude-cut:factor=0.75"),
            &robot,
            std::slice::from_ref(&goal),
        );
        for ((cut, goal), rest) in cut[0].iter().zip(&goal).zip(rest(&robot)) {
            assert!((cut - rest - 0.75 * (goal - rest)).abs() < 1e-6);
        }
    }
}

#[test]
fn a_soft_knee_bends_the_joints_that_it_names() {
    for robot in robots() {
        let specification = "soft-knee:shoulder_pitch=-1.5,left_shoulder_roll=1,slope=0.5";
        let filter = filter(&robot, specification);
        let with = |changes: &[(&str, f32)]| -> Vec<f32> {
            let joints = robot.goal_joints().iter();
            joints
                .map(|joint| {
                    let change = changes.iter().find(|(word, _)| joint.name.contains(word));
                    change.map_or(joint.default as f32, |(_, angle)| *angle)
                })
                .collect()
        };
        let bent = |changes: &[(&str, f32)]| run(&*filter, &robot, &[with(changes)])[0].clone();
        let overhead = [("right_shoulder_pitch", -2.5), ("left_shoulder_roll", 1.4)];
        let expected = [("right_shoulder_pitch", -2.0), ("left_shoulder_roll", 1.2)];
        for (found, expected) in bent(&overhead).iter().zip(with(&expected)) {
            assert!((found - expected).abs() < 1e-6);
        }
        // Not reached, the other side, another joint.
        let free = [
            ("left_shoulder_pitch", -1.4),
            ("right_shoulder_pitch", 1.0),
            ("right_shoulder_roll", -1.4),
        ];
        assert_eq!(bent(&free), with(&free));
    }
}

#[test]
fn arms_stretched_forward_are_pulled_back_to_the_line() {
    let robot = &robots()[0];
    // Both arms forward, elbows straight.
    let joints = robot.goal_joints().iter();
    let goal: Vec<f32> = joints
        .map(|joint| match joint.name.as_str() {
            name if name.contains("shoulder_pitch") => -1.57,
            name if name.contains("elbow") => 0.0,
            _ => joint.default as f32,
        })
        .collect();
    let loose = run(
        &*filter(robot, "static-clamp:margin=0"),
        robot,
        std::slice::from_ref(&goal),
    );
    assert_eq!(loose[0], goal);
    let tight = run(
        &*filter(robot, "static-clamp:margin=0.09"),
        robot,
        std::slice::from_ref(&goal),
    );
    let rest = rest(robot);
    let share = |joint: usize| (tight[0][joint] - rest[joint]) / (goal[joint] - rest[joint]);
    let (pitch, elbow) = (share(1), share(4));
    assert!(
        (pitch - elbow).abs() < 1e-3,
        "{pitch} and {elbow}: one line"
    );
    assert!((0.05..0.95).contains(&pitch), "{pitch}");
}

#[test]
fn robots_of_a_batch_do_not_mix() {
    let robot = &robots()[0];
    let observation = observation(robot, 0.0, 0.0);
    let goals = [step(robot, 20), vec![pose(robot, &[0.6; 15]); 20]];
    for description in rules() {
        let filter = filter(robot, description.name);
        let alone = goals.each_ref().map(|goals| run(&*filter, robot, goals));
        let mut memories = [Vec::new(), Vec::new()];
        let mut risks = [None; 2];
        for t in 0..20 {
            let mut frame = [goals[0][t].clone(), goals[1][t].clone()];
            let mut items: Vec<FilterItem<'_>> = frame
                .iter_mut()
                .zip(&mut memories)
                .zip(&mut risks)
                .map(|((goal, memory), risk)| FilterItem {
                    observation: &observation,
                    goal,
                    memory,
                    risk,
                })
                .collect();
            filter.filter(&mut items).unwrap();
            assert_eq!(frame, [alone[0][t].clone(), alone[1][t].clone()]);
        }
    }
}

#[test]
fn mistakes_in_a_specification_are_named() {
    for (specification, words) in [
        ("emp2", &["emp2", "soft-knee", "decoupled"][..]),
        ("low-pass:cutoff", &["low-pass", "key=value", "cutoff"]),
        ("low-pass:cutoff=2,cutoff=3", &["once", "cutoff=3"]),
        (
            "low-pass:cutof=2",
            &["low-pass", "cutof", "cutoff, order or joints"],
        ),
        ("low-pass:cutoff=fast", &["cutoff", "0.01 to 25 Hz", "fast"]),
        ("low-pass:order=3", &["order", "1 or 2", "3"]),
        ("velocity-limit:limit=NaN", &["limit", "rad/s", "NaN"]),
        ("amplitude-cut:factor=1.5", &["factor", "0 to 1", "1.5"]),
        ("soft-knee:wing=1", &["soft-knee", "wing", "goal joint"]),
        ("soft-knee:waist_yaw=9", &["waist_yaw", "-1.5 to 1.5", "9"]),
        (
            "static-clamp:legs=long",
            &["legs", "default or measured", "long"],
        ),
        (
            "static-clamp:margin=0.5",
            &["margin", "default pose", "0.5"],
        ),
        ("decoupled:x=1", &["decoupled", "x", "none"]),
        ("", &["no filter", "decoupled"]),
    ] {
        let message = refused(specification);
        for word in words {
            assert!(message.contains(word), "{specification}: {message}");
        }
    }
}

#[test]
fn a_filter_by_joint_can_be_for_some_of_them() {
    for robot in robots() {
        let goals = step(&robot, 12);
        for filter in [
            "velocity-limit:limit=1",
            "low-pass:cutoff=1",
            "one-euro",
            "amplitude-cut",
        ] {
            let joined = if filter.contains(':') { ',' } else { ':' };
            let some = format!("{filter}{joined}joints=waist+shoulder_roll");
            let all = run(&*self::filter(&robot, filter), &robot, &goals);
            let some = run(&*self::filter(&robot, &some), &robot, &goals);
            for (t, goal) in goals.iter().enumerate() {
                for (j, joint) in robot.goal_joints().iter().enumerate() {
                    let is_meant =
                        joint.name.contains("waist") || joint.name.contains("shoulder_roll");
                    let expected = if is_meant { all[t][j] } else { goal[j] };
                    assert_eq!(some[t][j], expected, "{filter}: {} at {t}", joint.name);
                }
            }
        }
    }
}

#[test]
fn combined_filters_answer_one_after_the_other() {
    for robot in robots() {
        let goals = step(&robot, 20);
        let parts = [
            "amplitude-cut:factor=0.5",
            "low-pass:cutoff=2,order=2",
            "velocity-limit:limit=1,joints=shoulder",
        ];
        let mut expected = goals.clone();
        for part in parts {
            expected = run(&*filter(&robot, part), &robot, &expected);
        }
        let chain = filter(&robot, &parts.join(">"));
        assert_eq!(run(&*chain, &robot, &goals), expected);
        assert_eq!(chain.name(), parts.join(">"));
        assert_ne!(expected, run(&*filter(&robot, parts[0]), &robot, &goals));
    }
}

#[test]
fn joints_and_combinations_that_are_none_are_refused() {
    for (specification, part) in [
        ("velocity-limit:joints=tail", "found tail"),
        ("velocity-limit:joints=", "joined by +"),
        ("velocity-limit:joints=waist+", "joined by +"),
        ("static-clamp:joints=waist", "no parameter \"joints\""),
        ("amplitude-cut>emp", "filter emp cannot be combined"),
        (
            "decoupled>amplitude-cut",
            "filter decoupled cannot be combined",
        ),
        ("amplitude-cut>", "no filter \"\""),
        ("amplitude-cut>nothing", "no filter \"nothing\""),
        ("amplitude-cut:factor=2>low-pass", "factor"),
    ] {
        let error = refused(specification);
        assert!(error.contains(part), "{specification}: {error}");
    }
}
