use candle_core::{DType, Device, Tensor};
use candle_nn::{VarBuilder, VarMap};
use proptest::prelude::*;
use pulp::Arch;
use rand::SeedableRng as _;
use rand_chacha::ChaCha8Rng;

use super::*;
use crate::mlp::Mlp;

/// Weights and biases of layers.
type Layers = Vec<(Vec<f32>, Vec<f32>)>;

fn numbers(rng: &mut ChaCha8Rng, count: usize, bound: f32) -> Vec<f32> {
    (0..count)
        .map(|_| rng.random_range(-bound..bound))
        .collect()
}

fn layers(rng: &mut ChaCha8Rng, widths: &[usize]) -> Layers {
    let pairs = widths.windows(2);
    pairs
        .map(|pair| {
            let bound = (3.0 / pair[0] as f32).sqrt();
            (
                numbers(rng, pair[0] * pair[1], bound),
                numbers(rng, pair[1], bound),
            )
        })
        .collect()
}

fn packed(layers: &Layers, precision: Precision) -> PackedMlp {
    let layers: Vec<(&[f32], &[f32])> = layers
        .iter()
        .map(|(weight, bias)| (weight.as_slice(), bias.as_slice()))
        .collect();
    PackedMlp::new(&layers, precision).unwrap()
}

fn forward(mlp: &PackedMlp, rows: &[f32]) -> Vec<f32> {
    let mut out = Vec::new();
    mlp.forward(rows, &mut out, &mut Scratch::default())
        .unwrap();
    out
}

/// The same layers in f64, row by row.
fn reference(layers: &Layers, rows: &[f32], inputs: usize) -> Vec<f64> {
    let mut answers = Vec::new();
    for row in rows.chunks(inputs) {
        let mut x: Vec<f64> = row.iter().map(|&x| f64::from(x)).collect();
        for (i, (weight, bias)) in layers.iter().enumerate() {
            let outputs = weight.chunks(x.len()).zip(bias);
            x = outputs
                .map(|(weight, &bias)| {
                    let terms = weight.iter().zip(&x).map(|(&w, x)| f64::from(w) * x);
                    let sum = f64::from(bias) + terms.sum::<f64>();
                    let last = i + 1 == layers.len();
                    if last || sum > 0.0 { sum } else { sum.exp_m1() }
                })
                .collect();
        }
        answers.extend(x);
    }
    answers
}

fn rounded(layers: &Layers) -> Layers {
    let round = |weight: &f32| f16::from_f32(*weight).to_f32();
    layers
        .iter()
        .map(|(weight, bias)| (weight.iter().map(round).collect(), bias.clone()))
        .collect()
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    /// Any widths and batch: right to 1e-5 · √k, and each row as if it were alone, bit for bit; f16 is f32 on rounded
    /// weights, bit for bit.
    #[test]
    fn answers_are_right_and_rows_independent(
        widths in prop::collection::vec(1usize..150, 2..5),
        rows in 1usize..40,
        seed in any::<u64>(),
    ) {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let layers = layers(&mut rng, &widths);
        let x = numbers(&mut rng, rows * widths[0], 1.0);
        let mlp = packed(&layers, Precision::F32);
        let answers = forward(&mlp, &x);
        let largest = widths.iter().max().unwrap();
        let tolerance = 1e-5 * (*largest as f64).sqrt();
        for (answer, expected) in answers.iter().zip(reference(&layers, &x, widths[0])) {
            prop_assert!((f64::from(*answer) - expected).abs() < tolerance, "{answer} {expected}");
        }
        let alone: Vec<f32> = x.chunks(widths[0]).flat_map(|row| forward(&mlp, row)).collect();
        prop_assert_eq!(&answers, &alone);
        let exact = packed(&rounded(&layers), Precision::F32);
        let halves = packed(&layers, Precision::F16);
        prop_assert_eq!(forward(&exact, &x), forward(&halves, &x));
    }

    /// Kinds of processors with a fused multiply-add agree bit for bit; the fallback to 1e-5 · √k.
    #[test]
    fn kinds_of_processors_agree(
        inputs in 1usize..300,
        outputs in 1usize..100,
        rows in 1usize..20,
        halves in any::<bool>(),
        seed in any::<u64>(),
    ) {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let layers = layers(&mut rng, &[inputs, outputs]);
        let precision = if halves { Precision::F16 } else { Precision::F32 };
        let mlp = packed(&layers, precision);
        let mut scratch = Scratch::default();
        scratch.read(&numbers(&mut rng, rows * inputs, 1.0), inputs);
        let layer = &mlp.layers[0];
        let run = |arch| {
            let mut out = vec![[0.0; WIDTH]; layer.panels() * rows];
            layer.multiply_on(arch, 0, &scratch.now, rows, &mut out);
            out.as_flattened().to_vec()
        };
        let fallback = run(Arch::Scalar);
        let tolerance = 1e-5 * (inputs as f32).sqrt();
        let fused = kinds().into_iter().map(run).collect::<Vec<_>>();
        for answers in &fused {
            prop_assert_eq!(answers, &fused[0]);
            for (a, b) in answers.iter().zip(&fallback) {
                prop_assert!((a - b).abs() < tolerance, "{} {}", a, b);
            }
        }
    }
}

/// The kinds with vectors and fused multiply-add that this machine has.
#[cfg(target_arch = "x86_64")]
fn kinds() -> Vec<Arch> {
    let kinds = [
        pulp::x86::V4::try_new().map(Arch::V4),
        pulp::x86::V3::try_new().map(Arch::V3),
    ];
    kinds.into_iter().flatten().collect()
}

#[cfg(not(target_arch = "x86_64"))]
fn kinds() -> Vec<Arch> {
    Vec::new()
}

#[test]
fn answers_equal_candles_and_bits_do_not_depend_on_threads() {
    let vars = VarMap::new();
    let builder = VarBuilder::from_varmap(&vars, DType::F32, &Device::Cpu);
    let mlp = Mlp::new(855, &[1024, 512], 64, &builder).unwrap();
    let mut rng = ChaCha8Rng::seed_from_u64(1);
    for rows in [1, 5, 64] {
        let x = numbers(&mut rng, rows * 855, 1.0);
        let tensor = Tensor::from_slice(&x, (rows, 855), &Device::Cpu).unwrap();
        let expected = mlp.forward(&tensor).unwrap().flatten_all().unwrap();
        let packed = mlp.pack().unwrap();
        let answers = forward(&packed, &x);
        for (a, b) in answers.iter().zip(expected.to_vec1::<f32>().unwrap()) {
            assert!((a - b).abs() < 1e-5 * 32.0, "{a} {b}");
        }
        for threads in [2, 3] {
            linear::set_threads(threads);
            assert_eq!(forward(&packed, &x), answers);
        }
        linear::set_threads(1);
    }
}

#[test]
fn halves_are_chosen_where_they_lose_nothing() {
    let (third, large) = (1.0 / 3.0, 1e6);
    assert_eq!(Precision::lossless(&[0.5, -2.0]), Precision::F16);
    assert_eq!(Precision::lossless(&[0.5, third]), Precision::F32);
    assert_eq!(Precision::lossless(&[large]), Precision::F32);
}

#[test]
fn a_batch_of_the_same_size_allocates_nothing() {
    let mut rng = ChaCha8Rng::seed_from_u64(2);
    let mlp = packed(&layers(&mut rng, &[40, 100, 30, 7]), Precision::F32);
    let x = numbers(&mut rng, 9 * 40, 1.0);
    let (mut out, mut scratch) = (Vec::new(), Scratch::default());
    let mut run = || {
        mlp.forward(&x, &mut out, &mut scratch).unwrap();
        let mut buffers = [scratch.now.as_ptr(), scratch.next.as_ptr()];
        buffers.sort_unstable();
        (buffers, out.as_ptr())
    };
    run();
    // The two buffers change places: both have grown after the second.
    let grown = run();
    assert_eq!(run(), grown);
}

#[test]
fn no_rows_and_misfits() {
    let weight = [1.0; 6];
    let of = |layers: &[(&[f32], &[f32])], precision| PackedMlp::new(layers, precision);
    let mlp = of(&[(&weight, &[0.0; 2])], Precision::F32).unwrap();
    assert_eq!((mlp.inputs(), mlp.outputs()), (3, 2));
    assert!(forward(&mlp, &[]).is_empty());
    let partial = mlp.forward(&[0.0; 4], &mut Vec::new(), &mut Scratch::default());
    assert!(partial.unwrap_err().to_string().contains("rows of 3"));
    for (layers, expected) in [
        (&[(&weight[..], &[0.0; 4][..])][..], "do not fit 4 outputs"),
        (&[(&weight, &[0.0; 2]), (&weight, &[0.0; 2])], "gives 2"),
        (&[], "needs a layer"),
    ] {
        let error = of(layers, Precision::F32).unwrap_err().to_string();
        assert!(error.contains(expected), "{error}");
    }
    let error = of(&[(&[1e6], &[0.0])], Precision::F16).unwrap_err();
    assert!(error.to_string().contains("1000000"), "{error}");
}
