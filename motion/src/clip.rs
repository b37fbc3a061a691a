//! A sequence of poses at a constant rate.

use crate::{FrameError, KeyNodeFrame, ResampleError, resample};

/// A recorded or generated motion.
#[derive(Clone, Debug, PartialEq)]
pub struct Clip {
    /// Where it comes from: a file's stem, or a skill and its seed.
    pub name: String,
    /// Frames a second.
    pub fps: f64,
    /// The poses, one every 1/fps seconds.
    pub frames: Vec<KeyNodeFrame>,
}

impl Clip {
    /// Seconds from the first to the last frame.
    #[must_use]
    pub fn duration(&self) -> f64 {
        self.frames.len().saturating_sub(1) as f64 / self.fps
    }

    /// Checks every frame.
    ///
    /// # Errors
    /// The index and the fault of the first frame that does not describe a body.
    pub fn validate(&self) -> Result<(), (usize, FrameError)> {
        self.frames
            .iter()
            .enumerate()
            .try_for_each(|(i, frame)| frame.validate().map_err(|e| (i, e)))
    }

    /// The same motion at another rate.
    ///
    /// Bone directions and wrist orientations are interpolated on their spheres (cubic, continuous velocity), so that
    /// bones keep their lengths; before going to a lower rate, everything above the new rate's Nyquist frequency is
    /// filtered out without delay. The last frame is dropped where it falls between two frames of the new rate.
    ///
    /// # Errors
    /// A rate that is not a positive number, and a clip so slow that it would become more than a million frames.
    pub fn resampled(&self, fps: f64) -> Result<Self, ResampleError> {
        Ok(Self {
            name: self.name.clone(),
            fps,
            frames: resample::resample(&self.frames, self.fps, fps)?,
        })
    }

    /// How many frames [`resampled`](Self::resampled) makes, without making them; both rates positive. Saturates.
    #[must_use]
    pub fn resampled_len(&self, fps: f64) -> usize {
        resample::resampled_len(self.frames.len(), self.fps, fps)
    }

    /// The motion seen in a mirror.
    #[must_use]
    pub fn mirrored(&self) -> Self {
        Self {
            name: format!("{}-mirrored", self.name),
            fps: self.fps,
            frames: self.frames.iter().map(KeyNodeFrame::mirrored).collect(),
        }
    }

    /// The motion `factor` times as fast, at the same frame rate.
    ///
    /// # Errors
    /// As [`resampled`](Self::resampled).
    pub fn time_warped(&self, factor: f64) -> Result<Self, ResampleError> {
        Ok(Self {
            name: format!("{}-x{factor:.2}", self.name),
            fps: self.fps,
            frames: resample::resample(&self.frames, self.fps * factor, self.fps)?,
        })
    }
}
