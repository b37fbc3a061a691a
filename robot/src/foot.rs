//! The feet.

/// A foot: the spheres it touches the floor with.
#[derive(Clone, Debug, PartialEq)]
pub struct Foot {
    /// Body that carries it; its z axis is the sole's normal.
    pub body: String,
    /// Radius of the spheres, metres.
    pub radius: f64,
    /// Centres in the body's frame, metres.
    pub centers: Vec<[f64; 3]>,
    /// Names of the spheres' geoms in the model, in the order of `centers`.
    pub geoms: Vec<String>,
}

impl Foot {
    /// Centre of the sole in the body's frame: in x and y the middle of what the spheres span, in z their lowest
    /// point.
    pub fn sole_center(&self) -> [f64; 3] {
        let fold = |axis: usize, start: f64, pick: fn(f64, f64) -> f64| {
            self.centers
                .iter()
                .map(|center| center[axis])
                .fold(start, pick)
        };
        let [lower, upper] = [
            [0, 1, 2].map(|axis| fold(axis, f64::INFINITY, f64::min)),
            [0, 1, 2].map(|axis| fold(axis, f64::NEG_INFINITY, f64::max)),
        ];
        [
            f64::midpoint(lower[0], upper[0]),
            f64::midpoint(lower[1], upper[1]),
            lower[2] - self.radius,
        ]
    }
}
