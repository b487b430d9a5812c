//! Asks a plain Qwen2.5-VL checkpoint about an image: the first thing to run to see that a checkpoint works.
//!
//! `cargo run --release --example ask -- --model DIR --image P --prompt TEXT`. With the feature `hub`, `--model` may also
//! be a repository such as `Qwen/Qwen2.5-VL-3B-Instruct`.

#[path = "common/stdout.rs"]
mod stdout;

use clap::Parser;
use sdim::chat::{AnswerOptions, ChatModel, Sampling};
use sdim::system::device;
use sdim::{LoadOptions, WeightFormat, read_rgb};
use serde_json::json;
use std::path::PathBuf;
use std::process::ExitCode;

#[derive(Parser)]
struct Args {
    /// Checkpoint directory.
    #[arg(long)]
    model: String,
    /// PNG or JPEG.
    #[arg(long)]
    image: PathBuf,
    /// The question.
    #[arg(long)]
    prompt: String,
    /// Tokens of the answer at most.
    #[arg(long, default_value_t = AnswerOptions::default().max_new_tokens)]
    max_new_tokens: usize,
    /// 1 is off; without it, as the checkpoint's generation_config.json says.
    #[arg(long)]
    repetition_penalty: Option<f32>,
    /// Draws tokens at random, at this temperature (0.7, say), instead of taking the likeliest one.
    #[arg(long)]
    temperature: Option<f64>,
    /// Draws among the likeliest tokens whose probabilities sum up to this.
    #[arg(long, requires = "temperature")]
    top_p: Option<f64>,
    /// The same seed gives the same answer.
    #[arg(long, requires = "temperature", default_value_t = 0)]
    seed: u64,
    /// How matrices are held: f32, bf16 (half the memory) or int8 (a quarter); without it, as suits the device.
    #[arg(long)]
    weights: Option<WeightFormat>,
    /// cpu, cuda:N or metal.
    #[arg(long, default_value = "cpu")]
    device: String,
    /// One JSON object on stdout instead of the answer.
    #[arg(long)]
    json: bool,
}

/// The directory of this name, or else the local copy of the repository.
fn checkpoint(model: &str) -> sdim::Result<PathBuf> {
    let dir = PathBuf::from(model);
    #[cfg(feature = "hub")]
    if !dir.exists() && sdim::hub::is_repository(model) {
        return sdim::hub::checkpoint(model, None);
    }
    Ok(dir)
}

fn run(args: &Args) -> sdim::Result<String> {
    sdim::internals::kernels::keep_freed_memory();
    let image = read_rgb(&args.image)?;
    let mut options = LoadOptions::on(&device(&args.device)?);
    options.weights = args.weights.unwrap_or(options.weights);
    let model = ChatModel::load(checkpoint(&args.model)?, &options)?;
    let mut options = AnswerOptions::default().with_max_new_tokens(args.max_new_tokens);
    options.repetition_penalty = args.repetition_penalty;
    options.sampling =
        args.temperature.map(|temperature| Sampling { temperature, top_p: args.top_p, seed: args.seed });
    let answer = model.answer(&image, &args.prompt, &options)?;
    if !args.json {
        return Ok(answer.text);
    }
    let object = json!({
        "prompt_ids": answer.prompt_ids,
        "generated_ids": answer.generated_ids,
        "text": answer.text,
        "first_logits_top": answer.first_logits_top,
    });
    Ok(object.to_string())
}

fn main() -> ExitCode {
    let answer = run(&Args::parse()).map_err(|e| e.to_string());
    match answer.and_then(|line| stdout::print(&line).map_err(|e| format!("stdout: {e}"))) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("Error: {error}");
            ExitCode::FAILURE
        }
    }
}
