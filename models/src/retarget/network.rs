//! The paper's graph VQ-VAE: human graph → codes → robot graph (section III).

use std::sync::Arc;

use candle_core::{CpuStorage, CustomOp1, CustomOp2, D, Device, Layout, Shape, Tensor, bail};
use candle_nn::VarBuilder;
use emp_motion::KeyNode;
use emp_robot::Robot;
use serde::{Deserialize, Serialize};

use super::features::NODE_FEATURES;
use crate::linear::{Linear, product_with_transpose};

/// Sizes of the network; the default is the paper's (section VI, implementation details).
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct NetworkConfig {
    /// Output widths of the encoder's graph layers.
    pub encoder: Vec<usize>,
    /// Output widths of the decoder's hidden graph layers; its input is a code and the joint's two limits.
    pub decoder: Vec<usize>,
    /// Number of codes.
    pub codes: usize,
}

impl Default for NetworkConfig {
    fn default() -> Self {
        Self {
            encoder: vec![16, 32, 64],
            decoder: vec![32, 16],
            codes: 2048,
        }
    }
}

impl NetworkConfig {
    /// Width of a code: the encoder's last width.
    pub fn code_width(&self) -> usize {
        self.encoder.last().copied().unwrap_or_default()
    }
}

/// A tree of nodes: each has at most one parent.
#[derive(Clone, Debug)]
struct Tree {
    /// Index of each node's parent.
    parents: Arc<[Option<usize>]>,
    /// 1 for nodes with a parent, 0 for roots; shape 1 × nodes × 1.
    has_parent: Tensor,
}

impl Tree {
    fn new(parents: Vec<Option<usize>>, device: &Device) -> candle_core::Result<Self> {
        let mask = parents
            .iter()
            .map(|parent| f32::from(u8::from(parent.is_some())));
        let has_parent = Tensor::from_iter(mask, device)?.reshape((1, parents.len(), 1))?;
        Ok(Self {
            parents: parents.into(),
            has_parent,
        })
    }

    /// What passes along each edge: `[x_parent ‖ x_child ‖ e]` for every node, zeros in place of a root's parent.
    fn edge_inputs(&self, x: &Tensor, edges: &Tensor) -> candle_core::Result<Tensor> {
        x.contiguous()?
            .apply_op2(&edges.contiguous()?, EdgeInputs(self.parents.clone()))
    }
}

/// The op behind [`Tree::edge_inputs`]: one pass instead of a gather and a concatenation.
struct EdgeInputs(Arc<[Option<usize>]>);

/// Its backward pass: gradients of the nodes and, behind them, of the edges, by row.
struct EdgeInputsGradient {
    parents: Arc<[Option<usize>]>,
    width: usize,
}

fn contiguous_f32<'a>(storage: &'a CpuStorage, layout: &Layout) -> candle_core::Result<&'a [f32]> {
    match (storage, layout.contiguous_offsets()) {
        (CpuStorage::F32(data), Some((start, end))) => Ok(&data[start..end]),
        _ => bail!("expected a contiguous f32 tensor, got {layout:?}"),
    }
}

impl CustomOp2 for EdgeInputs {
    fn name(&self) -> &'static str {
        "edge_inputs"
    }

    fn cpu_fwd(
        &self,
        x: &CpuStorage,
        x_layout: &Layout,
        edges: &CpuStorage,
        edges_layout: &Layout,
    ) -> candle_core::Result<(CpuStorage, Shape)> {
        let (batch, nodes, width) = x_layout.shape().dims3()?;
        let (edge_batch, edge_nodes, edge_width) = edges_layout.shape().dims3()?;
        if (edge_batch, edge_nodes) != (batch, nodes) || nodes != self.0.len() {
            bail!(
                "edge_inputs: {:?} and {:?} do not fit",
                x_layout.shape(),
                edges_layout.shape()
            );
        }
        let (x, edges) = (
            contiguous_f32(x, x_layout)?,
            contiguous_f32(edges, edges_layout)?,
        );
        let mut out = Vec::with_capacity(x.len() * 2 + edges.len());
        for (x, edges) in x
            .chunks(nodes * width)
            .zip(edges.chunks(nodes * edge_width))
        {
            for (node, parent) in self.0.iter().enumerate() {
                match parent {
                    Some(parent) => out.extend_from_slice(&x[parent * width..][..width]),
                    None => out.resize(out.len() + width, 0.0),
                }
                out.extend_from_slice(&x[node * width..][..width]);
                out.extend_from_slice(&edges[node * edge_width..][..edge_width]);
            }
        }
        Ok((
            CpuStorage::F32(out),
            Shape::from((batch, nodes, 2 * width + edge_width)),
        ))
    }

    fn bwd(
        &self,
        x: &Tensor,
        edges: &Tensor,
        _out: &Tensor,
        grad: &Tensor,
    ) -> candle_core::Result<(Option<Tensor>, Option<Tensor>)> {
        let grad = grad.contiguous()?;
        let width = x.dim(D::Minus1)?;
        let op = EdgeInputsGradient {
            parents: self.0.clone(),
            width,
        };
        let grad_edges = edges
            .track_op()
            .then(|| grad.narrow(D::Minus1, 2 * width, edges.dim(D::Minus1)?))
            .transpose()?;
        Ok((Some(grad.apply_op1_no_bwd(&op)?), grad_edges))
    }
}

impl CustomOp1 for EdgeInputsGradient {
    fn name(&self) -> &'static str {
        "edge_inputs_gradient"
    }

    fn cpu_fwd(
        &self,
        grad: &CpuStorage,
        layout: &Layout,
    ) -> candle_core::Result<(CpuStorage, Shape)> {
        let (batch, nodes, row) = layout.shape().dims3()?;
        let grad = contiguous_f32(grad, layout)?;
        let width = self.width;
        let mut out = vec![0.0; batch * nodes * width];
        for (grad, out) in grad.chunks(nodes * row).zip(out.chunks_mut(nodes * width)) {
            for (node, parent) in self.parents.iter().enumerate() {
                let grad = &grad[node * row..][..2 * width];
                let ends = [
                    (parent.as_ref(), &grad[..width]),
                    (Some(&node), &grad[width..]),
                ];
                for (end, grad) in ends {
                    let Some(end) = end else { continue };
                    for (out, grad) in out[end * width..][..width].iter_mut().zip(grad) {
                        *out += grad;
                    }
                }
            }
        }
        Ok((CpuStorage::F32(out), Shape::from((batch, nodes, width))))
    }
}

/// One graph convolution: `y_j = Σ_{i→j} LeakyReLU(W [x_i ‖ x_j ‖ e_ij] + b) + V x_j + c`, edges from parent to child.
#[derive(Clone, Debug)]
struct GraphLayer {
    message: Linear,
    skip: Linear,
}

impl GraphLayer {
    fn new(
        inputs: usize,
        edge_features: usize,
        outputs: usize,
        vars: &VarBuilder<'_>,
    ) -> candle_core::Result<Self> {
        Ok(Self {
            message: Linear::new(2 * inputs + edge_features, outputs, &vars.pp("message"))?,
            skip: Linear::new(inputs, outputs, &vars.pp("skip"))?,
        })
    }

    /// `x` batch × nodes × inputs, `edges` batch × nodes × edge features (of the edge that ends in the node).
    fn forward(&self, tree: &Tree, x: &Tensor, edges: &Tensor) -> candle_core::Result<Tensor> {
        let message = self
            .message
            .forward(&tree.edge_inputs(x, edges)?)?
            .apply_op1(LeakyRelu)?;
        message.broadcast_mul(&tree.has_parent)? + self.skip.forward(x)?
    }
}

/// `max(x, 0.2 x)`, f32.
struct LeakyRelu;

/// The same for the gradient, whose sign is that of the output: `grad · (y > 0 ? 1 : 0.2)`.
struct LeakyReluGradient;

const LEAK: f32 = 0.2;

impl CustomOp1 for LeakyRelu {
    fn name(&self) -> &'static str {
        "leaky_relu"
    }

    fn cpu_fwd(&self, x: &CpuStorage, layout: &Layout) -> candle_core::Result<(CpuStorage, Shape)> {
        let y = contiguous_f32(x, layout)?
            .iter()
            .map(|&x| x.max(LEAK * x))
            .collect();
        Ok((CpuStorage::F32(y), layout.shape().clone()))
    }

    fn bwd(&self, _x: &Tensor, y: &Tensor, grad: &Tensor) -> candle_core::Result<Option<Tensor>> {
        Ok(Some(y.apply_op2_no_bwd(
            &grad.contiguous()?,
            &LeakyReluGradient,
        )?))
    }
}

impl CustomOp2 for LeakyReluGradient {
    fn name(&self) -> &'static str {
        "leaky_relu_gradient"
    }

    fn cpu_fwd(
        &self,
        y: &CpuStorage,
        y_layout: &Layout,
        grad: &CpuStorage,
        grad_layout: &Layout,
    ) -> candle_core::Result<(CpuStorage, Shape)> {
        let (y, grad) = (
            contiguous_f32(y, y_layout)?,
            contiguous_f32(grad, grad_layout)?,
        );
        let out = y
            .iter()
            .zip(grad)
            .map(|(y, g)| if *y > 0.0 { *g } else { LEAK * g });
        Ok((CpuStorage::F32(out.collect()), y_layout.shape().clone()))
    }
}

/// The vectors that latent features are rounded to.
#[derive(Clone, Debug)]
pub struct Codebook {
    /// codes × width.
    vectors: Tensor,
    /// Half the squared norm of each vector, kept for [`Codebook::nearest`].
    half_norms: Vec<f32>,
    values: Vec<f32>,
}

impl Codebook {
    fn new(vectors: Tensor) -> candle_core::Result<Self> {
        let values = vectors.flatten_all()?.to_vec1::<f32>()?;
        let width = vectors.dim(1)?;
        let half_norms = values
            .chunks(width)
            .map(|v| 0.5 * v.iter().map(|x| x * x).sum::<f32>())
            .collect();
        Ok(Self {
            vectors,
            half_norms,
            values,
        })
    }

    /// Index of the nearest vector to each row of `z` (rows × width): `k = argmin_j ‖z − e_j‖` (paper, eq. 1).
    pub fn nearest(&self, z: &[f32]) -> Vec<u32> {
        /// Rows whose scores stay in the cache together.
        const BLOCK: usize = 64;
        let codes = self.half_norms.len();
        let width = self.values.len() / codes;
        let mut scores = vec![0.0; BLOCK * codes];
        let mut nearest = Vec::with_capacity(z.len() / width);
        for block in z.chunks(BLOCK * width) {
            let scores = &mut scores[..block.len() / width * codes];
            product_with_transpose(scores, block, &self.values, width);
            for row in scores.chunks_mut(codes) {
                for (score, half_norm) in row.iter_mut().zip(&self.half_norms) {
                    *score -= half_norm;
                }
                nearest.push(index_of_max(row));
            }
        }
        nearest
    }
}

/// Two passes, each of which vectorises; 0 for a row without a number.
fn index_of_max(row: &[f32]) -> u32 {
    const LANES: usize = 16;
    let mut lanes = [f32::NEG_INFINITY; LANES];
    let chunks = row.chunks_exact(LANES);
    let rest = chunks
        .remainder()
        .iter()
        .copied()
        .fold(f32::NEG_INFINITY, f32::max);
    for chunk in chunks {
        for (lane, x) in lanes.iter_mut().zip(chunk) {
            *lane = if *x > *lane { *x } else { *lane };
        }
    }
    let max = lanes.into_iter().fold(rest, f32::max);
    row.iter().position(|x| *x == max).unwrap_or(0) as u32
}

/// What a forward pass yields, with everything that the training losses need.
pub struct Decoded {
    /// Joint angles in goal order, batch × joints, radians, inside the joints' limits.
    pub angles: Tensor,
    /// Latent features before rounding, `z_B`: (batch · joints) × width.
    pub latent: Tensor,
    /// The codes chosen, `e_k`: (batch · joints) × width.
    pub codes: Tensor,
    /// The codes' indices.
    pub indices: Vec<u32>,
}

/// The retargeting network of section III for one robot.
#[derive(Clone, Debug)]
pub struct RetargetNetwork {
    encoder: Vec<GraphLayer>,
    transform: Linear,
    codebook: Codebook,
    decoder: Vec<GraphLayer>,
    human: Tree,
    robot: Tree,
    /// 1 × joints × 6: origin and orientation of each joint in its parent's frame (`E_B`).
    robot_edges: Tensor,
    /// 1 × joints × 2: lower and upper limit, radians.
    limits: Tensor,
}

impl RetargetNetwork {
    /// Takes the network's tensors from `vars`, creating those that do not exist.
    ///
    /// # Errors
    /// When a tensor of `vars` has another shape than `config` and `robot` ask for.
    pub fn new(
        config: &NetworkConfig,
        robot: &Robot,
        vars: &VarBuilder<'_>,
    ) -> candle_core::Result<Self> {
        let device = vars.device();
        let (human_nodes, joints) = (KeyNode::ALL.len(), robot.goal_joints().len());
        let width = config.code_width();
        let tree = robot.goal_tree();

        let layers = |name: &str, edge: usize, widths: &[usize]| {
            let steps = widths.windows(2).enumerate();
            steps
                .map(|(i, w)| GraphLayer::new(w[0], edge, w[1], &vars.pp(format!("{name}.{i}"))))
                .collect::<candle_core::Result<Vec<_>>>()
        };
        let encoder_widths = [&[NODE_FEATURES], config.encoder.as_slice()].concat();
        let decoder_widths = [&[width + 2], config.decoder.as_slice(), &[1]].concat();
        let init = candle_nn::Init::Uniform { lo: -1.0, up: 1.0 };

        let edges = tree
            .iter()
            .flat_map(|node| node.origin_xyz.into_iter().chain(node.origin_rpy));
        let limits = robot.goal_joints().iter().flat_map(|joint| joint.range);
        Ok(Self {
            encoder: layers("encoder", 3, &encoder_widths)?,
            transform: Linear::new(human_nodes * width, joints * width, &vars.pp("transform"))?,
            codebook: Codebook::new(vars.get_with_hints(
                (config.codes, width),
                "codebook",
                init,
            )?)?,
            decoder: layers("decoder", 6, &decoder_widths)?,
            human: Tree::new(
                KeyNode::ALL
                    .iter()
                    .map(|node| node.parent().map(|p| p as usize))
                    .collect(),
                device,
            )?,
            robot: Tree::new(tree.iter().map(|node| node.parent).collect(), device)?,
            robot_edges: Tensor::from_iter(edges.map(|x| x as f32), device)?
                .reshape((1, joints, 6))?,
            limits: Tensor::from_iter(limits.map(|x| x as f32), device)?.reshape((1, joints, 2))?,
        })
    }

    /// Reads the codebook again after an optimiser has changed its tensor.
    ///
    /// # Errors
    /// When the tensor cannot be read.
    pub fn refresh_codebook(&mut self) -> candle_core::Result<()> {
        self.codebook = Codebook::new(self.codebook.vectors.clone())?;
        Ok(())
    }

    /// The codebook's vectors, codes × width.
    pub fn codebook(&self) -> &Tensor {
        &self.codebook.vectors
    }

    /// Number of codes.
    pub fn codes(&self) -> usize {
        self.codebook.half_norms.len()
    }

    /// Human nodes to latent features of the robot's joints, `z_B = tanh(f_tf(f_e(Q_A, E_A)))`: (batch · joints) × width.
    ///
    /// # Errors
    /// When `features` is not batch × key nodes × [`NODE_FEATURES`].
    pub fn encode(&self, features: &Tensor) -> candle_core::Result<Tensor> {
        let positions = features.narrow(D::Minus1, 0, 3)?.contiguous()?;
        let edges = self.bones(&positions)?;
        let mut x = features.clone();
        for layer in &self.encoder {
            x = layer.forward(&self.human, &x, &edges)?;
        }
        let width = x.dim(D::Minus1)?;
        self.transform
            .forward(&x.flatten_from(1)?)?
            .tanh()?
            .reshape(((), width))
    }

    /// Edge features of the human graph, `E_A`: each node's offset from its parent, batch × nodes × 3.
    fn bones(&self, positions: &Tensor) -> candle_core::Result<Tensor> {
        let parents = self
            .human
            .parents
            .iter()
            .enumerate()
            .map(|(node, parent)| parent.unwrap_or(node) as u32);
        let parents = Tensor::from_iter(parents, positions.device())?;
        positions - positions.index_select(&parents, 1)?
    }

    /// Codes to joint angles, `f_d(z_e, E_B)`: batch × joints, radians.
    ///
    /// # Errors
    /// When `codes` is not (batch · joints) × code width.
    pub fn decode(&self, codes: &Tensor) -> candle_core::Result<Tensor> {
        let (_, joints, edge_features) = self.robot_edges.dims3()?;
        let (rows, width) = codes.dims2()?;
        let batch = rows / joints;
        let limits = self.limits.expand((batch, joints, 2))?;
        let edges = self.robot_edges.expand((batch, joints, edge_features))?;
        let mut x = Tensor::cat(
            &[&codes.reshape((batch, joints, width))?, &limits],
            D::Minus1,
        )?;
        for layer in &self.decoder {
            x = layer.forward(&self.robot, &x, &edges)?;
        }
        let (lower, upper) = (self.limits.narrow(2, 0, 1)?, self.limits.narrow(2, 1, 1)?);
        let middle = ((&lower + &upper)? * 0.5)?;
        let half_range = ((upper - lower)? * 0.5)?;
        x.tanh()?
            .broadcast_mul(&half_range)?
            .broadcast_add(&middle)?
            .squeeze(2)
    }

    /// The whole network. Gradients pass the rounding straight through.
    ///
    /// # Errors
    /// When `features` is not batch × key nodes × [`NODE_FEATURES`].
    pub fn forward(&self, features: &Tensor) -> candle_core::Result<Decoded> {
        let latent = self.encode(features)?;
        let indices = self
            .codebook
            .nearest(&latent.flatten_all()?.to_vec1::<f32>()?);
        let rows = Tensor::new(indices.as_slice(), features.device())?;
        let codes = self.codebook.vectors.index_select(&rows, 0)?;
        let rounded = (&latent + (&codes - &latent)?.detach())?;
        Ok(Decoded {
            angles: self.decode(&rounded)?,
            latent,
            codes,
            indices,
        })
    }

    /// Joint angles (batch × joints, row-major, radians) and the codes' indices (batch · joints), without gradients.
    ///
    /// # Errors
    /// When `features` is not batch × key nodes × [`NODE_FEATURES`].
    pub fn predict(&self, features: &Tensor) -> candle_core::Result<(Vec<f32>, Vec<u32>)> {
        let latent = self.encode(features)?.flatten_all()?.to_vec1::<f32>()?;
        let indices = self.codebook.nearest(&latent);
        let rows = Tensor::new(indices.as_slice(), features.device())?;
        let angles = self.decode(&self.codebook.vectors.index_select(&rows, 0)?)?;
        Ok((angles.flatten_all()?.to_vec1()?, indices))
    }
}
