//! AdamW with a moving average of the weights.

use crate::error::{Error, Result};
use crate::kernels::{self, AdamWStep};
use candle_core::backprop::GradStore;
use candle_core::{Device, Tensor, Var};
use std::collections::BTreeMap;

/// One trained tensor with its moments and its moving average.
pub struct Parameter {
    /// What the model computes with.
    pub var: Var,
    /// First moment.
    pub m: Vec<f32>,
    /// Second moment.
    pub v: Vec<f32>,
    /// Moving average of the values: what is published.
    pub average: Vec<f32>,
    values: Vec<f32>,
    decays: bool,
    frozen: bool,
}

/// Settings of AdamW.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(deny_unknown_fields)]
pub struct AdamW {
    /// First moment's decay.
    pub beta1: f32,
    /// Second moment's decay.
    pub beta2: f32,
    /// Added to the root of the second moment.
    pub eps: f32,
    /// Decoupled weight decay of matrices; norms, biases and embeddings have none.
    pub weight_decay: f32,
    /// Gradients are scaled down to this norm.
    pub clip: f32,
    /// Decay of the moving average per step.
    pub average: f32,
}

impl Default for AdamW {
    fn default() -> Self {
        Self { beta1: 0.9, beta2: 0.98, eps: 1e-8, weight_decay: 0.02, clip: 1.0, average: 0.998 }
    }
}

/// All trained tensors by name.
pub struct Parameters {
    /// By checkpoint name.
    pub all: BTreeMap<String, Parameter>,
}

impl Parameters {
    /// Starts from initial values with zero moments.
    ///
    /// # Errors
    /// [`Error::Tensors`] if a tensor cannot be copied.
    pub fn new(initial: BTreeMap<String, Tensor>) -> Result<Self> {
        let mut all = BTreeMap::new();
        for (name, tensor) in initial {
            let values: Vec<f32> = tensor.flatten_all()?.to_vec1()?;
            let decays = tensor.rank() >= 2 && !name.contains("embed_tokens");
            let zeros = vec![0f32; values.len()];
            let parameter = Parameter {
                var: Var::from_tensor(&tensor)?,
                m: zeros.clone(),
                v: zeros,
                average: values.clone(),
                values,
                decays,
                frozen: false,
            };
            all.insert(name, parameter);
        }
        Ok(Self { all })
    }

    /// Trains tensors of these names alone. To be said before a model is built on [`Parameters::tensors`].
    pub fn train_only(&mut self, trained: impl Fn(&str) -> bool) {
        for (name, parameter) in &mut self.all {
            parameter.frozen = !trained(name);
        }
    }

    /// The tensors for building a model on them; a step changes those that are trained in place.
    pub fn tensors(&self) -> std::collections::HashMap<String, Tensor> {
        // Nothing is passed back through a tensor that is not tracked.
        let tensor = |p: &Parameter| {
            let tensor = p.var.as_tensor();
            if p.frozen { tensor.detach() } else { tensor.clone() }
        };
        self.all.iter().map(|(n, p)| (n.clone(), tensor(p))).collect()
    }

    /// Copies of the moving averages.
    ///
    /// # Errors
    /// [`Error::Tensors`] if a tensor cannot be made.
    pub fn averages(&self) -> Result<BTreeMap<String, Tensor>> {
        let copy = |p: &Parameter| Tensor::from_slice(&p.average, p.var.shape(), &Device::Cpu);
        self.all.iter().map(|(n, p)| Ok((n.clone(), copy(p)?))).collect()
    }

    /// The gradients of all tensors, out of a backward pass.
    ///
    /// # Errors
    /// [`Error::Tensors`] if one cannot be read.
    pub fn gradients(&self, grads: &GradStore) -> Result<Gradients> {
        let mut each = Vec::with_capacity(self.all.len());
        let mut square = 0f64;
        for parameter in self.all.values() {
            let grad: Option<Vec<f32>> = match grads.get(&parameter.var) {
                Some(_) if parameter.frozen => None,
                Some(g) => Some(g.flatten_all()?.to_vec1()?),
                None => None,
            };
            square += grad.iter().flatten().map(|g| f64::from(*g) * f64::from(*g)).sum::<f64>();
            each.push(grad);
        }
        Ok(Gradients { each, norm: square.sqrt() as f32 })
    }

    /// One step, the `step`-th from 1; the averages stay (see [`Parameters::average`]). Running statistics have no gradient
    /// and stay, too.
    ///
    /// # Errors
    /// [`Error::Argument`] if the gradients are not finite; [`Error::BufferLength`] if they are not of these tensors.
    pub fn step(&mut self, gradients: Gradients, config: &AdamW, rate: f32, step: usize) -> Result<()> {
        if !gradients.norm.is_finite() {
            return Err(Error::argument("gradient norm", gradients.norm, "a finite number"));
        }
        let (expected, found) = (self.all.len(), gradients.each.len());
        if found != expected {
            return Err(Error::BufferLength { what: "gradients", expected, found });
        }
        let scale = (config.clip / gradients.norm.max(1e-12)).min(1.0);
        for (parameter, grad) in self.all.values_mut().zip(gradients.each) {
            let Some(grad) = grad else { continue };
            let decay = if parameter.decays { config.weight_decay } else { 0.0 };
            let settings = AdamWStep {
                lr: rate,
                beta1: config.beta1,
                beta2: config.beta2,
                eps: config.eps,
                weight_decay: decay,
                step,
                grad_scale: scale,
            };
            let Parameter { values, m, v, .. } = &mut *parameter;
            kernels::adamw_step(values, &grad, m, v, &settings)?;
            parameter.sync()?;
        }
        Ok(())
    }

    /// Moves all averages towards the values, running statistics' as weights', as they are after the `step`-th step from 1.
    pub fn average(&mut self, config: &AdamW, step: usize) {
        // Early averages would hold on to the random start.
        let keep = config.average.min((1.0 + step as f32) / (10.0 + step as f32));
        for parameter in self.all.values_mut() {
            for (a, v) in parameter.average.iter_mut().zip(&parameter.values) {
                *a += (1.0 - keep) * (v - *a);
            }
        }
    }
}

/// Gradients of all tensors of [`Parameters`], in their order.
pub struct Gradients {
    /// `None` where a tensor had no part in the loss.
    each: Vec<Option<Vec<f32>>>,
    norm: f32,
}

impl Gradients {
    /// Their norm before clipping.
    pub fn norm(&self) -> f32 {
        self.norm
    }
}

impl Parameter {
    fn sync(&self) -> Result<()> {
        Ok(self.var.set(&Tensor::from_slice(&self.values, self.var.shape(), &Device::Cpu)?)?)
    }

    /// Whether it keeps its values.
    pub fn frozen(&self) -> bool {
        self.frozen
    }

    /// Current values.
    pub fn values(&self) -> &[f32] {
        &self.values
    }

    /// Sets values, for running statistics and for resuming.
    ///
    /// # Errors
    /// [`Error::BufferLength`] on another length.
    pub fn set(&mut self, values: &[f32]) -> Result<()> {
        let (expected, found) = (self.values.len(), values.len());
        if found != expected {
            return Err(Error::BufferLength { what: "parameter", expected, found });
        }
        self.values.copy_from_slice(values);
        self.sync()
    }
}
