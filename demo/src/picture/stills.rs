//! Which frames of a motion are worth a picture.

use emp_motion::{KeyNode, KeyNodeFrame};

/// Frames that differ most from one another, in order of time: each next one is the frame farthest from all chosen ones.
///
/// At most `count`, fewer where the motion is shorter. The `fixed` frames are among them; no other lies closer to a chosen one
/// than a third of their mean distance, so that the whole motion is covered.
pub(crate) fn differing(frames: &[KeyNodeFrame], fixed: &[usize], count: usize) -> Vec<usize> {
    let gap = frames.len() / (3 * count.max(1));
    let mut chosen: Vec<usize> = fixed.to_vec();
    chosen.sort_unstable();
    chosen.dedup();
    // Without any, the first is the one that is farthest from the beginning.
    let mut novelty: Vec<f32> = frames
        .iter()
        .map(|frame| {
            nearest(
                frame,
                frames,
                if chosen.is_empty() { &[0] } else { &chosen },
            )
        })
        .collect();
    while chosen.len() < count.min(frames.len()) {
        let far = |index: usize| {
            chosen
                .iter()
                .all(|&other: &usize| index != other && index.abs_diff(other) >= gap)
        };
        let next = (0..frames.len())
            .filter(|&index| far(index))
            .max_by(|&a, &b| novelty[a].total_cmp(&novelty[b]));
        let Some(next) = next else { break };
        for (novelty, frame) in novelty.iter_mut().zip(frames) {
            let distance = distance(frame, &frames[next]);
            *novelty = if chosen.is_empty() {
                distance
            } else {
                novelty.min(distance)
            };
        }
        chosen.push(next);
    }
    chosen.sort_unstable();
    chosen
}

/// Distance of a pose from the nearest of those with the given numbers, metres.
fn nearest(frame: &KeyNodeFrame, frames: &[KeyNodeFrame], others: &[usize]) -> f32 {
    let distances = others.iter().map(|&other| distance(frame, &frames[other]));
    distances.fold(f32::INFINITY, f32::min)
}

/// Distance of two poses: how far elbows and wrists are apart, metres.
fn distance(a: &KeyNodeFrame, b: &KeyNodeFrame) -> f32 {
    [
        KeyNode::LeftElbow,
        KeyNode::RightElbow,
        KeyNode::LeftWrist,
        KeyNode::RightWrist,
    ]
    .map(|node| (a.position(node) - b.position(node)).norm())
    .iter()
    .sum()
}

#[cfg(test)]
mod tests {
    use emp_motion::skills::{self, Skill};

    use super::*;

    #[test]
    fn stills_are_in_order_apart_and_cover_the_farthest_pose() {
        let clip = skills::medley(3);
        let stills = differing(&clip.frames, &[], 8);
        assert_eq!(stills.len(), 8);
        let gap = clip.frames.len() / 24;
        assert!(
            stills.windows(2).all(|pair| pair[1] >= pair[0] + gap),
            "{stills:?}"
        );
        let reach = |index: &usize| distance(&clip.frames[*index], &clip.frames[0]);
        let farthest = (0..clip.frames.len())
            .map(|index| reach(&index))
            .fold(0.0, f32::max);
        let shown = stills.iter().map(reach).fold(0.0, f32::max);
        assert!(shown > 0.9 * farthest, "{shown} of {farthest}");
    }

    #[test]
    fn a_short_motion_has_as_many_stills_as_frames() {
        let frames = &skills::generate(Skill::Wave, 1).frames[..3];
        assert_eq!(differing(frames, &[], 8), [0, 1, 2]);
        assert!(differing(&[], &[], 8).is_empty());
    }

    #[test]
    fn fixed_stills_are_among_them() {
        let clip = skills::medley(3);
        let last = clip.frames.len() - 1;
        let stills = differing(&clip.frames, &[last, last - 1, last], 8);
        assert_eq!(stills.len(), 8);
        assert!(stills.ends_with(&[last - 1, last]), "{stills:?}");
    }
}
