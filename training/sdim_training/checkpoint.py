"""Checkpoints: the published one, which the crate loads as it is, and the state that a run resumes from."""

import json
import os
import shutil
from pathlib import Path

import torch
from safetensors.torch import load_file, save_file

FILES = ("config.json", "preprocessor_config.json", "sdim.json", "tokenizer.json")
WEIGHTS, STATE = "model.safetensors", "state.pt"


def whole(path, write):
    """Writes beside the target and renames: a run that is killed leaves no half file."""
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        write(part)
        part.chmod(0o644)
        os.replace(part, path)
    finally:
        part.unlink(missing_ok=True)


def load_weights(model, directory):
    """The weights of a checkpoint directory, all of them and no others."""
    model.load_state_dict({k: v.float() for k, v in load_file(Path(directory) / WEIGHTS).items()})


def publish(model, files, directory):
    """A checkpoint directory of these weights in bf16, with the JSON files of the directory `files`, but for the scale of the confidence:
    it was found for other weights (example `confidence`)."""
    directory.mkdir(parents=True, exist_ok=True)
    for name in FILES:
        if not (directory / name).exists() or not os.path.samefile(Path(files) / name, directory / name):
            whole(directory / name, lambda part, name=name: shutil.copyfile(Path(files) / name, part))
    sdim = json.loads((directory / "sdim.json").read_text())
    if sdim.pop("confidence", None):
        whole(directory / "sdim.json", lambda part: part.write_text(json.dumps(sdim, indent=2) + "\n"))
    tensors = {k: v.detach().bfloat16().contiguous().cpu() for k, v in model.state_dict().items()}
    whole(directory / WEIGHTS, lambda part: save_file(tensors, part))


def save_state(directory, **parts):
    directory.mkdir(parents=True, exist_ok=True)
    whole(directory / STATE, lambda part: torch.save(parts, part))


def load_state(directory, device, settings):
    """A run's state; `settings` are those that it must have been started with."""
    state = torch.load(directory / STATE, map_location=device, weights_only=True)
    known = {"sharp": False} | state["settings"]
    other = {k: (known.get(k), v) for k, v in settings.items() if known.get(k) != v}
    if other:
        said = ", ".join(f"{k} {old} there, {new} now" for k, (old, new) in other.items())
        raise SystemExit(f"{directory / STATE}: another run's state: {said}")
    return state


def shortages(directory, model, device):
    """What may soon run out, with a warning in words: disk for states and checkpoints, memory here and on the device."""
    size = sum(t.numel() * t.element_size() for t in model.state_dict().values())
    free = shutil.disk_usage(directory).free
    # A state holds weights, average and two moments; it is written beside the last one.
    if free < 12 * size:
        yield "disk", f"{free / 1e9:.2f} GB of disk left, a state and two checkpoints take {5 * size / 1e9:.2f}"
    left, total = (os.sysconf(n) * os.sysconf("SC_PAGE_SIZE") for n in ("SC_AVPHYS_PAGES", "SC_PHYS_PAGES"))
    if Path("/proc/meminfo").exists():
        lines = dict(line.split(":") for line in Path("/proc/meminfo").read_text().splitlines())
        left = int(lines["MemAvailable"].split()[0]) * 1024
    if left < 0.08 * total:
        yield "memory", f"{left / 1e9:.1f} of {total / 1e9:.1f} GB of memory left: fewer records (--memory-gb)"
    if device.type == "cuda":
        left, total = torch.cuda.mem_get_info(device)
        left += torch.cuda.memory_reserved(device) - torch.cuda.max_memory_allocated(device)
        if left < 0.05 * total:
            yield "gpu", f"{left / 1e9:.1f} of {total / 1e9:.1f} GB left on {device}: a smaller --batch"
