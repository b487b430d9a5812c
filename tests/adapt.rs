//! Adapting to a camera of one's own: what is written loads and is what was trained, and nothing is written for nothing.

mod common;

use common::program::program;
use sdim::internals::benchmarks::{DepthFile, write_frame};
use sdim::internals::scenes::{Rig, procedural};
use sdim::internals::supervise::{Adaptation, Base, OwnFrame, OwnFrames};
use sdim::settings::Settings;
use sdim::{CompleteOptions, DepthCompleter, DepthMap, LoadOptions, QueryPlan, WeightFormat};
use std::path::Path;
use std::process::{Command, Output};

/// Frames of a rig, without ground truth.
fn write_frames(dir: &Path, count: u64) {
    let rig = Rig { points: 60, ..Rig::draw(1) };
    std::fs::create_dir_all(dir.join("sparse")).unwrap();
    for seed in 0..count {
        let mut frame = procedural(3_000_000 + seed, 96, 64).unwrap();
        let (picture, sparse) = rig.take(&frame, seed).unwrap();
        frame.rgb = picture;
        write_frame(dir, &seed.to_string(), &frame, DepthFile::Npy).unwrap();
        sdim::depth::io::write_npy(dir.join(format!("sparse/{seed}.npy")), 96, 64, sparse.as_slice())
            .unwrap();
    }
    std::fs::remove_dir_all(dir.join("gt")).unwrap();
}

#[test]
fn a_rendered_rig_is_a_folder_to_adapt_to() {
    let dir = tempfile::tempdir().unwrap();
    let render = |rig: &[&str], out: &str| {
        let out = dir.path().join(out);
        let size = ["--count", "2", "--width", "96", "--height", "64"];
        let done = Command::new(program("render")).args(["--out", text(&out)]).args(size).args(rig).output();
        assert!(done.unwrap().status.success());
        out
    };
    let (own, clean) = (render(&["--rig", "3"], "own"), render(&[], "clean"));
    let frames = OwnFrames::read(&own, None).unwrap().frames;
    assert_eq!(frames.len(), 2);
    let picture = |dir: &Path| sdim::read_rgb(dir.join("rgb/scene_2000000.png")).unwrap();
    assert!(picture(&own) == frames[0].rgb && picture(&own) != picture(&clean));
    let truth = sdim::SparseDepth::read(own.join("gt/scene_2000000.npy"), None).unwrap();
    let wrong = frames[0].sparse.points().filter(|&(x, y, d)| truth.get(x, y) != Some(d)).count();
    assert!(wrong > 0, "the sensor has noise, ground truth has none");
}

fn f32_options() -> LoadOptions {
    LoadOptions::default().with_weights(WeightFormat::F32)
}

fn completed(completer: &DepthCompleter, frame: &OwnFrame) -> DepthMap {
    let options = CompleteOptions::default().with_plan(QueryPlan::Stride(8));
    completer.complete(&frame.rgb, &frame.sparse, &options).unwrap()
}

#[test]
fn what_is_adapted_is_what_loads_and_a_seed_decides_it() {
    let dir = tempfile::tempdir().unwrap();
    write_frames(&dir.path().join("data"), 5);
    let frames = OwnFrames::read(&dir.path().join("data"), None).unwrap().frames;
    let adapted = |seed: u64| {
        let mut config = Adaptation::config(3, seed);
        (config.batch.frames, config.batch.questions) = (2, 8);
        let mut run = Adaptation::new(config, Base::tiny().unwrap(), &frames).unwrap();
        let reports: Vec<_> = (0..3).map(|_| run.step().unwrap()).collect();
        assert!(reports.iter().all(|r| !r.skipped && r.loss.is_finite()));
        (run.adapter().unwrap(), run.model().unwrap())
    };
    let (adapter, model) = adapted(7);
    let out = dir.path().join("adapter");
    adapter.save(&out).unwrap();
    let mut names: Vec<String> =
        std::fs::read_dir(&out).unwrap().map(|e| e.unwrap().file_name().into_string().unwrap()).collect();
    names.sort();
    assert_eq!(names, ["sdim.json", "sdim.safetensors"]);
    let before = DepthCompleter::tiny_with(&f32_options()).unwrap();
    let loaded = DepthCompleter::tiny_with(&f32_options().with_adapter(&out)).unwrap();
    let ours = DepthCompleter::new(model);
    let maps = [&before, &loaded, &ours].map(|c| completed(c, &frames[0]));
    assert_eq!(maps[1].depth(), maps[2].depth(), "what was trained");
    assert_ne!(maps[0].depth(), maps[1].depth(), "another than before");

    // Running statistics stay as they are, and are not in it.
    assert!(adapter.tensors.keys().all(|name| !name.contains("running")));
    assert!(adapter.tensors.contains_key("sdim.glimpse.weight"));
    let values = |adapter: &sdim::Adapter| -> Vec<f32> {
        adapter.tensors.values().flat_map(|t| t.flatten_all().unwrap().to_vec1::<f32>().unwrap()).collect()
    };
    assert!(values(&adapter) == values(&adapted(7).0), "the same seed");
    assert!(values(&adapter) != values(&adapted(8).0), "another seed");
}

fn run(args: &[&str]) -> Output {
    Command::new(program("adapt")).args(args).output().unwrap()
}

fn text(path: &Path) -> &str {
    path.to_str().unwrap()
}

/// An untrained model soon learns a camera that always sees the same scene: the adapter that is written then is better at what was
/// held back, and loads.
#[test]
fn what_is_better_is_written_and_loads() {
    let dir = tempfile::tempdir().unwrap();
    let [data, base, out] = ["data", "base", "out"].map(|name| dir.path().join(name));
    write_frames(&data, 8);
    for (part, ending) in [("rgb", "png"), ("sparse", "npy")] {
        let frame = |i: u64| data.join(format!("{part}/{i}.{ending}"));
        for other in (0..8).filter(|i| *i != 3) {
            std::fs::copy(frame(3), frame(other)).unwrap();
        }
    }
    let files = common::tiny::small_files(&Settings { wide_glimpse: None, ..Settings::tiny() });
    std::fs::create_dir(&base).unwrap();
    common::tiny::write(&base, &files, &common::tiny::tensors(&files, 3));
    let flags =
        ["--data", text(&data), "--out", text(&out), "--model", text(&base), "--rate", "3e-3", "--json"];
    let done = run(&[&flags[..], &["--steps", "45", "--frames", "2", "--check-every", "15"]].concat());
    let said = String::from_utf8_lossy(&done.stdout).into_owned();
    assert!(done.status.success(), "{}", String::from_utf8_lossy(&done.stderr));
    let told: serde_json::Value = serde_json::from_str(&said).unwrap();
    assert_eq!(told["written"], text(&out), "{said}");
    assert!(told["ratio"].as_f64().unwrap() < 0.6 && told["steps"] == 45, "{said}");
    let frames = OwnFrames::read(&data, None).unwrap().frames;
    let load = |options: LoadOptions| DepthCompleter::load(&base, &options).unwrap();
    let [before, after] = [load(f32_options()), load(f32_options().with_adapter(&out))];
    assert_ne!(completed(&before, &frames[0]).depth(), completed(&after, &frames[0]).depth());
    let left: Vec<_> = std::fs::read_dir(dir.path()).unwrap().map(|e| e.unwrap().file_name()).collect();
    assert_eq!(left.len(), 3, "nothing half-written: {left:?}");
}

#[test]
fn nothing_is_written_that_is_no_better() {
    let dir = tempfile::tempdir().unwrap();
    let (data, out) = (dir.path().join("data"), dir.path().join("out"));
    write_frames(&data, 6);
    let flags = ["--data", text(&data), "--out", text(&out), "--rate", "5", "--steps", "4", "--frames", "1"];
    let done = run(&[&flags[..], &["--questions", "4", "--check-every", "2"]].concat());
    let said = String::from_utf8_lossy(&done.stdout).into_owned();
    assert!(done.status.success() && said.contains("nothing written"), "{said}");
    let left: Vec<_> = std::fs::read_dir(dir.path()).unwrap().map(|e| e.unwrap().file_name()).collect();
    assert_eq!(left, ["data"]);
}

#[test]
fn bad_input_is_told_and_nothing_is_written() {
    let dir = tempfile::tempdir().unwrap();
    let (data, out) = (dir.path().join("data"), dir.path().join("out"));
    let refused = |data: &Path, flags: &[&str], words: &str| {
        let done = run(&[&["--data", text(data), "--out", text(&out)], flags].concat());
        let said = String::from_utf8_lossy(&done.stderr).into_owned();
        assert!(!done.status.success() && said.contains(words), "{words}: {said}");
        assert!(!said.contains("panicked") && done.stdout.is_empty() && !out.exists(), "{said}");
    };
    refused(&data, &[], "data");
    write_frames(&data, 4);
    refused(&data, &[], "4 frames");
    write_frames(&data, 6);
    refused(&data, &["--model", text(&dir.path().join("none"))], "none");
    refused(&data, &["--rate", "0"], "rate");
    refused(dir.path(), &[], "no frame");
    std::fs::write(data.join("sparse/3.npy"), "cut").unwrap();
    refused(&data, &[], "3.npy");
    std::fs::create_dir(&out).unwrap();
    let done = run(&["--data", text(&data), "--out", text(&out)]);
    assert!(!done.status.success() && String::from_utf8_lossy(&done.stderr).contains("there already"));
}
