//! The example programs, run as a user runs them.

mod common;

use common::program::{FEATURES, Place, program};
use sdim::internals::supervise::FreshFiles;
use sdim::settings::Settings;
use serde_json::Value;
use std::path::Path;
use std::process::{Command, Output, Stdio};

fn run(name: &str, args: &[&str]) -> Output {
    Command::new(program(name)).args(args).output().unwrap()
}

fn text(path: &Path) -> &str {
    path.to_str().unwrap()
}

#[test]
fn complete_runs_on_the_bundled_pair() {
    let dir = tempfile::tempdir().unwrap();
    let out = run("complete", &["--out", text(dir.path()), "--json"]);
    assert!(out.status.success(), "{}", String::from_utf8_lossy(&out.stderr));
    let v: Value = serde_json::from_slice(&out.stdout).unwrap();
    assert_eq!(v["valid"].as_u64().unwrap(), v["width"].as_u64().unwrap() * v["height"].as_u64().unwrap());
    assert!(v["mae"].as_f64().unwrap() < v["nearest"]["mae"].as_f64().unwrap());
    for key in ["load", "encode", "prefill", "queries", "refine", "total"] {
        assert!(v["seconds"][key].as_f64().unwrap() >= 0.0, "{key}");
    }
    for key in ["measured", "asked", "queries_per_second", "rmse", "abs_rel"] {
        assert!(v[key].as_f64().unwrap() > 0.0, "{key}");
    }
    for name in ["dense.png", "dense.npy", "confidence.npy", "preview.png"] {
        assert!(dir.path().join(name).metadata().unwrap().len() > 1000, "{name}");
    }
    let again = sdim::SparseDepth::read(dir.path().join("dense.npy"), None).unwrap();
    let bundled = Path::new(env!("CARGO_MANIFEST_DIR")).join("assets/example/sparse.png");
    let sparse = sdim::SparseDepth::read(bundled, Some(sdim::DepthScale::millimetres())).unwrap();
    let changed = sparse.points().filter(|&(x, y, d)| again.get(x, y) != Some(d)).count();
    assert_eq!(
        v["flagged"].as_u64(),
        Some(changed as u64),
        "measured pixels in the file, but for flagged ones"
    );
    assert!(changed * 100 <= sparse.measured(), "{changed} flagged in a clean frame");
}

#[test]
fn complete_does_its_work_when_nobody_reads_on() {
    for json in [&["--json"][..], &[]] {
        let dir = tempfile::tempdir().unwrap();
        let mut command = Command::new(program("complete"));
        command.args(["--plan", "stride:32", "--max-memory", "1", "--out", text(dir.path())]).args(json);
        let mut child = command.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
        drop(child.stdout.take());
        let out = child.wait_with_output().unwrap();
        let said = String::from_utf8_lossy(&out.stderr);
        assert!(out.status.success() && !said.contains("panicked"), "{said}");
        assert!(dir.path().join("preview.png").exists());
    }
}

#[test]
fn complete_writes_nothing_on_bad_input() {
    let dir = tempfile::tempdir().unwrap();
    let out_dir = dir.path().join("out");
    let bundled = Path::new(env!("CARGO_MANIFEST_DIR")).join("assets/example");
    let (rgb, sparse) = (bundled.join("rgb.png"), bundled.join("sparse.png"));
    let cut = dir.path().join("cut.png");
    std::fs::write(&cut, &std::fs::read(&rgb).unwrap()[..5000]).unwrap();
    let absent = dir.path().join("absent");
    let (none, other) = (dir.path().join("none.png"), dir.path().join("other.png"));
    let scale = sdim::DepthScale::millimetres();
    sdim::depth::io::write_png16(&none, 640, 480, &[0; 640 * 480]).unwrap();
    sdim::depth::io::write_png16(&other, 480, 640, &[scale.stored(1.0).0; 640 * 480]).unwrap();
    let short = dir.path().join("short.png");
    std::fs::write(&short, &std::fs::read(&sparse).unwrap()[..3000]).unwrap();
    let cases: [(&[&str], &str); 10] = [
        (&["--rgb", text(&rgb), "--sparse", text(&none), "--depth-scale", "mm"], "no valid measurement"),
        (&["--rgb", text(&rgb), "--sparse", text(&other), "--depth-scale", "mm"], "other.png"),
        (
            &["--rgb", text(&rgb), "--sparse", text(&sparse), "--depth-scale", "mm", "--gt", text(&other)],
            "other.png",
        ),
        (&["--rgb", text(&rgb), "--sparse", text(&short), "--depth-scale", "mm"], "short.png"),
        (&["--rgb", text(&rgb), "--sparse", text(&sparse), "--depth-scale", "inch"], "inch"),
        (&["--rgb", text(&cut), "--sparse", text(&sparse), "--depth-scale", "mm"], "cut.png"),
        (&["--rgb", text(&rgb), "--sparse", text(&sparse)], "scale"),
        (&["--rgb", text(&rgb), "--sparse", text(&rgb), "--depth-scale", "mm"], "rgb.png"),
        (&["--model", text(&absent)], "absent"),
        (&["--plan", "stride:0"], "stride:0"),
    ];
    for (args, named) in cases {
        let out = run("complete", &[args, &["--out", text(&out_dir)]].concat());
        let said = String::from_utf8_lossy(&out.stderr).into_owned();
        assert!(!out.status.success() && said.contains(named), "{args:?}: {said}");
        assert!(!said.contains("panicked"), "{said}");
        assert!(out.stdout.is_empty() && !out_dir.exists(), "{args:?}");
    }
}

#[test]
fn robot_answers_messages_with_messages() {
    let of = |confidence: &str| {
        let out = run("robot", &["--json", "--plan", "stride:16", "--min-confidence", confidence]);
        assert!(out.status.success(), "{}", String::from_utf8_lossy(&out.stderr));
        serde_json::from_slice::<Value>(&out.stdout).unwrap()
    };
    let all = of("0");
    assert_eq!((&all["points_in"], &all["measured"], &all["hidden"]), (&500.into(), &500.into(), &0.into()));
    assert_eq!((&all["points_out"], &all["point_step"]), (&(640 * 480).into(), &20.into()));
    // The same map as that of `complete`, whose measurements come from a file.
    let dir = tempfile::tempdir().unwrap();
    let out = run("complete", &["--json", "--plan", "stride:16", "--out", text(dir.path())]);
    let complete: Value = serde_json::from_slice(&out.stdout).unwrap();
    let [ours, file] = [&all, &complete].map(|v| v["mae"].as_f64().unwrap());
    assert!((ours - file).abs() < 1e-4 * file, "{ours} and {file} m");
    // Measured pixels are sure, and not all others.
    let sure = of("0.9")["points_out"].as_u64().unwrap();
    assert!((480..640 * 480).contains(&sure), "{sure}");
}

#[test]
fn stream_compares_both_ways() {
    let flags = ["--json", "--frames", "4", "--width", "96", "--height", "72", "--points", "40"];
    for poses in [&[][..], &["--no-poses", "--speed", "0"]] {
        let out = run("stream", &[&flags[..], poses].concat());
        assert!(out.status.success(), "{}", String::from_utf8_lossy(&out.stderr));
        let v: Value = serde_json::from_slice(&out.stdout).unwrap();
        for key in ["frames_per_second", "asked", "mae", "flicker"] {
            assert!(v["single"][key].as_f64() > Some(0.0) && v["stream"][key].as_f64() > Some(0.0), "{key}");
        }
        assert!(v["stream"]["asked"].as_f64() < v["single"]["asked"].as_f64());
    }
}

#[test]
fn train_resumes_and_its_checkpoint_loads() {
    let dir = tempfile::tempdir().unwrap();
    let model = dir.path().join("model");
    let base = ["--out", text(&model), "--log-every", "1"];
    let flags = ["--steps", "4", "--frames", "1", "--questions", "8", "--rate", "2e-3", "--stop-at", "2"];
    let first = run("train", &[&base[..], &flags[..]].concat());
    assert!(first.status.success(), "{}", String::from_utf8_lossy(&first.stderr));
    let written = std::fs::read(model.join("train.json")).unwrap();
    // The flags of the first run need not be told again; one that says something else is refused.
    let refused = |flags: &[&str], words: &[&str]| {
        let out = run("train", &[&base[..], &["--resume"], flags].concat());
        let said = String::from_utf8_lossy(&out.stderr).into_owned();
        assert!(!out.status.success() && words.iter().all(|w| said.contains(w)), "{flags:?}: {said}");
        assert!(!said.contains("panicked"), "{said}");
    };
    for (flag, told, was) in [
        ("--steps", "9", "4"),
        ("--seed", "8", "7"),
        ("--rate", "0.001", "0.002"),
        ("--frames", "2", "1"),
        ("--questions", "128", "8"),
        ("--labels", "sparse", "dense"),
    ] {
        refused(&[flag, told], &[&format!("{flag} {told}"), &format!("has {was}")]);
    }
    std::fs::write(model.join("train.json"), &written[..written.len() / 2]).unwrap();
    refused(&[], &["train.json", "expected"]);
    std::fs::remove_file(model.join("train.json")).unwrap();
    refused(&[], &["train.json"]);
    std::fs::write(model.join("train.json"), &written).unwrap();
    let second = run("train", &[&base[..], &["--resume", "--frames", "1"]].concat());
    assert!(second.status.success(), "{}", String::from_utf8_lossy(&second.stderr));
    assert_eq!(std::fs::read(model.join("train.json")).unwrap(), written);
    let curve = std::fs::read_to_string(model.join("curve.csv")).unwrap();
    let steps: Vec<&str> = curve.lines().skip(1).map(|l| l.split(',').next().unwrap()).collect();
    assert_eq!(steps, ["1", "2", "3", "4"]);
    let out = run(
        "complete",
        &["--model", text(&model), "--out", text(&dir.path().join("out")), "--plan", "stride:32"],
    );
    assert!(out.status.success(), "{}", String::from_utf8_lossy(&out.stderr));
}

#[test]
fn train_goes_on_from_a_checkpoint_and_says_what_it_changed() {
    let dir = tempfile::tempdir().unwrap();
    let model = dir.path().join("model");
    let tiny = Path::new(env!("CARGO_MANIFEST_DIR")).join("assets/sdim-tiny");
    let steps = ["--steps", "1", "--frames", "1", "--questions", "8", "--size", "64x48", "--rate", "2e-5"];
    let tuned = ["--from", text(&tiny), "--adapter-of", text(&tiny), "--tune", "--mix", "glazed=1"];
    let out = run("train", &[&steps[..], &tuned[..], &["--out", text(&model)]].concat());
    assert!(out.status.success(), "{}", String::from_utf8_lossy(&out.stderr));
    let read = |path: &Path| std::fs::read(path).unwrap();
    let config: Value = serde_json::from_slice(&read(&model.join("train.json"))).unwrap();
    assert_eq!((config["batch"]["mix"]["glazed"].as_f64(), config["widen"].as_f64()), (Some(1.0), Some(0.0)));
    assert_eq!(config["batch"]["sizes"], serde_json::json!([[64, 48]]));
    // All that the checkpoint says of itself stays, its confidence, too.
    assert_eq!(read(&model.join("sdim.json")), read(&tiny.join("sdim.json")));
    let adapter = sdim::Adapter::load(&model.join("adapter")).unwrap();
    assert!(adapter.tensors.len() > 20 && adapter.tensors.contains_key("model.embed_tokens.weight"));
    let plain = |more: &[&str]| {
        let out =
            run("complete", &[&["--plan", "stride:32", "--json", "--out", text(dir.path())], more].concat());
        assert!(out.status.success(), "{}", String::from_utf8_lossy(&out.stderr));
        serde_json::from_slice::<Value>(&out.stdout).unwrap()["mae"].as_f64().unwrap()
    };
    let (before, after) = (plain(&[]), plain(&["--adapter", text(&model.join("adapter"))]));
    assert!(before != after && (after / before - 1.0).abs() < 0.2, "{before} {after}");
    // What is wrong is found before anything is written: a run that was there stays.
    let small = common::tiny::small_files(&sdim::settings::Settings::tiny());
    let other = dir.path().join("other");
    std::fs::create_dir(&other).unwrap();
    common::tiny::write(&other, &small, &common::tiny::tensors(&small, 3));
    let state = read(&model.join("trainer.safetensors"));
    for bad in [
        &["--tune"][..],
        &["--adapter-of", "/nowhere"],
        &["--from", text(&tiny), "--adapter-of", text(&other)],
        &["--mix", "glazed=1", "--labels", "sparse"],
        &["--mix", "rooms=1"],
        &["--mix", "furnished=1"],
        &["--size", "65x48"],
        &["--size", "64"],
        &["--from", "/nowhere"],
        &["--library", "/nowhere"],
    ] {
        let failed = run("train", &[&["--out", text(&model), "--steps", "1"], bad].concat());
        let said = String::from_utf8_lossy(&failed.stderr).into_owned();
        assert!(!failed.status.success() && !said.contains("panicked"), "{bad:?}: {said}");
    }
    assert!(state == read(&model.join("trainer.safetensors")));
}

#[test]
fn throughput_times_each_stage() {
    for weights in ["f32", "bf16", "int8"] {
        let args = ["--random", "tiny", "--width", "64", "--height", "48", "--queries", "40"];
        let shape =
            ["--batch", "16", "--suffix-tokens", "3", "--digits", "2", "--weights", weights, "--json"];
        let out = run("throughput", &[&args[..], &shape[..]].concat());
        assert!(out.status.success(), "{}", String::from_utf8_lossy(&out.stderr));
        let v: Value = serde_json::from_slice(&out.stdout).unwrap();
        for key in ["vision_s", "prefill_s", "queries_s", "queries_per_second", "gflops", "peak_gflops"] {
            assert!(v[key].as_f64().unwrap() > 0.0, "{key} of {v}");
        }
        assert!(v["peak_rss_bytes"].is_u64());
        assert_eq!((v["queries"].as_u64(), v["tokens_per_query"].as_u64()), (Some(40), Some(4)));
        // 4 x 3 merged tokens of 16 pixels between 15 and 5 of text.
        assert_eq!(v["prompt_tokens"].as_u64(), Some(32));
    }
    // One token of its own asks and answers; both ways of saying a number on one load.
    let small =
        ["--random", "tiny", "--layers", "2", "--width", "64", "--height", "48", "--queries", "20,40"];
    let out =
        run("throughput", &[&small[..], &["--numbers", "digits,bins", "--bins", "30", "--json"]].concat());
    assert!(out.status.success(), "{}", String::from_utf8_lossy(&out.stderr));
    let lines: Vec<Value> = out
        .stdout
        .split(|b| *b == b'\n')
        .filter(|l| !l.is_empty())
        .map(|l| serde_json::from_slice(l).unwrap())
        .collect();
    let told =
        lines.iter().map(|v| (v["numbers"].as_str(), v["queries"].as_u64(), v["tokens_per_query"].as_u64()));
    let (digits, bins) = (Some("digits"), Some("bins"));
    let wanted = [(digits, 20, 5), (digits, 40, 5), (bins, 20, 1), (bins, 40, 1)];
    assert_eq!(told.collect::<Vec<_>>(), wanted.map(|(n, q, t)| (n, Some(q), Some(t))));
    for bad in
        [&["--random", "9b"][..], &["--random", "tiny", "--queries", "0"], &["--model", "/nowhere"], &[]]
    {
        let out = run("throughput", bad);
        assert!(!out.status.success() && out.stdout.is_empty(), "{bad:?}");
    }
}

#[test]
fn number_tokens_writes_an_adapter_that_loads() {
    let dir = tempfile::tempdir().unwrap();
    let (model, adapter) = (dir.path().join("base"), dir.path().join("adapter"));
    let asking = Settings { fusion: None, glimpse: None, ..Settings::paper() };
    FreshFiles::tiny(&asking).unwrap().write_initial(&model, 1).unwrap();
    let made = ["--model", text(&model), "--out", text(&adapter), "--bins", "50"];
    let out = run("number_tokens", &[&made[..], &["--pointer", "<|point|>"]].concat());
    assert!(out.status.success(), "{}", String::from_utf8_lossy(&out.stderr));
    assert!(String::from_utf8_lossy(&out.stdout).contains("sdim.number_tokens.embedding [50, 192]"));
    let options = ["--model", text(&model), "--adapter", text(&adapter), "--plan", "stride:32", "--json"];
    let out = run("complete", &[&options[..], &["--out", text(&dir.path().join("out"))]].concat());
    assert!(out.status.success(), "{}", String::from_utf8_lossy(&out.stderr));
    // A token that the base lacks, and another way of asking that has digits.
    let settings = dir.path().join("paper.json");
    std::fs::write(&settings, "{\"preset\": \"paper\"}").unwrap();
    for bad in [&["--pointer", "<|nothing|>"][..], &["--settings", text(&settings)], &["--bins", "1"]] {
        let out = run("number_tokens", &[&["--model", text(&model), "--out", text(&adapter)], bad].concat());
        assert!(!out.status.success() && out.stdout.is_empty(), "{bad:?}");
    }
}

/// Programs are built with the features of the tests, so that all of them must be known.
#[test]
fn programs_are_built_with_every_feature_of_the_manifest() {
    let manifest = include_str!("../Cargo.toml");
    let section = manifest.split("\n[features]\n").nth(1).unwrap().split("\n[").next().unwrap();
    let keys = section.lines().filter(|line| !line.starts_with('#'));
    let mut named: Vec<&str> = keys.filter_map(|line| Some(line.split_once('=')?.0.trim())).collect();
    let mut known: Vec<&str> = FEATURES.iter().map(|(name, _)| *name).collect();
    named.sort();
    known.sort();
    assert_eq!(known, named);
}

#[test]
fn a_test_knows_where_cargo_has_put_it() {
    let dir = tempfile::tempdir().unwrap();
    let place = |triple: Option<&str>, profile: &str| Place {
        root: dir.path().into(),
        triple: triple.map(String::from),
        profile: profile.into(),
    };
    std::fs::write(dir.path().join(".rustc_info.json"), "{}").unwrap();
    for (path, expected) in [
        ("debug/deps/t-0", place(None, "dev")),
        ("release/deps/t-0", place(None, "release")),
        ("aarch64-unknown-linux-gnu/debug/deps/t-0", place(Some("aarch64-unknown-linux-gnu"), "dev")),
        ("x86_64-pc-windows-msvc/thin/deps/t.exe", place(Some("x86_64-pc-windows-msvc"), "thin")),
    ] {
        assert_eq!(Place::of(&dir.path().join(path)), expected, "{path}");
    }
}

#[test]
fn render_makes_sheets_and_measures_streets_in_rings() {
    let dir = tempfile::tempdir().unwrap();
    let (sheet, out) = (dir.path().join("sheet.png"), dir.path().join("out"));
    let size = ["--width", "64", "--height", "32", "--count", "5"];
    let street = ["--recipe", "street-lidar", "--rings", "16", "--sheet", text(&sheet), "--out", text(&out)];
    let done = run("render", &[&size[..], &street].concat());
    assert!(done.status.success(), "{}", String::from_utf8_lossy(&done.stderr));
    // Four pairs of a frame and its depth in a row, two rows.
    assert_eq!(image::image_dimensions(&sheet).unwrap(), (512, 64));
    let sparse = out.join("sparse/scene_2000000.png");
    let sparse = sdim::SparseDepth::read(sparse, Some(sdim::DepthScale::millimetres())).unwrap();
    assert!((20..64 * 16).contains(&sparse.measured()), "{}", sparse.measured());
    for bad in [
        &["--recipe", "furnished"][..],
        &["--recipe", "attic"],
        &["--recipe", "street-lidar", "--rings", "17"],
    ] {
        let failed = run("render", &[bad, &["--sheet", text(&sheet)]].concat());
        assert!(!failed.status.success(), "{bad:?}");
    }
}
