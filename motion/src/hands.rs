//! How a wrist joint's own axes are turned into the hand convention: x to the fingers, z to the thumb, y = z × x.

use nalgebra::{Matrix3, Rotation3, Vector3};

use crate::world_frame::WorldFrame;
use crate::{KeyNode, Side};

/// Share of the frames that count as calm.
const CALM_SHARE: f64 = 0.1;
/// Number of calm frames that tell as much as any more.
const ENOUGH: usize = 500;
/// Least cosine between the forearm and straight down of an arm that hangs.
const HANGS: f64 = 0.8;
/// Sine of the least elbow angle at which the elbow tells where the thumb is.
const ELBOW_BENT: f64 = 0.5;
/// Calm frames in which the hand lies differently by more than this on average, radians, tell nothing.
const SPREAD: f64 = 0.6;

/// What a file's skeleton tells of a hand, in the wrist joint's own axes.
#[derive(Clone, Debug)]
pub(crate) enum HandAxes {
    /// The wrist joint's axes are known: this turns them into the convention.
    Fixed(Rotation3<f64>),
    /// What the rest pose tells.
    Rest {
        /// To the fingers.
        fingers: Vector3<f64>,
        /// To the thumb.
        thumb: Thumb,
    },
    /// The wrist turns, but its rest pose says nothing.
    Untold,
    /// There is no wrist that turns; the reason.
    None(&'static str),
}

/// What a rest pose tells of the thumb.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Thumb {
    /// A finger's or the thumb's joint tells.
    Seen(Vector3<f64>),
    /// The arm is stretched sideways with the palm down, so the thumb is where left × up points; the other way round in
    /// a mirror image.
    Forward(Vector3<f64>),
    /// Nothing tells.
    Untold,
}

/// The turn from a wrist joint's axes to the hand's, and how it was found; or why the hand is not followed.
pub(crate) fn solve(
    axes: &HandAxes,
    side: Side,
    frames: &[WorldFrame],
    up: &Vector3<f64>,
    mirrored: bool,
) -> Result<(Rotation3<f64>, &'static str), &'static str> {
    let sign = if mirrored { -1.0 } else { 1.0 };
    let at_rest = |fingers: &Vector3<f64>, thumb: Vector3<f64>| {
        frame_of(*fingers, thumb).ok_or("the rest pose's fingers and thumb are in one line")
    };
    match axes {
        HandAxes::None(reason) => Err(reason),
        HandAxes::Fixed(turn) => Ok((*turn, "by the format's own axes")),
        HandAxes::Rest {
            fingers,
            thumb: Thumb::Seen(thumb),
        } => Ok((at_rest(fingers, *thumb)?, "by the fingers")),
        HandAxes::Rest {
            fingers,
            thumb: Thumb::Forward(thumb),
        } => Ok((at_rest(fingers, thumb * sign)?, "by the T pose")),
        HandAxes::Rest {
            fingers,
            thumb: Thumb::Untold,
        } => {
            let turn = calm_hand(side, frames, up, sign)?;
            let turn = at_rest(fingers, turn * Vector3::z())?;
            Ok((turn, "by the fingers and the calmest frames"))
        }
        HandAxes::Untold => Ok((calm_hand(side, frames, up, sign)?, "by the calmest frames")),
    }
}

/// A hand with these fingers and a thumb on that side; `None` where they are in one line.
pub(crate) fn frame_of(fingers: Vector3<f64>, thumb: Vector3<f64>) -> Option<Rotation3<f64>> {
    let x = fingers.try_normalize(1e-9)?;
    let thumb = thumb.try_normalize(1e-9)?;
    let z = (thumb - x * x.dot(&thumb)).try_normalize(1e-3)?;
    Some(Rotation3::from_matrix_unchecked(Matrix3::from_columns(&[
        x,
        z.cross(&x),
        z,
    ])))
}

/// A hand at ease continues the forearm, the thumb in front where the arm hangs, else on the side to which the elbow bends.
/// The wrist joint's axes are compared with that where arm and hand move least.
fn calm_hand(
    side: Side,
    frames: &[WorldFrame],
    up: &Vector3<f64>,
    sign: f64,
) -> Result<Rotation3<f64>, &'static str> {
    let mut hanging = Vec::new();
    let mut bent = Vec::new();
    for (index, frame) in frames.iter().enumerate() {
        let Some(wrist) = frame.wrists[side as usize] else {
            continue;
        };
        let Some((hand, hangs)) = hand_at_ease(side, frame, up, sign) else {
            continue;
        };
        let group = if hangs { &mut hanging } else { &mut bent };
        group.push((stir(side, frames, index), wrist.inverse() * hand));
    }
    let enough = (frames.len() / 100).max(1);
    let mut group = if hanging.len() >= enough {
        hanging
    } else {
        bent
    };
    if group.len() < enough {
        return Err(
            "the rest pose does not tell the hand's axes, and no frame has the arm at ease",
        );
    }
    group.sort_by(|a, b| a.0.total_cmp(&b.0));
    group.truncate(((group.len() as f64 * CALM_SHARE).ceil() as usize).clamp(1, ENOUGH));
    let sum: Matrix3<f64> = group.iter().map(|(_, turn)| turn.matrix()).sum();
    let mean = Rotation3::from_matrix(&(sum / group.len() as f64));
    let spread = group
        .iter()
        .map(|(_, turn)| turn.angle_to(&mean))
        .sum::<f64>()
        / group.len() as f64;
    if spread.is_finite() && spread < SPREAD {
        Ok(mean)
    } else {
        Err(
            "the rest pose does not tell the hand's axes, and the hand lies differently in the calmest frames",
        )
    }
}

/// The hand as a person at ease holds it, and whether the arm hangs.
fn hand_at_ease(
    side: Side,
    frame: &WorldFrame,
    up: &Vector3<f64>,
    sign: f64,
) -> Option<(Rotation3<f64>, bool)> {
    let [shoulder, elbow, wrist] = side
        .arm()
        .map(|node: KeyNode| frame.positions[node as usize]);
    let forearm = (wrist - elbow).try_normalize(1e-9)?;
    if -forearm.dot(up) > HANGS {
        let forward = frame.left.cross(up) * sign;
        return Some((frame_of(forearm, forward)?, true));
    }
    let upper = (shoulder - elbow).try_normalize(1e-9)?;
    (forearm.cross(&upper).norm() > ELBOW_BENT)
        .then(|| frame_of(forearm, upper))
        .flatten()
        .map(|hand| (hand, false))
}

/// How much wrist and forearm turn around a frame, radians a frame.
fn stir(side: Side, frames: &[WorldFrame], index: usize) -> f64 {
    let [_, elbow, wrist] = side.arm();
    let forearm = |f: &WorldFrame| f.positions[wrist as usize] - f.positions[elbow as usize];
    let near = [index.saturating_sub(1), (index + 1).min(frames.len() - 1)].map(|i| &frames[i]);
    let turned = match near.map(|f| f.wrists[side as usize]) {
        [Some(a), Some(b)] => a.angle_to(&b),
        _ => 0.0,
    };
    turned + forearm(near[0]).angle(&forearm(near[1]))
}
