//! Reduces a folder of furniture to one that travels, and lists who made the models.
//!
//! `cargo run --release --example furniture -- --library DIR [--pack DIR [--megabytes N] [--seed S]] [--triangles N]
//! [--attribution FILE] [--list]`

use anyhow::Context;
use clap::Parser;
use sdim::internals::scenes::furnished::{Library, PackOptions, Reduction, Split};
use std::path::PathBuf;

#[derive(Parser)]
struct Args {
    /// Folder of OBJ files with a catalogue (see scripts/furniture.sh), or one that was packed.
    #[arg(long)]
    library: PathBuf,
    /// Triangles of a large model, about, at most.
    #[arg(long, default_value_t = 3000)]
    triangles: usize,
    /// Folder to write the reduced library into.
    #[arg(long)]
    pack: Option<PathBuf>,
    /// Size of that folder, at most.
    #[arg(long, default_value_t = 30, requires = "pack")]
    megabytes: u64,
    /// Seed of the choice when not all models fit.
    #[arg(long, default_value_t = 0, requires = "pack")]
    seed: u64,
    /// File to write authors and licences of all models into, Markdown.
    #[arg(long)]
    attribution: Option<PathBuf>,
    /// Print every model: id, part, triangles, size.
    #[arg(long)]
    list: bool,
}

fn main() -> anyhow::Result<()> {
    let args = Args::parse();
    let reduction = Reduction::default().with_triangles(args.triangles);
    let library = Library::open_with(&args.library, &reduction)?;
    let models = library.models();
    let held_out = models.iter().filter(|m| m.split == Split::HeldOut).count();
    let triangles: usize = models.iter().map(|m| m.triangles).sum();
    println!("{} models ({held_out} held out), {triangles} triangles", models.len());
    if args.list {
        for m in &models {
            println!(
                "{}\t{:?}\t{}\t{:.2} x {:.2} x {:.2} m",
                m.id, m.split, m.triangles, m.size[0], m.size[1], m.size[2]
            );
        }
    }
    if let Some(path) = &args.attribution {
        let text = format!(
            "# Furniture that scenes were rendered with\n\nMade by `cargo run --release --example furniture -- --library DIR \
             --attribution FILE`. Triangles were reduced, textures made smaller, and some colours replaced.\n{}",
            library.attribution()
        );
        std::fs::write(path, text).with_context(|| path.display().to_string())?;
    }
    if let Some(dir) = &args.pack {
        let options = PackOptions::default().with_bytes(1_000_000 * args.megabytes).with_seed(args.seed);
        println!("{} models packed", library.pack(dir, &options)?);
    }
    Ok(())
}
