//! The SDIM fusion block: sparse depth enters the vision encoder softly (Eq. 1-3 of the paper).
//!
//! ```text
//! F = act(bn(conv(I)))            Eq. 1a
//! S' = act(bn(conv_z(S)))         Eq. 1b, zero-initialised convolution
//! M = F_t3(F_t2(concat(F, S')))   Eq. 2a, to a high- and back to a low-dimensional representation
//! O = conv_z(M)                   Eq. 2b, zero-initialised, three channels
//! E = patch_embed_1(I) + patch_embed_2(O)   Eq. 3a
//! ```
//! A fresh block has O = 0, so the model's output is that of the model without it.

use crate::error::Result;
use crate::kernels;
use crate::vlm::checkpoint::weights::Weights;
use candle_core::Tensor;

/// Epsilon of the batch normalisation.
pub const BN_EPS: f64 = 1e-5;
/// Slope of the LeakyReLU for negative values.
pub const LEAKY_SLOPE: f64 = 0.01;

/// Channels of the block.
#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
pub struct FusionConfig {
    /// Of each of the two first branches; 32 in the paper.
    pub branch: usize,
    /// Of the high-dimensional representation.
    pub high: usize,
    /// Of the low-dimensional representation.
    pub low: usize,
}

impl Default for FusionConfig {
    /// The paper's 32 channels per branch; it gives no figure for the other two (64 and 32 here).
    fn default() -> Self {
        Self { branch: 32, high: 64, low: 32 }
    }
}

/// Batch statistics that one normalisation saw, to update its running statistics with.
#[derive(Debug, Clone)]
pub struct BatchStats {
    /// Checkpoint name of the normalisation.
    pub name: String,
    /// Mean per channel.
    pub mean: Vec<f32>,
    /// Variance per channel, biased.
    pub var: Vec<f32>,
}

/// Which statistics the normalisations use.
pub enum Normalise<'a> {
    /// Those of this batch, which are also reported (training).
    Batch(&'a mut Vec<BatchStats>),
    /// The running ones of the checkpoint.
    Running,
}

/// Convolution, batch normalisation, LeakyReLU.
struct ConvBnAct {
    name: String,
    conv: Tensor,
    gamma: Tensor,
    beta: Tensor,
    mean: Tensor,
    var: Tensor,
    /// Scale and shift that stand for the running statistics, once they no longer change.
    folded: Option<(Tensor, Tensor)>,
}

impl ConvBnAct {
    fn new(weights: &Weights, name: &str, inputs: usize, outputs: usize) -> Result<Self> {
        let bn = |part: &str| weights.get(&format!("{name}.bn.{part}"), &[outputs]);
        Ok(Self {
            name: name.to_string(),
            conv: weights.get(&format!("{name}.conv.weight"), &[outputs, inputs, 3, 3])?,
            gamma: bn("weight")?,
            beta: bn("bias")?,
            mean: bn("running_mean")?,
            var: bn("running_var")?,
            folded: None,
        })
    }

    /// Scale and shift per channel that stand for the running statistics.
    fn affine(&self) -> Result<(Tensor, Tensor)> {
        // Running statistics are measured, never trained.
        let (mean, var) = (self.mean.detach(), self.var.detach());
        let scale = (&self.gamma / (var + BN_EPS)?.sqrt()?)?;
        let shift = (&self.beta - (mean * &scale)?)?;
        Ok((scale, shift))
    }

    fn fold(&mut self) -> Result<()> {
        self.folded = Some(self.affine()?);
        Ok(())
    }

    /// `[b, h, w, in]` to `[b, h, w, out]`.
    fn forward(&self, x: &Tensor, normalise: &mut Normalise) -> Result<Tensor> {
        match normalise {
            Normalise::Batch(stats) => {
                let y = kernels::conv3x3(x, &self.conv, None)?;
                let (y, mean, var) =
                    kernels::batch_norm_act(&y, &self.gamma, &self.beta, BN_EPS, LEAKY_SLOPE)?;
                stats.push(BatchStats { name: format!("{}.bn", self.name), mean, var });
                Ok(y)
            }
            Normalise::Running => {
                let (scale, shift) = match &self.folded {
                    Some(folded) => folded.clone(),
                    None => self.affine()?,
                };
                let y = kernels::conv3x3(x, &self.conv, None)?;
                kernels::affine_act(&y, &scale, &shift, LEAKY_SLOPE)
            }
        }
    }
}

/// The fusion block, `sdim.fusion.*` of a checkpoint.
pub struct Fusion {
    rgb: ConvBnAct,
    depth: ConvBnAct,
    high: ConvBnAct,
    low: ConvBnAct,
    out: Tensor,
    out_bias: Tensor,
}

impl Fusion {
    /// How far O depends on the input, in pixels: four 3x3 convolutions one after the other.
    pub const REACH: usize = 4;

    /// Reads `sdim.fusion.*`.
    ///
    /// # Errors
    /// As [`Weights::get`].
    pub fn new(config: &FusionConfig, weights: &Weights) -> Result<Self> {
        let block = |part: &str, inputs, outputs| {
            ConvBnAct::new(weights, &format!("sdim.fusion.{part}"), inputs, outputs)
        };
        Ok(Self {
            rgb: block("rgb", 3, config.branch)?,
            depth: block("depth", 1, config.branch)?,
            high: block("high", 2 * config.branch, config.high)?,
            low: block("low", config.high, config.low)?,
            out: weights.get("sdim.fusion.out.weight", &[3, config.low, 3, 3])?,
            out_bias: weights.get("sdim.fusion.out.bias", &[3])?,
        })
    }

    /// Turns the running statistics into one scale and shift per channel, for inference.
    ///
    /// # Errors
    /// [`crate::Error::Tensors`] if a tensor operation fails.
    pub fn fold(&mut self) -> Result<()> {
        for block in [&mut self.rgb, &mut self.depth, &mut self.high, &mut self.low] {
            block.fold()?;
        }
        Ok(())
    }

    /// O of Eq. 2b. `rgb` is `[b, h, w, 3]` normalised as for the encoder, `sparse` is `[b, h, w, 1]` in units of the
    /// frame's depth scale with 0 where nothing was measured; the result is `[b, h, w, 3]`.
    ///
    /// # Errors
    /// [`crate::Error::Tensors`] on other shapes.
    pub fn forward(&self, rgb: &Tensor, sparse: &Tensor, mut normalise: Normalise) -> Result<Tensor> {
        let f = self.rgb.forward(rgb, &mut normalise)?;
        let s = self.depth.forward(sparse, &mut normalise)?;
        let joined = Tensor::cat(&[f, s], 3)?;
        let m = self.high.forward(&joined, &mut normalise)?;
        let m = self.low.forward(&m, &mut normalise)?;
        kernels::conv3x3(&m, &self.out, Some(&self.out_bias))
    }
}
