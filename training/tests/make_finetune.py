"""Makes tests/fixtures/finetune: prompts for a small random Qwen2.5-VL, an adapter after 20 steps of fine-tuning on them, and the logits
that PyTorch gives for the first token of each answer. `cargo test --test finetune` loads the adapter and compares.

    pip install -r training/tests/requirements-finetune.txt
    cargo build --release --example records
    PYTHONPATH=training python training/tests/make_finetune.py

The base is that of tests/fixtures/qwen_small, with a vocabulary of bytes, as `tests/number_tokens/base.rs` makes it. Two ways of asking: `rows`,
one number token at a pixel that asks and answers, on a base with a head of its own; and `paper`, the paper's sentences and
digits, on a tied one.
"""

import json
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import torch
from safetensors.torch import load_file, save_file

from sdim_training.qwen import adapter, train
from sdim_training.qwen.records import Shard, collate

ROOT = Path(__file__).parents[2]
SMALL, FIXTURE = ROOT / "tests/fixtures/qwen_small", ROOT / "tests/fixtures/finetune"
SPECIAL = {
    290: "<|point|>", 296: "<|im_start|>", 297: "<|vision_start|>", 298: "<|vision_end|>", 299: "<|vision_pad|>",
    300: "<|image_pad|>", 301: "<|video_pad|>", 302: "<|im_end|>", 303: "<|endoftext|>",
}
STEPS, QUESTIONS = 20, {"rows": 12, "paper": 4}


def make_base(directory, tied):
    """The checkpoint that is tuned."""
    config = json.loads((SMALL / "config.json").read_text()) | {"tie_word_embeddings": tied}
    tensors = load_file(SMALL / "model.safetensors")
    if not tied:
        tensors["lm_head.weight"] = ((torch.arange(304.0 * 48) * 0.731).sin() * 0.3).view(304, 48)
    words = json.loads((ROOT / "tests/fixtures/records/checkpoint/tokenizer.json").read_text())
    words["added_tokens"] = [
        dict(id=i, content=SPECIAL.get(i, f"<|unused{i}|>"), single_word=False, lstrip=False, rstrip=False, normalized=False, special=True)
        for i in range(256, 304)
    ]
    for name, value in (("config.json", config), ("tokenizer.json", words)):
        (directory / name).write_text(json.dumps(value))
    shutil.copyfile(SMALL / "preprocessor_config.json", directory / "preprocessor_config.json")
    save_file(tensors, directory / "model.safetensors", {"format": "pt"})
    return directory


def settings(name):
    """The package's own settings, in the size of the base."""
    out = json.loads((train.SETTINGS / f"{name}.json").read_text())
    out["fusion"] = {"branch": 4, "high": 6, "low": 5}
    out["lora"] = {"rank": 3, "alpha": 6.0, "targets": ["q_proj", "v_proj", "o_proj", "down_proj", "qkv", "attn.proj", "mlp.0"]}
    if name == "rows":
        out["number"] = {"kind": "log_bins", "bins": 40, "lowest": 0.1, "highest": 10.0}
        out["pixel_reference"]["token"], out["measurements"]["max"], out["glimpse"] = "<|point|>", 20, 4
    return out


def options(name, base, start, records, out, *more):
    given = ["--base", base, "--adapter", start, "--records", records, "--out", out, "--steps", STEPS, "--batch", 2, "--rate", 1e-2]
    given += ["--own-rate", 2e-2, "--warmup", 2, "--precision", "f32", "--device", "cpu", "--seed", 3, *more]
    return train.options([str(g) for g in given])


def tuned(name, base, start, records, out, *more):
    """The trainer after its 20 steps, one thread."""
    torch.set_num_threads(1)
    return train.run(options(name, base, start, records, out, *more), torch.device("cpu"))


def loaded(name, base, directory):
    """A model of the base with an adapter, as it answers."""
    about = Shard(FIXTURE / name / "000000.safetensors").about
    chosen = options(name, base, directory, FIXTURE / name, directory)
    model = train.build(chosen, train.settings_of(chosen), about, "cpu", torch.float32)
    adapter.load(model, directory)
    return model.eval()


@torch.no_grad()
def first_logits(model, name):
    """Logits of the first token of each answer, [frames, questions, rows]."""
    shard = Shard(FIXTURE / name / "000000.safetensors")
    batch = collate([shard.example(i, 0) for i in range(shard.frames)])
    logits, _ = model(batch)
    first = torch.cat([torch.tensor([True]), batch.question[1:] != batch.question[:-1]])
    return logits[first].unflatten(0, (shard.frames, shard.questions))


def main():
    program = Path(sys.argv[1]) if len(sys.argv) > 1 else ROOT / "target/release/examples/records"
    for name, questions in QUESTIONS.items():
        target = FIXTURE / name
        shutil.rmtree(target, ignore_errors=True)
        target.mkdir(parents=True)
        with tempfile.TemporaryDirectory() as temporary:
            work = Path(temporary)
            for part in ("base", "start"):
                (work / part).mkdir()
            base = make_base(work / "base", tied=name == "paper")
            (work / "start/sdim.json").write_text(json.dumps(settings(name), indent=2) + "\n")
            command = [program, "--base", base, "--settings", work / "start/sdim.json", "--out", work / "records", "--size", "96x72"]
            command += ["--count", "4", "--shard", "4", "--variants", "1", "--questions", questions, "--prompt", "20", "--points", "20,60"]
            subprocess.run([str(c) for c in command], check=True)
            shutil.copyfile(work / "records/000000.safetensors", target / "000000.safetensors")
            tuned(name, base, work / "start", work / "records", work / "out")
            for part in (adapter.SETTINGS, adapter.TENSORS):
                shutil.copyfile(work / "out" / part, target / part)
            logits = first_logits(loaded(name, base, target), name)
            save_file({"first_logits": logits.contiguous()}, target / "expected.safetensors")
            print(name, logits.shape, logits.std())


if __name__ == "__main__":
    main()
