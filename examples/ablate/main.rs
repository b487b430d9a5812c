//! What each part of the sparse depth injection is worth: the paper's Table 5 and the ways of asking, on a small model.
//!
//! `cargo run --release --example ablate -- --out DIR [--library FURNITURE] [--seeds 3]`
//!
//! The paper fine-tunes Qwen2.5-VL, which knows pictures and has never seen depth. Here a model of half a million parameters is first
//! trained on pictures alone; each cell of the tables is then fine-tuned from it, with the same frames, the same 150 measurements of
//! each and the same number of steps. Finished cells are small files under `--out`, so that a run that was stopped goes on where it
//! was; `table.md` and `ablation.json` are made of all that are there.

mod cells;
#[path = "../common/mod.rs"]
mod common;
mod frames;
mod run;
mod table;

use anyhow::{Context, ensure};
use cells::Cell;
use clap::Parser;
use common::stdout::print;
use frames::Frames;
use run::Plan;
use std::path::{Path, PathBuf};
use std::time::Instant;

/// The paper's Table 5 on a small model, and ways of asking beside each other.
#[derive(Parser)]
struct Args {
    /// Folder of results.
    #[arg(long)]
    out: PathBuf,
    /// Folder of furniture, as it was installed or packed: half of the rooms are furnished. Procedural scenes alone without it.
    #[arg(long)]
    library: Option<PathBuf>,
    /// Only these cells, by their names in the tables.
    #[arg(long, value_delimiter = ',')]
    cells: Vec<String>,
    /// Seeds of each cell: 1 and so on.
    #[arg(long, default_value_t = 3)]
    seeds: u64,
    /// Steps of a cell.
    #[arg(long, default_value_t = Plan::default().steps)]
    steps: usize,
    /// Steps on pictures alone, before all cells.
    #[arg(long, default_value_t = Plan::default().first_steps)]
    first_steps: usize,
    /// Frames of a step.
    #[arg(long, default_value_t = Plan::default().batch)]
    batch: usize,
    /// Peak learning rate of a cell.
    #[arg(long, default_value_t = Plan::default().rates[1])]
    rate: f32,
    /// Threads; more than one makes no other result.
    #[arg(long, default_value_t = 1)]
    threads: usize,
    /// Next to no work, to see that all of it runs; its numbers say nothing.
    #[arg(long, conflicts_with_all = ["steps", "first_steps", "batch", "rate"])]
    quick: bool,
}

impl Args {
    fn plan(&self) -> Plan {
        match self.quick {
            true => Plan::quick(),
            false => {
                let Self { steps, first_steps, batch, .. } = *self;
                let rates = [Plan::default().rates[0], self.rate];
                Plan { steps, first_steps, batch, rates, ..Plan::default() }
            }
        }
    }

    fn cells(&self) -> anyhow::Result<Vec<Cell>> {
        let all = cells::all();
        let names: Vec<&str> = all.iter().map(|c| c.name).collect();
        for name in &self.cells {
            ensure!(names.contains(&name.as_str()), "--cells {name}: expected some of {}", names.join(","));
        }
        let wanted = |c: &Cell| self.cells.is_empty() || self.cells.iter().any(|name| name == c.name);
        Ok(all.into_iter().filter(wanted).collect())
    }
}

/// Refuses a folder of results that other arguments made.
fn claim(out: &Path, plan: &Plan, library: Option<&Path>) -> anyhow::Result<()> {
    let path = out.join("plan.json");
    let said =
        serde_json::json!({"plan": plan, "library": library.is_some(), "sdim": env!("CARGO_PKG_VERSION")});
    let text = serde_json::to_string_pretty(&said)?;
    // As it will be read back: not each number is what it was, once it has been text.
    let said: serde_json::Value = serde_json::from_str(&text)?;
    std::fs::create_dir_all(out).with_context(|| out.display().to_string())?;
    if path.exists() {
        let text = std::fs::read_to_string(&path).with_context(|| path.display().to_string())?;
        let found: serde_json::Value =
            serde_json::from_str(&text).with_context(|| path.display().to_string())?;
        ensure!(
            found == said,
            "{}: results of another run are there: {found}; expected {said}",
            path.display()
        );
        return Ok(());
    }
    std::fs::write(&path, text).with_context(|| path.display().to_string())
}

fn main() -> anyhow::Result<()> {
    let args = Args::parse();
    ensure!(args.seeds > 0, "--seeds 0: expected at least 1");
    let counts = [("steps", args.steps), ("first-steps", args.first_steps), ("batch", args.batch)];
    if let Some((flag, _)) = counts.iter().find(|(_, count)| *count == 0) {
        anyhow::bail!("--{flag} 0: expected at least 1");
    }
    ensure!(args.rate.is_finite() && args.rate > 0.0, "--rate {}: expected a positive number", args.rate);
    rayon::ThreadPoolBuilder::new().num_threads(args.threads).build_global()?;
    sdim::internals::kernels::keep_freed_memory();
    let (plan, cells) = (args.plan(), args.cells()?);
    claim(&args.out, &plan, args.library.as_deref())?;
    let start = Instant::now();
    let frames = Frames::render(&plan, args.library.as_deref())?;
    eprintln!("{} frames rendered in {:.0} s", frames.count(), start.elapsed().as_secs_f64());
    let known = run::known(&args.out.join("first"), &plan, &frames)?;
    // Seed by seed, so that a run that is stopped has whole tables of fewer seeds.
    for seed in 1..=args.seeds {
        for cell in &cells {
            let path = args.out.join(format!("{}-{seed}.json", cell.name));
            if path.exists() {
                continue;
            }
            let result = run::cell(cell, seed, &known, &plan, &frames)?;
            eprintln!("{}", result.line());
            result.write(&path)?;
        }
    }
    let table = table::Table::read(&args.out, frames.linear())?;
    table.write(&args.out)?;
    Ok(print(&table.markdown())?)
}
