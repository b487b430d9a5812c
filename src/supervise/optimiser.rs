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
}

/// Settings of AdamW.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize, serde::Deserialize)]
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
            };
            all.insert(name, parameter);
        }
        Ok(Self { all })
    }

    /// The tensors for building a model on them; a step changes them in place.
    pub fn tensors(&self) -> std::collections::HashMap<String, Tensor> {
        self.all.iter().map(|(n, p)| (n.clone(), p.var.as_tensor().clone())).collect()
    }

    /// Copies of the moving averages.
    ///
    /// # Errors
    /// [`Error::Tensors`] if a tensor cannot be made.
    pub fn averages(&self) -> Result<BTreeMap<String, Tensor>> {
        let copy = |p: &Parameter| Tensor::from_slice(&p.average, p.var.shape(), &Device::Cpu);
        self.all.iter().map(|(n, p)| Ok((n.clone(), copy(p)?))).collect()
    }

    /// One step; returns the gradients' norm before clipping. Running statistics have no gradient and stay.
    ///
    /// # Errors
    /// [`Error::Argument`] if the gradients are not finite (nothing is changed then).
    pub fn step(&mut self, grads: &GradStore, config: &AdamW, rate: f32, step: usize) -> Result<f32> {
        let mut gradients = Vec::with_capacity(self.all.len());
        let mut square = 0f64;
        for parameter in self.all.values() {
            let grad: Option<Vec<f32>> = match grads.get(&parameter.var) {
                Some(g) => Some(g.flatten_all()?.to_vec1()?),
                None => None,
            };
            square += grad.iter().flatten().map(|g| f64::from(*g) * f64::from(*g)).sum::<f64>();
            gradients.push(grad);
        }
        let norm = square.sqrt() as f32;
        if !norm.is_finite() {
            return Err(Error::argument("gradient norm", norm, "a finite number"));
        }
        let scale = (config.clip / norm.max(1e-12)).min(1.0);
        // Early averages would hold on to the random start.
        let keep = config.average.min((1.0 + step as f32) / (10.0 + step as f32));
        for (parameter, grad) in self.all.values_mut().zip(gradients) {
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
            let Parameter { values, m, v, .. } = parameter;
            kernels::adamw_step(values, &grad, m, v, &settings)?;
            for (a, v) in parameter.average.iter_mut().zip(&parameter.values) {
                *a += (1.0 - keep) * (v - *a);
            }
            parameter.sync()?;
        }
        Ok(norm)
    }
}

impl Parameter {
    fn sync(&self) -> Result<()> {
        Ok(self.var.set(&Tensor::from_slice(&self.values, self.var.shape(), &Device::Cpu)?)?)
    }

    /// Current values.
    pub fn values(&self) -> &[f32] {
        &self.values
    }

    /// Sets values (and their average), for running statistics and for resuming.
    ///
    /// # Errors
    /// [`Error::BufferLength`] on another length.
    pub fn set(&mut self, values: &[f32], average: &[f32]) -> Result<()> {
        if values.len() != self.values.len() || average.len() != self.values.len() {
            return Err(Error::BufferLength {
                what: "parameter",
                expected: self.values.len(),
                found: values.len().min(average.len()),
            });
        }
        self.values.copy_from_slice(values);
        self.average.copy_from_slice(average);
        self.sync()
    }
}
