//! Temporal smoothing of one stream of joint angles.

/// A three-tap binomial filter, `¼ x_t + ½ x_{t−1} + ¼ x_{t−2}`: a delay of exactly one frame at every frequency, and
/// nothing left of what alternates from frame to frame, which is what a jump between codes looks like.
///
/// No joint then moves by more than [`LARGEST_STEP`] in a frame: where a pose has two answers and the human passes from
/// one to the other, the robot takes a few frames to follow.
#[derive(Clone, Debug, Default)]
pub struct Smoother {
    /// `x_{t−1}` and `x_{t−2}`; empty before the first frame.
    previous: [Vec<f32>; 2],
    /// The last answer.
    answer: Vec<f32>,
}

/// Largest change of a joint between two answers, radians: 12 rad/s at 50 Hz, about the speed of a punch.
pub const LARGEST_STEP: f32 = 0.24;

impl Smoother {
    /// A smoother that has seen nothing: its first answer is its first input.
    pub fn new() -> Self {
        Self::default()
    }

    /// Replaces the newest angles (radians, one joint each) by the smoothed ones.
    ///
    /// A change of the number of joints starts the stream anew.
    pub fn step(&mut self, angles: &mut [f32]) {
        let [one, two] = &mut self.previous;
        if one.len() != angles.len() {
            *one = angles.to_vec();
            two.clone_from(one);
            self.answer.clone_from(one);
        }
        let past = one.iter_mut().zip(two).zip(&mut self.answer);
        for (x, ((one, two), answer)) in angles.iter_mut().zip(past) {
            let smooth = 0.25 * *x + 0.5 * *one + 0.25 * *two;
            *two = std::mem::replace(one, *x);
            *answer += (smooth - *answer).clamp(-LARGEST_STEP, LARGEST_STEP);
            *x = *answer;
        }
    }

    /// Forgets the stream's past, as after a gap.
    pub fn reset(&mut self) {
        *self = Self::default();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn run(inputs: impl IntoIterator<Item = f32>) -> Vec<f32> {
        let mut smoother = Smoother::new();
        let step = |x| {
            let mut angles = [x];
            smoother.step(&mut angles);
            angles[0]
        };
        inputs.into_iter().map(step).collect()
    }

    #[test]
    fn a_ramp_comes_out_one_frame_late() {
        let out = run((0..20).map(|t| 0.1 * t as f32));
        for (t, y) in out.iter().enumerate().skip(2) {
            assert!((y - 0.1 * (t as f32 - 1.0)).abs() < 1e-6);
        }
    }

    #[test]
    fn what_alternates_vanishes_and_what_rests_stays() {
        let out = run((0..20).map(|t| if t % 2 == 0 { 0.4 } else { 0.6 }));
        assert!(out[2..].iter().all(|y| (y - 0.5).abs() < 1e-6));
        assert!(run([0.3; 5]).iter().all(|y| (y - 0.3).abs() < 1e-7));
    }

    #[test]
    fn a_jump_becomes_a_walk() {
        let out = run((0..20).map(|t| if t < 5 { 0.0 } else { 2.0 }));
        assert!(
            out.windows(2)
                .all(|pair| (pair[1] - pair[0]).abs() <= LARGEST_STEP + 1e-6)
        );
        assert!((out[19] - 2.0).abs() < 1e-6);
    }

    #[test]
    fn a_reset_forgets() {
        let mut smoother = Smoother::new();
        smoother.step(&mut [1.0]);
        smoother.reset();
        let mut angles = [5.0];
        smoother.step(&mut angles);
        assert_eq!(angles, [5.0]);
    }
}
