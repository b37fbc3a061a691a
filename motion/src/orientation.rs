//! Which axis of a file points up, whether the file holds a mirror image, and how tall its person is.
//!
//! Nothing of that stands in most files. The body tells it: the trunk is above the feet, the lowest point of a pose
//! rests on the floor at zero, toes point forward, knees bend forward and elbows backward.

use nalgebra::Vector3;

use crate::{KEY_NODES, KeyNode, Side, UpAxis};

/// What a pose's legs say next to its legs' weight of 1, where the file has legs.
const TRUNK_WEIGHT: f64 = 0.5;
/// The trunk's weight where it is alone.
const TRUNK_ALONE_WEIGHT: f64 = 1.5;
/// Weight of the rest pose, which in some files keeps another axis up than the motion.
const REST_WEIGHT: f64 = 1.25;
/// Weight of standing on a floor at zero, and of having the feet deep below it while the file counts heights from it.
const FLOOR_WEIGHT: f64 = 1.0;
/// Weight of the axis that a format prescribes or its files say.
const PRIOR_WEIGHT: f64 = 0.75;
/// The lowest point lies within about this share of a body's size from the floor, …
const FLOOR_BAND: f64 = 0.1;
/// … and the waist at least this share above it.
const WAIST_ABOVE_FLOOR: f64 = 0.08;
/// A body whose lowest point is farther below zero than this share of its size is buried.
const BURIED: f64 = 0.25;
/// Shares of a body's size between which a waist's height over a floor lies, and how far it strays.
const WAIST_HEIGHT: std::ops::Range<f64> = 0.2..0.9;
const WAIST_STRAYS: f64 = 0.12;
/// Two axes whose scores are nearer than this are both likely.
const CLEAR_LEAD: f64 = 0.3;
/// Cosine between trunk and legs above which a rest pose stands upright.
const UPRIGHT: f64 = 0.8;
/// A limb whose middle joint is off the straight line by this share of its length is bent.
const BENT: f64 = 0.08;
/// Least number of limbs and poses that must show a direction.
const LEAST_SHOWS: usize = 2;
/// A body whose signs add up to less is its own mirror image.
const MIRRORED_BELOW: f64 = -0.4;

/// One pose with what tells its orientation; file units and axes.
#[derive(Clone, Debug)]
pub(crate) struct Probe {
    pub(crate) positions: [Vector3<f64>; KEY_NODES],
    /// From the right hip to the left one (shoulders where there are no hips).
    pub(crate) left: Vector3<f64>,
    pub(crate) legs: Option<[Leg; 2]>,
    /// Least and greatest coordinates of all joints.
    pub(crate) bounds: [Vector3<f64>; 2],
    /// The same without the arms.
    pub(crate) height_bounds: Option<[Vector3<f64>; 2]>,
}

/// One leg of a pose.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Leg {
    pub(crate) hip: Vector3<f64>,
    pub(crate) knee: Vector3<f64>,
    pub(crate) ankle: Vector3<f64>,
    pub(crate) toe: Option<Vector3<f64>>,
}

impl Probe {
    fn shoulders(&self) -> Vector3<f64> {
        let node = |n: KeyNode| self.positions[n as usize];
        (node(KeyNode::LeftShoulder) + node(KeyNode::RightShoulder)) * 0.5
    }

    fn waist(&self) -> Vector3<f64> {
        self.positions[KeyNode::Waist as usize]
    }

    /// From the ankles to the waist.
    fn leg_line(&self) -> Option<Vector3<f64>> {
        let [left, right] = self.legs.as_ref()?;
        Some(self.waist() - (left.ankle + right.ankle) * 0.5)
    }

    /// Along the trunk and the legs, whatever the pose.
    fn size(&self) -> f64 {
        let trunk = (self.shoulders() - self.waist()).norm();
        trunk + self.leg_line().map_or(trunk, |line| line.norm())
    }

    /// How far each foot points forward, −1 to 1, where its leg stands.
    fn toes_forward(&self, up: &Vector3<f64>) -> Vec<f64> {
        let toe = |leg: &Leg| {
            let foot = level(leg.toe? - leg.ankle, up).filter(|_| leg.stands(up))?;
            Some(foot.dot(&self.forward(up)?))
        };
        self.legs.iter().flatten().filter_map(toe).collect()
    }

    /// How far each bent knee points forward, where its leg stands.
    fn knees_forward(&self, up: &Vector3<f64>) -> Vec<f64> {
        let knee = |leg: &Leg| {
            let knee = bend(leg.hip, leg.knee, leg.ankle).filter(|_| leg.stands(up))?;
            Some(knee.dot(&self.forward(up)?))
        };
        self.legs.iter().flatten().filter_map(knee).collect()
    }

    /// How far each bent elbow of an arm that hangs from an upright trunk points backward.
    fn elbows_backward(&self, up: &Vector3<f64>) -> Vec<f64> {
        let trunk = self.shoulders() - self.waist();
        let elbow = |side: Side| {
            let [shoulder, elbow, wrist] = side.arm().map(|node| self.positions[node as usize]);
            // A raised arm may bend any way.
            let told = is_along(&trunk, up) && (elbow - shoulder).dot(up) < 0.0;
            let bend = bend(shoulder, elbow, wrist).filter(|_| told)?;
            Some(-bend.dot(&self.forward(up)?))
        };
        Side::BOTH.into_iter().filter_map(elbow).collect()
    }

    fn forward(&self, up: &Vector3<f64>) -> Option<Vector3<f64>> {
        self.left.cross(up).try_normalize(0.2 * self.left.norm())
    }
}

impl Leg {
    /// Whether the leg is about upright.
    fn stands(&self, up: &Vector3<f64>) -> bool {
        is_along(&(self.hip - self.ankle), up)
    }
}

/// Whether a direction is within 60° of another.
fn is_along(v: &Vector3<f64>, up: &Vector3<f64>) -> bool {
    v.dot(up) > 0.5 * v.norm()
}

/// Lowest and highest coordinates of some points.
pub(crate) fn bounds(points: impl Iterator<Item = Vector3<f64>>) -> Option<[Vector3<f64>; 2]> {
    points.fold(None, |bounds, p| {
        let [low, high] = bounds.unwrap_or([p, p]);
        Some([low.inf(&p), high.sup(&p)])
    })
}

/// The axis that points up, and a warning where a second one is nearly as likely.
pub(crate) fn up_axis(
    probes: &[Probe],
    rest: Option<&Probe>,
    prior: Option<UpAxis>,
) -> (UpAxis, Option<String>) {
    let from_floor = UpAxis::ALL
        .iter()
        .any(|axis| counts_from_floor(*axis, probes));
    let mut scored = UpAxis::ALL.map(|axis| {
        let told = f64::from(u8::from(prior == Some(axis)));
        let buried = f64::from(u8::from(from_floor)) * buried(axis, probes);
        let score = score(axis, probes, rest) + PRIOR_WEIGHT * told - FLOOR_WEIGHT * buried;
        (score, axis)
    });
    scored.sort_by(|a, b| b.0.total_cmp(&a.0));
    let [(first, up), (second, other), ..] = scored;
    let unsure = (first - second < CLEAR_LEAD)
        .then(|| format!("{up} is taken as up, but {other} is nearly as likely: --up tells"));
    (up, unsure)
}

fn score(axis: UpAxis, probes: &[Probe], rest: Option<&Probe>) -> f64 {
    let up = axis.direction();
    let along = |v: Vector3<f64>| v.try_normalize(1e-9).map_or(0.0, |v| v.dot(&up));
    let trunk = mean(probes.iter().map(|p| along(p.shoulders() - p.waist())));
    let legs: Option<f64> = probes
        .iter()
        .map(|p| p.leg_line().map(along))
        .collect::<Option<Vec<f64>>>()
        .map(|legs| mean(legs.into_iter()));
    let stands = match legs {
        Some(legs) => legs + TRUNK_WEIGHT * trunk,
        None => TRUNK_ALONE_WEIGHT * trunk,
    };
    let rest = rest.and_then(rest_line).map_or(0.0, along);
    let floor = mean(probes.iter().map(|p| on_floor(p, &up)));
    let tilt = mean(probes.iter().map(|p| along(p.left).abs()));
    stands + REST_WEIGHT * rest.max(0.0) + FLOOR_WEIGHT * floor - tilt
}

/// The direction of a rest pose that stands upright.
fn rest_line(rest: &Probe) -> Option<Vector3<f64>> {
    let trunk = (rest.shoulders() - rest.waist()).try_normalize(1e-9)?;
    let Some(legs) = rest.leg_line() else {
        return Some(trunk);
    };
    (legs.try_normalize(1e-9)?.dot(&trunk) > UPRIGHT).then_some(trunk)
}

/// The lowest coordinate along an axis.
fn lowest(probe: &Probe, up: &Vector3<f64>) -> f64 {
    let [low, high] = probe.bounds;
    up.dot(&low).min(up.dot(&high))
}

/// How well a pose rests on a floor at zero, 0 to 1.
fn on_floor(probe: &Probe, up: &Vector3<f64>) -> f64 {
    let (lowest, size) = (lowest(probe, up), probe.size());
    if up.dot(&probe.waist()) - lowest > WAIST_ABOVE_FLOOR * size {
        (-(lowest / (FLOOR_BAND * size)).powi(2)).exp()
    } else {
        0.0
    }
}

/// The share of poses that reach deep below zero along an axis.
fn buried(axis: UpAxis, probes: &[Probe]) -> f64 {
    let up = axis.direction();
    let deep = |p: &Probe| lowest(p, &up) < -BURIED * p.size();
    mean(probes.iter().map(|p| f64::from(u8::from(deep(p)))))
}

/// Whether the waist keeps a person's height over zero along an axis. In a file in which it does so along none, heights
/// are not counted from a floor.
fn counts_from_floor(axis: UpAxis, probes: &[Probe]) -> bool {
    let up = axis.direction();
    let height = |p: &Probe| up.dot(&p.waist()) / p.size();
    let middle = mean(probes.iter().map(height));
    let strays = mean(probes.iter().map(|p| (height(p) - middle).abs()));
    WAIST_HEIGHT.contains(&middle) && strays < WAIST_STRAYS
}

/// Whether the body is its own mirror image; `None` where neither legs nor arms tell.
/// `thumbs` is how far the thumbs point forward at rest, −1 to 1.
pub(crate) fn is_mirrored(
    probes: &[Probe],
    rest: Option<&Probe>,
    up: UpAxis,
    thumbs: Option<f64>,
) -> Option<bool> {
    let up = up.direction();
    let toes = sign(probes.iter().flat_map(|p| p.toes_forward(&up)));
    let knees = sign(probes.iter().flat_map(|p| p.knees_forward(&up)));
    let elbows = sign(probes.iter().flat_map(|p| p.elbows_backward(&up)));
    // A rest pose may have an up axis of its own.
    let at_rest = rest.and_then(|rest| Some((rest, rest_line(rest)?)));
    let toes_at_rest = at_rest.and_then(|(rest, up)| sign(rest.toes_forward(&up).into_iter()));
    let signs = [
        (toes, 2.0),
        (toes_at_rest, 2.0),
        (knees, 1.5),
        (thumbs, 1.0),
        (elbows, 0.75),
    ];
    let (sum, weight) = signs
        .into_iter()
        .filter_map(|(sign, weight)| Some((sign? * weight, weight)))
        .fold((0.0, 0.0), |(s, w), (sign, weight)| (s + sign, w + weight));
    (weight > 0.0).then(|| sum / weight < MIRRORED_BELOW)
}

/// The mean of what limbs and poses show, where enough of them show it.
fn sign(values: impl Iterator<Item = f64>) -> Option<f64> {
    let values: Vec<f64> = values.collect();
    (values.len() >= LEAST_SHOWS).then(|| mean(values.iter().copied()))
}

/// The horizontal direction of a foot that is not on its tip.
fn level(v: Vector3<f64>, up: &Vector3<f64>) -> Option<Vector3<f64>> {
    (v - up * up.dot(&v)).try_normalize(0.3 * v.norm().max(1e-9))
}

/// Where the middle joint of a bent limb points.
fn bend(a: Vector3<f64>, middle: Vector3<f64>, b: Vector3<f64>) -> Option<Vector3<f64>> {
    let line = (b - a).try_normalize(1e-9)?;
    let off = (middle - a) - line * line.dot(&(middle - a));
    let length = (middle - a).norm() + (b - middle).norm();
    off.try_normalize(BENT * length)
}

/// How tall the person is in file units: what most poses reach, arms aside.
pub(crate) fn height(probes: &[Probe], up: UpAxis) -> Option<f64> {
    let up = up.direction().abs();
    let mut heights: Vec<f64> = probes
        .iter()
        .map(|p| p.height_bounds.map(|[low, high]| up.dot(&(high - low))))
        .collect::<Option<_>>()?;
    heights.sort_by(f64::total_cmp);
    heights.get(heights.len() * 9 / 10).copied()
}

pub(crate) fn mean(values: impl Iterator<Item = f64>) -> f64 {
    let (sum, count) = values.fold((0.0, 0.0), |(s, n), v| (s + v, n + 1.0));
    sum / count
}
